//! Simulation against its limit: physics through the pool, and whole rollouts, beside a bare loop of `mj_step`.
//!
//! ```text
//! cargo bench -p emp-sim [-- --robot NAME]      # ratios, medians of interleaved rounds
//! cargo bench -p emp-sim -- --save FILE.mjb     # the compiled model, for benches/reference.py
//! ```

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use candle_core::{DType, Device, Tensor};
use emp_models::CheckpointMetadata;
use emp_models::checkpoint::Tensors;
use emp_models::policy::{KIND, NETWORK_PREFIX, Policy, PolicyConfig};
use emp_robot::Robot;
use emp_sim::environment::{EnvironmentConfig, Randomization, VecEnvironment};
use emp_sim::goals::{GoalClip, GoalLibrary, Source};
use emp_sim::tracking::{TrackingEnvironments, TrackingSettings};
use emp_sim::{Body, BodyParameters, Collector, Pool, Priority, Stage, Start, Targets};
use mujoco_rs::prelude::*;
use rayon::prelude::*;

/// Robots in a batch.
const BODIES: usize = 256;
/// Control periods of one measurement; the robots stand as long, held by their servos alone.
const PERIODS: usize = 20;
/// Measurements of each kind.
const ROUNDS: usize = 15;
/// Hidden layers of the policy.
const HIDDEN: [usize; 3] = [256, 128, 64];

/// One round of one kind of work; answers how long it took.
type Round<'a> = Box<dyn FnMut() -> Duration + 'a>;

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let option = |name: &str| {
        let at = arguments.iter().position(|argument| argument == name)?;
        arguments.get(at + 1).map(String::as_str)
    };
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots");
    let robot = Robot::load(&folder.join(option("--robot").unwrap_or("emp27")));
    let robot = Arc::new(robot.expect("a robot of the workspace"));
    if let Some(file) = option("--save") {
        robot.model().save_to_file(file).expect("a writable file");
        return;
    }
    println!(
        "{}: {BODIES} robots, {PERIODS} control periods, medians of {ROUNDS} rounds",
        robot.name()
    );
    for threads in [1, 2] {
        measure(&robot, threads);
    }
}

/// Interleaved rounds on `threads` threads.
fn measure(robot: &Arc<Robot>, threads: usize) {
    let pool = Arc::new(Pool::new(robot, threads, Priority::Normal).expect("a pool"));
    let policy = policy(robot);
    let library = Arc::new(standing(robot));
    let mut kinds: Vec<(&str, Round<'_>)> = vec![
        ("mj_step loop", Box::new(bare(robot, threads))),
        (
            "pool, nominal",
            Box::new(physics(robot, &pool, |_| BodyParameters::default())),
        ),
        (
            "pool, each robot different",
            Box::new(physics(robot, &pool, different)),
        ),
        (
            "observations, rewards, policy",
            Box::new(rollouts(
                robot,
                &pool,
                &policy,
                &library,
                Randomization::nominal(),
            )),
        ),
        (
            "the same, randomised",
            Box::new(rollouts(
                robot,
                &pool,
                &policy,
                &library,
                Randomization::default(),
            )),
        ),
        (
            "tracking environments",
            Box::new(tracking(robot, &pool, &policy, &library)),
        ),
    ];
    let mut times = vec![Vec::new(); kinds.len()];
    for _ in 0..ROUNDS {
        for (times, (_, run)) in times.iter_mut().zip(&mut kinds) {
            times.push(run().as_secs_f64());
        }
    }
    let steps = (BODIES * PERIODS) as f64;
    let substeps = robot.substeps() as f64;
    for (i, (name, _)) in kinds.iter().enumerate() {
        let ratios = times[0]
            .iter()
            .zip(&times[i])
            .map(|(bare, time)| bare / time);
        let rate = steps / median(times[i].iter().copied());
        println!(
            "{threads} thread(s)  {name:30} {rate:8.0} control periods/s {:8.0} mj_step/s   ratio {:.3}",
            rate * substeps,
            median(ratios),
        );
    }
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn rest(robot: &Robot) -> Vec<f64> {
    robot.joints().map(|joint| joint.default).collect()
}

fn place(robot: &Robot, stage: &mut Stage, parameters: BodyParameters) -> Body {
    stage.place(&Start {
        joint_positions: &rest(robot),
        lift: 0.0,
        parameters,
    })
}

/// The limit: every thread steps one data, put back where it started as often as there are robots.
fn bare(robot: &Arc<Robot>, threads: usize) -> impl FnMut() -> Duration + use<> {
    let mut data: Vec<_> = (0..threads)
        .map(|_| {
            let mut data = MjData::new(Box::new(robot.model()));
            data.qpos_mut()[2] = robot.standing_height();
            for joint in robot.joints() {
                data.qpos_mut()[joint.qpos_address] = joint.default;
            }
            data.ctrl_mut().copy_from_slice(&rest(robot));
            data
        })
        .collect();
    let state: Vec<f64> = data[0].qpos().to_vec();
    let (share, steps) = (BODIES / threads, PERIODS * robot.substeps());
    move || {
        let start = Instant::now();
        std::thread::scope(|scope| {
            for data in &mut data {
                let state = &state;
                scope.spawn(move || {
                    for _ in 0..share {
                        data.qpos_mut().copy_from_slice(state);
                        data.qvel_mut().fill(0.0);
                        data.qacc_warmstart_mut().fill(0.0);
                        for _ in 0..steps {
                            data.step();
                        }
                    }
                });
            }
        });
        start.elapsed()
    }
}

/// Bodies through the pool, one control period after the other.
fn physics(
    robot: &Arc<Robot>,
    pool: &Arc<Pool>,
    parameters: fn(usize) -> BodyParameters,
) -> impl FnMut() -> Duration + use<> {
    let mut stage = Stage::new(robot).expect("a stage");
    let bodies: Vec<Body> = (0..BODIES)
        .map(|index| place(robot, &mut stage, parameters(index)))
        .collect();
    let targets: Vec<f32> = rest(robot).iter().map(|&angle| angle as f32).collect();
    let goals = robot.goal_joints().len();
    let pool = Arc::clone(pool);
    move || {
        let mut bodies = bodies.clone();
        let targets = Targets {
            goal: &targets[..goals],
            legs: &targets[goals..],
        };
        let start = Instant::now();
        for _ in 0..PERIODS {
            pool.for_each(bodies.par_iter_mut(), |stage, body| {
                stage.step(body, &targets);
            });
        }
        start.elapsed()
    }
}

/// Parameters of a robot like no other.
fn different(index: usize) -> BodyParameters {
    BodyParameters {
        hand_mass: [0.001 * index as f64; 2],
        ..BodyParameters::default()
    }
}

/// Whole rollouts, resets of robots that fall or time out included.
fn rollouts(
    robot: &Arc<Robot>,
    pool: &Arc<Pool>,
    policy: &Arc<Policy>,
    library: &Arc<GoalLibrary>,
    randomization: Randomization,
) -> impl FnMut() -> Duration + use<> {
    let config = EnvironmentConfig {
        randomization,
        ..EnvironmentConfig::default()
    };
    let environments = VecEnvironment::new(
        Arc::clone(robot),
        Arc::clone(pool),
        config,
        Arc::clone(library),
        0..BODIES as u64,
        1,
    );
    let mut collector = Collector::new(environments.expect("environments"), 0, 1);
    let log_std = vec![-3.0; robot.leg_joints().len()];
    let policy = Arc::clone(policy);
    move || {
        let start = Instant::now();
        collector
            .collect(&policy, &log_std, PERIODS)
            .expect("a rollout");
        start.elapsed()
    }
}

/// Control periods under the mixed conditions of EMP training, resets included.
fn tracking(
    robot: &Arc<Robot>,
    pool: &Arc<Pool>,
    policy: &Arc<Policy>,
    library: &GoalLibrary,
) -> impl FnMut() -> Duration + use<> {
    let environments = TrackingEnvironments::new(
        Arc::clone(robot),
        Arc::clone(pool),
        Arc::clone(policy),
        TrackingSettings::default(),
        library.clips().cloned().collect(),
        0..BODIES as u64,
        1,
    );
    let mut environments = environments.expect("environments");
    move || {
        let start = Instant::now();
        for _ in 0..PERIODS {
            let goals = environments.goals().to_vec();
            environments.step(&goals).expect("a control period");
        }
        start.elapsed()
    }
}

/// Goals that stay at the default pose.
fn standing(robot: &Robot) -> GoalLibrary {
    let rest: Vec<f32> = robot.default_goal();
    let clip = GoalClip::new(robot, "rest", Source::Procedural, &vec![rest; 100]);
    GoalLibrary::new(robot, vec![clip.expect("a clip")]).expect("a library")
}

/// A policy of the shipped size that keeps the legs at their default pose.
fn policy(robot: &Arc<Robot>) -> Arc<Policy> {
    let config = PolicyConfig::new(robot, HIDDEN.to_vec());
    let widths = [
        &[config.features()],
        &HIDDEN[..],
        &[robot.leg_joints().len()],
    ]
    .concat();
    let zeros = |shape: &[usize]| Tensor::zeros(shape, DType::F32, &Device::Cpu).expect("a tensor");
    let mut tensors = Tensors::new();
    for (layer, pair) in widths.windows(2).enumerate() {
        let name = |part: &str| format!("{NETWORK_PREFIX}.{layer}.{part}");
        tensors.insert(name("weight"), zeros(&[pair[1], pair[0]]));
        tensors.insert(name("bias"), zeros(&[pair[1]]));
    }
    for name in ["mean", "scale"] {
        tensors.insert(format!("normalizer.{name}"), zeros(&[widths[0]]));
    }
    let metadata = CheckpointMetadata::for_joints(KIND, robot, robot.joints());
    let policy = Policy::from_tensors(config, Arc::clone(robot), tensors, metadata);
    Arc::new(policy.expect("a policy"))
}
