//! The demo from end to end: its own server, the control loop over TCP, physics, numbers and pictures.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use emp_motion::{key_nodes, skills};
use emp_tests::{emp, policy, process::binaries};
use serde_json::{Value, json};

/// A wave of this many frames as a file in a folder.
fn wave(folder: &Path, frames: usize) -> anyhow::Result<PathBuf> {
    let file = folder.join("motion.npz");
    let mut clip = skills::generate(skills::Skill::Wave, 1)
        .resampled(50.0)
        .expect("an ordinary rate");
    clip.frames.truncate(frames);
    key_nodes::write(&file, &clip)?;
    Ok(file)
}

/// Runs the demo to its end. Whether a robot with a policy that was never trained falls is no matter: that is a result, not an
/// error.
fn demo(weights: &Path, motion: &Path, out: &Path, further: &[&str]) -> anyhow::Result<Output> {
    let mut demo = Command::new(binaries()?.join("emp-demo"));
    demo.arg("--motion").arg(motion);
    demo.arg("--weights").arg(weights);
    demo.arg("--out").arg(out);
    let output = demo.args(["--load", "1.5"]).args(further).output()?;
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{errors}");
    Ok(output)
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or(f64::NAN)
}

/// What holds for every run's figures.
fn check_episode(episode: &Value) {
    assert_eq!(episode["stood"].as_bool(), Some(episode["fall"].is_null()));
    assert!(number(&episode["round_trip_ms"]["p50"]) > 0.0);
    for metric in ["suc", "mjp", "mbv", "mba", "mbo"] {
        let value = number(&episode["metrics"][metric]);
        assert!((0.0..=1.0).contains(&value), "{metric}: {value}");
    }
    let ramp = &episode["guards"][0];
    assert_eq!(ramp["what"], "ramp from the measured pose");
    assert_eq!(number(&ramp["from"]), 0.0);
}

/// A table has a row a frame: the time, the goal, what was executed, what was measured.
fn check_table(file: &Path, episode: &Value) -> anyhow::Result<()> {
    let table = std::fs::read_to_string(file)?;
    let rows: Vec<&str> = table.lines().collect();
    let frames = episode["frames"].as_u64().map(|frames| frames as usize);
    assert_eq!(Some(rows.len() - 1), frames);
    let robot = emp_tests::emp27()?;
    let columns = 1 + robot.goal_joints().len() + 2 * robot.joints().count();
    assert!(rows.iter().all(|row| row.split(',').count() == columns));
    Ok(())
}

#[test]
fn the_demo_closes_the_loop_and_leaves_its_files() -> anyhow::Result<()> {
    let weights = emp::weights(&emp::small(&*emp_tests::emp27()?, 3.0))?;
    let folder = tempfile::tempdir()?;
    let motion = wave(folder.path(), 100)?;
    let out = folder.path().join("out");
    let output = demo(weights.path(), &motion, &out, &["--json"])?;

    let summary: Value = serde_json::from_slice(&output.stdout)?;
    let written: Value = serde_json::from_slice(&std::fs::read(out.join("summary.json"))?)?;
    assert_eq!(summary, written);
    assert_eq!(summary["hand_load_kg"], json!([1.5, 1.5]));
    assert_eq!(summary["emp_mode"], "off");
    let factor = number(&summary["real_time_factor"]);
    // The clock sets the pace: never faster, and slower only on a machine that cannot keep up.
    assert!((0.5..=1.001).contains(&factor), "{factor}");
    check_episode(&summary);
    check_table(&out.join("joints.csv"), &summary)?;

    let hard = &summary["hard_motion"];
    assert_eq!(hard["motion"], "motion");
    assert_eq!(hard["hand_load_kg"], summary["hand_load_kg"]);
    for mode in ["off", "on"] {
        assert_eq!(hard[mode]["emp_mode"], mode);
        check_episode(&hard[mode]);
        check_table(&out.join(format!("emp-{mode}.csv")), &hard[mode])?;
    }
    // An EMP that was never trained changes goals as well; without one nothing but a joint's speed limit does.
    let change = |mode: &str| number(&hard[mode]["metrics"]["change"]);
    assert!(change("off") < change("on"), "{hard}");
    let counted = hard["all_motions"].as_array().map(Vec::as_slice);
    let [off, on] = counted.unwrap_or_default() else {
        anyhow::bail!("expected two counts, found {hard}");
    };
    assert_eq!(
        (&off["emp_mode"], &on["emp_mode"]),
        (&json!("off"), &json!("on"))
    );
    assert!(off["motions"] == 1 && on["motions"] == 1, "{hard}");
    for picture in ["contact-sheet.png", "stance-sheet.png", "emp-sheet.png"] {
        let bytes = std::fs::read(out.join(picture))?;
        assert!(
            bytes.starts_with(b"\x89PNG") && bytes.len() > 10_000,
            "{picture}"
        );
    }
    Ok(())
}

#[test]
fn without_an_emp_the_demo_says_so_and_a_comparison_repeats_itself() -> anyhow::Result<()> {
    let weights = policy::weights()?;
    let folder = tempfile::tempdir()?;
    let motion = wave(folder.path(), 60)?;
    let mut tables = Vec::new();
    for out in ["first", "second"] {
        let out = folder.path().join(out);
        let output = demo(weights.path(), &motion, &out, &[])?;
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(text.contains("there are no weights of an EMP"), "{text}");
        assert!(out.join("emp-sheet.png").is_file() && !out.join("emp-on.csv").exists());
        tables.push(std::fs::read(out.join("emp-off.csv"))?);
    }
    // Control periods in lock step know no clock.
    assert_eq!(tables[0], tables[1]);
    Ok(())
}

#[test]
fn a_missing_policy_is_named() -> anyhow::Result<()> {
    let weights = policy::weights()?;
    std::fs::remove_file(policy::file(&weights))?;
    let out = tempfile::tempdir()?;
    let output = Command::new(binaries()?.join("emp-demo"))
        .arg("--weights")
        .arg(weights.path())
        .arg("--out")
        .arg(out.path())
        .output()?;
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success());
    assert!(errors.contains("policy"), "{errors}");
    Ok(())
}
