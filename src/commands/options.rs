//! Argument values that several commands take.

use std::{
    fs,
    path::{Path, PathBuf},
};

use super::BadArgument;
use crate::types::Geodetic;

/// The command as it was typed; what is no UTF-8 is replaced, to be shown.
pub fn command_line() -> Vec<String> {
    std::env::args_os().map(|argument| argument.to_string_lossy().into_owned()).collect()
}

/// `LAT,LON` or `LAT,LON,ALT`: degrees and metres above the ellipsoid.
pub fn parse_origin(text: &str) -> Result<Geodetic, String> {
    let expected = "expected LAT,LON or LAT,LON,ALT in degrees (±90, ±180) and metres, such as 40.82,-73.9";
    let numbers: Result<Vec<f64>, _> = text.split(',').map(|part| part.trim().parse()).collect();
    let (latitude_deg, longitude_deg, altitude_m) = match numbers.as_deref() {
        Ok(&[latitude_deg, longitude_deg]) => (latitude_deg, longitude_deg, 0.0),
        Ok(&[latitude_deg, longitude_deg, altitude_m]) => (latitude_deg, longitude_deg, altitude_m),
        _ => return Err(expected.into()),
    };
    let origin = Geodetic { latitude_deg, longitude_deg, altitude_m };
    if origin.is_plausible() { Ok(origin) } else { Err(expected.into()) }
}

/// Refuses an input that is not there, and one that could be waited for forever, such as a pipe.
pub fn check_input(path: &Path) -> Result<(), BadArgument> {
    match fs::metadata(path) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            Err(BadArgument(format!("{}: no such file or folder", path.display())))
        }
        Ok(facts) if !facts.is_file() && !facts.is_dir() => {
            Err(BadArgument(format!("{}: not a regular file", path.display())))
        }
        _ => Ok(()),
    }
}

/// Refuses a folder where one file is wanted.
pub fn check_no_folder(path: &Path) -> Result<(), BadArgument> {
    match path.is_dir() {
        true => Err(BadArgument(format!("{}: is a folder; name one file in it", path.display()))),
        false => Ok(()),
    }
}

/// A folder stands for the recordings in it, in the order of their names, as a drive's segments are.
pub fn with_folders(paths: &[PathBuf]) -> Result<Vec<PathBuf>, BadArgument> {
    let mut all = Vec::new();
    for path in paths {
        if !path.is_dir() {
            all.push(path.clone());
            continue;
        }
        let entries = fs::read_dir(path).map_err(|error| BadArgument(format!("{}: {error}", path.display())))?;
        let is_recording = |path: &PathBuf| path.extension().is_some_and(|extension| extension == "mcap");
        let mut inside: Vec<PathBuf> = entries.flatten().map(|entry| entry.path()).filter(is_recording).collect();
        if inside.is_empty() {
            return Err(BadArgument(format!("{}: no recording (.mcap) is in this folder", path.display())));
        }
        inside.sort();
        all.append(&mut inside);
    }
    Ok(all)
}

/// What an output must be for `--force` to replace it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OutputKind {
    File,
    Folder,
}

/// Something in a folder that a data set or a set of images does not have: such a folder is never replaced.
fn foreign_entry(folder: &Path) -> Option<String> {
    const FILES: [&str; 4] = ["positions.csv", "donut.json", "recording.json", "truth.csv"];
    let is_image = |path: &Path| path.is_file() && path.extension().is_some_and(|extension| extension == "jpg");
    let is_ours = |path: &Path| {
        let is_images = || {
            let Ok(mut entries) = fs::read_dir(path) else { return false };
            path.ends_with("images") && entries.all(|entry| entry.is_ok_and(|entry| is_image(&entry.path())))
        };
        is_image(path) || path.is_file() && FILES.iter().any(|name| path.ends_with(name)) || is_images()
    };
    let entries = fs::read_dir(folder).ok()?;
    let foreign = entries.flatten().map(|entry| entry.path()).find(|path| !is_ours(path))?;
    Some(foreign.file_name().unwrap_or_default().to_string_lossy().into_owned())
}

/// Refuses an output that exists, unless `force` is given and it is of the kind that will be written.
pub fn check_output(out: &Path, kind: OutputKind, force: bool) -> Result<(), BadArgument> {
    let Ok(facts) = fs::symlink_metadata(out) else { return Ok(()) };
    let is_kind = match kind {
        OutputKind::File => facts.is_file(),
        OutputKind::Folder => facts.is_dir(),
    };
    match (is_kind, force) {
        (true, true) => match foreign_entry(out) {
            Some(name) if kind == OutputKind::Folder => Err(BadArgument(format!(
                "{}: holds {name}, which is no output of this command; choose another name",
                out.display()
            ))),
            _ => Ok(()),
        },
        (true, false) => Err(BadArgument(format!("{}: exists already; give --force to replace it", out.display()))),
        (false, _) => {
            let expected = if kind == OutputKind::File { "a regular file" } else { "a folder" };
            Err(BadArgument(format!("{}: exists and is not {expected}; choose another name", out.display())))
        }
    }
}

/// `path`, which need not be there, without links and detours.
pub fn resolved(path: &Path) -> PathBuf {
    let Ok(absolute) = std::path::absolute(path) else { return path.into() };
    let mut rest = PathBuf::new();
    let mut there = absolute.as_path();
    loop {
        match (fs::canonicalize(there), there.parent(), there.file_name()) {
            (Ok(there), ..) => return if rest.as_os_str().is_empty() { there } else { there.join(rest) },
            (Err(_), Some(parent), Some(name)) => {
                rest = if rest.as_os_str().is_empty() { name.into() } else { Path::new(name).join(rest) };
                there = parent;
            }
            _ => return absolute,
        }
    }
}

/// Refuses an output that is one of the inputs, under whatever name.
pub fn check_not_input<'a>(out: &Path, inputs: impl IntoIterator<Item = &'a PathBuf>) -> Result<(), BadArgument> {
    let Ok(target) = fs::canonicalize(out) else { return Ok(()) };
    match inputs.into_iter().find(|input| fs::canonicalize(input).is_ok_and(|input| input == target)) {
        Some(input) => Err(BadArgument(format!(
            "{} is the input {}: it would be overwritten; choose another name",
            out.display(),
            input.display()
        ))),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_place_under_several_names_is_one() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let real = folder.path().join("real");
        fs::create_dir(&real).expect("a folder");
        std::os::unix::fs::symlink(&real, folder.path().join("link")).expect("a link");
        let expected = fs::canonicalize(&real).expect("it is there").join("not/yet.json");
        for name in ["real/not/yet.json", "link/not/yet.json", "real/../link/./not/yet.json"] {
            assert_eq!(resolved(&folder.path().join(name)), expected, "{name}");
        }
    }

    #[test]
    fn origins_are_read_or_refused() {
        let origin = parse_origin("40.82, -73.9").expect("two numbers");
        assert_eq!((origin.latitude_deg, origin.longitude_deg, origin.altitude_m), (40.82, -73.9, 0.0));
        assert_eq!(parse_origin("1,2,3").expect("three numbers").altitude_m, 3.0);
        for bad in ["", "1", "91,0", "0,181", "NaN,0", "1,2,3,4", "a,b", "1;2", "0,0,inf"] {
            assert!(parse_origin(bad).is_err(), "{bad}");
        }
    }
}
