//! What a place wears on a day: leaves of the season, and daylight in its window panes.

use std::sync::Arc;

use rand::Rng;

use super::{
    Day, Season, World,
    paint::BARK,
    random::{Stream, fractal, stream},
    texture::{CLEAR, Color, mix, rgb, tinted},
    traffic::Textures,
};

/// Makes the place's own textures, which `textures` begins with, those of the day.
pub(super) fn dress(world: &World, day: &Day, textures: &mut Textures) {
    for &tree in &world.trees {
        if day.season != Season::Summer {
            let texture = &mut textures[usize::from(tree)];
            let leaf = |column: usize, row: usize, leaf: Color| in_season(day.season, [column, row], tree, leaf);
            *texture = Arc::new(texture.recolored(leaf));
        }
    }
    let mut random = stream(day.seed, Stream::Dress);
    // From late evening to full daylight.
    let outside: f32 = random.random_range(0.15..1.1);
    for &pane in &world.panes {
        let texture = &mut textures[usize::from(pane)];
        *texture = Arc::new(texture.recolored(|_, _, color| tinted(color, outside)));
    }
}

/// A texel of a tree that was painted for summer.
fn in_season(season: Season, [column, row]: [usize; 2], tree: u16, summer: Color) -> Color {
    if summer == CLEAR || summer == BARK {
        return summer;
    }
    let noise = |scale: f32, seed: u32| fractal(scale * column as f32, scale * row as f32, seed ^ u32::from(tree));
    match season {
        Season::Summer => summer,
        // Branches are where smooth noise crosses its mean; everything else has fallen.
        Season::Winter => {
            let branch = (noise(0.12, 3) - 0.5).abs() < 0.035;
            if branch { tinted(BARK, 0.8 + 0.6 * noise(0.3, 4)) } else { CLEAR }
        }
        // Thin and bright.
        Season::Spring => {
            if noise(0.35, 5) > 0.6 {
                CLEAR
            } else {
                mix(summer, rgb(150, 176, 88), 110)
            }
        }
        Season::Autumn => {
            if noise(0.35, 6) > 0.64 {
                CLEAR
            } else {
                mix(summer, rgb(190, 116, 40), 150)
            }
        }
    }
}
