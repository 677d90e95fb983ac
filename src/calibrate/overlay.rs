//! A picture of the result: both rims, centre, start of the panorama and the numbers, light on ink.

use image::{Rgb, RgbImage};

use super::{DonutEstimate, Orientation, Verdict};
use crate::types::LumaImage;

const INK: [u8; 3] = [14, 17, 23];
const TEXT: [u8; 3] = [226, 230, 236];
const OUTER: [u8; 3] = [255, 176, 59];
const INNER: [u8; 3] = [92, 200, 255];
const START: [u8; 3] = [120, 230, 140];
const DOUBT: [u8; 3] = [255, 110, 100];

/// Height of a text line and margin of the strip, in px at text scale 1.
const LINE_PX: usize = 11;
const MARGIN_PX: usize = 8;
/// Half the width of the lines drawn \[px\].
const HALF_LINE_PX: f64 = 0.8;
/// How much of the frame's brightness is kept, for the lines to stand out.
const DIMMED: f64 = 0.8;

/// The frame with the circles drawn, and a strip below it with the numbers.
///
/// Amber is the outer rim, blue the inner; the green ray is column 0 of the panorama, its hook points to where the
/// columns run.
pub fn overlay(frame: &LumaImage, donut: &DonutEstimate, orientation: &Orientation) -> RgbImage {
    let scale = if frame.width_px >= 600 { 2 } else { 1 };
    let lines = legend(donut);
    let strip_px = scale * (2 * MARGIN_PX + lines.len() * LINE_PX);
    let (width, height) = (frame.width_px as u32, (frame.height_px + strip_px) as u32);
    let mut picture = RgbImage::from_pixel(width, height, Rgb(INK));
    for (y, row) in frame.pixels.chunks_exact(frame.width_px.max(1)).enumerate() {
        for (x, &luma) in row.iter().enumerate() {
            picture.put_pixel(x as u32, y as u32, Rgb([(f64::from(luma) * DIMMED) as u8; 3]));
        }
    }
    draw_marks(&mut picture, frame.height_px, donut, orientation);
    for (i, (text, color)) in lines.iter().enumerate() {
        let top = frame.height_px + scale * (MARGIN_PX + i * LINE_PX);
        draw_text(&mut picture, scale * MARGIN_PX, top, scale, text, *color);
    }
    picture
}

fn legend(donut: &DonutEstimate) -> Vec<(String, [u8; 3])> {
    let verdict = match &donut.verdict {
        Verdict::Sure => (format!("sure, confidence {:.2}, {} frames", donut.confidence, donut.frames_used), TEXT),
        Verdict::Doubtful(_) => {
            (format!("DOUBTFUL, confidence {:.2}, {} frames", donut.confidence, donut.frames_used), DOUBT)
        }
    };
    let rim = |name: &str, radius: f64, std: f64, supported: f64| {
        format!("{name} radius {radius:.1} ± {std:.1} px, seen on {:.0} %", 100.0 * supported)
    };
    vec![
        (rim("outer", donut.outer_radius_px, donut.outer_radius_std_px, donut.outer_rim.supported), OUTER),
        (rim("inner", donut.inner_radius_px, donut.inner_radius_std_px, donut.inner_rim.supported), INNER),
        (
            format!(
                "centre {:.1} ± {:.1}, {:.1} ± {:.1} px",
                donut.center_x_px, donut.center_x_std_px, donut.center_y_px, donut.center_y_std_px
            ),
            TEXT,
        ),
        ("column 0 of the panorama".into(), START),
        verdict,
    ]
}

/// Every pixel near a line is mixed with its colour by how much of it the line covers.
fn draw_marks(picture: &mut RgbImage, height_px: usize, donut: &DonutEstimate, orientation: &Orientation) {
    let (inner, outer) = (donut.inner_radius_px, donut.outer_radius_px);
    let sense = if orientation.clockwise { 1.0 } else { -1.0 };
    let (sin, cos) = libm::sincos(sense * orientation.start_angle_rad);
    let cover = |distance_px: f64| (HALF_LINE_PX + 0.5 - distance_px).clamp(0.0, 1.0);
    for y in 0..height_px {
        for x in 0..picture.width() as usize {
            let (dx, dy) = (x as f64 - donut.center_x_px, y as f64 - donut.center_y_px);
            let r = libm::hypot(dx, dy);
            // Along the start ray and across it, in the direction of the columns.
            let (along, across) = (dx * cos + dy * sin, sense * (dy * cos - dx * sin));
            let on_ray = along > inner && along < outer;
            let hook_radius = inner + 0.85 * (outer - inner);
            let on_hook = along > 0.0 && across > 0.0 && across < 0.12 * outer;
            let on_cross = dx.abs().max(dy.abs()) < 0.25 * inner;
            let marks = [
                (if on_ray { cover(across.abs()) } else { 0.0 }, START),
                (if on_hook { cover((r - hook_radius).abs()) } else { 0.0 }, START),
                (if on_cross { cover(dx.abs().min(dy.abs())) } else { 0.0 }, TEXT),
                (cover((r - inner).abs()), INNER),
                (cover((r - outer).abs()), OUTER),
            ];
            for (share, color) in marks.into_iter().filter(|mark| mark.0 > 0.0) {
                let pixel = picture.get_pixel_mut(x as u32, y as u32);
                for (old, new) in pixel.0.iter_mut().zip(color) {
                    *old = (f64::from(*old) * (1.0 - share) + f64::from(new) * share) as u8;
                }
            }
        }
    }
}

/// Letters of 5 x 7 px, one px apart; what the font lacks is left blank, what does not fit is cut off.
fn draw_text(picture: &mut RgbImage, left: usize, top: usize, scale: usize, text: &str, color: [u8; 3]) {
    for (i, letter) in text.chars().enumerate() {
        let Some((_, columns)) = FONT.iter().find(|(known, _)| *known == letter) else { continue };
        for (column, bits) in columns.iter().enumerate() {
            for row in (0..7).filter(|row| bits >> row & 1 == 1) {
                for dot in 0..scale * scale {
                    let x = left + scale * (6 * i + column) + dot % scale;
                    let y = top + scale * row + dot / scale;
                    if let Some(pixel) = picture.get_pixel_mut_checked(x as u32, y as u32) {
                        *pixel = Rgb(color);
                    }
                }
            }
        }
    }
}

/// Columns from the left, lowest bit on top: the letters the legend uses.
#[rustfmt::skip]
const FONT: &[(char, [u8; 5])] = &[
    ('0', [0x3E, 0x51, 0x49, 0x45, 0x3E]), ('1', [0x00, 0x42, 0x7F, 0x40, 0x00]), ('2', [0x42, 0x61, 0x51, 0x49, 0x46]),
    ('3', [0x21, 0x41, 0x45, 0x4B, 0x31]), ('4', [0x18, 0x14, 0x12, 0x7F, 0x10]), ('5', [0x27, 0x45, 0x45, 0x45, 0x39]),
    ('6', [0x3C, 0x4A, 0x49, 0x49, 0x30]), ('7', [0x01, 0x71, 0x09, 0x05, 0x03]), ('8', [0x36, 0x49, 0x49, 0x49, 0x36]),
    ('9', [0x06, 0x49, 0x49, 0x29, 0x1E]), ('.', [0x00, 0x60, 0x60, 0x00, 0x00]), (',', [0x00, 0x50, 0x30, 0x00, 0x00]),
    ('-', [0x08, 0x08, 0x08, 0x08, 0x08]), ('±', [0x44, 0x44, 0x5F, 0x44, 0x44]), ('%', [0x23, 0x13, 0x08, 0x64, 0x62]),
    ('a', [0x20, 0x54, 0x54, 0x54, 0x78]), ('b', [0x7F, 0x48, 0x44, 0x44, 0x38]), ('c', [0x38, 0x44, 0x44, 0x44, 0x20]),
    ('d', [0x38, 0x44, 0x44, 0x48, 0x7F]), ('e', [0x38, 0x54, 0x54, 0x54, 0x18]), ('f', [0x08, 0x7E, 0x09, 0x01, 0x02]),
    ('g', [0x0C, 0x52, 0x52, 0x52, 0x3E]), ('h', [0x7F, 0x08, 0x04, 0x04, 0x78]), ('i', [0x00, 0x44, 0x7D, 0x40, 0x00]),
    ('l', [0x00, 0x41, 0x7F, 0x40, 0x00]), ('m', [0x7C, 0x04, 0x18, 0x04, 0x78]), ('n', [0x7C, 0x08, 0x04, 0x04, 0x78]),
    ('o', [0x38, 0x44, 0x44, 0x44, 0x38]), ('p', [0x7C, 0x14, 0x14, 0x14, 0x08]), ('r', [0x7C, 0x08, 0x04, 0x04, 0x08]),
    ('s', [0x48, 0x54, 0x54, 0x54, 0x20]), ('t', [0x04, 0x3F, 0x44, 0x40, 0x20]), ('u', [0x3C, 0x40, 0x40, 0x20, 0x7C]),
    ('x', [0x44, 0x28, 0x10, 0x28, 0x44]), ('B', [0x7F, 0x49, 0x49, 0x49, 0x36]), ('D', [0x7F, 0x41, 0x41, 0x22, 0x1C]),
    ('F', [0x7F, 0x09, 0x09, 0x09, 0x01]), ('L', [0x7F, 0x40, 0x40, 0x40, 0x40]), ('O', [0x3E, 0x41, 0x41, 0x41, 0x3E]),
    ('T', [0x01, 0x01, 0x7F, 0x01, 0x01]), ('U', [0x3F, 0x40, 0x40, 0x40, 0x3F]),
];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibrate::{find_donut, synthetic::SyntheticDonut};

    #[test]
    fn the_font_has_every_letter_of_the_legend() {
        let mut donut = find_donut(&SyntheticDonut::day(1).frames(1)).expect("a donut");
        let mut lines = legend(&donut);
        donut.verdict = Verdict::Doubtful(Vec::new());
        lines.extend(legend(&donut));
        for letter in lines.iter().flat_map(|(text, _)| text.chars()).chain("0123456789-".chars()) {
            assert!(letter == ' ' || FONT.iter().any(|(known, _)| *known == letter), "{letter} is missing");
        }
    }
}
