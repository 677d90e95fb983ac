//! Progress of long work on stderr: a bar on a terminal, a line a stage elsewhere.

use std::io::IsTerminal;
use std::sync::Mutex;
use std::time::Instant;

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::train::Step;

/// What is going on, and how far it is.
pub struct Progress {
    bar: ProgressBar,
    stage: Mutex<String>,
    on_terminal: bool,
    start: Instant,
}

impl Progress {
    pub fn new() -> Self {
        let on_terminal = std::io::stderr().is_terminal();
        let target = if on_terminal { ProgressDrawTarget::stderr() } else { ProgressDrawTarget::hidden() };
        let bar = ProgressBar::with_draw_target(None, target);
        let style = ProgressStyle::with_template("{elapsed:>4} {msg:44} {wide_bar} {percent:>3} %, {eta} left");
        bar.set_style(style.expect("the template is sound"));
        Self { bar, stage: Mutex::new(String::new()), on_terminal, start: Instant::now() }
    }

    /// Work on `what` begins, in `count` pieces.
    pub fn begin(&self, what: &str, count: usize) {
        self.bar.set_message(what.to_owned());
        self.bar.set_length(count as u64);
        self.bar.set_position(0);
        let mut stage = self.stage.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        if !self.on_terminal && *stage != what {
            eprintln!("{:5.1} s  {what}", self.start.elapsed().as_secs_f64());
        }
        *stage = what.to_owned();
    }

    pub fn advance(&self, pieces: usize) {
        self.bar.inc(pieces as u64);
    }

    /// A step of training, within `part` of the work.
    pub fn step(&self, part: &str, step: Step) {
        match step {
            Step::Fitting { descriptor, features } => self.begin(&format!("{part}: learning {descriptor}"), features),
            Step::Eliminating { features } => self.begin(&format!("{part}: choosing features"), features),
            Step::FeatureFitted | Step::FeatureEliminated => self.advance(1),
            Step::Done => {}
        }
    }

    /// Says something beside the bar.
    pub fn say(&self, text: &str) {
        self.bar.suspend(|| eprintln!("{text}"));
    }

    /// Clears the bar, so that results can be printed.
    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }
}

impl Default for Progress {
    fn default() -> Self {
        Self::new()
    }
}
