use std::path::Path;

use candle_core::{DType, Device};
use candle_nn::{VarBuilder, VarMap};
use emp_models::{
    controller::{Controller, ControllerOutput},
    emp::{DangerGate, EmpConfig, EmpNetwork, Output},
    filters::Risk,
    mlp::Normalizer,
    observation::HistoryMap,
};
use emp_robot::Robot;
use emp_sim::{
    Priority, Reading,
    evaluation::{ExecutedFrame, Observer as _},
    goals::{GoalClip, Source},
};

use std::sync::Arc;

use emp_models::{emp::Emp, policy::Policy};
use emp_sim::{Pool, metrics::Interval};

use super::*;
use crate::sets::{ClipGroup, MotionSet};

fn root() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
}

fn policy() -> Arc<Policy> {
    let robot = Arc::new(Robot::load(&root().join("robots/emp27")).unwrap());
    let weights = root().join("models/weights/emp27-policy.safetensors");
    Arc::new(Policy::load(&weights, robot).unwrap())
}

/// An EMP with small random weights that adds to the goal.
fn emp(robot: &Arc<Robot>) -> Arc<Emp> {
    let config = EmpConfig {
        history_map: HistoryMap::differences(),
        output: Output::Residual,
        state_hidden: vec![8],
        target_hidden: vec![8],
        encoding: 4,
        fusion_hidden: vec![8],
        latent: 3,
        decoder_hidden: vec![8],
        ..EmpConfig::paper(robot)
    };
    let vars = VarMap::new();
    let builder = VarBuilder::from_varmap(&vars, DType::F32, &Device::Cpu);
    let normalizer = Normalizer::identity(config.features());
    let network = EmpNetwork::new(config.clone(), normalizer.clone(), &builder).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("emp.safetensors");
    let (tensors, training) = (network.tensors(), serde_json::Value::Null);
    let revision = String::new();
    Emp::save(
        &path,
        robot,
        &config,
        &normalizer,
        &tensors,
        training,
        revision,
    )
    .unwrap();
    Arc::new(Emp::load(&path, Arc::clone(robot)).unwrap())
}

/// Swinging arms.
fn clips(robot: &Robot) -> Vec<GoalClip> {
    let clip = |number: usize| {
        let goal = |t: usize| -> Vec<f32> {
            let swing = 0.6 * (0.05 * (t * (number + 1)) as f32).sin();
            let joints = robot.goal_joints().iter();
            joints
                .map(|joint| joint.default as f32 + swing * f32::from(joint.name.contains("pitch")))
                .collect()
        };
        let rows: Vec<Vec<f32>> = (0..30).map(goal).collect();
        GoalClip::new(robot, format!("swing {number}"), Source::Procedural, &rows).unwrap()
    };
    (0..3).map(clip).collect()
}

fn small_report() -> EmpReport {
    let policy = policy();
    let robot = policy.robot();
    let pool = Pool::new(robot, 2, Priority::Normal).unwrap();
    let candidates = [Candidate {
        name: "small".to_owned(),
        emp: emp(robot),
    }];
    let families = [Family {
        name: "cut".to_owned(),
        members: ["amplitude-cut:factor=0.9", "amplitude-cut:factor=0.5"]
            .map(str::to_owned)
            .to_vec(),
    }];
    let mut clips = clips(robot);
    let groups = [
        ClipGroup {
            name: ClipGroup::LIVELY,
            clips: clips.split_off(1),
        },
        ClipGroup {
            name: ClipGroup::PROCEDURAL,
            clips,
        },
    ];
    let run = EmpRun {
        pool: &pool,
        policy: &policy,
        groups: &groups,
        set: MotionSet::Train,
        candidates: &candidates,
        families: &families,
        gates: Some(0),
    };
    report(&run, &mut ()).unwrap()
}

#[test]
fn every_controller_is_compared_on_the_same_episodes() {
    let report = small_report();
    let names: Vec<&str> = report.rows.iter().map(|row| row.name.as_str()).collect();
    assert_eq!(
        names,
        [
            "decoupled",
            "small",
            "amplitude-cut:factor=0.9",
            "amplitude-cut:factor=0.5"
        ]
    );
    let raw = &report.rows[0];
    assert_eq!(raw.conditions.len(), 8);
    assert_eq!((raw.hard.episodes, raw.hard.motions), (6 * 3, 3));
    let by_group = raw.groups.iter().map(|group| group.outcome.episodes);
    assert_eq!(by_group.collect::<Vec<_>>(), [6 * 2, 6]);
    assert_eq!(raw.hard.difference.mjp, Interval::default());
    assert_eq!(raw.hard.metrics.changed_share.mean, 0.0);
    for row in &report.rows[1..] {
        assert!(row.hard.metrics.changed_share.mean > 0.9, "{}", row.name);
        let mjp = row.hard.metrics.mjp.mean - raw.hard.metrics.mjp.mean;
        assert!((row.hard.difference.mjp.mean - mjp).abs() < 1e-9);
    }
    for (row, lost) in report.rows[2..].iter().zip([0.1, 0.5]) {
        assert!(
            (row.hard.metrics.relative_change.mean - lost).abs() < 1e-3,
            "{row:?}"
        );
        assert!((row.hard.metrics.amplitude_loss.mean - lost).abs() < 1e-3);
    }
    let duels: Vec<_> = report
        .duels
        .iter()
        .map(|duel| (&*duel.emp, &*duel.filter))
        .collect();
    assert_eq!(
        duels,
        [
            ("small", "amplitude-cut:factor=0.9"),
            ("small", "amplitude-cut:factor=0.5")
        ]
    );

    let gates: Vec<Option<DangerGate>> = report.gates.iter().map(|row| row.gate).collect();
    assert_eq!((gates.len(), gates[0]), (10, None));
    assert!(gates.contains(&Some(DangerGate::PAPER)));
    let acting = |row: &GateRow| row.nominal.metrics.changed_share.mean;
    assert!(acting(&report.gates[0]) > 0.9);
    // A higher threshold lets the EMP act less.
    for pair in report.gates[3..6]
        .windows(2)
        .chain(report.gates[6..].windows(2))
    {
        assert!(acting(&pair[0]) >= acting(&pair[1]), "{pair:?}");
    }
    assert!(acting(&report.gates[3]) > acting(&report.gates[5]));

    let text = report.to_string();
    for part in [
        "| **small** | ",
        "| decoupled | 0 of 18 | – |",
        "on the train set, seed 7: 2 clips of 2 motions (lively recordings), 1 clips of 1 motions (procedural)",
        "| controller | lively recordings, 12 of 2 | procedural, 6 of 1 |",
        "### Falls by condition",
        "| **small** | amplitude-cut:factor=0.5 |",
        "### Danger gates of small",
        "| **small** | cut |",
        "| regloss 0.04000 | the paper's |",
    ] {
        assert!(text.contains(part), "{part}\n{text}");
    }
    let json = serde_json::to_value(&report).unwrap();
    assert!(json["rows"][1]["hard"]["metrics"]["relative_change"]["high"].is_f64());

    let folder = tempfile::tempdir().unwrap();
    let picture = folder.path().join("frontier.svg");
    draw(&report, &picture).unwrap();
    let svg = std::fs::read_to_string(picture).unwrap();
    for part in [
        "<svg",
        "small",
        "decoupled",
        "cut",
        "loss of MJP",
        "share of falls",
    ] {
        assert!(svg.contains(part), "{part}");
    }
}

#[test]
fn how_long_a_gate_has_been_open_is_counted_anew_after_it_closed() {
    let mut openings = gates::Openings::default();
    let reading = Reading::default();
    let mut see = |episode: usize, applied: &[f32]| {
        for (frame, &applied) in applied.iter().enumerate() {
            let risk = Risk {
                regloss: 0.0,
                danger: applied > 0.0,
                applied,
            };
            let output = ControllerOutput {
                goal: Vec::new(),
                action: Vec::new(),
                leg_targets: Vec::new(),
                risk: Some(risk),
                execution: None,
            };
            openings.executed(&ExecutedFrame {
                episode,
                frame,
                asked: &[],
                output: &output,
                reading: &reading,
            });
        }
    };
    see(1, &[0.0, 0.2, 0.4]);
    see(0, &[0.2, 0.0, 0.2, 0.4, 0.6]);
    see(3, &[1.0, 0.0]);
    assert_eq!(
        [0, 1, 2, 3, 4].map(|episode| openings.frames(episode)),
        [3, 2, 0, 0, 0]
    );
}

#[test]
fn the_usual_filters_can_be_made_and_the_remedies_are_among_them() {
    let policy = policy();
    let families = Family::usual("shoulder_pitch=-1.2");
    for member in families.iter().flat_map(|family| &family.members) {
        Controller::by_name(member, &policy, None).unwrap();
    }
    let remedies = families
        .iter()
        .find(|family| family.name.contains("remedies"));
    let joints = "joints=waist+shoulder_pitch+shoulder_roll";
    let tamed =
        |factor| format!("amplitude-cut:factor={factor},{joints}>velocity-limit:limit=3,{joints}");
    assert_eq!(
        remedies.unwrap().members,
        [
            format!("velocity-limit:limit=1.5,{joints}"),
            tamed("0.8"),
            tamed("0.6"),
            tamed("0.4")
        ]
    );
}
