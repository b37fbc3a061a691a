//! Retargeting as a stream: mirrored, bounded in speed, with and without a network.

#![allow(clippy::unwrap_used, reason = "a helper that fails must fail its test")]

use std::{path::Path, sync::Arc};

use emp_models::retarget::{
    Memory, Mode, RetargetInput, RetargetOutput, Retargeter, Solver, Target, predict_clip,
    retarget_clips,
};
use emp_motion::{Clip, KeyNodeFrame, skills};
use emp_robot::Robot;
use nalgebra::{Rotation3, Vector2, Vector3};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

fn root() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
}

fn robot(name: &str) -> Arc<Robot> {
    Arc::new(Robot::load(&root().join("robots").join(name)).unwrap())
}

/// Both robots, or only ours where the other was not fetched.
fn robots() -> Vec<Arc<Robot>> {
    let mut robots = vec![robot("emp27")];
    if root().join(".robots/g1/g1.xml").exists() {
        robots.push(robot("g1"));
    } else {
        println!("skipped for g1: run `cargo xtask robot g1` first");
    }
    robots
}

fn medley() -> Clip {
    skills::medley(3).resampled(50.0).unwrap()
}

fn shipped(robot: Arc<Robot>) -> Retargeter {
    let weights = root().join(format!(
        "models/weights/{}-retargeter.safetensors",
        robot.name()
    ));
    Retargeter::load(&weights, robot).unwrap()
}

/// The robot's own range of poses, as a person might show them: bones anywhere, hands turned anyhow or unknown.
fn random_target(rng: &mut ChaCha8Rng) -> Target {
    let mut direction = || loop {
        let v = Vector3::from_fn(|_, _| rng.random_range(-1.0..1.0f64));
        if (0.01..1.0).contains(&v.norm_squared()) {
            return v.normalize();
        }
    };
    let bones = [direction(), direction(), direction(), direction()];
    let wrists = [direction(), direction()].map(|axis| Rotation3::new(axis * 0.5).into_inner());
    let yaw = rng.random_range(-0.5..0.5f64);
    let with_hands = rng.random_bool(0.5);
    Target {
        bones,
        shoulder_line: Vector2::new(-yaw.sin(), yaw.cos()),
        wrists: wrists.map(|wrist| with_hands.then_some(wrist)),
    }
}

/// A pose of a person of ordinary size whose arms point this way; the hands are not known.
fn frame_of(target: &Target) -> KeyNodeFrame {
    let line = Vector3::new(target.shoulder_line.x, target.shoulder_line.y, 0.0) * 0.2;
    let up = Vector3::new(0.0, 0.0, 0.5);
    let [left, right] = [up + line, up - line];
    let [left_elbow, right_elbow] = [
        left + target.bones[0] * 0.28,
        right + target.bones[2] * 0.28,
    ];
    let [left_wrist, right_wrist] = [
        left_elbow + target.bones[1] * 0.25,
        right_elbow + target.bones[3] * 0.25,
    ];
    let torso = Vector3::new(0.0, 0.0, 0.3);
    let nodes = [
        Vector3::zeros(),
        torso,
        left,
        right,
        left_elbow,
        right_elbow,
        left_wrist,
        right_wrist,
    ];
    KeyNodeFrame {
        positions: nodes.map(|node| node.cast()),
        wrist_rotations: [None, None],
    }
}

fn begin(retargeter: &Retargeter, frame: KeyNodeFrame) -> RetargetOutput {
    let input = RetargetInput {
        frame,
        mode: Mode::Begin,
    };
    retargeter.retarget(&[input]).unwrap().remove(0)
}

#[test]
fn the_mirrored_pose_gives_the_mirrored_answer() {
    const POSES: usize = 100;
    for robot in robots() {
        let mirror = robot.mirror().unwrap();
        for retargeter in [
            shipped(robot.clone()),
            Retargeter::without_network(robot.clone()),
        ] {
            let mut rng = ChaCha8Rng::seed_from_u64(8);
            let mut alike = 0;
            for _ in 0..POSES {
                let frame = frame_of(&random_target(&mut rng));
                let direct = begin(&retargeter, frame.clone()).angles;
                let through_mirror = begin(&retargeter, frame.mirrored()).angles;
                let mut back = vec![0.0; direct.len()];
                mirror.goal(&through_mirror, &mut back);
                let apart = direct.iter().zip(&back).map(|(a, b)| (a - b).abs());
                alike += usize::from(apart.fold(0.0, f32::max) < 0.02);
            }
            assert_eq!(alike, POSES, "{}", robot.name());
        }
    }
}

#[test]
fn arms_back_above_the_shoulder_are_reached_on_both_sides() {
    let robot = robot("emp27");
    for retargeter in [
        shipped(robot.clone()),
        Retargeter::without_network(robot.clone()),
    ] {
        let back = Vector3::new(-0.95, 0.0, 0.3).normalize();
        let hanging = -Vector3::z();
        let left_back = Target {
            bones: [back, back, hanging, hanging],
            shoulder_line: Vector2::y(),
            wrists: [None, None],
        };
        let mut solver = Solver::new(&robot);
        let errors = [left_back.clone(), left_back.mirrored()].map(|target| {
            let answer = begin(&retargeter, frame_of(&target)).angles;
            let answer: Vec<f64> = answer.into_iter().map(f64::from).collect();
            let errors = solver.bone_errors(&target, &answer);
            errors.into_iter().fold(0.0, f64::max).to_degrees()
        });
        // The shoulder's pitch ends at 86°.
        assert!(errors.iter().all(|error| *error < 25.0), "{errors:?}");
        assert!((errors[0] - errors[1]).abs() < 0.5, "{errors:?}");
    }
}

/// An arm that waves to the side, where two axes of a shoulder line up: the upper arm circles about the side by `radius`
/// while the forearm points up, `rate` times a second.
fn wave(radius: f64, rate: f64, seconds: f64) -> Vec<Target> {
    let frames = (seconds * 50.0) as usize;
    (0..frames)
        .map(|t| {
            let phase = std::f64::consts::TAU * rate * t as f64 / 50.0;
            let (s, c) = (radius * phase.sin(), 0.5 * radius * phase.cos());
            let left = Vector3::new(s, 1.0, c).normalize();
            let right = Vector3::new(s, -1.0, c).normalize();
            let up = Vector3::new(0.3 * phase.sin(), 0.0, 1.0).normalize();
            Target {
                bones: [left, up, right, up],
                shoulder_line: Vector2::y(),
                wrists: [None, None],
            }
        })
        .collect()
}

#[test]
fn a_wave_to_the_side_spins_no_joint() {
    for robot in robots() {
        let mut solver = Solver::new(&robot);
        for (radius, rate) in [(0.05, 1.0), (0.15, 1.0), (0.3, 1.5), (0.6, 2.0)] {
            let targets = wave(radius, rate, 6.0);
            let mut memory = solver.begin(&targets[0], &[]);
            let mut error = 0.0;
            for (i, pair) in targets.windows(2).enumerate() {
                let next = solver.follow(&pair[1], memory.clone(), 0.02);
                let recent = &targets[i.saturating_sub(2)..=i + 1];
                let turns = recent.windows(2).map(|pair| pair[0].arm_turns(&pair[1]));
                let fastest = turns.flatten().fold(0.0, f64::max);
                for (before, after) in memory.answer().iter().zip(next.answer()) {
                    let step = (after - before).abs();
                    assert!(
                        step <= 2.0 * 0.02 + 1.5 * fastest,
                        "{}: radius {radius}, frame {i}: {step}",
                        robot.name()
                    );
                }
                let errors = solver.bone_errors(&pair[1], next.answer());
                error += errors.iter().sum::<f64>() / 4.0;
                memory = next;
            }
            let mean = (error / targets.len() as f64).to_degrees();
            assert!(mean < 5.0, "{}: radius {radius}: {mean}°", robot.name());
        }
    }
}

#[test]
fn a_memory_that_is_not_the_robots_is_refused() {
    let robot = robot("emp27");
    let retargeter = Retargeter::without_network(robot.clone());
    let frame = medley().frames[0].clone();
    let follow = |memory: Memory, seconds: f64| {
        let input = RetargetInput {
            frame: frame.clone(),
            mode: Mode::Follow {
                memory: Box::new(memory),
                seconds,
            },
        };
        retargeter.retarget(&[input])
    };
    let sound = Memory::after(&robot, &[0.0; 15]);
    assert!(follow(sound.clone(), 0.02).is_ok());
    for seconds in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let error = follow(sound.clone(), seconds).unwrap_err().to_string();
        assert!(error.contains("expected more than 0"), "{error}");
    }
    let error = follow(Memory::after(&robot, &[f32::NAN; 15]), 0.02).unwrap_err();
    assert!(error.to_string().contains("no number"), "{error}");
    if let Some(g1) = robots().iter().find(|robot| robot.name() == "g1") {
        // As many joints: what the memory holds is put inside the limits.
        let answer = &follow(Memory::after(g1, &[3.0; 15]), 0.02).unwrap()[0].angles;
        for (angle, joint) in answer.iter().zip(robot.goal_joints()) {
            let range = joint.range[0] - 1e-6..=joint.range[1] + 1e-6;
            assert!(range.contains(&f64::from(*angle)), "{}", joint.name);
        }
    }
}

#[test]
fn a_robot_without_a_network_is_followed_closely() {
    for robot in robots() {
        let retargeter = Retargeter::without_network(robot.clone());
        let rows = retarget_clips(&retargeter, &[medley()], 1).unwrap().remove(0);
        let mut solver = Solver::new(&robot);
        let mut sum = 0.0;
        // Smoothing is a frame behind.
        for (frame, row) in medley().frames.iter().zip(&rows[1..]) {
            let row: Vec<f64> = row.iter().map(|angle| f64::from(*angle)).collect();
            let errors = solver.bone_errors(&Target::new(frame), &row);
            sum += errors.iter().sum::<f64>() / 4.0;
        }
        let mean = (sum / rows.len() as f64).to_degrees();
        assert!(mean < 3.0, "{}: {mean}°", robot.name());
        let live = predict_clip(&retargeter, &medley()).unwrap();
        assert_eq!(live.len(), rows.len());
    }
}
