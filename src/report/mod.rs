//! The report: one page that says how good a map is, where it fails and how it compares, with the numbers beside it.
//!
//! ```text
//! evaluation ─► Dataset ─► figures, tables, gallery ─► index.html, figures/*.svg and *.png, report.json
//! ```
//!
//! A [`Dataset`] collects what an evaluation of one recording brings; [`Report::write`] draws it. A *figure* is a row of
//! panels with a caption and its data: what is drawn is drawn from the very numbers that go into the JSON. Behind the
//! feature `report`, which a vehicle does not need.

mod chart;
mod dataset;
mod figure;
mod figures;
mod gallery;
mod insight;
mod methods;
mod page;
mod photograph;
mod tables;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use serde_json::{Map, Value, json};

pub use dataset::{Dataset, MapFacts};
pub use gallery::GalleryError;
pub use insight::InsightError;

use chart::picture::{PictureError, rasterized};
use figure::{Drawn, Figure};
use gallery::Gallery;
use tables::Table;

use crate::evaluate::InputFile;
use crate::gnss::date_of_day;
use crate::recording::{Recording, RecordingError, write_bytes_atomically};

/// Pixels of a PNG for each of the drawing.
const PNG_SCALE: f32 = 2.0;

#[derive(Debug, Clone)]
pub struct Report {
    /// Version of the program.
    pub program: String,
    /// When: date and time, UTC.
    pub made: String,
    /// As it was typed.
    pub command: Vec<String>,
    /// Options and what they were.
    pub settings: Vec<(String, String)>,
    /// The files that were read.
    pub inputs: Vec<InputFile>,
    pub datasets: Vec<Dataset>,
}

#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    #[error("cannot make the folder {folder}")]
    Folder { folder: PathBuf, source: std::io::Error },
    #[error(transparent)]
    Write(#[from] RecordingError),
    #[error(transparent)]
    Gallery(#[from] GalleryError),
    #[error("figure {id}")]
    Picture { id: String, source: PictureError },
}

/// What is drawn of one dataset.
struct Part {
    drawn: Vec<Drawn>,
    tables: Vec<Table>,
    /// One a split.
    galleries: Vec<Gallery>,
}

/// What is being done, for a progress display.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ReportStep {
    Reading,
    Drawing { figures: usize },
    Drawn,
}

impl Report {
    /// Writes the report into `folder`. `recordings` are those of the datasets; `surveys`, what their map was learned from,
    /// are only needed to show its images.
    pub fn write(
        mut self,
        folder: &Path,
        recordings: &[Recording],
        surveys: &[Recording],
        on_step: impl Fn(ReportStep) + Sync,
    ) -> Result<(), ReportError> {
        self.name_apart();
        on_step(ReportStep::Reading);
        let mut parts = Vec::new();
        for (dataset, recording) in self.datasets.iter_mut().zip(recordings) {
            let shown = BTreeSet::from([figures::shown_row(dataset)]);
            dataset.photographs = gallery::photographs(recording, &shown)?;
            let galleries = gallery::galleries(dataset, recording, surveys)?;
            parts.push(Part { drawn: figures::all(dataset), tables: tables::all(dataset), galleries });
        }
        let figures_folder = folder.join("figures");
        let make = |folder: &Path| {
            std::fs::create_dir_all(folder).map_err(|source| ReportError::Folder { folder: folder.into(), source })
        };
        make(&figures_folder)?;
        let figures: Vec<&Figure> = parts.iter().flat_map(|part| &part.drawn).filter_map(figure_of).collect();
        on_step(ReportStep::Drawing { figures: figures.len() });
        figures.par_iter().try_for_each(|figure| {
            let svg = figure.whole();
            let png = rasterized(&svg, PNG_SCALE);
            let png = png.map_err(|source| ReportError::Picture { id: figure.id.clone(), source })?;
            write_bytes_atomically(&figures_folder.join(format!("{}.svg", figure.id)), svg.as_bytes())?;
            write_bytes_atomically(&figures_folder.join(format!("{}.png", figure.id)), &png)?;
            on_step(ReportStep::Drawn);
            Ok::<_, ReportError>(())
        })?;
        let json = format!("{:#}\n", self.json(&parts));
        write_bytes_atomically(&folder.join("report.json"), json.as_bytes())?;
        // Last: where there is a page, there is everything it refers to.
        write_bytes_atomically(&folder.join("index.html"), page::html(&self, &parts).as_bytes())?;
        Ok(())
    }

    /// Datasets of the same name get different addresses, and none that the page itself uses.
    fn name_apart(&mut self) {
        let mut taken: BTreeSet<String> = ["method", "provenance"].map(String::from).into();
        for dataset in &mut self.datasets {
            let wanted = dataset.id.clone();
            let mut number = 2;
            while !taken.insert(dataset.id.clone()) {
                dataset.id = format!("{wanted}-{number}");
                number += 1;
            }
        }
    }

    /// The command, as a shell takes it.
    fn command_line(&self) -> String {
        let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_./=,:+@%".contains(c);
        let quoted = |argument: &String| {
            let plain = !argument.is_empty() && argument.chars().all(is_plain);
            if plain { argument.clone() } else { format!("'{}'", argument.replace('\'', "'\\''")) }
        };
        self.command.iter().map(quoted).collect::<Vec<_>>().join(" ")
    }

    fn json(&self, parts: &[Part]) -> Value {
        let (mut figures, mut tables, mut left_out, mut galleries) = (Map::new(), Map::new(), Vec::new(), Map::new());
        for (dataset, part) in self.datasets.iter().zip(parts) {
            for drawn in &part.drawn {
                match drawn {
                    Drawn::Figure(figure) => {
                        let id = &figure.id;
                        let files = [format!("figures/{id}.svg"), format!("figures/{id}.png")];
                        let object = json!({
                            "dataset": dataset.id, "title": figure.title, "caption": figure.caption, "files": files,
                            "data": figure.data,
                        });
                        figures.insert(id.clone(), object);
                    }
                    Drawn::LeftOut { title, why } => {
                        left_out.push(json!({"dataset": dataset.id, "title": title, "why": why}));
                    }
                }
            }
            part.tables.iter().for_each(|table| _ = tables.insert(table.id.clone(), table.json()));
            galleries.insert(dataset.id.clone(), part.galleries.iter().map(gallery::json).collect());
        }
        let datasets = self.datasets.iter().map(|dataset| {
            let facts: Map<String, Value> =
                page::facts_of(&dataset.provenance).into_iter().map(|(key, value)| (key.into(), json!(value))).collect();
            json!({
                "id": dataset.id,
                "name": dataset.name,
                "facts": facts,
                "map": dataset.map.as_ref().map(|map| json!({"file": map.path, "sha256": map.sha256, "info": map.info})),
                "results": dataset.entries,
                "statistics": dataset.statistics,
                "position_shifts": dataset.shifts,
                "warnings": dataset.warnings,
            })
        });
        json!({
            "program": self.program,
            "made": self.made,
            "command": self.command,
            "settings": self.settings.iter().cloned().collect::<std::collections::BTreeMap<_, _>>(),
            "inputs": self.inputs,
            "datasets": datasets.collect::<Vec<_>>(),
            "tables": tables,
            "figures": figures,
            "left_out": left_out,
            "worst_frames": galleries,
        })
    }
}

fn figure_of(drawn: &Drawn) -> Option<&Figure> {
    match drawn {
        Drawn::Figure(figure) => Some(figure),
        Drawn::LeftOut { .. } => None,
    }
}

/// `seconds` since 1970 as date and time, UTC.
pub fn utc_text(seconds: u64) -> String {
    let (year, month, day) = date_of_day((seconds / 86_400) as i64);
    format!("{year:04}-{month:02}-{day:02} {:02}:{:02} UTC", seconds / 3600 % 24, seconds / 60 % 60)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(command: &[&str]) -> Report {
        Report {
            program: "0".into(),
            made: String::new(),
            command: command.iter().map(|argument| (*argument).to_owned()).collect(),
            settings: Vec::new(),
            inputs: Vec::new(),
            datasets: Vec::new(),
        }
    }

    #[test]
    fn the_command_can_be_pasted_into_a_shell() {
        let line =
            report(&["omniloc", "evaluate", "my drive.mcap", "--split=a,b", "it's", "", "$(reboot)"]).command_line();
        assert_eq!(line, r"omniloc evaluate 'my drive.mcap' --split=a,b 'it'\''s' '' '$(reboot)'");
    }

    #[test]
    fn dates_are_those_of_the_calendar() {
        for (seconds, expected) in [
            (0, "1970-01-01 00:00 UTC"),
            (951_782_399, "2000-02-28 23:59 UTC"),
            (951_782_400, "2000-02-29 00:00 UTC"),
            (1_796_025_600, "2026-11-30 08:00 UTC"),
        ] {
            assert_eq!(utc_text(seconds), expected);
        }
    }
}
