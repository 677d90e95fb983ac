//! The statistics as text, a line a method.

use super::{Comparison, Estimate, MethodStatistics, Section, Statistics, p_text};

pub fn text(statistics: &Statistics) -> String {
    let mut text = String::new();
    let mut section_before: Option<&Section> = None;
    for method in &statistics.methods {
        let of_section = |comparison: &&Comparison| comparison.section == method.section;
        if section_before != Some(&method.section) {
            let reference = statistics.comparisons.iter().find(of_section).map(|comparison| &comparison.reference);
            let reference = reference.map(|r| format!("{} {}", r.recipe.unwrap_or("-"), r.features));
            text += &heading(statistics, method, reference.as_deref());
            section_before = Some(&method.section);
        }
        let comparison = statistics.comparisons.iter().filter(of_section).find(|c| c.method == method.method);
        text += &line(method, comparison);
    }
    text
}

fn heading(statistics: &Statistics, first: &MethodStatistics, reference: Option<&str>) -> String {
    let Section { split, noisy, fixed, .. } = &first.section;
    let variant = if *noisy {
        " (noisy)"
    } else if *fixed {
        " (fixed)"
    } else {
        ""
    };
    let what = match split {
        Some(split) if first.seeds > 1 => format!("{split} split{variant}, {} seeds", first.seeds),
        Some(split) => format!("{split} split{variant}"),
        None => "against a map".into(),
    };
    let level = 100.0 * statistics.level;
    let than =
        reference.map_or(String::new(), |reference| format!("; mean error against {reference} on the same frames"));
    format!(
        "\n{what}: intervals of {level:.0} %{than}\n{:8} {:20} {:>22} {:>22} | {:>23} | {:>24} {:>7} {:>7}\n",
        "recipe", "features", "RMSE", "median", "% within 1, 2, 5, 10 m", "larger by", "closer", "p"
    )
}

fn line(of: &MethodStatistics, comparison: Option<&Comparison>) -> String {
    let recall: Vec<String> = of.recall.iter().map(|recall| format!("{:5.1}", 100.0 * recall.value)).collect();
    let compared = comparison.map_or("-".into(), |comparison| {
        let mark = if comparison.is_real { "*" } else { " " };
        format!(
            "{:>24} {:>6.0}% {:>7}{mark}",
            meters(&comparison.mean_difference_m),
            100.0 * comparison.closer_share.value,
            comparison.p_holm.map_or("-".into(), p_text)
        )
    });
    let text = format!(
        "{:8} {:20} {:>22} {:>22} | {} | {compared}",
        of.method.recipe.unwrap_or("-"),
        of.method.features,
        meters(&of.rmse_m),
        meters(&of.median_m),
        recall.join(" ")
    );
    text.trim_end().to_owned() + "\n"
}

/// As in `0.98 [0.91, 1.06]`.
fn meters(estimate: &Estimate) -> String {
    let number = |value: Option<f64>| match value {
        None => "-".into(),
        Some(value) if value.abs() < 9.995 => format!("{value:.2}"),
        Some(value) => format!("{value:.1}"),
    };
    format!("{} [{}, {}]", number(Some(estimate.value)), number(estimate.low), number(estimate.high))
}

/// What the columns mean, for under the tables.
pub const LEGEND: &str = "\
Intervals: the middle 95 % of bootstrap draws of stretches of the drive, a twentieth of it each, and of seeds; where frames
were held out in runs, of whole runs, which are the same in every seed; none where there is but one. larger by:
mean error minus that of the method named above, on the same frames; closer: share of the frames it errs less on; p: how
often signs drawn for the stretches or runs make the mean difference as large, adjusted for all comparisons of the table; * below
0.05. They say what other stretches and splits of this drive would show, not what other days and places would.
";
