//! Configuration files: refused with a place, or sound; what is sound can be written down.
#![no_main]

use libfuzzer_sys::fuzz_target;
use omniloc::config::RecordConfig;

fuzz_target!(|text: &str| {
    if let Ok(config) = RecordConfig::parse(text) {
        let _ = config.resolved();
    }
});
