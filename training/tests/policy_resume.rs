//! A policy's training that is killed and resumed makes the same weights as one that is left alone.

#![allow(clippy::unwrap_used, reason = "a helper that fails must fail its test")]

use std::{
    path::Path,
    process::{Command, Stdio},
    time::{Duration, Instant},
};

use emp_models::checkpoint;

/// `emp-train policy` on a small run in `folder`, which saves after every update.
fn trainer(folder: &Path, threads: usize) -> Command {
    let repository = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let mut command = Command::new(env!("CARGO_BIN_EXE_emp-train"));
    command
        .args(["policy", "--robot", "emp27", "--robots"])
        .arg(repository.join("robots"))
        .arg("--retargeter")
        .arg(repository.join("models/weights/emp27-retargeter.safetensors"))
        .args(["--steps", "4096", "--environments", "16", "--horizon", "8"])
        .args([
            "--procedural-clips",
            "2",
            "--seed",
            "7",
            "--save-every",
            "0",
        ])
        .args(["--threads", &threads.to_string()])
        .arg("--out")
        .arg(folder.join("weights.safetensors"))
        .arg("--run")
        .arg(folder.join("run"))
        .stderr(Stdio::null());
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

#[test]
fn a_killed_run_resumes_bit_for_bit_at_any_number_of_threads() {
    let (whole, killed) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    assert!(trainer(whole.path(), 1).status().unwrap().success());

    let mut child = trainer(killed.path(), 2).spawn().unwrap();
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
        !trainer(killed.path(), 2).status().unwrap().success(),
        "a run must not be overwritten unasked"
    );
    let mut resumed = trainer(killed.path(), 2);
    assert!(resumed.arg("--resume").status().unwrap().success());

    assert_eq!(log(whole.path()), log(killed.path()));
    assert_eq!(log(whole.path()).len(), 32);
    assert_eq!(weights(whole.path()), weights(killed.path()));
}
