//! A training in the simulator that is killed and resumed makes the same weights as one that is left alone.

#![allow(clippy::unwrap_used, reason = "a helper that fails must fail its test")]

use std::{
    path::Path,
    process::{Command, Stdio},
    time::{Duration, Instant},
};

use emp_models::checkpoint;

/// `emp-train` with these arguments on a small run in `folder`, which saves after every update.
fn trainer(arguments: &[&str], folder: &Path, threads: usize) -> Command {
    let repository = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let weights = |kind: &str| repository.join(format!("models/weights/emp27-{kind}.safetensors"));
    let mut command = Command::new(env!("CARGO_BIN_EXE_emp-train"));
    command
        .args(arguments)
        .args(["--robot", "emp27", "--robots"])
        .arg(repository.join("robots"))
        .arg("--retargeter")
        .arg(weights("retargeter"))
        .args(["--seed", "7", "--save-every", "0"])
        .args(["--threads", &threads.to_string()])
        .arg("--out")
        .arg(folder.join("weights.safetensors"))
        .arg("--run")
        .arg(folder.join("run"))
        .stderr(Stdio::null());
    if arguments[0] != "policy" {
        command.arg("--policy").arg(weights("policy"));
    }
    command
}

/// The log without the times.
fn log(folder: &Path) -> Vec<Vec<String>> {
    let mut reader = csv::Reader::from_path(folder.join("run/log.csv")).unwrap();
    let headers = reader.headers().unwrap().clone();
    let rows = reader.records().map(|row| {
        let row = row.unwrap();
        let columns = headers.iter().zip(row.iter());
        let kept = columns.filter(|(header, _)| !header.starts_with("seconds"));
        kept.map(|(_, value)| value.to_owned()).collect()
    });
    rows.collect()
}

fn weights(folder: &Path) -> String {
    let (metadata, _) = checkpoint::load(&folder.join("weights.safetensors")).unwrap();
    metadata.sha256
}

/// Runs a training of `rows` updates once as a whole, once killed after its first checkpoint and resumed.
fn check(arguments: &[&str], rows: usize) {
    let (whole, killed) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let run = |folder: &Path, threads| trainer(arguments, folder, threads);
    assert!(run(whole.path(), 1).status().unwrap().success());

    let mut child = run(killed.path(), 2).spawn().unwrap();
    let state = killed.path().join("run/checkpoint.safetensors");
    let start = Instant::now();
    while !state.exists() {
        assert!(
            start.elapsed() < Duration::from_secs(120),
            "no checkpoint after two minutes"
        );
        std::thread::sleep(Duration::from_millis(2));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(
        !killed.path().join("weights.safetensors").exists(),
        "the run ended before it was killed"
    );
    assert!(
        !run(killed.path(), 2).status().unwrap().success(),
        "a run must not be overwritten unasked"
    );
    let mut resumed = run(killed.path(), 2);
    assert!(resumed.arg("--resume").status().unwrap().success());

    assert_eq!(log(whole.path()), log(killed.path()));
    assert_eq!(log(whole.path()).len(), rows);
    assert_eq!(weights(whole.path()), weights(killed.path()));
}

#[test]
fn a_policy_resumes_bit_for_bit_at_any_number_of_threads() {
    let arguments = "policy --steps 4096 --set environments=16 --set horizon=8 --set procedural_clips=2 \
                     --set evaluation_clips=2";
    check(&arguments.split(' ').collect::<Vec<_>>(), 32);
}

/// A small EMP run; an evaluation would write weights before it is killed.
const EMP: &str = "--steps 2560 --set environments=16 --set frames=8 --set warm_up=8 --set procedural_clips=2 \
                   --set hindsight.horizon=4 --set hindsight.window=2 --set optimizer.rows=64 \
                   --set evaluation_clips=1 --set evaluate_every=1000000";

/// A small run of a world model.
const WORLD_MODEL: &[&str] = &[
    "world-model",
    "--steps=100",
    "--environments=8",
    "--rows=16",
    "--loss-steps=3",
    "--procedural-clips=2",
];

#[test]
fn an_emp_that_learns_the_price_of_falls_resumes_bit_for_bit() {
    let arguments = format!("emp --preset default {EMP}");
    check(&arguments.split_whitespace().collect::<Vec<_>>(), 20);
}

#[test]
fn an_emp_that_imagines_resumes_bit_for_bit() {
    let sizes = "--set network.state_hidden=[16] --set network.target_hidden=[16] \
                 --set network.fusion_hidden=[16] --set network.decoder_hidden=[16] \
                 --set horizon=2";
    let folder = tempfile::tempdir().unwrap();
    let mut world_model = trainer(WORLD_MODEL, folder.path(), 2);
    assert!(world_model.status().unwrap().success());
    let file = folder.path().join("weights.safetensors");
    let arguments = format!(
        "emp --preset paper --world-model {} {EMP} {sizes}",
        file.display()
    );
    check(&arguments.split_whitespace().collect::<Vec<_>>(), 20);
}

#[test]
fn a_world_model_resumes_bit_for_bit() {
    check(WORLD_MODEL, 4);
}
