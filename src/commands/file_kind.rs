//! Is a file a recording or a map? By its content; by its name only if the content does not tell.

use std::{
    fs::File,
    io::{self, Read},
    path::Path,
};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FileKind {
    Recording,
    Map,
}

/// A map is a safetensors file: the header's length (8 bytes, little-endian), then the header, a JSON object.
pub fn file_kind(path: &Path) -> io::Result<FileKind> {
    const START_BYTES: u64 = 9;
    let mut start = Vec::new();
    File::open(path)?.take(START_BYTES).read_to_end(&mut start)?;
    let named_map = path.extension().is_some_and(|extension| extension == "map");
    Ok(match start.get(..mcap::MAGIC.len()) {
        Some(magic) if magic == mcap::MAGIC => FileKind::Recording,
        _ if named_map || start.get(8) == Some(&b'{') => FileKind::Map,
        _ => FileKind::Recording,
    })
}
