//! The plane from above: a metre is as long to the east as to the north.

use super::color::{ColorMap, MUTED};
use super::picture::{Rgba, png_address};
use super::plot::{Axis, LABEL, LegendItem, Plot, Spec, TICK};
use super::scale::Scale;
use super::svg::{Anchor, Paint};
use super::text::width_px as width_of;
use crate::map::CandidateCells;
use crate::types::{PositionCovariance, PositionM};

/// What part of the plane is shown.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Extent {
    pub low_m: PositionM,
    pub high_m: PositionM,
}

impl Extent {
    /// Everything in `positions`, and a margin.
    pub fn of<'a>(positions: impl IntoIterator<Item = &'a PositionM>) -> Self {
        let (mut low_m, mut high_m) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for position in positions.into_iter().filter(|p| p.iter().all(|c| c.is_finite())) {
            for axis in 0..2 {
                low_m[axis] = low_m[axis].min(position[axis]);
                high_m[axis] = high_m[axis].max(position[axis]);
            }
        }
        if low_m[0] > high_m[0] {
            (low_m, high_m) = ([0.0; 2], [1.0; 2]);
        }
        let side_m = (high_m[0] - low_m[0]).max(high_m[1] - low_m[1]).max(1e-3);
        // A drive along a line is still shown as an area.
        let margin_m =
            [0, 1].map(|axis: usize| 0.04 * side_m + 0.5 * (0.25 * side_m - high_m[axis] + low_m[axis]).max(0.0));
        Self {
            low_m: [low_m[0] - margin_m[0], low_m[1] - margin_m[1]],
            high_m: [high_m[0] + margin_m[0], high_m[1] + margin_m[1]],
        }
    }
}

/// Plotting areas are at most so high \[px\].
const MAX_HEIGHT_PX: f64 = 560.0;

/// A plot of `extent`, with equal scales.
pub fn map_plot(title: impl Into<String>, extent: Extent, legend: Vec<LegendItem>, width_px: f64) -> Plot {
    // Room for the labels of any number of ticks, also of an extent that is made somewhat larger below: the size of the
    // area must not depend on them.
    let labels = (3..=8).flat_map(|wanted| Scale::linear(extent.low_m[1], extent.high_m[1]).ticks(wanted));
    let widest_px = labels.map(|tick| width_of(&tick.label, TICK.size_px, false)).fold(0.0, f64::max);
    let left_px = widest_px + 18.0;
    let build = |extent: Extent, height_px: f64| {
        let x = Axis::new("east [m]", Scale::linear(extent.low_m[0], extent.high_m[0]));
        let y = Axis::new("north [m]", Scale::linear(extent.low_m[1], extent.high_m[1]));
        let mut spec = Spec::new("", x, y);
        spec.width_px = width_px;
        spec.area_height_px = height_px;
        spec.grid = false;
        spec.left_px = Some(left_px);
        spec
    };
    let size_m = [0, 1].map(|axis: usize| extent.high_m[axis] - extent.low_m[axis]);
    let trial = Plot::new(build(extent, 200.0));
    let wide_px = trial.area_size[0];
    let max_height_px = MAX_HEIGHT_PX.min(1.2 * wide_px);
    let height_px = (wide_px * size_m[1] / size_m[0]).min(max_height_px);
    let meters_a_px = (size_m[1] / height_px).max(size_m[0] / wide_px);
    let widened_m = 0.5 * (meters_a_px * wide_px - size_m[0]);
    let raised_m = 0.5 * (meters_a_px * height_px - size_m[1]);
    let extent = Extent {
        low_m: [extent.low_m[0] - widened_m, extent.low_m[1] - raised_m],
        high_m: [extent.high_m[0] + widened_m, extent.high_m[1] + raised_m],
    };
    let mut spec = build(extent, height_px);
    spec.title = title.into();
    spec.legend = legend;
    let mut plot = Plot::new(spec);
    plot.above.rect(plot.area_at, plot.area_size, Paint::stroke(super::color::GRID, 1.0));
    plot
}

impl Plot {
    /// Pixels of a metre on a map.
    pub fn px_a_m(&self) -> f64 {
        (self.x.to_px - self.x.from_px) / (self.x.high - self.x.low)
    }

    /// The ellipse that holds `probability` of a normal distribution.
    pub fn covariance_ellipse(
        &mut self,
        center_m: PositionM,
        covariance: &PositionCovariance,
        probability: f64,
        paint: Paint,
    ) {
        let ([a_m, b_m], turn_rad) = ellipse_m(covariance, probability);
        let (at, scale) = (self.at(center_m), self.px_a_m());
        self.inside.ellipse(at, [a_m * scale, b_m * scale], turn_rad, paint);
    }

    /// Values on cells as colours, from `low` to `high`.
    pub fn surface(&mut self, cells: &CandidateCells, values: &[f32], [low, high]: [f64; 2], map: ColorMap) {
        let grid = cells.grid;
        let (columns, rows) = (grid.columns as usize, grid.rows as usize);
        let mut picture = Rgba::transparent(columns, rows);
        for (&[i, j], &value) in cells.indices().iter().zip(values) {
            let share = (f64::from(value) - low) / (high - low).max(f64::MIN_POSITIVE);
            picture.put(i as usize, rows - 1 - j as usize, map.at(share));
        }
        let half_m = 0.5 * grid.step_m;
        let west_north = [grid.origin_m[0] - half_m, grid.origin_m[1] + grid.step_m * rows as f64 - half_m];
        let east_south = [grid.origin_m[0] + grid.step_m * columns as f64 - half_m, grid.origin_m[1] - half_m];
        let (from, to) = (self.at(west_north), self.at(east_south));
        self.inside.image(from, [to[0] - from[0], to[1] - from[1]], &png_address(&picture), true);
    }

    /// What the colours of a surface mean, below the plot.
    pub fn color_bar(&mut self, label: &str, [low, high]: [f64; 2], map: ColorMap) {
        let top = self.room_below(56.0) + 22.0;
        let (left, wide) = (self.area_at[0], self.area_size[0]);
        let mut strip = Rgba::transparent(128, 1);
        (0..128).for_each(|i| strip.put(i, 0, map.at(i as f64 / 127.0)));
        self.above.image([left, top], [wide, 9.0], &png_address(&strip), false);
        self.above.rect([left, top], [wide, 9.0], Paint::stroke(super::color::GRID, 1.0));
        let scale = Scale::linear(low, high).onto(left, left + wide);
        let mut free_from = left;
        for tick in scale.ticks(5) {
            let at = scale.px(tick.value);
            let half = 0.5 * width_of(&tick.label, TICK.size_px, false);
            let x = at.clamp(left + half, left + wide - half);
            self.above.line([at, top + 9.0], [at, top + 12.0], Paint::stroke(MUTED, 1.0));
            if x - half >= free_from {
                self.above.text([x, top + 23.0], &tick.label, TICK.anchored(Anchor::Middle));
                free_from = x + half + 6.0;
            }
        }
        self.above.text([left, top - 6.0], label, LABEL);
    }
}

/// Semi-axes \[m\] and direction of the longer one, from east, counter-clockwise, of the ellipse that holds `probability`
/// of a normal distribution: the eigenvectors of the covariance, and √(−2 ln(1 − p)) deviations.
pub fn ellipse_m(covariance: &PositionCovariance, probability: f64) -> ([f64; 2], f64) {
    let PositionCovariance { ee_m2, en_m2, nn_m2 } = *covariance;
    let (mean, difference) = (0.5 * (ee_m2 + nn_m2), 0.5 * (ee_m2 - nn_m2));
    let spread = difference.hypot(en_m2);
    let deviations = (-2.0 * (1.0 - probability).ln()).sqrt();
    let axis = |eigenvalue: f64| deviations * eigenvalue.max(0.0).sqrt();
    ([axis(mean + spread), axis(mean - spread)], 0.5 * en_m2.atan2(difference))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_meter_is_as_long_to_the_east_as_to_the_north() {
        for corner in [[100.0, 20.0], [10.0, 300.0], [5.0, 0.0], [0.0, 0.0]] {
            let plot = map_plot("", Extent::of(&[[0.0, 0.0], corner]), Vec::new(), 364.0);
            let north = (plot.y.from_px - plot.y.to_px) / (plot.y.high - plot.y.low);
            assert!((plot.px_a_m() / north - 1.0).abs() < 1e-9, "{corner:?}");
            let at = plot.at(corner);
            assert!(at[0] <= plot.area_at[0] + plot.area_size[0] && at[1] >= plot.area_at[1], "{corner:?} is inside");
        }
    }

    #[test]
    fn ellipses_follow_the_covariance() {
        let covariance = PositionCovariance { ee_m2: 5.0, en_m2: 3.0, nn_m2: 5.0 };
        let ([a, b], turn_rad) = ellipse_m(&covariance, 0.95);
        // Eigenvalues 8 and 2 along the diagonals; χ²(2) at 95 % is 5.991.
        assert!((a - (8.0 * 5.991_f64).sqrt()).abs() < 1e-3 && (b - (2.0 * 5.991_f64).sqrt()).abs() < 1e-3);
        assert!((turn_rad - std::f64::consts::FRAC_PI_4).abs() < 1e-12);
    }
}
