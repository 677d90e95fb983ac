//! `omniloc evaluate`
use std::path::PathBuf;
use std::process::ExitCode;

use crate::evaluate::{ErrorFigures, protocol};
use crate::recording::Recording;
use crate::train::*;

#[derive(Debug, clap::Args)]
pub struct Args {
    recording: PathBuf,
    #[arg(long)]
    split_csv: Option<PathBuf>,
    #[arg(long, default_value_t = 1.0)]
    grid_step_m: f64,
    #[arg(long, default_value_t = 1)]
    seeds: u64,
    #[arg(long)]
    truth: Option<PathBuf>,
    #[arg(long)]
    recipe: RecipeName,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let t = std::time::Instant::now();
    let recording = Recording::open(&args.recording)?;
    let recipe = Recipe::new(args.recipe, &[]);
    let options = SurveyOptions { descriptors: recipe.descriptors(), fixed: false, repetitions: PERTURBED_COPIES, perturbed: recipe.perturbed(), seed: 0 };
    let survey = Survey::read(&[recording], &options, |_| {})?;
    eprintln!("read {:?}", t.elapsed());
    let recorded = survey.positions_m();
    let mut truth = recorded.clone();
    if let Some(t) = &args.truth {
        for (i, l) in std::fs::read_to_string(t)?.lines().skip(1).enumerate() {
            let v: Vec<f64> = l.split(',').map(|v| v.parse().unwrap()).collect();
            truth[i] = [v[1], v[2]];
        }
    }
    let indices: Vec<usize> = survey.frames.iter().map(|f| f.index).collect();
    for seed in 0..args.seeds {
        let split = match &args.split_csv {
            Some(p) => Split::from_csv(std::fs::File::open(p)?, &indices)?,
            None => Split::new(SplitKind::Random, survey.len(), seed),
        };
        let trial = protocol::Trial { recipe: &recipe, split: &split, grid_step_m: args.grid_step_m, recorded_m: &recorded };
        let outcomes = protocol::run(&survey, &trial, |_| {})?;
        let tt: Vec<_> = split.test.iter().map(|&i| truth[i]).collect();
        let tv: Vec<_> = split.validation.iter().map(|&i| truth[i]).collect();
        for o in outcomes {
            let a = ErrorFigures::of(&o.all_test_m, &tt).unwrap();
            let b = ErrorFigures::of(&o.kept_test_m, &tt).unwrap();
            let v = ErrorFigures::of(&o.kept_validation_m, &tv).unwrap();
            println!("{seed} {:16} rank {} kept {} all {:.2} ({:.2}) BE V {:.2} T {:.2} ({:.2}) p95 {:.2} >10 {:.3} bic {:?} {:?} {:?}", o.features, o.rank, o.kept, a.rmse_m, a.median_m, v.rmse_m, b.rmse_m, b.median_m, b.p95_m, b.share_over_10m, o.bic_all, o.bic_kept, o.warnings);
        }
        eprintln!("{:?}", t.elapsed());
    }
    Ok(ExitCode::SUCCESS)
}
