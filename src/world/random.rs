//! Seeds and noise: everything in a world follows from one number.

use std::f64::consts::TAU;

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// What a stream of random numbers is for: changing how much one of them uses leaves the others as they are.
#[derive(Debug, Clone, Copy)]
pub(super) enum Stream {
    Layout = 1,
    Ground,
    Light,
    Sky,
    Parked,
    Traffic,
    People,
    Lamps,
    Lens,
    Path,
    Receiver,
    Outages,
    Dress,
    Gain,
    Mount,
}

pub(super) fn stream(seed: u64, stream: Stream) -> ChaCha8Rng {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(stream as u64);
    random
}

/// A standard normal number (Box & Muller 1958).
pub(super) fn standard_normal(random: &mut ChaCha8Rng) -> f64 {
    let (radius, angle): (f64, f64) = (random.random_range(f64::MIN_POSITIVE..1.0), random.random_range(0.0..TAU));
    (-2.0 * radius.ln()).sqrt() * angle.cos()
}

/// 32 well-mixed bits of a lattice point (the finalizer of MurmurHash3 over the sum of odd multiples).
fn lattice(x: i32, y: i32, seed: u32) -> u32 {
    let mut h = (x as u32).wrapping_mul(0x9E37_79B1) ^ (y as u32).wrapping_mul(0x85EB_CA77) ^ seed;
    h = (h ^ (h >> 16)).wrapping_mul(0x85EB_CA6B);
    h = (h ^ (h >> 13)).wrapping_mul(0xC2B2_AE35);
    h ^ (h >> 16)
}

/// Uniform in 0..1, one number a lattice point.
pub(super) fn white(x: i32, y: i32, seed: u32) -> f32 {
    (lattice(x, y, seed) >> 8) as f32 / (1 << 24) as f32
}

/// Smooth noise in 0..1 with features of about one unit.
pub(super) fn smooth(x: f32, y: f32, seed: u32) -> f32 {
    let (x0, y0) = (x.floor(), y.floor());
    let ease = |t: f32| t * t * (3.0 - 2.0 * t);
    let (u, v) = (ease(x - x0), ease(y - y0));
    let (i, j) = (x0 as i32, y0 as i32);
    let upper = white(i, j, seed) * (1.0 - u) + white(i + 1, j, seed) * u;
    let lower = white(i, j + 1, seed) * (1.0 - u) + white(i + 1, j + 1, seed) * u;
    upper * (1.0 - v) + lower * v
}

/// Smooth noise in 0..1 with features of one unit, and half and a quarter of it.
pub(super) fn fractal(x: f32, y: f32, seed: u32) -> f32 {
    let octave = |scale: f32, seed_step: u32| smooth(x * scale, y * scale, seed.wrapping_add(seed_step));
    (4.0 * octave(1.0, 0) + 2.0 * octave(2.0, 1) + octave(4.0, 2)) / 7.0
}
