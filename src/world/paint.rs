//! Paints facades, doors, cars and trees texel by texel.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::{
    random::{fractal, white},
    texture::{CLEAR, Color, Texture, rgb, tinted},
};

/// A picture in the making: metres from its lower left corner.
#[derive(Debug, Clone)]
pub(super) struct Canvas {
    columns: usize,
    rows: usize,
    texels_per_m: f32,
    texels: Vec<Color>,
}

impl Canvas {
    pub fn new(width_m: f32, height_m: f32, texels_per_m: f32, color: Color) -> Self {
        let texels = |length_m: f32| ((length_m * texels_per_m).round() as usize).max(1);
        let (columns, rows) = (texels(width_m), texels(height_m));
        Self { columns, rows, texels_per_m, texels: vec![color; columns * rows] }
    }

    pub fn into_texture(self) -> Texture {
        Texture::new(self.columns, self.rows, self.texels, self.texels_per_m)
    }

    /// Gives every texel its colour: `color(x_m, y_m, before)` with the place of its centre.
    pub fn fill(&mut self, color: impl Fn(f32, f32, Color) -> Color) {
        let per_m = self.texels_per_m;
        for (column, texels) in self.texels.chunks_exact_mut(self.rows).enumerate() {
            for (row, texel) in texels.iter_mut().enumerate() {
                let y_m = (self.rows - row) as f32 / per_m - 0.5 / per_m;
                *texel = color((column as f32 + 0.5) / per_m, y_m, *texel);
            }
        }
    }

    pub fn rect(&mut self, [left_m, bottom_m]: [f32; 2], [width_m, height_m]: [f32; 2], color: Color) {
        let texel = |length_m: f32, end: usize| ((length_m * self.texels_per_m).round().max(0.0) as usize).min(end);
        let (left, right) = (texel(left_m, self.columns), texel(left_m + width_m, self.columns));
        let (bottom, top) = (texel(bottom_m, self.rows), texel(bottom_m + height_m, self.rows));
        for column in left..right {
            self.texels[column * self.rows..][self.rows - top..self.rows - bottom].fill(color);
        }
    }

    pub fn ellipse(&mut self, [x_m, y_m]: [f32; 2], [half_width_m, half_height_m]: [f32; 2], color: Color) {
        self.fill(|x, y, before| {
            let (dx, dy) = ((x - x_m) / half_width_m, (y - y_m) / half_height_m);
            if dx * dx + dy * dy < 1.0 { color } else { before }
        });
    }

    /// Stains of `scale_m` and grain of one texel, each as a share of the brightness.
    pub fn weather(&mut self, seed: u32, scale_m: f32, stains: f32, grain: f32) {
        let per_m = self.texels_per_m;
        self.fill(|x, y, before| {
            let stain = stains * (fractal(x / scale_m, y / scale_m, seed) - 0.5);
            let speck = grain * (white((x * per_m) as i32, (y * per_m) as i32, seed ^ 0x5bd1) - 0.5);
            tinted(before, 1.0 + 2.0 * stain + 2.0 * speck)
        });
    }
}

/// One of `choices`.
pub(super) fn pick<T: Copy>(random: &mut ChaCha8Rng, choices: &[T]) -> T {
    choices[random.random_range(0..choices.len())]
}

/// A colour near `color`: every channel up to a fifth brighter or darker.
pub(super) fn vary(random: &mut ChaCha8Rng, color: Color) -> Color {
    let [r, g, b, a] = color.to_le_bytes();
    let mut vary = |channel: u8| (f32::from(channel) * random.random_range(0.82..1.2)).min(255.0) as u8;
    u32::from_le_bytes([vary(r), vary(g), vary(b), a])
}

/// A colour as signs, doors and cars have it.
pub(super) fn bright(random: &mut ChaCha8Rng) -> Color {
    let color = pick(
        random,
        &[
            rgb(170, 40, 36),
            rgb(30, 70, 130),
            rgb(30, 110, 70),
            rgb(210, 160, 40),
            rgb(90, 45, 100),
            rgb(200, 95, 35),
            rgb(40, 130, 150),
            rgb(225, 225, 220),
            rgb(45, 45, 50),
        ],
    );
    vary(random, color)
}

const WALLS: [Color; 9] = [
    rgb(150, 80, 62),
    rgb(196, 182, 150),
    rgb(205, 200, 192),
    rgb(172, 128, 84),
    rgb(120, 62, 52),
    rgb(140, 144, 148),
    rgb(178, 160, 128),
    rgb(146, 160, 140),
    rgb(190, 150, 120),
];

/// Texels of facades: finer than the lens resolves from a lane.
const FACADE_TEXELS_PER_M: f32 = 10.0;

/// How one house looks; its sides share it.
#[derive(Debug, Clone)]
pub(super) struct HouseStyle {
    wall: Color,
    frame: Color,
    glass: Color,
    bricks: bool,
    floor_m: f32,
    window_m: [f32; 2],
    spacing_m: f32,
    cornice: bool,
    shutters: Option<Color>,
    seed: u32,
}

impl HouseStyle {
    pub fn random(random: &mut ChaCha8Rng) -> Self {
        let wall = pick(random, &WALLS);
        let window_width_m = random.random_range(0.8..1.9);
        Self {
            wall: vary(random, wall),
            frame: pick(random, &[rgb(232, 230, 224), rgb(70, 66, 60), rgb(205, 196, 175), rgb(90, 100, 90)]),
            glass: pick(random, &[rgb(38, 46, 56), rgb(56, 62, 66), rgb(70, 84, 98), rgb(28, 30, 34)]),
            bricks: random.random_bool(0.4),
            floor_m: random.random_range(2.7..3.5),
            window_m: [window_width_m, random.random_range(1.2..1.9)],
            spacing_m: window_width_m + random.random_range(0.7..2.4),
            cornice: random.random_bool(0.6),
            shutters: random.random_bool(0.3).then(|| bright(random)),
            seed: random.random(),
        }
    }

    pub fn roof(&self) -> Color {
        tinted(self.wall, 0.6)
    }

    fn wall(&self, width_m: f32, height_m: f32) -> Canvas {
        let mut canvas = Canvas::new(width_m, height_m, FACADE_TEXELS_PER_M, self.wall);
        canvas.weather(self.seed, 2.5, 0.16, 0.05);
        if self.bricks {
            canvas.fill(|x, y, before| {
                let course = (y / 0.3) as i32;
                let brick = ((x + 0.3 * (course & 1) as f32) / 0.6) as i32;
                tinted(before, 0.86 + 0.24 * white(brick, course, self.seed ^ 0xB1))
            });
        }
        // Splashed from below, washed out above.
        canvas.fill(|_, y, before| tinted(before, 0.84 + 0.16 * (y / 1.5).min(1.0)));
        if self.cornice {
            canvas.rect([0.0, height_m - 0.5], [width_m, 0.5], tinted(self.frame, 0.85));
            canvas.rect([0.0, height_m - 0.7], [width_m, 0.2], tinted(self.wall, 0.55));
        }
        canvas
    }

    fn window(&self, canvas: &mut Canvas, left_m: f32, bottom_m: f32, random: &mut ChaCha8Rng) {
        let [width_m, height_m] = self.window_m;
        if let Some(shutters) = self.shutters {
            canvas.rect([left_m - 0.45, bottom_m], [width_m + 0.9, height_m], shutters);
        }
        canvas.rect([left_m - 0.12, bottom_m - 0.15], [width_m + 0.24, height_m + 0.27], self.frame);
        let glass = tinted(self.glass, random.random_range(0.7..1.5));
        canvas.rect([left_m, bottom_m], [width_m, height_m], glass);
        if random.random_bool(0.45) {
            // A curtain or a blind.
            let drawn_m = height_m * random.random_range(0.2..0.8);
            let cloth = tinted(rgb(190, 184, 170), random.random_range(0.6..1.1));
            canvas.rect([left_m, bottom_m + height_m - drawn_m], [width_m, drawn_m], cloth);
        }
        canvas.rect([left_m + 0.5 * width_m - 0.05, bottom_m], [0.1, height_m], self.frame);
    }

    fn windows(
        &self,
        canvas: &mut Canvas,
        [width_m, height_m]: [f32; 2],
        from_m: f32,
        share: f64,
        random: &mut ChaCha8Rng,
    ) {
        let count = ((width_m - 0.8) / self.spacing_m).floor().max(0.0);
        let margin_m = 0.5 * (width_m - count * self.spacing_m + self.spacing_m - self.window_m[0]);
        let mut floor_m = from_m;
        while floor_m + self.floor_m < height_m + 0.6 {
            let bottom_m = floor_m + 0.75;
            for i in 0..count as usize {
                if random.random_bool(share) && bottom_m + self.window_m[1] < height_m - 0.8 {
                    self.window(canvas, margin_m + i as f32 * self.spacing_m, bottom_m, random);
                }
            }
            floor_m += self.floor_m;
        }
    }

    /// The side towards the street: a shop or a door below, windows above.
    pub fn front(&self, width_m: f32, height_m: f32, random: &mut ChaCha8Rng) -> Texture {
        let mut canvas = self.wall(width_m, height_m);
        let shop = random.random_bool(0.5) && height_m > 4.5;
        if shop {
            self.shop(&mut canvas, width_m, random);
            self.windows(&mut canvas, [width_m, height_m], 3.9, 0.96, random);
        } else {
            self.windows(&mut canvas, [width_m, height_m], 0.4, 0.94, random);
            self.door(&mut canvas, random.random_range(0.6..(width_m - 1.8).max(0.7)), random);
            if random.random_bool(0.4) {
                let (left_m, gate) = (random.random_range(0.3..(width_m - 3.0).max(0.4)), bright(random));
                canvas.rect([left_m, 0.0], [2.6, 2.4], tinted(gate, 0.7));
                (1..4).for_each(|i| canvas.rect([left_m, 0.6 * i as f32], [2.6, 0.1], tinted(gate, 0.5)));
            }
        }
        canvas.into_texture()
    }

    fn door(&self, canvas: &mut Canvas, left_m: f32, random: &mut ChaCha8Rng) {
        let leaf = bright(random);
        canvas.rect([left_m - 0.25, 0.0], [1.5, 2.75], self.frame);
        canvas.rect([left_m, 0.0], [1.0, 2.1], tinted(leaf, 0.75));
        canvas.rect([left_m + 0.2, 1.1], [0.6, 0.8], tinted(leaf, 0.5));
        canvas.rect([left_m, 2.2], [1.0, 0.4], self.glass);
    }

    fn shop(&self, canvas: &mut Canvas, width_m: f32, random: &mut ChaCha8Rng) {
        let (sign, letters, front) = (bright(random), bright(random), bright(random));
        canvas.rect([0.2, 0.0], [width_m - 0.4, 3.0], tinted(front, 0.55));
        let mut left_m = 0.5;
        while left_m + 1.4 < width_m {
            let pane_m = random.random_range(1.2_f32..3.0).min(width_m - 0.5 - left_m);
            if random.random_bool(0.25) {
                canvas.rect([left_m, 0.0], [1.1, 2.4], tinted(front, 0.9));
                canvas.rect([left_m + 0.15, 0.5], [0.8, 1.7], self.glass);
                left_m += 1.4;
                continue;
            }
            canvas.rect([left_m, 0.5], [pane_m, 2.2], tinted(self.glass, 1.2));
            for _ in 0..random.random_range(2..6) {
                // Goods in the window.
                let at = [left_m + random.random_range(0.0..pane_m * 0.8), 0.5 + random.random_range(0.0..0.6)];
                let size = [random.random_range(0.2..0.6), random.random_range(0.3..1.1)];
                canvas.rect(at, size, bright(random));
            }
            left_m += pane_m + 0.25;
        }
        canvas.rect([0.2, 3.0], [width_m - 0.4, 0.75], sign);
        let name_m = width_m * random.random_range(0.35..0.8);
        let mut at_m = 0.5 * (width_m - name_m);
        while at_m < 0.5 * (width_m + name_m) {
            let stroke_m = pick(random, &[0.1, 0.2, 0.3]);
            canvas.rect([at_m, 3.12 + random.random_range(0.0..0.2)], [stroke_m, 0.36], letters);
            at_m += stroke_m + pick(random, &[0.1, 0.1, 0.2, 0.4]);
        }
    }

    /// A side towards the neighbours.
    pub fn flank(&self, width_m: f32, height_m: f32, random: &mut ChaCha8Rng) -> Texture {
        let mut canvas = self.wall(width_m, height_m);
        self.windows(&mut canvas, [width_m, height_m], 0.4, 0.55, random);
        canvas.into_texture()
    }
}

/// A picture or a notice: a frame of this width, a ground, and shapes on it.
pub(super) fn board(
    canvas: &mut Canvas,
    [left_m, bottom_m]: [f32; 2],
    [width_m, height_m]: [f32; 2],
    frame_m: f32,
    random: &mut ChaCha8Rng,
) {
    canvas.rect([left_m, bottom_m], [width_m, height_m], tinted(bright(random), 0.6));
    let inner_m = [width_m - 2.0 * frame_m, height_m - 2.0 * frame_m];
    canvas.rect([left_m + frame_m, bottom_m + frame_m], inner_m, bright(random));
    for _ in 0..random.random_range(2..7) {
        let part = [random.random_range(0.1..0.6), random.random_range(0.08..0.4)];
        let at = [random.random_range(0.05..0.9 - part[0]), random.random_range(0.05..0.9 - part[1])];
        let corner = [left_m + at[0] * width_m, bottom_m + at[1] * height_m];
        canvas.rect(corner, [part[0] * width_m, part[1] * height_m], bright(random));
    }
}

pub(super) const BARK: Color = rgb(74, 60, 48);

/// The crown and trunk of a tree, in a square of `size_m`.
pub(super) fn tree(random: &mut ChaCha8Rng, size_m: f32) -> Texture {
    let seed: u32 = random.random();
    let leaves =
        pick(random, &[rgb(62, 92, 40), rgb(84, 108, 48), rgb(52, 80, 52), rgb(130, 100, 42), rgb(96, 62, 40)]);
    let slim = random.random_range(0.7..1.0);
    let mut canvas = Canvas::new(size_m, size_m, 12.0, CLEAR);
    let middle_m = 0.5 * size_m;
    canvas.rect([middle_m - 0.14, 0.0], [0.28, 0.5 * size_m], BARK);
    canvas.fill(|x, y, before| {
        let (dx, dy) = ((x - middle_m) / (0.42 * size_m * slim), (y - 0.62 * size_m) / (0.34 * size_m));
        let edge = 1.15 - 0.75 * fractal(x * 1.6, y * 1.6, seed);
        let gap = fractal(x * 3.0, y * 3.0, seed ^ 7) > 0.68;
        if dx * dx + dy * dy < edge * edge && !gap {
            tinted(leaves, 0.55 + 0.75 * fractal(x * 2.5, y * 2.5, seed ^ 3) + 0.15 * dy)
        } else {
            before
        }
    });
    canvas.into_texture()
}

/// A pole of `height_m` with something on top, in a strip of `width_m`.
pub(super) fn pole(random: &mut ChaCha8Rng, width_m: f32, height_m: f32) -> Texture {
    let mut canvas = Canvas::new(width_m, height_m, 20.0, CLEAR);
    let gray = tinted(rgb(120, 122, 124), random.random_range(0.5..1.2));
    canvas.rect([0.5 * width_m - 0.08, 0.0], [0.16, height_m - 0.05], gray);
    if height_m > 4.0 {
        canvas.rect([0.05, height_m - 0.35], [width_m - 0.1, 0.25], tinted(gray, 0.8));
    } else {
        let (face, plate) = (bright(random), 0.5 * width_m - 0.05);
        canvas.ellipse([0.5 * width_m, height_m - plate - 0.05], [plate, plate], face);
        canvas.rect([0.3 * width_m, height_m - plate - 0.12], [0.4 * width_m, 0.14], rgb(235, 235, 235));
    }
    canvas.into_texture()
}

pub(super) const PERSON_M: [f32; 2] = [0.8, 1.85];

pub(super) fn person(random: &mut ChaCha8Rng) -> Texture {
    let mut canvas = Canvas::new(PERSON_M[0], PERSON_M[1], 40.0, CLEAR);
    let (coat, trousers) = (bright(random), tinted(bright(random), 0.6));
    canvas.rect([0.24, 0.0], [0.14, 0.85], trousers);
    canvas.rect([0.43, 0.0], [0.14, 0.85], trousers);
    canvas.ellipse([0.4, 1.15], [0.27, 0.42], coat);
    canvas.ellipse([0.4, 1.67], [0.11, 0.14], rgb(196, 150, 122));
    canvas.into_texture()
}

/// The side of a car's body: paint, wheels, and darkness below.
pub(super) fn car_body(paint: Color, length_m: f32, height_m: f32) -> Texture {
    let mut canvas = Canvas::new(length_m, height_m, 16.0, paint);
    canvas.fill(|_, y, before| tinted(before, 0.75 + 0.4 * y / height_m));
    canvas.rect([0.0, 0.0], [length_m, 0.22], rgb(24, 24, 25));
    for x_m in [0.19 * length_m, 0.81 * length_m] {
        canvas.ellipse([x_m, 0.32], [0.34, 0.32], rgb(22, 22, 23));
        canvas.ellipse([x_m, 0.32], [0.17, 0.16], rgb(140, 142, 145));
    }
    canvas.rect([0.5 * length_m, 0.3], [0.07, height_m], tinted(paint, 0.5));
    canvas.into_texture()
}

/// Front or back of a car's body, with lamps.
pub(super) fn car_end(paint: Color, width_m: f32, height_m: f32, lamps: Color) -> Texture {
    let mut canvas = Canvas::new(width_m, height_m, 16.0, paint);
    canvas.rect([0.0, 0.0], [width_m, 0.22], rgb(24, 24, 25));
    canvas.rect([0.5 * width_m - 0.3, 0.32], [0.6, 0.16], rgb(225, 225, 210));
    [0.1, width_m - 0.45].into_iter().for_each(|x_m| canvas.rect([x_m, 0.52], [0.35, 0.16], lamps));
    canvas.into_texture()
}

/// Windows between pillars.
pub(super) fn car_cabin(paint: Color, length_m: f32, height_m: f32) -> Texture {
    let mut canvas = Canvas::new(length_m, height_m, 16.0, rgb(34, 40, 46));
    for x_m in [0.0, 0.48 * length_m, length_m - 0.12] {
        canvas.rect([x_m, 0.0], [0.12, height_m], paint);
    }
    canvas.rect([0.0, height_m - 0.1], [length_m, 0.1], paint);
    canvas.into_texture()
}
