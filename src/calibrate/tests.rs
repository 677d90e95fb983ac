use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::synthetic::SyntheticDonut;
use super::*;

fn conditions(seed: u64) -> Vec<(&'static str, SyntheticDonut)> {
    let day = || SyntheticDonut::day(seed);
    let wide = SyntheticDonut { size_px: [1280, 720], center_px: [420.7, 391.2], ..day() };
    vec![
        ("day", day()),
        ("off-centre, wide", SyntheticDonut { inner_radius_px: 96.4, outer_radius_px: 301.9, ..wide }),
        ("small", SyntheticDonut { center_px: [250.2, 260.9], inner_radius_px: 36.2, outer_radius_px: 122.3, ..day() }),
        ("thin", SyntheticDonut { inner_radius_px: 140.2, ..day() }),
        ("a quarter cut", SyntheticDonut { center_px: [320.3, 152.1], ..day() }),
        ("a third cut", SyntheticDonut { center_px: [300.3, 108.1], ..day() }),
        ("cut above and below", SyntheticDonut { outer_radius_px: 265.2, ..day() }),
        ("noise of 12", SyntheticDonut { noise: 12.0, ..day() }),
        ("noise of 25", SyntheticDonut { noise: 25.0, ..day() }),
        ("night", SyntheticDonut { surround: 5.0, hub: 6.0, content: [9.0, 40.0], sky: 16.0, noise: 3.0, ..day() }),
        ("bright surround", SyntheticDonut { surround: 130.0, hub: 100.0, ..day() }),
        ("white surround", SyntheticDonut { surround: 240.0, ..day() }),
        ("defocused", SyntheticDonut { rim_width_px: 9.0, ..day() }),
        ("vehicle in view", SyntheticDonut { vehicle_rad: 1.2, ..day() }),
    ]
}

/// Worst of the centre's distance and the radii's differences from the truth \[px\].
fn error_px(found: &DonutEstimate, truth: &SyntheticDonut) -> f64 {
    let center = (found.center_x_px - truth.center_px[0]).hypot(found.center_y_px - truth.center_px[1]);
    center
        .max((found.inner_radius_px - truth.inner_radius_px).abs())
        .max((found.outer_radius_px - truth.outer_radius_px).abs())
}

#[test]
fn ten_frames_give_the_donut_under_every_condition() {
    for seed in 1..=2 {
        for (name, donut) in conditions(seed) {
            let found = find_donut(&donut.frames(10)).unwrap_or_else(|error| panic!("{name}, seed {seed}: {error}"));
            // Three times the systematic deviation of 0.1 px.
            assert!(error_px(&found, &donut) < 0.3, "{name}, seed {seed}: {found:?}");
            if name != "noise of 25" {
                assert_eq!(found.verdict, Verdict::Sure, "{name}, seed {seed}");
            }
        }
    }
}

#[test]
fn one_frame_gives_the_donut_or_is_not_called_sure() {
    for seed in 11..=14 {
        for (name, donut) in conditions(seed) {
            match find_donut(&donut.frames(1)) {
                Ok(found) if found.verdict == Verdict::Sure => {
                    assert!(error_px(&found, &donut) < 0.5, "{name}, seed {seed}: {found:?}");
                }
                Ok(_) | Err(FindDonutError::NotFound { .. }) => {
                    let hard = ["noise of 12", "noise of 25", "night", "bright surround", "white surround"];
                    assert!(hard.contains(&name), "{name}, seed {seed}: one frame should do");
                }
                Err(error) => panic!("{name}, seed {seed}: {error}"),
            }
        }
    }
}

#[test]
fn standing_clutter_misleads_one_frame_but_not_ten() {
    let donut = SyntheticDonut { clutter: true, ..SyntheticDonut::day(3) };
    let found = find_donut(&donut.frames(10)).expect("content moves, clutter does not");
    assert!(error_px(&found, &donut) < 0.3, "{found:?}");
}

#[test]
fn shaking_is_measured_and_widens_the_deviation_of_the_centre() {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let mut finder = DonutFinder::new(640, 480).expect("large enough");
    let still = SyntheticDonut::day(5);
    for index in 0..24 {
        let center_px = still.center_px.map(|c| c + rng.random_range(-1.7..1.7));
        let frame = SyntheticDonut { center_px, seed: 100 + index, ..still.clone() }.frames(1);
        finder.add(&frame[0]).expect("same size");
    }
    let found = finder.finish().expect("a donut");
    let wander_px = found.wander_px.expect("enough frames");
    // Uniform over 3.4 px: a deviation of 0.98 px, known to 1/√(2·20) of itself.
    assert!((wander_px - 0.98).abs() < 0.3, "{wander_px}");
    assert!(found.center_x_std_px > 0.15, "{found:?}");
    // Three deviations of the mean of 24.
    assert!(error_px(&found, &still) < 0.6, "{found:?}");
}

/// Sum of smoothed noise at several scales: clouds, foliage.
fn clouds(seed: u64, roughness: f64) -> LumaImage {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let grids: Vec<(usize, Vec<f64>)> =
        (1..7).map(|level| (1 << level, (0..400 * 400).map(|_| rng.random_range(-1.0..1.0)).collect())).collect();
    LumaImage::from_fn(640, 480, |x, y| {
        let sum: f64 = grids
            .iter()
            .map(|(step, grid)| {
                let (i, j) = (x / step, y / step);
                let (u, v) = ((x % step) as f64 / *step as f64, (y % step) as f64 / *step as f64);
                let at = |i: usize, j: usize| grid[j * 400 + i];
                let value = (1.0 - v) * ((1.0 - u) * at(i, j) + u * at(i + 1, j))
                    + v * ((1.0 - u) * at(i, j + 1) + u * at(i + 1, j + 1));
                value * (*step as f64).powf(1.0 - roughness)
            })
            .sum();
        (120.0 + 40.0 * sum).clamp(0.0, 255.0) as u8
    })
}

#[test]
fn images_without_a_donut_are_refused() {
    let distance = |x: usize, y: usize| (x as f64 - 300.0).hypot(y as f64 - 240.0);
    let mut images = vec![
        ("black".to_owned(), LumaImage::from_fn(640, 480, |_, _| 0)),
        ("white".to_owned(), LumaImage::from_fn(640, 480, |_, _| 255)),
        ("ramp".to_owned(), LumaImage::from_fn(640, 480, |x, y| (x / 4 + y / 8) as u8)),
        ("vignette".to_owned(), LumaImage::from_fn(640, 480, |x, y| (230.0 - 0.5 * distance(x, y)) as u8)),
        ("disc".to_owned(), LumaImage::from_fn(640, 480, |x, y| if distance(x, y) < 200.0 { 180 } else { 10 })),
        (
            "chessboard".to_owned(),
            LumaImage::from_fn(640, 480, |x, y| if (x / 40 + y / 40) % 2 == 0 { 30 } else { 220 }),
        ),
    ];
    let mut half = SyntheticDonut::day(1).frames(1).remove(0);
    let kept = LumaImage::from_fn(300, 480, |x, y| half.row(y)[x]);
    half = kept;
    images.push(("half a donut".to_owned(), half));
    for seed in 0..4 {
        for roughness in [0.7, 1.0] {
            images.push((format!("clouds {seed} {roughness}"), clouds(seed, roughness)));
        }
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut noise = LumaImage::from_fn(640, 480, |_, _| 0);
        noise.pixels.iter_mut().for_each(|pixel| *pixel = rng.random());
        images.push((format!("noise {seed}"), noise));
    }
    for (name, image) in images {
        let found = find_donut(&[image]);
        assert!(matches!(found, Err(FindDonutError::NotFound { .. })), "{name}: {found:?}");
    }
}

#[test]
fn unusable_frames_are_errors() {
    let frame = |width, height| LumaImage::from_fn(width, height, |_, _| 0);
    assert_eq!(find_donut(&[]), Err(FindDonutError::NoFrames));
    assert_eq!(
        find_donut(&[frame(640, 480), frame(640, 360)]),
        Err(FindDonutError::DifferentSizes {
            width_px: 640,
            height_px: 480,
            found_width_px: 640,
            found_height_px: 360
        })
    );
    assert_eq!(find_donut(&[frame(64, 64)]), Err(FindDonutError::TooSmall { width_px: 64, height_px: 64 }));
    let lying = LumaImage { width_px: 640, height_px: 480, pixels: vec![0; 7] };
    assert_eq!(find_donut(&[lying]), Err(FindDonutError::BadFrame { width_px: 640, height_px: 480, pixels: 7 }));
    assert_eq!(DonutFinder::new(640, 480).expect("large enough").finish(), Err(FindDonutError::NoFrames));
}

#[test]
fn overlay_draws_the_rim_where_it_was_found() {
    let donut = SyntheticDonut::day(2);
    let frames = donut.frames(1);
    let found = find_donut(&frames).expect("a donut");
    let picture = overlay(&frames[0], &found, &Orientation::default());
    assert_eq!(picture.width(), 640);
    assert!(picture.height() > 480);
    // On the outer rim to the right of the centre, amber: red well above blue.
    let rim = picture.get_pixel((donut.center_px[0] + donut.outer_radius_px).round() as u32, 237);
    assert!(rim[0] > rim[2] + 60, "{rim:?}");
}
