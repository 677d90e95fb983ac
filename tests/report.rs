//! `evaluate --report` as a whole: its files, that every number on the page is in the JSON, and that a browser shows it.

mod common;

use std::{
    collections::BTreeSet,
    fs,
    path::{Path, PathBuf},
    sync::OnceLock,
};

use common::{TinyDataset, names, omniloc, run};
use serde_json::Value;
use sha2::{Digest, Sha256};
use tempfile::TempDir;

/// A name that wants to be more than text, in a page and on a terminal.
const HOSTILE: &str = "yard <script>alert(1)</script> & \"quotes\" \u{1b}[31m\u{7}\u{9b}2J";

/// A report of the protocol, on the sample's first photographs under a hostile name, and the folder it lies in.
fn protocol_report() -> PathBuf {
    static FOLDER: OnceLock<TempDir> = OnceLock::new();
    let folder = FOLDER.get_or_init(|| {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let recording = courtyard(folder.path(), 24);
        let report = folder.path().join("report");
        let (code, stdout, stderr) = run(omniloc()
            .arg("evaluate")
            .arg(&recording)
            .args(["--features", "sp", "--seeds", "2", "--variants", "plain", "--grid-step-m", "1", "--report"])
            .arg(&report));
        assert_eq!(code, 0, "{stderr}");
        let is_harmless = |text: &str| text.chars().all(|character| character == '\n' || !character.is_control());
        assert!(is_harmless(&stdout) && is_harmless(&stderr), "{stdout:?}{stderr:?}");
        assert!(stdout.contains("yard <script>") && stdout.contains("\u{fffd}[31m"), "{stdout}");
        assert!(stdout.contains("report/index.html") && stderr.contains("report: drawing"), "{stdout}{stderr}");
        folder
    });
    folder.path().join("report")
}

/// A report of another drive through the simulated corridor against its map.
fn map_report() -> PathBuf {
    static FOLDER: OnceLock<TempDir> = OnceLock::new();
    let folder = FOLDER.get_or_init(|| {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let (dataset, recording) = (folder.path().join("evening"), folder.path().join("evening.mcap"));
        let place =
            ["--world", "corridor", "--seed", common::map::SEED, "--day", "2", "--frames", "60", "--size", "320x180"];
        omniloc().arg("simulate").args(place).arg("--out").arg(&dataset).assert().success();
        omniloc().arg("import").arg(&dataset).arg("--out").arg(&recording).assert().success();
        let report = folder.path().join("report");
        let (code, _, stderr) = run(omniloc()
            .arg("evaluate")
            .arg(&recording)
            .arg("--map")
            .arg(common::map::map())
            .arg("--survey")
            .arg(common::map::folder().join("survey.mcap"))
            .args(["--baselines", "nearest", "--report"])
            .arg(&report));
        assert_eq!(code, 0, "{stderr}");
        folder
    });
    folder.path().join("report")
}

/// A recording of the sample's first `frames` photographs, two metres apart in place of ten: bags of words want neighbours
/// within five.
fn courtyard(folder: &Path, frames: usize) -> PathBuf {
    let sample = Path::new(env!("CARGO_MANIFEST_DIR")).join("samples/courtyard-75");
    // A folder's name cannot have a slash.
    let dataset = folder.join(HOSTILE.replace('/', "\u{2215}"));
    fs::create_dir_all(dataset.join("images")).expect("a folder");
    let rows = fs::read_to_string(sample.join("positions.csv")).expect("the sample is shipped");
    let closer = |field: &str| format!("{:.3}", 0.2 * field.parse::<f64>().expect("a number"));
    let kept: Vec<String> = rows
        .lines()
        .take(1 + frames)
        .enumerate()
        .map(|(number, line)| {
            let mut fields: Vec<String> = line.split(',').map(str::to_owned).collect();
            if number > 0 {
                (fields[2], fields[3]) = (closer(&fields[2]), closer(&fields[3]));
            }
            fields.join(",")
        })
        .collect();
    fs::write(dataset.join("positions.csv"), kept.join("\n") + "\n").expect("writes");
    for index in 0..frames {
        let name = format!("images/{index:04}.jpg");
        fs::copy(sample.join(&name), dataset.join(&name)).expect("copies");
    }
    fs::copy(sample.join("donut.json"), dataset.join("donut.json")).expect("copies");
    let out = folder.join("courtyard.mcap");
    omniloc().arg("import").arg(&dataset).arg("--out").arg(&out).assert().success();
    out
}

fn page(report: &Path) -> String {
    fs::read_to_string(report.join("index.html")).expect("the page is written")
}

fn json(report: &Path) -> Value {
    serde_json::from_slice(&fs::read(report.join("report.json")).expect("the JSON is written")).expect("JSON")
}

/// The value at `a.b.3.c`.
fn at<'a>(value: &'a Value, path: &str) -> Option<&'a Value> {
    path.split('.').try_fold(value, |value, key| match value {
        Value::Array(list) => list.get(key.parse::<usize>().ok()?),
        object => object.get(key),
    })
}

/// The pieces of `text` between `before` and `after`.
fn between<'a>(text: &'a str, before: &str, after: &str) -> Vec<&'a str> {
    text.split(before).skip(1).filter_map(|rest| rest.split(after).next()).collect()
}

#[test]
fn a_report_is_a_page_with_its_figures_and_all_their_numbers() {
    for (report, expected, left_out) in [
        (
            protocol_report(),
            &["comparison", "paired", "elimination", "words", "tiles"][..],
            "The drive, second by second",
        ),
        (
            map_report(),
            &["timeline", "estimates", "error-map", "likelihood", "surfaces", "reliability"],
            "Backward elimination",
        ),
    ] {
        let (page, json) = (page(&report), json(&report));
        assert_eq!(names(&report), ["figures", "index.html", "report.json"]);
        let figures = json["figures"].as_object().expect("figures by name");
        for kind in expected {
            assert!(figures.keys().any(|id| id.ends_with(&format!("-{kind}"))), "{kind} in {:?}", figures.keys());
        }
        let left: Vec<_> = json["left_out"].as_array().expect("a list").iter().map(|one| &one["title"]).collect();
        assert!(left.iter().any(|title| *title == left_out), "{left:?}");
        assert!(page.contains(&format!("<b>{left_out}:</b> left out.")));

        let shown: BTreeSet<&str> = between(&page, "data-source=\"figures.", ".data\"").into_iter().collect();
        assert_eq!(shown, figures.keys().map(String::as_str).collect(), "figures on the page and in the JSON");
        let files: BTreeSet<String> = names(&report.join("figures")).into_iter().collect();
        let written = figures.keys().flat_map(|id| [format!("{id}.svg"), format!("{id}.png")]);
        assert_eq!(files, written.collect());
        for (id, figure) in figures {
            assert!(!figure["data"].is_null() && figure["data"] != Value::Array(Vec::new()), "{id} has no data");
            let svg = fs::read_to_string(report.join(format!("figures/{id}.svg"))).expect("readable");
            assert!(svg.starts_with("<svg xmlns") && svg.ends_with("</svg>"), "{id}");
            let png = image::open(report.join(format!("figures/{id}.png"))).expect("a picture").to_luma8();
            let dark = png.pixels().filter(|pixel| pixel[0] < 128).count();
            assert!(png.width() > 400 && dark > 300, "{id}: {dark} dark pixels of {:?}", png.dimensions());
        }
    }
}

#[test]
fn every_table_cell_is_the_number_in_the_json() {
    for report in [protocol_report(), map_report()] {
        let (page, json) = (page(&report), json(&report));
        let cells = between(&page, "<td data-source=\"", "</td>");
        assert!(cells.len() > 40, "{} cells", cells.len());
        for cell in cells {
            let (path, text) = cell.split_once("\">").expect("a cell");
            let value = at(&json, path).unwrap_or_else(|| panic!("{path} is not in the JSON"));
            let Some(value) = value.as_f64() else {
                assert!(value.is_null() && text == "–", "{path}: {value} is written {text}");
                continue;
            };
            if let Some(bound) = text.strip_prefix("&lt; ") {
                assert!(value < bound.parse().expect("a number"), "{path}: {value} is written {text}");
                continue;
            }
            let plain = text.replace('−', "-").replace(['\u{a0}', '%', ' '], "");
            let plain = plain.split('(').next().unwrap_or_default();
            let shown: f64 = plain.parse().unwrap_or_else(|_| panic!("{path}: {text}"));
            let shown = if text.contains('%') { shown / 100.0 } else { shown };
            let decimals = plain.split_once('.').map_or(0, |(_, digits)| digits.len()) as i32;
            let half_a_digit = 0.501 * 10.0_f64.powi(-decimals) * if text.contains('%') { 0.01 } else { 1.0 };
            assert!((shown - value).abs() <= half_a_digit, "{path}: {value} is written {text}");
        }
    }
}

#[test]
fn what_is_drawn_is_what_the_results_say() {
    let json = json(&map_report());
    let dataset = &json["datasets"][0];
    let fused = dataset["results"].as_array().expect("a list").iter().find(|entry| entry["features"] == "fused");
    let frames = fused.expect("a fused row")["frames"].as_array().expect("frames");
    let panels = json["figures"]["corridor-7-day-2-estimates"]["data"].as_array().expect("panels");
    let drawn = panels[0]["frames"].as_array().expect("frames");
    assert_eq!((frames.len(), drawn.len()), (60, 60));
    for (result, drawn) in frames.iter().zip(drawn) {
        let number = |value: &Value| value.as_f64().expect("a number");
        assert_eq!(result["index"], drawn["index"]);
        for (key, axis) in [("est_e_m", 0), ("est_n_m", 1)] {
            assert!((number(&result[key]) - number(&drawn["estimate_m"][axis])).abs() < 1e-9, "{result} {drawn}");
        }
    }
    // Each frame is one dot on the map.
    let svg = fs::read_to_string(map_report().join("figures/corridor-7-day-2-error-map.svg")).expect("readable");
    assert_eq!(
        svg.matches("<title>frame ").count(),
        panels_frames(&json["figures"]["corridor-7-day-2-error-map"]["data"])
    );
    assert!(json["program"] == env!("CARGO_PKG_VERSION") && json["command"].as_array().expect("a list").len() > 5);
    let facts = &dataset["facts"];
    assert_eq!(facts["SHA-256"].as_str().expect("a text").len(), 64);
    assert_eq!(dataset["map"]["info"]["recordings"][0]["frames"], 120);
}

/// Whether the stated uncertainty keeps its promise is said in words, by the numbers that are drawn.
#[test]
fn the_page_says_whether_coverage_is_as_stated() {
    let (page, json) = (page(&map_report()), json(&map_report()));
    let series = json["figures"]["corridor-7-day-2-reliability"]["data"].as_array().expect("a list");
    assert!(series.len() >= 2, "{series:?}");
    for one in series {
        let [estimates, verdict] = ["estimates", "verdict"].map(|key| one[key].as_str().expect("a text"));
        let known =
            ["over-confident", "too cautious", "as stated"].contains(&verdict) || verdict.starts_with("mixed: ");
        assert!(known, "{verdict}");
        assert!(page.contains(&format!("({estimates}: {verdict})")), "{estimates} {verdict}");
        // The same as in the table.
        let rows = json["tables"]["corridor-7-day-2-table-accuracy"]["rows"].as_array().expect("a list");
        let of_figure = ["nees_mean", "coverage_95"].map(|key| one[key].as_f64().expect("a number"));
        let is_same = |row: &Value| {
            let of_row = ["nees_mean", "coverage_95"].map(|key| row[key].as_f64().unwrap_or(f64::NAN));
            of_row.iter().zip(of_figure).all(|(a, b)| (a - b).abs() < 1e-6 * b.max(1.0))
        };
        assert!(rows.iter().any(is_same), "{estimates}: {of_figure:?} in {rows:?}");
    }
}

/// Every file that was read is named with its checksum: recording, map, and what the map was learned from.
#[test]
fn the_files_that_were_read_are_on_the_page_with_their_checksums() {
    let (page, json) = (page(&map_report()), json(&map_report()));
    let inputs = json["inputs"].as_array().expect("a list");
    let roles: Vec<_> = inputs.iter().map(|input| input["role"].as_str().expect("a text")).collect();
    assert_eq!(roles, ["recording", "map", "survey"]);
    for input in inputs {
        let [file, sha256] = ["file", "sha256"].map(|key| input[key].as_str().expect("a text"));
        let bytes = fs::read(file).expect("it is still there");
        let expected: String = Sha256::digest(&bytes).iter().map(|byte| format!("{byte:02x}")).collect();
        assert_eq!(sha256, expected, "{file}");
        assert!(page.contains(&format!("<td>{file}</td><td><code>{sha256}</code></td>")), "{file}");
    }
}

/// Every line of figure 6 leads from a learning image to the test image whose label it carries.
#[test]
fn the_words_figure_draws_the_assignment_of_every_image() {
    let (report, json) = (protocol_report(), json(&protocol_report()));
    let figures = json["figures"].as_object().expect("figures by name");
    let (id, figure) = figures.iter().find(|(id, _)| id.ends_with("-words")).expect("the figure of the words");
    let mut labelled = 0;
    for panel in figure["data"].as_array().expect("panels") {
        let list = |key: &str| panel[key].as_array().expect("a list").clone();
        let counts = |key: &str| panel["counts"][key].as_u64().expect("a number") as usize;
        let of_panel = list("learning").iter().filter(|frame| !frame["label"].is_null()).count();
        assert_eq!(counts("learning_labelled"), of_panel);
        assert_eq!(counts("learning_left_out"), list("learning").len() - of_panel);
        let right = list("test").iter().filter(|test| test["index"] == test["predicted"]).count();
        assert_eq!((counts("test_right"), counts("test_wrong")), (right, list("test").len() - right));
        labelled += of_panel;
    }
    let svg = fs::read_to_string(report.join(format!("figures/{id}.svg"))).expect("readable");
    let lines = svg.matches("stroke-width=\"1.2\"").count();
    // And one in the legend of every panel.
    assert_eq!(lines, labelled + figure["data"].as_array().expect("panels").len());
    // What overlaps hides what is below it, and does not add up.
    assert!(!svg.contains("opacity"), "{id}");
}

/// Every split has its worst frames, the largest errors of the headline method in it.
#[test]
fn the_gallery_shows_the_worst_frames_of_every_split() {
    let (report, json) = (protocol_report(), json(&protocol_report()));
    let galleries = json["worst_frames"].as_object().expect("by dataset").values().next().expect("a dataset");
    let galleries = galleries.as_array().expect("one a split");
    let splits: Vec<_> = galleries.iter().map(|gallery| gallery["split"].as_str().expect("a name")).collect();
    assert_eq!(splits, ["random", "blocked"]);
    for gallery in galleries {
        let number = |value: &Value| value.as_f64().expect("a number");
        let of_split = |entry: &&Value| entry["split"] == gallery["split"] && entry["recipe"] == "default";
        let rows = json["datasets"][0]["results"].as_array().expect("a list");
        let worst = rows.iter().filter(of_split).map(|row| number(&row["emax_test_m"])).fold(0.0, f64::max);
        let frames = gallery["frames"].as_array().expect("a list");
        let errors_m: Vec<f64> = frames.iter().map(|frame| number(&frame["error_m"])).collect();
        assert!(errors_m.len() == 4 && errors_m.is_sorted_by(|a, b| a >= b) && (errors_m[0] - worst).abs() < 1e-9);
        assert!(frames.iter().all(|frame| frame["nearest_learning_image"]["index"].is_number()));
    }
    assert_eq!(page(&report).matches("<article class=\"worst\">").count(), 8);
}

fn panels_frames(panels: &Value) -> usize {
    panels.as_array().expect("panels").iter().map(|panel| panel["frames"].as_array().expect("frames").len()).sum()
}

#[test]
fn the_page_fetches_nothing_and_believes_no_name() {
    for report in [protocol_report(), map_report()] {
        let page = page(&report);
        for address in between(&page, "src=\"", "\"").into_iter().chain(between(&page, "url(", ")")) {
            assert!(address.starts_with("data:"), "{address:.80}");
        }
        for address in between(&page, " href=\"", "\"") {
            let is_own = ["data:", "#", "figures/", "report.json"].iter().any(|own| address.starts_with(own));
            assert!(is_own, "{address:.80}");
        }
        assert!(!page.contains("<script") && !page.contains("onload"));
        assert!(page.contains("default-src 'none'"));
    }
    let hostile = page(&protocol_report());
    assert!(hostile.contains(
        "yard &lt;script&gt;alert(1)&lt;\u{2215}script&gt; &amp; &quot;quotes&quot; \u{fffd}[31m\u{fffd}\u{fffd}2J"
    ));
    let is_text = |character: char| matches!(character, '\n' | '\t') || !character.is_control();
    assert!(hostile.chars().all(is_text), "control characters on the page");
}

#[test]
fn a_report_replaces_only_a_report_and_only_when_told() {
    let dataset = TinyDataset::new();
    let recording = dataset.import("rec.mcap");
    let folder = dataset.path("papers");
    fs::create_dir_all(&folder).expect("a folder");
    fs::write(folder.join("thesis.tex"), "years of work").expect("writes");
    let (code, _, stderr) = run(omniloc().arg("evaluate").arg(&recording).arg("--report").arg(&folder).arg("--force"));
    assert!(code == 2 && stderr.contains("thesis.tex"), "{code} {stderr}");
    let before = fs::read(protocol_report().join("index.html")).expect("readable");
    let (code, _, stderr) = run(omniloc().arg("evaluate").arg(&recording).arg("--report").arg(protocol_report()));
    assert!(code == 2 && stderr.contains("--force"), "{code} {stderr}");
    assert!(fs::read(protocol_report().join("index.html")).expect("readable") == before);
}

/// What cannot be written is said before the work, and nothing is left of it.
#[test]
fn a_folder_that_cannot_hold_the_report_is_refused_at_the_start() {
    let dataset = TinyDataset::new();
    let recording = dataset.import("rec.mcap");
    let evaluate = |arguments: &[&str]| {
        run(omniloc().current_dir(dataset.temporary.path()).arg("evaluate").arg(&recording).args(arguments))
    };
    // No folder can be made there, not even by root.
    let (code, _, stderr) = evaluate(&["--report", "/proc/report"]);
    assert!(code == 2 && stderr.contains("cannot make this folder") && !stderr.contains("reading"), "{code} {stderr}");
    let (code, _, stderr) = evaluate(&["--report", "/proc/self"]);
    assert!(code == 2 && !stderr.contains("reading frames"), "{code} {stderr}");
    for json in ["there", "there/results.json", "./there/../there/results.json", "there/more/results.json"] {
        let (code, _, stderr) = evaluate(&["--report", "there", "--json", json]);
        assert!(code == 2 && stderr.contains("lies in the folder of the report"), "{json}: {code} {stderr}");
    }
    // Five frames are too few to learn from: what was begun is taken back.
    let (code, ..) = evaluate(&["--report", "there"]);
    assert!(code != 0 && !dataset.path("there").exists(), "{code}");
}

/// A program of Debian's chromium package.
fn chromium() -> &'static str {
    let known = ["/usr/bin/chromium", "/usr/bin/chromium-browser", "/usr/bin/google-chrome"];
    let found = known.into_iter().find(|path| Path::new(path).exists());
    found.unwrap_or_else(|| panic!("chromium is not installed: tests/run does it, or apt-get install chromium"))
}

#[test]
fn a_browser_shows_it_without_complaint_on_a_desk_and_on_a_telephone() {
    let python = std::env::var("OMNILOC_PYTHON").unwrap_or_else(|_| "python3".into());
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/look_at_page.py");
    for report in [protocol_report(), map_report()] {
        let mut command = std::process::Command::new(&python);
        command.arg(&script).arg(chromium()).arg(report.join("index.html")).arg("1280,390");
        let outcome = command.output().expect("Python runs");
        let stdout = String::from_utf8_lossy(&outcome.stdout);
        assert!(outcome.status.success(), "{stdout}{}", String::from_utf8_lossy(&outcome.stderr));
        let widths: Vec<Value> = stdout.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect();
        assert_eq!(widths.len(), 2, "{stdout}");
        for found in widths {
            let none = |key: &str| found[key].as_array().expect("a list").is_empty();
            assert!(none("complaints") && none("requests") && none("sticking") && none("lost"), "{found}");
            assert!(none("silent"), "{found}");
            assert_eq!((&found["wide"], &found["broken"]), (&Value::from(0), &Value::from(0)), "{found}");
            assert!(found["pictures"].as_u64() >= Some(10) && found["figures"].as_u64() >= Some(8), "{found}");
            // Nine pixels are what small print in a newspaper is.
            assert!(found["smallest_px"].as_f64() >= Some(9.0) && found["font"] == true, "{found}");
        }
    }
}
