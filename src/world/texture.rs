//! Textures: packed colours, filtered ahead for every distance.

/// Red, green, blue and opacity, 8 bits each from the lowest byte up.
pub(super) type Color = u32;

const PAIR: u32 = 0x00FF_00FF;

pub(super) const fn rgb(red: u8, green: u8, blue: u8) -> Color {
    u32::from_le_bytes([red, green, blue, 255])
}

pub(super) const CLEAR: Color = 0;

/// `a` at weight 0, `b` at weight 256: two bytes at a time.
#[inline(always)]
pub(super) fn mix(a: Color, b: Color, weight: u32) -> Color {
    let keep = 256 - weight;
    let even = (((a & PAIR) * keep + (b & PAIR) * weight) >> 8) & PAIR;
    let odd = (((a >> 8) & PAIR) * keep + ((b >> 8) & PAIR) * weight) & !PAIR;
    even | odd
}

/// All four bytes times `light` / 256, which must be at most 256.
#[inline(always)]
pub(super) fn dim(color: Color, light: u32) -> Color {
    let even = (((color & PAIR) * light) >> 8) & PAIR;
    let odd = (((color >> 8) & PAIR) * light) & !PAIR;
    even | odd
}

/// Red, green and blue times `factor`, opacity kept.
pub(super) fn tinted(color: Color, factor: f32) -> Color {
    let [r, g, b, a] = color.to_le_bytes();
    let scale = |channel: u8| (f32::from(channel) * factor).clamp(0.0, 255.0) as u8;
    u32::from_le_bytes([scale(r), scale(g), scale(b), a])
}

/// A picture on a plane, finest level first, each level half as fine as the one before.
#[derive(Debug, Clone)]
pub(super) struct Texture {
    pub texels_per_m: f32,
    levels: Vec<Level>,
}

/// Texels column by column, so that one column of the image walks along memory.
#[derive(Debug, Clone)]
pub(super) struct Level {
    pub columns: usize,
    pub rows: usize,
    pub texels: Vec<Color>,
}

impl Texture {
    /// Takes `texels` column by column.
    pub fn new(columns: usize, rows: usize, texels: Vec<Color>, texels_per_m: f32) -> Self {
        Self::unfiltered(columns, rows, texels, texels_per_m).refilter()
    }

    /// Without the coarser levels: for what is changed before it is shown.
    pub fn unfiltered(columns: usize, rows: usize, texels: Vec<Color>, texels_per_m: f32) -> Self {
        assert_eq!(texels.len(), columns * rows, "one colour a texel");
        Self { texels_per_m, levels: vec![Level { columns, rows, texels }] }
    }

    /// The level whose texels are as large as `footprint_m`, and its texels per metre.
    #[inline]
    pub fn level(&self, footprint_m: f32) -> (&Level, f32) {
        let texels = (footprint_m * self.texels_per_m).max(1.0);
        // The exponent of the number is its logarithm, rounded down.
        let exponent = (texels * 1.414).to_bits() >> 23;
        let index = (exponent as usize).saturating_sub(127).min(self.levels.len() - 1);
        (&self.levels[index], self.texels_per_m / (1 << index) as f32)
    }

    pub fn finest_mut(&mut self) -> &mut Level {
        &mut self.levels[0]
    }

    /// With another colour for every texel: `color(column, row, before)`.
    pub fn recolored(&self, color: impl Fn(usize, usize, Color) -> Color) -> Self {
        let Level { columns, rows, texels } = &self.levels[0];
        let texels = texels.iter().enumerate().map(|(i, &before)| color(i / rows, i % rows, before)).collect();
        Self::new(*columns, *rows, texels, self.texels_per_m)
    }

    /// Makes the coarser levels anew after the finest was changed.
    pub fn refilter(mut self) -> Self {
        self.levels.truncate(1);
        while let Some(coarser) = self.levels.last().and_then(Level::halved) {
            self.levels.push(coarser);
        }
        self
    }
}

impl Level {
    #[inline]
    pub fn column(&self, column: usize) -> &[Color] {
        &self.texels[column * self.rows..(column + 1) * self.rows]
    }

    /// Between the four texels around (`u`, `v`), in texels; the border is repeated.
    #[inline(always)]
    pub fn bilinear(&self, u: f32, v: f32) -> Color {
        let u = (u - 0.5).clamp(0.0, (self.columns - 1) as f32);
        let v = (v - 0.5).clamp(0.0, (self.rows - 1) as f32);
        let (i, j) = (u as usize, v as usize);
        let (wu, wv) = (((u - i as f32) * 256.0) as u32, ((v - j as f32) * 256.0) as u32);
        let right = (i + 1).min(self.columns - 1) * self.rows;
        let (left, below) = (i * self.rows, (j + 1).min(self.rows - 1));
        let upper = mix(self.texels[left + j], self.texels[right + j], wu);
        let lower = mix(self.texels[left + below], self.texels[right + below], wu);
        mix(upper, lower, wv)
    }

    fn halved(&self) -> Option<Self> {
        if self.columns.max(self.rows) == 1 {
            return None;
        }
        let (columns, rows) = (self.columns.div_ceil(2), self.rows.div_ceil(2));
        let mut texels = Vec::with_capacity(columns * rows);
        for i in 0..columns {
            for j in 0..rows {
                let (right, below) = ((2 * i + 1).min(self.columns - 1), (2 * j + 1).min(self.rows - 1));
                let four = [(2 * i, 2 * j), (right, 2 * j), (2 * i, below), (right, below)];
                texels.push(average(four.map(|(i, j)| self.texels[i * self.rows + j])));
            }
        }
        Some(Self { columns, rows, texels })
    }
}

/// The mean of four colours, each as heavy as it is opaque.
fn average(colors: [Color; 4]) -> Color {
    let mut sums = [0_u32; 4];
    for color in colors {
        let [r, g, b, a] = color.to_le_bytes().map(u32::from);
        sums[0] += r * a;
        sums[1] += g * a;
        sums[2] += b * a;
        sums[3] += a;
    }
    let [r, g, b, a] = sums;
    if a == 0 {
        return CLEAR;
    }
    u32::from_le_bytes([(r / a) as u8, (g / a) as u8, (b / a) as u8, (a / 4) as u8])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mixing_and_dimming_act_on_every_channel() {
        let (a, b) = (u32::from_le_bytes([0, 255, 100, 8]), u32::from_le_bytes([255, 0, 200, 16]));
        assert_eq!(mix(a, b, 0), a);
        assert_eq!(mix(a, b, 256), b);
        assert_eq!(mix(a, b, 128).to_le_bytes(), [127, 127, 150, 12]);
        assert_eq!(dim(b, 256), b);
        assert_eq!(dim(a, 128).to_le_bytes(), [0, 127, 50, 4]);
    }

    #[test]
    fn coarser_levels_keep_the_mean_and_weigh_by_opacity() {
        let texels = vec![rgb(200, 0, 0), CLEAR, CLEAR, CLEAR];
        let texture = Texture::new(2, 2, texels, 10.0);
        let (level, per_m) = texture.level(0.2);
        assert_eq!((level.columns, level.rows, per_m), (1, 1, 5.0));
        assert_eq!(level.texels[0].to_le_bytes(), [200, 0, 0, 63]);
    }

    #[test]
    fn the_level_follows_the_footprint() {
        let texture = Texture::new(64, 64, vec![0; 64 * 64], 10.0);
        for (footprint_m, columns) in [(0.001, 64), (0.1, 64), (0.2, 32), (0.4, 16), (100.0, 1)] {
            assert_eq!(texture.level(footprint_m).0.columns, columns, "{footprint_m} m");
        }
    }
}
