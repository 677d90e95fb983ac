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

/// A map of an earlier format is refused at its version, and nothing behind that is tried.
#[test]
fn the_kept_map_is_one_of_the_present_format() {
    let input = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/inputs/map/sp-of-a-corridor");
    omniloc::map::file::from_bytes(&fs::read(input).expect("readable")).expect(
        "make it anew: simulate a corridor of 12 frames of 320x240, train --recipe paper --features sp --select none",
    );
}
