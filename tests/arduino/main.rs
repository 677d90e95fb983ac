//! The Arduino sketch, with a simulated sensor at one end and our own serial driver and decoder at the other.
//!
//! What needs hardware runs on an emulated ATmega2560 (simavr): interrupts, buffers, time. What is logic runs as a
//! program of this computer, by the thousand. Time is that of the emulation, in step with the sensor, so nothing here
//! depends on how fast the host is. The packages it takes: see `rig::checked`; `tests/run` installs them.

mod drive;
mod mti;
mod rig;

use std::{sync::mpsc, thread};

use drive::{
    Drive, NS_PER_TICK, POSITION_ERROR_M, PULSE_INTERVAL, PULSES, START_UTC_NS, Said, YAW_ERROR_DEG, distance_m, truth,
    without_satellites,
};
use mti::{Mti, everything, factory};
use omniloc::{
    devices::{
        SerialChunk, SerialEvent, Stop,
        gnss_serial::{self, Baud},
        pty::{Pace, Pty, TimedBytes},
    },
    gnss::encode::{AxesSense, Measurement, Precision, XbusFormat, XbusSensor, write_packet},
    types::{FixQuality, Geodetic, North, SystemClock, wrap_angle_rad},
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rig::Rig;

/// Plays bytes to the real serial driver and returns what it has read.
fn through_the_driver(bytes: Vec<u8>) -> Vec<SerialChunk> {
    let pty = Pty::open(None).expect("a pseudo-terminal");
    let settings =
        gnss_serial::Settings { port: pty.path().to_owned(), baud: Baud::Fixed(115_200), silence_timeout_s: 60.0 };
    let (stop, expected) = (Stop::default(), bytes.len());
    let (chunks, received) = mpsc::channel();
    let driver = thread::spawn({
        let stop = stop.clone();
        move || {
            gnss_serial::run(&settings, &SystemClock, &stop, &mut |event| {
                if let SerialEvent::Chunk(chunk) = event {
                    chunks.send(chunk).expect("somebody listens");
                }
            })
        }
    });
    let once = [TimedBytes { at_ns: 0, bytes }];
    let played = pty.play(once, Pace::AsRead, &SystemClock, &stop).expect("a pseudo-terminal can be written to");
    assert_eq!(played.written_bytes, expected as u64);
    let mut found = Vec::new();
    while found.iter().map(|chunk: &SerialChunk| chunk.bytes.len()).sum::<usize>() < expected {
        found.push(received.recv().expect("the driver reads all of it"));
    }
    stop.stop();
    driver.join().expect("the driver does not panic").expect("and ends well");
    found
}

/// Longest sentences, with `$` and line end, and all of a second together: as arduino/README.md has them.
const LONGEST: [(&str, usize); 5] = [("$GNZDA", 39), ("$GNGST", 47), ("$GNGGA", 80), ("$PASHR", 53), ("$HCHDM", 21)];
const MAX_BYTES_PER_S: usize = 8176;

/// The loop may be away for so long: a fifth of what the buffer holds of the sensor's line.
const MAX_LOOP_CYCLES: u64 = 22 * rig::CYCLES_PER_MS / 5;

#[test]
fn every_sample_at_100_hz_reaches_the_serial_driver() {
    let mut drive = Drive::new(Rig::board(), Mti::new(factory()));
    drive.ticks(1000, truth);
    let stats = drive.rig.stats();
    let bytes = std::mem::take(&mut drive.received);
    let chunks = through_the_driver(bytes.clone());
    assert!(chunks.iter().flat_map(|chunk| &chunk.bytes).eq(&bytes));

    let said = Said::of_chunks(&chunks);
    said.assert_no_losses();
    let (headings, fixes) = said.ticks(truth);
    // Configured with the first messages; the last lines are still under way.
    let (first, last) = (headings[0], *headings.last().expect("headings"));
    assert!(first < 10 && last >= 997, "{first} to {last}");
    assert!(headings.iter().copied().eq(first..=last), "every one of them, in order");
    let (first, last) = (fixes[0], *fixes.last().expect("fixes"));
    assert!(fixes.iter().copied().eq((first..=last).step_by(10)) && last >= 980, "{fixes:?}");
    // The receiver in the sensor speaks four times a second.
    for fix in &said.fixes[3..] {
        assert_eq!((fix.quality, fix.satellites), (FixQuality::Autonomous, Some(9)));
        let std_m = fix.position_std_m.expect("deviations");
        assert!(std_m.iter().zip([0.9, 0.9, 2.5]).all(|(found_m, std_m)| (found_m - std_m).abs() < 0.001), "{std_m:?}");
    }
    assert_eq!(said.states(), "SMMMMMMMMMM");
    println!("{stats:?}, {} bytes of the sensor waited at most", said.count("peak"));
    assert_eq!(stats["overruns"], 0);
    assert!(stats["longest_loop_cycles"] < MAX_LOOP_CYCLES, "{stats:?}");
    // Ten seconds: two changes a second while there is a fix, more before.
    assert!((18..40).contains(&stats["lamp_changes"]), "{stats:?}");
}

#[test]
fn a_sensor_that_is_off_deaf_and_old_is_configured_in_the_end() {
    let mut drive = Drive::new(Rig::board(), Mti::new(factory()));
    drive.silence(250);
    let said = drive.take();
    assert_eq!(said.states(), "SSS", "the heart beats");

    drive.sensor.unknown_items = vec![0x7010];
    drive.sensor.ignored = 2;
    let wake_up = drive.sensor.wake_up();
    drive.send(&wake_up);
    drive.ticks(500, truth);
    // The first two go unheard; refused with the new item, accepted with the old ones.
    assert_eq!(drive.sensor.heard, [0x30, 0x30, 0x30, 0xC0, 0xC0, 0xC0, 0x10]);
    let said = drive.take();
    said.assert_no_losses();
    let (headings, fixes) = said.ticks(truth);
    assert!(headings.windows(2).all(|pair| pair[1] == pair[0] + 1) && headings.len() > 350, "{}", headings.len());
    assert!(fixes.windows(2).all(|pair| pair[1] == pair[0] + 10) && fixes.len() > 35, "{}", fixes.len());
    let std_m = said.fixes.last().and_then(|fix| fix.position_std_m).expect("deviations, from the old items");
    assert!(std_m.iter().zip([1.6, 1.2, 4.8]).all(|(found_m, std_m)| (found_m - std_m).abs() < 0.001), "{std_m:?}");
    assert!(said.states().ends_with("MMM"), "{}", said.states());

    // Gone, and back: with its power it keeps what it was told, so that it is not told again.
    drive.silence(300);
    let said = drive.take();
    assert!(said.states().ends_with("SS"), "{}", said.states());
    assert_eq!(said.count("losses"), 1);
    drive.sensor.heard.clear();
    drive.ticks(200, truth);
    assert_eq!(drive.sensor.heard, [0x30, 0xC0, 0x10]);
    let said = drive.take();
    assert!(said.states().ends_with('M'), "{}", said.states());
    assert_eq!(said.ticks(truth).0.last().map(|tick| tick + 4 > drive.tick), Some(true));
}

#[test]
fn a_sensor_whose_receive_line_is_not_wired_is_listened_to() {
    let mut sensor = Mti::new(everything());
    sensor.hears = false;
    let mut drive = Drive::new(Rig::board(), sensor);
    drive.ticks(500, truth);
    let said = drive.take();
    said.assert_no_losses();
    let (headings, fixes) = said.ticks(truth);
    assert!(headings.iter().copied().eq(0..=headings.len() as u64 - 1) && headings.len() > 495, "{}", headings.len());
    // It sends a position with every packet; they are thinned.
    assert!(fixes.windows(2).all(|pair| pair[1] == pair[0] + 10) && fixes.len() > 48, "{fixes:?}");
    assert!(said.states().ends_with("LLL"), "{}", said.states());
}

#[test]
fn more_than_the_line_carries_is_dropped_in_whole_lines_and_counted() {
    let mut drive = Drive::new(Rig::board(), Mti::new(everything()));
    drive.ticks(50, truth);
    // A sensor that measures as fast as its own line carries, with stamps 10 ms apart: 15 kB of lines a second.
    drive.sensor.outputs.retain(|(item, _)| [0x1010, 0x1060, 0x2030, 0x5023, 0x5043].contains(item));
    let before: u64 = drive.tick;
    let mut flood = Vec::new();
    for _ in 0..400 {
        flood.extend(drive.sensor.tick(&[], &truth(drive.tick)));
        drive.tick += 1;
    }
    let sent = drive.rig.run(flood.len() as u64 * 10_000 / 115_200 + 1000, &flood);
    drive.received.extend(sent.to_computer);
    let stats = drive.rig.stats();

    let said = drive.take();
    assert_eq!(said.counters.lost(), 0, "no line is cut: {:?}", said.counters);
    let (headings, fixes) = said.ticks(truth);
    let passed = headings.iter().filter(|&&tick| tick >= before).count() as u64;
    let dropped = said.count("dropped");
    assert!(dropped > 0 && passed + dropped == 400, "{passed} headings came, {dropped} lines were dropped");
    assert_eq!(fixes.iter().filter(|&&tick| tick >= before).count(), 40, "positions are dropped after headings");
    assert!(said.health.len() >= 2, "the heart beats");
    for counter in ["wrong sums", "skipped", "overruns", "missed", "refused"] {
        assert_eq!(said.count(counter), 0, "{counter}");
    }
    println!("{stats:?}, {} bytes of the sensor waited at most", said.count("peak"));
    assert_eq!(stats["overruns"], 0);
    assert!(stats["longest_loop_cycles"] < MAX_LOOP_CYCLES, "{stats:?}");
}

#[test]
fn noise_and_damage_are_counted_and_cost_only_what_they_hit() {
    let mut drive = Drive::new(Rig::board(), Mti::new(everything()));
    drive.ticks(50, truth);
    // Stop bits missing, bytes of nothing, and a start that promises more than comes.
    let sent = drive.rig.noise(10, &[0x55; 7]);
    drive.received.extend(sent.to_computer);
    drive.send(b"noise");
    drive.send(&[0xFA, 0xFF, 0x36, 0x40, 1, 2, 3]);
    drive.ticks(100, truth);
    // A bit flipped, a byte missing, the rest of a packet missing; five more in between.
    let mut hit = Vec::new();
    for damage in [(|packet| flip_a_bit(packet)) as fn(&mut Vec<u8>), lose_a_byte, lose_the_rest] {
        let mut said = drive.sensor.tick(&[], &truth(drive.tick));
        damage(&mut said);
        hit.push(drive.tick);
        drive.send(&said);
        drive.ticks(5, truth);
    }
    drive.ticks(150, truth);
    let said = drive.take();
    assert_eq!(said.counters.lost(), 0, "what is sent is sound: {:?}", said.counters);
    let (headings, _) = said.ticks(truth);
    let expected: Vec<_> = (52..drive.tick - 3).filter(|tick| !hit.contains(tick)).collect();
    let found: Vec<_> = headings.into_iter().filter(|tick| (52..drive.tick - 3).contains(tick)).collect();
    assert_eq!(found, expected);
    assert_eq!(said.count("framing"), 7);
    assert_eq!(said.count("missed"), 3);
    assert_eq!(said.count("losses"), 0);
    assert!(said.count("wrong sums") >= 4, "{:?}", said.errors);
    assert!(said.count("skipped") >= 12, "{:?}", said.errors);
}

fn flip_a_bit(packet: &mut [u8]) {
    packet[20] ^= 4;
}

fn lose_a_byte(packet: &mut Vec<u8>) {
    packet.remove(30);
}

fn lose_the_rest(packet: &mut Vec<u8>) {
    packet.truncate(packet.len() / 2);
}

#[test]
fn the_pulse_is_passed_on_and_timed() {
    let mut drive = Drive::new(Rig::board(), Mti::new(everything()));
    for _ in 0..3 {
        drive.rig.pulse(true);
        drive.ticks(5, truth);
        drive.rig.pulse(false);
        drive.ticks(45, truth);
    }
    drive.ticks(60, truth);
    assert_eq!(drive.rig.stats()["pulses_passed"], 3);
    let said = drive.take();
    said.assert_no_losses();
    let health = said.health.last().expect("a heartbeat");
    assert_eq!(health[PULSES], "3");
    // Micros count in steps of 4, and an instruction or a byte's interrupt may be under way.
    let interval_us: i64 = health[PULSE_INTERVAL].parse().expect("a number");
    assert!((interval_us - 500_000).abs() < 50, "{interval_us}");
}

#[test]
fn without_satellites_there_is_no_position_and_the_heading_says_what_it_is() {
    let mut drive = Drive::new(Rig::native(), Mti::new(everything()));
    drive.ticks(100, truth);
    let with = drive.take();
    assert!(with.headings.iter().all(|heading| heading.north == North::True) && with.no_fixes == 0);
    // Coasting: our encoder's status; it gives no position then.
    drive.ticks(300, without_satellites);
    let coasting = drive.take();
    assert!(coasting.headings.iter().all(|heading| heading.north == North::True));
    assert!(coasting.fixes.len() <= 1, "{:?}", coasting.fixes);
    // No satellites for long, then no heading either: bits of the status word.
    for (status, headings, no_fixes) in [(0x01, 0, 20), (0x03, 200, 20)] {
        for _ in 0..200 {
            let said = drive.sensor.tick(&[], &without_satellites(drive.tick));
            drive.send(&with_status(&said, status));
        }
        // Two seconds; with magnetic headings there is more to say than ever.
        let bytes = drive.received.len();
        assert!(bytes <= 2 * MAX_BYTES_PER_S, "{bytes} bytes in two seconds");
        let said = drive.take();
        assert_eq!(said.rejected, Vec::<&str>::new());
        assert!(said.headings.len().abs_diff(headings) <= 3, "{status}: {} headings", said.headings.len());
        assert!(said.no_fixes.abs_diff(no_fixes) <= 2, "{status}: {} times no fix", said.no_fixes);
        for heading in &said.headings {
            let time = heading.sample_time.expect("that of the line before it");
            let measured = truth(((time.ns - START_UTC_NS) / NS_PER_TICK) as u64);
            assert!(wrap_angle_rad(heading.yaw_rad - measured.yaw_rad).abs() < YAW_ERROR_DEG.to_radians());
        }
        assert!(said.headings.iter().skip(3).all(|heading| heading.north == North::Magnetic));
    }
}

/// The packet with another status word, which is its last item.
fn with_status(packet: &[u8], status: u32) -> Vec<u8> {
    let header_bytes = if packet[3] == 0xFF { 6 } else { 4 };
    let mut data = packet[header_bytes..packet.len() - 1].to_vec();
    let at = data.len() - 4;
    data[at..].copy_from_slice(&status.to_be_bytes());
    let mut changed = Vec::new();
    write_packet(0x36, &data, &mut changed);
    changed
}

#[test]
fn wherever_a_packet_is_cut_those_behind_it_come() {
    let mut sensor = Mti::new(everything());
    sensor.hears = false;
    let mut drive = Drive::new(Rig::native(), sensor);
    // The first has more: what the satellite receiver says.
    let [_, packet_bytes] = [(); 2].map(|()| drive.sensor.tick(&[], &truth(0)).len());
    let mut whole = Vec::new();
    for cut in 0..packet_bytes {
        let said = drive.sensor.tick(&[], &truth(drive.tick));
        drive.send(&said[..cut]);
        whole.extend(drive.tick..drive.tick + 2);
        drive.ticks(2, truth);
    }
    whole.extend(drive.tick..drive.tick + 100);
    drive.ticks(150, truth);
    let (headings, _) = drive.take().ticks(truth);
    let last = *whole.last().expect("some");
    assert_eq!(headings.into_iter().filter(|&tick| tick <= last).collect::<Vec<_>>(), whole);
}

/// Packets are found among noise, false starts and damage: all that are whole, and nothing else.
#[test]
fn noise_hides_no_packet_and_is_never_taken_for_one() {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let mut sensor = Mti::new(everything());
    sensor.hears = false;
    let mut drive = Drive::new(Rig::native(), sensor);
    let mut whole = Vec::new();
    for _ in 0..4000 {
        let mut said = drive.sensor.tick(&[], &truth(drive.tick));
        let damage = random.random_range(0..12);
        match damage {
            0 => flip_a_bit(&mut said),
            1 => lose_a_byte(&mut said),
            2 => lose_the_rest(&mut said),
            3 => said = (0..random.random_range(0..100)).map(|_| random.random()).collect(),
            4 => said.splice(0..0, [0xFA, 0xFF, 0x36, random.random()]).for_each(drop),
            5 => said.splice(0..0, [0xFA, 0xFF, 0x36, 0xFF, random.random_range(0..3), random.random()]).for_each(drop),
            6 => said.splice(0..0, [0xFA, random.random(), 0xFA, 0xFF]).for_each(drop),
            _ => {}
        }
        whole.extend((damage > 3).then_some(drive.tick));
        drive.send(&said);
    }
    whole.extend(drive.tick..drive.tick + 100);
    drive.ticks(150, truth);
    let said = drive.take();
    assert_eq!(said.counters.lost(), 0);
    let last = *whole.last().expect("some");
    let (headings, _) = said.ticks(truth);
    assert_eq!(headings.into_iter().filter(|&tick| tick <= last).collect::<Vec<_>>(), whole);
}

/// Messages lost and damaged both ways, the sensor switched off and on: in the end it measures as it was told to.
#[test]
fn whatever_happens_to_the_conversation_it_ends_well() {
    for seed in 0..40 {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut drive = Drive::new(Rig::native(), Mti::new(factory()));
        for _ in 0..800 {
            let mut said = drive.sensor.tick(&drive.to_sensor, &truth(drive.tick));
            match random.random_range(0..20) {
                0 => said.clear(),
                1 if !said.is_empty() => said[0] ^= 1,
                2 => {
                    let last = said.len().saturating_sub(1);
                    said.truncate(last);
                }
                3 => drive.sensor.ignored += 1,
                _ => {}
            }
            if random.random_range(0..200) == 0 {
                drive.silence(random.random_range(1..200));
                drive.sensor.is_measuring = true;
                drive.sensor.outputs = if random.random() { factory() } else { drive.sensor.outputs.clone() };
                said = drive.sensor.wake_up();
            }
            drive.send(&said);
        }
        drive.sensor.ignored = 0;
        // A sensor that answered nothing for two seconds is asked again after ten.
        drive.ticks(1500, truth);
        let calm = drive.tick;
        drive.ticks(200, truth);
        let said = drive.take();
        let (headings, _) = said.ticks(truth);
        let last: Vec<_> = headings.into_iter().filter(|tick| (calm..calm + 190).contains(tick)).collect();
        assert!(last.iter().copied().eq(calm..calm + 190), "seed {seed}: {last:?}");
        assert!(said.states().ends_with("MM"), "seed {seed}: {}", said.states());
    }
}

/// All over the Earth, in every format of numbers and axes.
#[test]
fn numbers_of_every_format_keep_their_digits() {
    const EDGES_DEG: [f64; 10] =
        [0.0, 1e-9, -1e-9, 89.999_999_999, -90.0, 7.0 - 1e-10, 0.5 / 60.0, 59.999_999_99 / 60.0, 180.0, -180.0];
    let mut random = ChaCha8Rng::seed_from_u64(6);
    let mut rig = Rig::native();
    let (mut utc_ns, mut on_for_ns) = (START_UTC_NS, 0);
    for counter in 0..6000 {
        // Never the same second of a minute twice in a row, so that every time comes with its date.
        let step_ns = random.random_range(1_000_000_000..58_000_000_000);
        (utc_ns, on_for_ns) = (utc_ns + step_ns, on_for_ns + step_ns);
        let format = XbusFormat {
            attitude: Precision::ALL[random.random_range(0..4)],
            position: Precision::ALL[random.random_range(1..4)],
            axes: AxesSense::ALL[random.random_range(0..3)],
        };
        let mut angle_deg = |limit_deg: f64| match random.random_range(0..4) {
            0 => EDGES_DEG[random.random_range(0..EDGES_DEG.len())].clamp(-limit_deg, limit_deg),
            _ => random.random_range(-limit_deg..=limit_deg),
        };
        let (latitude_deg, longitude_deg, yaw_deg) = (angle_deg(90.0), angle_deg(180.0), angle_deg(180.0));
        let altitude_m = 800.0 + angle_deg(90.0) * 13.0;
        let position = Geodetic { latitude_deg, longitude_deg, altitude_m };
        let measured = Measurement {
            utc_ns,
            position: Some(position),
            roll_rad: angle_deg(180.0).to_radians(),
            pitch_rad: angle_deg(90.0).to_radians(),
            yaw_rad: yaw_deg.to_radians(),
            ..truth(0)
        };
        let mut packet = Vec::new();
        XbusSensor { format, counter }.write(&measured, on_for_ns, true, &mut packet);
        let lines = rig.run(60, &packet).to_computer;

        for line in lines.split_inclusive(|&byte| byte == b'\n') {
            let longest = LONGEST.iter().find(|(start, _)| line.starts_with(start.as_bytes()));
            assert!(longest.is_none_or(|&(_, bytes)| line.len() <= bytes), "{}", String::from_utf8_lossy(line));
        }
        // Positions at 0, 0 are not believed, whoever states them.
        let said = Said::new(&lines);
        assert!(said.fixes.len() + said.rejected.len() == 1, "{}", String::from_utf8_lossy(&lines));
        for fix in &said.fixes {
            // Half of a step of fixed point 12.20 is 5 cm along each axis.
            let limit_m = if format.position == Precision::Fp1220 { 0.08 } else { 0.0 } + POSITION_ERROR_M;
            let error_m = distance_m(fix.position, position);
            assert!(error_m < limit_m, "{error_m} m: {fix:?} {measured:?} {format:?}");
        }
        let [heading] = &said.headings[..] else { panic!("{}", String::from_utf8_lossy(&lines)) };
        // Half a millisecond.
        let time = heading.sample_time.expect("a time");
        assert!((time.ns - utc_ns).abs() <= 500_000, "{time:?} {measured:?}");
        let error_rad = wrap_angle_rad(heading.yaw_rad - measured.yaw_rad);
        assert!(error_rad.abs() < YAW_ERROR_DEG.to_radians(), "{heading:?} {measured:?} {format:?}");
    }
}

#[test]
fn documented_lines_are_those_that_are_sent() {
    let mut drive = Drive::new(Rig::native(), Mti::new(everything()));
    drive.ticks(200, truth);
    let sent = String::from_utf8(std::mem::take(&mut drive.received)).expect("text");
    let sent: Vec<_> = sent.lines().collect();
    let readme = include_str!("../../arduino/README.md");
    let documented: Vec<_> = readme.lines().filter(|line| line.starts_with('$')).collect();
    for line in &documented {
        assert!(sent.contains(line), "{line} is not among\n{}", sent.join("\n"));
    }
    assert_eq!(documented.len(), 6);
}
