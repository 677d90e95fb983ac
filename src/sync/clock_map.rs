//! One clock of the receiver against the monotonic clock.

use std::collections::VecDeque;

use libm::hypot;

use crate::types::NS_PER_S;

/// Two quartz clocks do not drift apart faster than 1 / this: 100 ppm.
const SLOWEST_DRIFT_INVERSE: i64 = 10_000;
/// The window is this many buckets of one second that hold samples.
const BUCKETS: usize = 120;
const BUCKET_NS: u64 = NS_PER_S;
/// The newest buckets, from which a rise of the latency shows; the lowest of their samples lies above the envelope by up
/// to this share of the mean lateness by chance.
const RECENT_BUCKETS: usize = 3;
const CHANCE_ABOVE: f64 = 0.25;
/// A sample may be this much later than the envelope: a stalled hub, a busy line. Beyond, the receiver's clock may have
/// been set back.
const MAX_EXCESS_NS: i64 = 750_000_000;
/// A sample may be this much earlier than the envelope, which then follows at once. Beyond, the receiver's clock may have
/// been set forward, or its time is wrong in this one sample.
const MAX_DROP_NS: i64 = 100_000_000;
/// What lies outside is believed when samples agree with each other this well, for this long and in this number. What a
/// stalled line hands over in one go agrees with nothing: its lateness falls from sample to sample.
const AGREEMENT_NS: i64 = 250_000_000;
const AGREEMENT_SPAN_NS: u64 = 500_000_000;
const AGREEMENT_SAMPLES: u32 = 3;
/// When the window's lowest samples leave it, the envelope rises a little by chance; more than this is a changed latency.
const CHANCE_RISE_NS: i64 = 20_000_000;
/// Jitter that is assumed before there are samples, with the weight of one of them \[s\].
const PRIOR_JITTER_S: f64 = 0.05;
/// The mean lateness is over about this many samples.
const JITTER_SAMPLES: f64 = 500.0;
/// Samples of this many former epochs can still be placed.
const EPOCHS_KEPT: usize = 8;

/// What a sample says about the clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// It lies on the envelope or a little above.
    Fits,
    /// It does not; the next samples show whether the clock was set. Hold it back until then.
    Undecided,
    /// The receiver's clock was set: a new epoch has begun, to which the samples held back belong.
    Stepped,
}

/// The lower envelope of `arrival − sample time` = clock offset + smallest latency + jitter.
///
/// Jitter is never negative, so the lowest samples lie nearest to the truth. A sample of age a bounds the envelope from
/// above by its offset + 100 ppm · a, and the envelope is the lowest bound over a window of the last 120 seconds with
/// samples. The order of two bounds does not change as they age, so that each sample is compared once: against the
/// lowest of its second; the window is searched once a second.
///
/// All is counted in *zero-latency time*: sample time + envelope, which is later than the true monotonic time by the
/// smallest latency of the line. What that is, no one-way data can show.
#[derive(Debug, Clone)]
pub struct ClockMap {
    buckets: VecDeque<Bucket>,
    lowest: Option<Lowest>,
    newest_arrival_ns: u64,
    /// Mean of `offset − envelope` \[s\], and its weight in samples.
    mean_excess_s: f64,
    excess_weight: f64,
    /// How far the envelope stands above where it once was, for no reason that drift could give.
    rise_ns: i64,
    candidate: Option<Candidate>,
    epoch: u32,
    past_epochs: VecDeque<(u32, i64)>,
    steps: u64,
    jumps: u64,
}

#[derive(Debug, Clone, Copy)]
struct Bucket {
    number: u64,
    samples: u64,
    lowest: Lowest,
}

#[derive(Debug, Clone, Copy)]
struct Lowest {
    /// `offset − arrival · 100 ppm`: orders bounds whatever their age.
    key_ns: i64,
    arrival_ns: u64,
}

/// Samples that contradict the envelope but perhaps agree with each other.
#[derive(Debug, Clone, Copy)]
struct Candidate {
    offset_ns: i64,
    first_arrival_ns: u64,
    samples: u32,
}

impl Default for ClockMap {
    fn default() -> Self {
        Self {
            buckets: VecDeque::with_capacity(BUCKETS),
            lowest: None,
            newest_arrival_ns: 0,
            mean_excess_s: 0.0,
            excess_weight: 0.0,
            rise_ns: 0,
            candidate: None,
            epoch: 0,
            past_epochs: VecDeque::with_capacity(EPOCHS_KEPT),
            steps: 0,
            jumps: 0,
        }
    }
}

impl ClockMap {
    /// Takes in a sample taken at `sample_ns` on the receiver's clock.
    pub fn push(&mut self, sample_ns: i64, arrival_ns: u64) -> Verdict {
        let offset_ns = signed(arrival_ns).saturating_sub(sample_ns);
        self.newest_arrival_ns = self.newest_arrival_ns.max(arrival_ns);
        let Some(envelope_ns) = self.offset_ns() else {
            self.take_in(offset_ns, arrival_ns);
            return Verdict::Fits;
        };
        let excess_ns = offset_ns.saturating_sub(envelope_ns);
        if (-MAX_DROP_NS..=MAX_EXCESS_NS).contains(&excess_ns) {
            self.candidate = None;
            self.take_in(offset_ns, arrival_ns);
            return Verdict::Fits;
        }
        self.consider(offset_ns, arrival_ns, envelope_ns)
    }

    /// A sample off the envelope: is it one of several that agree?
    fn consider(&mut self, offset_ns: i64, arrival_ns: u64, envelope_ns: i64) -> Verdict {
        let fresh = Candidate { offset_ns, first_arrival_ns: arrival_ns, samples: 1 };
        let candidate = match self.candidate {
            Some(known) if known.offset_ns.saturating_sub(offset_ns).saturating_abs() <= AGREEMENT_NS => {
                Candidate { offset_ns: known.offset_ns.min(offset_ns), samples: known.samples + 1, ..known }
            }
            _ => fresh,
        };
        let span_ns = arrival_ns.saturating_sub(candidate.first_arrival_ns);
        if candidate.samples < AGREEMENT_SAMPLES || span_ns < AGREEMENT_SPAN_NS {
            self.candidate = Some(candidate);
            return Verdict::Undecided;
        }
        self.candidate = None;
        let step_ns = candidate.offset_ns.saturating_sub(envelope_ns);
        if (-MAX_EXCESS_NS..0).contains(&step_ns) {
            // As likely a latency that fell as a clock that was set: older samples move along.
            self.jumps += 1;
            self.take_in(candidate.offset_ns, arrival_ns);
            return Verdict::Fits;
        }
        self.steps += 1;
        self.begin_epoch(envelope_ns);
        self.buckets.clear();
        self.lowest = None;
        self.rise_ns = 0;
        self.take_in(candidate.offset_ns, arrival_ns);
        Verdict::Stepped
    }

    fn begin_epoch(&mut self, last_offset_ns: i64) {
        if self.past_epochs.len() == EPOCHS_KEPT {
            self.past_epochs.pop_front();
        }
        self.past_epochs.push_back((self.epoch, last_offset_ns));
        self.epoch += 1;
    }

    fn take_in(&mut self, offset_ns: i64, arrival_ns: u64) {
        let sample = Lowest { key_ns: offset_ns.saturating_sub(drift_ns(signed(arrival_ns))), arrival_ns };
        let before = self.lowest;
        let number = arrival_ns / BUCKET_NS;
        match self.buckets.back_mut() {
            Some(newest) if number <= newest.number => {
                newest.samples += 1;
                if sample.key_ns < newest.lowest.key_ns {
                    newest.lowest = sample;
                }
            }
            _ => {
                if self.buckets.len() == BUCKETS {
                    self.buckets.pop_front();
                    self.lowest = lowest_of(self.buckets.iter());
                }
                self.buckets.push_back(Bucket { number, samples: 1, lowest: sample });
            }
        }
        if self.lowest.is_none_or(|lowest| sample.key_ns < lowest.key_ns) {
            self.lowest = Some(sample);
        }
        let (Some(lowest), Some(before)) = (self.lowest, before) else { return };
        let rise_ns = lowest.key_ns.saturating_sub(before.key_ns);
        if rise_ns > CHANCE_RISE_NS {
            self.rise_ns = self.rise_ns.saturating_add(rise_ns);
            self.jumps += 1;
        } else if rise_ns < 0 {
            self.rise_ns = self.rise_ns.saturating_add(rise_ns).max(0);
        }
        self.excess_weight = (self.excess_weight + 1.0).min(JITTER_SAMPLES);
        let excess_s = sample.key_ns.saturating_sub(lowest.key_ns) as f64 * 1e-9;
        self.mean_excess_s += (excess_s - self.mean_excess_s) / self.excess_weight;
    }

    /// The receiver's clock is counted from another instant from now on: `by_ns` is added to sample times.
    pub fn recount(&mut self, by_ns: i64) {
        let Some(offset_ns) = self.offset_ns() else { return };
        self.begin_epoch(offset_ns);
        let moved = |lowest: &mut Lowest| lowest.key_ns = lowest.key_ns.saturating_sub(by_ns);
        self.buckets.iter_mut().for_each(|bucket| moved(&mut bucket.lowest));
        self.lowest.iter_mut().for_each(moved);
        self.candidate = None;
    }

    /// The envelope now: what is added to a sample time to get zero-latency time. `None` before the first sample.
    pub fn offset_ns(&self) -> Option<i64> {
        self.offset_at_ns(self.newest_arrival_ns)
    }

    /// The envelope at an instant of the monotonic clock.
    pub fn offset_at_ns(&self, monotonic_ns: u64) -> Option<i64> {
        Some(self.lowest?.key_ns.saturating_add(drift_ns(signed(monotonic_ns))))
    }

    /// The same for a sample of an earlier epoch: as it was when the epoch ended.
    pub fn offset_in_epoch_ns(&self, epoch: u32) -> Option<i64> {
        if epoch == self.epoch {
            return self.offset_ns();
        }
        self.past_epochs.iter().find(|(past, _)| *past == epoch).map(|&(_, offset_ns)| offset_ns)
    }

    /// Counts the ways in which sample times have been counted.
    pub fn epoch(&self) -> u32 {
        self.epoch
    }

    /// How often the receiver's clock was set.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// Counts how often the envelope jumped: what was found out about the latency before holds no longer.
    pub fn jumps(&self) -> u64 {
        self.jumps
    }

    /// How late samples come after the earliest possible, on average.
    pub fn mean_excess_s(&self) -> f64 {
        self.mean_excess_s
    }

    /// One standard deviation of the envelope, the constant latency aside.
    ///
    /// The lowest of n samples with exponential jitter of mean s lies s / n above the truth on average, and as much again
    /// as drift may have moved the clock since. To this comes what cannot be told apart: whether the latency or the clock
    /// moved when the newest samples all lie further above the envelope than by chance, or when the envelope had to rise.
    pub fn std_s(&self) -> f64 {
        let Some(lowest) = self.lowest else { return PRIOR_JITTER_S };
        let samples: u64 = self.buckets.iter().map(|bucket| bucket.samples).sum();
        let samples = samples as f64;
        let jitter_s = (PRIOR_JITTER_S + self.mean_excess_s * samples) / (1.0 + samples);
        let age_ns = self.newest_arrival_ns.saturating_sub(lowest.arrival_ns);
        let chance_s = jitter_s / samples.max(1.0) + drift_ns(signed(age_ns)) as f64 * 1e-9;

        let recent = || self.buckets.iter().rev().take(RECENT_BUCKETS);
        let recent_samples: u64 = recent().map(|bucket| bucket.samples).sum();
        let above_ns = match lowest_of(recent()) {
            Some(of_recent) if recent_samples >= AGREEMENT_SAMPLES.into() => {
                of_recent.key_ns.saturating_sub(lowest.key_ns)
            }
            _ => 0,
        };
        let above_s = (above_ns as f64 * 1e-9 - CHANCE_ABOVE * self.mean_excess_s).max(0.0);
        hypot(hypot(chance_s, above_s), self.rise_ns as f64 * 1e-9)
    }
}

fn lowest_of<'a>(buckets: impl Iterator<Item = &'a Bucket>) -> Option<Lowest> {
    buckets.map(|bucket| bucket.lowest).min_by_key(|lowest| lowest.key_ns)
}

fn drift_ns(span_ns: i64) -> i64 {
    span_ns / SLOWEST_DRIFT_INVERSE
}

fn signed(ns: u64) -> i64 {
    i64::try_from(ns).unwrap_or(i64::MAX)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    const LATENCY_NS: i64 = 300_000_000;
    const RECEIVER_START_NS: i64 = 77_000_000_000;
    const START_NS: i64 = 500_000_000_000;

    /// Pushes samples of `span_s`, each late by what `late` says; returns the worst error of the envelope \[s\] from the
    /// 100th sample on.
    fn run(map: &mut ClockMap, span_s: std::ops::Range<i64>, hz: i64, drift: f64, late: impl Fn(f64) -> f64) -> f64 {
        let mut worst_s = 0.0f64;
        for tick in span_s.start * hz..span_s.end * hz {
            let time_s = tick as f64 / hz as f64;
            let sample_ns = RECEIVER_START_NS + (time_s * (1.0 - drift) * 1e9) as i64;
            let taken_ns = START_NS + (time_s * 1e9) as i64;
            map.push(sample_ns, (taken_ns + LATENCY_NS + (late(time_s) * 1e9) as i64) as u64);
            let error_ns = map.offset_ns().expect("there are samples") + sample_ns - taken_ns - LATENCY_NS;
            if tick >= span_s.start * hz + 100 {
                worst_s = worst_s.max((error_ns as f64 * 1e-9).abs());
            }
        }
        worst_s
    }

    #[test]
    fn the_envelope_follows_any_drift_through_jitter() {
        for (hz, tolerance_s) in [(4, 0.012), (100, 0.004)] {
            for drift in [-100e-6, -30e-6, 0.0, 30e-6, 100e-6] {
                let rng = std::cell::RefCell::new(ChaCha8Rng::seed_from_u64(3));
                let jitter = |_| -0.04 * (1.0 - rng.borrow_mut().random::<f64>()).ln();
                let mut map = ClockMap::default();
                let worst_s = run(&mut map, 0..600, hz, drift, jitter);
                assert!(worst_s < tolerance_s, "{hz} Hz, drift {drift}: {worst_s} s");
                assert_eq!((map.epoch(), map.jumps()), (0, 0));
                // What 100 ppm may have done in a window, were they not what the clock does.
                assert!(map.std_s() < 0.013, "{}", map.std_s());
                assert!((map.mean_excess_s() - 0.04).abs() < 0.015, "{}", map.mean_excess_s());
            }
        }
    }

    #[test]
    fn what_a_stalled_line_hands_over_at_once_is_no_step() {
        let mut map = ClockMap::default();
        run(&mut map, 0..60, 100, 0.0, |_| 0.0);
        // From 60 s to 65 s nothing arrives; then all of it.
        let worst_s = run(&mut map, 60..120, 100, 0.0, |time_s| (65.0 - time_s).max(0.0));
        assert!(worst_s < 1e-3, "{worst_s}");
        assert_eq!((map.epoch(), map.steps()), (0, 0));
    }

    #[test]
    fn a_frozen_clock_is_never_believed() {
        let mut map = ClockMap::default();
        run(&mut map, 0..60, 10, 0.0, |_| 0.0);
        let last_ns = RECEIVER_START_NS + 60_000_000_000;
        let verdicts = (0..600)
            .map(|tick| map.push(last_ns, (START_NS + LATENCY_NS + 62_000_000_000 + tick * 100_000_000) as u64));
        assert!(verdicts.into_iter().all(|verdict| verdict == Verdict::Undecided));
    }

    #[test]
    fn counting_anew_moves_no_sample() {
        let mut map = ClockMap::default();
        run(&mut map, 0..10, 10, 0.0, |_| 0.0);
        let (before_ns, epoch) = (map.offset_ns().expect("samples"), map.epoch());
        map.recount(1_000_000_007);
        assert_eq!(map.offset_ns(), Some(before_ns - 1_000_000_007));
        assert_eq!(map.offset_in_epoch_ns(epoch), Some(before_ns));
        assert_eq!(map.steps(), 0);
    }

    proptest! {
        #[test]
        fn no_times_can_break_it(pushes in prop::collection::vec((any::<i64>(), any::<u64>(), 0..6u8), 0..200)) {
            let mut map = ClockMap::default();
            for (sample_ns, arrival_ns, what) in pushes {
                match what {
                    0 => map.recount(sample_ns),
                    1 => drop((0..8).map(|i| map.push(sample_ns, arrival_ns.saturating_add(i << 28))).count()),
                    _ => drop(map.push(sample_ns, arrival_ns)),
                }
                prop_assert!(map.std_s() >= 0.0);
                map.offset_at_ns(arrival_ns);
            }
        }
    }
}
