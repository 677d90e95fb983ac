//! The receiver's pulse: an edge at the start of every second.

use std::collections::VecDeque;

use crate::types::NS_PER_S;

/// Edges looked back on.
const EDGES: usize = 32;
/// Edges of the same train lie this close to whole seconds apart, drift of 100 ppm over all of them included.
const SAME_TRAIN_NS: i64 = 4_000_000;
/// A train: at least so many of the edges, at least this share of them, and this many times the next best train.
const MIN_EDGES: usize = 5;
const MIN_SHARE: f64 = 0.3;
const MIN_LEAD: usize = 2;
/// A slope is fitted from this many edges on; fewer are averaged.
const MIN_EDGES_FOR_SLOPE: usize = 8;
const MAX_SLOPE: f64 = 200e-6;
/// Without an edge for this long the phase is not known any more.
const STALE_NS: u64 = 20 * NS_PER_S;
/// What a stamp taken by a kernel driver is good for at best, and how the fitted slope may be wrong.
const MIN_STD_S: f64 = 1e-6;
const SLOPE_STD: f64 = 5e-6;

/// Edges of the pulse, among them missing, doubled and spurious ones.
#[derive(Debug, Clone)]
pub struct Pulses {
    edges: VecDeque<u64>,
    train: Option<Train>,
}

/// Where whole seconds of the receiver lie: a line through the edges that agree.
#[derive(Debug, Clone, Copy)]
struct Train {
    /// The newest edge that agrees, and how far the line lies beside it.
    edge_ns: u64,
    intercept_s: f64,
    slope: f64,
    std_s: f64,
}

/// Where whole seconds lie on the monotonic clock.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SecondPhase {
    /// In 0..10⁹: monotonic time of a whole second, modulo one second.
    pub phase_ns: i64,
    pub std_s: f64,
}

impl Default for Pulses {
    fn default() -> Self {
        Self { edges: VecDeque::with_capacity(EDGES), train: None }
    }
}

impl Pulses {
    /// Takes in an edge.
    pub fn push(&mut self, stamp_ns: u64) {
        if self.edges.len() == EDGES {
            self.edges.pop_front();
        }
        self.edges.push_back(stamp_ns);
        self.train = self.find_train();
    }

    /// Where whole seconds lie around `now_ns`. `None`: no edges, or no agreement among them.
    pub fn phase(&self, now_ns: u64) -> Option<SecondPhase> {
        let train = self.train.filter(|train| now_ns.saturating_sub(train.edge_ns) <= STALE_NS)?;
        let since_s = (now_ns as i64).saturating_sub(train.edge_ns as i64) as f64 * 1e-9;
        let beside_ns = ((train.intercept_s + train.slope * since_s) * 1e9).round() as i64;
        let phase_ns = (train.edge_ns as i64).saturating_add(beside_ns).rem_euclid(NS_PER_S as i64);
        Some(SecondPhase { phase_ns, std_s: train.std_s + SLOPE_STD * since_s.abs() })
    }

    /// The largest set of edges that lie whole seconds apart.
    fn find_train(&self) -> Option<Train> {
        let beside_ns = |edge_ns: u64, of_ns: u64| {
            let apart_ns = (edge_ns as i64).wrapping_sub(of_ns as i64).rem_euclid(NS_PER_S as i64);
            if apart_ns > NS_PER_S as i64 / 2 { apart_ns - NS_PER_S as i64 } else { apart_ns }
        };
        let agreeing = |of_ns: u64| self.edges.iter().filter(move |&&e| beside_ns(e, of_ns).abs() <= SAME_TRAIN_NS);
        let counted = self.edges.iter().map(|&edge_ns| (agreeing(edge_ns).count(), edge_ns));
        let (count, center_ns) = counted.clone().max()?;
        let apart = |edge_ns: u64| beside_ns(edge_ns, center_ns).abs() > 2 * SAME_TRAIN_NS;
        let next_best = counted.filter(|&(_, edge_ns)| apart(edge_ns)).map(|(count, _)| count).max().unwrap_or(0);
        let enough = count >= MIN_EDGES && count as f64 >= MIN_SHARE * self.edges.len() as f64;
        if !enough || count < MIN_LEAD * next_best {
            return None;
        }

        let edge_ns = agreeing(center_ns).copied().max()?;
        let points = || {
            let since_s = move |e: u64| (e as i64).wrapping_sub(edge_ns as i64) as f64 * 1e-9;
            agreeing(center_ns).map(move |&e| (since_s(e), beside_ns(e, edge_ns) as f64 * 1e-9))
        };
        let n = count as f64;
        let mean = |value: fn((f64, f64)) -> f64| points().map(value).sum::<f64>() / n;
        let (mean_t, mean_y) = (mean(|(t, _)| t), mean(|(_, y)| y));
        let spread: f64 = points().map(|(t, _)| (t - mean_t).powi(2)).sum();
        let slope = match count >= MIN_EDGES_FOR_SLOPE && spread > 0.0 {
            true => points().map(|(t, y)| (t - mean_t) * (y - mean_y)).sum::<f64>() / spread,
            false => 0.0,
        };
        let slope = slope.clamp(-MAX_SLOPE, MAX_SLOPE);
        let intercept_s = mean_y - slope * mean_t;
        let residual: f64 = points().map(|(t, y)| (y - intercept_s - slope * t).powi(2)).sum();
        // At the end of the line its variance is about four times that of its middle.
        let std_s = MIN_STD_S + 2.0 * (residual / (n - 2.0) / n).sqrt();
        Some(Train { edge_ns, intercept_s, slope, std_s })
    }
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    const OFFSET_NS: u64 = 5_123_456_789;

    /// Error of the phase \[s\] for edges at `second·(1 + drift) + OFFSET`, each through `change`.
    fn error_s(pulses: &Pulses, now_s: f64, drift: f64) -> Option<f64> {
        let now_ns = OFFSET_NS + (now_s * 1e9) as u64;
        let truth_ns = OFFSET_NS as f64 + now_s.floor() * 1e9 * (1.0 + drift);
        let apart_s = (pulses.phase(now_ns)?.phase_ns as f64 - truth_ns) * 1e-9;
        Some(apart_s - apart_s.round())
    }

    #[test]
    fn whole_seconds_are_found_to_microseconds_among_missing_and_spurious_edges() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut pulses = Pulses::default();
        let drift = 40e-6;
        for second in 0..60 {
            let edge_ns = OFFSET_NS as f64 + f64::from(second) * 1e9 * (1.0 + drift);
            if rng.random_bool(0.8) {
                pulses.push((edge_ns + rng.random_range(-20e3..20e3)) as u64);
            }
            if rng.random_bool(0.3) {
                pulses.push((edge_ns + rng.random_range(10e6..990e6)) as u64);
            }
        }
        let error_s = error_s(&pulses, 60.2, drift).expect("most edges agree");
        assert!(error_s.abs() < 30e-6, "{error_s}");
    }

    #[test]
    fn edges_that_do_not_agree_say_nothing() {
        let mut pulses = Pulses::default();
        assert_eq!(pulses.phase(0), None);
        (0..4).for_each(|second| pulses.push(second * NS_PER_S));
        assert_eq!(pulses.phase(4 * NS_PER_S), None, "too few");
        pulses.push(4 * NS_PER_S);
        assert_eq!(pulses.phase(5 * NS_PER_S).expect("enough").phase_ns, 0);
        assert_eq!(pulses.phase(60 * NS_PER_S), None, "too long ago");

        // Both edges of a pulse that is 100 ms long: which one starts the second?
        let mut both = Pulses::default();
        for second in 0..30 {
            both.push(second * NS_PER_S);
            both.push(second * NS_PER_S + 100_000_000);
        }
        assert_eq!(both.phase(30 * NS_PER_S), None);

        let mut noise = Pulses::default();
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let mut stamp_ns = 0;
        for _ in 0..2000 {
            stamp_ns += rng.random_range(1_000_000..2_000_000_000);
            noise.push(stamp_ns);
            assert_eq!(noise.phase(stamp_ns), None);
        }
        // No stamp may overflow.
        [0, u64::MAX, i64::MAX as u64, 1].into_iter().for_each(|stamp_ns| noise.push(stamp_ns));
        noise.phase(u64::MAX);
    }
}
