//! Tracks whose truth is known.

use std::f64::consts::{PI, TAU};

use faer::Mat;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::panorama::{WIDE_COLUMNS, WIDE_ROWS};
use crate::train::perturbation::standard_normal;
use crate::types::AzimuthSense;

const RECEIVER_STD_M: f64 = 0.6;
const RECEIVER_TIME_S: f64 = 20.0;

/// Laps of a block of 60 by 40 m with round corners, about 1.5 m/s at 1 Hz: truth and course.
fn laps(frames: usize) -> Vec<(PositionM, f64)> {
    // The speed varies.
    laps_after((0..frames).map(|i| 1.5 * i as f64 + 2.0 * (0.05 * i as f64).sin()))
}

/// The same, after so many metres.
fn laps_after(ways_m: impl Iterator<Item = f64>) -> Vec<(PositionM, f64)> {
    let corner_m = 5.0;
    let sides_m = [60.0, 40.0, 60.0, 40.0];
    let quarter_m = corner_m * std::f64::consts::FRAC_PI_2;
    ways_m
        .map(|mut way_m| {
            let (mut at, mut course_rad) = ([0.0, 0.0], 0.0_f64);
            for side in (0..4).cycle() {
                let (sin, cos) = course_rad.sin_cos();
                let straight_m: f64 = way_m.min(sides_m[side]);
                at = [at[0] + straight_m * cos, at[1] + straight_m * sin];
                way_m -= straight_m;
                let turn_rad = way_m.min(quarter_m) / corner_m;
                let (forward_m, left_m) = (corner_m * turn_rad.sin(), corner_m * (1.0 - turn_rad.cos()));
                at = [at[0] + forward_m * cos - left_m * sin, at[1] + forward_m * sin + left_m * cos];
                course_rad += turn_rad;
                way_m -= turn_rad * corner_m;
                if way_m <= 0.0 {
                    break;
                }
            }
            (at, course_rad)
        })
        .collect()
}

/// What a receiver says of it, with a yaw that is off by `yaw_offset_rad`.
fn received(truth: &[(PositionM, f64)], seed: u64, yaw_offset_rad: f64) -> Vec<TrackPoint> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut normal = || f64::from(standard_normal(&mut random));
    let kept = (-1.0 / RECEIVER_TIME_S).exp();
    let mut error_m = [RECEIVER_STD_M * normal(), RECEIVER_STD_M * normal()];
    truth
        .iter()
        .enumerate()
        .map(|(i, (position_m, course_rad))| {
            error_m = error_m.map(|error_m| kept * error_m + RECEIVER_STD_M * (1.0 - kept * kept).sqrt() * normal());
            TrackPoint {
                position_m: [position_m[0] + error_m[0], position_m[1] + error_m[1]],
                yaw_rad: Some(course_rad + yaw_offset_rad + 0.01 * normal()),
                time_s: Some(i as f64),
            }
        })
        .collect()
}

/// Images of 40 properties that follow the place at about the scale of metres, and noise of the day.
fn similarity(truth: &[PositionM]) -> Similarity {
    let mut random = ChaCha8Rng::seed_from_u64(99);
    let mut normal = || f64::from(standard_normal(&mut random));
    let waves: Vec<[f64; 3]> = (0..40).map(|_| [0.3 * normal(), 0.3 * normal(), 3.0 * normal()]).collect();
    let properties = Mat::from_fn(truth.len(), 40, |i, k| {
        let [east, north, phase] = waves[k];
        (east * truth[i][0] + north * truth[i][1] + phase).sin() + 0.1 * normal()
    });
    let changes = Mat::from_fn(truth.len(), 40, |_, _| 0.1 * normal());
    Similarity::learn(properties.as_ref(), changes.as_ref()).expect("it varies")
}

fn rmse_m(positions_m: &[PositionM], truth_m: &[PositionM]) -> f64 {
    let squares: f64 = positions_m.iter().zip(truth_m).map(|(&a, &b)| distance_m(a, b).powi(2)).sum();
    (squares / positions_m.len() as f64).sqrt()
}

/// The same without the part of the error that is the same everywhere.
fn rmse_about_mean_m(positions_m: &[PositionM], truth_m: &[PositionM]) -> f64 {
    let mean = |axis: usize| {
        positions_m.iter().zip(truth_m).map(|(a, b)| a[axis] - b[axis]).sum::<f64>() / positions_m.len() as f64
    };
    let mean = [mean(0), mean(1)];
    rmse_m(&positions_m.iter().map(|p| [p[0] - mean[0], p[1] - mean[1]]).collect::<Vec<_>>(), truth_m)
}

fn positions(points: &[TrackPoint]) -> Vec<PositionM> {
    points.iter().map(|point| point.position_m).collect()
}

#[test]
fn motion_takes_off_part_of_the_error_and_views_most_of_it() {
    let truth = laps(300);
    let truth_m: Vec<PositionM> = truth.iter().map(|(position_m, _)| *position_m).collect();
    let images = similarity(&truth_m);
    let everything: Vec<usize> = (0..300).collect();
    let mut sums = [0.0; 3];
    for seed in 0..4 {
        // A camera that looks to the left does not matter.
        let points = received(&truth, seed, 1.5);
        let smoother = TrackSmoother::of_points(&points, &[0; 300]);
        let by_motion = smoother.smoothed(&everything, None);
        let by_views = smoother.smoothed(&everything, Some(&images));
        let TrackReport::Smoothed { receiver_std_m, views, remaining_std_m, .. } = by_views.reports[0] else {
            panic!("a track: {:?}", by_views.reports)
        };
        assert!((0.3..1.2).contains(&receiver_std_m), "{receiver_std_m}");
        assert!(views > 50 && remaining_std_m < receiver_std_m, "{views} {remaining_std_m}");
        for (sum, of) in sums.iter_mut().zip([&positions(&points), &by_motion.positions_m, &by_views.positions_m]) {
            *sum += rmse_about_mean_m(of, &truth_m);
        }
    }
    let [received, by_motion, by_views] = sums;
    assert!(by_motion < 0.85 * received, "{by_motion} of {received}");
    assert!(by_views < 0.65 * received, "{by_views} of {received}");
}

#[test]
fn two_recordings_agree_afterwards_between_what_their_receivers_said() {
    let truth = laps(150);
    let truth_m: Vec<PositionM> = truth.iter().map(|(position_m, _)| *position_m).collect();
    let mut points = received(&truth, 1, 0.0);
    // The second receiver is off by 1.6 m east for the whole drive.
    points.extend(received(&truth, 2, 0.0).into_iter().map(|mut point| {
        point.position_m[0] += 1.6;
        point
    }));
    let recording: Vec<usize> = (0..300).map(|i| i / 150).collect();
    let smoother = TrackSmoother::of_points(&points, &recording);
    let both_m = [truth_m.clone(), truth_m.clone()].concat();
    let everything: Vec<usize> = (0..300).collect();
    let smoothed = smoother.smoothed(&everything, Some(&similarity(&both_m)));
    let apart = |positions_m: &[PositionM]| rmse_m(&positions_m[..150], &positions_m[150..]);
    let (before_m, after_m) = (apart(&positions(&points)), apart(&smoothed.positions_m));
    assert!(after_m < 0.5 * before_m, "{after_m} of {before_m}");
    // Where they agree lies between what they said; where between depends on how steady each receiver looks.
    let mean_m = |positions_m: &[PositionM]| positions_m.iter().map(|p| p[0]).sum::<f64>() / positions_m.len() as f64;
    let (received, agreed_m) = (positions(&points), mean_m(&smoothed.positions_m));
    let (one_m, other_m) = (mean_m(&received[..150]), mean_m(&received[150..]));
    assert!((one_m..other_m).contains(&agreed_m), "{one_m} {agreed_m} {other_m}");
}

#[test]
fn a_jump_of_the_receiver_is_taken_off_and_does_not_spoil_the_rest() {
    let truth = laps(200);
    let truth_m: Vec<PositionM> = truth.iter().map(|(position_m, _)| *position_m).collect();
    let mut points = received(&truth, 5, 0.0);
    let calm = TrackSmoother::of_points(&points, &[0; 200]).smoothed(&[], None).positions_m;
    points[100..104].iter_mut().for_each(|point| point.position_m[1] += 15.0);
    let jumped = TrackSmoother::of_points(&points, &[0; 200]).smoothed(&[], None).positions_m;
    assert!(distance_m(jumped[102], truth_m[102]) < 3.0, "{:?} {:?}", jumped[102], truth_m[102]);
    let without_jump = |p: &[PositionM]| [&p[..95], &p[110..]].concat();
    let (jumped_m, calm_m) = (
        rmse_m(&without_jump(&jumped), &without_jump(&truth_m)),
        rmse_m(&without_jump(&calm), &without_jump(&truth_m)),
    );
    assert!(jumped_m < calm_m + 0.3, "{jumped_m} {calm_m}");
}

#[test]
fn exact_positions_hardly_move() {
    let truth = laps(200);
    let points: Vec<TrackPoint> = (truth.iter().zip(received(&truth, 3, 0.0)))
        .map(|((position_m, _), point)| TrackPoint { position_m: *position_m, ..point })
        .collect();
    let smoothed = TrackSmoother::of_points(&points, &[0; 200]).smoothed(&[], None);
    assert!(rmse_m(&smoothed.positions_m, &positions(&points)) < 0.05, "{:?}", smoothed.reports);
}

#[test]
fn what_is_no_track_is_left_alone() {
    let good = received(&laps(100), 7, 0.0);
    let change = |spoil: fn(usize, &mut TrackPoint)| {
        let mut points = good.clone();
        points.iter_mut().enumerate().for_each(|(i, point)| spoil(i, point));
        points
    };
    let table: [(&str, Vec<TrackPoint>, NotATrack); 6] = [
        ("no time", change(|i, point| point.time_s = point.time_s.filter(|_| i != 40)), NotATrack::NoTime),
        ("no yaw", change(|_, point| point.yaw_rad = None), NotATrack::NoYaw),
        ("short", good[..10].to_vec(), NotATrack::TooFewFrames),
        ("random yaw", change(|i, point| point.yaw_rad = Some((i * i) as f64)), NotATrack::NotAlongYaw),
        (
            "lattice",
            change(|i, point| (point.position_m, point.yaw_rad) = ([(i % 10) as f64, (i / 10) as f64], Some(0.0))),
            NotATrack::NotAlongYaw,
        ),
        ("standing", change(|_, point| point.position_m = [1.0, 2.0]), NotATrack::NotAlongYaw),
    ];
    for (case, points, why) in table {
        let recording = vec![0; points.len()];
        let smoothed = TrackSmoother::of_points(&points, &recording).smoothed(&[], None);
        assert_eq!(smoothed.reports, [TrackReport::LeftAlone(why)], "{case}");
        assert_eq!(smoothed.positions_m, positions(&points), "{case}");
    }
}

#[test]
fn a_recording_that_is_no_track_stays_beside_one_that_is() {
    let mut points = received(&laps(100), 7, 0.0);
    points.extend(received(&laps(50), 8, 0.0).into_iter().map(|point| TrackPoint { yaw_rad: None, ..point }));
    let recording: Vec<usize> = (0..150).map(|i| i / 100).collect();
    let smoothed = TrackSmoother::of_points(&points, &recording).smoothed(&[], None);
    assert!(matches!(smoothed.reports[..], [TrackReport::Smoothed { .. }, TrackReport::LeftAlone(NotATrack::NoYaw)]));
    assert_eq!(smoothed.positions_m[100..], positions(&points)[100..]);
    assert_ne!(smoothed.positions_m[..100], positions(&points)[..100]);
}

/// What a camera, `turned_rad` against the yaw, sees of 400 points along the laps.
fn points(truth: &[(PositionM, f64)], turned_rad: f64) -> Vec<PointTrack> {
    let mut random = ChaCha8Rng::seed_from_u64(17);
    let mut normal = || f64::from(standard_normal(&mut random));
    let scene: Vec<PositionM> = (0..400)
        .map(|k| {
            let (near, _) = truth[k * truth.len() / 400];
            [near[0] + 10.0 * normal(), near[1] + 10.0 * normal()]
        })
        .collect();
    let sightings: Vec<Vec<Sighting>> = truth
        .iter()
        .enumerate()
        .map(|(i, &(at, yaw_rad))| {
            let near = scene.iter().enumerate().filter(|(_, point)| (2.0..20.0).contains(&distance_m(**point, at)));
            near.map(|(number, point)| Sighting {
                // On the next lap nobody knows it again.
                point: 10 * number + i / 60,
                height_px: 60.0,
                azimuth_rad: (point[1] - at[1]).atan2(point[0] - at[0]) - yaw_rad + turned_rad + 0.005 * normal(),
            })
            .collect()
        })
        .collect();
    PointTrack::gather(0, &sightings)
}

#[test]
fn points_take_off_more_than_motion_and_nothing_where_the_camera_looks_elsewhere() {
    // In traffic: now fast, now slow.
    let mut way_m = 0.0;
    let truth = laps_after((0..300).map(|i| {
        way_m += 1.5 + (f64::from(i * i % 7) - 3.0) / 3.0;
        way_m
    }));
    let truth_m: Vec<PositionM> = truth.iter().map(|(position_m, _)| *position_m).collect();
    let everything: Vec<usize> = (0..300).collect();
    let mut sums = [0.0; 2];
    for seed in 0..3 {
        let by_motion = TrackSmoother::of_points(&received(&truth, seed, 0.0), &[0; 300]);
        let with_points = |turned_rad| {
            TrackSmoother { points: points(&truth, turned_rad), ..by_motion.clone() }.smoothed(&everything, None)
        };
        let without = by_motion.smoothed(&everything, None);
        assert_eq!(with_points(1.5), without, "its points are nowhere");
        // A camera that is turned a little does not matter.
        for (sum, of) in sums.iter_mut().zip([&without, &with_points(0.05)]) {
            *sum += rmse_about_mean_m(&of.positions_m, &truth_m);
        }
    }
    let [by_motion, by_points] = sums;
    assert!(by_points < 0.85 * by_motion, "{by_points} of {by_motion}");
}

/// What a camera sees from `at`: blobs of 0.3 m east, north and above it, so bright.
fn panorama(scene: &[[f64; 4]], (at, yaw_rad): (PositionM, f64)) -> Vec<f32> {
    let columns_a_rad = WIDE_COLUMNS as f64 / TAU;
    let mut wide = vec![120.0_f32; WIDE_ROWS * WIDE_COLUMNS];
    for &[east_m, north_m, above_m, bright] in scene {
        let to = [east_m - at[0], north_m - at[1]];
        let distance_m = to[0].hypot(to[1]);
        let column = (to[1].atan2(to[0]) - yaw_rad) * columns_a_rad;
        let row = 60.0 - (above_m / distance_m).atan() * columns_a_rad;
        let size_px = 0.3 / distance_m * columns_a_rad;
        let reach_px = (4.0 * size_px).ceil() as i64;
        for x in column.round() as i64 - reach_px..=column.round() as i64 + reach_px {
            for y in (row.round() as i64 - reach_px).max(0)..=(row.round() as i64 + reach_px).min(WIDE_ROWS as i64 - 1)
            {
                let apart_px = (x as f64 - column).hypot(y as f64 - row);
                wide[y as usize * WIDE_COLUMNS + x.rem_euclid(WIDE_COLUMNS as i64) as usize] +=
                    (bright * (-0.5 * (apart_px / size_px).powi(2)).exp()) as f32;
            }
        }
    }
    wide
}

#[test]
fn points_that_two_lanes_share_tie_them_across_the_street() {
    // Lanes that are 3 m apart, the second the other way, and houses to either side.
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let mut share = || f64::from(random.random::<f32>());
    let scene: Vec<[f64; 4]> = (0..250)
        .map(|k| {
            let beside_m = 1.5 + (5.0 + 6.0 * share()) * if k % 2 == 0 { 1.0 } else { -1.0 };
            [100.0 * share() - 20.0, beside_m, 6.0 * share() - 1.5, 100.0 * share() - 50.0]
        })
        .collect();
    let there = (0..40).map(|i| ([1.5 * f64::from(i), 0.0], 0.0));
    let back = (0..40).map(|i| ([60.0 - 1.5 * f64::from(i), 3.0], PI));
    let truth: Vec<(PositionM, f64)> = there.chain(back).collect();
    let (images, sightings): (Vec<Vec<f32>>, Vec<Vec<Sighting>>) = {
        let mut follower = PointFollower::new(AzimuthSense::Ccw);
        let seen = truth.iter().enumerate().map(|(i, &at)| {
            if i == 40 {
                follower = PointFollower::new(AzimuthSense::Ccw);
            }
            let wide = panorama(&scene, at);
            let sightings = follower.take(&wide, at.1);
            (wide, sightings)
        });
        seen.unzip()
    };
    // The receivers see them 1.4 m apart.
    let mut points = [received(&truth[..40], 1, 0.0), received(&truth[40..], 2, 0.0)].concat();
    for (row, point) in points.iter_mut().enumerate() {
        point.position_m[1] += if row < 40 { 0.8 } else { -0.8 };
    }
    let recording: Vec<usize> = (0..80).map(|row| row / 40).collect();
    let untied = TrackSmoother {
        points: [PointTrack::gather(0, &sightings[..40]), PointTrack::gather(40, &sightings[40..])].concat(),
        ..TrackSmoother::of_points(&points, &recording)
    };
    let images = images.iter().map(|wide| Some(KeptImage::new(wide, AzimuthSense::Ccw))).collect();
    let tied = TrackSmoother { images, ..untied.clone() };
    let off_m = |smoother: &TrackSmoother, learned: &[usize]| {
        let positions_m = smoother.smoothed(learned, None).positions_m;
        let beside = |row: usize| positions_m[79 - row][1] - positions_m[row + 1][1] - 3.0;
        ((1..39).map(|row| beside(row).powi(2)).sum::<f64>() / 38.0).sqrt()
    };
    let everything: Vec<usize> = (0..80).collect();
    let (untied_m, tied_m) = (off_m(&untied, &everything), off_m(&tied, &everything));
    assert!(untied_m > 1.0 && tied_m < 0.15, "{untied_m} {tied_m}");
    // What is not learned from is not looked at.
    let one_lane: Vec<usize> = (0..40).collect();
    assert_eq!(off_m(&tied, &one_lane), off_m(&untied, &one_lane));
}

#[test]
fn the_truth_solves_the_vehicle_equations() {
    // Straight on at a constant speed; receiver and yaw err from frame to frame.
    let error_m = |i: usize| [0.3 * (0.7 * i as f64).sin(), 0.2 * (1.1 * i as f64).cos()];
    let yaw_rad = |i: usize| 0.01 * (1.9 * i as f64).sin();
    let track = Track {
        positions_m: (0..40).map(|i| [1.5 * i as f64 + error_m(i)[0], error_m(i)[1]]).collect(),
        course_rad: (0..40).map(yaw_rad).collect(),
        time_s: (0..40).map(f64::from).collect(),
        noise: motion::TrackNoise {
            receiver_std_m: 0.6,
            receiver_time_s: 20.0,
            speed_change_std_mps: 0.5,
            yaw_std_rad: 0.01,
        },
    };
    const COURSE: usize = 40;
    let unknowns = Unknowns { first: 0, a_frame: 3, has_yaw: true, course: 3 * COURSE };
    let truth = |at: usize| match (at / 3, at % 3) {
        (COURSE, _) => 0.0,
        (row, axis @ 0..2) => error_m(row)[axis],
        (row, _) => yaw_rad(row),
    };
    let equations = track.vehicle_equations(unknowns, 1.0);
    assert_eq!(equations.len(), 1 + 39 + 38);
    for equation in &equations {
        let left: f64 = equation.terms.iter().map(|&(at, coefficient)| coefficient * truth(at)).sum();
        // Of second order: the yaw's error times that of a step.
        assert!((left - equation.right).abs() < 0.006, "{left} {}", equation.right);
    }
}
