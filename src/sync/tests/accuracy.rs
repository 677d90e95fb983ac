//! How far pairs are off, and whether they say so.

use super::{
    super::{LatencySource, Pair, Settings},
    drive::{Drive, Observers, play, synchronizer},
};
use crate::types::{TimeScale, wrap_angle_rad};

/// Root mean square of the true and of the stated error of the time \[s\].
pub struct TimeErrors {
    pub rms_s: f64,
    pub stated_rms_s: f64,
    /// Mean of (error / stated deviation)².
    pub normalised: f64,
    pub pairs: usize,
}

/// Errors along the way over the speed, where the vehicle moves; without noise of positions.
pub fn time_errors(drive: &Drive, pairs: &[Pair], from_s: f64) -> TimeErrors {
    let (mut squares, mut stated, mut normalised, mut count) = (0.0, 0.0, 0.0, 0);
    for pair in pairs.iter().filter(|pair| pair.stamp_ns >= Drive::monotonic_ns(from_s) && pair.invalid.is_none()) {
        let truth = drive.truth_at(pair.stamp_ns);
        if truth.speed_mps < 2.0 {
            continue;
        }
        let position_m = pair.position_m.expect("a valid pair has a position");
        let (sin, cos) = truth.yaw_rad.sin_cos();
        let along_m = (position_m[0] - truth.position_m[0]) * cos + (position_m[1] - truth.position_m[1]) * sin;
        let error_s = along_m / truth.speed_mps;
        squares += error_s * error_s;
        stated += pair.time_std_s.powi(2);
        normalised += (error_s / pair.time_std_s).powi(2);
        count += 1;
    }
    let n = count as f64;
    TimeErrors {
        rms_s: (squares / n).sqrt(),
        stated_rms_s: (stated / n).sqrt(),
        normalised: normalised / n,
        pairs: count,
    }
}

fn report(what: &str, errors: &TimeErrors) {
    println!(
        "{what}: {:.1} ms RMS, stated {:.1} ms, normalised {:.2}, {} pairs",
        errors.rms_s * 1e3,
        errors.stated_rms_s * 1e3,
        errors.normalised,
        errors.pairs
    );
}

#[test]
fn with_a_pulse_pairs_are_synchronized_to_a_few_milliseconds() {
    for scale in [TimeScale::Utc, TimeScale::UtcOfDay] {
        for fix_hz in [4.0, 100.0] {
            let observers = Observers { scale: Some(scale), fix_hz, pulse: true, ..Observers::default() };
            let mut drive = Drive::new(observers, 1);
            let mut synchronizer = synchronizer(&Settings::default());
            let events = drive.events(0.0, 200.0);
            let pairs = play(&mut synchronizer, &events);
            assert_eq!(synchronizer.latency().source, LatencySource::Pulse);
            let errors = time_errors(&drive, &pairs, 15.0);
            report(&format!("pulse, {scale:?}, fixes at {fix_hz} Hz"), &errors);
            assert!(errors.rms_s < 0.005 && errors.pairs > 1500, "{} ms", errors.rms_s * 1e3);
            assert!(errors.stated_rms_s < 0.02 && errors.normalised < 4.0, "{}", errors.normalised);
        }
    }
}

#[test]
fn with_turns_seen_by_the_camera_pairs_are_synchronized_to_20_ms() {
    for scale in [TimeScale::Utc, TimeScale::UtcOfDay, TimeScale::Device] {
        for (fix_hz, seed) in [(4.0, 2), (100.0, 3)] {
            let observers = Observers { scale: Some(scale), fix_hz, rotations: true, ..Observers::default() };
            let mut drive = Drive::new(observers, seed);
            let mut synchronizer = synchronizer(&Settings::default());
            let events = drive.events(0.0, 240.0);
            let pairs = play(&mut synchronizer, &events);
            let latency = synchronizer.latency();
            assert_eq!(latency.source, LatencySource::Visual);
            let errors = time_errors(&drive, &pairs, 60.0);
            report(&format!("turns, {scale:?}, fixes at {fix_hz} Hz, latency {latency:?}"), &errors);
            assert!(errors.rms_s < 0.02 && errors.pairs > 1500, "{} ms", errors.rms_s * 1e3);
            assert!(errors.stated_rms_s < 0.02, "stated {} ms", errors.stated_rms_s * 1e3);
            assert!(errors.normalised < 4.0, "{}", errors.normalised);
        }
    }
}

#[test]
fn yaws_without_a_time_of_their_own_carry_their_jitter_into_the_latency_and_say_so() {
    let mut drive = Drive::new(Observers { rotations: true, frame_hz: 30.0, ..Observers::default() }, 7);
    let mut events = drive.events(0.0, 240.0);
    for (_, event) in &mut events {
        if let super::drive::Event::Sample(crate::types::GnssSample::Heading(heading)) = event {
            heading.sample_time = None;
        }
    }
    let mut synchronizer = synchronizer(&Settings::default());
    let pairs = play(&mut synchronizer, &events);
    assert_eq!(synchronizer.latency().source, LatencySource::Visual);
    let errors = time_errors(&drive, &pairs, 90.0);
    report("turns against yaws without a time", &errors);
    // A line that keeps the order makes 40 ms of jitter into 60 ms of mean lateness, of which turns see a sample.
    assert!(errors.rms_s < 0.03 && errors.normalised < 4.0, "{} ms, {}", errors.rms_s * 1e3, errors.normalised);
}

#[test]
fn the_visual_latency_is_as_good_as_it_says() {
    let (mut within, mut squares, runs) = (0, 0.0, 24);
    for seed in 0..runs {
        let observers = Observers { rotations: true, frame_hz: 30.0, jitter_s: 0.02, ..Observers::default() };
        let mut drive = Drive::new(observers, 100 + seed);
        let mut synchronizer = synchronizer(&Settings::default());
        play(&mut synchronizer, &drive.events(0.0, 75.0));
        let latency = synchronizer.latency();
        assert_eq!(latency.source, LatencySource::Visual, "a minute with a few turns is enough");
        let error_s = latency.latency_s - drive.observers.latency_s;
        squares += error_s * error_s;
        within += u64::from(error_s.abs() <= 2.0 * latency.std_s);
    }
    let rms_s = (squares / runs as f64).sqrt();
    println!("visual latency after 75 s: {:.1} ms RMS, {within} of {runs} within two deviations", rms_s * 1e3);
    assert!(rms_s < 0.005, "{} ms", rms_s * 1e3);
    assert!(within >= runs - 3, "{within} of {runs}");
}

#[test]
fn a_wrong_constant_is_covered_by_the_stated_deviation() {
    let mut drive = Drive::new(Observers::default(), 4);
    let mut synchronizer = synchronizer(&Settings::default());
    let pairs = play(&mut synchronizer, &drive.events(0.0, 120.0));
    assert_eq!(synchronizer.latency().source, LatencySource::Configured);
    let errors = time_errors(&drive, &pairs, 10.0);
    report("nothing but a constant that is 150 ms off", &errors);
    assert!(errors.rms_s > 0.1, "this is what is not known");
    assert!(errors.rms_s < 2.0 * errors.stated_rms_s);
}

#[test]
fn a_vehicle_that_does_not_turn_says_nothing_of_the_latency() {
    let mut drive = Drive::new(Observers { rotations: true, ..Observers::default() }, 5);
    let mut events = drive.events(0.0, 60.0);
    for (_, event) in &mut events {
        match event {
            super::drive::Event::Rotation { rotation_rad, .. } => *rotation_rad = 0.001,
            super::drive::Event::Sample(crate::types::GnssSample::Heading(heading)) => heading.yaw_rad = 1.0,
            _ => {}
        }
    }
    let mut synchronizer = synchronizer(&Settings::default());
    play(&mut synchronizer, &events);
    assert_eq!(synchronizer.latency().source, LatencySource::Configured);
    assert_eq!(synchronizer.statistics().turns, 0);
}

#[test]
fn positions_and_yaws_are_as_good_as_they_say() {
    for velocities in [false, true] {
        let observers = Observers { position_std_m: 0.6, pulse: true, velocities, ..Observers::default() };
        let mut drive = Drive::new(observers, 6);
        let mut synchronizer = synchronizer(&Settings::default());
        let pairs = play(&mut synchronizer, &drive.events(0.0, 600.0));
        let (mut normalised, mut yaw_squares, mut count) = (0.0, 0.0, 0.0);
        for pair in pairs.iter().filter(|pair| pair.invalid.is_none()) {
            let truth = drive.truth_at(pair.stamp_ns);
            let position_m = pair.position_m.expect("a valid pair has a position");
            let std_m = pair.position_std_m.expect("the receiver states it");
            let error_m = crate::types::distance_m(position_m, truth.position_m);
            normalised += (error_m / std_m).powi(2) / 2.0;
            yaw_squares += wrap_angle_rad(pair.yaw_rad.expect("a yaw") - truth.yaw_rad).powi(2);
            count += 1.0;
        }
        let (normalised, yaw_rms_rad) = (normalised / count, (yaw_squares / count).sqrt());
        println!("velocities {velocities}: normalised position error {normalised:.2}, yaw {yaw_rms_rad:.4} rad RMS");
        // 600 s of errors that are alike for 3 s: about 200 independent ones on two axes, χ² with 400 degrees of freedom,
        // 99.9 % within 1 ± 0.23. Interpolating between fixes averages their noise a little: less than 1.
        assert!((0.65..1.25).contains(&normalised), "{normalised}");
        assert!(yaw_rms_rad < 0.01, "{yaw_rms_rad}");
        assert!(count > 8900.0);
    }
}
