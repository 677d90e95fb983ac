//! Drives on a disk that is slow, full or read-only for a while, through the whole program.
//!
//! The disk is the machine's; a library that is preloaded into the program makes it fail: `disk_shim/shim.c`.

mod common;

use std::{collections::BTreeMap, fs, path::Path, thread, time::Duration};

use common::{
    drive::{command, configure, finished, health, messages, stderr, wait},
    omniloc, shim,
};
use omniloc::recording::{
    proto::{foxglove, omniloc as proto},
    topics,
};

/// Bytes in the folder of recordings.
fn recorded_bytes(folder: &Path) -> u64 {
    let entries = fs::read_dir(folder.join("recordings")).into_iter().flatten().flatten();
    entries.filter_map(|entry| Some(entry.metadata().ok()?.len())).sum()
}

/// Records a drive of `duration_s`; while it goes on the disk has the `fault` for `lasts`. Afterwards `/status` has said
/// so, every frame is there once, and so is its pair, but for those that came for frames of a segment that had failed:
/// at most `late_pairs`, and they are counted.
fn drive_with(fault: &str, lasts: Duration, duration_s: f64, late_pairs: u64) {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let faults = folder.path().join("faults");
    fs::create_dir(&faults).expect("a folder");
    let config = configure(folder.path(), &format!("duration_s = {duration_s:.1}"), &[]);
    let recordings = folder.path().join("recordings");
    let child = command(&config)
        .env("LD_PRELOAD", shim("disk_shim"))
        .env("DISK_FOLDER", &recordings)
        .env("DISK_FAULTS", &faults)
        .spawn()
        .expect("starts");
    while recorded_bytes(folder.path()) < 200_000 {
        thread::sleep(Duration::from_millis(20));
    }
    fs::write(faults.join(fault), "").expect("writes");
    thread::sleep(lasts);
    fs::remove_file(faults.join(fault)).expect("removes");
    let output = wait(child);

    // A segment that the end of the drive left cut is mended by the next start, or by hand.
    for entry in fs::read_dir(&recordings).expect("readable") {
        let path = entry.expect("entry").path();
        if path.extension().is_some_and(|extension| extension == "part") {
            omniloc().arg("recover").arg(path).assert().success();
        }
    }
    let paths = finished(folder.path());
    let statuses: Vec<_> = paths.iter().flat_map(|path| messages::<proto::Status>(path, &topics::STATUS)).collect();
    let said = health(&statuses, |status| &status.disk_health);
    assert!(said.contains(fault) && said.contains("ok"), "{fault}: {said:?} {}", stderr(&output));
    let last = &statuses.iter().max_by_key(|(stamp_ns, _)| stamp_ns).expect("there are some").1;
    assert_eq!((last.disk_health.as_str(), last.frames_dropped), ("ok", 0), "{fault}");

    let mut frames: BTreeMap<u64, (usize, usize)> = BTreeMap::new();
    let mut late = 0;
    for path in &paths {
        for (stamp_ns, _) in messages::<foxglove::CompressedImage>(path, &topics::CAMERA_IMAGE) {
            frames.entry(stamp_ns).or_default().0 += 1;
        }
        for (stamp_ns, _) in messages::<proto::SurveyPair>(path, &topics::SURVEY_PAIR) {
            frames.entry(stamp_ns).or_default().1 += 1;
        }
        for (_, loss) in messages::<proto::Dropped>(path, &topics::DROPPED) {
            assert_eq!(loss.reason, "pair after its segment", "{fault}");
            late += if loss.topic == topics::SURVEY_PAIR.name { loss.count } else { 0 };
        }
        omniloc().arg("check").arg(path).assert().success();
    }
    assert!(last.frames > 50 && frames.len() as u64 >= last.frames, "{fault}: {} of {}", frames.len(), last.frames);
    assert!(frames.values().all(|(images, pairs)| *images == 1 && *pairs <= 1), "{fault}: {frames:?}");
    let without_pair = frames.values().filter(|(_, pairs)| *pairs == 0).count() as u64;
    assert_eq!(without_pair, late, "{fault}: {frames:?}");
    assert!(late <= late_pairs, "{fault}: {late}");
    assert_eq!(output.status.code(), Some(if late > 0 { 3 } else { 0 }), "{fault}: {}", stderr(&output));
}

#[test]
fn a_disk_that_is_slow_full_or_read_only_for_a_while_costs_no_frame_and_is_reported() {
    thread::scope(|scope| {
        scope.spawn(|| drive_with("slow", Duration::from_secs(7), 16.0, 0));
        scope.spawn(|| drive_with("full", Duration::from_secs(4), 14.0, 10));
        scope.spawn(|| drive_with("read-only", Duration::from_secs(4), 14.0, 10));
    });
}
