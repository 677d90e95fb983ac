//! `omniloc calibrate` as a user runs it: exit codes, stdout and files.

use std::path::{Path, PathBuf};

use assert_cmd::Command;
use omniloc::calibrate::{DonutFinder, Verdict};
use omniloc::jpeg::LumaDecoder;
use omniloc::types::DonutCalibration;

const SETS: [&str; 4] = ["courtyard", "drive", "drive-day2", "corridor"];

fn data(set: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(set)
}

fn calibration(path: &Path) -> DonutCalibration {
    let text = std::fs::read_to_string(path).expect("a calibration file");
    serde_json::from_str(&text).expect("the data-set format")
}

fn calibrate(inputs: &[&Path], folder: &Path) -> Command {
    let mut command = Command::cargo_bin("omniloc").expect("the program is built");
    command.arg("calibrate").args(inputs).current_dir(folder);
    command
}

/// Distance of the centres, largest difference of the radii \[px\].
fn errors_px(found: &DonutCalibration, truth: &DonutCalibration) -> (f64, f64) {
    let center = (found.center_x_px - truth.center_x_px).hypot(found.center_y_px - truth.center_y_px);
    let inner = (found.inner_radius_px - truth.inner_radius_px).abs();
    (center, inner.max((found.outer_radius_px - truth.outer_radius_px).abs()))
}

#[test]
fn data_sets_give_their_own_calibration() {
    for set in SETS {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let output = calibrate(&[&data(set)], folder.path()).output().expect("it runs");
        let stdout = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success(), "{set}: {stdout} {}", String::from_utf8_lossy(&output.stderr));
        assert!(stdout.contains("sure, confidence") && stdout.contains("moved by"), "{set}: {stdout}");
        let (found, truth) =
            (calibration(&folder.path().join("donut.json")), calibration(&data(set).join("donut.json")));
        let (center_px, radius_px) = errors_px(&found, &truth);
        // Frames shake by 0.5 px an axis, radii do not.
        assert!(center_px < 1.5 && radius_px < 0.3, "{set}: {found:?}");
        assert_eq!((found.azimuth, found.clockwise), (truth.azimuth, truth.clockwise), "{set}");
        let picture = image::open(folder.path().join("donut.png")).expect("a picture");
        assert!(picture.height() > 640, "{set}");
    }
}

#[test]
fn recordings_are_looked_at_together_and_those_without_images_left_out() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (drive, other, useless) =
        (folder.path().join("a.mcap"), folder.path().join("b.mcap"), folder.path().join("c.mcap"));
    let dataset = folder.path().join("dataset");
    std::fs::create_dir_all(dataset.join("images")).expect("a folder");
    std::fs::copy(data("drive").join("donut.json"), dataset.join("donut.json")).expect("copies");
    let mut rows = String::from("index,file,x_m,y_m,yaw_rad,time_s\n");
    for (index, entry) in std::fs::read_dir(data("drive").join("images")).expect("a folder").flatten().enumerate() {
        std::fs::copy(entry.path(), dataset.join("images").join(entry.file_name())).expect("copies");
        rows += &format!("{index},{},{index},0,,\n", entry.file_name().display());
    }
    std::fs::write(dataset.join("positions.csv"), rows).expect("writes");
    for out in [&drive, &other] {
        let mut import = Command::cargo_bin("omniloc").expect("the program is built");
        import.arg("import").arg(&dataset).arg("--out").arg(out).assert().success();
    }
    let file = std::fs::File::create(&useless).expect("creates");
    mcap::Writer::new(file).and_then(|mut writer| writer.finish()).expect("writes");
    let output = calibrate(&[&drive, &other, &useless], folder.path()).output().expect("it runs");
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && stderr.contains("c.mcap: no images on /camera/image"), "{stderr}");
    let (center_px, radius_px) =
        errors_px(&calibration(&folder.path().join("donut.json")), &calibration(&data("drive").join("donut.json")));
    assert!(center_px < 1.5 && radius_px < 0.3, "{center_px} {radius_px}");

    let elsewhere = tempfile::tempdir().expect("a temporary folder");
    let output = calibrate(&[&useless], elsewhere.path()).output().expect("it runs");
    assert!(!output.status.success() && String::from_utf8_lossy(&output.stderr).contains("no images"));
}

#[test]
fn one_image_is_enough_and_options_set_what_it_cannot_show() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let image = data("drive").join("images/0100.jpg");
    let options =
        ["--clockwise", "false", "--azimuth", "cw", "--start-angle", "-1.5", "--top-is-outer", "false", "--json"];
    let output = calibrate(&[&image], folder.path()).args(options).output().expect("it runs");
    assert!(output.status.success());
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).expect("one JSON object");
    assert_eq!(report["verdict"], "sure");
    assert_eq!(report["calibration"]["azimuth"], "cw");
    let found = calibration(&folder.path().join("donut.json"));
    assert_eq!((found.clockwise, found.top_is_outer, found.start_angle_rad), (false, false, -1.5));
}

#[test]
fn an_existing_calibration_is_replaced_only_when_forced() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let out = folder.path().join("donut.json");
    std::fs::write(&out, "mine").expect("a file");
    calibrate(&[&data("courtyard")], folder.path()).assert().code(2);
    assert_eq!(std::fs::read_to_string(&out).expect("still there"), "mine");
    calibrate(&[&data("courtyard")], folder.path()).arg("--force").assert().code(0);
    assert!((calibration(&out).outer_radius_px - 312.0).abs() < 0.3);
}

#[test]
fn without_a_donut_nothing_is_written() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let photograph = folder.path().join("photograph.png");
    // The content of a real donut without its rims: houses, trees and grass.
    let donut = image::open(data("courtyard").join("images/0025.jpg")).expect("a test image").to_luma8();
    image::imageops::crop_imm(&donut, 200, 30, 240, 200).to_image().save(&photograph).expect("a writable folder");
    let cut = folder.path().join("cut.jpg");
    std::fs::write(&cut, [0xFF, 0xD8, 0xFF]).expect("a writable folder");
    for input in [photograph, cut, folder.path().join("missing.jpg")] {
        calibrate(&[&input], folder.path()).assert().code(1).stdout("");
        assert!(!folder.path().join("donut.json").exists() && !folder.path().join("donut.png").exists(), "{input:?}");
    }
}

/// Every single frame and every ten of the full data sets, when `OMNILOC_DATA` names their folder.
#[test]
fn full_data_sets_are_within_tolerance() {
    let Some(root) = std::env::var_os("OMNILOC_DATA").map(PathBuf::from) else { return };
    for set in ["courtyard-75", "drive-378", "drive-378-day2", "corridor-207"] {
        let truth = calibration(&root.join(set).join("donut.json"));
        let listed = std::fs::read_dir(root.join(set).join("images")).expect("the data set");
        let mut files: Vec<PathBuf> = listed.map(|entry| entry.expect("a file").path()).collect();
        files.sort();
        for count in [1, 10, 30] {
            let mut within = 0;
            let groups: Vec<&[PathBuf]> = files.chunks_exact(count).collect();
            for group in &groups {
                let mut decoder = LumaDecoder::new();
                let mut finder: Option<DonutFinder> = None;
                for file in *group {
                    let frame = decoder.decode(&std::fs::read(file).expect("an image")).expect("a JPEG");
                    let finder = finder.get_or_insert_with(|| {
                        DonutFinder::new(frame.width_px, frame.height_px).expect("large enough")
                    });
                    finder.add(frame).expect("one size");
                }
                let found = finder.expect("frames").finish().expect("a donut");
                assert_eq!(found.verdict, Verdict::Sure, "{set} {:?}", group[0]);
                let (center_px, radius_px) = errors_px(&found.calibration(&(&truth).into()), &truth);
                within += usize::from(center_px <= 1.5 && radius_px <= 2.0);
                assert!(center_px < 2.5 && radius_px < 0.3, "{set} {:?}: {found:?}", group[0]);
            }
            println!("{set}: {within} of {} groups of {count} within tolerance", groups.len());
            // Single rendered frames shake by up to 2 px.
            assert!(within == groups.len() || count == 1 && within * 100 >= groups.len() * 99, "{set} {count}");
        }
    }
}
