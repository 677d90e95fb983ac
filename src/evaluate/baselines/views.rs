//! What the baselines keep of every frame's image.

use super::Baseline;
use super::aligned::{Signature, Signatures};
use super::bag_of_words::BagOfWords;
use crate::features::{Describer, PATCH_COEFFICIENTS};
use crate::panorama::Panorama;
use crate::recording::Recording;
use crate::train::{SurveyError, describe_panoramas};

/// Local descriptors of every frame, d numbers each.
#[derive(Debug, Clone, PartialEq)]
pub struct LocalDescriptors {
    d: usize,
    values: Vec<f32>,
    /// Where every frame's descriptors end, counted in descriptors.
    ends: Vec<usize>,
}

impl LocalDescriptors {
    pub fn new(d: usize) -> Self {
        Self { d, values: Vec::new(), ends: Vec::new() }
    }

    /// Adds a frame.
    pub fn push(&mut self, descriptors: &[f32]) {
        self.values.extend(descriptors);
        self.ends.push(self.values.len() / self.d);
    }

    /// Number of frames.
    pub fn len(&self) -> usize {
        self.ends.len()
    }

    pub fn is_empty(&self) -> bool {
        self.ends.is_empty()
    }

    /// Numbers of a descriptor.
    pub fn dimensions(&self) -> usize {
        self.d
    }

    fn range(&self, row: usize) -> std::ops::Range<usize> {
        let begin = row.checked_sub(1).map_or(0, |before| self.ends[before]);
        begin..self.ends[row]
    }

    /// Number of descriptors of a frame.
    pub fn count(&self, row: usize) -> usize {
        self.range(row).len()
    }

    pub fn of_frame(&self, row: usize) -> &[f32] {
        let range = self.range(row);
        &self.values[range.start * self.d..range.end * self.d]
    }

    pub fn of_frames(&self, rows: &[usize]) -> Vec<f32> {
        rows.iter().flat_map(|&row| self.of_frame(row)).copied().collect()
    }
}

/// The views of all frames of some recordings, one after the other; only those that were asked for.
#[derive(Default)]
pub struct Views {
    pub aligned: Option<Vec<Signature>>,
    pub bow: Option<BagOfWords>,
    pub bow_surf: Option<BagOfWords>,
}

/// One frame.
#[derive(Default)]
struct View {
    aligned: Signature,
    patches: Vec<f32>,
    surf: Vec<f32>,
}

impl Views {
    /// Reads what `wanted` need of all usable frames of `recordings`, in order; `fixed`: every panorama is turned by its
    /// yaw. `on_frames` is told how many more are done.
    ///
    /// # Errors
    /// Those of reading a survey.
    pub fn read(
        recordings: &[&Recording],
        wanted: &[Baseline],
        fixed: bool,
        on_frames: impl Fn(usize),
    ) -> Result<Self, SurveyError> {
        let wants = |baseline: Baseline| wanted.contains(&baseline);
        if !wants(Baseline::Aligned) && !wants(Baseline::Bow) && !wants(Baseline::BowSurf) {
            return Ok(Self::default());
        }
        let signatures = Signatures::new();
        let view = |describer: &mut Describer, panorama: &Panorama| View {
            aligned: if wants(Baseline::Aligned) { signatures.of(panorama) } else { Vec::new() },
            patches: if wants(Baseline::Bow) {
                describer.patches(panorama).as_flattened().to_vec()
            } else {
                Vec::new()
            },
            surf: if wants(Baseline::BowSurf) { surf(panorama) } else { Vec::new() },
        };
        let mut views = Vec::new();
        for recording in recordings {
            let describe = |describer: &mut Describer, _, panorama: &Panorama| view(describer, panorama);
            let take = |_, view| views.push(view);
            describe_panoramas(recording, fixed, Describer::new, describe, take, &on_frames)?;
        }
        let words = |d: usize, of: fn(&View) -> &Vec<f32>| {
            let mut local = LocalDescriptors::new(d);
            views.iter().for_each(|view| local.push(of(view)));
            BagOfWords::new(local)
        };
        Ok(Self {
            bow: wants(Baseline::Bow).then(|| words(PATCH_COEFFICIENTS, |view| &view.patches)),
            bow_surf: wants(Baseline::BowSurf).then(|| words(SURF_DIMENSIONS, |view| &view.surf)),
            aligned: wants(Baseline::Aligned).then(|| views.into_iter().map(|view| view.aligned).collect()),
        })
    }
}

const SURF_DIMENSIONS: usize = 64;

#[cfg(feature = "surf")]
fn surf(panorama: &Panorama) -> Vec<f32> {
    super::surf::describe_panorama(panorama).into_iter().flat_map(|point| point.descriptor).collect()
}

/// Never asked for: [`Baseline::check`].
#[cfg(not(feature = "surf"))]
fn surf(_: &Panorama) -> Vec<f32> {
    Vec::new()
}
