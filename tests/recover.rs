//! `omniloc recover` as a script sees it.

mod common;

use std::{fs, path::Path};

use common::{TinyDataset, names, omniloc, run};
use omniloc::recording::recover::recover_bytes;

/// Exit code and output of `recover --json` on these bytes, called `cut.mcap`.
fn recover(folder: &Path, bytes: &[u8]) -> (i32, serde_json::Value) {
    let cut = folder.join("cut.mcap");
    fs::write(&cut, bytes).expect("writes");
    let (code, stdout, stderr) = run(omniloc().args(["recover", "--json", "--force"]).arg(&cut));
    assert_eq!(fs::read(&cut).expect("readable"), bytes, "the old file stays as it is");
    assert_eq!(stderr, "");
    let report: serde_json::Value = serde_json::from_str(&stdout).expect("JSON");
    (code, report["recordings"][0].clone())
}

#[test]
fn every_cut_is_mended() {
    let dataset = TinyDataset::new();
    let bytes = fs::read(dataset.import("whole.mcap")).expect("readable");
    let whole = recover_bytes(&bytes).expect("writes").0;
    assert!(whole.reached_the_end && !whole.lost_something());
    let mut last = 0;
    for length in (0..bytes.len()).step_by(97) {
        let (recovery, out) = recover_bytes(&bytes[..length]).expect("writes");
        assert!(recovery.messages >= last, "{length} bytes give {} messages, fewer gave {last}", recovery.messages);
        assert!(!recovery.reached_the_end || recovery.messages == whole.messages);
        let again = recover_bytes(&out).expect("writes").0;
        assert_eq!((again.messages, again.lost_bytes), (recovery.messages, 0), "cut to {length} bytes");
        last = recovery.messages;
    }
    assert_eq!(last, whole.messages);
}

#[test]
fn exit_codes_say_whether_something_was_lost() {
    let dataset = TinyDataset::new();
    let bytes = fs::read(dataset.import("whole.mcap")).expect("readable");
    let temporary = tempfile::tempdir().expect("a temporary folder");
    let folder = temporary.path();

    let (code, report) = recover(folder, &bytes);
    assert_eq!((code, report["outcome"].as_str()), (0, Some("already whole")));
    assert_eq!(names(folder), ["cut.mcap"]);

    // Only the index is missing.
    let (code, report) = recover(folder, &bytes[..bytes.len() - 20]);
    assert_eq!((code, report["outcome"].as_str()), (0, Some("recovered")), "{report}");
    let recovered = folder.join("cut.recovered.mcap");
    omniloc().arg("check").arg(&recovered).assert().success();
    let messages = report["messages"].as_u64().expect("a number");

    let (code, report) = recover(folder, &bytes[..bytes.len() / 3]);
    assert_eq!(code, 3, "{report}");
    assert!(report["lost_bytes"].as_u64() > Some(0) && report["messages"].as_u64() < Some(messages), "{report}");
    omniloc().arg("check").arg(&recovered).assert().success();

    // Zeros in place of data: what lies around them is kept.
    let mut holed = bytes.clone();
    holed[4096..8192].fill(0);
    let (code, report) = recover(folder, &holed);
    assert_eq!(code, 3, "{report}");
    let lost_images = report["lost_messages"]["/camera/image"].as_u64();
    assert!(lost_images.is_some_and(|lost| (1..5).contains(&lost)), "{report}");
    assert!(report["messages"].as_u64() > Some(0), "{report}");
    omniloc().arg("check").arg(&recovered).assert().success();

    // Damage that shows only in the CRC: nothing of the chunk can be trusted.
    let mut flipped = bytes.clone();
    flipped[6000] ^= 1;
    let (code, report) = recover(folder, &flipped);
    assert_eq!((code, report["outcome"].as_str()), (1, Some("failed")), "it has one chunk: {report}");

    let (code, report) = recover(folder, b"not a recording");
    assert_eq!((code, report["outcome"].as_str()), (1, Some("failed")));
    assert!(report["error"].as_str().is_some_and(|error| error.contains("nothing to recover")), "{report}");
}

#[test]
fn bad_arguments_are_refused_and_nothing_is_overwritten() {
    let dataset = TinyDataset::new();
    let whole = dataset.import("whole.mcap");
    let cut = dataset.path("a.mcap.part");
    let bytes = fs::read(&whole).expect("readable");
    fs::write(&cut, &bytes[..bytes.len() / 2]).expect("writes");

    let (code, _, stderr) = run(omniloc().args(["recover", "/nowhere.mcap"]));
    assert_eq!((code, stderr.contains("no such file")), (2, true), "{stderr}");
    let (code, _, stderr) = run(omniloc().arg("recover").args([&whole, &cut]).args(["--out", "x.mcap"]));
    assert_eq!((code, stderr.contains("--out names one file")), (2, true), "{stderr}");
    let (code, _, stderr) = run(omniloc().arg("recover").arg(&cut).arg("--out").arg(&cut).arg("--force"));
    assert_eq!((code, stderr.contains("would be overwritten")), (2, true), "{stderr}");

    let (code, stdout, _) = run(omniloc().arg("recover").args([&whole, &cut]));
    assert_eq!(code, 3, "{stdout}");
    assert!(stdout.contains("already whole") && stdout.contains("lost:"), "{stdout}");
    assert!(dataset.path("a.mcap").is_file(), ".part is taken off");
    let (code, _, stderr) = run(omniloc().arg("recover").arg(&cut));
    assert_eq!((code, stderr.contains("exists already")), (2, true), "{stderr}");
}

#[test]
fn a_folder_where_nothing_is_recorded_cannot_be_marked() {
    let temporary = tempfile::tempdir().expect("a temporary folder");
    let (code, _, stderr) = run(omniloc().arg("mark").arg(temporary.path()));
    assert_eq!((code, stderr.contains("nothing is being recorded")), (2, true), "{stderr}");
    assert!(names(temporary.path()).is_empty());
    let _recorder = omniloc::recording::recorder::Folder::new(temporary.path()).expect("locks it");
    let (code, stdout, _) = run(omniloc().arg("mark").arg(temporary.path()));
    assert_eq!((code, stdout.contains("will be kept")), (0, true), "{stdout}");
    assert_eq!(names(temporary.path()), ["mark.request"]);
}
