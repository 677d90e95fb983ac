//! JPEG in, luma out.

mod decode;

pub use decode::{JpegError, LumaDecoder};
