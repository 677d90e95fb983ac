//! The fuzz targets on all inputs that are kept: those they start from, and those that once showed something.
//!
//! `tests/soak fuzz` goes on from them with inputs of its own.

#[path = "../fuzz/bodies.rs"]
mod bodies;

use std::{fs, path::Path};

#[test]
fn every_kept_input_holds() {
    for (name, target) in bodies::ALL {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/inputs").join(name);
        let inputs: Vec<_> =
            fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("entry").path()).collect();
        assert!(!inputs.is_empty(), "{name} starts from nothing");
        for input in inputs {
            println!("{}", input.display());
            target(&fs::read(&input).expect("readable"));
        }
    }
}
