//! The methods that are compared: their names, their colours, and their errors over all seeds.

use super::chart::color::{BLACK, BLUE, BROWN, GREEN, MUTED, OLIVE, ORANGE, PURPLE, SKY, VERMILION};
use super::dataset::Dataset;
use crate::evaluate::statistics::{self, Comparison, MethodStatistics, Statistics};
use crate::evaluate::{Entry, FrameEntry, emax_m};
use crate::features::Descriptor;
use crate::types::PositionM;

/// What takes a whole drive has the same colour in every figure.
pub const FILTERED: &str = GREEN;
pub const SMOOTHED: &str = PURPLE;

/// All plain results of one method on one split.
#[derive(Debug, Clone)]
pub struct Method<'a> {
    pub label: String,
    pub color: &'static str,
    pub dashes: Option<&'static str>,
    pub kind: Kind,
    /// One a seed.
    pub entries: Vec<&'a Entry>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// A recipe with everything it has, or an estimator that takes a whole drive.
    Whole,
    /// One type of features of a recipe.
    Part,
    /// Something simpler.
    Baseline,
    /// Always the same answer.
    Nothing,
}

/// One frame's error.
#[derive(Debug, Clone, Copy)]
pub struct FrameError {
    pub index: usize,
    pub seed: Option<u64>,
    pub truth_m: PositionM,
    pub estimate_m: PositionM,
    pub error_m: f64,
}

impl<'a> Method<'a> {
    /// The method of an entry, without its entries.
    fn of(entry: &Entry) -> Self {
        let features = entry.features.as_str();
        let is_baseline = entry.recipe.is_none();
        let is_sequence = entry.estimator != "single";
        let (label, color, dashes, kind) = match (entry.recipe, features) {
            (_, "filtered") => ("filtered".to_owned(), FILTERED, Some("12 3"), Kind::Whole),
            (_, "smoothed") => ("smoothed".to_owned(), SMOOTHED, Some("5 2"), Kind::Whole),
            (_, "median") => ("always the median".to_owned(), MUTED, Some("2 3"), Kind::Nothing),
            (Some(recipe), "fused") => {
                let (color, dashes) = recipe_look(recipe);
                (format!("{}, all features", recipe_name(recipe)), color, dashes, Kind::Whole)
            }
            (Some(recipe), of_type) => {
                let color = if recipe == "paper" { ORANGE } else { SKY };
                (format!("{}, {}", recipe_name(recipe), feature_name(of_type)), color, type_dashes(of_type), Kind::Part)
            }
            (None, baseline) => {
                let (name, color, dashes) = baseline_name(baseline);
                (name, color, dashes, Kind::Baseline)
            }
        };
        let kind = if is_sequence { Kind::Whole } else { kind };
        let kind = if is_baseline && kind == Kind::Part { Kind::Baseline } else { kind };
        Self { label, color, dashes, kind, entries: Vec::new() }
    }

    /// Whether its answers are labels, which are right where they are named rightly, and no positions (Do et al. 2015, eq.
    /// 15): errors of these are not to be compared with those of the others.
    pub fn answers_labels(&self) -> bool {
        matches!(self.entries[0].features.as_str(), "bow" | "bow-surf")
    }

    /// What an entry's method is called.
    pub fn name_of(entry: &Entry) -> String {
        Method::of(entry).label
    }

    /// What the statistics' method is called.
    pub fn name_of_parts(of: &statistics::Method) -> String {
        let (recipe, features, estimator) = (of.recipe, of.features.clone(), of.estimator);
        Self::name_of(&Entry { recipe, features, estimator, ..Entry::default() })
    }

    /// Errors of all frames that have an estimate, seed after seed.
    pub fn errors(&self) -> Vec<FrameError> {
        let of_entry = |entry: &&'a Entry| {
            let frames = entry.frames.iter().flatten();
            let seed = entry.seed;
            frames.filter_map(move |frame| frame_error(frame, seed)).collect::<Vec<_>>()
        };
        self.entries.iter().flat_map(of_entry).collect()
    }

    /// Error \[m\] of every frame that has one, in rising order.
    pub fn sorted_errors_m(&self) -> Vec<f64> {
        let mut errors_m: Vec<f64> = self.errors().iter().map(|frame| frame.error_m).collect();
        errors_m.sort_unstable_by(f64::total_cmp);
        errors_m
    }

    /// What bootstrap draws say of it.
    pub fn statistics<'b>(&self, of: &'b Statistics) -> Option<&'b MethodStatistics> {
        let first = self.entries[0];
        of.methods.iter().find(|method| {
            let (section, found) = (&method.section, &method.method);
            section.split == first.split
                && (section.noisy, section.fixed) == (first.noisy, first.fixed)
                && (found.recipe, &found.features, found.estimator) == (first.recipe, &first.features, first.estimator)
        })
    }

    /// How it compares with the method that its table is about.
    pub fn comparison<'b>(&self, of: &'b Statistics) -> Option<&'b Comparison> {
        let first = self.entries[0];
        of.comparisons.iter().find(|comparison| {
            let (section, found) = (&comparison.section, &comparison.method);
            section.split == first.split
                && (section.noisy, section.fixed) == (first.noisy, first.fixed)
                && (found.recipe, &found.features, found.estimator) == (first.recipe, &first.features, first.estimator)
        })
    }

    /// Largest error of all seeds \[m\].
    pub fn emax_m(&self) -> Option<f64> {
        emax_m(&self.entries)
    }

    /// Mean over the seeds.
    pub fn mean(&self, of: impl Fn(&Entry) -> Option<f64>) -> Option<f64> {
        let values: Option<Vec<f64>> = self.entries.iter().map(|entry| of(entry)).collect();
        values.filter(|values| !values.is_empty()).map(|values| values.iter().sum::<f64>() / values.len() as f64)
    }
}

fn frame_error(frame: &FrameEntry, seed: Option<u64>) -> Option<FrameError> {
    let (truth_m, estimate_m) = ([frame.truth_e_m, frame.truth_n_m], [frame.est_e_m?, frame.est_n_m?]);
    let error_m = crate::types::distance_m(truth_m, estimate_m);
    Some(FrameError { index: frame.index, seed, truth_m, estimate_m, error_m })
}

/// The plain methods of a split (`None`: against a map), those that matter most first.
pub fn methods<'a>(dataset: &'a Dataset, split: Option<&str>) -> Vec<Method<'a>> {
    let mut methods: Vec<Method> = Vec::new();
    for entry in &dataset.entries {
        if entry.split.as_deref() != split || entry.noisy || entry.fixed {
            continue;
        }
        let same = |method: &&mut Method| method.entries[0].row_key() == entry.row_key();
        match methods.iter_mut().find(same) {
            Some(method) => method.entries.push(entry),
            None => methods.push(Method { entries: vec![entry], ..Method::of(entry) }),
        }
    }
    // A recipe of one type of features stands for itself.
    for recipe in ["default", "paper"] {
        let of_recipe =
            |method: &&mut Method| method.entries[0].recipe == Some(recipe) && method.entries[0].estimator == "single";
        let mut own: Vec<&mut Method> = methods.iter_mut().filter(of_recipe).collect();
        if let [only] = &mut own[..] {
            only.kind = Kind::Whole;
            (only.color, only.dashes) = recipe_look(recipe);
        }
    }
    methods.sort_by_key(|method| (method.kind, method.entries[0].recipe != Some("default")));
    methods
}

/// The method that a report is about: what `localize` would say, frame by frame.
pub fn headline<'a, 'b>(methods: &'b [Method<'a>]) -> Option<&'b Method<'a>> {
    let whole = |method: &&Method| method.kind == Kind::Whole && method.entries[0].estimator == "single";
    methods
        .iter()
        .find(|method| whole(method) && method.entries[0].recipe == Some("default"))
        .or_else(|| methods.iter().find(whole))
}

/// Colour and dashes of a recipe with all it has.
pub fn recipe_look(recipe: &str) -> (&'static str, Option<&'static str>) {
    if recipe == "paper" { (VERMILION, Some("16 3 3 3")) } else { (BLUE, None) }
}

/// A recipe in words.
pub fn recipe_name(recipe: &str) -> &str {
    match recipe {
        "paper" => "paper’s recipe",
        "default" => "default recipe",
        other => other,
    }
}

/// A feature type in words.
pub fn feature_name(name: &str) -> String {
    match name {
        "fft" => "FFT",
        "hist" => "histogram",
        "sp" => "steerable pyramid",
        "gradient" => "gradients",
        "patch-words" => "patch words",
        "fused" => "all features",
        other => other,
    }
    .into()
}

fn type_dashes(name: &str) -> Option<&'static str> {
    match name.parse() {
        Ok(Descriptor::Fft | Descriptor::Gradient) => None,
        Ok(Descriptor::Hist) => Some("6 3"),
        Ok(Descriptor::Sp) => Some("2 2"),
        Ok(Descriptor::Patches) => Some("8 3 2 3"),
        _ => Some("1 3"),
    }
}

fn baseline_name(name: &str) -> (String, &'static str, Option<&'static str>) {
    match name {
        "bow" => ("bag of words, paper’s rule".into(), BLACK, Some("6 3")),
        "bow-nearest" => ("bag of words, nearest image".into(), BLACK, None),
        "bow-surf" => ("bag of words, SURF".into(), BLACK, Some("2 2")),
        "bow-surf-nearest" => ("bag of words, SURF, nearest image".into(), BLACK, Some("8 3 2 3")),
        "nearest" => ("nearest image by features".into(), BROWN, Some("10 2 2 2")),
        "aligned" => ("nearest image, aligned".into(), OLIVE, Some("4 2 1 2 1 2")),
        other => (other.into(), MUTED, Some("1 2")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// On paper without colours only the dashes are left.
    #[test]
    fn methods_that_stand_together_differ_in_colour_and_in_dashes() {
        let of = |recipe, features: &str| {
            let estimator = if matches!(features, "filtered" | "smoothed") { "filtered" } else { "single" };
            Method::of(&Entry { recipe, features: features.into(), estimator, ..Entry::default() })
        };
        let baselines = || ["nearest", "aligned", "bow-nearest", "median"].map(|name| of(None, name));
        let with_map = ["fused", "filtered", "smoothed"].map(|name| of(Some("default"), name));
        let in_protocol = ["paper", "default"].map(|recipe| of(Some(recipe), "fused"));
        for methods in [
            with_map.into_iter().chain(baselines()).collect::<Vec<_>>(),
            in_protocol.into_iter().chain(baselines()).collect(),
        ] {
            for (i, a) in methods.iter().enumerate() {
                for b in &methods[..i] {
                    assert!(a.color != b.color, "{} and {}", a.label, b.label);
                    // What is whole is drawn thicker than baselines.
                    assert!((a.dashes, a.kind) != (b.dashes, b.kind), "{} and {}", a.label, b.label);
                }
            }
        }
    }

    #[test]
    fn every_result_has_a_name_and_its_place() {
        let entry = |recipe, features: &str| Entry {
            recipe,
            features: features.into(),
            estimator: "single",
            ..Entry::default()
        };
        let of = |entry: &Entry| {
            let method = Method::of(entry);
            (method.label, method.kind)
        };
        for (recipe, features, label, kind) in [
            (Some("paper"), "fused", "paper’s recipe, all features", Kind::Whole),
            (Some("paper"), "sp", "paper’s recipe, steerable pyramid", Kind::Part),
            (None, "bow", "bag of words, paper’s rule", Kind::Baseline),
            (None, "something new", "something new", Kind::Baseline),
            (None, "median", "always the median", Kind::Nothing),
        ] {
            assert_eq!(of(&entry(recipe, features)), (label.into(), kind));
        }
        let sequence = Entry { estimator: "filtered", ..entry(Some("default"), "filtered") };
        assert_eq!(of(&sequence), ("filtered".into(), Kind::Whole));
    }
}
