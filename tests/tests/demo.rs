//! The demo from end to end: its own server, the control loop over TCP, physics, numbers and pictures.

use std::process::Command;

use emp_motion::{key_nodes, skills};
use emp_tests::{policy, process::binaries};
use serde_json::Value;

#[test]
fn the_demo_closes_the_loop_and_leaves_its_files() -> anyhow::Result<()> {
    let weights = policy::weights()?;
    let folder = tempfile::tempdir()?;
    let motion = folder.path().join("motion.npz");
    let mut clip = skills::generate(skills::Skill::Wave, 1).resampled(50.0);
    clip.frames.truncate(100);
    key_nodes::write(&motion, &clip)?;
    let out = folder.path().join("out");
    let mut demo = Command::new(binaries()?.join("emp-demo"));
    demo.arg("--motion").arg(&motion);
    demo.arg("--weights").arg(weights.path());
    demo.arg("--out").arg(&out);
    let output = demo.args(["--load", "1.5", "--json"]).output()?;
    // Whether a robot with a policy that was never trained falls is no matter: that is a result, not an error.
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{errors}");

    let summary: Value = serde_json::from_slice(&output.stdout)?;
    let written: Value = serde_json::from_slice(&std::fs::read(out.join("summary.json"))?)?;
    assert_eq!(summary, written);
    assert_eq!(summary["hand_load_kg"], serde_json::json!([1.5, 1.5]));
    assert_eq!(summary["stood"].as_bool(), Some(summary["fall"].is_null()));
    let number = |value: &Value| value.as_f64().unwrap_or(f64::NAN);
    let factor = number(&summary["real_time_factor"]);
    // The clock sets the pace: never faster, and slower only on a machine that cannot keep up.
    assert!((0.5..=1.001).contains(&factor), "{factor}");
    assert!(number(&summary["round_trip_ms"]["p50"]) > 0.0);
    for metric in ["suc", "mjp", "mbv", "mba", "mbo"] {
        assert!(
            (0.0..=1.0).contains(&number(&summary["metrics"][metric])),
            "{metric}"
        );
    }

    let table = std::fs::read_to_string(out.join("joints.csv"))?;
    let frames = summary["frames"].as_u64().map(|frames| frames as usize);
    let rows: Vec<&str> = table.lines().collect();
    assert_eq!(Some(rows.len() - 1), frames);
    let robot = emp_tests::emp27()?;
    let joints = robot.joints().count();
    for row in rows {
        // The time, the goal, what was executed, what was measured.
        let columns = 1 + robot.goal_joints().len() + 2 * joints;
        assert_eq!(row.split(',').count(), columns);
    }
    for picture in ["contact-sheet.png", "stance-sheet.png"] {
        let bytes = std::fs::read(out.join(picture))?;
        assert!(
            bytes.starts_with(b"\x89PNG") && bytes.len() > 10_000,
            "{picture}"
        );
    }
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
