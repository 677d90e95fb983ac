//! Unknown, candidate, localized, lost: when a position may be said.
//!
//! ```text
//!            one place likely            sure for a while
//! unknown ───────────────────► candidate ────────────────► localized
//!    ▲                           │    ▲                       │
//!    └───────────────────────────┘    │ likely                │ contradicted, unlike the map, or not sure
//!                                     └──────── lost ◄────────┘
//! ```
//!
//! Log-likelihoods are calibrated: what a map's temperature makes of them are probabilities, and thresholds are
//! probabilities too, not a matter of taste. What a frame of no place in the map looks like is learned with the map.

use crate::types::{EstimateWarnings, LocalizationState};

/// What the filter found after a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Evidence {
    /// Of the belief's hill.
    pub probability: f64,
    /// How much likelier the frame finds another place \[nats\].
    pub contradiction: f64,
    /// How much likelier the frame is at its best place than at none \[nats\].
    pub resemblance: Option<f64>,
    /// What the frame is worth: 0..1 of a frame that errs independently of those before it.
    pub share: f64,
}

/// The belief is wrong about the place less often than this.
const SURE: f64 = 0.99;
/// Once localized, it stays so down to here.
const STILL_SURE: f64 = 0.9;
/// More likely than not.
const LIKELY: f64 = 0.5;
/// A frame that finds another place exp(5) = 150 times likelier contradicts.
const CONTRADICTED: f64 = 5.0;
/// Sure for so many independent frames before a position is said.
const SETTLED: f64 = 3.0;
/// Weight of an independent frame in the mean resemblance.
const RESEMBLANCE_WEIGHT: f64 = 0.1;

#[derive(Debug, Clone)]
pub struct StateMachine {
    /// Frames of no place in the map resemble it less than this; `None` where the map does not say.
    least_resemblance: Option<f64>,
    state: LocalizationState,
    mean_resemblance: Option<f64>,
    /// Independent frames in a row for which the belief was sure and not contradicted.
    settled: f64,
    has_been_localized: bool,
}

impl StateMachine {
    pub fn new(least_resemblance: Option<f64>) -> Self {
        Self {
            least_resemblance,
            state: LocalizationState::Unknown,
            mean_resemblance: None,
            settled: 0.0,
            has_been_localized: false,
        }
    }

    pub fn start_again(&mut self) {
        *self = Self::new(self.least_resemblance);
    }

    pub fn state(&self) -> LocalizationState {
        self.state
    }

    /// Too long without a frame: what was known is not known any more.
    pub fn lose(&mut self) {
        self.settled = 0.0;
        if self.state == LocalizationState::Localized {
            self.state = LocalizationState::Lost;
        }
    }

    /// The state after a frame, and what is unusual about it.
    pub fn take(&mut self, evidence: &Evidence) -> (LocalizationState, EstimateWarnings) {
        let is_unlike = self.is_unlike(evidence);
        let is_contradicted = evidence.contradiction > CONTRADICTED;
        let fits = !is_unlike && !is_contradicted;
        let least = if self.state == LocalizationState::Localized { STILL_SURE } else { SURE };
        let is_sure = fits && evidence.probability >= least;
        self.settled = if is_sure { (self.settled + evidence.share).min(SETTLED) } else { 0.0 };
        self.state = if is_sure && self.settled >= SETTLED {
            self.has_been_localized = true;
            LocalizationState::Localized
        } else if self.state == LocalizationState::Localized {
            LocalizationState::Lost
        } else if fits && evidence.probability >= LIKELY {
            LocalizationState::Candidate
        } else if self.has_been_localized {
            LocalizationState::Lost
        } else {
            LocalizationState::Unknown
        };
        let warnings = EstimateWarnings {
            bad_frame: false,
            unlike_the_map: is_unlike,
            contradiction: is_contradicted,
            ambiguous: evidence.probability < LIKELY,
        };
        (self.state, warnings)
    }

    /// Whether the frames of late resemble no place of the map.
    fn is_unlike(&mut self, evidence: &Evidence) -> bool {
        let (Some(resemblance), Some(least)) = (evidence.resemblance, self.least_resemblance) else { return false };
        let before = self.mean_resemblance.unwrap_or(resemblance);
        let mean = before + RESEMBLANCE_WEIGHT * evidence.share * (resemblance - before);
        self.mean_resemblance = Some(mean);
        mean < least
    }
}

#[cfg(test)]
mod tests {
    use LocalizationState::{Candidate, Localized, Lost, Unknown};

    use super::*;

    const GOOD: Evidence = Evidence { probability: 0.999, contradiction: 0.0, resemblance: Some(5.0), share: 1.0 };

    fn states(frames: &[Evidence]) -> Vec<LocalizationState> {
        let mut machine = StateMachine::new(Some(-12.0));
        frames.iter().map(|evidence| machine.take(evidence).0).collect()
    }

    #[test]
    fn nothing_is_said_before_it_is_sure_for_a_while() {
        let unsure = Evidence { probability: 0.3, ..GOOD };
        assert_eq!(states(&[unsure, GOOD, GOOD, GOOD, GOOD]), [Unknown, Candidate, Candidate, Localized, Localized]);
        let likely = Evidence { probability: 0.8, ..GOOD };
        assert_eq!(states(&[GOOD, GOOD, likely, GOOD, GOOD, GOOD])[5], Localized);
        assert_eq!(states(&[GOOD, GOOD, likely, GOOD, GOOD])[4], Candidate);
        // Thirty frames a second are not thirty witnesses.
        let quick = Evidence { share: 0.1, ..GOOD };
        let said = states(&[quick; 40]).iter().filter(|state| **state == Localized).count();
        assert!((8..=11).contains(&said), "{said}");
    }

    #[test]
    fn one_contradiction_is_enough_to_be_silent() {
        let elsewhere = Evidence { contradiction: 9.0, ..GOOD };
        let found = states(&[GOOD, GOOD, GOOD, elsewhere, GOOD, GOOD, GOOD]);
        assert_eq!(found[2..], [Localized, Lost, Candidate, Candidate, Localized]);
        let less_sure = Evidence { probability: 0.95, ..GOOD };
        assert_eq!(states(&[GOOD, GOOD, GOOD, less_sure])[3], Localized);
    }

    #[test]
    fn frames_of_another_place_are_not_localized_however_sure_the_belief() {
        let strange = Evidence { resemblance: Some(-17.0), ..GOOD };
        assert!(states(&[strange; 50]).iter().all(|state| *state == Unknown));
        let mut drive_out = vec![GOOD; 10];
        drive_out.extend([strange; 20]);
        let found = states(&drive_out);
        let until = found.iter().position(|state| *state == Lost).expect("noticed");
        assert!((10..28).contains(&until), "{until}");
        assert!(found[until..].iter().all(|state| *state == Lost));
    }
}
