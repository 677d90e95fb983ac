//! Colours: a palette that colour-blind readers can tell apart, and colour maps for surfaces.

/// Text and axes.
pub const INK: &str = "#1b1f24";
/// Labels that matter less.
pub const MUTED: &str = "#57606a";
/// Grid lines and frames.
pub const GRID: &str = "#dde2e8";
/// Points of the background.
pub const FAINT: &str = "#b3bac3";
pub const PAPER: &str = "#ffffff";

// Okabe & Ito, “Color Universal Design” (2008); orange a little darker, to be read on white.
pub const BLUE: &str = "#0072b2";
pub const VERMILION: &str = "#d55e00";
pub const GREEN: &str = "#009e73";
pub const ORANGE: &str = "#d98e04";
pub const PURPLE: &str = "#b2588f";
pub const SKY: &str = "#56b4e9";
pub const BLACK: &str = "#1b1f24";
// Beyond the palette: for what stands beside all of it.
pub const BROWN: &str = "#7a4419";
pub const OLIVE: &str = "#8f9a1f";

pub type Rgb = [u8; 3];

/// A colour map: 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ColorMap {
    /// From little (dark blue) to much (yellow), as bright as it is large: viridis.
    Sequential,
    /// From below (blue) over 0.5 (white) to above (brown red).
    Diverging,
    /// From nothing (white) to all (dark blue).
    Fading,
    Gray,
}

/// Viridis (Smith and van der Walt, 2015), at ninths.
const VIRIDIS: [Rgb; 9] = [
    [68, 1, 84],
    [71, 44, 122],
    [59, 81, 139],
    [44, 113, 142],
    [33, 144, 141],
    [39, 173, 129],
    [92, 200, 99],
    [170, 220, 50],
    [253, 231, 37],
];
/// RdBu of ColorBrewer (Brewer, 2003), turned so that red is above.
const RED_BLUE: [Rgb; 9] = [
    [33, 102, 172],
    [67, 147, 195],
    [146, 197, 222],
    [209, 229, 240],
    [247, 247, 247],
    [253, 219, 199],
    [244, 165, 130],
    [214, 96, 77],
    [178, 24, 43],
];
/// Blues of ColorBrewer, from white.
const BLUES: [Rgb; 9] = [
    [255, 255, 255],
    [222, 235, 247],
    [198, 219, 239],
    [158, 202, 225],
    [107, 174, 214],
    [66, 146, 198],
    [33, 113, 181],
    [8, 81, 156],
    [8, 48, 107],
];
const GRAYS: [Rgb; 2] = [[0, 0, 0], [255, 255, 255]];

impl ColorMap {
    pub fn at(self, share: f64) -> Rgb {
        let stops: &[Rgb] = match self {
            Self::Sequential => &VIRIDIS,
            Self::Diverging => &RED_BLUE,
            Self::Fading => &BLUES,
            Self::Gray => &GRAYS,
        };
        let at = if share.is_finite() { share.clamp(0.0, 1.0) } else { 0.0 } * (stops.len() - 1) as f64;
        let below = (at.floor() as usize).min(stops.len() - 2);
        let fraction = at - below as f64;
        std::array::from_fn(|i| {
            let (a, b) = (f64::from(stops[below][i]), f64::from(stops[below + 1][i]));
            (a + fraction * (b - a)).round() as u8
        })
    }
}

/// Classes of errors on a map, from small to gross: worse is warmer, and larger.
pub const ERROR_CLASSES: [ErrorClass; 5] = [
    ErrorClass { color: "#2c7fb8", radius_px: 2.6 },
    ErrorClass { color: "#41b6c4", radius_px: 2.8 },
    ErrorClass { color: "#f2b134", radius_px: 3.4 },
    ErrorClass { color: "#e2621b", radius_px: 4.2 },
    ErrorClass { color: "#a50026", radius_px: 5.0 },
];

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ErrorClass {
    pub color: &'static str,
    pub radius_px: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn maps_run_from_end_to_end_and_take_anything() {
        assert_eq!(ColorMap::Gray.at(0.5), [128; 3]);
        assert_eq!((ColorMap::Sequential.at(-1.0), ColorMap::Sequential.at(2.0)), (VIRIDIS[0], VIRIDIS[8]));
        assert_eq!(ColorMap::Diverging.at(f64::NAN), RED_BLUE[0]);
    }

    /// Surfaces are also printed in gray: the sequential map must rise in brightness.
    #[test]
    fn the_sequential_map_rises_in_brightness() {
        let luma = |c: Rgb| 0.2126 * f64::from(c[0]) + 0.7152 * f64::from(c[1]) + 0.0722 * f64::from(c[2]);
        let values: Vec<f64> = (0..=40).map(|i| luma(ColorMap::Sequential.at(f64::from(i) / 40.0))).collect();
        assert!(values.is_sorted(), "{values:?}");
    }
}
