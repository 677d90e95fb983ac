//! `omniloc simulate`: a drive through a simulated place becomes a data set.

use std::{
    fs,
    path::{Path, PathBuf},
    process::ExitCode,
};

use anyhow::Context;
use clap::ValueEnum;
use serde_json::json;

use super::{
    BadArgument, DONE,
    options::{OutputKind, check_output, parse_origin},
    print,
    progress::Progress,
};
use crate::{
    types::{Geodetic, LocalFrame, wrap_angle_rad},
    world::{
        Camera, CameraError, Day, Drive, DriveSettings, Pose, Receiver, ReceiverSample, ReceiverSettings, Renderer,
        Season, World,
    },
};

/// Drive through a simulated place and write images and positions as a data set
///
/// What `omniloc import` reads: images/, positions.csv with the errors of a satellite receiver (none indoors), donut.json,
/// and beside them truth.csv with the exact positions. The same options give the same files. Use it to try settings: the
/// same place on another day has the same --seed and another --day. The hall is not driven through but photographed: at
/// random places, or with --spacing-m near the points of a lattice, facing anywhere, without times.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Folder to write
    #[arg(long, value_name = "DATASET")]
    pub out: PathBuf,
    /// The kind of place
    #[arg(long, value_enum, default_value = "town")]
    pub world: WorldName,
    /// Which place
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Which day: light, shadows, parked cars, traffic, people
    #[arg(long, default_value_t = 1)]
    pub day: u64,
    /// Which drive: speeds, stops, errors of the receiver; which places in the hall [default: the day's number]
    #[arg(long)]
    pub drive: Option<u64>,
    /// Images, evenly along the whole drive, or at so many places
    #[arg(long, default_value_t = 400, value_parser = clap::value_parser!(u32).range(2..=100_000))]
    pub frames: u32,
    /// One image near every point of a lattice of this spacing, instead of --frames images (hall) [m]
    #[arg(long, value_name = "M", conflicts_with = "frames")]
    pub spacing_m: Option<f64>,
    /// Laps round the block in each direction (town)
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=100))]
    pub laps: u32,
    /// Drive this much further to the right than the middle of the lane [m]
    #[arg(long, default_value_t = 0.0, allow_negative_numbers = true, value_name = "M")]
    pub lane_shift_m: f64,
    /// Length of the corridor that is driven through [m]
    #[arg(long, default_value_t = 7.0, value_name = "M")]
    pub length_m: f64,
    /// Deviation of the receiver's slow error, an axis [m; default: 0.6 in town, 0 in the corridor; none in the hall]
    #[arg(long, value_name = "M")]
    pub position_std_m: Option<f64>,
    /// Season: height of the sun, leaves of the trees [default: full leaves, and the sun as high as --day says]
    #[arg(long, value_enum)]
    pub season: Option<SeasonName>,
    /// So many times as many people and cars as --day says
    #[arg(long, default_value_t = 1.0, value_name = "FACTOR")]
    pub traffic: f64,
    /// The camera's gain is off by about this much, every --day another way [dB]
    #[arg(long, default_value_t = 0.0, value_name = "DB")]
    pub gain_db: f64,
    /// The camera is mounted askew by about this much, every --day another way [degrees]
    #[arg(long, default_value_t = 0.0, value_name = "DEG")]
    pub tilt_deg: f64,
    /// Size of the images [px]
    #[arg(long, default_value = "1280x720", value_parser = parse_size, value_name = "WxH")]
    pub size: (usize, usize),
    /// Where x = y = 0 lies [default: somewhere at sea]
    #[arg(long, value_name = "LAT,LON[,ALT]", value_parser = parse_origin, allow_hyphen_values = true)]
    pub origin: Option<Geodetic>,
    /// Replace the output if it exists
    #[arg(long)]
    pub force: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum SeasonName {
    Winter,
    Spring,
    Summer,
    Autumn,
}

impl From<SeasonName> for Season {
    fn from(name: SeasonName) -> Self {
        match name {
            SeasonName::Winter => Self::Winter,
            SeasonName::Spring => Self::Spring,
            SeasonName::Summer => Self::Summer,
            SeasonName::Autumn => Self::Autumn,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum WorldName {
    /// Streets around a block of houses of 60 by 90 m
    Town,
    /// 7 by 2.7 m between doors, posters and furniture
    Corridor,
    /// 44 by 38 m with stands, shelves and columns
    Hall,
}

fn parse_size(text: &str) -> Result<(usize, usize), String> {
    let size = text.split_once('x').and_then(|(width, height)| Some((width.parse().ok()?, height.parse().ok()?)));
    size.ok_or_else(|| format!("{text} is not a size such as 1280x720"))
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    check_output(&args.out, OutputKind::Folder, args.force)?;
    check_range("--lane-shift-m", args.lane_shift_m, -1.5..=1.5)?;
    check_range("--length-m", args.length_m, World::CORRIDOR_LENGTHS_M)?;
    check_range("--position-std-m", args.position_std_m.unwrap_or(0.0), 0.0..=100.0)?;
    let (world, camera) = match args.world {
        WorldName::Town => (World::town_block(args.seed), Camera::town()),
        WorldName::Corridor => (World::corridor_of_length(args.seed, args.length_m), Camera::corridor()),
        WorldName::Hall => (World::hall(args.seed), Camera::hall()),
    };
    if args.world != WorldName::Hall && args.spacing_m.is_some() {
        return Err(BadArgument("--spacing-m goes with --world hall: other places are driven through".into()).into());
    }
    if args.world == WorldName::Hall && args.position_std_m.is_some() {
        return Err(BadArgument("--position-std-m goes with a drive: positions in the hall are exact".into()).into());
    }
    check_range("--spacing-m", args.spacing_m.unwrap_or(1.0), 0.3..=10.0)?;
    let world = args.origin.map_or(world.clone(), |origin| world.with_origin(origin));
    check_range("--traffic", args.traffic, 0.0..=10.0)?;
    check_range("--gain-db", args.gain_db, 0.0..=12.0)?;
    check_range("--tilt-deg", args.tilt_deg, 0.0..=4.0)?;
    let day = Day::new(args.day);
    let day = args.season.map_or(day.clone(), |season| day.in_season(season.into()));
    let day = day.with_traffic(args.traffic).with_gain(args.gain_db);
    let camera = camera.scaled_to(args.size.0, args.size.1).tilted(args.tilt_deg.to_radians(), args.day);
    let renderer = Renderer::new(&world, &day, &camera);
    let mut renderer = renderer.map_err(|error: CameraError| BadArgument(format!("--size: {error}")))?;

    let parent = args.out.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let temporary = tempfile::Builder::new()
        .prefix(".omniloc-")
        .tempdir_in(parent)
        .with_context(|| format!("making a folder in {}", parent.display()))?;
    let filled = temporary.path().join("new");
    let frames = write_dataset(args, &world, &mut renderer, &filled)
        .with_context(|| format!("writing {}", args.out.display()))?;
    if args.out.exists() {
        fs::rename(&args.out, temporary.path().join("old"))
            .with_context(|| format!("replacing {}", args.out.display()))?;
    }
    fs::rename(&filled, &args.out).with_context(|| format!("writing {}", args.out.display()))?;
    print(&format!("{}: {frames} frames of {} x {} px\n", args.out.display(), camera.width_px, camera.height_px))?;
    Ok(DONE.into())
}

fn check_range(option: &str, found: f64, range: std::ops::RangeInclusive<f64>) -> Result<(), BadArgument> {
    if range.contains(&found) {
        return Ok(());
    }
    Err(BadArgument(format!("{option} is {found}, expected {} to {}", range.start(), range.end())))
}

/// What one image shows and what is known of it.
struct Shot {
    pose: Pose,
    /// Of the traffic; in the files only if images follow each other in time.
    time_s: f64,
    in_order: bool,
    measured_m: [f64; 2],
    measured_yaw_rad: f64,
}

/// Number of frames written.
fn write_dataset(args: &Args, world: &World, renderer: &mut Renderer, folder: &Path) -> anyhow::Result<usize> {
    let shots = match args.world {
        WorldName::Town | WorldName::Corridor => driven(args, world),
        WorldName::Hall => photographed(args, world),
    };
    let (mut positions, mut truth) =
        (String::from("index,file,x_m,y_m,yaw_rad,time_s\n"), String::from("index,x_m,y_m\n"));
    let progress = Progress::new();
    progress.begin("rendering", shots.len());
    fs::create_dir_all(folder.join("images"))?;
    let mut jpeg = Vec::new();
    for (index, shot) in shots.iter().enumerate() {
        renderer.render_jpeg(&shot.pose, shot.time_s, &mut jpeg);
        let file = format!("{index:05}.jpg");
        fs::write(folder.join("images").join(&file), &jpeg)?;
        let ([x_m, y_m], yaw_rad) = (shot.measured_m, shot.measured_yaw_rad);
        let time = if shot.in_order { format!("{:.4}", shot.time_s) } else { String::new() };
        positions += &format!("{index},{file},{x_m:.4},{y_m:.4},{yaw_rad:.5},{time}\n");
        let [x_m, y_m] = shot.pose.position_m;
        truth += &format!("{index},{x_m:.4},{y_m:.4}\n");
        progress.advance(1);
    }
    progress.finish();
    fs::write(folder.join("positions.csv"), positions)?;
    fs::write(folder.join("truth.csv"), truth)?;
    fs::write(folder.join("donut.json"), format!("{:#}\n", json!(renderer.camera().donut)))?;
    let Geodetic { latitude_deg, longitude_deg, altitude_m } = world.origin;
    let origin = json!({"latitude_deg": latitude_deg, "longitude_deg": longitude_deg, "altitude_m": altitude_m});
    let kind = match args.world {
        WorldName::Town => "town",
        WorldName::Corridor => "corridor",
        WorldName::Hall => "hall",
    };
    let name = format!("{kind}-{}-day-{}", args.seed, args.day);
    fs::write(folder.join("recording.json"), format!("{:#}\n", json!({"name": name, "origin": origin})))?;
    Ok(shots.len())
}

/// Evenly along a drive.
fn driven(args: &Args, world: &World) -> Vec<Shot> {
    let drive_seed = args.drive.unwrap_or(args.day);
    let settings = DriveSettings {
        seed: drive_seed,
        laps: args.laps,
        lane_shift_m: args.lane_shift_m,
        ..DriveSettings::default()
    };
    let drive = Drive::new(world, &settings);
    let mut receiver = Positions::new(args, world, &drive, drive_seed);
    (0..args.frames)
        .map(|index| {
            let distance_m = drive.length_m() * f64::from(index) / f64::from(args.frames);
            // Stamps and positions have so many digits in the files: what is written is what was rendered.
            let time_s = (drive.time_at_distance_s(distance_m) * 1e4).round() / 1e4;
            let (measured_m, measured_yaw_rad) = receiver.at(time_s);
            Shot { pose: drive.pose_at(time_s), time_s, in_order: true, measured_m, measured_yaw_rad }
        })
        .collect()
}

/// One by one, in no order, at known places. Between two photographs everybody has gone somewhere else.
fn photographed(args: &Args, world: &World) -> Vec<Shot> {
    const BETWEEN_S: f64 = 20.0;
    let seed = args.drive.unwrap_or(args.day);
    let poses = match args.spacing_m {
        Some(spacing_m) => world.lattice(spacing_m, seed),
        None => world.scattered(args.frames as usize, seed),
    };
    let shot = |(index, pose): (usize, Pose)| Shot {
        pose,
        time_s: BETWEEN_S * index as f64,
        in_order: false,
        measured_m: pose.position_m,
        measured_yaw_rad: pose.yaw_rad,
    };
    poses.into_iter().enumerate().map(shot).collect()
}

/// The receiver's position at the time of a frame, between its samples.
struct Positions {
    receiver: Receiver,
    frame: LocalFrame,
    before: ReceiverSample,
    after: ReceiverSample,
}

impl Positions {
    fn new(args: &Args, world: &World, drive: &Drive, seed: u64) -> Self {
        let exact = ReceiverSettings { position_noise_std_m: 0.0, ..ReceiverSettings::default() };
        let (settings, drift_std_m) = match args.world {
            WorldName::Town => (ReceiverSettings::default(), 0.6),
            WorldName::Corridor | WorldName::Hall => (exact, 0.0),
        };
        let settings = ReceiverSettings { drift_std_m: args.position_std_m.unwrap_or(drift_std_m), ..settings };
        let mut receiver = Receiver::new(drive, world.origin, seed, settings);
        let mut next = || receiver.next().expect("a receiver never ends");
        let (before, after) = (next(), next());
        Self { receiver, frame: LocalFrame::new(world.origin), before, after }
    }

    /// Times must not go back.
    fn at(&mut self, time_s: f64) -> ([f64; 2], f64) {
        while self.after.time_s < time_s {
            self.before = self.after;
            self.after = self.receiver.next().expect("a receiver never ends");
        }
        let t = (time_s - self.before.time_s) / (self.after.time_s - self.before.time_s);
        let [a, b] = [self.before, self.after].map(|sample| self.frame.to_enu_m(sample.position));
        let turned_rad = wrap_angle_rad(self.after.yaw_rad - self.before.yaw_rad);
        let position_m = [0, 1].map(|axis| a[axis] + t * (b[axis] - a[axis]));
        (position_m, wrap_angle_rad(self.before.yaw_rad + t * turned_rad))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_read_or_refused() {
        assert_eq!(parse_size("1280x720"), Ok((1280, 720)));
        for bad in ["", "1280", "1280x", "axb", "1280x720x3", "-1x5"] {
            assert!(parse_size(bad).is_err(), "{bad}");
        }
    }
}
