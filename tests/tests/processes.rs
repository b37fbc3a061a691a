//! The shipped binaries: `emp-server` from any folder, its end by SIGTERM, and `emp` against it.

use std::{
    ffi::OsStr,
    path::Path,
    process::{Command, Output},
};

use emp_client::{Backoff, Client, ClientError, Event, StreamConfig};
use emp_motion::{key_nodes, skills};
use emp_tests::{
    policy, poses,
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
    let mut clip = skills::generate(skills::Skill::Wave, 1)
        .resampled(50.0)
        .expect("an ordinary rate");
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

fn evaluation_server(weights: &Path) -> anyhow::Result<(tempfile::TempDir, ServerProcess)> {
    let folder = tempfile::tempdir()?;
    let arguments = [OsStr::new("--weights"), weights.as_os_str()];
    let server = ServerProcess::start_with(folder.path(), &arguments)?;
    Ok((folder, server))
}

#[test]
fn the_command_evaluates_a_controller() -> anyhow::Result<()> {
    let weights = policy::weights()?;
    let (folder, server) = evaluation_server(weights.path())?;
    let motions = folder.path().join("motions");
    std::fs::create_dir(&motions)?;
    let clip = skills::generate(skills::Skill::Wave, 1)
        .resampled(50.0)
        .expect("an ordinary rate");
    key_nodes::write(&motions.join("wave.npz"), &clip)?;
    let table = folder.path().join("episodes.csv");
    let [motions, table] = [motions, table].map(|path| path.to_string_lossy().into_owned());
    let arguments = [
        "evaluate",
        "--robot",
        "emp27",
        "--controller",
        "amplitude-cut:factor=0.8",
        "--motions",
        &motions,
        "--procedural",
        "1",
        "--seed",
        "4",
        "--load",
        "0.5..0.6",
        "--csv",
        &table,
    ];
    let json = emp(&server.url, &[&arguments[..], &["--json"]].concat())?;
    assert!(json.status.success(), "{}", text(&json.stderr));
    let object: Value = serde_json::from_slice(&json.stdout)?;
    assert_eq!(object["robot"], "emp27");
    assert_eq!(object["controller"], "amplitude-cut:factor=0.8");
    assert_eq!(object["seed"], 4);
    assert_eq!(object["complete"], true);
    for metric in ["suc", "mjp", "msc", "mbv", "mba", "mbo", "mus"] {
        for part in ["low", "mean", "high"] {
            assert!(object[metric][part].is_f64(), "{metric}.{part}: {object}");
        }
    }
    let episodes = object["episodes"].as_u64().expect("a number");
    let of = |set: &str| object[set]["episodes"].as_u64().expect("a number");
    assert_eq!(of("recorded") + of("procedural"), episodes);
    let failures = object["failures"].as_array().expect("failures");
    assert!(!failures.is_empty(), "a random policy falls");
    assert!(failures[0]["time"].as_f64().is_some_and(|time| time > 0.0));
    let rows = std::fs::read_to_string(&table)?;
    assert_eq!(rows.lines().count() as u64, 1 + episodes);

    let again = emp(&server.url, &[&arguments[..], &["--json"]].concat())?;
    assert_eq!(again.stdout, json.stdout, "the same request, the same bits");
    let printed = emp(&server.url, &arguments)?;
    let printed = text(&printed.stdout);
    for part in ["SUC", "procedural (", "goals: faster hand", "failed: "] {
        assert!(printed.contains(part), "{printed}");
    }

    let unknown = emp(
        &server.url,
        &[
            "evaluate",
            "--robot",
            "emp27",
            "--procedural",
            "1",
            "--controller",
            "wishful-thinking",
        ],
    )?;
    assert_eq!(unknown.status.code(), Some(1));
    assert!(
        text(&unknown.stderr).contains("velocity-limit"),
        "it says what there is: {}",
        text(&unknown.stderr)
    );
    Ok(())
}

/// Starts an evaluation without end, lets some episodes finish, stops it by `stop`, and gives what was printed.
fn stopped_evaluation(
    server: &mut ServerProcess,
    table: &Path,
    stop: impl FnOnce(u32, &mut ServerProcess) -> anyhow::Result<()>,
) -> anyhow::Result<Output> {
    let child = Command::new(binaries()?.join("emp"))
        .args(["--server", &server.url, "evaluate", "--robot", "emp27"])
        .args(["--procedural", "1", "--episodes", "100000", "--json"])
        .arg("--csv")
        .arg(table)
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped())
        .spawn()?;
    std::thread::sleep(std::time::Duration::from_secs(4));
    stop(child.id(), server)?;
    Ok(child.wait_with_output()?)
}

fn assert_partial(output: &Output, table: &Path) -> anyhow::Result<()> {
    let object: Value = serde_json::from_slice(&output.stdout)?;
    assert_eq!(object["complete"], false);
    let episodes = object["episodes"].as_u64().expect("a number");
    assert!(episodes > 0);
    assert!(object["mbo"]["mean"].is_f64());
    let rows = std::fs::read_to_string(table)?;
    assert_eq!(rows.lines().count() as u64, 1 + episodes);
    Ok(())
}

#[test]
fn an_interrupted_evaluation_reports_what_finished() -> anyhow::Result<()> {
    let weights = policy::weights()?;
    let (folder, mut server) = evaluation_server(weights.path())?;
    let table = folder.path().join("episodes.csv");
    let output = stopped_evaluation(&mut server, &table, |client, _| {
        Command::new("kill")
            .args(["-INT", &client.to_string()])
            .status()?;
        Ok(())
    })?;
    assert_eq!(output.status.code(), Some(130), "{}", text(&output.stderr));
    assert_partial(&output, &table)
}

#[test]
fn sigterm_drains_a_server_with_an_evaluation_running() -> anyhow::Result<()> {
    let weights = policy::weights()?;
    let (folder, mut server) = evaluation_server(weights.path())?;
    let table = folder.path().join("episodes.csv");
    let output = stopped_evaluation(&mut server, &table, |_, server| {
        server.terminate()?;
        let status = server.wait()?;
        assert!(status.success(), "{status}");
        Ok(())
    })?;
    assert_eq!(output.status.code(), Some(1));
    assert!(
        text(&output.stderr).contains("shutting down"),
        "{}",
        text(&output.stderr)
    );
    assert_partial(&output, &table)
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
