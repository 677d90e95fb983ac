//! Panorama → descriptor → features.
//!
//! A *descriptor* is the vector of image properties y of one panorama; a *feature* is one entry of it after scaling
//! (whitening or z-score).

// The same estimates on every computer.
#![cfg_attr(not(test), deny(clippy::disallowed_methods))]

mod fft;
mod gradient;
mod histogram;
mod patches;
pub mod scaling;
mod steerable;
mod words;

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::panorama::Panorama;
use gradient::GradientSignature;
pub use gradient::{COMPASS_BYTES, COMPASS_HARMONICS};
pub use patches::{COEFFICIENTS as PATCH_COEFFICIENTS, Patch};
use patches::{KernelMean, Patches};
use steerable::SteerablePyramid;
use words::PatchWords;

/// A kind of image properties.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Descriptor {
    /// Fourier magnitudes along both axes: the paper's FFT.
    Fft,
    /// Gray histogram: the paper's Histogram.
    Hist,
    /// Steerable pyramid: the paper's SP.
    Sp,
    /// Fourier signature of gradient orientations.
    Gradient,
    /// Kernel mean of the patches all around.
    Patches,
    /// Patches aggregated by what they resemble.
    PatchWords,
}

impl Descriptor {
    pub const ALL: [Self; 6] = [Self::Fft, Self::Hist, Self::Sp, Self::Gradient, Self::Patches, Self::PatchWords];
    /// The three the paper evaluates.
    pub const PAPER: [Self; 3] = [Self::Fft, Self::Hist, Self::Sp];

    /// Number of properties d.
    pub fn dimensions(self) -> usize {
        match self {
            Self::Fft => fft::DIMENSIONS,
            Self::Hist => histogram::DIMENSIONS,
            Self::Sp => steerable::DIMENSIONS,
            Self::Gradient => gradient::DIMENSIONS,
            Self::Patches => patches::DIMENSIONS,
            Self::PatchWords => words::DIMENSIONS,
        }
    }

    /// The name used in arguments, maps and tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Fft => "fft",
            Self::Hist => "hist",
            Self::Sp => "sp",
            Self::Gradient => "gradient",
            Self::Patches => "patches",
            Self::PatchWords => "patch-words",
        }
    }
}

impl fmt::Display for Descriptor {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.pad(self.name())
    }
}

#[derive(Debug, thiserror::Error)]
#[error("unknown feature type `{found}`; known are {}", Descriptor::ALL.map(Descriptor::name).join(", "))]
pub struct UnknownDescriptor {
    found: String,
}

impl FromStr for Descriptor {
    type Err = UnknownDescriptor;

    fn from_str(name: &str) -> Result<Self, Self::Err> {
        let known = Self::ALL.into_iter().find(|descriptor| descriptor.name() == name);
        known.ok_or_else(|| UnknownDescriptor { found: name.to_owned() })
    }
}

impl TryFrom<String> for Descriptor {
    type Error = UnknownDescriptor;

    fn try_from(name: String) -> Result<Self, Self::Error> {
        name.parse()
    }
}

impl From<Descriptor> for String {
    fn from(descriptor: Descriptor) -> Self {
        descriptor.name().to_owned()
    }
}

/// Descriptors that are made of the orientations of gradients.
const OF_ORIENTATIONS: [Descriptor; 3] = [Descriptor::Gradient, Descriptor::Patches, Descriptor::PatchWords];

/// Computes descriptors, with the plans and buffers they need: nothing is allocated per frame.
pub struct Describer {
    fft: fft::FftDescriptor,
    pyramid: SteerablePyramid<f32>,
    gradient: GradientSignature,
    patches: Patches,
    kernel_mean: KernelMean,
    words: PatchWords,
}

impl Default for Describer {
    fn default() -> Self {
        Self::new()
    }
}

impl Describer {
    pub fn new() -> Self {
        Self {
            fft: fft::FftDescriptor::new(),
            pyramid: SteerablePyramid::new(),
            gradient: GradientSignature::new(),
            patches: Patches::new(),
            kernel_mean: KernelMean::new(),
            words: PatchWords::new(),
        }
    }

    /// The `descriptors` of `panorama`, each into its own of `properties`. What several of them need is computed once.
    ///
    /// # Panics
    /// When one of `properties` is not [`Descriptor::dimensions`] long.
    pub fn describe(&mut self, descriptors: &[Descriptor], panorama: &Panorama, properties: &mut [Vec<f32>]) {
        let wanted = |of: &[Descriptor]| descriptors.iter().any(|descriptor| of.contains(descriptor));
        if wanted(&OF_ORIENTATIONS) {
            self.gradient.look(panorama);
        }
        if wanted(&[Descriptor::Patches, Descriptor::PatchWords]) {
            self.patches.look(self.gradient.orientations());
        }
        for (&descriptor, properties) in descriptors.iter().zip(properties) {
            assert_eq!(properties.len(), descriptor.dimensions(), "room for the properties of {descriptor}");
            match descriptor {
                Descriptor::Fft => self.fft.describe(panorama, properties),
                Descriptor::Hist => histogram::describe(panorama, properties),
                Descriptor::Sp => self.pyramid.describe(panorama, properties),
                Descriptor::Gradient => self.gradient.describe(properties),
                Descriptor::Patches => self.kernel_mean.describe(self.patches.all(), properties),
                Descriptor::PatchWords => self.words.describe(self.patches.all(), properties),
            }
        }
    }

    /// The patches of `panorama`, from all around and every elevation: the local descriptors that
    /// [`Descriptor::Patches`] and [`Descriptor::PatchWords`] are made of.
    pub fn patches(&mut self, panorama: &Panorama) -> &[Patch] {
        self.gradient.look(panorama);
        self.patches.look(self.gradient.orientations());
        self.patches.all()
    }

    /// The compass signature of `panorama`, [`COMPASS_BYTES`] long. Costs next to nothing right after a description of the
    /// same panorama with a descriptor of gradient orientations.
    pub fn compass(&mut self, described: &[Descriptor], panorama: &Panorama, signature: &mut [i8]) {
        if !described.iter().any(|descriptor| OF_ORIENTATIONS.contains(descriptor)) {
            self.gradient.look(panorama);
        }
        self.gradient.compass(signature);
    }

    /// Vectors of the right lengths for [`describe`](Self::describe).
    pub fn room_for(descriptors: &[Descriptor]) -> Vec<Vec<f32>> {
        descriptors.iter().map(|descriptor| vec![0.0; descriptor.dimensions()]).collect()
    }
}
