use candle_core::Tensor;
use candle_nn::VarMap;

use super::*;
use crate::filters::{EmpFilter, FilterItem, GoalFilter as _, Risk};
use crate::observation::{HISTORY, HistoryMap};

fn robot() -> Arc<Robot> {
    Arc::new(Robot::load("../robots/emp27".as_ref()).unwrap())
}

fn config(robot: &Robot, output: Output) -> EmpConfig {
    EmpConfig {
        history_map: HistoryMap::differences(),
        output,
        state_hidden: vec![8],
        target_hidden: vec![8],
        encoding: 4,
        fusion_hidden: vec![8],
        latent: 3,
        decoder_hidden: vec![8],
        gate: DangerGate::Tilt(0.2),
        ..EmpConfig::paper(robot)
    }
}

/// Saves an EMP with random weights and loads it again.
fn emp(robot: &Arc<Robot>, config: &EmpConfig) -> Arc<Emp> {
    let vars = VarMap::new();
    let builder = VarBuilder::from_varmap(&vars, DType::F32, &Device::Cpu);
    let normalizer = Normalizer::identity(config.features());
    let network = EmpNetwork::new(config.clone(), normalizer.clone(), &builder).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("emp.safetensors");
    let (tensors, training) = (network.tensors(), serde_json::Value::Null);
    Emp::save(
        &path,
        robot,
        config,
        &normalizer,
        &tensors,
        training,
        String::new(),
    )
    .unwrap();
    Arc::new(Emp::load(&path, Arc::clone(robot)).unwrap())
}

fn stacks(config: &EmpConfig, rows: usize) -> Vec<f32> {
    let numbers = rows * config.observation.width();
    (0..numbers).map(|i| (i as f32 * 0.37).sin()).collect()
}

#[test]
fn the_papers_network_has_its_sizes() {
    let robot = robot();
    let config = EmpConfig::paper(&robot);
    assert_eq!(config.features(), 855);
    let vars = VarMap::new();
    let builder = VarBuilder::from_varmap(&vars, DType::F32, &Device::Cpu);
    let normalizer = Normalizer::identity(config.features());
    let network = EmpNetwork::new(config, normalizer, &builder).unwrap();
    let tensors = network.tensors();
    let numbers = tensors.values().map(Tensor::elem_count);
    // 11.9 million, as in the performance notes.
    assert!((11_800_000..12_100_000).contains(&numbers.sum::<usize>()));
}

#[test]
fn a_saved_emp_loads_and_a_batch_equals_its_rows() {
    let robot = robot();
    for output in [Output::Absolute, Output::Residual] {
        let config = config(&robot, output);
        let emp = emp(&robot, &config);
        assert_eq!(emp.config(), &config);
        assert_eq!(emp.metadata().history_length, HISTORY);
        let (stacks, width) = (stacks(&config, 5), config.observation.width());
        let batch = emp.answer(&stacks).unwrap();
        for (stack, expected) in stacks.chunks(width).zip(&batch) {
            let answer = &emp.answer(stack).unwrap()[0];
            assert_eq!(answer, expected);
            let inside = robot
                .goal_joints()
                .iter()
                .zip(&answer.goal)
                .all(|(joint, &a)| (joint.range[0] as f32..=joint.range[1] as f32).contains(&a));
            assert!(inside, "{answer:?}");
        }
        assert!(emp.answer(&[]).unwrap().is_empty());
        assert!(emp.answer(&stacks[1..]).is_err());
    }
}

#[test]
fn answers_are_the_candle_networks() {
    let robot = robot();
    for output in [Output::Absolute, Output::Residual] {
        let config = config(&robot, output);
        let features = config.features();
        let normalizer = Normalizer {
            mean: (0..features).map(|i| (i as f32).cos()).collect(),
            scale: vec![0.7; features],
        };
        let vars = VarMap::new();
        let builder = VarBuilder::from_varmap(&vars, DType::F32, &Device::Cpu);
        let network = EmpNetwork::new(config.clone(), normalizer.clone(), &builder).unwrap();
        let mut tensors: Tensors = normalizer.tensors().unwrap().into_iter().collect();
        for (name, tensor) in network.tensors() {
            tensors.insert(format!("{NETWORK_PREFIX}.{name}"), tensor);
        }
        let metadata = emp_metadata(&robot);
        let emp = Emp::from_tensors(config.clone(), Arc::clone(&robot), tensors, metadata).unwrap();
        let (stacks, width) = (stacks(&config, 3), config.observation.width());
        let goals = stacks.chunks(width);
        let goals = goals.flat_map(|stack| stack[config.observation.newest_goal()].to_vec());
        let goals = Tensor::from_iter(goals, &Device::Cpu).unwrap();
        let goals = goals.reshape((3, ())).unwrap();
        let tensor = Tensor::from_slice(&stacks, (3, width), &Device::Cpu).unwrap();
        let (executable, latent) = network.forward(&tensor, &goals).unwrap();
        let latent = latent.sqr().unwrap().mean(1).unwrap();
        let rows = executable.to_vec2::<f32>().unwrap().into_iter();
        let expected = rows.zip(latent.to_vec1::<f32>().unwrap());
        for (answer, (mut goal, regloss)) in emp.answer(&stacks).unwrap().iter().zip(expected) {
            robot.clamp_goal(&mut goal);
            assert!((answer.regloss - regloss).abs() < 1e-5);
            for (a, b) in answer.goal.iter().zip(goal) {
                assert!((a - b).abs() < 1e-5, "{a} {b}");
            }
        }
    }
}

#[test]
fn weights_of_another_kind_are_refused() {
    let weights = "weights/emp27-policy.safetensors";
    let error = Emp::load(weights.as_ref(), robot())
        .unwrap_err()
        .to_string();
    assert!(error.contains("kind"), "{error}");
}

/// Filters one goal in a robot that is pitched by `pitch`.
fn step(
    filter: &EmpFilter,
    stack: &mut [f32],
    pitch: f32,
    memory: &mut Vec<f32>,
) -> (Vec<f32>, Risk) {
    let layout = filter.emp().config().observation;
    let orientation = layout.newest().start + layout.orientation().start;
    stack[orientation..orientation + 3].copy_from_slice(&[0.0, pitch, 0.0]);
    let mut goal = stack[layout.newest_goal()].to_vec();
    let mut risk = None;
    filter
        .filter(&mut [FilterItem {
            observation: stack,
            goal: &mut goal,
            memory,
            risk: &mut risk,
        }])
        .unwrap();
    (goal, risk.unwrap())
}

#[test]
fn danger_fades_the_correction_in_and_safety_fades_it_out() {
    let robot = robot();
    let config = config(&robot, Output::Residual);
    let emp = emp(&robot, &config);
    let filter = EmpFilter::when_danger(Arc::clone(&emp), config.gate);
    let mut stack = stacks(&config, 1);
    let asked = stack[config.observation.newest_goal()].to_vec();
    let mut memory = Vec::new();
    let (goal, risk) = step(&filter, &mut stack, 0.1, &mut memory);
    assert_eq!((&goal, risk.danger, risk.applied), (&asked, false, 0.0));
    let mut shares = Vec::new();
    for _ in 0..6 {
        let (_, risk) = step(&filter, &mut stack, 0.3, &mut memory);
        assert!(risk.danger);
        shares.push((risk.applied * 10.0).round() / 10.0);
    }
    assert_eq!(shares, [0.2, 0.4, 0.6, 0.8, 1.0, 1.0]);
    let (goal, _) = step(&filter, &mut stack, 0.3, &mut memory);
    let full = &emp.answer(&stack).unwrap()[0];
    for (a, b) in goal.iter().zip(&full.goal) {
        assert!((a - b).abs() < 1e-6, "{a} {b}");
    }
    let (_, risk) = step(&filter, &mut stack, 0.1, &mut memory);
    assert!(!risk.danger && (risk.applied - 0.96).abs() < 1e-6);
    for _ in 0..25 {
        step(&filter, &mut stack, 0.1, &mut memory);
    }
    let (goal, _) = step(&filter, &mut stack, 0.1, &mut memory);
    assert_eq!(goal, asked);
}

#[test]
fn always_is_always_and_regloss_is_judged_by_its_limit() {
    let robot = robot();
    let config = config(&robot, Output::Residual);
    let emp = emp(&robot, &config);
    let mut stack = stacks(&config, 1);
    let (goal, risk) = step(
        &EmpFilter::always(Arc::clone(&emp)),
        &mut stack,
        0.0,
        &mut Vec::new(),
    );
    let full = &emp.answer(&stack).unwrap()[0];
    assert_eq!((risk.applied, risk.danger), (1.0, false));
    assert_eq!((&goal, risk.regloss), (&full.goal, full.regloss));
    for (limit, danger) in [(full.regloss * 0.9, true), (full.regloss * 1.1, false)] {
        let gate = DangerGate::Regloss(limit);
        let filter = EmpFilter::when_danger(Arc::clone(&emp), gate);
        let (_, risk) = step(&filter, &mut stack, 0.0, &mut Vec::new());
        assert_eq!(risk.danger, danger);
    }
}
