//! Map files: refused or sound, never a panic; what is sound survives being written again.
#![no_main]

use libfuzzer_sys::fuzz_target;
use omniloc::map::file;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(map) = file::from_bytes(bytes) {
        assert!(file::from_bytes(&file::to_bytes(&map)).is_ok());
    }
});
