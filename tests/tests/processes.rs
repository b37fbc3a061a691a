//! The shipped binaries: `emp-server` from any folder, its end by SIGTERM, and `emp` against it.

use std::process::{Command, Output};

use emp_client::{Backoff, Client, ClientError, Event, StreamConfig};
use emp_motion::{key_nodes, skills};
use emp_tests::{
    poses,
    process::{ServerProcess, binaries},
    root, within,
};
use serde_json::Value;

fn emp(server: &str, arguments: &[&str]) -> anyhow::Result<Output> {
    Ok(Command::new(binaries()?.join("emp"))
        .args(["--server", server])
        .args(arguments)
        .output()?)
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

#[tokio::test]
async fn sigterm_drains_a_server_with_a_stream_open() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let mut server = ServerProcess::start(folder.path())?;
    let backoff = Backoff {
        give_up: std::time::Duration::ZERO,
        ..Backoff::default()
    };
    let client = Client::connect(&server.url).await?.with_backoff(backoff);
    let (mut sender, mut events) = client.stream(StreamConfig::for_robot("emp27")).await?;
    let poses = poses(1, 10);
    for pose in &poses {
        sender.send(pose, None).await?;
    }
    for number in 0..10 {
        let event = within("an answer", events.next()).await??;
        assert!(matches!(event, Some(Event::Answer(answer)) if answer.sequence_number == number));
    }
    server.terminate()?;
    let end = within("the stream's end", events.next())
        .await?
        .expect_err("the server is gone");
    assert!(
        matches!(&end, ClientError::Lost { last, .. } if last.contains("shutting down")),
        "{end}"
    );
    let status = tokio::task::spawn_blocking(move || server.wait()).await??;
    assert!(status.success(), "{status}");
    Ok(())
}

#[test]
fn the_command_retargets_a_file() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let server = ServerProcess::start(folder.path())?;
    let motion = folder.path().join("motion.npz");
    let mut clip = skills::generate(skills::Skill::Wave, 1).resampled(50.0);
    clip.frames.truncate(150);
    key_nodes::write(&motion, &clip)?;
    let (motion, table) = (
        motion.to_string_lossy().into_owned(),
        folder.path().join("joints.csv"),
    );
    let out = table.to_string_lossy().into_owned();
    for options in [&["--refine", "--smooth"][..], &["--realtime"]] {
        let arguments = [
            &[
                "retarget", &motion, "--robot", "emp27", "--out", &out, "--json",
            ],
            options,
        ]
        .concat();
        let output = emp(&server.url, &arguments)?;
        assert!(output.status.success(), "{}", text(&output.stderr));
        let summary: Value = serde_json::from_slice(&output.stdout)?;
        assert_eq!(summary["frames"], 150);
        assert!(
            summary["latency_ms"]["p50"]
                .as_f64()
                .is_some_and(|ms| ms > 0.0)
        );
        assert!(
            summary["batch"]["max"]
                .as_u64()
                .is_some_and(|size| size >= 1)
        );
        let csv = std::fs::read_to_string(&table)?;
        let mut lines = csv.lines();
        assert!(
            lines.next().is_some_and(
                |header| header.starts_with("time_s,") && header.split(',').count() == 16
            )
        );
        assert_eq!(Some(lines.count() as u64), summary["answered"].as_u64());
    }
    Ok(())
}

#[test]
fn the_command_lists_robots_and_models() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let server = ServerProcess::start(folder.path())?;
    let robots: Value = serde_json::from_slice(&emp(&server.url, &["robots", "--json"])?.stdout)?;
    assert!(
        robots
            .as_array()
            .is_some_and(|robots| robots.iter().any(|robot| robot["name"] == "emp27"))
    );
    assert!(
        text(&emp(&server.url, &["robots"])?.stdout)
            .contains("emp27: 15 goal joints, 12 leg joints, 50 Hz")
    );
    let models: Value = serde_json::from_slice(&emp(&server.url, &["models", "--json"])?.stdout)?;
    assert!(
        models[0]["weights_sha256"]
            .as_str()
            .is_some_and(|sum| sum.len() == 64)
    );
    assert!(text(&emp(&server.url, &["models"])?.stdout).contains("emp27-retargeter"));
    Ok(())
}

#[test]
fn the_command_says_what_is_wrong_and_fails() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let server = ServerProcess::start(folder.path())?;
    let motion = folder.path().join("motion.bvh");
    std::fs::write(&motion, "HIERARCHY\nnonsense")?;
    let motion = motion.to_string_lossy().into_owned();
    let out = folder
        .path()
        .join("joints.csv")
        .to_string_lossy()
        .into_owned();
    let broken = emp(
        &server.url,
        &["retarget", &motion, "--robot", "emp27", "--out", &out],
    )?;
    assert_eq!(broken.status.code(), Some(1));
    assert!(
        text(&broken.stderr).contains("motion.bvh"),
        "{}",
        text(&broken.stderr)
    );
    let nowhere = emp("http://127.0.0.1:1", &["robots"])?;
    assert_eq!(nowhere.status.code(), Some(1));
    assert!(
        text(&nowhere.stderr).contains("cannot connect to http://127.0.0.1:1"),
        "{}",
        text(&nowhere.stderr)
    );
    assert_eq!(emp(&server.url, &["retarget"])?.status.code(), Some(2));
    Ok(())
}

#[test]
fn the_server_says_which_setting_is_wrong() -> anyhow::Result<()> {
    let server = |arguments: &[&str]| {
        Command::new(binaries()?.join("emp-server"))
            .args(arguments)
            .output()
            .map_err(anyhow::Error::from)
    };
    let output = server(&["--listen", "nowhere"])?;
    assert_eq!(output.status.code(), Some(1));
    assert!(
        text(&output.stderr).contains("listen"),
        "{}",
        text(&output.stderr)
    );
    let folder = tempfile::tempdir()?;
    let empty = folder.path().to_string_lossy().into_owned();
    let output = server(&["--robots", &empty, "--weights", &empty])?;
    assert_eq!(output.status.code(), Some(1));
    assert!(
        text(&output.stderr).contains("no robot"),
        "{}",
        text(&output.stderr)
    );
    Ok(())
}

#[test]
fn the_client_links_neither_mujoco_nor_candle() -> anyhow::Result<()> {
    let tree = Command::new(env!("CARGO"))
        .args([
            "tree",
            "--offline",
            "-p",
            "emp-client",
            "-e",
            "normal,build",
            "--prefix",
            "none",
        ])
        .current_dir(root())
        .output()?;
    assert!(tree.status.success(), "{}", text(&tree.stderr));
    let tree = text(&tree.stdout);
    assert!(
        tree.contains("emp-motion") && tree.contains("tonic"),
        "{tree}"
    );
    for heavy in ["mujoco", "candle", "emp-models", "emp-robot", "emp-server"] {
        assert!(
            !tree.lines().any(|line| line.starts_with(heavy)),
            "{heavy} is among the client's dependencies"
        );
    }
    Ok(())
}
