//! Drawing charts: shapes, axes, colours, and pictures of them.
//!
//! A [`Plot`](plot::Plot) becomes a [`Panel`](plot::Panel), about as wide as a telephone; figures are rows of panels, so
//! that a page can break them and letters stay as large as they are. The same shapes are the SVG in the page, the SVG
//! file and the PNG.

pub mod color;
pub mod map_plot;
pub mod picture;
pub mod plot;
pub mod scale;
pub mod svg;
pub mod text;
