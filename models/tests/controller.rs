//! The controller: order of things in a control period, batches, refusals.

use std::{sync::Arc, time::Duration};

use candle_core::{DType, Device};
use candle_nn::{VarBuilder, VarMap};
use emp_models::{
    ModelError,
    checkpoint::Tensors,
    controller::{Controller, ControllerInput, ControllerState},
    filters::{DECOUPLED, FilterItem, GoalFilter},
    guard::{ExecutionGuard, GuardSettings},
    mlp::{Mlp, Normalizer},
    observation::RobotState,
    policy::{Policy, PolicyConfig},
};
use emp_robot::Robot;
use nalgebra::UnitQuaternion;

/// A policy with random weights.
fn policy() -> Arc<Policy> {
    let robot = Arc::new(Robot::load("../robots/emp27".as_ref()).expect("emp27"));
    let config = PolicyConfig::new(&robot, vec![16]);
    let vars = VarMap::new();
    let builder = VarBuilder::from_varmap(&vars, DType::F32, &Device::Cpu);
    Mlp::new(config.features(), &config.hidden, 12, &builder).expect("a network");
    let network: Tensors = vars
        .data()
        .lock()
        .expect("the variables")
        .iter()
        .map(|(name, var)| (name.clone(), var.as_detached_tensor()))
        .collect();
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("policy.safetensors");
    let normalizer = Normalizer::identity(config.features());
    let training = serde_json::Value::Null;
    Policy::save(
        &path,
        &robot,
        &config,
        &normalizer,
        &network,
        training,
        String::new(),
    )
    .expect("saved");
    Arc::new(Policy::load(&path, robot).expect("loaded"))
}

/// Adds the number of frames that it has seen to every angle.
struct Counting;

impl GoalFilter for Counting {
    fn name(&self) -> &'static str {
        "counting"
    }

    fn filter(&self, batch: &mut [FilterItem<'_>]) -> Result<(), ModelError> {
        for item in batch {
            let newest = &item.observation[item.observation.len() - item.goal.len()..];
            assert_eq!(
                newest, item.goal,
                "the filter sees the goal that was asked for"
            );
            item.memory.push(0.0);
            let seen = item.memory.len() as f32;
            item.goal.iter_mut().for_each(|angle| *angle += seen);
        }
        Ok(())
    }
}

fn input<'a>(positions: &'a [f32], goal: &'a [f32], pitch: f64) -> ControllerInput<'a> {
    ControllerInput {
        state: RobotState {
            joint_positions: positions,
            orientation: UnitQuaternion::from_euler_angles(0.0, pitch, 0.4),
        },
        goal,
    }
}

#[test]
fn the_filtered_goal_is_executed_observed_and_remembered() {
    let controller = Controller::new(policy(), Some(Arc::new(Counting)));
    assert_eq!(controller.name(), "counting");
    let layout = *controller.policy().layout();
    let mut state = controller.state();
    let mut last_action = vec![0.0; 12];
    for seen in 1..=3 {
        let (positions, goal) = ([0.1; 27], [0.2; 15]);
        let answers = controller
            .step(&mut [(&mut state, input(&positions, &goal, 0.05))])
            .expect("an answer");
        assert_eq!(answers[0].goal, [0.2 + seen as f32; 15]);
        let newest = state.history().newest();
        assert_eq!(newest[layout.goal()], answers[0].goal);
        assert_eq!(newest[layout.last_action()], last_action);
        assert_eq!(
            answers[0].leg_targets,
            controller.policy().leg_targets(&answers[0].action)
        );
        last_action.clone_from(&answers[0].action);
    }
    state.reset();
    assert!(state.history().is_empty());
    let answers = controller
        .step(&mut [(&mut state, input(&[0.1; 27], &[0.2; 15], 0.05))])
        .expect("an answer");
    assert_eq!(answers[0].goal, [1.2; 15], "the filter's memory went too");
}

/// Asks for twice the angle.
struct Doubling;

impl GoalFilter for Doubling {
    fn name(&self) -> &'static str {
        "doubling"
    }

    fn filter(&self, batch: &mut [FilterItem<'_>]) -> Result<(), ModelError> {
        for item in batch {
            item.goal.iter_mut().for_each(|angle| *angle *= 2.0);
        }
        Ok(())
    }
}

#[test]
fn what_the_guard_leaves_is_executed_and_observed() {
    let policy = policy();
    let robot = Arc::clone(policy.robot());
    let controller = Controller::new(policy, Some(Arc::new(Doubling)));
    let layout = *controller.policy().layout();
    let settings = GuardSettings {
        ramp: Duration::from_millis(100),
        stale_after: Duration::from_secs(1),
        return_after: Duration::from_secs(1),
    };
    let mut state = controller
        .state()
        .with_guard(ExecutionGuard::new(&robot, &settings));
    let positions = [0.0; 27];
    let mut goal = [0.0; 15];
    goal[0] = 0.1;
    let mut run = |goal: &[f32], periods: usize| {
        let mut executed = Vec::new();
        for _ in 0..periods {
            let answer = controller
                .step(&mut [(&mut state, input(&positions, goal, 0.0))])
                .expect("an answer")
                .remove(0);
            assert_eq!(state.history().newest()[layout.goal()], answer.goal);
            executed.push((answer.goal[0], answer.execution.expect("a guard")));
        }
        executed
    };
    let executed = run(&goal, 6);
    assert_eq!(executed[0].0, 0.1, "the correction fades in");
    assert_eq!(executed[0].1.fade, Some(0.0));
    assert_eq!(executed[5].0, 0.2);
    assert_eq!(executed[5].1.fade, None);
    goal[0] = 0.6;
    let executed = run(&goal, 1);
    let step = (robot.goal_joints()[0].velocity_limit / robot.control_rate_hz()) as f32;
    assert!((executed[0].0 - (0.2 + step)).abs() < 1e-6);
    assert_eq!(executed[0].1.limited, [0]);
    assert_eq!(executed[0].1.wanted[0], 1.2);
}

#[test]
fn a_robot_in_a_batch_is_a_robot_alone() {
    let controller = Controller::new(policy(), None);
    assert_eq!(controller.name(), DECOUPLED);
    let mut together: Vec<ControllerState> = (0..3).map(|_| controller.state()).collect();
    let mut alone = controller.state();
    for t in 0..20 {
        let rows: Vec<[f32; 27]> = (0..3).map(|i| [(t * (i + 1)) as f32 * 0.01; 27]).collect();
        let goal = [t as f32 * 0.02; 15];
        let mut batch: Vec<_> = together
            .iter_mut()
            .zip(&rows)
            .map(|(state, row)| (state, input(row, &goal, 0.01 * t as f64)))
            .collect();
        let answers = controller.step(&mut batch).expect("answers");
        let single = controller
            .step(&mut [(&mut alone, input(&rows[1], &goal, 0.01 * t as f64))])
            .expect("an answer");
        for (a, b) in answers[1].action.iter().zip(&single[0].action) {
            assert!((a - b).abs() < 1e-5, "{a} {b}");
        }
    }
}

#[test]
fn a_wrong_width_is_refused_before_anything_changes() {
    let controller = Controller::new(policy(), None);
    let (mut good, mut bad) = (controller.state(), controller.state());
    let mut batch = [
        (&mut good, input(&[0.0; 27], &[0.0; 15], 0.0)),
        (&mut bad, input(&[0.0; 27], &[0.0; 14], 0.0)),
    ];
    let error = controller
        .step(&mut batch)
        .expect_err("refused")
        .to_string();
    assert!(
        error.contains("frame 1") && error.contains("14 goal angles, expected 15"),
        "{error}"
    );
    assert!(good.history().is_empty());
}
