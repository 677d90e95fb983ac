//! Recipes: which features, scaled how, modelled how, selected how.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::features::Descriptor;
use crate::features::scaling::ScalingMethod;
use crate::gp::Hyperparameters;
use crate::gp::fit::{Bounds, Fit, Warning};

/// The recipes the program knows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum RecipeName {
    /// Do et al. (2015) to the letter: whitening, a Gaussian process a feature, backward elimination.
    Paper,
    /// What measures best.
    Default,
}

impl RecipeName {
    pub fn name(self) -> &'static str {
        match self {
            Self::Paper => "paper",
            Self::Default => "default",
        }
    }
}

/// How features are chosen on the validation images.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Selection {
    /// All are kept.
    None,
    /// Backward sequential elimination: the paper's.
    Backward,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Recipe {
    pub name: RecipeName,
    pub groups: Vec<GroupRecipe>,
    pub selection: Selection,
    /// Look for the summit between the cells.
    pub refine: bool,
    /// Learn from the validation frames too once nothing is left to choose: only without a selection.
    pub refit: bool,
}

/// How the residuals d_i = z_i − μ_i of a group of k features add up to a log-likelihood, with the predictive variances
/// p_i = σ_e² + v_i:
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum NoiseModel {
    /// −½ Σ (d_i²/p_i + log p_i + log 2π): Do et al. (2015), eqs. 10 and 11.
    Gaussian,
    /// −k/2 log Σ d_i² − ¼ Σ log p_i. The first term is noise of one unknown scale a frame, at its most likely value:
    /// light and traffic change a frame's residuals together, and a frame that fits nowhere well is not trusted k times
    /// over. The second is half of what eq. 10 charges for not knowing. With all of it, frames in the gaps of a survey are
    /// drawn to the next image; with none (which is what dividing d_i² by p_i as well leaves), frames of another day,
    /// whose features are fainter, are sent to cells off the survey's path, where the predicted mean is faint too.
    UnknownScale,
}

/// One descriptor's part of a recipe.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GroupRecipe {
    pub descriptor: Descriptor,
    pub model: Model,
    pub noise: NoiseModel,
}

/// How a descriptor becomes features and Gaussian processes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Model {
    /// Scaled by `scaling`; every feature with hyperparameters of its own, within `bounds`.
    EachFeature { scaling: ScalingMethod, bounds: Bounds },
    /// Noise-whitened features that share their hyperparameters.
    SharedField(NoiseWhiteningSettings),
}

/// How noise-whitened features are learned.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NoiseWhiteningSettings {
    /// At most this many features.
    pub features: usize,
    /// Length scale as a multiple of the median distance to the nearest learning position.
    pub length_scale_spacings: f64,
    /// Added to the noise covariance, as a share of its mean eigenvalue: directions never seen to vary are not thereby
    /// free of noise.
    pub ridge: f64,
}

impl Recipe {
    /// The recipe `name` over `descriptors`, each once; the recipe's own choice where that is empty.
    pub fn new(name: RecipeName, descriptors: &[Descriptor]) -> Self {
        let mut descriptors = descriptors.to_vec();
        let mut seen = Vec::new();
        descriptors.retain(|descriptor| {
            !seen.contains(descriptor) && {
                seen.push(*descriptor);
                true
            }
        });
        match name {
            RecipeName::Paper => Self::paper(if descriptors.is_empty() { &Descriptor::PAPER } else { &descriptors }),
            RecipeName::Default => Self::default_over(if descriptors.is_empty() { &DEFAULT } else { &descriptors }),
        }
    }

    fn paper(descriptors: &[Descriptor]) -> Self {
        let model = Model::EachFeature { scaling: ScalingMethod::Whitening, bounds: Bounds::PAPER };
        let group = |&descriptor| GroupRecipe { descriptor, model, noise: NoiseModel::Gaussian };
        Self {
            name: RecipeName::Paper,
            groups: descriptors.iter().map(group).collect(),
            selection: Selection::Backward,
            refine: false,
            refit: false,
        }
    }

    fn default_over(descriptors: &[Descriptor]) -> Self {
        let group = |&descriptor| {
            // Words vary in thousands of ways, of which few learning images see few: they are taken nearly as they are.
            let ridge = if descriptor == Descriptor::PatchWords { 2.0 } else { 0.05 };
            let settings = NoiseWhiteningSettings { features: FEATURES_A_GROUP, length_scale_spacings: 1.5, ridge };
            let model = Model::SharedField(settings);
            GroupRecipe { descriptor, model, noise: NoiseModel::UnknownScale }
        };
        Self {
            name: RecipeName::Default,
            groups: descriptors.iter().map(group).collect(),
            selection: Selection::None,
            refine: true,
            refit: true,
        }
    }

    /// The same recipe with another way of choosing features.
    pub fn with_selection(self, selection: Selection) -> Self {
        Self { selection, refit: self.refit && selection == Selection::None, ..self }
    }

    pub fn descriptors(&self) -> Vec<Descriptor> {
        self.groups.iter().map(|group| group.descriptor).collect()
    }

    /// Descriptors whose reaction to perturbations the recipe uses.
    pub fn perturbed(&self) -> Vec<Descriptor> {
        let shared = |group: &&GroupRecipe| matches!(group.model, Model::SharedField(_));
        self.groups.iter().filter(shared).map(|group| group.descriptor).collect()
    }
}

/// At most: with 96 more frames are taken for another place, with 300 no fewer (docs/ablation.md).
const FEATURES_A_GROUP: usize = 192;
/// Descriptors of the default recipe.
const DEFAULT: [Descriptor; 3] = [Descriptor::Gradient, Descriptor::Patches, Descriptor::PatchWords];
/// Perturbed copies of every learning image.
pub const PERTURBED_COPIES: usize = 2;

/// How frames are split.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum SplitKind {
    /// Every frame on its own, at random: the paper's. Test frames lie between their own neighbours.
    Random,
    /// Contiguous stretches of the drive, at random: the nearest learning frames may be far.
    Blocked,
}

/// Hyperparameters of a group's Gaussian processes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum GroupHyperparameters {
    /// One fit a feature.
    Each(Vec<Fit>),
    /// The same for all features.
    Shared(Hyperparameters),
}

impl GroupHyperparameters {
    /// What the fits have to say, each with the number of features it holds for.
    pub fn warnings(&self) -> BTreeMap<Warning, usize> {
        let mut counts = BTreeMap::new();
        if let Self::Each(fits) = self {
            for &warning in fits.iter().flat_map(|fit| &fit.warnings) {
                *counts.entry(warning).or_default() += 1;
            }
        }
        counts
    }
}
