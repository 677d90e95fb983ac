//! How wide a text is: for legends, margins and labels that must not run into each other.

/// Advance widths of the characters from space to `~` in Inter Regular \[1/1000 em\].
const ADVANCES: [u16; 95] = [
    281, 278, 403, 631, 638, 812, 639, 222, 362, 362, 500, 659, 280, 460, 276, 357, 625, 464, 605, 636, 642, 608, 624,
    571, 616, 624, 276, 280, 659, 659, 659, 507, 936, 676, 651, 727, 719, 598, 587, 743, 740, 264, 543, 652, 562, 889,
    753, 761, 635, 761, 639, 638, 642, 741, 676, 949, 642, 665, 625, 362, 357, 362, 469, 452, 497, 564, 621, 558, 621,
    582, 361, 609, 591, 237, 237, 544, 237, 869, 585, 597, 609, 609, 372, 523, 364, 581, 557, 812, 540, 557, 541, 362,
    327, 362, 659,
];
/// Of any other character.
const OTHER_ADVANCE: u16 = 640;

/// Width of `text` at a font size \[px\]; bold is taken to be 5 % wider.
pub fn width_px(text: &str, size_px: f64, bold: bool) -> f64 {
    let advance = |c: char| {
        let index = (c as usize).wrapping_sub(' ' as usize);
        f64::from(ADVANCES.get(index).copied().unwrap_or(OTHER_ADVANCE))
    };
    text.chars().map(advance).sum::<f64>() * 1e-3 * size_px * if bold { 1.05 } else { 1.0 }
}

/// `text` cut to a width, with an ellipsis where something is missing.
pub fn fitted(text: &str, size_px: f64, bold: bool, room_px: f64) -> String {
    if width_px(text, size_px, bold) <= room_px {
        return text.into();
    }
    let mut kept = String::new();
    for character in text.chars() {
        let mut longer = kept.clone();
        longer.push(character);
        if width_px(&longer, size_px, bold) + size_px > room_px {
            break;
        }
        kept = longer;
    }
    kept + "…"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_texts_are_cut_to_their_room() {
        assert_eq!(fitted("short", 11.0, false, 100.0), "short");
        let cut = fitted("a very long name of a recording", 11.0, false, 80.0);
        assert!(cut.ends_with('…') && width_px(&cut, 11.0, false) <= 82.0, "{cut}");
    }
}
