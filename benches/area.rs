//! What a map of a hundred times the area costs.
//!
//!     cargo bench --bench area -- AREA.map REC.mcap
//!
//! Localizes a recording on its map, and on that map among 99 others of its size: its own copies, with the signs of the
//! features drawn anew, so that they are other places which are as hard to tell apart. Each runs in a process of its own,
//! which prints milliseconds a frame (reading the recording is part of it) and the greatest resident memory.

use std::{
    env, fs,
    path::{Path, PathBuf},
    process::Command,
    time::Instant,
};

use anyhow::Context;
use omniloc::{
    localize::{FIELDS_IN_MEMORY_BYTES, MotionSettings},
    map::{CandidateCells, Compass, FeatureMap, Grid, MapGroup, OpenMap, file},
    recording::DeviceRecords,
    runtime::localize::{Session, playback},
    types::{LocalizationState, PositionM},
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Maps in a row.
const SIDE: u32 = 10;
/// Steps between them.
const GAP: u32 = 20;

fn main() -> anyhow::Result<()> {
    let args: Vec<PathBuf> = env::args_os().skip(1).filter(|arg| arg != "--bench").map(PathBuf::from).collect();
    match args.as_slice() {
        [area, recording] => compare(area, recording),
        [run, area, recording] if run.as_os_str() == "run" => localize(area, recording),
        _ => {
            println!("area: needs a map and a recording: cargo bench --bench area -- AREA.map REC.mcap");
            Ok(())
        }
    }
}

fn compare(area: &Path, recording: &Path) -> anyhow::Result<()> {
    let map = file::read(fs::File::open(area)?)?;
    let folder = tempfile::tempdir()?;
    let large = folder.path().join("large.map");
    let tiled = tiled(&map);
    println!("{} cells, and {} among as many others", map.cells.len(), tiled.cells.len());
    fs::write(&large, file::to_bytes(&tiled))?;
    drop(tiled);
    for map in [area, &large, area, &large] {
        let status = Command::new(env::current_exe()?).arg("run").arg(map).arg(recording).status()?;
        anyhow::ensure!(status.success(), "{}", map.display());
    }
    Ok(())
}

/// The map in the middle of its strange copies.
fn tiled(map: &FeatureMap) -> FeatureMap {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let [wide, high] = [map.cells.grid.columns + GAP, map.cells.grid.rows + GAP];
    let step_m = map.cells.grid.step_m;
    let middle = [SIDE / 2 * wide, SIDE / 2 * high];
    let origin_m = [0, 1].map(|axis| map.cells.grid.origin_m[axis] - step_m * f64::from(middle[axis]));
    let grid = Grid { origin_m, step_m, columns: SIDE * wide, rows: SIDE * high };
    let features: usize = map.info.groups.iter().map(|group| group.features).sum();

    let c = map.cells.len();
    let mut cells = Vec::new();
    let mut fields: Vec<MapGroup> = map.groups.iter().map(|group| MapGroup { ..group.clone() }).collect();
    let copies: Vec<([u32; 2], Vec<f32>)> = (0..SIDE * SIDE)
        .map(|copy| {
            let corner = [copy % SIDE * wide, copy / SIDE * high];
            let sign = |_| if corner == middle || random.random::<bool>() { 1.0 } else { -1.0 };
            (corner, (0..features).map(sign).collect())
        })
        .collect();
    // By row, then column, as a map has them.
    let mut order: Vec<([u32; 2], usize, usize)> = Vec::new();
    for (copy, (corner, _)) in copies.iter().enumerate() {
        let of_copy = map.cells.indices().iter().enumerate();
        order.extend(of_copy.map(|(cell, &[i, j])| ([j + corner[1], i + corner[0]], copy, cell)));
    }
    order.sort_unstable();
    cells.extend(order.iter().map(|&([j, i], ..)| [i, j]));
    let mut before = 0;
    for (tiled, group) in fields.iter_mut().zip(&map.groups) {
        let k = group.scaling.features();
        let row = |values: &[f32], r: usize, signed: bool| -> Vec<f32> {
            let sign = |copy: usize| if signed { copies[copy].1[before + r] } else { 1.0 };
            order.iter().map(|&(_, copy, cell)| sign(copy) * values[r * c + cell]).collect()
        };
        tiled.field_mean = (0..k).flat_map(|r| row(&group.field_mean, r, true)).collect();
        tiled.field_variance =
            (0..group.field_variance.len() / c).flat_map(|r| row(&group.field_variance, r, false)).collect();
        before += k;
    }

    let moved = |copy: usize, position_m: PositionM| {
        let corner = copies[copy].0;
        [0, 1].map(|axis| position_m[axis] + step_m * (f64::from(corner[axis]) - f64::from(middle[axis])))
    };
    let everywhere: Vec<PositionM> = (0..copies.len())
        .flat_map(|copy| map.positions_m.iter().map(move |&p| (copy, p)))
        .map(|(c, p)| moved(c, p))
        .collect();
    let n = map.positions_m.len();
    for group in &mut fields {
        group.learning =
            faer::Mat::from_fn(everywhere.len(), group.learning.ncols(), |i, r| group.learning[(i % n, r)]);
    }
    let compass = map.compass.as_ref().map(|compass| Compass {
        positions_m: everywhere.clone(),
        yaws_rad: compass.yaws_rad.repeat(copies.len()),
        signatures: compass.signatures.repeat(copies.len()),
        ..*compass
    });
    let cells = CandidateCells::from_parts(grid, cells).expect("in order");
    let mut info = map.info.clone();
    info.grid = grid;
    FeatureMap { info, positions_m: everywhere, cells, groups: fields, compass }
}

/// In a process of its own.
fn localize(area: &Path, recording: &Path) -> anyhow::Result<()> {
    let started = Instant::now();
    let map = OpenMap::open(Box::new(fs::File::open(area)?))?;
    let cells = map.cells.len();
    let mut session = Session::new(map, MotionSettings::default(), FIELDS_IN_MEMORY_BYTES)?;
    let loaded_s = started.elapsed().as_secs_f64();
    let mut last = Instant::now();
    let (mut following_ms, mut searching_ms) = (Vec::new(), Vec::new());
    let mut was_localized = false;
    playback::play(DeviceRecords::open(recording)?, &mut session, |estimate| {
        let ms = last.elapsed().as_secs_f64() * 1e3;
        if was_localized {
            following_ms.push(ms)
        } else {
            searching_ms.push(ms)
        }
        was_localized = estimate.state == LocalizationState::Localized;
        last = Instant::now();
        Ok(())
    })?;
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len().max(1) as f64;
    following_ms.sort_unstable_by(f64::total_cmp);
    let at = |share: f64| following_ms.get((share * following_ms.len() as f64) as usize).copied().unwrap_or(f64::NAN);
    let status = fs::read_to_string("/proc/self/status").context("reading the memory in use")?;
    let resident = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap_or("?").trim();
    println!(
        "{cells:>7} cells: once localized {:.2} ms a frame (median {:.2}, 99 % {:.2}, {} frames); until then {:.1} ms \
         ({} frames); opened in {loaded_s:.2} s; resident {resident}",
        mean(&following_ms),
        at(0.5),
        at(0.99),
        following_ms.len(),
        mean(&searching_ms),
        searching_ms.len(),
    );
    Ok(())
}
