//! `omniloc recover` as a script sees it.

mod common;

use std::{fs, path::Path};

use common::{TinyDataset, names, omniloc, run};
use omniloc::recording::{
    RecordingWriter,
    proto::omniloc::SurveyPair,
    recover::{Recovery, recover_bytes},
    topics,
};

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

/// A drive as the recorder writes it, cut off: every topic declared at the start, a chunk a frame. Where chunks end.
fn cut_drive(frames: u32) -> (Vec<u8>, Vec<usize>) {
    let file = tempfile::NamedTempFile::new().expect("a temporary file");
    let length = || file.path().metadata().expect("it is there").len() as usize;
    let out = file.reopen().expect("opens");
    let mut recording = RecordingWriter::appending(out, 1_700_000_000_000_000_000).expect("starts");
    topics::ALL.iter().for_each(|topic| recording.declare(topic).expect("declares"));
    let mut ends = Vec::new();
    for frame in 0..frames {
        let stamp_ns = u64::from(frame + 1) * 100_000_000;
        recording.write_image(frame, stamp_ns, &common::jpeg(64, 64, frame)).expect("writes");
        let pair = SurveyPair { valid: true, east_m: f64::from(frame), ..Default::default() };
        recording.write_pair(frame, stamp_ns, pair).expect("writes");
        recording.flush().expect("writes");
        ends.push(length());
    }
    recording.abandon();
    (fs::read(file.path()).expect("readable"), ends)
}

#[test]
fn without_its_first_chunk_a_cut_drive_is_readable_still() {
    const FRAMES: u32 = 20;
    let (mut bytes, ends) = cut_drive(FRAMES);
    let whole = recover_bytes(&bytes).expect("writes").0;
    let counts = |recovery: &Recovery| -> Vec<u64> { recovery.topics.values().map(|topic| topic.messages).collect() };
    assert_eq!(counts(&whole), [u64::from(FRAMES); 3], "images, pairs, poses: {:?}", whole.topics);

    // The declarations stand in the first chunk, which is then not to be trusted.
    bytes[ends[0] / 2] ^= 1;
    let (recovery, out) = recover_bytes(&bytes).expect("writes");
    assert_eq!(counts(&recovery), [u64::from(FRAMES) - 1; 3]);
    let messages: Vec<_> =
        mcap::MessageStream::new(&out).expect("sound").map(|message| message.expect("sound")).collect();
    for message in messages {
        let topic = topics::ALL.iter().find(|topic| topic.name == message.channel.topic).expect("one of ours");
        let schema = message.channel.schema.as_ref().expect("declared again");
        assert_eq!((schema.name.as_str(), &*schema.data), (topic.schema_name, topic.schema));
    }

    // Neither the file's beginning nor the chunk's is there.
    let (recovery, _) = recover_bytes(&bytes[ends[3] - 10..]).expect("writes");
    assert_eq!(counts(&recovery), [u64::from(FRAMES) - 4; 3]);
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
