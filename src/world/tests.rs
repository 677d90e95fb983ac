//! Frames against what is known of the place, and against the rest of the program.

use std::f64::consts::{PI, TAU};

use super::{
    Camera, Day, Drive, DriveSettings, Pose, Renderer, Season, World, WorldKind,
    render::{PANORAMA_COLUMNS, PANORAMA_ROWS},
    scene::{Block, Plane, Upright},
    texture::rgb,
};
use crate::{
    calibrate::DonutFinder,
    jpeg::LumaDecoder,
    panorama::{SAMPLED_COLUMNS, SAMPLED_ROWS, UnwrapTable, WIDE_COLUMNS, WIDE_ROWS},
    types::{AzimuthSense, DonutCalibration, LumaImage},
};

fn frame(world: &World, day: &Day, camera: &Camera, pose: &Pose, time_s: f64) -> Vec<u8> {
    let mut jpeg = Vec::new();
    renderer(world, day, camera).render_jpeg(pose, time_s, &mut jpeg);
    jpeg
}

fn renderer(world: &World, day: &Day, camera: &Camera) -> Renderer {
    Renderer::new(world, day, camera).expect("the camera is possible")
}

/// A clean camera, small enough for many frames.
fn clean() -> Camera {
    Camera { noise: 0.0, vignetting: 0.0, ..Camera::town() }
}

fn mean_difference(a: &LumaImage, b: &LumaImage) -> f64 {
    let sum: u64 = a.pixels.iter().zip(&b.pixels).map(|(&a, &b)| u64::from(a.abs_diff(b))).sum();
    sum as f64 / a.pixels.len() as f64
}

/// Column `j` of the result is column `j + columns` of the image.
fn rolled(image: &LumaImage, columns: usize) -> LumaImage {
    LumaImage::from_fn(image.width_px, image.height_px, |x, y| image.row(y)[(x + columns) % image.width_px])
}

/// A black block under a white sky, and nothing else.
fn black_block(center_m: [f32; 2], half_m: [f32; 2], heights_m: [f32; 2]) -> World {
    let ground = Plane::painted(0.0, [-50.0, -50.0], [100.0, 100.0], 1.0, |_, _| rgb(90, 90, 90));
    let mut world = World::empty(WorldKind::Corridor { length_m: 7.0 }, ground);
    let black = world.add_plain(rgb(0, 0, 0));
    world.blocks.push(Block::upright(center_m, half_m, heights_m, [black; 4], rgb(0, 0, 0)));
    world
}

const POSE: Pose = Pose { position_m: [1.8, 30.0], yaw_rad: 0.4, speed_mps: 0.0, yaw_rate_radps: 0.0 };

#[test]
fn the_same_seeds_give_the_same_bytes_whatever_was_rendered_before() {
    let (world, day, camera) = (World::town_block(3), Day::new(5), Camera::town().scaled_to(640, 360));
    let first = frame(&world, &day, &camera, &POSE, 12.5);
    let mut again = renderer(&World::town_block(3), &Day::new(5), &camera);
    let mut jpeg = Vec::new();
    again.render_jpeg(&Pose::at([1.8, 50.0], 1.0), 3.0, &mut jpeg);
    assert_ne!(jpeg, first);
    again.render_jpeg(&POSE, 12.5, &mut jpeg);
    assert_eq!(jpeg, first);
}

#[test]
fn another_seed_is_another_place() {
    for build in [World::town_block, World::corridor, World::hall] {
        let panorama =
            |seed| renderer(&build(seed), &Day::deserted(1), &clean()).render_panorama(&Pose::at([1.8, 1.4], 0.0), 0.0);
        let difference = mean_difference(&panorama(1), &panorama(2));
        assert!(difference > 10.0, "{difference} gray levels");
    }
}

/// How strongly brightness changes from column to column, around the horizon.
fn edges(panorama: &LumaImage) -> Vec<f64> {
    let rows = PANORAMA_ROWS / 4..PANORAMA_ROWS * 5 / 9;
    (0..PANORAMA_COLUMNS)
        .map(|x| {
            rows.clone()
                .map(|y| f64::from(panorama.row(y)[x].abs_diff(panorama.row(y)[(x + 1) % PANORAMA_COLUMNS])))
                .sum()
        })
        .collect()
}

fn correlation(a: &[f64], b: &[f64], shift: usize) -> f64 {
    let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
    let (mean_a, mean_b, n) = (mean(a), mean(b), a.len());
    let (mut ab, mut aa, mut bb) = (0.0, 0.0, 0.0);
    for (i, a) in a.iter().enumerate() {
        let (a, b) = (a - mean_a, b[(i + shift) % n] - mean_b);
        (ab, aa, bb) = (ab + a * b, aa + a * a, bb + b * b);
    }
    ab / (aa * bb).sqrt()
}

#[test]
fn another_day_is_another_picture_of_the_same_place() {
    let world = World::town_block(1);
    let day = |seed, overcast| Day { overcast, ..Day::deserted(seed) };
    let (dull, sunny) = (day(1, 1.0), day(2, 0.0));
    let [a, b] = [dull, sunny].map(|day| renderer(&world, &day, &clean()).render_panorama(&POSE, 0.0));
    assert!(mean_difference(&a, &b) > 8.0, "{}", mean_difference(&a, &b));
    let (a, b) = (edges(&a), edges(&b));
    let at = |shift: i64| correlation(&a, &b, shift.rem_euclid(PANORAMA_COLUMNS as i64) as usize);
    let best = (-20..=20).max_by(|&s, &t| at(s).total_cmp(&at(t))).expect("there are shifts");
    assert_eq!(best, 0, "{} there, {} in place", at(best), at(0));
    assert!(at(0) > 0.8, "{}", at(0));
}

#[test]
fn a_season_changes_the_trees_and_nothing_else_of_the_place() {
    let world = World::town_block(1);
    let day = Day { overcast: 1.0, ..Day::deserted(1) };
    // Across the street from a tree.
    let beside = |tree: &&Upright| world.trees.contains(&tree.texture) && tree.center_m[0].abs() < 8.0;
    let [_, y_m] = world.uprights.iter().find(beside).expect("the street has a tree").center_m;
    let pose = Pose::at([0.0, y_m.into()], 0.0);
    let at =
        |world: &World, season| renderer(world, &Day { season, ..day.clone() }, &clean()).render_panorama(&pose, 0.0);
    let summer = at(&world, Season::Summer);
    let without_trees = World { trees: Vec::new(), ..world.clone() };
    for season in [Season::Winter, Season::Spring, Season::Autumn] {
        let difference = mean_difference(&at(&world, season), &summer);
        assert!((0.2..20.0).contains(&difference), "{season:?}: {difference}");
        assert_eq!(at(&without_trees, season), summer, "{season:?}");
    }
}

#[test]
fn daylight_changes_the_windows_of_a_hall() {
    let world = World::hall(1);
    // Of the same day: with its own daylight, and with panes that have none.
    let day = Day::deserted(3);
    let at = |world: &World| renderer(world, &day, &clean()).render_panorama(&Pose::at([6.3, 12.7], 0.3), 0.0);
    let (daylight, painted) = (at(&world), at(&World { panes: Vec::new(), ..world.clone() }));
    assert_ne!(daylight, painted);
    let below = |image: &LumaImage| image.pixels[PANORAMA_COLUMNS * PANORAMA_ROWS * 5 / 9..].to_vec();
    assert_eq!(below(&daylight), below(&painted), "windows are high up");
}

#[test]
fn a_lens_is_mounted_as_askew_as_asked() {
    let tilted = clean().tilted(0.02, 5);
    assert_eq!(tilted, clean().tilted(0.02, 5));
    assert_ne!(tilted.pitch_rad, tilted.roll_rad);
    assert!(tilted.pitch_rad.abs().max(tilted.roll_rad.abs()) <= 0.04, "{tilted:?}");
    assert_eq!(clean().tilted(0.0, 5), clean());
}

#[test]
fn turning_the_vehicle_shifts_the_columns() {
    let world = World::town_block(1);
    for (azimuth, sign) in [(AzimuthSense::Ccw, 1.0), (AzimuthSense::Cw, -1.0)] {
        let camera = Camera { donut: DonutCalibration { azimuth, ..Camera::town().donut }, ..clean() };
        let mut renderer = renderer(&world, &Day::new(1), &camera);
        let panorama = renderer.render_panorama(&POSE, 7.0);
        for columns in [1_usize, 100, 777] {
            let yaw_rad = POSE.yaw_rad + sign * TAU * columns as f64 / PANORAMA_COLUMNS as f64;
            let turned = renderer.render_panorama(&Pose { yaw_rad, ..POSE }, 7.0);
            let difference = mean_difference(&turned, &rolled(&panorama, columns));
            // Single precision moves an edge by a ray here and there.
            assert!(difference < 0.15, "{azimuth:?} by {columns}: {difference}");
        }
    }
}

#[test]
fn our_own_unwrapping_gives_the_panorama_back() {
    let world = World::town_block(1);
    for (top_is_outer, clockwise, azimuth, start_angle_rad) in [
        (true, true, AzimuthSense::Ccw, 0.0),
        (false, true, AzimuthSense::Ccw, 1.0),
        (true, false, AzimuthSense::Cw, -2.0),
        (false, false, AzimuthSense::Ccw, 4.0),
    ] {
        let donut = DonutCalibration { top_is_outer, clockwise, azimuth, start_angle_rad, ..Camera::town().donut };
        let camera = Camera { donut: donut.clone(), ..clean() };
        let mut renderer = renderer(&world, &Day::new(1), &camera);
        let mut jpeg = Vec::new();
        renderer.render_jpeg(&POSE, 7.0, &mut jpeg);
        let mut decoder = LumaDecoder::new();
        let image = decoder.decode(&jpeg).expect("a whole JPEG");
        let unwrapped = UnwrapTable::build(&donut, 1280, 720).expect("inside").to_panorama(image);

        let direct = renderer.render_panorama(&POSE, 7.0);
        let (across, down) = (SAMPLED_COLUMNS / WIDE_COLUMNS, SAMPLED_ROWS / WIDE_ROWS);
        let reduced = |x: usize, y: usize| {
            let cell = (0..down).flat_map(|j| direct.row(y * down + j)[x * across..][..across].iter());
            cell.map(|&pixel| f64::from(pixel)).sum::<f64>() / (across * down) as f64
        };
        let mut sum = 0.0;
        // Without the rims, where the donut fades out.
        let rows = 3..WIDE_ROWS - 3;
        for y in rows.clone() {
            for x in 0..WIDE_COLUMNS {
                sum += (f64::from(unwrapped.wide[y * WIDE_COLUMNS + x]) - reduced(x, y)).abs();
            }
        }
        let difference = sum / (rows.len() * WIDE_COLUMNS) as f64;
        assert!(difference < 2.5, "{donut:?}: {difference} gray levels");
    }
}

#[test]
fn a_wall_is_seen_where_it_stands() {
    // Its west side is 10 m east of the camera and reaches from 3 m to the right to 3 m to the left.
    let mut world = black_block([12.0, 0.0], [2.0, 3.0], [0.0, 4.0]);
    world.ground = Plane::painted(0.0, [-50.0, -50.0], [100.0, 100.0], 1.0, |_, _| rgb(200, 200, 200));
    let camera = Camera { height_m: 1.5, blur_px: 0.0, ..clean() };
    let mut renderer = renderer(&world, &Day { overcast: 1.0, people: 0, ..Day::new(1) }, &camera);
    for yaw_rad in [0.0, 1.0, -2.5] {
        let panorama = renderer.render_panorama(&Pose::at([0.0, 0.0], yaw_rad), 0.0);
        let row_of = |elevation_rad: f64| (50.0_f64.to_radians() - elevation_rad) / (PI / 2.0) * PANORAMA_ROWS as f64;
        let column_of = |azimuth_rad: f64| ((azimuth_rad - yaw_rad) / TAU).rem_euclid(1.0) * PANORAMA_COLUMNS as f64;
        let dark = |x: usize, y: usize| panorama.row(y)[x % PANORAMA_COLUMNS] < 40;

        let middle = column_of(0.0) as usize;
        let rows: Vec<usize> = (0..PANORAMA_ROWS).filter(|&y| dark(middle, y)).collect();
        let (top, foot) = (row_of((2.5_f64 / 10.0).atan()), row_of((-1.5_f64 / 10.0).atan()));
        assert!((rows[0] as f64 - top).abs() < 1.5, "yaw {yaw_rad}: {} instead of {top}", rows[0]);
        assert!((rows[rows.len() - 1] as f64 + 1.0 - foot).abs() < 1.5, "yaw {yaw_rad}: {rows:?} instead of {foot}");

        let horizon = row_of(0.0) as usize;
        let half = (3.0_f64 / 10.0).atan();
        let (right, width) = (column_of(-half), 2.0 * half / TAU * PANORAMA_COLUMNS as f64);
        let columns: Vec<usize> = (0..PANORAMA_COLUMNS)
            .map(|j| (right.ceil() as usize + PANORAMA_COLUMNS - 10 + j) % PANORAMA_COLUMNS)
            .filter(|&x| dark(x, horizon))
            .collect();
        assert!((columns.len() as f64 - width).abs() <= 1.5, "yaw {yaw_rad}: {} instead of {width}", columns.len());
        let off = (columns[0] as f64 - right).rem_euclid(PANORAMA_COLUMNS as f64);
        assert!(!(1.5..PANORAMA_COLUMNS as f64 - 1.5).contains(&off), "yaw {yaw_rad}: {} not {right}", columns[0]);
    }
}

#[test]
fn a_low_block_shows_its_lid_and_what_is_behind_it() {
    let world = black_block([5.0, 0.0], [1.0, 1.0], [0.0, 1.0]);
    let camera = Camera { height_m: 2.0, blur_px: 0.0, ..clean() };
    let mut renderer = renderer(&world, &Day { overcast: 1.0, people: 0, ..Day::new(1) }, &camera);
    let panorama = renderer.render_panorama(&Pose::at([0.0, 0.0], 0.0), 0.0);
    let dark: Vec<usize> = (0..PANORAMA_ROWS).filter(|&y| panorama.row(y)[0] < 30).collect();
    let row_of = |height_m: f64, distance_m: f64| {
        (50.0_f64.to_radians() - (height_m / distance_m).atan()) / (PI / 2.0) * PANORAMA_ROWS as f64
    };
    // From the far edge of the lid to the foot of the near side.
    let (top, foot) = (row_of(-1.0, 6.0), row_of(-2.0, 4.0));
    assert!((dark[0] as f64 - top).abs() < 1.5, "{} instead of {top}", dark[0]);
    assert!((dark[dark.len() - 1] as f64 + 1.0 - foot).abs() < 1.5, "{dark:?} instead of {foot}");
    assert_eq!(dark.len(), dark[dark.len() - 1] + 1 - dark[0], "no gap between side and lid");
}

#[test]
fn near_places_look_more_alike_than_far_ones() {
    for (world, camera, steps_m) in [
        (World::town_block(1), clean(), [0.1, 0.5, 2.5]),
        (World::corridor(1), Camera { height_m: 1.2, ..clean() }, [0.01, 0.05, 0.25]),
    ] {
        let mut renderer = renderer(&world, &Day::deserted(1), &camera);
        let mut at = |x_m: f64| renderer.render_panorama(&Pose::at([x_m, 1.75], 0.0), 0.0);
        let origin = at(2.0);
        let differences = steps_m.map(|step_m| mean_difference(&origin, &at(2.0 + step_m)));
        assert!(differences.is_sorted(), "{differences:?}");
        assert!(differences[0] < 0.5 * differences[1] && differences[0] < 2.0, "{differences:?}");
    }
}

#[test]
fn calibrating_finds_the_donut() {
    for (world, camera) in [
        (World::town_block(2), Camera::town()),
        (World::corridor(2), Camera::corridor()),
        (World::hall(2), Camera::hall()),
    ] {
        let drive = Drive::new(&world, &DriveSettings::default());
        let mut renderer = renderer(&world, &Day::new(3), &camera);
        let mut finder = DonutFinder::new(1280, 720).expect("large enough");
        let (mut decoder, mut jpeg) = (LumaDecoder::new(), Vec::new());
        for i in 0..16 {
            let time_s = drive.duration_s() * f64::from(i) / 16.0;
            renderer.render_jpeg(&drive.pose_at(time_s), time_s, &mut jpeg);
            finder.add(decoder.decode(&jpeg).expect("a whole JPEG")).expect("all of one size");
        }
        let found = finder.finish().expect("there is a donut");
        for (what, found, expected) in [
            ("x", found.center_x_px, 651.0),
            ("y", found.center_y_px, 352.0),
            ("inner", found.inner_radius_px, 115.0),
            ("outer", found.outer_radius_px, 335.0),
        ] {
            assert!((found - expected).abs() < 1.5, "{what}: {found} instead of {expected}");
        }
    }
}

#[test]
fn frames_are_colour_jpegs_like_a_webcams() {
    let jpeg = frame(&World::corridor(1), &Day::new(1), &Camera::corridor(), &Pose::at([2.0, 1.0], 0.0), 0.0);
    let picture = image::load_from_memory(&jpeg).expect("decodes").to_rgb8();
    assert_eq!(picture.dimensions(), (1280, 720));
    let colourful =
        picture.pixels().filter(|p| p.0.iter().max().unwrap_or(&0) - p.0.iter().min().unwrap_or(&0) > 40).count();
    assert!(colourful > 10_000, "{colourful} pixels");
    assert!(jpeg.len() < 200_000, "{} bytes", jpeg.len());
}
