//! `emp-train emp-report`.

use std::{path::PathBuf, process::ExitCode, str::FromStr, sync::Arc};

use anyhow::{Context as _, Result};
use clap::Args;
use emp_models::{emp::Emp, linear};
use emp_motion::atomic;
use emp_robot::Robot;
use emp_training::emp::report::{self, Candidate, EmpRun, Family};

use super::{
    arguments::RobotArguments,
    trial::{EpisodeProgress, TrialArguments, printed},
};

/// What is compared, and on what.
#[derive(Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    robot: RobotArguments,
    #[command(flatten)]
    trial: TrialArguments,
    /// EMPs: what tables call each, and its weights.
    #[arg(long, num_args = 1.., value_name = "NAME=FILE")]
    emp: Vec<NamedFile>,
    /// Compare the danger gates of this EMP, one of --emp.
    #[arg(long, value_name = "NAME")]
    gates: Option<String>,
    /// Knees of the soft-knee filter, whose slope is varied.
    #[arg(
        long,
        value_name = "JOINT=ANGLE,…",
        default_value = "shoulder_pitch=-1.5"
    )]
    knee: String,
    /// Set these filters beside the EMPs instead of the usual ones, mild ones first: `NAME:key=value,…`.
    #[arg(long, num_args = 1.., value_name = "FILTER")]
    filters: Vec<String>,
    /// Print JSON instead of tables.
    #[arg(long)]
    json: bool,
    /// Also write emp-report.md, emp-report.json and frontier.svg here.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

/// A file with a name of its own.
#[derive(Clone)]
struct NamedFile {
    name: String,
    file: PathBuf,
}

impl FromStr for NamedFile {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.split_once('=') {
            Some((name, file)) if !name.is_empty() && !file.is_empty() => Ok(Self {
                name: name.to_owned(),
                file: PathBuf::from(file),
            }),
            _ => Err(format!("expected NAME=FILE, found {text:?}")),
        }
    }
}

impl Arguments {
    fn candidates(&self, robot: &Arc<Robot>) -> Result<Vec<Candidate>> {
        let load = |NamedFile { name, file }: &NamedFile| {
            Ok(Candidate {
                name: name.clone(),
                emp: Arc::new(Emp::load(file, Arc::clone(robot))?),
            })
        };
        self.emp.iter().map(load).collect()
    }

    fn families(&self) -> Vec<Family> {
        if self.filters.is_empty() {
            return Family::usual(&self.knee);
        }
        vec![Family {
            name: "filters".to_owned(),
            members: self.filters.clone(),
        }]
    }

    fn gates(&self) -> Result<Option<usize>> {
        let position = |name: &String| {
            let found = self.emp.iter().position(|emp| emp.name == *name);
            found.with_context(|| format!("--gates {name}: expected a name from --emp"))
        };
        self.gates.as_ref().map(position).transpose()
    }
}

/// Compares EMPs with what needs no learning, and prints the tables.
pub(crate) fn run(arguments: &Arguments) -> Result<ExitCode> {
    let robot = arguments.robot.load()?;
    let policy = arguments.trial.policy(&robot)?;
    let candidates = arguments.candidates(&robot)?;
    let families = arguments.families();
    let gates = arguments.gates()?;
    let groups = arguments.trial.groups(&robot)?;
    let pool = arguments.trial.pool(&robot)?;
    linear::set_threads(arguments.trial.threads);
    let mut progress = EpisodeProgress::listen()?;
    let run = EmpRun {
        pool: &pool,
        policy: &policy,
        groups: &groups,
        set: arguments.trial.set,
        candidates: &candidates,
        families: &families,
        gates,
    };
    let report = report::report(&run, &mut progress)?;
    progress.finish();
    if let Some(folder) = &arguments.out {
        for (name, json) in [("emp-report.md", false), ("emp-report.json", true)] {
            let path = folder.join(name);
            atomic::write(&path, printed(&report, json)?.as_bytes())
                .with_context(|| format!("writing {}", path.display()))?;
        }
        report::draw(&report, &folder.join("frontier.svg"))?;
    }
    print!("{}", printed(&report, arguments.json)?);
    Ok(ExitCode::SUCCESS)
}
