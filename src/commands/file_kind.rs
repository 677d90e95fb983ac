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

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn content_decides_before_the_name() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        for (name, bytes, expected) in [
            ("a.map", mcap::MAGIC, FileKind::Recording),
            ("a.mcap", b"\x10\0\0\0\0\0\0\0{}".as_slice(), FileKind::Map),
            ("b.map", b"".as_slice(), FileKind::Map),
            ("b.mcap", b"".as_slice(), FileKind::Recording),
        ] {
            let path = folder.path().join(name);
            fs::write(&path, bytes).expect("writes");
            assert_eq!(file_kind(&path).expect("readable"), expected, "{name}");
        }
    }
}
