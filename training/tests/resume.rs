//! A run that is killed and resumed makes the same weights as one that is left alone.

#![allow(clippy::unwrap_used, reason = "a helper that fails must fail its test")]

use std::{
    path::Path,
    process::{Command, Stdio},
    time::{Duration, Instant},
};

use emp_models::checkpoint;

/// `emp-train retargeter` on a small run in `folder`, which saves after every step.
fn trainer(folder: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_emp-train"));
    command
        .args(["retargeter", "--robot", "emp27", "--robots"])
        .arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots"))
        .args([
            "--steps",
            "40",
            "--batch",
            "16",
            "--procedural-clips",
            "2",
            "--seed",
            "7",
            "--save-every",
            "0",
        ])
        .arg("--out")
        .arg(folder.join("weights.safetensors"))
        .arg("--run")
        .arg(folder.join("run"))
        .stderr(Stdio::null());
    command
}

fn logged_steps(folder: &Path) -> String {
    std::fs::read_to_string(folder.join("run/log.csv")).unwrap()
}

#[test]
fn a_killed_run_resumes_bit_for_bit() {
    let (whole, killed) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    assert!(trainer(whole.path()).status().unwrap().success());

    let mut child = trainer(killed.path()).spawn().unwrap();
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
        !trainer(killed.path()).status().unwrap().success(),
        "a run must not be overwritten unasked"
    );
    assert!(
        trainer(killed.path())
            .arg("--resume")
            .status()
            .unwrap()
            .success()
    );

    let weights = |folder: &Path| {
        checkpoint::load(&folder.join("weights.safetensors"))
            .unwrap()
            .0
            .sha256
    };
    assert_eq!(weights(whole.path()), weights(killed.path()));
    assert_eq!(logged_steps(whole.path()), logged_steps(killed.path()));
}

#[test]
fn a_resumed_run_must_be_the_same_run() {
    let folder = tempfile::tempdir().unwrap();
    assert!(trainer(folder.path()).status().unwrap().success());
    let output = trainer(folder.path())
        .args(["--resume", "--learning-rate", "0.5"])
        .stderr(Stdio::piped())
        .output()
        .unwrap();
    assert!(!output.status.success());
    assert!(String::from_utf8_lossy(&output.stderr).contains("learning_rate"));
}
