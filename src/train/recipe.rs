//! Recipes: which features, scaled how, modelled how, selected how.

use serde::{Deserialize, Serialize};

use super::noise_whitening;
use crate::features::Descriptor;
use crate::features::scaling::ScalingMethod;
use crate::gp::fit::Bounds;
use crate::localize::NoiseModel;

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
    /// Backward sequential elimination.
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

/// One descriptor's part of a recipe.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GroupRecipe {
    pub descriptor: Descriptor,
    pub model: Model,
    pub noise: NoiseModel,
    /// Factor on the group's log-likelihood where groups are summed.
    pub weight: f64,
}

/// How a descriptor becomes features and Gaussian processes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Model {
    /// Scaled by `scaling`; every feature with hyperparameters of its own, within `bounds`.
    EachFeature { scaling: ScalingMethod, bounds: Bounds },
    /// Noise-whitened features that share their hyperparameters.
    SharedField(noise_whitening::Settings),
}

impl Recipe {
    /// The recipe `name` over `descriptors`; the recipe's own choice where that is empty.
    pub fn new(name: RecipeName, descriptors: &[Descriptor]) -> Self {
        match name {
            RecipeName::Paper => Self::paper(if descriptors.is_empty() { &Descriptor::PAPER } else { descriptors }),
            RecipeName::Default => Self::default_over(if descriptors.is_empty() { &DEFAULT } else { descriptors }),
        }
    }

    fn paper(descriptors: &[Descriptor]) -> Self {
        let model = Model::EachFeature { scaling: ScalingMethod::Whitening, bounds: Bounds::PAPER };
        let group = |&descriptor| GroupRecipe { descriptor, model, noise: NoiseModel::Gaussian, weight: 1.0 };
        Self {
            name: RecipeName::Paper,
            groups: descriptors.iter().map(group).collect(),
            selection: Selection::Backward,
            refine: false,
            refit: false,
        }
    }

    fn default_over(descriptors: &[Descriptor]) -> Self {
        let model =
            Model::SharedField(noise_whitening::Settings { features: 96, length_scale_spacings: 1.75, ridge: 0.05 });
        let group = |&descriptor| GroupRecipe { descriptor, model, noise: NoiseModel::UnknownScale, weight: 1.0 };
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

/// Descriptors of the default recipe.
const DEFAULT: [Descriptor; 3] = [Descriptor::Gradient, Descriptor::GradientUnsigned, Descriptor::GradientCoarse];
/// Perturbed copies of every learning image.
pub const PERTURBED_COPIES: usize = 2;
