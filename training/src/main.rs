//! `emp-train`: trains the models and reports on them.

mod commands;

use std::process::ExitCode;

use anyhow::Result;
use clap::{Parser, Subcommand};

/// Trains the models of the motion-filtering service, and reports on them.
#[derive(Parser)]
#[command(
    name = "emp-train",
    version,
    after_help = "Exit codes: 0 done, 1 failed, 3 interrupted with its state saved."
)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Train the human-to-robot retargeting network (paper, section III).
    ///
    /// Procedural skills are always in the mix; recorded motion comes from --motions. The run's checkpoint and CSV log
    /// stand in runs/retargeter-ROBOT; Ctrl-C saves, --resume continues bit for bit.
    Retargeter(commands::retargeter::Arguments),
    /// Train the lower-body policy by proximal policy optimisation (paper, section IV).
    ///
    /// Procedural skills are always in the mix; recorded motion comes from --motions, retargeted by the robot's retargeter.
    /// The run's checkpoint and CSV log stand in runs/policy-ROBOT; Ctrl-C saves, --resume continues bit for bit.
    Policy(commands::policy::Arguments),
    /// Train an Executable Motion Prior on a robot's frozen policy (paper, section V).
    ///
    /// Procedural skills are always in the mix; recorded motion comes from --motions. The run's checkpoint and CSV logs stand in
    /// runs/emp-ROBOT; Ctrl-C saves, --resume continues bit for bit.
    Emp(commands::emp::Arguments),
    /// Train the rows of the paper's ablation table, one after the other, and write the table.
    ///
    /// Runs, checkpoints and the table stand in runs/ablation-ROBOT; Ctrl-C saves, --resume continues.
    EmpAblation(commands::emp_ablation::Arguments),
    /// Train a world model of a robot and its policy (paper, section V).
    ///
    /// Procedural skills are always in the mix; recorded motion comes from --motions. The run's checkpoint, CSV log and model
    /// stand in runs/world-model-ROBOT; Ctrl-C saves, --resume continues bit for bit.
    WorldModel(commands::world_model::Arguments),
    /// Measure how well a world model predicts, one and ten control periods ahead.
    ///
    /// Motion as for policy-report, under the hard conditions of training.
    WorldModelReport(commands::world_model_report::Arguments),
    /// Draw the learning curves of policies.
    PolicyCurves(commands::policy_curves::Arguments),
    /// Score a trained policy, bare and behind goal filters: held-out clips, larger amplitude, full randomisation.
    ///
    /// Recorded motion comes from --motions and should be of people that were not trained on; procedural skills come from a
    /// seed of their own.
    PolicyReport(commands::policy_report::Arguments),
    /// Compare EMPs with the policy alone and with filters that need no learning, on nominal, easy and hard conditions.
    ///
    /// Motion as for policy-report. Prints tables in Markdown, all differences on the same episodes.
    EmpReport(commands::emp_report::Arguments),
    /// Find out what fells a policy under hard conditions: joints, directions, poses, and how early it shows.
    ///
    /// Motion as for policy-report. Prints a page in Markdown.
    FallReport(commands::fall_report::Arguments),
    /// Compare a trained retargeter with converged inverse kinematics on the same objective.
    RetargetReport(commands::retarget_report::Arguments),
    /// Measure how lively procedural skills and recorded motion are, beside people.
    SkillReport(commands::skill_report::Arguments),
}

fn main() -> Result<ExitCode> {
    // SAFETY: no other thread runs yet, so none reads the environment meanwhile.
    unsafe { single_thread_element_wise_ops() };
    match Cli::parse().command {
        Command::Retargeter(arguments) => commands::retargeter::run(&arguments),
        Command::Policy(arguments) => commands::policy::run(&arguments),
        Command::Emp(arguments) => commands::emp::run(&arguments),
        Command::EmpAblation(arguments) => commands::emp_ablation::run(&arguments),
        Command::WorldModel(arguments) => commands::world_model::run(&arguments),
        Command::WorldModelReport(arguments) => commands::world_model_report::run(&arguments),
        Command::PolicyCurves(arguments) => commands::policy_curves::run(&arguments),
        Command::PolicyReport(arguments) => commands::policy_report::run(&arguments),
        Command::EmpReport(arguments) => commands::emp_report::run(&arguments),
        Command::FallReport(arguments) => commands::fall_report::run(&arguments),
        Command::RetargetReport(arguments) => commands::retarget_report::run(&arguments),
        Command::SkillReport(arguments) => commands::skill_report::run(&arguments),
    }
}

/// Keeps candle's element-wise ops on the calling thread: its own pool waits by spinning, which costs more than half of the
/// time where anything else runs on the machine. Matrix products have their own threads (`--threads`).
///
/// # Safety
/// As [`std::env::set_var`]: no other thread may be running.
unsafe fn single_thread_element_wise_ops() {
    // SAFETY: the caller's promise.
    unsafe { std::env::set_var("CANDLE_NUM_THREADS", "1") };
}
