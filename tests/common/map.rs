//! A map of the simulated corridor, made by the program once a test program.

#![allow(dead_code, reason = "each test program uses a part")]

use std::{
    path::{Path, PathBuf},
    sync::OnceLock,
};

use super::omniloc;

/// The corridor that it is of.
pub const SEED: &str = "7";

/// The folder that [`map`] lies in, with its data set in `dataset`.
pub fn folder() -> &'static Path {
    static FOLDER: OnceLock<tempfile::TempDir> = OnceLock::new();
    FOLDER
        .get_or_init(|| {
            let folder = tempfile::tempdir().expect("a temporary folder");
            let [dataset, recording, map] =
                ["dataset", "survey.mcap", "corridor.map"].map(|name| folder.path().join(name));
            let size = ["--world", "corridor", "--seed", SEED, "--frames", "120", "--size", "320x180"];
            omniloc()
                .arg("simulate")
                .args(size)
                .args(["--position-std-m", "0", "--out"])
                .arg(&dataset)
                .assert()
                .success();
            omniloc().arg("import").arg(&dataset).arg("--out").arg(&recording).assert().success();
            omniloc().arg("train").arg(&recording).args(["--grid-step-m", "0.2", "--out"]).arg(&map).assert().success();
            folder
        })
        .path()
}

pub fn map() -> PathBuf {
    folder().join("corridor.map")
}
