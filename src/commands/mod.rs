//! One file a command: arguments in, exit code out.

pub mod calibrate;
pub mod frame_source;
