//! Our side of `benches/peers/run`: does one task a line of standard input and answers each with one line of JSON that
//! holds the CPU time it took. The inputs are in the directory given as the first argument; `compare.py` writes them.

use std::error::Error;
use std::fs;
use std::io::{BufRead, Write};
use std::path::Path;
use std::time::Duration;

use faer::Mat;
use omniloc::features::{Describer, Descriptor};
use omniloc::gp::LearningPositions;
use omniloc::gp::fit::{Bounds, fit_each};
use omniloc::jpeg::LumaDecoder;
use omniloc::localize::{FieldOnCells, most_likely_cell};
use omniloc::map::NoiseModel;
use omniloc::panorama::{Panorama, UnwrapTable};
use omniloc::train::{LikelihoodTable, backward_elimination};
use omniloc::types::{DonutCalibration, PositionM};
use rustix::time::{ClockId, clock_gettime};
use serde_json::{Value, json};

fn main() -> Result<(), Box<dyn Error>> {
    // `cargo bench` passes --bench to every target; without a directory there is nothing to do.
    let Some(directory) = std::env::args().skip(1).find(|argument| !argument.starts_with("--")) else {
        println!("ours: run benches/peers/run");
        return Ok(());
    };
    let directory = Path::new(&directory);
    let mut chain = Chain::load(directory)?;
    for line in std::io::stdin().lock().lines() {
        let answer = match line?.as_str() {
            "chain" => chain.all_frames()?,
            "decode" => chain.decode_all()?,
            "fit" => fit(directory)?,
            "eliminate" => eliminate(directory)?,
            "match" => match_frames(directory)?,
            task => return Err(format!("unknown task {task}").into()),
        };
        println!("{answer}");
        std::io::stdout().flush()?;
    }
    Ok(())
}

/// CPU time of this process, all threads \[s\]: the clock `time.process_time` reads in Python.
fn cpu_s() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    Duration::new(time.tv_sec as u64, time.tv_nsec as u32).as_secs_f64()
}

/// JPEG → properties of the three descriptors of the paper.
struct Chain {
    jpegs: Vec<Vec<u8>>,
    decoder: LumaDecoder,
    table: UnwrapTable,
    panorama: Panorama,
    describer: Describer,
}

impl Chain {
    fn load(directory: &Path) -> Result<Self, Box<dyn Error>> {
        let mut paths: Vec<_> =
            fs::read_dir(directory.join("frames"))?.map(|entry| entry.map(|e| e.path())).collect::<Result<_, _>>()?;
        paths.sort();
        let jpegs = paths.iter().map(fs::read).collect::<Result<Vec<_>, _>>()?;
        let donut: DonutCalibration = serde_json::from_slice(&fs::read(directory.join("donut.json"))?)?;
        let mut decoder = LumaDecoder::new();
        let first = decoder.decode(jpegs.first().ok_or("no frames")?)?;
        let table = UnwrapTable::build(&donut, first.width_px, first.height_px)?;
        Ok(Self { jpegs, decoder, table, panorama: Panorama::zeros(), describer: Describer::new() })
    }

    fn all_frames(&mut self) -> Result<Value, Box<dyn Error>> {
        let mut properties = vec![Describer::room_for(&Descriptor::PAPER); self.jpegs.len()];
        let start = cpu_s();
        for (jpeg, properties) in self.jpegs.iter().zip(&mut properties) {
            let image = self.decoder.decode_needed(jpeg, self.table.needed())?;
            self.table.unwrap_into(image, 0, &mut self.panorama);
            self.describer.describe(&Descriptor::PAPER, &self.panorama, properties);
        }
        let seconds = cpu_s() - start;
        let properties: Vec<Vec<f32>> = properties.into_iter().map(|of_frame| of_frame.concat()).collect();
        Ok(json!({ "seconds": seconds, "properties": properties }))
    }

    fn decode_all(&mut self) -> Result<Value, Box<dyn Error>> {
        let start = cpu_s();
        let mut sum = 0;
        for jpeg in &self.jpegs {
            sum += usize::from(self.decoder.decode(jpeg)?.pixels[0]);
        }
        Ok(json!({ "seconds": cpu_s() - start, "sum": sum }))
    }
}

/// One Gaussian process a feature: `positions.f64` (n × 2), `features.f64` (n × d).
fn fit(directory: &Path) -> Result<Value, Box<dyn Error>> {
    let learning = LearningPositions::new(positions(&directory.join("positions.f64"))?);
    let values = doubles(&directory.join("features.f64"))?;
    let columns = values.len() / learning.len();
    let features = Mat::from_fn(learning.len(), columns, |i, r| values[i * columns + r]);
    let start = cpu_s();
    let fits = fit_each(&learning, features.as_ref(), &Bounds::PAPER, || {});
    let seconds = cpu_s() - start;
    let hyperparameters: Vec<[f64; 4]> = fits.iter().map(|fit| fit.hyperparameters.to_log().map(f64::exp)).collect();
    Ok(json!({
        "seconds": seconds,
        "log_likelihood": fits.iter().map(|fit| fit.log_likelihood).collect::<Vec<_>>(),
        "evaluations": fits.iter().map(|fit| fit.evaluations).sum::<usize>(),
        "hyperparameters": hyperparameters,
    }))
}

/// `cells.f64` (cells × 2), `truth.f64` (queries × 2), `table.f32` (query × feature × cell).
fn eliminate(directory: &Path) -> Result<Value, Box<dyn Error>> {
    let cells = positions(&directory.join("cells.f64"))?;
    let truths = positions(&directory.join("truth.f64"))?;
    let values = floats(&directory.join("table.f32"))?;
    let features = values.len() / cells.len() / truths.len();
    // The table keeps what it is given, as the peer works in its own copy.
    let queries: Vec<Vec<f32>> = values.chunks_exact(features * cells.len()).map(<[f32]>::to_vec).collect();
    let start = cpu_s();
    let mut table = LikelihoodTable::new(features, cells);
    for (query, truth_m) in queries.into_iter().zip(truths) {
        table.push(truth_m, query);
    }
    let path = backward_elimination(&table, |_| {});
    Ok(json!({ "seconds": cpu_s() - start, "removed": path.removed, "rmse_m": path.rmse_m }))
}

/// `match_mean.f32`, `match_variance.f32` (feature × cell), `match_queries.f32` (query × feature).
fn match_frames(directory: &Path) -> Result<Value, Box<dyn Error>> {
    let cells = positions(&directory.join("cells.f64"))?.len();
    let mean = floats(&directory.join("match_mean.f32"))?;
    let variance = floats(&directory.join("match_variance.f32"))?;
    let queries = floats(&directory.join("match_queries.f32"))?;
    let features = mean.len() / cells;
    let field = FieldOnCells::new(features, cells, mean, &variance);
    let (mut scratch, mut log_likelihood) = (Vec::new(), vec![0.0; cells]);
    let start = cpu_s();
    let best: Vec<usize> = queries
        .chunks_exact(features)
        .map(|query| {
            log_likelihood.fill(0.0);
            field.add_log_likelihood(query, NoiseModel::Gaussian, &mut scratch, &mut log_likelihood);
            most_likely_cell(&log_likelihood)
        })
        .collect();
    Ok(json!({ "seconds": cpu_s() - start, "best": best }))
}

fn positions(path: &Path) -> Result<Vec<PositionM>, Box<dyn Error>> {
    Ok(doubles(path)?.chunks_exact(2).map(|pair| [pair[0], pair[1]]).collect())
}

fn doubles(path: &Path) -> Result<Vec<f64>, Box<dyn Error>> {
    Ok(fs::read(path)?.as_chunks().0.iter().map(|&bytes| f64::from_le_bytes(bytes)).collect())
}

fn floats(path: &Path) -> Result<Vec<f32>, Box<dyn Error>> {
    Ok(fs::read(path)?.as_chunks().0.iter().map(|&bytes| f32::from_le_bytes(bytes)).collect())
}
