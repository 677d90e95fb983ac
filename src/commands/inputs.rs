//! The files that an evaluation read, and their checksums.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context;
use sha2::{Digest, Sha256};

use super::evaluate::Args;
use super::options::{check_input, with_folders};
use crate::evaluate::InputFile;

/// Every file that `args` name; a folder stands for the recordings in it.
pub fn inputs(args: &Args) -> anyhow::Result<Vec<InputFile>> {
    let of = |role: &'static str, paths: Vec<PathBuf>| paths.into_iter().map(move |path| (role, path));
    let is_file = |split: &&String| !matches!(split.as_str(), "random" | "blocked");
    let splits = args.split.iter().filter(is_file).map(PathBuf::from).collect();
    let files = of("recording", with_folders(&args.recordings)?)
        .chain(of("map", args.map.iter().cloned().collect()))
        .chain(of("survey", with_folders(&args.survey)?))
        .chain(of("truth", args.truth.iter().cloned().collect()))
        .chain(of("split", splits));
    files
        .map(|(role, path)| {
            check_input(&path)?;
            Ok(InputFile { role, sha256: sha256_of(&path)?, file: path.display().to_string() })
        })
        .collect()
}

fn sha256_of(path: &Path) -> anyhow::Result<String> {
    let context = || format!("reading {}", path.display());
    let mut file = fs::File::open(path).with_context(context)?;
    let mut hash = Sha256::new();
    let mut buffer = vec![0; 1 << 16];
    loop {
        let read = std::io::Read::read(&mut file, &mut buffer).with_context(context)?;
        if read == 0 {
            break;
        }
        hash.update(&buffer[..read]);
    }
    Ok(hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect())
}
