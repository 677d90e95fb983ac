//! The worst frames, with what explains them: the image, where it was and was thought to be, and what was learned there.

use std::collections::{BTreeMap, BTreeSet};

use serde_json::{Value, json};

use super::chart::color::{FAINT, GRID, INK, PAPER, VERMILION};
use super::chart::map_plot::Extent;
use super::chart::plot::NOTE;
use super::chart::scale::meters;
use super::chart::svg::{Paint, Shapes, document, escaped};
use super::dataset::Dataset;
use super::figure::capitalized;
use super::figures::{cases, extent_of};
use super::methods::{FrameError, headline, methods};
use super::photograph::Photograph;
use crate::jpeg::JpegError;
use crate::panorama::UnwrapTable;
use crate::recording::{Recording, RecordingError};
use crate::types::{CalibrationError, PositionM, distance_m};

/// Frames that are shown of a split, by the number of splits: few enough to be looked at.
fn shown_of_a_split(splits: usize) -> usize {
    match splits {
        0 | 1 => 6,
        2 => 4,
        _ => 3,
    }
}

/// A frame and why it may have gone wrong.
#[derive(Debug, Clone)]
pub struct Worst {
    pub frame: FrameError,
    pub photograph: Photograph,
    /// The learning image nearest to where it was taken, and to where it was thought to be.
    pub at_truth: Option<Neighbour>,
    pub at_answer: Option<Neighbour>,
}

#[derive(Debug, Clone)]
pub struct Neighbour {
    pub recording: String,
    pub index: usize,
    pub position_m: PositionM,
    pub photograph: Photograph,
}

/// What is shown of a split, before any image is read.
#[derive(Debug, Clone)]
pub struct Chosen {
    pub method: String,
    /// The split whose test frames they are, and what it is; no split against a map.
    pub split: Option<String>,
    pub case: String,
    pub frames: Vec<FrameError>,
    /// Learning frames of each of them.
    learning: Vec<Vec<LearningFrame>>,
}

#[derive(Debug, Clone, Copy)]
struct LearningFrame {
    /// Number of the recording, and row in it.
    place: (usize, usize),
    position_m: PositionM,
}

/// A split's worst frames.
#[derive(Debug, Clone)]
pub struct Gallery {
    pub chosen: Chosen,
    pub worst: Vec<Worst>,
}

#[derive(Debug, thiserror::Error)]
pub enum GalleryError {
    #[error(transparent)]
    Recording(#[from] RecordingError),
    #[error(transparent)]
    Calibration(#[from] CalibrationError),
    #[error("frame {index}")]
    Frame { index: usize, source: JpegError },
}

/// The worst frames of every split. `surveys` are what a map was learned from.
pub fn galleries(
    dataset: &Dataset,
    recording: &Recording,
    surveys: &[Recording],
) -> Result<Vec<Gallery>, GalleryError> {
    let cases = cases(dataset);
    let count = shown_of_a_split(cases.len());
    let chosen = cases.into_iter().filter_map(|(split, case)| choose(dataset, surveys, split, case, count));
    let galleries = read(chosen.collect(), dataset, recording, surveys)?;
    Ok(galleries.into_iter().filter(|gallery| !gallery.worst.is_empty()).collect())
}

/// The worst `count` frames of the headline method on a split, each once.
fn choose(
    dataset: &Dataset,
    surveys: &[Recording],
    split: Option<String>,
    case: String,
    count: usize,
) -> Option<Chosen> {
    let all = methods(dataset, split.as_deref());
    let method = headline(&all)?;
    let mut errors = method.errors();
    errors.sort_by(|a, b| b.error_m.total_cmp(&a.error_m).then(a.index.cmp(&b.index)));
    let mut seen = BTreeSet::new();
    errors.retain(|frame| seen.insert(frame.index));
    errors.truncate(count);
    let learning_of = |frame: &FrameError| -> Vec<LearningFrame> {
        if dataset.map.is_some() {
            let of = surveys.iter().enumerate();
            return of
                .flat_map(|(i, recording)| {
                    let rows = recording.survey.iter().enumerate();
                    rows.map(move |(row, f)| LearningFrame { place: (i, row), position_m: f.position_m })
                })
                .collect();
        }
        let shown = dataset.splits.iter().find(|shown| Some(&shown.name) == split.as_ref() && shown.seed == frame.seed);
        let Some(shown) = shown else { return Vec::new() };
        let entry = method.entries.iter().find(|entry| entry.seed == frame.seed);
        let refits = entry.is_some_and(|entry| entry.n_learned_from > entry.n_learning);
        let validation = if refits { &shown.split.validation[..] } else { &[] };
        let rows = shown.split.learning.iter().chain(validation);
        rows.map(|&row| LearningFrame { place: (0, row), position_m: dataset.frames[row].position_m }).collect()
    };
    let learning = errors.iter().map(learning_of).collect();
    Some(Chosen { method: method.label.clone(), split, case, frames: errors, learning })
}

/// Reads the images of what was chosen; every recording once.
fn read(
    all: Vec<Chosen>,
    dataset: &Dataset,
    recording: &Recording,
    surveys: &[Recording],
) -> Result<Vec<Gallery>, GalleryError> {
    let row_of = |index: usize| dataset.frames.iter().position(|frame| frame.index == index);
    let sources: Vec<&Recording> = if dataset.map.is_some() { surveys.iter().collect() } else { vec![recording] };
    let (mut own, mut wanted) = (BTreeSet::new(), vec![BTreeSet::new(); sources.len()]);
    for chosen in &all {
        for (frame, learning) in chosen.frames.iter().zip(&chosen.learning) {
            own.extend(row_of(frame.index));
            for (source, row) in near_ends(frame, learning).into_iter().flatten() {
                wanted[source].insert(row);
            }
        }
    }
    let own = photographs(recording, &own)?;
    let learned = sources.iter().zip(&wanted).map(|(source, rows)| photographs(source, rows));
    let learned = learned.collect::<Result<Vec<_>, _>>()?;
    let neighbour = |place: Option<(usize, usize)>| {
        let (source, row) = place?;
        let frame = &sources[source].survey[row];
        let (index, position_m) = (frame.index, frame.position_m);
        let photograph = learned[source].get(&row)?.clone();
        Some(Neighbour { recording: sources[source].name.clone(), index, position_m, photograph })
    };
    let of_chosen = |chosen: Chosen| {
        let worst = chosen.frames.iter().zip(&chosen.learning).filter_map(|(frame, learning)| {
            let photograph = own.get(&row_of(frame.index)?)?.clone();
            let [at_truth, at_answer] = near_ends(frame, learning).map(&neighbour);
            Some(Worst { frame: *frame, photograph, at_truth, at_answer })
        });
        Gallery { worst: worst.collect(), chosen }
    };
    Ok(all.into_iter().map(of_chosen).collect())
}

/// The places of the learning frames nearest to where a frame was taken, and to where it was thought to be.
fn near_ends(frame: &FrameError, learning: &[LearningFrame]) -> [Option<(usize, usize)>; 2] {
    [frame.truth_m, frame.estimate_m].map(|to| {
        let apart_m = |one: &LearningFrame| distance_m(one.position_m, to);
        learning.iter().min_by(|a, b| apart_m(a).total_cmp(&apart_m(b))).map(|one| one.place)
    })
}

/// Photographs of the frames at `rows`.
pub fn photographs(recording: &Recording, rows: &BTreeSet<usize>) -> Result<BTreeMap<usize, Photograph>, GalleryError> {
    let mut found = BTreeMap::new();
    let Some(&last) = rows.last() else { return Ok(found) };
    let donut = recording.calibration()?;
    let mut table: Option<UnwrapTable> = None;
    for (row, frame) in recording.frames()?.enumerate().take(last + 1) {
        let (frame, jpeg) = frame?;
        if !rows.contains(&row) {
            continue;
        }
        let table = match &table {
            Some(table) => table,
            None => {
                let mut decoder = crate::jpeg::LumaDecoder::new();
                let image =
                    decoder.decode(&jpeg).map_err(|source| GalleryError::Frame { index: frame.index, source })?;
                table.insert(UnwrapTable::build(&donut, image.width_px, image.height_px)?)
            }
        };
        let photograph = Photograph::of(&jpeg, &donut, table, frame.yaw_rad);
        found.insert(row, photograph.map_err(|source| GalleryError::Frame { index: frame.index, source })?);
    }
    Ok(found)
}

/// A split's worst frames as HTML.
pub fn html(dataset: &Dataset, Gallery { chosen, worst }: &Gallery) -> String {
    let mut html = format!(
        "<h4>{}</h4><p class=\"before-gallery\">The largest errors of the <b>{}</b>, each frame once. Panoramas begin to the east where the yaw is \
         known, so that those of one place look alike.</p><div class=\"gallery\">",
        escaped(&capitalized(&chosen.case)),
        escaped(&chosen.method),
    );
    for (i, one) in worst.iter().enumerate() {
        let seed = one.frame.seed.map(|seed| format!(", seed {seed}")).unwrap_or_default();
        html += &format!(
            "<article class=\"worst\"><h5>Frame {}{seed}: {} m off</h5><div class=\"pair\">\
             <img src=\"{}\" alt=\"camera image of frame {}\" width=\"320\" height=\"320\">{}</div>{}",
            one.frame.index,
            meters(one.frame.error_m),
            one.photograph.donut,
            one.frame.index,
            small_map(dataset, &one.frame, &chosen.learning[i]),
            panorama("this frame", &one.photograph)
        );
        match &one.at_truth {
            Some(near) => {
                let apart_m = distance_m(near.position_m, one.frame.truth_m);
                html += &panorama(
                    &format!("nearest learning image, {} m from the truth ({})", meters(apart_m), near.name()),
                    &near.photograph,
                );
            }
            None if dataset.map.is_some() => {
                html += "<p class=\"note\">A map holds no images: name the recordings it was learned from with --survey to see \
                         the nearest one.</p>";
            }
            None => {}
        }
        if let Some(near) = &one.at_answer
            && one.at_truth.as_ref().is_none_or(|other| other.index != near.index)
        {
            let apart_m = distance_m(near.position_m, one.frame.estimate_m);
            html += &panorama(
                &format!("learning image at the answer, {} m from it ({})", meters(apart_m), near.name()),
                &near.photograph,
            );
        }
        html += "</article>";
    }
    html + "</div>"
}

impl Neighbour {
    fn name(&self) -> String {
        format!("{} of {}", self.index, self.recording)
    }
}

fn panorama(what: &str, photograph: &Photograph) -> String {
    format!(
        "<figure class=\"strip\"><img src=\"{}\" alt=\"panorama: {what}\" width=\"512\" height=\"128\"><figcaption>{what}\
         </figcaption></figure>",
        photograph.panorama,
        what = escaped(what)
    )
}

/// Where it was and where it was thought to be, with a bar for scale in place of axes.
fn small_map(dataset: &Dataset, frame: &FrameError, learning: &[LearningFrame]) -> String {
    const SIDE_PX: f64 = 240.0;
    const BELOW_PX: f64 = 24.0;
    let Extent { low_m, high_m } = extent_of(dataset);
    let scale = SIDE_PX / (high_m[0] - low_m[0]).max(high_m[1] - low_m[1]);
    let size = [(high_m[0] - low_m[0]) * scale, (high_m[1] - low_m[1]) * scale];
    let at = |[e, n]: PositionM| [(e - low_m[0]) * scale, (high_m[1] - n) * scale];
    let mut shapes = Shapes::default();
    shapes.rect([0.0, 0.0], size, Paint::fill(PAPER).outlined(GRID, 1.0));
    // Where the images that the map was learned from are not there, their positions are.
    let of_map = dataset.insights.first().filter(|_| dataset.map.is_some()).map(|insight| &insight.learning_m[..]);
    let learned = learning.iter().map(|one| one.position_m).chain(of_map.unwrap_or_default().iter().copied());
    learned.for_each(|position_m| shapes.circle(at(position_m), 1.2, Paint::fill(FAINT)));
    let (truth, estimate) = (at(frame.truth_m), at(frame.estimate_m));
    shapes.line(truth, estimate, Paint::stroke(VERMILION, 1.6));
    shapes.circle(truth, 5.0, Paint::fill(PAPER).outlined(INK, 2.0));
    shapes.diamond(estimate, 6.0, Paint::fill(VERMILION).outlined(PAPER, 1.0));
    let bar_m = [0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0]
        .into_iter()
        .rfind(|bar_m| bar_m * scale < 0.4 * size[0])
        .unwrap_or(0.1);
    let y = size[1] + 12.0;
    shapes.line([0.0, y], [bar_m * scale, y], Paint::stroke(INK, 2.0));
    shapes.text([bar_m * scale + 6.0, y + 4.0], &format!("{bar_m} m"), NOTE);
    let label = format!("truth (ring) and estimate (diamond) of frame {}", frame.index);
    document([size[0] + 1.0, size[1] + BELOW_PX], &shapes, &label)
}

pub fn json(Gallery { chosen, worst }: &Gallery) -> Value {
    let near = |neighbour: &Option<Neighbour>| {
        neighbour.as_ref().map(|n| json!({"recording": n.recording, "index": n.index, "position_m": n.position_m}))
    };
    let frames = worst.iter().map(|one| {
        json!({
            "index": one.frame.index,
            "seed": one.frame.seed,
            "truth_m": one.frame.truth_m,
            "estimate_m": one.frame.estimate_m,
            "error_m": one.frame.error_m,
            "nearest_learning_image": near(&one.at_truth),
            "learning_image_at_the_answer": near(&one.at_answer),
        })
    });
    json!({"method": chosen.method, "split": chosen.split, "frames": frames.collect::<Vec<_>>()})
}
