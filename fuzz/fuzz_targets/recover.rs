//! Recovery of any bytes: no panic, bounded memory, and what it writes is a whole recording.
#![no_main]

use libfuzzer_sys::fuzz_target;
use omniloc::recording::{recover::recover_bytes, verify};

fuzz_target!(|bytes: &[u8]| {
    let Some((recovery, out)) = recover_bytes(bytes) else { return };
    let file = tempfile::NamedTempFile::new().expect("a temporary file");
    std::fs::write(file.path(), &out).expect("writes");
    let verdict = verify(file.path()).expect("readable");
    assert_eq!((verdict.is_complete, verdict.messages), (true, recovery.messages), "{:?}", verdict.problems);
});
