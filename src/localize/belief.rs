//! Where the vehicle may be: a probability for every candidate cell.

use crate::map::{CandidateCells, Grid};
use crate::types::{PositionCovariance, PositionM};

/// A discrete belief on the candidate cells.
///
/// The belief of a cell is of the place at the cell's centre plus an *offset* that all cells share, at most half a step on
/// either axis: the vehicle's own motion moves the offset, and whole cells only once it is larger, so that a motion of less
/// than a cell blurs nothing, however often it is repeated.
#[derive(Debug, Clone)]
pub struct Belief {
    grid: Grid,
    columns: usize,
    rows: usize,
    /// Where each candidate cell is on the full grid, row by row.
    places: Vec<u32>,
    is_candidate: Vec<bool>,
    /// On the full grid; 0 where no candidate is. Sums to 1.
    probability: Vec<f32>,
    /// East, north \[steps\].
    offset: [f64; 2],
    /// Variance of motions that were too small to be worth a blur \[steps²\].
    unspread: f64,
    scratch: Vec<f32>,
    kernel: Vec<f32>,
    /// The last log-likelihood on the full grid.
    weights: Vec<f32>,
}

/// A hill of the belief, or of a likelihood.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mode {
    /// Of all probability.
    pub probability: f64,
    pub mean_m: PositionM,
    /// With that of a position within its cell.
    pub covariance: PositionCovariance,
}

/// A hill reaches so many cells from its middle.
const MODE_RADIUS: f64 = 8.0;
/// Smaller variances wait until they add up to this \[steps²\].
const LEAST_SPREAD: f64 = 0.02;
/// Up to this variance three taps have exactly the right one.
const THREE_TAPS: f64 = 0.64;
/// Kernels end at so many deviations.
const KERNEL_STDS: f64 = 3.0;
/// Weights below this times the largest are nothing: keeps numbers away from what slows processors down.
const NEGLIGIBLE_LOG: f32 = -80.0;

impl Belief {
    /// Every cell alike.
    pub fn uniform(cells: &CandidateCells) -> Self {
        let grid = cells.grid;
        let (columns, rows) = (grid.columns as usize, grid.rows as usize);
        let places: Vec<u32> = cells.indices().iter().map(|&[i, j]| j * grid.columns + i).collect();
        let mut is_candidate = vec![false; columns * rows];
        places.iter().for_each(|&place| is_candidate[place as usize] = true);
        let mut belief = Self {
            grid,
            columns,
            rows,
            places,
            is_candidate,
            probability: vec![0.0; columns * rows],
            offset: [0.0; 2],
            unspread: 0.0,
            scratch: vec![0.0; columns * rows],
            kernel: Vec::new(),
            weights: vec![0.0; columns * rows],
        };
        belief.forget();
        belief
    }

    /// The same belief on other cells of the same grid: what lies outside them is forgotten, and cells that it did not know
    /// before have nothing.
    pub fn on(&self, cells: &CandidateCells) -> Self {
        let mut belief = Self::uniform(cells);
        let steps = |axis: usize| (belief.grid.origin_m[axis] - self.grid.origin_m[axis]) / self.grid.step_m;
        let [right, up] = [steps(0), steps(1)].map(|steps| steps.round() as i64);
        for &[i, j] in cells.indices() {
            let ours = [i64::from(i) + right, i64::from(j) + up].map(usize::try_from);
            let probability = match ours {
                [Ok(i), Ok(j)] if i < self.columns && j < self.rows => self.probability[j * self.columns + i],
                _ => 0.0,
            };
            belief.probability[(j * cells.grid.columns + i) as usize] = probability;
        }
        (belief.offset, belief.unspread) = (self.offset, self.unspread);
        belief.normalize();
        belief
    }

    /// Makes every cell alike again.
    pub fn forget(&mut self) {
        let each = 1.0 / self.places.len() as f32;
        self.places.iter().for_each(|&place| self.probability[place as usize] = each);
        (self.offset, self.unspread) = ([0.0; 2], 0.0);
    }

    /// Moves the belief by `mean_m` and spreads it by `std_m` on either axis: the convolution of the motion. What would
    /// leave the candidates is shared out among the rest.
    pub fn spread(&mut self, mean_m: PositionM, std_m: f64) {
        let step_m = self.grid.step_m;
        let mut whole = [0_i64; 2];
        for axis in [0, 1] {
            let moved = self.offset[axis] + mean_m[axis] / step_m;
            whole[axis] = moved.round() as i64;
            self.offset[axis] = moved - whole[axis] as f64;
        }
        self.unspread += (std_m / step_m).powi(2);
        let variance = if self.unspread >= LEAST_SPREAD { std::mem::take(&mut self.unspread) } else { 0.0 };
        if whole == [0, 0] && variance == 0.0 {
            return;
        }
        let [right, up] = whole;
        let mut half = std::mem::take(&mut self.kernel);
        fill_half_kernel(variance, &mut half);
        self.convolve(&half, right, up);
        self.kernel = half;
        self.normalize();
    }

    /// Mixes in that the vehicle may be anywhere.
    pub fn doubt(&mut self, share: f64) {
        let each = (share / self.places.len() as f64) as f32;
        for &place in &self.places {
            let probability = &mut self.probability[place as usize];
            *probability = *probability * (1.0 - share as f32) + each;
        }
    }

    /// Multiplies with exp(`factor` × `log_likelihood`), one value a cell: Bayes' rule.
    pub fn weigh(&mut self, log_likelihood: &[f32], factor: f32) {
        let greatest = log_likelihood.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        for (&place, &value) in self.places.iter().zip(log_likelihood) {
            self.weights[place as usize] = (factor * (value - greatest)).max(NEGLIGIBLE_LOG);
        }
        for k in 0..self.places.len() {
            let place = self.places[k] as usize;
            self.probability[place] *= libm::expf(self.interpolated(place));
        }
        self.normalize();
    }

    /// `weights` at a cell's centre plus the offset, bilinearly; neighbours that are no candidates count as the cell
    /// itself.
    fn interpolated(&self, place: usize) -> f32 {
        let (i, j) = (place % self.columns, place / self.columns);
        let beside = |at: usize, count: usize, offset: f64| match offset {
            offset if offset > 0.0 => (at + 1 < count).then(|| at + 1),
            offset if offset < 0.0 => at.checked_sub(1),
            _ => None,
        };
        let (i2, j2) = (beside(i, self.columns, self.offset[0]), beside(j, self.rows, self.offset[1]));
        let here = self.weights[place];
        let at = |i: Option<usize>, j: Option<usize>| {
            let neighbour = i.zip(j).map(|(i, j)| j * self.columns + i).filter(|&place| self.is_candidate[place]);
            neighbour.map_or(here, |place| self.weights[place])
        };
        let [x, y] = self.offset.map(|offset| offset.abs() as f32);
        let near = here + x * (at(i2, Some(j)) - here);
        let far = at(Some(i), j2) + x * (at(i2, j2) - at(Some(i), j2));
        near + y * (far - near)
    }

    /// The hill around the likeliest cell.
    pub fn mode(&self) -> Mode {
        let greatest = self.probability.iter().copied().fold(0.0, f32::max);
        let peak = self.probability.iter().position(|&p| p >= greatest).unwrap_or(0);
        let mut middle = [(peak % self.columns) as f64, (peak / self.columns) as f64];
        let mut hill = self.hill(middle);
        // The peak may lie on a flank.
        for _ in 0..2 {
            middle = hill.mean;
            hill = self.hill(middle);
        }
        self.in_metres(&hill)
    }

    /// The hill of this frame's likelihood, as it was last [weighed](Self::weigh) but with the power `factor`, around a
    /// position: what the frame says there by itself.
    pub fn seen_near(&self, position_m: PositionM, factor: f32) -> Mode {
        let middle = [0, 1].map(|axis| (position_m[axis] - self.grid.origin_m[axis]) / self.grid.step_m);
        let hill = gather(self.columns, self.rows, middle, |place| match self.is_candidate[place] {
            true => libm::expf(factor * self.weights[place]),
            false => 0.0,
        });
        let mode = self.in_metres(&hill);
        let [x, y] = self.offset.map(|offset| offset * self.grid.step_m);
        // Likelihoods know no offset.
        Mode { mean_m: [mode.mean_m[0] - x, mode.mean_m[1] - y], ..mode }
    }

    fn hill(&self, middle: [f64; 2]) -> Hill {
        gather(self.columns, self.rows, middle, |place| self.probability[place])
    }

    fn in_metres(&self, hill: &Hill) -> Mode {
        let step_m = self.grid.step_m;
        let position = |axis: usize| self.grid.origin_m[axis] + step_m * (hill.mean[axis] + self.offset[axis]);
        let variance = |value: f64| step_m * step_m * (value + 1.0 / 12.0);
        let [xx, xy, yy] = hill.covariance;
        Mode {
            probability: hill.mass,
            mean_m: [position(0), position(1)],
            covariance: PositionCovariance { ee_m2: variance(xx), en_m2: step_m * step_m * xy, nn_m2: variance(yy) },
        }
    }

    /// The belief of cells in which it is at least `least`, without the offset: pairs of cell and probability.
    pub fn on_cells(&self, least: f32) -> Vec<(u32, f32)> {
        let mut shifted = self.clone();
        shifted.weights.copy_from_slice(&self.probability);
        shifted.offset = self.offset.map(|offset| -offset);
        let cells = self.places.iter().enumerate();
        let all = cells.map(|(cell, &place)| (cell as u32, shifted.interpolated(place as usize)));
        all.filter(|&(_, probability)| probability >= least).collect()
    }

    /// The hill of this belief times another one's probabilities [on cells](Self::on_cells).
    pub fn product(&self, other: &[(u32, f32)]) -> Mode {
        let mut product = Self { probability: vec![0.0; self.probability.len()], offset: [0.0; 2], ..self.clone() };
        let ours = self.on_cells(0.0);
        for &(cell, probability) in other {
            let cell = cell as usize;
            product.probability[self.places[cell] as usize] = probability * ours[cell].1;
        }
        product.normalize();
        product.mode()
    }

    fn convolve(&mut self, half: &[f32], right: i64, up: i64) {
        let (columns, rows) = (self.columns, self.rows);
        for (from, to) in self.probability.chunks_exact(columns).zip(self.scratch.chunks_exact_mut(columns)) {
            to.fill(0.0);
            for_each_tap(half, right, |shift, weight| add_shifted(from, to, shift, weight));
        }
        self.probability.fill(0.0);
        for_each_tap(half, up, |shift, weight| {
            for j in 0..rows as i64 {
                let Some(target) = usize::try_from(j + shift).ok().filter(|&target| target < rows) else { continue };
                let from = &self.scratch[j as usize * columns..][..columns];
                let to = &mut self.probability[target * columns..][..columns];
                to.iter_mut().zip(from).for_each(|(to, from)| *to += weight * from);
            }
        });
        for (probability, is_candidate) in self.probability.iter_mut().zip(&self.is_candidate) {
            *probability = if *is_candidate { *probability } else { 0.0 };
        }
    }

    fn normalize(&mut self) {
        let sum: f64 = self.probability.iter().map(|&p| f64::from(p)).sum();
        if sum > f64::from(f32::MIN_POSITIVE) {
            let scale = 1.0 / sum;
            self.probability.iter_mut().for_each(|p| *p = (f64::from(*p) * scale) as f32);
        } else {
            // All of it has left the candidates: nothing is known.
            self.forget();
        }
    }
}

/// Mass, mean and covariance of a hill, in steps of the grid.
struct Hill {
    mass: f64,
    mean: [f64; 2],
    /// xx, xy, yy.
    covariance: [f64; 3],
}

/// The hill of `value`, by place, within [`MODE_RADIUS`] of `middle`.
fn gather(columns: usize, rows: usize, middle: [f64; 2], value: impl Fn(usize) -> f32) -> Hill {
    let range = |at: f64, count: usize| {
        let (from, to) = ((at - MODE_RADIUS).ceil().max(0.0), (at + MODE_RADIUS).floor().min(count as f64 - 1.0));
        from as usize..(to.max(-1.0) + 1.0) as usize
    };
    let mut sums = [0.0_f64; 6];
    for j in range(middle[1], rows) {
        for i in range(middle[0], columns) {
            let (x, y) = (i as f64 - middle[0], j as f64 - middle[1]);
            if x * x + y * y <= MODE_RADIUS * MODE_RADIUS {
                let p = f64::from(value(j * columns + i));
                for (sum, term) in sums.iter_mut().zip([1.0, x, y, x * x, x * y, y * y]) {
                    *sum += p * term;
                }
            }
        }
    }
    let [mass, x, y, xx, xy, yy] = sums;
    if mass <= 0.0 {
        return Hill {
            mass: 0.0,
            mean: middle,
            covariance: [MODE_RADIUS * MODE_RADIUS, 0.0, MODE_RADIUS * MODE_RADIUS],
        };
    }
    let (x, y) = (x / mass, y / mass);
    let covariance = [(xx / mass - x * x).max(0.0), xy / mass - x * y, (yy / mass - y * y).max(0.0)];
    Hill { mass, mean: [middle[0] + x, middle[1] + y], covariance }
}

/// Half of a symmetric kernel of this variance \[steps²\], centre first.
fn fill_half_kernel(variance: f64, half: &mut Vec<f32>) {
    half.clear();
    if variance <= THREE_TAPS {
        half.extend([(1.0 - variance) as f32, (0.5 * variance) as f32]);
        return;
    }
    let std = variance.sqrt();
    let taps = (KERNEL_STDS * std).ceil() as i32;
    half.extend((0..=taps).map(|i| libm::exp(-0.5 * (f64::from(i) / std).powi(2)) as f32));
    let sum = 2.0 * half.iter().sum::<f32>() - half[0];
    half.iter_mut().for_each(|weight| *weight /= sum);
}

fn for_each_tap(half: &[f32], shift: i64, mut tap: impl FnMut(i64, f32)) {
    for (distance, &weight) in half.iter().enumerate().filter(|(_, weight)| **weight > 0.0) {
        tap(shift + distance as i64, weight);
        if distance > 0 {
            tap(shift - distance as i64, weight);
        }
    }
}

/// to\[i + shift\] += weight × from\[i\].
fn add_shifted(from: &[f32], to: &mut [f32], shift: i64, weight: f32) {
    let by = shift.unsigned_abs() as usize;
    if by >= from.len() {
        return;
    }
    let count = from.len() - by;
    let (from, to) = if shift >= 0 { (&from[..count], &mut to[by..]) } else { (&from[by..], &mut to[..count]) };
    to.iter_mut().zip(from).for_each(|(to, from)| *to += weight * from);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cells() -> CandidateCells {
        CandidateCells::around(&[[0.0, 0.0], [40.0, 30.0]], 0.5, None).expect("a small grid")
    }

    fn hill_at(cells: &CandidateCells, at_m: PositionM, std_m: f64) -> Vec<f32> {
        let log = |c: &PositionM| -0.5 * ((c[0] - at_m[0]).powi(2) + (c[1] - at_m[1]).powi(2)) / (std_m * std_m);
        cells.centers_m().iter().map(|c| log(c) as f32).collect()
    }

    #[test]
    fn bayes_rule_multiplies_gaussians() {
        let cells = cells();
        let mut belief = Belief::uniform(&cells);
        belief.weigh(&hill_at(&cells, [20.0, 15.0], 1.5), 1.0);
        belief.weigh(&hill_at(&cells, [21.0, 15.0], 1.5), 1.0);
        let mode = belief.mode();
        assert!((mode.mean_m[0] - 20.5).abs() < 0.01 && (mode.mean_m[1] - 15.0).abs() < 0.01, "{mode:?}");
        let expected_m2 = 1.5_f64.powi(2) / 2.0 + 0.25 / 12.0;
        // A hill ends at four metres.
        assert!((mode.covariance.ee_m2 / expected_m2 - 1.0).abs() < 0.03, "{mode:?}");
        assert!(mode.covariance.en_m2.abs() < 1e-3 && mode.probability > 0.99, "{mode:?}");
    }

    /// Many small steps carry the belief as far as one large one, and blur it no more than the motion says.
    #[test]
    fn small_motions_add_up_exactly() {
        let cells = cells();
        let mut belief = Belief::uniform(&cells);
        belief.weigh(&hill_at(&cells, [10.0, 10.0], 1.0), 1.0);
        let before = belief.mode();
        for _ in 0..300 {
            belief.spread([0.037, -0.011], 0.02);
        }
        let mode = belief.mode();
        for axis in [0, 1] {
            let expected_m = before.mean_m[axis] + 300.0 * [0.037, -0.011][axis];
            assert!((mode.mean_m[axis] - expected_m).abs() < 0.02, "{mode:?}");
        }
        let added_m2 = 300.0 * 0.02_f64.powi(2);
        let found_m2 = mode.covariance.ee_m2 - before.covariance.ee_m2;
        assert!((found_m2 - added_m2).abs() < 0.02, "{found_m2} instead of {added_m2}");
    }

    #[test]
    fn a_wide_motion_has_its_variance() {
        let cells = cells();
        let mut belief = Belief::uniform(&cells);
        belief.weigh(&hill_at(&cells, [20.0, 15.0], 0.3), 1.0);
        let before = belief.mode();
        belief.spread([2.2, 0.0], 0.9);
        let mode = belief.mode();
        assert!((mode.mean_m[0] - before.mean_m[0] - 2.2).abs() < 0.02, "{mode:?}");
        let found_m2 = mode.covariance.ee_m2 - before.covariance.ee_m2;
        assert!((found_m2 / 0.81 - 1.0).abs() < 0.05, "{found_m2}");
    }

    /// The likelihood is taken at the places that the shifted cells stand for.
    #[test]
    fn the_offset_is_heeded() {
        let cells = cells();
        let mut belief = Belief::uniform(&cells);
        belief.spread([0.2, -0.15], 0.0);
        belief.weigh(&hill_at(&cells, [20.1, 15.2], 1.0), 1.0);
        let mode = belief.mode();
        assert!((mode.mean_m[0] - 20.1).abs() < 0.01 && (mode.mean_m[1] - 15.2).abs() < 0.01, "{mode:?}");
        let seen = belief.seen_near([20.0, 15.0], 1.0);
        assert!((seen.mean_m[0] - 20.1).abs() < 0.01 && (seen.mean_m[1] - 15.2).abs() < 0.01, "{seen:?}");
        let on_cells = belief.on_cells(1e-6);
        let centers_m = cells.centers_m();
        let mean = |axis: usize| {
            let sum: f64 = on_cells.iter().map(|&(_, p)| f64::from(p)).sum();
            on_cells.iter().map(|&(cell, p)| f64::from(p) * centers_m[cell as usize][axis]).sum::<f64>() / sum
        };
        assert!((mean(0) - 20.1).abs() < 0.01 && (mean(1) - 15.2).abs() < 0.01, "{} {}", mean(0), mean(1));
    }

    #[test]
    fn what_leaves_the_map_is_forgotten() {
        let cells = cells();
        let mut belief = Belief::uniform(&cells);
        belief.weigh(&hill_at(&cells, [39.0, 15.0], 0.5), 1.0);
        belief.spread([500.0, 0.0], 0.0);
        let mode = belief.mode();
        assert!(mode.probability < 0.1, "{mode:?}");
    }

    #[test]
    fn a_part_of_the_cells_knows_what_the_whole_knew() {
        let cells = cells();
        let mut belief = Belief::uniform(&cells);
        belief.weigh(&hill_at(&cells, [20.0, 15.0], 1.0), 1.0);
        belief.spread([0.3, -0.2], 0.1);
        let part = belief.on(&cells.within(24..60, 10..50).expect("some"));
        let same = |a: Mode, b: Mode| {
            assert!(
                (a.mean_m[0] - b.mean_m[0]).abs() < 1e-3 && (a.mean_m[1] - b.mean_m[1]).abs() < 1e-3,
                "{a:?} {b:?}"
            );
            assert!((a.covariance.ee_m2 / b.covariance.ee_m2 - 1.0).abs() < 1e-3, "{a:?} {b:?}");
        };
        same(part.mode(), belief.mode());
        same(part.on(&cells).mode(), belief.mode());
        // Nothing is left where nothing was.
        let elsewhere = belief.on(&cells.within(0..5, 0..5).expect("some")).mode();
        assert!(elsewhere.mean_m[0] < 3.0, "{elsewhere:?}");
    }

    #[test]
    fn doubt_leaves_the_hill_its_share() {
        let cells = cells();
        let mut belief = Belief::uniform(&cells);
        belief.weigh(&hill_at(&cells, [20.0, 15.0], 0.5), 1.0);
        belief.doubt(0.25);
        assert!((belief.mode().probability - 0.75).abs() < 0.02, "{:?}", belief.mode());
    }
}
