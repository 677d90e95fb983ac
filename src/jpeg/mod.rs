//! JPEG frames: is it a whole image, how large is it, what a webcam leaves out, and its luma.

// The same estimates on every computer.
#![cfg_attr(not(test), deny(clippy::disallowed_methods))]

mod baseline;
mod bits;
mod decode;
mod header;
mod huffman;
mod idct;
mod markers;
mod unstuff;

pub use decode::{JpegError, LumaDecoder, MAX_SIDE_PX};
pub use markers::{JpegInfo, MarkerError, scan, scan_header, standard_huffman_segment, with_huffman_tables};
