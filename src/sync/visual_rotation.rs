//! By how much the camera turned between two frames, from their panoramas.

use std::{
    f64::consts::{PI, TAU},
    sync::Arc,
};

use realfft::num_complex::Complex;
use realfft::{ComplexToReal, RealFftPlanner, RealToComplex};

use crate::{
    panorama::{Panorama, WIDE_COLUMNS, WIDE_ROWS},
    types::{AzimuthSense, wrap_angle_rad},
};

/// The panorama in rings, each averaged over its rows.
const RINGS: usize = 8;
const ROWS_PER_RING: usize = WIDE_ROWS / RINGS;
const HARMONICS: usize = WIDE_COLUMNS / 2 + 1;
/// Slower harmonics are light and sky, faster ones noise.
const USED: std::ops::Range<usize> = 4..160;
/// The correlation of the two frames, 1 for equal ones, must be at least this.
const MIN_QUALITY: f64 = 0.4;
/// And this many times the highest one elsewhere: repeated windows look alike.
const MIN_LEAD: f64 = 1.05;
/// "Elsewhere" begins this far from the peak \[columns\].
const PEAK_COLUMNS: usize = 12;
/// A frame that does not show its rotation is passed over and the next compared with the one before it, so many times:
/// glare or a bus beside the vehicle must not break the chain.
const MAX_PASSED_OVER: u32 = 2;
/// Rings are judged by turns of at least two columns: on the straight, the vehicle's own roof fits best of all.
const LEARNING_SHIFT_RAD: f64 = 2.0 * TAU / WIDE_COLUMNS as f64;
/// Share of the newest turn in what is known of a ring.
const LEARNING_RATE: f64 = 0.1;
/// Steps of Newton's method from the highest column to the peak; two are enough.
const NEWTON_STEPS: usize = 3;
/// Steps of Gauss-Newton from there to what is left without parallax, and the longest: two columns.
const PARALLAX_STEPS: usize = 6;
const MAX_STEP_RAD: f64 = 0.025;
/// The parallax of one ring is known a little less well than its columns say.
const PARALLAX_DAMPING: f64 = 0.05;
/// A column that fits this many times worse than the mean (in squares) counts half.
const TOLERATED_MISFIT: f64 = 2.25;
/// Parallax does not move the peak further than this: six columns.
const MAX_PARALLAX_RAD: f64 = 0.075;

/// How the vehicle turned between two frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VisualRotation {
    pub from_ns: u64,
    pub to_ns: u64,
    /// Counter-clockwise.
    pub rotation_rad: f64,
    /// Correlation of the two frames, up to 1.
    pub quality: f64,
}

/// Compares each frame with the one before.
///
/// Turning the vehicle shifts the columns of the panorama. Driving on shifts them too, by v/d · sin φ at the angle φ from
/// ahead, where things are d away: with houses on one side and a wide street on the other, a straight drive looks like a
/// turn of 0.2 rad/s. Ahead and behind it does not, so that columns count by cos⁴ φ; column 0 looks ahead, as
/// [`AzimuthSense`] has it.
///
/// With Aᵣ and Bᵣ the spectra of ring r of the two frames, less the slow and the very fast harmonics, and A′ᵣ and B′ᵣ
/// those of the same rings times cos⁴ φ, the correlation at a shift of s columns is
///
/// ```text
/// c(s) = Σᵣ wᵣ Σₖ ½ Re((A′ᵣₖ* Bᵣₖ + Aᵣₖ* B′ᵣₖ) e^{2πi k s / W}) / √(Σ w Re(A′* A) Σ w Re(B′* B))
/// ```
///
/// One term alone would lean to where the image is rich, just beside what counts; the two lean to opposite sides.
///
/// Rings around the horizon see what is far away, rings below and above it the road and façades that pass by, or the
/// vehicle itself. Which is which is learnt: w is the fourth power of a ring's own mean correlation in turns.
///
/// Its highest column comes from one inverse transform, its peak between columns from Newton's method on the sum itself,
/// which is exact: no error that depends on where between two columns the peak lies. From there, parallax is fitted beside
/// the shift and taken off it, see `without_parallax_rad`.
pub struct RotationTracker {
    azimuth: AzimuthSense,
    // In f32, whose twiddle factors are the same on every computer.
    forward: Arc<dyn RealToComplex<f32>>,
    inverse: Arc<dyn ComplexToReal<f32>>,
    ring: Vec<f32>,
    cross: Vec<Complex<f64>>,
    spectrum: Vec<Complex<f32>>,
    correlation: Vec<f32>,
    scratch: Vec<Complex<f32>>,
    /// What columns count, and the scale of a transform forth and back.
    along: Vec<f64>,
    /// How much parallax shifts them.
    sideways: Vec<f64>,
    /// Values and slopes of a ring in the two frames.
    columns: [Vec<f64>; 4],
    /// How well each ring fits the turns that were found, and what that makes it count.
    agreement: [f64; RINGS],
    weights: [f64; RINGS],
    before: Option<Profile>,
    passed_over: u32,
    spare: Option<Profile>,
}

/// The spectra of one frame's rings, one after the other.
struct Profile {
    stamp_ns: u64,
    spectra: Vec<Complex<f64>>,
    /// Of the rings times what their columns count.
    along: Vec<Complex<f64>>,
    energies: [f64; RINGS],
}

impl RotationTracker {
    /// `azimuth`: which way the columns run.
    pub fn new(azimuth: AzimuthSense) -> Self {
        let mut planner = RealFftPlanner::new();
        let forward = planner.plan_fft_forward(WIDE_COLUMNS);
        let inverse = planner.plan_fft_inverse(WIDE_COLUMNS);
        let scratch_length = forward.get_scratch_len().max(inverse.get_scratch_len());
        Self {
            azimuth,
            ring: forward.make_input_vec(),
            cross: vec![Complex::ZERO; HARMONICS],
            spectrum: forward.make_output_vec(),
            correlation: inverse.make_output_vec(),
            scratch: vec![Complex::ZERO; scratch_length],
            sideways: (0..WIDE_COLUMNS)
                .map(|column| libm::sin(TAU * (column as f64 + 0.5) / WIDE_COLUMNS as f64).abs())
                .collect(),
            columns: std::array::from_fn(|_| vec![0.0; WIDE_COLUMNS]),
            along: (0..WIDE_COLUMNS)
                .map(|column| {
                    libm::cos(TAU * (column as f64 + 0.5) / WIDE_COLUMNS as f64).powi(4) / WIDE_COLUMNS as f64
                })
                .collect(),
            forward,
            inverse,
            agreement: [1.0; RINGS],
            weights: [1.0; RINGS],
            before: None,
            passed_over: 0,
            spare: None,
        }
    }

    /// The rotation since the frame before, or the one before that if that one was passed over. `None`: there was none,
    /// or the two do not show it.
    pub fn push(&mut self, stamp_ns: u64, panorama: &Panorama) -> Option<VisualRotation> {
        let mut profile = self.spare.take().unwrap_or_else(Profile::zeros);
        self.describe(stamp_ns, panorama, &mut profile);
        let before = self.before.take();
        let rotation = before.as_ref().and_then(|before| self.between(before, &profile));
        if rotation.is_none() && before.is_some() && self.passed_over < MAX_PASSED_OVER {
            self.passed_over += 1;
            (self.before, self.spare) = (before, Some(profile));
        } else {
            // Who was given up on is not trusted for long either.
            if rotation.is_some() {
                self.passed_over = 0;
            }
            (self.before, self.spare) = (Some(profile), before);
        }
        rotation
    }

    /// The next frame has none before it.
    pub fn restart(&mut self) {
        self.passed_over = 0;
        self.spare = self.before.take().or(self.spare.take());
    }

    fn describe(&mut self, stamp_ns: u64, panorama: &Panorama, profile: &mut Profile) {
        profile.stamp_ns = stamp_ns;
        let rings = panorama.wide.chunks_exact(WIDE_COLUMNS * ROWS_PER_RING);
        let spectra = profile.spectra.chunks_exact_mut(USED.len()).zip(profile.along.chunks_exact_mut(USED.len()));
        for (rows, ((spectrum, along), energy)) in rings.zip(spectra.zip(&mut profile.energies)) {
            self.ring.fill(0.0);
            for row in rows.chunks_exact(WIDE_COLUMNS) {
                // Around mid-gray: the mean is not used, and small numbers keep their digits.
                self.ring.iter_mut().zip(row).for_each(|(sum, &value)| *sum += value - 128.0);
            }
            self.forward
                .process_with_scratch(&mut self.ring, &mut self.spectrum, &mut self.scratch)
                .expect("the buffers come from the plan");
            spectrum.iter_mut().zip(&self.spectrum[USED]).for_each(|(to, from)| *to = wide(from));
            self.spectrum[..USED.start].fill(Complex::ZERO);
            self.spectrum[USED.end..].fill(Complex::ZERO);
            self.inverse
                .process_with_scratch(&mut self.spectrum, &mut self.ring, &mut self.scratch)
                .expect("the buffers come from the plan");
            self.ring.iter_mut().zip(&self.along).for_each(|(value, factor)| *value *= *factor as f32);
            self.forward
                .process_with_scratch(&mut self.ring, &mut self.spectrum, &mut self.scratch)
                .expect("the buffers come from the plan");
            along.iter_mut().zip(&self.spectrum[USED]).for_each(|(to, from)| *to = wide(from));
            *energy = along.iter().zip(&*spectrum).map(|(a, b)| (a.conj() * b).re).sum();
        }
    }

    fn between(&mut self, from: &Profile, to: &Profile) -> Option<VisualRotation> {
        let weighted = |profile: &Profile| -> f64 {
            self.weights.iter().zip(&profile.energies).map(|(weight, energy)| weight * energy).sum()
        };
        let scale = (weighted(from) * weighted(to)).sqrt();
        if !(scale > 0.0 && scale.is_finite()) {
            return None;
        }
        self.cross.fill(Complex::ZERO);
        let used = &mut self.cross[USED];
        for (ring, weight) in self.weights.iter().enumerate() {
            let factor = weight / scale;
            used.iter_mut().zip(products(from, to, ring)).for_each(|(sum, product)| *sum += product * factor);
        }
        let mut spectrum = std::mem::take(&mut self.spectrum);
        spectrum.iter_mut().zip(&self.cross).for_each(|(to, from)| *to = narrow(from));
        self.inverse
            .process_with_scratch(&mut spectrum, &mut self.correlation, &mut self.scratch)
            .expect("the buffers come from the plan");
        self.spectrum = spectrum;

        let (column, &peak) = self.correlation.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1))?;
        let apart = |other: usize| {
            let apart = other.abs_diff(column);
            apart.min(WIDE_COLUMNS - apart)
        };
        let elsewhere = self.correlation.iter().enumerate().filter(|(other, _)| apart(*other) > PEAK_COLUMNS);
        let rival = f64::from(elsewhere.map(|(_, &value)| value).fold(0.0, f32::max));
        let peak = f64::from(peak);
        // The inverse transform counts each harmonic for itself and its conjugate.
        let quality = peak / 2.0;
        if quality < MIN_QUALITY || peak < MIN_LEAD * rival {
            return None;
        }
        let shift_rad = self.peak_near_rad(TAU * column as f64 / WIDE_COLUMNS as f64);
        let shift_rad = self.without_parallax_rad(from, to, shift_rad);
        self.learn_weights(from, to, shift_rad);
        // What the vehicle turns towards moves to lower columns where the azimuth grows with the column.
        let rotation_rad = match self.azimuth {
            AzimuthSense::Ccw => -shift_rad,
            AzimuthSense::Cw => shift_rad,
        };
        let rotation_rad = wrap_angle_rad(rotation_rad);
        Some(VisualRotation { from_ns: from.stamp_ns, to_ns: to.stamp_ns, rotation_rad, quality })
    }

    /// Rings that show the turn well get more weight.
    fn learn_weights(&mut self, from: &Profile, to: &Profile, shift_rad: f64) {
        if shift_rad.abs() < LEARNING_SHIFT_RAD {
            return;
        }
        let step = from_polar(1.0, shift_rad);
        let first = from_polar(1.0, shift_rad * USED.start as f64);
        for ring in 0..RINGS {
            let scale = (from.energies[ring] * to.energies[ring]).sqrt();
            let mut turn = first;
            let mut product = 0.0;
            for cross in products(from, to, ring) {
                product += (cross * turn).re;
                turn *= step;
            }
            let agreement = if scale > 0.0 { (product / scale).clamp(0.0, 1.0) } else { 0.0 };
            self.agreement[ring] += LEARNING_RATE * (agreement - self.agreement[ring]);
            self.weights[ring] = self.agreement[ring].powi(4);
        }
    }

    /// The shift that explains the two frames together with parallax, from one near it.
    ///
    /// Gauss-Newton on Σ w (a − b)² over all rings and columns. Besides the shift of all, each ring has a shift of its own
    /// that grows with |sin φ|: what one side is nearer than the other. Columns that fit badly, where cars pass or façades
    /// end, count less.
    fn without_parallax_rad(&mut self, from: &Profile, to: &Profile, start_rad: f64) -> f64 {
        let mut shift_rad = start_rad;
        let mut parallax_rad = [0.0; RINGS];
        for _ in 0..PARALLAX_STEPS {
            let (mut bend, mut slope) = (0.0, 0.0);
            let mut rings = [(0.0, 0.0); RINGS];
            for (ring, side) in rings.iter_mut().enumerate() {
                self.fill_columns(from, ring, 0.0, 0);
                self.fill_columns(to, ring, shift_rad, 1);
                let [a, a_slope, b, b_slope] = &self.columns;
                let of_column = |j: usize| (a[j] - b[j], 0.5 * (a_slope[j] + b_slope[j]), self.sideways[j]);
                let misfit = |j: usize| {
                    let (rest, gradient, sideways) = of_column(j);
                    (rest - gradient * sideways * parallax_rad[ring]).powi(2)
                };
                let total: f64 = self.along.iter().enumerate().map(|(j, along)| along * misfit(j)).sum();
                let tolerated = TOLERATED_MISFIT * total / self.along.iter().sum::<f64>();
                let (mut gg, mut gs, mut ss, mut g_rest, mut s_rest) = (0.0, 0.0, 0.0, 0.0, 0.0);
                for (j, along) in self.along.iter().enumerate() {
                    let (rest, gradient, sideways) = of_column(j);
                    let weight = if tolerated > 0.0 { along / (1.0 + misfit(j) / tolerated) } else { *along };
                    let by_side = gradient * sideways;
                    gg += weight * gradient * gradient;
                    gs += weight * gradient * by_side;
                    ss += weight * by_side * by_side;
                    g_rest += weight * gradient * rest;
                    s_rest += weight * by_side * rest;
                }
                let ss = ss * (1.0 + PARALLAX_DAMPING);
                if ss > 0.0 {
                    bend += gg - gs * gs / ss;
                    slope += g_rest - gs * s_rest / ss;
                    *side = (s_rest / ss, gs / ss);
                }
            }
            if !(bend > 0.0 && slope.is_finite()) {
                return start_rad;
            }
            let step_rad = (slope / bend).clamp(-MAX_STEP_RAD, MAX_STEP_RAD);
            for (parallax_rad, (own, shared)) in parallax_rad.iter_mut().zip(rings) {
                *parallax_rad = own - shared * step_rad;
            }
            shift_rad += step_rad;
        }
        // The two images match elsewhere: the peak of the correlation is the better answer.
        if (shift_rad - start_rad).abs() <= MAX_PARALLAX_RAD { shift_rad } else { start_rad }
    }

    /// A ring's values and slopes, with its columns moved by `shift_rad`, to `columns[2 * place..]`.
    fn fill_columns(&mut self, profile: &Profile, ring: usize, shift_rad: f64, place: usize) {
        let harmonics = &profile.spectra[ring * USED.len()..(ring + 1) * USED.len()];
        let step = from_polar(1.0, shift_rad);
        for (is_slope, columns) in self.columns[2 * place..2 * place + 2].iter_mut().enumerate() {
            self.spectrum.fill(Complex::ZERO);
            let mut turn = from_polar(1.0 / WIDE_COLUMNS as f64, shift_rad * USED.start as f64);
            for (k, (value, harmonic)) in USED.zip(self.spectrum[USED].iter_mut().zip(harmonics)) {
                let factor = if is_slope == 1 { Complex::new(0.0, k as f64) } else { Complex::new(1.0, 0.0) };
                *value = narrow(&(harmonic * turn * factor));
                turn *= step;
            }
            self.inverse
                .process_with_scratch(&mut self.spectrum, &mut self.correlation, &mut self.scratch)
                .expect("the buffers come from the plan");
            columns.iter_mut().zip(&self.correlation).for_each(|(to, &from)| *to = from.into());
        }
    }

    /// The maximum of Σ Re(cross e^{i k s}) next to `start_rad`.
    fn peak_near_rad(&self, start_rad: f64) -> f64 {
        let column_rad = TAU / WIDE_COLUMNS as f64;
        let mut shift_rad = start_rad;
        for _ in 0..NEWTON_STEPS {
            let (mut slope, mut bend) = (0.0, 0.0);
            let step = from_polar(1.0, shift_rad);
            let mut turn = from_polar(1.0, shift_rad * USED.start as f64);
            for (k, cross) in USED.zip(&self.cross[USED]) {
                let (k, value) = (k as f64, cross * turn);
                slope -= k * value.im;
                bend -= k * k * value.re;
                turn *= step;
            }
            if bend >= 0.0 {
                break;
            }
            shift_rad = (shift_rad - slope / bend).clamp(start_rad - column_rad, start_rad + column_rad);
        }
        if shift_rad > PI { shift_rad - TAU } else { shift_rad }
    }
}

fn from_polar(radius: f64, angle_rad: f64) -> Complex<f64> {
    let (sin, cos) = libm::sincos(angle_rad);
    Complex::new(radius * cos, radius * sin)
}

fn wide(value: &Complex<f32>) -> Complex<f64> {
    Complex::new(value.re.into(), value.im.into())
}

fn narrow(value: &Complex<f64>) -> Complex<f32> {
    Complex::new(value.re as f32, value.im as f32)
}

/// ½ (A′* B + A* B′) of one ring, for each harmonic.
fn products<'a>(from: &'a Profile, to: &'a Profile, ring: usize) -> impl Iterator<Item = Complex<f64>> + 'a {
    let range = ring * USED.len()..(ring + 1) * USED.len();
    let from = from.spectra[range.clone()].iter().zip(&from.along[range.clone()]);
    let to = to.spectra[range.clone()].iter().zip(&to.along[range]);
    from.zip(to).map(|((a, a_along), (b, b_along))| 0.5 * (a_along.conj() * b + a.conj() * b_along))
}

impl Profile {
    fn zeros() -> Self {
        let zeros = vec![Complex::ZERO; RINGS * USED.len()];
        Self { stamp_ns: 0, spectra: zeros.clone(), along: zeros, energies: [0.0; RINGS] }
    }
}

const _: () = assert!(USED.end <= HARMONICS, "harmonics of a transform of WIDE_COLUMNS");

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// A landscape of harmonics, seen at a yaw; with noise.
    fn seen(azimuth: AzimuthSense, yaw_rad: f64, noise: f32, seed: u64) -> Panorama {
        let mut scene = ChaCha8Rng::seed_from_u64(7);
        let waves: Vec<(f64, f64, f64)> =
            (1..60).map(|k| (f64::from(k), scene.random_range(0.0..TAU), scene.random_range(0.0..12.0))).collect();
        let sense = if azimuth == AzimuthSense::Ccw { 1.0 } else { -1.0 };
        let row: Vec<f32> = (0..WIDE_COLUMNS)
            .map(|j| {
                let azimuth_rad = yaw_rad + sense * TAU * (j as f64 + 0.5) / WIDE_COLUMNS as f64;
                waves.iter().map(|(k, phase, size)| size * (k * azimuth_rad + phase).cos()).sum::<f64>() as f32
            })
            .collect();
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let shade = |i: usize| 100.0 + row[i % WIDE_COLUMNS] + noise * rng.random_range(-1.0..1.0f32);
        Panorama::from_wide((0..WIDE_COLUMNS * WIDE_ROWS).map(shade).collect())
    }

    #[test]
    fn turns_of_any_size_are_found_to_a_fraction_of_a_column() {
        for azimuth in [AzimuthSense::Ccw, AzimuthSense::Cw] {
            let mut tracker = RotationTracker::new(azimuth);
            assert_eq!(tracker.push(0, &seen(azimuth, 0.3, 30.0, 0)), None);
            let mut yaw_rad = 0.3;
            for (i, turn_rad) in [0.0, 0.001, 0.0123, -0.0123, 0.2, -1.0, 3.0, -0.005].into_iter().enumerate() {
                yaw_rad += turn_rad;
                let stamp_ns = i as u64 + 1;
                let found = tracker.push(stamp_ns, &seen(azimuth, yaw_rad, 30.0, stamp_ns)).expect("clear");
                assert_eq!((found.from_ns, found.to_ns), (stamp_ns - 1, stamp_ns));
                // One column is 0.0123 rad. Those to the sides count less and parallax is fitted too: noise is left.
                assert!(wrap_angle_rad(found.rotation_rad - turn_rad).abs() < 8e-4, "{found:?}, truth {turn_rad}");
                assert!((0.5..1.01).contains(&found.quality), "{found:?}");
            }
        }
    }

    #[test]
    fn what_does_not_show_a_turn_is_refused() {
        let azimuth = AzimuthSense::Ccw;
        let plain = Panorama::from_wide(vec![90.0; WIDE_COLUMNS * WIDE_ROWS]);
        let noise = |seed| seen(azimuth, 0.0, 5000.0, seed);
        let landscape = || seen(azimuth, 0.0, 1.0, 0);
        let striped = |j: usize| if (j / 8).is_multiple_of(2) { 50.0 } else { 150.0 };
        let stripes = Panorama::from_wide((0..WIDE_COLUMNS * WIDE_ROWS).map(striped).collect());
        let broken = Panorama::from_wide(vec![f32::NAN; WIDE_COLUMNS * WIDE_ROWS]);
        let mut tracker = RotationTracker::new(azimuth);
        for (what, before, after) in [
            ("nothing to see", &plain, &plain),
            ("nothing before", &plain, &landscape()),
            ("noise", &noise(1), &noise(2)),
            ("it could be any of 32 turns", &stripes, &stripes),
            ("not numbers", &broken, &broken),
        ] {
            tracker.restart();
            assert_eq!(tracker.push(0, before), None);
            assert_eq!(tracker.push(1, after), None, "{what}");
        }
        tracker.restart();
        assert_eq!(tracker.push(2, &landscape()), None, "told to begin anew");
        for stamp_ns in 3..5 {
            assert_eq!(tracker.push(stamp_ns, &plain), None, "glare");
        }
        let found = tracker.push(5, &landscape()).expect("the glare is over");
        assert_eq!((found.from_ns, found.to_ns), (2, 5));
        (6..9).for_each(|stamp_ns| assert_eq!(tracker.push(stamp_ns, &plain), None));
        assert_eq!(tracker.push(9, &landscape()), None, "too long ago");
        assert!(tracker.push(10, &landscape()).is_some());
    }
}
