//! The page: everything in one file, nothing fetched from anywhere.

use std::fmt::Write;

use super::Report;
use super::chart::picture::font_faces;
use super::chart::plot::HALF_WIDTH_PX;
use super::chart::plot::Panel;
use super::chart::scale::{meters, number};
use super::chart::svg::{document, escaped};
use super::dataset::{Dataset, Provenance};
use super::figure::{Drawn, Figure, capitalized};
use super::figures::{cases, recall_at};
use super::methods::{Kind, Method, headline, methods};
use super::{Part, gallery};
use crate::evaluate::PositionShift;
use crate::map::Selection;
use crate::types::counted;

const STYLE: &str = include_str!("page.css");
/// Nothing may be fetched, and nothing runs.
const POLICY: &str = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; font-src data:";

pub fn html(report: &Report, parts: &[Part]) -> String {
    let names: Vec<&str> = report.datasets.iter().map(|dataset| dataset.name.as_str()).collect();
    let title = format!("Localization report: {}", names.join(", "));
    let mut page = String::new();
    let _ = write!(
        page,
        "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" \
         content=\"width=device-width, initial-scale=1\"><meta http-equiv=\"Content-Security-Policy\" \
         content=\"{POLICY}\"><meta name=\"generator\" content=\"omniloc {}\"><link rel=\"icon\" href=\"data:,\"><title>{}\
         </title><style>{}{STYLE}</style></head><body>",
        escaped(&report.program),
        escaped(&title),
        font_faces()
    );
    let _ = write!(
        page,
        "<header><div><h1>How well does it localize?</h1><p class=\"lead\">Position from one omnidirectional camera, measured \
         on {}.</p><p class=\"muted\">omniloc {}, {}. Made by</p><pre>{}</pre><nav>",
        escaped(&names.join(", ")),
        escaped(&report.program),
        escaped(&report.made),
        escaped(&report.command_line())
    );
    for dataset in &report.datasets {
        let _ = write!(page, "<a href=\"#{}\">{}</a>", dataset.id, escaped(&dataset.name));
    }
    page +=
        "<a href=\"#method\">What was done</a><a href=\"#provenance\">Data and settings</a></nav></div></header><main>";
    for (dataset, part) in report.datasets.iter().zip(parts) {
        put_dataset(&mut page, dataset, part);
    }
    put_method(&mut page, report);
    put_provenance(&mut page, report);
    page += "</main><footer>Every number on this page is in <code>report.json</code> beside it: a figure’s under \
             <code>figures</code> and its name, a table cell’s where its <code>data-source</code> says. The font is Inter, \
             SIL Open Font License 1.1.</footer></body></html>\n";
    page
}

/// Figures before the tables.
const FIRST: usize = 4;

fn put_dataset(page: &mut String, dataset: &Dataset, part: &Part) {
    let _ = write!(page, "<section id=\"{}\" class=\"dataset\"><h2>{}</h2>", dataset.id, escaped(&dataset.name));
    for warning in &dataset.warnings {
        let _ = write!(page, "<p class=\"warning\"><b>Doubtful:</b> {}</p>", escaped(warning));
    }
    put_glance(page, dataset);
    for drawn in &part.drawn[..part.drawn.len().min(FIRST)] {
        put_drawn(page, drawn);
    }
    page.push_str("<h3>Tables</h3>");
    part.tables.iter().for_each(|table| *page += &table.html());
    for drawn in part.drawn.iter().skip(FIRST) {
        put_drawn(page, drawn);
    }
    let _ = write!(page, "<h3 id=\"{}-gallery\">The worst frames</h3>", dataset.id);
    part.galleries.iter().for_each(|of_split| *page += &gallery::html(dataset, of_split));
    if part.galleries.is_empty() {
        *page += "<p class=\"left-out\">No frame has an estimate.</p>";
    }
    *page += "</section>";
}

/// What matters most, in words and large numbers.
fn put_glance(page: &mut String, dataset: &Dataset) {
    let yardstick = dataset.yardstick();
    let percent = |share: f64| format!("{} %", number(100.0 * share, 1));
    let over = |method: &Method, gross_m: f64| {
        let errors_m = method.sorted_errors_m();
        errors_m.iter().filter(|&&error_m| error_m > gross_m).count() as f64 / errors_m.len().max(1) as f64
    };
    for (split, case) in cases(dataset) {
        let all = methods(dataset, split.as_deref());
        let Some(method) = headline(&all) else { continue };
        *page += &format!("<p class=\"lead\">{}</p>", escaped(&in_words(method, &all, &case)));
        let cards: [(&str, Option<String>); 6] = [
            ("median error", method.mean(|e| e.median_m).map(|v| format!("{} m", meters(v)))),
            ("root mean square error", method.mean(|e| e.rmse_m).map(|v| format!("{} m", meters(v)))),
            ("95 % of the errors are below", method.mean(|e| e.p95_m).map(|v| format!("{} m", meters(v)))),
            (&format!("found within {} m", yardstick.near_m), Some(percent(recall_at(method, yardstick.near_m)))),
            (&format!("errors over {} m", yardstick.gross_m), Some(percent(over(method, yardstick.gross_m)))),
            ("skill: 1 is perfect, 0 knows nothing", method.mean(|e| e.skill).map(|v| number(v, 2))),
        ];
        *page += "<div class=\"cards\">";
        for (what, value) in cards {
            let _ = write!(
                page,
                "<div class=\"card\"><b>{}</b><span>{what}</span></div>",
                value.unwrap_or_else(|| "–".into())
            );
        }
        *page += "</div>";
    }
}

/// How the headline method does beside the others.
fn in_words(method: &Method, all: &[Method], case: &str) -> String {
    let seeds = method.entries.len();
    let n_test: usize = method.entries.iter().map(|entry| entry.n_test).sum();
    let mut text = match seeds {
        1 => format!("{}, {}: ", capitalized(case), counted(n_test, "frame")),
        _ => format!("{}, {n_test} test frames over {seeds} seeds: ", capitalized(case)),
    };
    let rmse = |method: &Method| method.mean(|e| e.rmse_m).map(meters).unwrap_or_else(|| "–".into());
    let _ = write!(text, "an RMSE of {} m with the {}", rmse(method), method.label);
    let others = all.iter().filter(|other| {
        other.label != method.label
            && !other.answers_labels()
            && matches!(other.kind, Kind::Whole | Kind::Nothing | Kind::Baseline)
            && other.mean(|e| e.rmse_m).is_some()
    });
    let named: Vec<String> = others.map(|other| format!("{} m {}", rmse(other), other.label)).collect();
    if !named.is_empty() {
        let _ = write!(text, ". To compare: {}", named.join(", "));
    }
    text + "."
}

fn put_drawn(page: &mut String, drawn: &Drawn) {
    match drawn {
        Drawn::Figure(figure) => put_figure(page, figure),
        Drawn::LeftOut { title, why } => {
            let _ = write!(page, "<p class=\"left-out\"><b>{}:</b> left out. {}</p>", escaped(title), escaped(why));
        }
    }
}

fn put_figure(page: &mut String, figure: &Figure) {
    let id = &figure.id;
    let _ = write!(
        page,
        "<figure class=\"figure\" id=\"{id}\" data-source=\"figures.{id}.data\"><h3>{}</h3><figcaption>{}</figcaption>",
        escaped(&figure.title),
        escaped(&figure.caption)
    );
    let mut put_panels = |panels: &[Panel], class: &str| {
        let width = panels.iter().map(|panel| panel.size_px[0]).fold(0.0, f64::max);
        let size = if width > HALF_WIDTH_PX + 1.0 {
            " full"
        } else if width > 400.0 {
            " halves"
        } else if panels.len() == 4 && width < 300.0 {
            " quarters"
        } else {
            ""
        };
        let _ = write!(page, "<div class=\"panels{class}{size}\">");
        for panel in panels {
            *page += &document(panel.size_px, &panel.shapes, &format!("{}: {}", figure.title, panel.title));
        }
        *page += "</div>";
    };
    put_panels(&figure.panels, if figure.narrow.is_empty() { "" } else { " wide-only" });
    if !figure.narrow.is_empty() {
        put_panels(&figure.narrow, " narrow");
    }
    let _ = write!(
        page,
        "<p class=\"files\"><a href=\"figures/{id}.svg\">SVG</a> · <a href=\"figures/{id}.png\">PNG</a> · numbers in <a \
         href=\"report.json\">report.json</a>, figures.{id}</p></figure>"
    );
}

fn put_method(page: &mut String, report: &Report) {
    *page += "<section id=\"method\"><h2>What was done</h2><div class=\"columns\"><div>";
    *page += "<h4>Method</h4><p>Every image is unwrapped to a panorama and described by numbers; over the plane each number \
              is a Gaussian process, learned from images at known positions. A new image is looked for among all cells of a \
              grid: it was taken where its numbers are likeliest. After Do, Jadaliha, Choi and Lim, “Feature selection for \
              position estimation using an omnidirectional camera”, Image and Vision Computing 39 (2015) 1–9. The \
              <b>paper</b> recipe follows it to the letter: whitening, a process a feature, backward elimination. The \
              <b>default</b> recipe is what measures best.</p>";
    if report.datasets.iter().any(|dataset| dataset.map.is_none()) {
        *page += "<h4>Protocol without a map</h4><p>Of every recording by itself, half of the images are learned from, a \
                  quarter chooses features (validation) and a quarter is only measured on (test): the paper’s section 5.1. \
                  The paper’s recipe is tested as learned from the first half; the default recipe and the baselines, which \
                  choose little or nothing on the validation images, learn from these too before they are tested. \
                  Either every image is drawn by itself at random, as in the paper, or the drive is cut into 20 stretches \
                  that are drawn as wholes, which is harder and more honest: then no test image lies between learned \
                  neighbours. Noisy: all positions disturbed by 0.3 m on either axis; fixed: panoramas turned by their \
                  yaw.</p>";
    }
    if report.datasets.iter().any(|dataset| dataset.map.is_some()) {
        *page += "<h4>Against a map</h4><p>Every frame of another recording against a map that was learned before. Single \
                  frames know nothing of each other; <b>filtered</b> takes them one after the other as the vehicle does, and \
                  says a position only when it is sure; <b>smoothed</b> also knows what came later.</p>";
    }
    *page += "</div><div><h4>Errors</h4><p>Distances in the plane between the estimate and the recorded position, or the one \
              given with --truth. What the receiver itself was wrong by is part of them. RMSE is the root of the mean \
              square: a single gross error weighs much in it; the median does not see them.</p>";
    *page += "<h4>Uncertainty</h4><p>A single frame’s probabilities are exp(log-likelihood / temperature) over the cells; the \
              temperature is learned from images that were held back. Its covariance is that of these probabilities about \
              the estimate. NEES is the squared error in units of the stated covariance.</p></div></div></section>";
}

fn put_provenance(page: &mut String, report: &Report) {
    *page += "<section id=\"provenance\"><h2>Data and settings</h2>";
    for dataset in &report.datasets {
        let _ = write!(page, "<h3>{}</h3>", escaped(&dataset.name));
        put_facts(page, &facts_of(&dataset.provenance));
        put_shifts(page, dataset);
        if let Some(map) = &dataset.map {
            let info = &map.info;
            let recordings = info.recordings.iter().map(|r| format!("{} ({})", r.name, counted(r.frames, "frame")));
            let groups = info
                .groups
                .iter()
                .map(|group| format!("{} ({})", group.recipe.descriptor, counted(group.features, "feature")));
            let selection = match info.selection {
                Selection::None => "none",
                Selection::Backward => "backward elimination",
            };
            *page += "<h4>The map</h4>";
            put_facts(
                page,
                &[
                    ("file", map.path.clone()),
                    ("SHA-256", map.sha256.clone()),
                    ("learned from", recordings.collect::<Vec<_>>().join(", ")),
                    ("recipe", info.recipe.name().into()),
                    ("features", groups.collect::<Vec<_>>().join(", ")),
                    ("selection", selection.into()),
                    ("cells", format!("{} at {} m", number(map.cells as f64, 0), info.grid.step_m)),
                    ("temperature", number(info.temperature, 2)),
                    ("program that learned it", format!("omniloc {}", info.program)),
                ],
            );
        }
        if !dataset.provenance.metadata.is_empty() {
            *page += "<details><summary>Metadata of the recording</summary>";
            let rows = dataset.provenance.metadata.iter();
            let rows: Vec<(String, String)> =
                rows.map(|(record, key, value)| (format!("{record}: {key}"), value.clone())).collect();
            put_facts(page, &rows.iter().map(|(key, value)| (key.as_str(), value.clone())).collect::<Vec<_>>());
            *page += "</details>";
        }
    }
    put_inputs(page, report);
    *page += "<h3>Settings</h3>";
    put_facts(page, &report.settings.iter().map(|(key, value)| (key.as_str(), value.clone())).collect::<Vec<_>>());
    let _ = write!(
        page,
        "<h4>To repeat it, with --force into the same folder</h4><pre>{}</pre></section>",
        escaped(&report.command_line())
    );
}

fn put_inputs(page: &mut String, report: &Report) {
    *page += "<h3>Files that were read</h3><div class=\"scroll\" tabindex=\"0\"><table class=\"inputs\"><thead><tr><th></th><th>file\
              </th><th>SHA-256</th></tr></thead><tbody>";
    for input in &report.inputs {
        let (file, sha256) = (escaped(&input.file), escaped(&input.sha256));
        let _ = write!(page, "<tr><th>{}</th><td>{file}</td><td><code>{sha256}</code></td></tr>", input.role);
    }
    *page += "</tbody></table></div>";
}

/// How far positions were moved before anything was learned at them.
fn put_shifts(page: &mut String, dataset: &Dataset) {
    let lines = PositionShift::lines(&dataset.shifts);
    if lines.is_empty() {
        return;
    }
    *page += "<h4>Positions that were learned from</h4>";
    for line in lines {
        let _ = write!(page, "<p>{}.</p>", escaped(&capitalized(&line)));
    }
    *page += "<p class=\"note\">Smoothing corrects what the receiver said by how a vehicle moves and by places seen more than \
              once; errors are measured against the positions as they were recorded, or against --truth. Of every trial: \
              <code>position_shifts</code> in report.json.</p>";
}

pub fn facts_of(facts: &Provenance) -> Vec<(&'static str, String)> {
    let donut = &facts.calibration;
    let mut rows = vec![
        ("file", facts.path.clone()),
        ("SHA-256", facts.sha256.clone()),
        ("frames", format!("{}, {} more not usable", number(facts.frames as f64, 0), facts.unusable)),
        (
            "way",
            format!(
                "{} m, within {} × {} m",
                number(facts.length_m, 0),
                number(facts.extent_m[0], 1),
                number(facts.extent_m[1], 1)
            ),
        ),
    ];
    rows.push(("time", facts.duration_s.map_or("not known".into(), |s| format!("{} s", number(s, 0)))));
    rows.push((
        "positions",
        match facts.position_std_m {
            Some(std_m) => {
                format!("stated to be good to {std_m:.2} m on either axis (median of the standard deviations)")
            }
            None => "their accuracy is not stated".into(),
        },
    ));
    if let Some([latitude, longitude]) = facts.origin_deg {
        rows.push(("origin", format!("{latitude:.6}° N, {longitude:.6}° E")));
    }
    rows.push(("frames with a yaw", number(facts.with_yaw as f64, 0)));
    rows.push(("camera images", format!("{} × {} px", facts.image_size_px.0, facts.image_size_px.1)));
    rows.push((
        "donut",
        format!(
            "centre ({:.1}, {:.1}), radii {:.1} to {:.1} px",
            donut.center_x_px, donut.center_y_px, donut.inner_radius_px, donut.outer_radius_px
        ),
    ));
    rows
}

fn put_facts(page: &mut String, rows: &[(&str, String)]) {
    *page += "<table class=\"facts\"><tbody>";
    for (key, value) in rows {
        let _ = write!(page, "<tr><th>{}</th><td>{}</td></tr>", escaped(key), escaped(value));
    }
    *page += "</tbody></table>";
}
