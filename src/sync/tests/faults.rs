//! What goes wrong, and what pairs say of it.

use proptest::prelude::*;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{
    super::{InvalidReason, LatencySource, Pair, Settings, Synchronizer},
    accuracy::time_errors,
    drive::{Drive, Event, Observers, START_UTC_NS, play, synchronizer},
};
use crate::types::{GnssSample, NS_PER_S, North, SampleTime, TimeScale, wrap_angle_rad};

fn sample_time(sample: &mut GnssSample) -> &mut Option<SampleTime> {
    match sample {
        GnssSample::Fix(fix) => &mut fix.sample_time,
        GnssSample::Heading(heading) => &mut heading.sample_time,
        _ => unreachable!("drives have nothing else"),
    }
}

fn arrival_ns(sample: &mut GnssSample) -> &mut u64 {
    match sample {
        GnssSample::Fix(fix) => &mut fix.arrival_ns,
        GnssSample::Heading(heading) => &mut heading.arrival_ns,
        _ => unreachable!("drives have nothing else"),
    }
}

/// Changes the time of all samples from some moment on.
fn set_clock(events: &mut [(u64, Event)], from_s: f64, change: impl Fn(&mut Option<SampleTime>)) {
    for (ns, event) in events.iter_mut() {
        if let Event::Sample(sample) = event
            && *ns >= Drive::monotonic_ns(from_s)
        {
            change(sample_time(sample));
        }
    }
}

/// Samples taken in a span arrive later by this much.
fn delay(events: &mut [(u64, Event)], span_s: std::ops::Range<f64>, by_ns: u64) {
    let span_ns = Drive::monotonic_ns(span_s.start)..Drive::monotonic_ns(span_s.end);
    for (ns, event) in events.iter_mut() {
        if let Event::Sample(sample) = event
            && span_ns.contains(ns)
        {
            *arrival_ns(sample) += by_ns;
            *ns += by_ns;
        }
    }
    events.sort_by_key(|event| event.0);
}

fn in_span(pairs: &[Pair], span_s: std::ops::Range<f64>) -> Vec<Pair> {
    let span_ns = Drive::monotonic_ns(span_s.start)..Drive::monotonic_ns(span_s.end);
    pairs.iter().filter(|pair| span_ns.contains(&pair.stamp_ns)).cloned().collect()
}

fn known_latency() -> Settings {
    Settings { serial_latency_s: 0.3, serial_latency_std_s: 0.01, ..Settings::default() }
}

fn reasons(pairs: &[Pair]) -> Vec<String> {
    let mut reasons: Vec<String> = pairs.iter().filter_map(|pair| Some(pair.invalid?.to_string())).collect();
    reasons.dedup();
    reasons
}

#[test]
fn every_frame_gets_one_pair_in_order_and_in_time() {
    let mut drive = Drive::new(Observers::default(), 10);
    let events = drive.events(0.0, 30.0);
    let mut synchronizer = synchronizer(&known_latency());
    let mut pairs = Vec::new();
    for event in &events {
        pairs.extend(play(&mut synchronizer, std::slice::from_ref(event)));
        let waiting_s = synchronizer.statistics().frames_waiting as f64 / drive.observers.frame_hz;
        assert!(waiting_s <= Settings::default().max_wait_s + 0.1);
    }
    synchronizer.finish(&mut pairs);
    let sequences: Vec<u64> = pairs.iter().map(|pair| pair.sequence).collect();
    assert_eq!(sequences, (1..=450).collect::<Vec<u64>>());
    let statistics = synchronizer.statistics();
    assert_eq!(statistics.valid_pairs + statistics.invalid_pairs, 450);
    assert_eq!((statistics.clock_steps, statistics.misplaced_samples), (0, 0));
}

#[test]
fn a_tunnel_gives_no_position_but_a_yaw() {
    let mut drive = Drive::new(Observers::default(), 11);
    let mut events = drive.events(0.0, 60.0);
    let tunnel_ns = Drive::monotonic_ns(20.0)..Drive::monotonic_ns(35.0);
    events.retain(|(ns, event)| !(matches!(event, Event::Sample(GnssSample::Fix(_))) && tunnel_ns.contains(ns)));
    let mut synchronizer = synchronizer(&known_latency());
    let pairs = play(&mut synchronizer, &events);
    let inside = in_span(&pairs, 20.0..34.5);
    assert!(inside.iter().all(|pair| pair.invalid.is_some() && pair.yaw_rad.is_some()));
    let reasons = reasons(&inside);
    assert_eq!(reasons[0], "no fix within 2.5 s after the exposure");
    assert!(reasons[1].starts_with("gap of 15.") && reasons[1].ends_with(" s between fixes"), "{reasons:?}");
    assert_eq!(reasons.len(), 2);
    for sound in [in_span(&pairs, 5.0..19.0), in_span(&pairs, 36.0..55.0)] {
        assert!(sound.iter().all(|pair| pair.invalid.is_none()));
    }
}

#[test]
fn frames_before_the_first_position_and_damaged_frames_say_so() {
    let mut drive = Drive::new(Observers { position_std_m: 30.0, ..Observers::default() }, 12);
    let mut vague = Synchronizer::new(&known_latency(), None).expect("sound settings");
    let pairs = play(&mut vague, &drive.events(0.0, 10.0));
    assert_eq!(reasons(&pairs)[0], "position standard deviation 30 m");
    assert_eq!(vague.origin(), None);

    let mut synchronizer = Synchronizer::new(&known_latency(), None).expect("sound settings");
    let mut pairs = Vec::new();
    synchronizer.push_frame(7, Drive::monotonic_ns(0.0), None);
    synchronizer.poll(Drive::monotonic_ns(2.4), &mut pairs);
    assert!(pairs.is_empty());
    synchronizer.poll(Drive::monotonic_ns(2.5), &mut pairs);
    assert_eq!(pairs[0].invalid, Some(InvalidReason::NoPositionYet));
    let message = pairs[0].to_message();
    assert_eq!((message.frame_sequence, message.valid, message.yaw_rad), (7, false, None));
    assert_eq!(message.invalid_reason, "no position yet");

    let mut drive = Drive::new(Observers::default(), 12);
    play(&mut synchronizer, &drive.events(5.0, 8.0));
    assert!(synchronizer.origin().is_some(), "the first good fix");
    synchronizer.push_frame(8, Drive::monotonic_ns(7.0), Some("cut short"));
    pairs.clear();
    synchronizer.finish(&mut pairs);
    let last = pairs.last().expect("a pair");
    assert_eq!(last.to_message().invalid_reason, "frame damaged: cut short");
    assert!(last.position_m.is_some() && last.yaw_rad.is_some());
}

#[test]
fn a_yaw_that_is_missing_leaves_the_pair_valid() {
    let mut drive = Drive::new(Observers::default(), 13);
    let mut events = drive.events(0.0, 20.0);
    let silent_ns = Drive::monotonic_ns(10.0);
    events.retain(|(ns, event)| !(matches!(event, Event::Sample(GnssSample::Heading(_))) && *ns > silent_ns));
    let mut synchronizer = synchronizer(&known_latency());
    let pairs = play(&mut synchronizer, &events);
    let late = in_span(&pairs, 11.0..18.0);
    assert!(late.len() > 90 && late.iter().all(|pair| pair.invalid.is_none() && pair.yaw_rad.is_none()));
}

#[test]
fn the_receivers_clock_may_be_set_by_any_amount() {
    let drift_free = |step_ns: i64| {
        move |time: &mut Option<SampleTime>| {
            if let Some(time) = time {
                time.ns += step_ns;
            }
        }
    };
    let second_ns = NS_PER_S as i64;
    let steps_ns = [-second_ns, second_ns, -18 * second_ns, 18 * second_ns, 1024 * 7 * 86_400 * second_ns];
    for step_ns in steps_ns {
        let mut drive = Drive::new(Observers::default(), 14);
        let mut events = drive.events(0.0, 90.0);
        set_clock(&mut events, 45.0, drift_free(step_ns));
        let mut synchronizer = synchronizer(&known_latency());
        let pairs = play(&mut synchronizer, &events);
        assert_eq!(synchronizer.statistics().clock_steps, 1, "step of {step_ns} ns");
        let errors = time_errors(&drive, &pairs, 5.0);
        println!("clock set by {:.0} s: {:.1} ms RMS", step_ns as f64 * 1e-9, errors.rms_s * 1e3);
        assert!(errors.rms_s < 0.02, "step of {step_ns} ns: {} ms", errors.rms_s * 1e3);
        let invalid = pairs.iter().filter(|pair| pair.invalid.is_some()).count();
        assert!(invalid <= 10, "step of {step_ns} ns: {invalid} invalid pairs");
    }
}

#[test]
fn a_device_that_restarts_counts_anew() {
    let mut drive = Drive::new(Observers { scale: Some(TimeScale::Device), ..Observers::default() }, 15);
    let mut events = drive.events(0.0, 90.0);
    let off_ns = Drive::monotonic_ns(40.0)..Drive::monotonic_ns(47.0);
    events.retain(|(ns, event)| !(matches!(event, Event::Sample(_)) && off_ns.contains(ns)));
    set_clock(&mut events, 47.0, |time| {
        time.as_mut().expect("the device states it").ns -= 53_900_000_000;
    });
    let mut synchronizer = synchronizer(&known_latency());
    let pairs = play(&mut synchronizer, &events);
    assert_eq!(synchronizer.statistics().clock_steps, 1);
    assert!(time_errors(&drive, &pairs, 5.0).rms_s < 0.02);
    assert!(in_span(&pairs, 48.0..85.0).iter().all(|pair| pair.invalid.is_none()));
}

#[test]
fn gps_time_that_comes_late_dates_what_came_before() {
    let observers = Observers { scale: None, pulse: true, ..Observers::default() };
    let mut drive = Drive::new(observers, 16);
    let mut synchronizer = synchronizer(&known_latency());
    let without_time = play(&mut synchronizer, &drive.events(0.0, 60.0));
    assert_eq!(synchronizer.latency().source, LatencySource::Configured, "edges of which seconds?");
    assert_eq!(synchronizer.utc_at(Drive::monotonic_ns(60.0)), None);
    let invalid = without_time.iter().filter(|pair| pair.invalid.is_some()).count();
    assert!(invalid < without_time.len() / 10, "only where the line was busy: {invalid}");
    // Without sample times, jitter is in the pairs.
    assert!(time_errors(&drive, &without_time, 5.0).rms_s < 0.2);

    drive.observers.scale = Some(TimeScale::UtcOfDay);
    let undated = play(&mut synchronizer, &drive.events(60.0, 120.0));
    assert_eq!(synchronizer.latency().source, LatencySource::Pulse);
    assert_eq!(synchronizer.utc_at(Drive::monotonic_ns(120.0)), None, "the date is not known");
    assert!(time_errors(&drive, &undated, 65.0).rms_s < 0.005);

    drive.observers.scale = Some(TimeScale::Utc);
    let dated = play(&mut synchronizer, &drive.events(120.0, 180.0));
    assert!(time_errors(&drive, &dated, 120.0).rms_s < 0.005);
    assert_eq!(synchronizer.statistics().clock_steps, 0, "a date is no step");
    let (utc_ns, std_s) = synchronizer.utc_at(Drive::monotonic_ns(180.0)).expect("dated");
    let error_s = (utc_ns - drive.receiver_ns(180.0, TimeScale::Utc)) as f64 * 1e-9;
    assert!(error_s.abs() < 1e-3 && std_s < 1e-3, "{error_s} s, stated {std_s} s");
    assert!(utc_ns > START_UTC_NS);
}

#[test]
fn a_latency_that_jumps_for_a_minute_is_survived_and_one_that_stays_is_stated() {
    let mut drive = Drive::new(Observers::default(), 17);
    let mut events = drive.events(0.0, 200.0);
    delay(&mut events, 60.0..120.0, 200_000_000);
    let pairs = play(&mut synchronizer(&known_latency()), &events);
    let during = time_errors(&drive, &in_span(&pairs, 60.0..120.0), 0.0);
    let after = time_errors(&drive, &in_span(&pairs, 125.0..195.0), 0.0);
    println!("latency up for a minute: {:.1} ms RMS meanwhile", during.rms_s * 1e3);
    assert!(during.rms_s < 0.02 && after.rms_s < 0.02);
    assert!(during.stated_rms_s > 0.1, "it could have been the clock");
    assert!(after.stated_rms_s < 0.03);

    let mut drive = Drive::new(Observers::default(), 17);
    let mut events = drive.events(0.0, 320.0);
    delay(&mut events, 60.0..400.0, 200_000_000);
    let pairs = play(&mut synchronizer(&known_latency()), &events);
    let stayed = time_errors(&drive, &in_span(&pairs, 200.0..310.0), 0.0);
    assert!(stayed.rms_s > 0.15 && stayed.rms_s < 1.2 * stayed.stated_rms_s, "{}", stayed.stated_rms_s);

    for what in
        [Observers { pulse: true, ..Observers::default() }, Observers { rotations: true, ..Observers::default() }]
    {
        let mut drive = Drive::new(what, 17);
        let mut events = drive.events(0.0, 420.0);
        delay(&mut events, 60.0..500.0, 200_000_000);
        let pairs = play(&mut synchronizer(&Settings::default()), &events);
        let found_out = time_errors(&drive, &in_span(&pairs, 300.0..410.0), 0.0);
        assert!(found_out.rms_s < 0.02, "pulse or turns show it: {} ms", found_out.rms_s * 1e3);
    }
}

#[test]
fn samples_out_of_order_doubled_or_with_a_wrong_time_do_no_harm() {
    let mut rng = ChaCha8Rng::seed_from_u64(18);
    let mut drive = Drive::new(Observers { pulse: true, ..Observers::default() }, 18);
    let mut events = drive.events(0.0, 90.0);
    for _ in 0..400 {
        let index = rng.random_range(0..events.len() - 1);
        match rng.random_range(0..3) {
            0 => events.swap(index, index + 1),
            1 => events.insert(index, events[index].clone()),
            _ => {
                if let Event::Sample(sample) = &mut events[index].1 {
                    let wrong_ns = [i64::MIN, i64::MAX, 0, START_UTC_NS / 2][rng.random_range(0..4)];
                    *sample_time(sample) = Some(SampleTime { ns: wrong_ns, scale: TimeScale::Utc });
                }
            }
        }
    }
    // Frames that come twice get two pairs; here each comes once.
    let mut seen = std::collections::BTreeSet::new();
    events.retain(|(_, event)| !matches!(event, Event::Frame { sequence, .. } if !seen.insert(*sequence)));
    let mut synchronizer = synchronizer(&Settings::default());
    let pairs = play(&mut synchronizer, &events);
    let errors = time_errors(&drive, &pairs, 15.0);
    assert!(errors.rms_s < 0.01, "{} ms", errors.rms_s * 1e3);
    assert!(synchronizer.statistics().misplaced_samples > 50);
    let invalid = pairs.iter().filter(|pair| pair.invalid.is_some()).count();
    assert!(invalid < pairs.len() / 20, "{invalid} of {}", pairs.len());
}

#[test]
fn ten_hours_need_no_more_memory_than_a_minute() {
    let observers = Observers { yaw_hz: 20.0, frame_hz: 4.0, pulse: true, rotations: true, ..Observers::default() };
    let mut drive = Drive::new(observers, 19);
    let mut synchronizer = synchronizer(&Settings::default());
    let (mut kept_early, mut errors_late) = (0, 0.0f64);
    for minute in 0..600 {
        let from_s = f64::from(minute) * 60.0;
        let pairs = play(&mut synchronizer, &drive.events(from_s, from_s + 60.0));
        let statistics = synchronizer.statistics();
        if minute == 1 {
            kept_early = statistics.samples_kept;
        }
        assert!(minute < 1 || statistics.samples_kept <= kept_early + 50, "{statistics:?}");
        if minute >= 590 {
            errors_late = errors_late.max(time_errors(&drive, &pairs, 0.0).rms_s);
        }
    }
    println!("after ten hours: {:.1} ms RMS, {:?}", errors_late * 1e3, synchronizer.statistics());
    assert!(errors_late < 0.01, "{} ms", errors_late * 1e3);
    assert_eq!(synchronizer.statistics().clock_steps, 0);
    assert!(synchronizer.statistics().turns >= 4);
}

#[test]
fn what_is_recorded_of_a_sample_is_stamped_with_when_it_was_taken() {
    let mut drive = Drive::new(Observers { pulse: true, ..Observers::default() }, 20);
    let events = drive.events(0.0, 30.0);
    let mut synchronizer = synchronizer(&Settings::default());
    play(&mut synchronizer, &events);
    let scale = TimeScale::Utc;
    let time = Some(SampleTime { ns: drive.receiver_ns(29.0, scale), scale });
    let truth_ns = Drive::monotonic_ns(29.0);
    let error_ns = |stamp_ns: u64| stamp_ns.abs_diff(truth_ns);
    // Whenever it came; without a time of its own, and with one that cannot be, its arrival is what there is.
    assert!(error_ns(synchronizer.stamp_ns(truth_ns + 300_000_000, time)) < 1_000_000);
    assert!(error_ns(synchronizer.stamp_ns(truth_ns + 700_000_000, time)) < 1_000_000);
    assert!(error_ns(synchronizer.stamp_ns(truth_ns + 350_000_000, None)) < 50_000_000);
    let wrong = Some(SampleTime { ns: 5, scale });
    assert!(error_ns(synchronizer.stamp_ns(truth_ns + 300_000_000, wrong)) < 50_000_000);
}

#[test]
fn the_yaw_comes_from_one_source_and_true_north_goes_first() {
    let settings = Settings { magnetic_declination_deg: -13.0, ..known_latency() };
    let mut drive = Drive::new(Observers::default(), 21);
    let mut events = drive.events(0.0, 20.0);
    let other_from_ns = Drive::monotonic_ns(8.0);
    let mut both = Vec::new();
    for (ns, event) in &mut events {
        if matches!(event, Event::Sample(GnssSample::Heading(_))) && *ns > other_from_ns {
            both.push((*ns, event.clone()));
        }
        let Event::Sample(GnssSample::Heading(heading)) = event else { continue };
        // 13 degrees west: the needle points west of north, and yaws counted from it are too small.
        heading.yaw_rad = wrap_angle_rad(heading.yaw_rad - 13f64.to_radians());
        (heading.north, heading.source) = (North::Magnetic, "HDM");
    }
    events.extend(both);
    events.sort_by_key(|event| event.0);
    let pairs = play(&mut synchronizer(&settings), &events);
    for pair in in_span(&pairs, 3.0..17.0) {
        let error_rad = wrap_angle_rad(pair.yaw_rad.expect("a yaw") - drive.truth_at(pair.stamp_ns).yaw_rad);
        assert!(error_rad.abs() < 0.05, "{error_rad} at frame {}", pair.sequence);
    }
}

proptest! {
    #[test]
    fn nothing_that_is_said_can_break_it(said in prop::collection::vec(any_sample(), 1..150)) {
        let mut synchronizer = Synchronizer::new(&Settings::default(), None).expect("sound settings");
        let mut pairs = Vec::new();
        for (sequence, (sample, stamp_ns)) in said.iter().enumerate() {
            synchronizer.push_sample(sample);
            synchronizer.push_frame(sequence as u64, *stamp_ns, None);
            synchronizer.push_pps(*stamp_ns);
            synchronizer.push_visual_rotation(stamp_ns / 2, *stamp_ns, f64::from(sequence as u32));
            synchronizer.poll(*stamp_ns, &mut pairs);
            synchronizer.utc_at(*stamp_ns);
            if let GnssSample::Fix(fix) = sample {
                synchronizer.stamp_ns(fix.arrival_ns, fix.sample_time);
            }
        }
        synchronizer.finish(&mut pairs);
        let sequences: Vec<u64> = pairs.iter().map(|pair| pair.sequence).collect();
        prop_assert_eq!(sequences, (0..said.len() as u64).collect::<Vec<u64>>());
        let sound = |pair: &Pair| pair.position_m.is_some_and(|position_m| position_m.iter().all(|x| x.is_finite()));
        prop_assert!(pairs.iter().all(|pair| pair.invalid.is_some() || sound(pair)));
    }
}

fn a_sample(is_fix: bool) -> GnssSample {
    let events = Drive::new(Observers::default(), 0).events(0.0, 0.01);
    let mut samples = events.into_iter().filter_map(|(_, event)| match event {
        Event::Sample(sample) if matches!(sample, GnssSample::Fix(_)) == is_fix => Some(sample),
        _ => None,
    });
    samples.next().expect("a fix and a heading at the start")
}

/// A fix or heading with any times and numbers, and some instant.
fn any_sample() -> impl Strategy<Value = (GnssSample, u64)> {
    let time_ns = prop_oneof![any::<i64>(), 0..5_000_000_000i64];
    let arrival_ns = prop_oneof![any::<u64>(), 0..5_000_000_000u64];
    let number = prop_oneof![any::<f64>(), -90.0..90.0f64];
    let samples: Vec<GnssSample> = [true, false].map(a_sample).into();
    (time_ns, arrival_ns.clone(), arrival_ns, number.clone(), number, 0..4u8).prop_map(
        move |(ns, arrival_ns, stamp_ns, a, b, what)| {
            let scale = [TimeScale::Utc, TimeScale::UtcOfDay, TimeScale::Device, TimeScale::Utc][what as usize];
            let mut sample = samples[usize::from(what == 0)].clone();
            *sample_time(&mut sample) = (what != 3).then_some(SampleTime { ns, scale });
            match &mut sample {
                GnssSample::Fix(fix) => {
                    (fix.arrival_ns, fix.position.latitude_deg, fix.speed_mps) = (arrival_ns, a, Some(b));
                    fix.position_std_m = Some([b, a, 1.0]);
                }
                GnssSample::Heading(heading) => (heading.arrival_ns, heading.yaw_rad) = (arrival_ns, a),
                _ => {}
            }
            (sample, stamp_ns)
        },
    )
}

#[test]
fn settings_that_cannot_be_are_refused() {
    assert_eq!(Settings::default().check(), Ok(()));
    let table = [
        (Settings { max_gap_s: 0.0, ..Settings::default() }, "max_gap_s is 0, expected 0.01 to 10"),
        (Settings { serial_latency_s: 300.0, ..Settings::default() }, "serial_latency_s is 300, expected 0 to 1"),
        (Settings { max_wait_s: f64::NAN, ..Settings::default() }, "max_wait_s is NaN, expected 0.1 to 30"),
        (
            Settings { max_wait_s: 0.5, ..Settings::default() },
            "max_wait_s is 0.5, expected at least max_gap_s + serial_latency_s = 0.75",
        ),
    ];
    for (settings, expected) in table {
        assert_eq!(settings.check(), Err(expected.to_owned()));
    }
    let table: Settings = toml::from_str("").expect("all have defaults");
    assert_eq!(table, Settings::default());
    assert!(toml::from_str::<Settings>("max_gap_ms = 3").is_err());
}
