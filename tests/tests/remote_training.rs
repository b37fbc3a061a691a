//! A learner whose environments are simulated by servers learns from the rollouts that its own machine would have collected.

use std::{ffi::OsStr, sync::Arc, time::Duration};

use emp_robot::Robot;
use emp_sim::{
    Pool, Priority, Rollout,
    environment::EnvironmentConfig,
    goals::{GoalClip, GoalLibrary, Source},
};
use emp_tests::{TestServer, emp27, process::ServerProcess, root, weights};
use emp_training::policy::{
    Preset, Settings, Trainer,
    remote::RemoteSource,
    source::{LocalSource, PolicySnapshot, RolloutSource},
};

const HORIZON: usize = 24;

/// Many short episodes.
fn settings(robot: &Robot) -> Settings {
    Settings {
        environments: 64,
        environment: EnvironmentConfig {
            episode_frames: 20,
            ..EnvironmentConfig::robust(robot)
        },
        ..Settings::preset(Preset::Robust, robot)
    }
}

fn library(robot: &Robot) -> anyhow::Result<GoalLibrary> {
    let joints = robot.goal_joints().iter();
    let rest: Vec<f32> = joints.map(|joint| joint.default as f32).collect();
    let row = |t: usize| rest.iter().map(move |q| q + 0.3 * (0.1 * t as f32).sin());
    let rows: Vec<Vec<f32>> = (0..150).map(|t| row(t).collect()).collect();
    let clip = GoalClip::new(robot, "swing", Source::Recorded, &rows)?;
    Ok(GoalLibrary::new(robot, vec![clip])?)
}

fn snapshot(robot: &Arc<Robot>) -> anyhow::Result<PolicySnapshot> {
    let trainer = Trainer::new(
        Arc::clone(robot),
        settings(robot),
        Arc::new(library(robot)?),
        1,
    )?;
    Ok(PolicySnapshot {
        policy: Arc::new(trainer.policy()?),
        log_std: vec![-1.0; robot.leg_joints().len()],
        randomization: 0.5,
        difficulty: 0.8,
        clip_weights: vec![0.7],
    })
}

fn local(robot: &Arc<Robot>) -> anyhow::Result<LocalSource> {
    let pool = Arc::new(Pool::new(robot, 2, Priority::Normal)?);
    LocalSource::new(robot, &pool, &settings(robot), Arc::new(library(robot)?))
}

fn collect(source: &mut dyn RolloutSource, snapshot: &PolicySnapshot) -> anyhow::Result<Rollout> {
    Ok(source.collect(snapshot, HORIZON)?.rollout)
}

/// Equal but for the last bits of the mean reward terms, which are added in another order.
fn assert_same(served: &Rollout, here: &Rollout) {
    let terms = served.statistics.reward_terms.iter();
    for (a, b) in terms.zip(&here.statistics.reward_terms) {
        assert!((a - b).abs() < 1e-9, "{a} {b}");
    }
    let mut expected = here.clone();
    expected.statistics.reward_terms = served.statistics.reward_terms.clone();
    assert!(!here.timed_out_privileged.is_empty());
    assert_eq!(*served, expected);
}

#[test]
fn two_server_processes_collect_what_this_one_would() -> anyhow::Result<()> {
    let robot = emp27()?;
    let snapshot = snapshot(&robot)?;
    let folder = tempfile::tempdir()?;
    let (robots, weights) = (root().join("robots"), weights()?);
    let arguments = [
        OsStr::new("--robots"),
        robots.as_os_str(),
        OsStr::new("--weights"),
        weights.as_os_str(),
    ];
    let servers = [
        ServerProcess::start_with(folder.path(), &arguments)?,
        ServerProcess::start_with(folder.path(), &arguments)?,
    ];
    let urls = servers.each_ref().map(|server| server.url.clone());
    let mut here = local(&robot)?;
    let mut there = RemoteSource::new(&urls, &robot, &settings(&robot), &library(&robot)?)?;
    for _ in 0..3 {
        let served = collect(&mut there, &snapshot)?;
        assert_same(&served, &collect(&mut here, &snapshot)?);
    }
    let saved = there.snapshot()?;
    let next = collect(&mut there, &snapshot)?;
    there.restore(&saved)?;
    assert_eq!(collect(&mut there, &snapshot)?, next);
    Ok(())
}

#[test]
fn a_server_that_comes_back_goes_on_where_it_was() -> anyhow::Result<()> {
    let robot = emp27()?;
    let snapshot = snapshot(&robot)?;
    let server = TestServer::start_real()?;
    let (port, urls) = (server.port(), [server.url()]);
    let mut here = local(&robot)?;
    let mut there = RemoteSource::new(&urls, &robot, &settings(&robot), &library(&robot)?)?;
    let served = collect(&mut there, &snapshot)?;
    assert_same(&served, &collect(&mut here, &snapshot)?);
    server.kill();
    let restarted = std::thread::spawn(move || {
        // The learner finds nobody at first.
        std::thread::sleep(Duration::from_millis(300));
        TestServer::start_with_on(port, &weights()?, |_| {})
    });
    let served = collect(&mut there, &snapshot)?;
    assert_same(&served, &collect(&mut here, &snapshot)?);
    drop(restarted.join().expect("the thread")?);
    Ok(())
}

#[test]
fn a_server_that_refuses_is_named() -> anyhow::Result<()> {
    let robot = emp27()?;
    let server = TestServer::start_real()?;
    let mut wrong = settings(&robot);
    wrong.environment.tilt_limit = 2.0;
    let source = RemoteSource::new(&[server.url()], &robot, &wrong, &library(&robot)?);
    let error = format!("{:#}", source.err().expect("a refusal"));
    assert!(
        error.contains(&server.url()) && error.contains("tilt_limit"),
        "{error}"
    );
    Ok(())
}
