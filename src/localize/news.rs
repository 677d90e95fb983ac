//! What a frame is worth beside those before it, and how far the vehicle can have moved since.
//!
//! Frames that look alike err alike: thirty frames a second of the same view are not thirty witnesses, nor are those of a
//! minute at a red light. Features are measured in the noise within a place, so that views of a place on different days
//! differ by ‖Δz‖² = 2 Σ σ² on average. Views whose errors have little in common differ by a quarter of that; as long as a
//! frame differs from an earlier one by less, the two together are worth that much less than two.
//!
//! And a view that does not change says that the vehicle stands. Features are Gaussian processes over the plane: over a way
//! d they change by ‖Δz‖² = 2 Σ s² (1 − exp(−d²/2ℓ²)), which is d²/ℓ² Σ s² while it is small.

use crate::gp::Hyperparameters;
use crate::map::{GroupHyperparameters, MapInfo};
use crate::types::NS_PER_S;

/// A frame is never worth nothing: whoever stands long enough may become sure.
const LEAST_SHARE: f64 = 1e-3;
/// Views whose errors have little in common differ by so much of Σ σ²: fixed on simulated towns, driven with half a metre
/// and with 2.5 m between frames, where it makes the covariance true.
const INDEPENDENT: f64 = 0.5;
/// Views that differ by more than this share of independent ones say nothing of the way between them.
const FAR: f64 = 0.25;
/// Some places change less on the way than the map does on average.
const REACH_MARGIN: f64 = 2.0;

/// What a frame brings.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Worth {
    /// 1 for an independent view.
    pub share: f64,
    /// The vehicle has moved at most about so far since the view that this one is compared with, and how long ago that
    /// was; `None` where the views say nothing of it.
    pub reach: Option<Reach>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reach {
    pub way_m: f64,
    pub time_s: f64,
}

#[derive(Debug, Clone)]
pub struct News {
    /// The squared difference of independent views.
    independent: f64,
    /// ℓ² / Σ s² \[m²\].
    way_m2: f64,
    /// The view that the present ones are compared with, when that was, and what they were worth since.
    reference: Vec<f32>,
    reference_ns: u64,
    granted: f64,
}

impl News {
    pub fn new(info: &MapInfo) -> Self {
        let (mut noise, mut signal, mut length_m2, mut count) = (0.0, 0.0, 0.0, 0.0);
        let mut add = |features: f64, noise_variance: f64, hyperparameters: &Hyperparameters| {
            noise += features * noise_variance;
            signal += features * hyperparameters.signal_std.powi(2);
            length_m2 += features * hyperparameters.length_scale_m[0] * hyperparameters.length_scale_m[1];
            count += features;
        };
        for group in &info.groups {
            match &group.hyperparameters {
                // The noise within a place has been made white.
                GroupHyperparameters::Shared(shared) => add(group.features as f64, 1.0, shared),
                GroupHyperparameters::Each(fits) => {
                    fits.iter().for_each(|fit| add(1.0, fit.hyperparameters.noise_std.powi(2), &fit.hyperparameters));
                }
            }
        }
        Self {
            independent: INDEPENDENT * noise,
            way_m2: length_m2 / count / signal,
            reference: Vec::with_capacity(count as usize),
            reference_ns: 0,
            granted: 0.0,
        }
    }

    /// The worth of a frame with these features.
    pub fn of(&mut self, stamp_ns: u64, features: &[f32]) -> Worth {
        if self.reference.len() != features.len() {
            self.look_at(stamp_ns, features);
            return Worth { share: 1.0, reach: None };
        }
        let square: f64 = self.reference.iter().zip(features).map(|(a, b)| f64::from(a - b).powi(2)).sum();
        let differs = square / self.independent;
        let share = (differs.min(1.0) - self.granted).max(LEAST_SHARE);
        self.granted += share;
        let reach = (differs < FAR).then(|| Reach {
            way_m: REACH_MARGIN * (square * self.way_m2).sqrt(),
            time_s: stamp_ns.saturating_sub(self.reference_ns) as f64 / NS_PER_S as f64,
        });
        if differs >= 1.0 {
            self.look_at(stamp_ns, features);
        }
        Worth { share, reach }
    }

    /// The next frame is the first.
    pub fn forget(&mut self) {
        self.reference.clear();
    }

    fn look_at(&mut self, stamp_ns: u64, features: &[f32]) {
        self.reference.clear();
        self.reference.extend_from_slice(features);
        self.reference_ns = stamp_ns;
        self.granted = 0.0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::tests::small_map;

    /// Two features: independent views differ by 1.
    fn news() -> News {
        News::new(&small_map().info)
    }

    #[test]
    fn a_view_that_does_not_change_is_worth_one_frame() {
        let mut news = news();
        let worth: f64 = (0..100).map(|i| news.of(i, &[1.0 + 0.01 * (i % 2) as f32, 0.0]).share).sum();
        assert!((1.0..1.2).contains(&worth), "{worth}");
    }

    #[test]
    fn slow_change_is_worth_as_much_as_the_same_in_one_step() {
        let run = |steps: u16| {
            let mut news = news();
            let mut worth = 0.0;
            for i in 0..=4 * steps {
                // Four units of way, the independent difference being one.
                worth += news.of(0, &[f32::from(i) / f32::from(steps), 0.0]).share;
            }
            worth
        };
        assert!((run(1) - 5.0).abs() < 1e-6, "{}", run(1));
        assert!((run(10) - 5.0).abs() < 0.7, "{}", run(10));
        assert!((run(100) - 5.0).abs() < 0.7, "{}", run(100));
    }

    /// ℓ = 2 m, two features of s = 1.
    #[test]
    fn a_view_that_hardly_changes_bounds_the_way() {
        let mut news = news();
        assert_eq!(news.of(0, &[1.0, 0.0]).reach, None);
        let reach = news.of(2 * NS_PER_S, &[1.1, 0.0]).reach.expect("much the same view");
        assert!((reach.way_m - REACH_MARGIN * 0.1 * 2.0 / 2.0_f64.sqrt()).abs() < 1e-6, "{reach:?}");
        assert_eq!(reach.time_s, 2.0);
        assert_eq!(news.of(3 * NS_PER_S, &[9.0, 0.0]).reach, None);
    }
}
