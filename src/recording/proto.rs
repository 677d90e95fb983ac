//! The messages, generated from `proto/` by `build.rs`.

#![allow(clippy::all, missing_docs)]

include!(concat!(env!("OUT_DIR"), "/proto.rs"));
