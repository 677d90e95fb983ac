//! Whether to believe what was found, and why not.

use super::fit::{Fit, RimSupport, tolerance_px};
use super::search::Candidate;
use super::{DonutEstimate, FindDonutError, RimEvidence, Verdict};

/// One thing a donut has to show: what is measured, below which value it is refused, and where all is well.
struct Check {
    value: f64,
    refused: f64,
    good: f64,
    words: String,
}

impl Check {
    /// 0 where refused or worse, 1 where good or better, straight between.
    fn confidence(&self) -> f64 {
        ((self.value - self.refused) / (self.good - self.refused)).clamp(0.0, 1.0)
    }
}

/// At half the way between refused and good the result is called sure.
const SURE_CONFIDENCE: f64 = 0.5;

/// The limits come from the four data sets (rises of 0.65 and more, support of 0.84 and more in every single frame),
/// from synthetic donuts at night, out of focus and in noise, and from 366 photographs, pages, noise images and parts of
/// donuts, each of which fails at least one of the first four checks.
pub(super) fn judge(candidate: &Candidate, fit: &Fit, frames_used: u32) -> Result<DonutEstimate, FindDonutError> {
    let percent = |share: f64| format!("{:.0} %", 100.0 * share);
    let rims = [("inner", &fit.inner, candidate.inner_rise), ("outer", &fit.outer, candidate.outer_rise)];
    let mut checks = Vec::new();
    for (rim, support, rise) in rims {
        checks.push(Check {
            value: support.supported,
            refused: 0.5,
            good: 0.85,
            words: format!("only {} of the visible {rim} rim have an edge on the circle", percent(support.supported)),
        });
        checks.push(Check {
            value: f64::from(rise),
            refused: 0.4,
            good: 0.6,
            words: format!("the {rim} rim hardly stands out from what is beyond it ({rise:.2} of 1)"),
        });
    }
    // What follows makes a result doubtful, never refused: the circles are there.
    checks.push(Check {
        value: fit.outer.visible,
        refused: 0.4,
        good: 0.8,
        words: format!("only {} of the outer rim lie in the image", percent(fit.outer.visible)),
    });
    let tolerance_px = tolerance_px(fit.circles.outer_radius_px);
    checks.push(Check {
        value: -fit.center_disagreement_px,
        refused: -3.0 * tolerance_px,
        good: -tolerance_px,
        words: format!("the rims' centres are {:.1} px apart", fit.center_disagreement_px),
    });
    let worst_std_px = fit.deviations_px.into_iter().fold(0.0, f64::max);
    checks.push(Check {
        value: -worst_std_px,
        refused: -1.5,
        good: -0.5,
        words: format!("standard deviations of up to {worst_std_px:.1} px"),
    });

    if let Some(failed) = checks[..4].iter().find(|check| check.confidence() == 0.0) {
        return Err(FindDonutError::NotFound { reason: failed.words.clone() });
    }
    let confidence = checks.iter().map(Check::confidence).fold(1.0, f64::min);
    let doubts: Vec<String> =
        checks.into_iter().filter(|check| check.confidence() < SURE_CONFIDENCE).map(|check| check.words).collect();
    let evidence = |rim: &RimSupport| RimEvidence { visible: rim.visible, supported: rim.supported };
    let [center_x_px, center_y_px] = fit.circles.center_px;
    let [center_x_std_px, center_y_std_px, inner_radius_std_px, outer_radius_std_px] = fit.deviations_px;
    Ok(DonutEstimate {
        center_x_px,
        center_y_px,
        inner_radius_px: fit.circles.inner_radius_px,
        outer_radius_px: fit.circles.outer_radius_px,
        center_x_std_px,
        center_y_std_px,
        inner_radius_std_px,
        outer_radius_std_px,
        inner_rim: evidence(&fit.inner),
        outer_rim: evidence(&fit.outer),
        center_disagreement_px: fit.center_disagreement_px,
        wander_px: None,
        confidence,
        verdict: if doubts.is_empty() { Verdict::Sure } else { Verdict::Doubtful(doubts) },
        frames_used,
    })
}
