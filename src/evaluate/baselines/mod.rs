//! What one would try before a map of Gaussian processes, on the same frames.
//!
//! - [`nearest`]: the position of the learning image with the most similar properties;
//! - [`aligned`]: the position of the learning image whose panorama, turned, is most like this one;
//! - [`bag_of_words`]: Do et al. (2015), section 5.3, with the words of [`LocalDescriptors`] of either kind.
//!
//! Each gets what the recipes get: the learning frames to learn from, the validation frames to choose on and then to learn
//! from too. None sees where the test frames are.

pub mod aligned;
pub mod bag_of_words;
mod codebook;
pub mod nearest;
mod rows;
#[cfg(feature = "surf")]
pub mod surf;
mod views;

pub use bag_of_words::{AssignedFrame, AssignedTest, WordAssignment};
pub use rows::{BaselineRows, Frames};
pub use views::{LocalDescriptors, Views};

/// A method to compare with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Baseline {
    /// Only the answer that knows nothing
    None,
    /// Nearest learning image by z-scored properties
    Nearest,
    /// Nearest learning image by circular correlation of small panoramas
    Aligned,
    /// Bag of words of upright patches: the paper's protocol, and the nearest learning image
    Bow,
    /// Bag of words of SURF
    BowSurf,
}

impl Baseline {
    /// As rows and arguments name it.
    pub fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Nearest => "nearest",
            Self::Aligned => "aligned",
            Self::Bow => "bow",
            Self::BowSurf => "bow-surf",
        }
    }

    /// Whether it needs the images that are learned from, which a map does not hold.
    pub fn compares_images(self) -> bool {
        matches!(self, Self::Aligned | Self::Bow | Self::BowSurf)
    }

    /// Whether this build has it, or why not.
    pub fn check(self) -> Result<(), &'static str> {
        match self {
            Self::BowSurf if cfg!(not(feature = "surf")) => Err(
                "this build has no SURF, which may be patented: see CONTRIBUTING.md, then build with --features surf",
            ),
            _ => Ok(()),
        }
    }
}
