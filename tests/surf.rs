//! SURF against mahotas, an implementation that has nothing of ours, on real photographs.
#![cfg(feature = "surf")]

mod common;

use std::f64::consts::PI;
use std::fmt;
use std::path::Path;
use std::process::Command;

use omniloc::evaluate::baselines::surf::{self, SurfPoint, SurfSettings};
use omniloc::jpeg::LumaDecoder;
use omniloc::types::wrap_angle_rad;

/// A point of the other implementation.
#[derive(serde::Deserialize)]
struct Other {
    x: f64,
    y: f64,
    scale: f64,
    orientation: f64,
    descriptor: Vec<f64>,
}

/// Some hundred points a photograph.
const THRESHOLD: f64 = 100.0;
/// mahotas weighs the mixed derivative so, and the publication so.
const WEIGHT_OF_MAHOTAS: f64 = 0.6;
const WEIGHT_PUBLISHED: f64 = 0.9;

#[test]
fn points_and_descriptors_are_those_of_mahotas() {
    let Some(python) = common::python() else { return };
    let folder = tempfile::TempDir::new().expect("a temporary folder");
    let (mut alike, mut published) = (Matches::default(), Matches::default());
    for index in [0, 20, 40, 60] {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("samples/courtyard-75/images/{index:04}.jpg"));
        let jpeg = std::fs::read(path).expect("the sample is shipped");
        let mut decoder = LumaDecoder::new();
        let image = decoder.decode(&jpeg).expect("a photograph");
        let raw = folder.path().join("gray");
        std::fs::write(&raw, &image.pixels).expect("writes");
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/surf.py");
        let mut command = Command::new(&python);
        command.arg(script).arg(&raw).arg(image.width_px.to_string()).arg(THRESHOLD.to_string());
        let output = command.output().expect("OMNILOC_PYTHON runs");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let others: Vec<Other> = serde_json::from_slice(&output.stdout).expect("JSON");

        let pixels: Vec<f32> = image.pixels.iter().map(|&gray| f32::from(gray)).collect();
        for (cross_weight, matches) in [(WEIGHT_OF_MAHOTAS, &mut alike), (WEIGHT_PUBLISHED, &mut published)] {
            let ours = surf::describe(&pixels, image.width_px, &SurfSettings { threshold: THRESHOLD, cross_weight });
            let inside = |point: &&SurfPoint| is_inside(point, image.width_px, image.height_px);
            ours.iter().filter(inside).for_each(|point| matches.add(point, &others));
        }
    }
    for (weight, matches) in [(WEIGHT_OF_MAHOTAS, &mut alike), (WEIGHT_PUBLISHED, &mut published)] {
        matches.correlations.sort_by(f64::total_cmp);
        println!("weight {weight}: {matches}");
    }
    assert!(alike.points > 1000 && alike.share(alike.found) > 0.98 && alike.share(alike.exact) > 0.95, "{alike}");
    assert!(published.share(published.found) > 0.75, "{published}");
    for matches in [alike, published] {
        assert!(matches.turned_alike as f64 > 0.7 * matches.found as f64, "{matches}");
        assert!(matches.correlation(0.5) > 0.95 && matches.correlation(0.1) > 0.9, "{matches}");
    }
}

/// How our points and those of mahotas belong together.
#[derive(Default)]
struct Matches {
    points: usize,
    /// Within a pixel and a fifth of the scale; within a tenth of a pixel.
    found: usize,
    exact: usize,
    /// Of these, with an orientation within 10°.
    turned_alike: usize,
    /// Of their descriptors, where mahotas' wavelets have an even width: those of an odd width have halves of unequal area.
    correlations: Vec<f64>,
}

impl Matches {
    fn add(&mut self, point: &SurfPoint, others: &[Other]) {
        self.points += 1;
        let away = |other: &Other| (other.x - point.x_px).hypot(other.y - point.y_px);
        let near = others.iter().filter(|other| away(other) <= 1.0 && (other.scale / point.scale_px).ln().abs() < 0.2);
        let Some(other) = near.min_by(|a, b| away(a).total_cmp(&away(b))) else { return };
        self.found += 1;
        self.exact += usize::from(away(other) <= 0.1);
        if wrap_angle_rad(point.orientation_rad - other.orientation).abs() < PI / 18.0 {
            self.turned_alike += 1;
            if ((2.0 * other.scale + 0.5) as usize).is_multiple_of(2) {
                self.correlations.push(correlation(point, other));
            }
        }
    }

    fn share(&self, part: usize) -> f64 {
        part as f64 / self.points as f64
    }

    /// The correlation that this share of the descriptors is below.
    fn correlation(&self, share: f64) -> f64 {
        self.correlations[((self.correlations.len() - 1) as f64 * share) as usize]
    }
}

impl fmt::Display for Matches {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(
            f,
            "{} points, {:.1} % of them within a pixel of one of mahotas, {:.1} % within a tenth; {} of {} with an \
             orientation within 10 deg; correlation of descriptors: median {:.3}, tenth {:.3}",
            self.points,
            100.0 * self.share(self.found),
            100.0 * self.share(self.exact),
            self.turned_alike,
            self.found,
            self.correlation(0.5),
            self.correlation(0.1)
        )
    }
}

/// Whether mahotas looks there: as far from the border as its largest filter of the octave and its descriptor reach.
fn is_inside(point: &SurfPoint, width: usize, height: usize) -> bool {
    let border = [18.0, 66.0, 252.0][if point.scale_px < 3.2 {
        0
    } else if point.scale_px < 6.4 {
        1
    } else {
        2
    }];
    let border = f64::max(border, 15.5 * point.scale_px) + 1.0;
    let within = |at: f64, size: usize| at > border && at + border < size as f64;
    within(point.x_px, width) && within(point.y_px, height)
}

fn correlation(point: &SurfPoint, other: &Other) -> f64 {
    let ours: Vec<f64> = point.descriptor.iter().map(|&d| f64::from(d)).collect();
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
    let (a, b) = (mean(&ours), mean(&other.descriptor));
    let product = |x: &[f64], y: &[f64], a: f64, b: f64| x.iter().zip(y).map(|(x, y)| (x - a) * (y - b)).sum::<f64>();
    product(&ours, &other.descriptor, a, b)
        / (product(&ours, &ours, a, a) * product(&other.descriptor, &other.descriptor, b, b)).sqrt()
}
