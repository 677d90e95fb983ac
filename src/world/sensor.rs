//! From the panorama to the JPEG of a camera: the donut, noise, encoding.

use jpeg_encoder::{Encoder, ImageBuffer, JpegColorType, SamplingFactor};
use multiversion::multiversion;
use rand::Rng;

use super::{
    Camera,
    random::{Stream, standard_normal, stream},
    render::{PANORAMA_COLUMNS, PANORAMA_ROWS, Planes},
};

/// Numbers of noise that are drawn once and used again from another place in every row.
const NOISE_VALUES: usize = 1 << 16;

/// Where a pixel of the donut looks.
#[derive(Debug, Clone, Copy, Default)]
struct Sample {
    /// Of the panorama's cell up and to the left, in planes that go column by column.
    index: u32,
    /// Weights of the cells to the right and below, of 256.
    right: u8,
    below: u8,
    /// Light that arrives, of 256, and what is added to it.
    light: u8,
    lift: u8,
}

/// Pixels side by side that lie in the donut.
#[derive(Debug, Clone, Copy)]
struct Run {
    y: usize,
    first_x: usize,
    /// In the table of samples.
    samples: (usize, usize),
}

/// One plane of the picture.
#[derive(Debug, Clone)]
struct Table {
    runs: Vec<Run>,
    samples: Vec<Sample>,
}

impl Table {
    /// For a plane of `columns` × `rows`, each of whose cells spans `step` pixels; the panorama's planes have
    /// `panorama_rows` rows and are coarser than the panorama by `coarser`.
    fn build(camera: &Camera, [columns, rows]: [usize; 2], step: [usize; 2], coarser: usize) -> Self {
        let panorama_rows = PANORAMA_ROWS / coarser;
        let (mut runs, mut samples) = (Vec::new(), Vec::new());
        for y in 0..rows {
            let mut open = false;
            for x in 0..columns {
                let center = |at: usize, step: usize| (at * step) as f64 + 0.5 * (step as f64 - 1.0);
                let Some(look) = camera.look(center(x, step[0]), center(y, step[1])) else {
                    open = false;
                    continue;
                };
                if !open {
                    runs.push(Run { y, first_x: x, samples: (samples.len(), samples.len()) });
                    open = true;
                }
                let cell = |at: f64| (at + 0.5) / coarser as f64 - 0.5;
                let column = cell(look.column).rem_euclid((PANORAMA_COLUMNS / coarser) as f64);
                let row = cell(look.row).clamp(0.0, panorama_rows as f64 - 1.001);
                let (left, above) = (column.floor(), row.floor());
                let lift = (1.0 - look.shows) * f64::from(camera.surround);
                samples.push(Sample {
                    index: (left as usize * panorama_rows + above as usize) as u32,
                    right: ((column - left) * 255.0) as u8,
                    below: ((row - above) * 255.0) as u8,
                    light: (look.shows * look.light * 255.0).round() as u8,
                    lift: lift.round() as u8,
                });
                let end = samples.len();
                runs.last_mut().expect("a run is open").samples.1 = end;
            }
        }
        Self { runs, samples }
    }
}

/// What happens behind the lens; holds all buffers, so that a frame allocates next to nothing.
#[derive(Debug, Clone)]
pub(super) struct Sensor {
    width_px: usize,
    height_px: usize,
    surround: u8,
    quality: u8,
    luma_table: Table,
    chroma_table: Table,
    noise: Vec<i8>,
    luma: Vec<u8>,
    /// Blue and red difference: 4:2:2, in the even columns of a full plane, which are those that the encoder reads.
    chroma: [Vec<u8>; 2],
}

/// No colour.
const NEUTRAL: u8 = 128;

impl Sensor {
    pub fn new(camera: &Camera) -> Self {
        let (width_px, height_px) = (camera.width_px, camera.height_px);
        let pixels = width_px * height_px;
        let mut random = stream(0, Stream::Lens);
        let noise = (0..NOISE_VALUES + width_px)
            .map(|_| (camera.noise * standard_normal(&mut random)).round().clamp(-127.0, 127.0) as i8)
            .collect();
        Self {
            width_px,
            height_px,
            surround: camera.surround,
            quality: camera.quality,
            luma_table: Table::build(camera, [width_px, height_px], [1, 1], 1),
            chroma_table: Table::build(camera, [width_px.div_ceil(2), height_px], [2, 1], 2),
            noise,
            luma: vec![camera.surround; pixels],
            chroma: [vec![NEUTRAL; pixels], vec![NEUTRAL; pixels]],
        }
    }

    /// Takes the picture; `frame` chooses the noise.
    pub fn expose(&mut self, panorama: &Planes, frame: u64) {
        self.luma.fill(self.surround);
        let panorama_rows = PANORAMA_ROWS;
        for run in &self.luma_table.runs {
            let samples = &self.luma_table.samples[run.samples.0..run.samples.1];
            let out = &mut self.luma[run.y * self.width_px + run.first_x..][..samples.len()];
            expose_luma(samples, &panorama.luma, panorama_rows, out);
        }
        let [blue, red] = &mut self.chroma;
        for run in &self.chroma_table.runs {
            let samples = &self.chroma_table.samples[run.samples.0..run.samples.1];
            let start = run.y * self.width_px + 2 * run.first_x;
            let end = (start + 2 * samples.len()).min(blue.len());
            expose_chroma(samples, &panorama.chroma, panorama_rows / 2, &mut blue[start..end], &mut red[start..end]);
        }
        let mut random = stream(frame, Stream::Lens);
        for row in self.luma.chunks_exact_mut(self.width_px) {
            let offset = random.random_range(0..NOISE_VALUES);
            add_noise(row, &self.noise[offset..]);
        }
    }

    /// The picture as a JPEG, colours at half the columns like a webcam's.
    pub fn encode(&self, jpeg: &mut Vec<u8>) {
        jpeg.clear();
        let mut encoder = Encoder::new(&mut *jpeg, self.quality);
        encoder.set_sampling_factor(SamplingFactor::R_4_2_2);
        encoder.encode_image(Picture(self)).expect("sizes were checked, and a vector takes everything");
    }
}

fn expose_luma(samples: &[Sample], luma: &[u8], stride: usize, out: &mut [u8]) {
    for (out, sample) in out.iter_mut().zip(samples) {
        let index = sample.index as usize;
        let (left, right) = (&luma[index..index + 2], &luma[index + stride..index + stride + 2]);
        let (wr, wb) = (u32::from(sample.right), u32::from(sample.below));
        let left = u32::from(left[0]) * (255 - wb) + u32::from(left[1]) * wb;
        let right = u32::from(right[0]) * (255 - wb) + u32::from(right[1]) * wb;
        // 24 bits: 255 · 255 · 255.
        let value = (left * (255 - wr) + right * wr) / (255 * 255);
        *out = ((value * (u32::from(sample.light) + 1)) >> 8) as u8 + sample.lift;
    }
}

fn expose_chroma(samples: &[Sample], chroma: &[[u8; 2]], stride: usize, blue: &mut [u8], red: &mut [u8]) {
    for (sample, (blue, red)) in samples.iter().zip(blue.chunks_mut(2).zip(red.chunks_mut(2))) {
        let index = sample.index as usize;
        // Colour is coarse anyway: the nearest cell will do.
        let index = index + usize::from(sample.below >> 7) + stride * usize::from(sample.right >> 7);
        let [b, r] = chroma[index].map(|c| (i32::from(c) - i32::from(NEUTRAL)) * i32::from(sample.light));
        blue[0] = ((b >> 8) + i32::from(NEUTRAL)) as u8;
        red[0] = ((r >> 8) + i32::from(NEUTRAL)) as u8;
    }
}

#[multiversion(targets("x86_64+avx2"))]
fn add_noise(row: &mut [u8], noise: &[i8]) {
    for (pixel, &noise) in row.iter_mut().zip(noise) {
        *pixel = pixel.saturating_add_signed(noise);
    }
}

struct Picture<'a>(&'a Sensor);

impl ImageBuffer for Picture<'_> {
    fn get_jpeg_color_type(&self) -> JpegColorType {
        JpegColorType::Ycbcr
    }

    fn width(&self) -> u16 {
        self.0.width_px as u16
    }

    fn height(&self) -> u16 {
        self.0.height_px as u16
    }

    fn fill_buffers(&self, y: u16, buffers: &mut [Vec<u8>; 4]) {
        let row = usize::from(y) * self.0.width_px..(usize::from(y) + 1) * self.0.width_px;
        buffers[0].extend_from_slice(&self.0.luma[row.clone()]);
        buffers[1].extend_from_slice(&self.0.chroma[0][row.clone()]);
        buffers[2].extend_from_slice(&self.0.chroma[1][row]);
    }
}
