//! `emp inspect`: what a motion file is taken for.

use std::process::ExitCode;

use anyhow::Context as _;

use crate::cli::Inspect;

pub(crate) fn run(command: &Inspect, as_json: bool) -> anyhow::Result<ExitCode> {
    let understood = emp_motion::read(&command.file, &command.reading.options())?.understanding;
    if as_json {
        println!(
            "{}",
            serde_json::to_string(&understood).context("understanding")?
        );
    } else {
        print!("{understood}");
    }
    Ok(ExitCode::SUCCESS)
}
