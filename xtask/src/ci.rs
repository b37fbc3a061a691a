//! `cargo xtask ci`: everything that must pass before a change lands, step by step.

use std::{
    io::{BufRead, BufReader, Write},
    process::{Command, Stdio},
    time::{Duration, Instant},
};

use anyhow::{Context, Result, bail};

use crate::{
    demo::{self, DemoArgs},
    mujoco,
    robots::{self, FetchedRobot},
    tools::Tools,
    workspace::{Workspace, describe},
};

/// Runs every step, the tests last, so that one run shows all that is wrong; fails if one of them did.
pub(crate) fn run(workspace: &Workspace) -> Result<()> {
    let mut steps = Steps::default();
    let fetched = steps.run("fetch MuJoCo, g1 and the checking tools", || {
        fetch(workspace)
    });
    let Some(tools) = fetched else {
        return steps.finish();
    };

    steps.run("format", || {
        workspace.run(workspace.cargo().args(["fmt", "--all", "--check"]))
    });
    steps.run("lints", || clippy(workspace));
    steps.run("the demo with MuJoCo's renderer", || render(workspace));
    steps.run("documentation", || documentation(workspace));
    steps.run("licences, bans and sources", || deny(workspace, &tools));
    steps.run("advisories", || advisories(workspace, &tools));
    steps.run("wire contract", || {
        workspace.run(workspace.command(tools.program("buf")).arg("lint"))
    });
    steps.run("wire contract against the last release", || {
        breaking(workspace, &tools)
    });
    for robot in ["emp27", "g1"] {
        steps.run(&format!("demo on {robot}"), || demo_on(workspace, robot));
    }
    let tally = steps.run("tests", || test(workspace, &tools));
    if let Some(tally) = tally {
        println!(
            "{} passed, {} failed, {} skipped",
            tally.passed, tally.failed, tally.skipped
        );
    }
    steps.finish()
}

/// The steps run so far.
#[derive(Default)]
struct Steps {
    times: Vec<String>,
    failed: Vec<String>,
}

impl Steps {
    /// Runs one step under its name; its error is printed and kept, not passed on.
    fn run<T>(&mut self, name: &str, step: impl FnOnce() -> Result<T>) -> Option<T> {
        println!("\n==> {name}");
        let start = Instant::now();
        let result = step();
        let time = minutes(start.elapsed());
        self.times.push(format!("{name} {time}"));
        match result {
            Ok(value) => {
                println!("==> {name}: ok, {time}");
                Some(value)
            }
            Err(error) => {
                println!("==> {name}: FAILED, {time}: {error:#}");
                self.failed.push(name.to_owned());
                None
            }
        }
    }

    fn finish(self) -> Result<()> {
        println!("==> {}", self.times.join(", "));
        if !self.failed.is_empty() {
            bail!("failed: {}", self.failed.join(", "));
        }
        Ok(())
    }
}

fn minutes(time: Duration) -> String {
    let seconds = time.as_secs();
    format!("{}:{:02}", seconds / 60, seconds % 60)
}

fn fetch(workspace: &Workspace) -> Result<Tools> {
    mujoco::ensure(workspace)?;
    robots::ensure(workspace, FetchedRobot::G1)?;
    Tools::ensure(workspace)
}

/// Refuses changes of the contract that would break the clients of the last tag; without a tag there are none.
fn breaking(workspace: &Workspace, tools: &Tools) -> Result<()> {
    let described = workspace
        .command("git")
        .args(["describe", "--tags", "--abbrev=0"])
        .stderr(Stdio::null())
        .output()
        .context("git describe")?;
    let tag = String::from_utf8_lossy(&described.stdout).trim().to_owned();
    if !described.status.success() || tag.is_empty() {
        println!("skipped: nothing has been released yet (no git tag)");
        return Ok(());
    }
    let against = format!(".git#tag={tag}");
    let mut buf = workspace.command(tools.program("buf"));
    workspace.run(buf.args(["breaking", "--against", &against]))
}

fn clippy(workspace: &Workspace) -> Result<()> {
    let lints = [
        "clippy",
        "--release",
        "--workspace",
        "--all-targets",
        "--",
        "-D",
        "warnings",
    ];
    workspace.run(workspace.cargo().args(lints))
}

/// The one feature that is off by default is only checked: running it needs a graphics library.
fn render(workspace: &Workspace) -> Result<()> {
    let check = ["check", "--release", "--workspace", "--bins"];
    workspace.run(workspace.cargo().args(check).args(demo::RENDER))
}

/// Warnings are errors; set as `RUSTDOCFLAGS` for this step only, since it replaces the flags by which documentation tests
/// find MuJoCo.
fn documentation(workspace: &Workspace) -> Result<()> {
    let doc = ["doc", "--release", "--workspace", "--no-deps"];
    workspace.run(
        workspace
            .cargo()
            .args(doc)
            .env("RUSTDOCFLAGS", "-D warnings"),
    )
}

fn deny(workspace: &Workspace, tools: &Tools) -> Result<()> {
    let check = [
        "--workspace",
        "check",
        "--hide-inclusion-graph",
        "bans",
        "licenses",
        "sources",
    ];
    workspace.run(workspace.command(tools.program("cargo-deny")).args(check))
}

/// Checks against the advisory database where that can be fetched; it is no package, and some networks hold only packages.
fn advisories(workspace: &Workspace, tools: &Tools) -> Result<()> {
    let mut fetch = workspace.command(tools.program("cargo-deny"));
    let output = fetch
        .args(["fetch", "db"])
        .output()
        .with_context(|| format!("cannot start {}", describe(&fetch)))?;
    if !output.status.success() {
        println!("skipped: the advisory database is out of reach");
        return Ok(());
    }
    let check = ["--workspace", "check", "--disable-fetch", "advisories"];
    workspace.run(workspace.command(tools.program("cargo-deny")).args(check))
}

fn demo_on(workspace: &Workspace, robot: &str) -> Result<()> {
    let out = workspace.target().join("demo").join(robot);
    demo::run(
        workspace,
        &DemoArgs {
            robot: robot.to_owned(),
            out: Some(out),
            ..DemoArgs::default()
        },
    )
}

/// What `cargo test` counted.
#[derive(Debug, Default, PartialEq, Eq)]
struct Tally {
    passed: u64,
    failed: u64,
    skipped: u64,
}

fn test(workspace: &Workspace, tools: &Tools) -> Result<Tally> {
    let mut cargo = workspace.cargo();
    cargo
        .args(["test", "--release", "--workspace", "--no-fail-fast"])
        .env("PATH", tools.path()?);
    tallied(&mut cargo)
}

/// Runs `cargo test`, passing its output on and adding up its summaries, which are printed once more at the end.
fn tallied(cargo: &mut Command) -> Result<Tally> {
    let name = describe(cargo);
    let mut child = cargo
        .stdout(Stdio::piped())
        .spawn()
        .with_context(|| format!("cannot start {name}"))?;
    let stdout = child
        .stdout
        .take()
        .context("the child has no standard output")?;
    let mut tally = Tally::default();
    let mut summaries = Vec::new();
    for line in BufReader::new(stdout).split(b'\n') {
        let line = line.with_context(|| format!("cannot read what {name} prints"))?;
        let line = String::from_utf8_lossy(&line).into_owned();
        writeln!(std::io::stdout(), "{line}")?;
        if tally.add(&line) {
            summaries.push(line);
        }
    }
    let status = child
        .wait()
        .with_context(|| format!("cannot wait for {name}"))?;
    println!(
        "\nsummaries of all test binaries:\n{}",
        summaries.join("\n")
    );
    if !status.success() {
        bail!(
            "{name} failed ({status}): {} passed, {} failed",
            tally.passed,
            tally.failed
        );
    }
    if tally.passed == 0 {
        bail!("{name} ran no test");
    }
    Ok(tally)
}

impl Tally {
    /// Adds a summary such as `test result: ok. 3 passed; 0 failed; 1 ignored; …`; whether the line was one.
    fn add(&mut self, line: &str) -> bool {
        let Some((_, counts)) = line
            .strip_prefix("test result: ")
            .and_then(|rest| rest.split_once(". "))
        else {
            return false;
        };
        for count in counts.split("; ") {
            match count
                .split_once(' ')
                .map(|(number, what)| (number.parse::<u64>(), what))
            {
                Some((Ok(number), "passed")) => self.passed += number,
                Some((Ok(number), "failed")) => self.failed += number,
                Some((Ok(number), "ignored")) => self.skipped += number,
                _ => {}
            }
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn adds_up_test_summaries() {
        let mut tally = Tally::default();
        assert!(tally.add("test result: ok. 12 passed; 0 failed; 1 ignored; 0 measured; 0 filtered out; finished in 0.5s"));
        assert!(tally.add("test result: FAILED. 3 passed; 2 failed; 0 ignored; 0 measured; 4 filtered out; finished in 1s"));
        assert!(!tally.add("test reads_a_file ... ok"));
        assert_eq!(
            tally,
            Tally {
                passed: 15,
                failed: 2,
                skipped: 1
            }
        );
    }

    #[test]
    fn a_failed_step_fails_the_run_and_is_named() {
        let mut steps = Steps::default();
        assert_eq!(steps.run("first", || Ok(1)), Some(1));
        assert_eq!(
            steps.run("second", || -> Result<u8> { bail!("broken") }),
            None
        );
        assert_eq!(steps.finish().unwrap_err().to_string(), "failed: second");
    }
}
