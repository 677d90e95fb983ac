//! A tiny data set for program tests: drawn, not photographed.

#![allow(dead_code, reason = "each test program uses a part")]

pub mod drive;
pub mod map;

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    sync::Mutex,
};

use assert_cmd::Command;
use tempfile::TempDir;

pub const HEADER: &str = "index,file,x_m,y_m,yaw_rad,time_s";
pub const DONUT: &str = r#"{"kind": "donut", "cx": 47.5, "cy": 47.5, "r_in": 10.0, "r_out": 40.0, "top_is_outer": true,
    "start_angle": 0.0, "clockwise": true, "azimuth": "ccw"}"#;

/// The library `tests/NAME/shim.c`, compiled once a program: preloaded, it plays a device or makes one fail.
pub fn shim(name: &str) -> PathBuf {
    static COMPILED: Mutex<BTreeMap<String, PathBuf>> = Mutex::new(BTreeMap::new());
    let mut compiled = COMPILED.lock().expect("nothing panicked");
    let compile = || {
        let library = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name).with_extension("so");
        // Another run of this program may be using the library: a new one is put in its place whole.
        let compiling = library.with_extension(std::process::id().to_string());
        let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests").join(name).join("shim.c");
        let status = std::process::Command::new("cc")
            .args(["-shared", "-fPIC", "-O1", "-Wall", "-Wextra", "-Werror", "-o"])
            .args([&compiling, &source])
            .args(["-ldl", "-lpthread"])
            .status()
            .expect("cc runs");
        assert!(status.success(), "cc {}", source.display());
        fs::rename(&compiling, &library).expect("renames");
        library
    };
    compiled.entry(name.into()).or_insert_with(compile).clone()
}

/// A grey JPEG whose pixels depend on `seed`.
pub fn jpeg(width_px: u32, height_px: u32, seed: u32) -> Vec<u8> {
    let pixels: Vec<u8> = (0..width_px * height_px).map(|i| ((i * (seed + 7)) % 251) as u8).collect();
    let mut bytes = Vec::new();
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 80)
        .encode(&pixels, width_px, height_px, image::ExtendedColorType::L8)
        .expect("encodes");
    bytes
}

/// A sound data set of five frames in its own temporary folder.
pub struct TinyDataset {
    pub temporary: TempDir,
}

impl TinyDataset {
    pub fn new() -> Self {
        let dataset = Self { temporary: TempDir::new().expect("a temporary folder") };
        fs::create_dir_all(dataset.folder().join("images")).expect("a folder");
        for index in 0..5 {
            dataset.write(&format!("images/{index:04}.jpg"), &jpeg(96, 96, index));
        }
        dataset.write("donut.json", DONUT.as_bytes());
        // Numbers that a careless writer would change; both ways to name a file; an empty yaw.
        dataset.write_rows(&[
            "0,0000.jpg,8.2848,7.5000,0.01567,0.30000000000000004",
            "1,images/0001.jpg,-1e-3,0.1,,1.00",
            "2,0002.jpg,123456.789012345,-0.0,-3.1,2.5",
            "3,0003.jpg,3,4,1.5,2.5",
            "7,0004.jpg,5,6,0,1700000000.123456",
        ]);
        dataset
    }

    pub fn folder(&self) -> PathBuf {
        self.temporary.path().join("tiny")
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.temporary.path().join(name)
    }

    pub fn write(&self, name: &str, bytes: &[u8]) {
        fs::write(self.folder().join(name), bytes).expect("writes");
    }

    pub fn write_rows(&self, rows: &[&str]) {
        self.write("positions.csv", format!("{HEADER}\n{}\n", rows.join("\n")).as_bytes());
    }

    /// Imports the data set, which must succeed.
    pub fn import(&self, name: &str) -> PathBuf {
        let out = self.path(name);
        omniloc().arg("import").arg(self.folder()).arg("--out").arg(&out).assert().success();
        out
    }
}

pub fn omniloc_path() -> PathBuf {
    env!("CARGO_BIN_EXE_omniloc").into()
}

pub fn omniloc() -> Command {
    Command::new(env!("CARGO_BIN_EXE_omniloc"))
}

/// The Python that has `tests/python/requirements.txt`; `tests/run` makes it and runs what needs it.
pub fn python() -> Option<String> {
    let python = std::env::var("OMNILOC_PYTHON").ok();
    if python.is_none() {
        println!("not run: OMNILOC_PYTHON is unset; tests/run sets up the Python packages and runs this test");
    }
    python
}

/// Exit code, stdout, stderr of a command.
pub fn run(command: &mut Command) -> (i32, String, String) {
    let output = command.output().expect("the program starts");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.code().expect("no signal ended it"), text(&output.stdout), text(&output.stderr))
}

/// Names in a folder, sorted.
pub fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).expect("readable");
    let mut names: Vec<String> =
        entries.map(|entry| entry.expect("readable").file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}
