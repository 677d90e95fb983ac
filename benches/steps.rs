//! Every step on its own, at the sizes of a survey like the paper's Case 2: 378 frames of 1280 × 720, 189 to learn from,
//! 94 to select on, 4345 cells. One thread.
//!
//! The frames are made here: detail of several sizes, noise, JPEG quality 85, every frame another. `peers/run` times the
//! same steps against other programs, and on recorded frames too.

use std::f64::consts::TAU;
use std::hint::black_box;

use criterion::{BatchSize, Criterion, criterion_group, criterion_main};
use faer::Mat;
use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;
use omniloc::features::{Describer, Descriptor};
use omniloc::gp::fit::{Bounds, fit_each};
use omniloc::gp::likelihood::likelihood_and_gradient;
use omniloc::gp::{Hyperparameters, LearningPositions, Posterior};
use omniloc::jpeg::LumaDecoder;
use omniloc::localize::{FieldOnCells, most_likely_cell};
use omniloc::map::{NoiseModel, NoiseWhiteningSettings, Recipe, RecipeName};
use omniloc::panorama::{Panorama, UnwrapTable};
use omniloc::train::{LikelihoodTable, backward_elimination, noise_whitening};
use omniloc::types::{DonutCalibration, LumaImage, PositionM};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

const FRAMES: usize = 8;
const LEARNING: usize = 189;
const QUERIES: usize = 94;
const FEATURES: usize = 128;
/// Columns and rows of the grid: 4345 cells.
const GRID: [usize; 2] = [55, 79];
const CELLS: usize = GRID[0] * GRID[1];

fn donut() -> DonutCalibration {
    serde_json::from_str(
        r#"{"kind": "donut", "cx": 651, "cy": 352, "r_in": 115, "r_out": 335, "top_is_outer": true, "start_angle": 0,
            "clockwise": true, "azimuth": "ccw"}"#,
    )
    .expect("the data-set format")
}

/// A coloured donut on a dark surround.
fn textured_jpeg(seed: u64) -> Vec<u8> {
    const SIZE: (usize, usize) = (1280, 720);
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    // Plane waves: strong and wide, weak and narrow.
    let waves: Vec<[f64; 4]> = (0..24)
        .map(|i| {
            let frequency = 0.01 * 1.2_f64.powi(i);
            let direction = TAU * random.random::<f64>();
            [
                frequency * direction.cos(),
                frequency * direction.sin(),
                TAU * random.random::<f64>(),
                30.0 / f64::from(i + 2).sqrt(),
            ]
        })
        .collect();
    let mut rgb = Vec::with_capacity(SIZE.0 * SIZE.1 * 3);
    for y in 0..SIZE.1 {
        for x in 0..SIZE.0 {
            let (x, y) = (x as f64, y as f64);
            let noise = random.random_range(-4.0..4.0);
            let inside = (115.0..335.0).contains(&(x - 651.0).hypot(y - 352.0));
            let gray: f64 = waves.iter().map(|[u, v, phase, size]| size * (u * x + v * y + phase).cos()).sum();
            let gray = if inside { 120.0 + gray + noise } else { 8.0 + 0.5 * noise };
            let tint = 12.0 * (0.02 * x).cos();
            rgb.extend([gray + tint, gray, gray - tint].map(|value| value as u8));
        }
    }
    let mut jpeg = Vec::new();
    JpegEncoder::new_with_quality(&mut jpeg, 85)
        .encode(&rgb, SIZE.0 as u32, SIZE.1 as u32, ExtendedColorType::Rgb8)
        .expect("encoding into memory");
    jpeg
}

/// Goes round and round: one element a call.
fn cycle<'a, T>(items: &'a [T]) -> impl FnMut() -> &'a T {
    let mut items = items.iter().cycle();
    move || items.next().expect("there are items")
}

fn frames(c: &mut Criterion) {
    let jpegs: Vec<Vec<u8>> = (0..FRAMES as u64).map(textured_jpeg).collect();
    let mut decoder = LumaDecoder::new();
    let images: Vec<LumaImage> = jpegs.iter().map(|jpeg| decoder.decode(jpeg).expect("a whole JPEG").clone()).collect();
    let table = UnwrapTable::build(&donut(), 1280, 720).expect("the donut is inside");
    let panoramas: Vec<Panorama> = images.iter().map(|image| table.to_panorama(image)).collect();
    let mut describer = Describer::new();
    let mut panorama = Panorama::zeros();

    let mut jpeg = cycle(&jpegs);
    c.bench_function("frame/decode luma", |b| b.iter(|| decoder.decode(jpeg()).map(|image| image.pixels[0])));
    c.bench_function("frame/decode the luma that is needed", |b| {
        b.iter(|| decoder.decode_needed(jpeg(), table.needed()).map(|image| image.width_px));
    });
    let mut image = cycle(&images);
    c.bench_function("frame/unwrap", |b| b.iter(|| table.unwrap_into(image(), 0, black_box(&mut panorama))));
    for descriptor in Descriptor::ALL {
        let mut properties = Describer::room_for(&[descriptor]);
        let mut panorama = cycle(&panoramas);
        c.bench_function(&format!("frame/describe {descriptor}"), |b| {
            b.iter(|| describer.describe(&[descriptor], panorama(), black_box(&mut properties)));
        });
    }
    for (what, descriptors) in [
        ("356 properties", Descriptor::PAPER.to_vec()),
        ("default properties", Recipe::new(RecipeName::Default, &[]).descriptors()),
    ] {
        let mut properties = Describer::room_for(&descriptors);
        c.bench_function(&format!("frame/JPEG to {what}"), |b| {
            b.iter(|| {
                let image = decoder.decode_needed(jpeg(), table.needed()).expect("a whole JPEG");
                table.unwrap_into(image, 0, &mut panorama);
                describer.describe(&descriptors, &panorama, black_box(&mut properties));
            });
        });
    }
}

/// A winding drive, and features on it that vary over metres to tens of metres, with noise.
fn drive(frames: usize, features: usize) -> (Vec<PositionM>, Mat<f64>) {
    let mut random = ChaCha8Rng::seed_from_u64(378);
    let positions: Vec<PositionM> = (0..frames)
        .map(|i| {
            let turn = 2.0 * TAU * i as f64 / frames as f64;
            let mut jitter = || random.random_range(-1.0..1.0);
            [27.0 + 26.0 * turn.sin() + jitter(), 39.0 + 38.0 * (1.5 * turn + 0.3).sin() + jitter()]
        })
        .collect();
    let mut values = Mat::zeros(frames, features);
    for r in 0..features {
        let length_m = 2.0 * 15.0_f64.powf(random.random());
        let waves: [[f64; 3]; 20] = std::array::from_fn(|_| {
            let mut component = || random.random_range(-1.8..1.8);
            [component() / length_m, component() / length_m, 2.0 * component()]
        });
        let noise = random.random_range(0.2..1.5);
        for (i, p) in positions.iter().enumerate() {
            let field: f64 = waves.iter().map(|[u, v, phase]| (u * p[0] + v * p[1] + phase).cos()).sum();
            values[(i, r)] = 0.3 * field + noise * random.random_range(-1.0..1.0);
        }
    }
    (positions, values)
}

fn cells() -> Vec<PositionM> {
    (0..CELLS).map(|i| [(i % GRID[0]) as f64, (i / GRID[0]) as f64]).collect()
}

const HYPERPARAMETERS: Hyperparameters =
    Hyperparameters { signal_std: 0.9, noise_std: 0.5, length_scale_m: [6.0, 8.0] };

fn gaussian_processes(c: &mut Criterion) {
    let (positions, features) = drive(LEARNING, FEATURES);
    let learning = LearningPositions::new(positions);
    let z: Vec<f64> = features.col(0).iter().copied().collect();
    c.bench_function("gp/likelihood and gradient, n = 189", |b| {
        b.iter(|| likelihood_and_gradient(&learning, &z, black_box(&HYPERPARAMETERS)).expect("positive definite"));
    });
    let (mut group, cells) = (c.benchmark_group("gp"), cells());
    group.sample_size(10);
    group.bench_function("fit of 128 features, n = 189", |b| {
        b.iter(|| fit_each(&learning, features.as_ref(), &Bounds::PAPER, || {}));
    });
    group.bench_function("posterior of one feature on 4345 cells", |b| {
        b.iter(|| {
            let posterior = Posterior::new(&learning, features.as_ref().subcols(0, 1), HYPERPARAMETERS);
            posterior.expect("positive definite").predict(&cells)
        });
    });
}

/// Log-likelihoods with one summit a query, and noise: feature × cell.
fn log_likelihoods(truth_m: PositionM, cells: &[PositionM], random: &mut ChaCha8Rng) -> Vec<f32> {
    let mut table = Vec::with_capacity(FEATURES * cells.len());
    for _ in 0..FEATURES {
        let wave: [f64; 3] = std::array::from_fn(|_| random.random_range(-0.4..0.4));
        let field = |p: PositionM| 1.5 * (wave[0] * p[0] + wave[1] * p[1] + 10.0 * wave[2]).cos();
        let seen = field(truth_m) + random.random_range(-1.0..1.0);
        table.extend(cells.iter().map(|&p| (-0.5 * (field(p) - seen).powi(2)) as f32));
    }
    table
}

fn selection(c: &mut Criterion) {
    let cells = cells();
    let mut random = ChaCha8Rng::seed_from_u64(94);
    let queries: Vec<(PositionM, Vec<f32>)> = (0..QUERIES)
        .map(|_| {
            let truth_m = [random.random_range(0.0..54.0), random.random_range(0.0..78.0)];
            (truth_m, log_likelihoods(truth_m, &cells, &mut random))
        })
        .collect();
    let mut group = c.benchmark_group("selection");
    group.sample_size(10);
    group.bench_function("elimination, 128 features x 94 queries x 4345 cells", |b| {
        let eliminate = |queries: Vec<(PositionM, Vec<f32>)>| {
            let mut table = LikelihoodTable::new(FEATURES, cells.clone());
            for (truth_m, log_likelihood) in queries {
                table.push(truth_m, log_likelihood);
            }
            backward_elimination(&table, |_| {})
        };
        b.iter_batched(|| queries.clone(), eliminate, BatchSize::PerIteration);
    });
}

fn matching(c: &mut Criterion) {
    const FEATURES: usize = 356;
    let mut random = ChaCha8Rng::seed_from_u64(356);
    let mut normal = |count: usize| -> Vec<f32> { (0..count).map(|_| random.random_range(-1.7..1.7)).collect() };
    let (mean, queries) = (normal(FEATURES * CELLS), normal(FEATURES * 16));
    let variance: Vec<f32> = normal(FEATURES * CELLS).iter().map(|v| 0.2 + v * v).collect();
    let mut query = queries.chunks_exact(FEATURES).cycle();
    let (mut scratch, mut log_likelihood) = (Vec::new(), vec![0.0; CELLS]);
    for (name, variance) in [("a feature", &variance[..]), ("shared", &variance[..CELLS])] {
        let field = FieldOnCells::new(FEATURES, CELLS, mean.clone(), variance);
        c.bench_function(&format!("matching/356 features x 4345 cells, variance {name}"), |b| {
            b.iter(|| {
                log_likelihood.fill(0.0);
                let features = query.next().expect("they go round");
                field.add_log_likelihood(features, NoiseModel::Gaussian, &mut scratch, &mut log_likelihood);
                most_likely_cell(&log_likelihood)
            });
        });
    }
}

fn learning(c: &mut Criterion) {
    let (positions, properties) = drive(LEARNING, Descriptor::Gradient.dimensions());
    let learning = LearningPositions::new(positions);
    let mut random = ChaCha8Rng::seed_from_u64(2);
    let changes = Mat::from_fn(2 * LEARNING, properties.ncols(), |_, _| random.random_range(-0.3..0.3));
    let settings = NoiseWhiteningSettings { features: 96, length_scale_spacings: 1.5, ridge: 0.05 };
    let mut group = c.benchmark_group("train");
    group.sample_size(10);
    group.bench_function("noise whitening, gradient, n = 189", |b| {
        b.iter(|| noise_whitening::learn(&settings, &learning, properties.as_ref(), changes.as_ref()).expect("varies"));
    });
}

fn one_thread(_: &mut Criterion) {
    rayon::ThreadPoolBuilder::new().num_threads(1).build_global().expect("first use of the pool");
}

criterion_group!(benches, one_thread, frames, gaussian_processes, selection, matching, learning);
criterion_main!(benches);
