//! `emp-train skill-report`.

use std::{path::PathBuf, process::ExitCode};

use anyhow::Result;
use clap::Args;
use emp_motion::skills::{self, Skill};
use emp_training::{
    retargeter::data,
    run::base_name,
    skill_report::{ArmTable, Report},
};

/// What is measured.
#[derive(Args)]
pub(crate) struct Arguments {
    /// Procedural motions.
    #[arg(long, default_value_t = 400)]
    procedural: usize,
    /// Seed of the procedural motions.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Folders (or files) of recorded motion, measured beside them one by one.
    #[arg(long, num_args = 1.., value_name = "DIR")]
    motions: Vec<PathBuf>,
    /// Measure each skill on its own, as many performances of each.
    #[arg(long, value_name = "COUNT")]
    skills: Option<u64>,
    /// Print the report as JSON.
    #[arg(long)]
    json: bool,
}

/// Measures motion and prints the table.
pub(crate) fn run(arguments: &Arguments) -> Result<ExitCode> {
    let library = skills::library(arguments.seed, arguments.procedural);
    let mut tables = vec![ArmTable::new("procedural", &library)];
    for folder in &arguments.motions {
        let clips = data::load_clips(std::slice::from_ref(folder))?;
        tables.push(ArmTable::new(base_name(folder), &clips));
    }
    if let Some(count) = arguments.skills {
        for skill in Skill::ALL {
            let seeds = arguments.seed..arguments.seed + count;
            let clips: Vec<_> = seeds.map(|seed| skills::generate(skill, seed)).collect();
            tables.push(ArmTable::new(skill.name(), &clips));
        }
    }
    let report = Report(tables);
    if arguments.json {
        println!("{}", serde_json::to_string_pretty(&report)?);
    } else {
        print!("{report}");
    }
    Ok(ExitCode::SUCCESS)
}
