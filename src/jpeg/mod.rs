//! JPEG frames: is it a whole image, how large is it, and what a webcam leaves out.

mod markers;

pub use markers::{JpegInfo, MarkerError, scan, with_huffman_tables};
