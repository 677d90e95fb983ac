//! Tables: the shapes of Do et al. (2015), tables 1 to 3, and one that tells more. Every cell has its number in the JSON.

use serde_json::{Map, Value, json};

use super::chart::scale::{meters, number};
use super::chart::svg::escaped;
use super::dataset::Dataset;
use super::figures::{RECALL_AT_M, cases, recall_at};
use super::methods::{Kind, Method, feature_name, methods};
use crate::evaluate::statistics::{Estimate, p_text};
use crate::evaluate::{Entry, emax_m};
use crate::types::counted;

#[derive(Debug, Clone)]
pub struct Table {
    pub id: String,
    pub title: String,
    pub note: String,
    pub columns: Vec<Column>,
    pub rows: Vec<Row>,
}

#[derive(Debug, Clone)]
pub struct Column {
    /// In the JSON.
    pub key: &'static str,
    pub label: &'static str,
    /// Over several columns.
    pub group: &'static str,
}

#[derive(Debug, Clone)]
pub struct Row {
    pub label: String,
    /// A line above it.
    pub begins_group: Option<String>,
    /// What is written, and the number it stands for.
    pub cells: Vec<Cell>,
    /// Printed bold.
    pub is_strong: bool,
}

#[derive(Debug, Clone)]
pub struct Cell {
    pub text: String,
    pub value: Value,
}

impl Cell {
    fn of(value: Option<f64>, text: impl Fn(f64) -> String) -> Self {
        match value {
            Some(value) => Self { text: text(value), value: json!(value) },
            None => Self { text: "–".into(), value: Value::Null },
        }
    }

    fn meters(value: Option<f64>) -> Self {
        Self::of(value, meters)
    }

    fn count(value: Option<f64>) -> Self {
        Self::of(value, |v| number(v, 0))
    }

    fn percent(value: Option<f64>) -> Self {
        Self::of(value, |v| format!("{} %", number(100.0 * v, if v < 0.0995 && v > 0.0 { 1 } else { 0 })))
    }

    fn decimals(value: Option<f64>, decimals: usize) -> Self {
        Self::of(value, |v| number(v, decimals))
    }
}

impl Table {
    pub fn json(&self) -> Value {
        let row = |row: &Row| {
            let mut object = Map::new();
            object.insert("row".into(), json!(row.label));
            for (column, cell) in self.columns.iter().zip(&row.cells) {
                object.insert(column.key.into(), cell.value.clone());
            }
            Value::Object(object)
        };
        json!({"title": self.title, "rows": self.rows.iter().map(row).collect::<Vec<_>>()})
    }

    pub fn html(&self) -> String {
        let mut html = format!(
            "<div class=\"table\" id=\"{id}\"><h4>{}</h4><p class=\"hint\">Wider than the screen: swipe it sideways →</p><div \
             class=\"scroll\" tabindex=\"0\"><table><thead>",
            escaped(&self.title),
            id = self.id
        );
        if self.columns.iter().any(|column| !column.group.is_empty()) {
            html += "<tr><th></th>";
            let mut columns = &self.columns[..];
            while let [first, ..] = columns {
                let span = columns.iter().take_while(|column| column.group == first.group).count();
                html += &format!("<th colspan=\"{span}\" class=\"group\">{}</th>", escaped(first.group));
                columns = &columns[span..];
            }
            html += "</tr>";
        }
        html += "<tr><th></th>";
        self.columns.iter().for_each(|column| html += &format!("<th>{}</th>", escaped(column.label)));
        html += "</tr></thead><tbody>";
        for (i, row) in self.rows.iter().enumerate() {
            if let Some(group) = &row.begins_group {
                let span = self.columns.len() + 1;
                html +=
                    &format!("<tr class=\"split\"><th colspan=\"{span}\"><span>{}</span></th></tr>", escaped(group));
            }
            let class = if row.is_strong { " class=\"strong\"" } else { "" };
            html += &format!("<tr{class}><th>{}</th>", escaped(&row.label));
            for (column, cell) in self.columns.iter().zip(&row.cells) {
                let source = format!("tables.{}.rows.{i}.{}", self.id, column.key);
                html += &format!("<td data-source=\"{source}\">{}</td>", escaped(&cell.text));
            }
            html += "</tr>";
        }
        html += &format!("</tbody></table></div><p class=\"note\">{}</p></div>", escaped(&self.note));
        html
    }
}

/// All tables of a dataset.
pub fn all(dataset: &Dataset) -> Vec<Table> {
    let mut tables = Vec::new();
    if dataset.map.is_none() {
        tables.push(paper_shape(dataset));
        tables.extend(against_words(dataset));
    }
    tables.push(accuracy(dataset));
    tables.push(intervals(dataset));
    tables
}

fn column(key: &'static str, label: &'static str, group: &'static str) -> Column {
    Column { key, label, group }
}

fn mean(entries: &[&Entry], of: impl Fn(&Entry) -> Option<f64>) -> Option<f64> {
    let values: Option<Vec<f64>> = entries.iter().map(|entry| of(entry)).collect();
    values.filter(|values| !values.is_empty()).map(|values| values.iter().sum::<f64>() / values.len() as f64)
}

/// Entries that differ in the seed only, in the order of the results.
fn grouped(entries: &[Entry]) -> Vec<Vec<&Entry>> {
    let mut groups: Vec<Vec<&Entry>> = Vec::new();
    for entry in entries {
        match groups.iter_mut().find(|group| group[0].row_key() == entry.row_key()) {
            Some(group) => group.push(entry),
            None => groups.push(vec![entry]),
        }
    }
    groups
}

fn variant(entry: &Entry) -> &'static str {
    match (entry.noisy, entry.fixed) {
        (true, _) => " (noisy)",
        (_, true) => " (fixed)",
        _ => "",
    }
}

/// Tables 1 and 2 of Do et al. (2015).
fn paper_shape(dataset: &Dataset) -> Table {
    let mut rows = Vec::new();
    let mut before = None;
    for group in grouped(&dataset.entries) {
        let first = group[0];
        let Some(recipe) = first.recipe else { continue };
        let key = (first.split.clone(), recipe);
        let begins = (before.as_ref() != Some(&key)).then(|| {
            let split = first.split.clone().unwrap_or_default();
            format!(
                "{recipe} recipe, {split} split: {} learning, {} validation, {}",
                first.n_learning,
                first.n_validation,
                counted(first.n_test, "test image")
            )
        });
        before = Some(key);
        let count = |of: fn(&Entry) -> Option<usize>| mean(&group, |entry| of(entry).map(|n| n as f64));
        let kept = count(|e| e.kept);
        let ratio = mean(&group, |e| e.compression);
        let kept_cell = Cell {
            text: match (kept, ratio) {
                (Some(kept), Some(ratio)) => format!("{} ({})", number(kept, 0), number(ratio, 1)),
                (Some(kept), None) => number(kept, 0),
                _ => "–".into(),
            },
            value: json!(kept),
        };
        rows.push(Row {
            label: format!("{}{}", feature_name(&first.features), variant(first)),
            begins_group: begins,
            cells: vec![
                Cell::count(count(|e| e.m)),
                kept_cell,
                Cell::meters(mean(&group, |e| e.rmse_all_test_m)),
                Cell::meters(mean(&group, |e| e.rmse_be_test_m)),
                Cell::meters(mean(&group, |e| e.rmse_be_validation_m)),
                Cell::meters(emax_m(&group)),
                Cell::decimals(mean(&group, |e| e.bic_all.map(|bic| bic / 1e3)), 1),
                Cell::decimals(mean(&group, |e| e.bic_kept.map(|bic| bic / 1e3)), 1),
            ],
            is_strong: first.features == "fused",
        });
    }
    Table {
        id: format!("{}-table-paper", dataset.id),
        title: "In the shape of the paper’s Tables 1 and 2".into(),
        note: "Mean over the seeds, but for e_max. All: with all features; BE: with those that backward elimination kept; T: on the test \
               images, V: on the validation images, which the choice was made on and which therefore flatter where \
               features were chosen. The default recipe then learns from the validation images too before it is tested, the \
               paper’s does not. Ratio: features in all over features kept. e_max: largest test error of all seeds. BIC: −2 Σ L + 4 k \
               log n, where every feature has a likelihood of its own."
            .into(),
        columns: vec![
            column("m", "total", "features"),
            column("kept", "kept (ratio)", "features"),
            column("rmse_all_test_m", "All T", "RMSE [m]"),
            column("rmse_be_test_m", "BE T", "RMSE [m]"),
            column("rmse_be_validation_m", "BE V", "RMSE [m]"),
            column("emax_test_m", "T", "e_max [m]"),
            column("bic_all_thousands", "all", "BIC [10³]"),
            column("bic_kept_thousands", "kept", "BIC [10³]"),
        ],
        rows,
    }
}

/// Table 3 of Do et al. (2015): the recipes beside bags of words, with images as they are and turned by their yaw.
fn against_words(dataset: &Dataset) -> Option<Table> {
    let split = dataset.split_names().into_iter().next()?;
    let of_split: Vec<Entry> =
        dataset.entries.iter().filter(|e| e.split.as_deref() == Some(&split) && !e.noisy).cloned().collect();
    let is_words = |entry: &Entry| entry.features.starts_with("bow");
    let mut rows = Vec::new();
    let groups = grouped(&of_split);
    for group in groups.iter().filter(|group| !group[0].fixed) {
        let first = group[0];
        let words = is_words(first);
        if !words && first.recipe.is_none() {
            continue;
        }
        let fixed = groups
            .iter()
            .find(|other| other[0].fixed && other[0].recipe == first.recipe && other[0].features == first.features);
        let of =
            |group: Option<&Vec<&Entry>>, of: &dyn Fn(&Entry) -> Option<f64>| group.and_then(|group| mean(group, of));
        let (kept, fixed_kept) =
            (of(Some(group), &|e| e.kept.map(|n| n as f64)), of(fixed, &|e| e.kept.map(|n| n as f64)));
        let (rmse, fixed_rmse) = (of(Some(group), &|e| e.rmse_m), of(fixed, &|e| e.rmse_m));
        let mine = |value: Option<f64>, belongs: bool| Cell::meters(value.filter(|_| belongs));
        let label = match first.recipe {
            Some(recipe) if !words => format!("{recipe}, {}", feature_name(&first.features)),
            _ => Method::name_of(first),
        };
        rows.push(Row {
            label,
            begins_group: None,
            cells: vec![
                Cell::count(mean(group, |e| e.m.map(|n| n as f64))),
                Cell::count(kept),
                Cell::count(fixed_kept),
                mine(rmse, !words),
                mine(fixed_rmse, !words),
                mine(rmse, words),
                mine(fixed_rmse, words),
            ],
            is_strong: first.features == "fused",
        });
    }
    (!rows.is_empty()).then(|| Table {
        id: format!("{}-table-words", dataset.id),
        title: format!("In the shape of the paper’s Table 3 ({split} split)"),
        note: "Gaussian processes beside bags of words, mean over the seeds, on the test images. Fixed: every panorama turned \
               by its yaw first; a dash where that was not run or no yaw is known."
            .into(),
        columns: vec![
            column("m", "total", "features"),
            column("kept", "kept", "features"),
            column("kept_fixed", "kept, fixed", "features"),
            column("rmse_gp_m", "unfixed", "RMSE [m], Gaussian processes"),
            column("rmse_gp_fixed_m", "fixed", "RMSE [m], Gaussian processes"),
            column("rmse_words_m", "unfixed", "RMSE [m], bag of words"),
            column("rmse_words_fixed_m", "fixed", "RMSE [m], bag of words"),
        ],
        rows,
    })
}

/// What the paper's tables do not tell.
fn accuracy(dataset: &Dataset) -> Table {
    let against_map = dataset.map.is_some();
    let mut columns = vec![
        column("n_learned_from", "images", ""),
        column("rmse_m", "RMSE", "error [m]"),
        column("median_m", "median", "error [m]"),
        column("p90_m", "P90", "error [m]"),
        column("p95_m", "P95", "error [m]"),
        column("emax_test_m", "max", "error [m]"),
        column("share_over_10m", "> 10 m", ""),
        column("skill", "skill", ""),
        column("recall_1m", "1 m", "found within"),
        column("recall_2m", "2 m", "found within"),
        column("recall_5m", "5 m", "found within"),
        column("recall_10m", "10 m", "found within"),
    ];
    if against_map {
        columns.extend([
            column("localized_share", "answered", "drive"),
            column("first_localized_s", "first [s]", "drive"),
            column("heading_median_deg", "heading [°]", "drive"),
            column("nees_mean", "NEES", "covariance"),
            column("coverage_95", "in 95 %", "covariance"),
        ]);
    }
    let mut rows = Vec::new();
    for (split, case) in cases(dataset) {
        for (i, method) in methods(dataset, split.as_deref()).iter().enumerate() {
            let mut cells = vec![
                Cell::count(method.mean(|e| Some(e.n_learned_from as f64))),
                Cell::meters(method.mean(|e| e.rmse_m)),
                Cell::meters(method.mean(|e| e.median_m)),
                Cell::meters(method.mean(|e| e.p90_m)),
                Cell::meters(method.mean(|e| e.p95_m)),
                Cell::meters(method.emax_m()),
                Cell::percent(method.mean(|e| e.share_over_10m)),
                Cell::decimals(method.mean(|e| e.skill), 2),
            ];
            cells.extend(RECALL_AT_M.map(|at_m| Cell::percent(Some(recall_at(method, at_m)))));
            if against_map {
                cells.extend([
                    Cell::percent(method.mean(|e| e.localized_share)),
                    Cell::decimals(method.mean(|e| e.first_localized_s), 1),
                    Cell::decimals(method.mean(|e| e.heading_median_deg), 1),
                    Cell::decimals(method.mean(|e| e.nees_mean), 1),
                    Cell::percent(method.mean(|e| e.coverage_95)),
                ]);
            }
            let seeds = method.entries.len();
            let begins =
                format!("{case}{}", if seeds > 1 { format!(", mean over {seeds} seeds") } else { String::new() });
            rows.push(Row {
                label: method.label.clone(),
                begins_group: (i == 0).then_some(begins),
                cells,
                is_strong: method.kind == Kind::Whole,
            });
        }
    }
    Table {
        id: format!("{}-table-accuracy", dataset.id),
        title: "Accuracy of every method".into(),
        note: "Images: what the method learned from; without a map, the paper’s recipe learns from the learning images alone, \
               the default one and the baselines, but for the median position, from the validation images too, once those \
               have chosen. Skill: 1 − RMSE / RMSE of always answering the median position: 1 is \
               perfect, 0 knows nothing. Max: of all seeds. Found within: share of all test frames, all seeds together; frames without an \
               answer are not found. Errors are of the frames that have one."
            .into(),
        columns,
        rows,
    }
}

/// How far the figures can be trusted, and which differences are real.
fn intervals(dataset: &Dataset) -> Table {
    let mut rows = Vec::new();
    for (split, case) in cases(dataset) {
        let mut group = Some(case);
        for method in methods(dataset, split.as_deref()) {
            let Some(statistics) = method.statistics(&dataset.statistics) else { continue };
            let comparison = method.comparison(&dataset.statistics);
            let three = |estimate: &Estimate| [Some(estimate.value), estimate.low, estimate.high];
            let mut cells: Vec<Cell> =
                [&statistics.rmse_m, &statistics.median_m].into_iter().flat_map(three).map(Cell::meters).collect();
            let difference = comparison.map(|comparison| three(&comparison.mean_difference_m));
            cells.extend((0..3).map(|i| Cell::meters(difference.and_then(|values| values[i]))));
            cells.push(Cell::percent(comparison.map(|comparison| comparison.closer_share.value)));
            cells.push(Cell::of(comparison.and_then(|comparison| comparison.p_holm), p_text));
            rows.push(Row {
                label: method.label.clone(),
                begins_group: group.take(),
                cells,
                is_strong: method.kind == Kind::Whole,
            });
        }
    }
    let level = dataset.statistics.level;
    Table {
        id: format!("{}-table-intervals", dataset.id),
        title: format!("Intervals of {:.0} %, and differences on the same frames", 100.0 * level),
        note: format!(
            "From {} bootstrap draws of stretches of the drive, a twentieth of it each, and of seeds; where frames were held \
             out in runs (blocked split), of whole runs, a run being the same in every seed. A dash: there is but one run, and \
             nothing can be said. What other stretches \
             and splits of this drive would show, not what other days and places would. Larger by: mean error minus that \
             of the method without an entry there; closer: share of the frames it errs less on; p: of that difference, by \
             sign flips of stretches or runs (n runs cannot bring it below 2 / 2ⁿ), corrected for all comparisons of the table (Holm 1979).",
            dataset.statistics.draws
        ),
        columns: vec![
            column("rmse_m", "value", "RMSE [m]"),
            column("rmse_low_m", "from", "RMSE [m]"),
            column("rmse_high_m", "to", "RMSE [m]"),
            column("median_m", "value", "median [m]"),
            column("median_low_m", "from", "median [m]"),
            column("median_high_m", "to", "median [m]"),
            column("mean_difference_m", "value", "mean error larger by [m]"),
            column("mean_difference_low_m", "from", "mean error larger by [m]"),
            column("mean_difference_high_m", "to", "mean error larger by [m]"),
            column("closer_share", "closer", ""),
            column("p_holm", "p", ""),
        ],
        rows,
    }
}
