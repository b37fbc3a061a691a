use std::sync::Arc;

use emp_models::observation::{HISTORY, ObservationLayout};
use emp_robot::Robot;
use nalgebra::{UnitQuaternion, Vector3};
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;

use super::episode::Setting;
use super::rewards::Outcome;
use super::*;
use crate::pushes::Push;
use crate::testing::{emp27, for_each_robot, goal_library};
use crate::{BodyParameters, Divergence, FootReading, Pool, Priority, Reading, Stage};

fn environments(config: EnvironmentConfig, count: u64, threads: usize) -> VecEnvironment {
    let robot = emp27();
    let pool = Arc::new(Pool::new(&robot, threads, Priority::Normal).unwrap());
    let library = Arc::new(goal_library(&robot));
    VecEnvironment::new(robot, pool, config, library, 0..count, 5).unwrap()
}

fn nominal() -> EnvironmentConfig {
    EnvironmentConfig {
        randomization: Randomization::nominal(),
        ..EnvironmentConfig::default()
    }
}

/// Small actions, different for each row and time.
fn actions(environments: &VecEnvironment, t: usize) -> Vec<f32> {
    let legs = environments.layout().last_action().len();
    (0..legs * environments.len())
        .map(|i| 0.3 * ((i * 7 + t * 3) as f32).sin())
        .collect()
}

/// A reading of a robot that stands still in its default pose.
fn still(robot: &Robot) -> Reading {
    let foot = FootReading {
        force: robot.mass() * 9.81 / 2.0,
        ..FootReading::default()
    };
    Reading {
        joint_positions: robot.joints().map(|joint| joint.default as f32).collect(),
        joint_velocities: vec![0.0; 27],
        joint_accelerations: vec![0.0; 27],
        torques: vec![0.0; 27],
        position: Vector3::new(0.0, 0.0, robot.standing_height()),
        feet: [foot.clone(), foot],
        ..Reading::default()
    }
}

/// The weighted terms by name.
fn terms(robot: &Robot, reading: &Reading, actions: [&[f32]; 3]) -> impl Fn(&str) -> f64 + use<> {
    let legs: Vec<f32> = robot
        .leg_joints()
        .iter()
        .map(|joint| joint.default as f32)
        .collect();
    let terms = RewardWeights::default().terms(&Outcome {
        reading,
        standing_height: robot.standing_height(),
        leg_default: &legs,
        action_scale: robot.action_scale(),
        actions,
        fell: false,
    });
    move |name| terms[REWARD_NAMES.iter().position(|&n| n == name).unwrap()]
}

#[test]
fn standing_still_earns_every_reward_and_no_penalty() {
    for_each_robot(|robot| {
        let zero = [0.0; 12];
        let term = terms(robot, &still(robot), [&zero, &zero, &zero]);
        for (name, value) in [
            ("base_orientation", 3.0),
            ("projected_gravity", 3.0),
            ("base_height", 0.2),
            ("base_linear_velocity", 0.75),
            ("base_angular_velocity", 0.75),
            ("base_acceleration", 0.2),
            ("leg_position", 1.0),
            ("feet_contact", 0.5),
            ("feet_slip", 0.0),
            ("action_range", 0.0),
            ("action_rate", 0.0),
            ("action_acceleration", 0.0),
            ("torques", 0.0),
            ("joint_velocity", 0.0),
            ("joint_acceleration", 0.0),
        ] {
            assert!((term(name) - value).abs() < 1e-12, "{name}: {}", term(name));
        }
    });
}

#[test]
fn reward_terms_are_the_papers() {
    for_each_robot(|robot| {
        let mut reading = still(robot);
        reading.orientation = UnitQuaternion::from_euler_angles(0.02, -0.03, 1.0);
        reading.position.z += 0.004;
        reading.linear_velocity = Vector3::new(0.1, 0.2, -0.2);
        reading.angular_velocity = Vector3::new(0.03, 0.0, -0.04);
        reading.velocity_change = Vector3::new(0.0, 0.1, 0.0);
        let goals = robot.goal_joints().len();
        // Only leg joints count.
        reading.joint_positions[0] += 1.0;
        reading.joint_positions[goals] += 0.003;
        reading.joint_positions[goals + 5] -= 0.004;
        for values in [
            &mut reading.torques,
            &mut reading.joint_velocities,
            &mut reading.joint_accelerations,
        ] {
            values[0] = 1000.0;
        }
        (reading.torques[goals], reading.torques[goals + 1]) = (30.0, -40.0);
        reading.joint_velocities[goals + 2] = 3.0;
        reading.joint_accelerations[goals + 3] = -100.0;
        reading.feet[0].velocity = Vector3::new(0.04, 0.0, 0.0);
        reading.feet[1].velocity = Vector3::new(0.0, 9.0, 0.0);
        reading.feet[1].force = 4.9;
        let mut actions = [[0.0_f32; 12]; 3];
        (actions[0][0], actions[0][1]) = (2.0, -1.0);
        (actions[1][0], actions[1][2]) = (1.0, 1.0);
        actions[2][0] = 3.0;
        let term = terms(robot, &reading, [&actions[0], &actions[1], &actions[2]]);
        let scale = robot.action_scale();
        let (sin, cos) = (f64::sin, f64::cos);
        // World −z in the base's frame: (sin pitch, −sin roll cos pitch).
        let gravity = (sin(-0.03).powi(2) + (sin(0.02) * cos(-0.03)).powi(2)).sqrt();
        for (name, value) in [
            ("base_orientation", 3.0 * (-10.0_f64 * 0.05).exp()),
            ("projected_gravity", 3.0 * (-20.0 * gravity).exp()),
            ("base_height", 0.2 * (-0.4_f64).exp()),
            ("base_linear_velocity", 0.75 * (-0.9_f64).exp()),
            ("base_angular_velocity", 0.75 * (-1.0_f64).exp()),
            ("base_acceleration", 0.2 * (-0.3_f64).exp()),
            ("leg_position", (-0.5_f64).exp()),
            ("feet_contact", 0.25),
            ("feet_slip", -0.2 * 0.2),
            ("action_range", -0.075 * scale * 3.0),
            ("action_rate", -1.5 * scale * scale * (1.0 + 1.0 + 1.0)),
            (
                "action_acceleration",
                -1.5 * scale * scale * (9.0 + 1.0 + 4.0),
            ),
            ("torques", -1e-5 * 2500.0),
            ("joint_velocity", -1e-4 * 9.0),
            ("joint_acceleration", -1e-7 * 1e4),
        ] {
            let found = term(name);
            assert!(
                (found - value).abs() < 2e-5 * value.abs(),
                "{name}: {found}, {value}"
            );
        }
    });
}

#[test]
fn a_reward_is_the_sum_of_its_terms_times_the_control_period() {
    let mut environments = environments(EnvironmentConfig::default(), 4, 2);
    for t in 0..5 {
        let actions = actions(&environments, t);
        let step = environments.step(&actions);
        for (reward, terms) in step.rewards.iter().zip(step.terms.chunks(REWARD_TERMS)) {
            let sum: f64 = terms.iter().sum();
            assert!(sum > 0.1);
            assert!((f64::from(*reward) - 0.02 * sum).abs() < 1e-6);
        }
    }
}

#[test]
fn an_episode_ends_by_tilt_height_or_divergence() {
    for_each_robot(|robot| {
        let library = Arc::new(goal_library(robot));
        let robot = Arc::new(Robot::load(&crate::testing::folder(robot.name())).unwrap());
        let setting = Setting::new(robot.clone(), EnvironmentConfig::default(), library);
        let end = |roll: f64, pitch: f64, height: f64| {
            let mut reading = still(&robot);
            reading.orientation = UnitQuaternion::from_euler_angles(roll, pitch, 2.0);
            reading.position.z = height * robot.standing_height();
            setting.fall(&reading)
        };
        let limit = 0.7_f64.asin();
        assert_eq!(end(0.0, 0.0, 1.0), None);
        assert_eq!(end(0.0, limit - 0.01, 1.0), None);
        assert_eq!(end(0.0, limit + 0.01, 1.0), Some(EndReason::Tilted));
        assert_eq!(end(-limit - 0.01, 0.0, 1.0), Some(EndReason::Tilted));
        assert_eq!(end(limit - 0.01, 0.0, 1.0), None);
        assert_eq!(end(0.0, 3.0, 1.0), None, "pg_x is small again upside down");
        assert_eq!(end(0.0, 0.0, 0.34), None);
        assert_eq!(end(0.0, 0.0, 0.33), Some(EndReason::Sank));
        let mut reading = still(&robot);
        reading.divergence = Some(Divergence::Velocity);
        let diverged = EndReason::Diverged(Divergence::Velocity);
        assert_eq!(setting.fall(&reading), Some(diverged));
    });
}

/// Parameters of many episodes.
fn draws(robot: &Robot, randomization: &Randomization) -> Vec<BodyParameters> {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    (0..400)
        .map(|_| randomization.draw(robot, 30, &mut rng))
        .collect()
}

#[test]
fn every_row_is_drawn_from_its_range_and_can_be_switched_off() {
    for_each_robot(|robot| {
        type Row = (
            &'static str,
            fn(&mut Randomization),
            fn(&BodyParameters) -> Vec<f64>,
            [f64; 2],
            f64,
        );
        let masses = robot.added_masses();
        let rows: [Row; 11] = [
            (
                "friction",
                |r| r.friction = None,
                |b| vec![b.friction],
                [0.1, 2.0],
                1.0,
            ),
            (
                "base_mass",
                |r| r.base_mass = MassRange::Off,
                |b| vec![b.base_mass],
                masses.base,
                0.0,
            ),
            (
                "hand_mass",
                |r| r.hand_mass = MassRange::Off,
                |b| b.hand_mass.to_vec(),
                masses.hand,
                0.0,
            ),
            (
                "base_com",
                |r| r.base_com = None,
                |b| b.base_com.to_vec(),
                [-0.05, 0.05],
                0.0,
            ),
            (
                "link_inertia",
                |r| r.link_inertia = None,
                |b| b.link_inertia.clone(),
                [0.8, 1.2],
                1.0,
            ),
            (
                "link_mass",
                |r| r.link_mass = None,
                |b| b.link_mass.clone(),
                [0.8, 1.2],
                1.0,
            ),
            (
                "p_gain",
                |r| r.p_gain = None,
                |b| b.p_gain.clone(),
                [0.8, 1.2],
                1.0,
            ),
            (
                "d_gain",
                |r| r.d_gain = None,
                |b| b.d_gain.clone(),
                [0.8, 1.2],
                1.0,
            ),
            (
                "motor_torque",
                |r| r.motor_torque = None,
                |b| b.motor_torque.clone(),
                [0.8, 1.2],
                1.0,
            ),
            (
                "motor_damping",
                |r| r.motor_damping = None,
                |b| b.motor_damping.clone(),
                [0.3, 4.0],
                1.0,
            ),
            (
                "motor_delay",
                |r| r.motor_delay = None,
                |b| vec![b.motor_delay],
                [0.0, 0.01],
                0.0,
            ),
        ];
        let on = draws(robot, &Randomization::default());
        for (name, switch_off, values, [low, high], nominal) in rows {
            let mut numbers: Vec<f64> = on.iter().flat_map(values).collect();
            numbers.sort_by(f64::total_cmp);
            let (least, most) = (numbers[0], numbers[numbers.len() - 1]);
            let slack = 0.03 * (high - low);
            assert!(low <= least && least < low + slack, "{name}: {least}");
            assert!(most <= high && high - slack < most, "{name}: {most}");
            let mut randomization = Randomization::default();
            switch_off(&mut randomization);
            let off = draws(robot, &randomization);
            assert!(off.iter().flat_map(values).all(|x| x == nominal), "{name}");
            // The other rows are drawn as before.
            let all = |b: &BodyParameters| rows.iter().map(|row| (row.2)(b)).collect::<Vec<_>>();
            let position = rows.iter().position(|row| row.0 == name).unwrap();
            for (a, b) in on.iter().map(all).zip(off.iter().map(all)) {
                let same = a.iter().zip(&b).enumerate();
                assert!(
                    same.into_iter().all(|(i, (a, b))| i == position || a == b),
                    "{name}"
                );
            }
        }
        let nominal = draws(robot, &Randomization::nominal());
        let plain = BodyParameters {
            link_inertia: vec![1.0; 30],
            link_mass: vec![1.0; 30],
            p_gain: vec![1.0; 27],
            d_gain: vec![1.0; 27],
            motor_torque: vec![1.0; 27],
            motor_damping: vec![1.0; 27],
            ..BodyParameters::default()
        };
        assert!(nominal.iter().all(|parameters| *parameters == plain));
    });
}

#[test]
fn the_scale_shrinks_every_range_about_its_nominal_value() {
    let robot = emp27();
    let full = Randomization::default();
    let half = full.scaled(&robot, 0.5);
    assert_eq!(half.friction, Some([0.55, 1.5]));
    assert_eq!(half.base_mass, MassRange::Kilograms([-2.5, 2.5]));
    assert_eq!(half.hand_mass, MassRange::Kilograms([0.0, 1.25]));
    assert_eq!(half.base_com, Some([-0.025, 0.025]));
    assert_eq!(half.p_gain, Some([0.9, 1.1]));
    assert_eq!(half.motor_damping, Some([0.65, 2.5]));
    assert_eq!(half.motor_delay, Some([0.0, 0.005]));
    assert_eq!(half.initial_joints, Some([-0.05, 0.05]));
    assert_eq!(half.action, Some([0.99, 1.01]));
    let push = half.push.unwrap();
    assert_eq!((push.interval, push.linear, push.angular), (5.0, 0.25, 0.2));
    let hang = half.hang.unwrap();
    assert_eq!((hang.height, hang.ratio), (0.1, 0.1));
    let none = draws(&robot, &full.scaled(&robot, 0.0));
    assert!(none == draws(&robot, &Randomization::nominal()));
}

#[test]
fn settings_that_are_left_out_are_the_papers_and_bad_ones_are_refused_by_name() {
    let read = serde_json::from_str::<EnvironmentConfig>;
    assert_eq!(read("{}").unwrap(), EnvironmentConfig::default());
    let text = r#"{"randomization": {"friction": null, "hand_mass": {"kilograms": [1, 3]},
        "base_mass": "off", "push": null}, "rewards": {"torques": 0}, "episode_frames": 100}"#;
    let config = read(text).unwrap();
    assert_eq!(config.randomization.friction, None);
    assert_eq!(
        config.randomization.hand_mass,
        MassRange::Kilograms([1.0, 3.0])
    );
    assert_eq!(config.randomization.base_com, Some([-0.05, 0.05]));
    assert_eq!(config.rewards.torques, 0.0);
    assert!(read(r#"{"reward": {}}"#).is_err());
    let robot = emp27();
    config.check(&robot).unwrap();
    for (text, name) in [
        (r#"{"episode_frames": 0}"#, "episode_frames"),
        (r#"{"tilt_limit": 2}"#, "tilt_limit"),
        (
            r#"{"randomization": {"friction": [2, 1]}}"#,
            "randomization.friction",
        ),
        (
            r#"{"randomization": {"motor_delay": [0, 0.03]}}"#,
            "randomization.motor_delay",
        ),
        (
            r#"{"randomization": {"hand_mass": {"kilograms": [-1, 0]}}}"#,
            "randomization.hand_mass",
        ),
        (
            r#"{"randomization": {"push": {"interval": 0, "linear": 1, "angular": 1}}}"#,
            "randomization.push.interval",
        ),
        (
            r#"{"randomization": {"hang": {"height": 1, "ratio": 2}}}"#,
            "randomization.hang.ratio",
        ),
    ] {
        let error = read(text).unwrap().check(&robot).unwrap_err().to_string();
        assert!(error.starts_with(&format!("{name}: expected")), "{error}");
    }
}

/// Bits of all that a step tells.
fn step_bits(environments: &mut VecEnvironment, actions: &[f32]) -> Vec<u32> {
    let step = environments.step(actions);
    let mut bits: Vec<u32> = step.rewards.iter().map(|x| x.to_bits()).collect();
    bits.extend(step.ends.iter().map(|end| u32::from(end.is_some())));
    bits.extend(step.lengths);
    let seen = environments.observations().iter();
    bits.extend(seen.chain(environments.privileged()).map(|x| x.to_bits()));
    bits
}

#[test]
fn the_number_of_threads_and_the_split_into_ranges_change_no_bit() {
    let config = EnvironmentConfig {
        episode_frames: 20,
        ..EnvironmentConfig::default()
    };
    let run = |threads: usize| {
        let mut environments = environments(config, 7, threads);
        (0..40)
            .map(|t| {
                let actions = actions(&environments, t);
                step_bits(&mut environments, &actions)
            })
            .collect::<Vec<_>>()
    };
    let one = run(1);
    assert!(one == run(2) && one == run(3));

    let robot = emp27();
    let pool = Arc::new(Pool::new(&robot, 2, Priority::Low).unwrap());
    let library = Arc::new(goal_library(&robot));
    let mut part = VecEnvironment::new(robot, pool, config, library, 4..7, 5).unwrap();
    let mut whole = environments(config, 7, 1);
    for t in 0..40 {
        let actions = actions(&whole, t);
        whole.step(&actions);
        part.step(&actions[4 * 12..]);
    }
    let width = whole.layout().width();
    assert_eq!(whole.observations()[4 * width..], *part.observations());
}

#[test]
fn a_snapshot_goes_on_bit_for_bit() {
    let config = EnvironmentConfig {
        episode_frames: 30,
        ..EnvironmentConfig::default()
    };
    let mut original = environments(config, 5, 2);
    original.set_curriculum(0.7, 0.9);
    for t in 0..17 {
        let actions = actions(&original, t);
        original.step(&actions);
    }
    let snapshot = original.snapshot().unwrap();
    let mut restored = environments(config, 5, 1);
    restored.set_curriculum(0.7, 0.9);
    restored.restore(&snapshot).unwrap();
    assert_eq!(restored.observations(), original.observations());
    assert_eq!(restored.privileged(), original.privileged());
    for t in 17..60 {
        let actions = actions(&original, t);
        let bits = step_bits(&mut original, &actions);
        assert!(bits == step_bits(&mut restored, &actions), "{t}");
    }
    let mut other = environments(config, 4, 1);
    let error = other.restore(&snapshot).unwrap_err().to_string();
    assert!(
        error.contains("expected 4 environments, found 5"),
        "{error}"
    );
    assert!(restored.restore(&snapshot[..1000]).is_err());
}

#[test]
fn a_divergence_ends_its_own_episode_and_no_neighbour_notices() {
    let mut sick = environments(EnvironmentConfig::default(), 6, 2);
    let mut healthy = environments(EnvironmentConfig::default(), 6, 2);
    let width = sick.layout().width();
    for t in 0..5 {
        let good = actions(&sick, t);
        let mut bad = good.clone();
        if t == 2 {
            bad[3 * 12 + 4] = f32::NAN;
        }
        let ends = healthy.step(&good).ends.to_vec();
        let step = sick.step(&bad);
        for (n, &end) in ends.iter().enumerate() {
            let expected = match (t, n) {
                (2, 3) => Some(EndReason::Diverged(Divergence::Control)),
                _ => end,
            };
            if (t, n) == (2, 3) {
                assert_eq!(step.rewards[n], 0.0);
                assert_eq!(
                    step.terms[3 * REWARD_TERMS..4 * REWARD_TERMS],
                    [0.0; REWARD_TERMS]
                );
            }
            if t <= 2 || n != 3 {
                assert_eq!(step.ends[n], expected);
            }
        }
        assert!(sick.observations().iter().all(|x| x.is_finite()));
        assert!(sick.privileged().iter().all(|x| x.is_finite()));
        for n in (0..6).filter(|&n| n != 3) {
            let row = n * width..(n + 1) * width;
            assert_eq!(
                sick.observations()[row.clone()],
                healthy.observations()[row]
            );
        }
    }
}

#[test]
fn an_episode_starts_with_copies_of_its_first_frame() {
    let config = EnvironmentConfig {
        episode_frames: 10,
        ..EnvironmentConfig::default()
    };
    let mut environments = environments(config, 8, 2);
    let layout: ObservationLayout = *environments.layout();
    let (mut firsts, mut goes_on) = (0, 0);
    for t in 0..25 {
        let before = environments.observations().to_vec();
        let actions = actions(&environments, t);
        let ends = environments.step(&actions).ends.to_vec();
        let rows = environments.observations().chunks(layout.width());
        for (n, (row, before)) in rows.zip(before.chunks(layout.width())).enumerate() {
            let newest = &row[layout.newest()];
            let action = &newest[layout.last_action()];
            if ends[n].is_some() {
                firsts += 1;
                assert!(
                    row.chunks(layout.frame_width())
                        .all(|frame| frame == newest)
                );
                assert_eq!(action, [0.0; 12]);
                assert_eq!(newest[layout.orientation()], [0.0; 3]);
            } else {
                goes_on += 1;
                let kept = (HISTORY - 1) * layout.frame_width();
                assert_eq!(row[..kept], before[layout.frame_width()..]);
                assert_eq!(action, &actions[n * 12..(n + 1) * 12]);
            }
        }
    }
    assert!(firsts >= 16 && goes_on > 100, "{firsts} {goes_on}");
}

#[test]
fn time_outs_are_spread_and_tell_the_state_at_the_end() {
    let config = EnvironmentConfig {
        episode_frames: 20,
        ..nominal()
    };
    let mut environments = environments(config, 40, 2);
    let layout = environments.privileged_layout().clone();
    let mut by_time = [0; 20];
    for t in 0..40 {
        let actions = vec![0.0; 40 * 12];
        let step = environments.step(&actions);
        for n in 0..40 {
            let Some(end) = step.ends[n] else { continue };
            assert_eq!(end, EndReason::TimedOut);
            by_time[t % 20] += 1;
            if t >= 20 {
                assert_eq!(step.lengths[n], 20);
            }
            // The robot has stood for a while: its feet carry it, its history is no longer that of the start.
            let last = &step.final_privileged[n * layout.width()..(n + 1) * layout.width()];
            if step.lengths[n] > 10 {
                let carried: f32 = last[layout.foot_forces.clone()].iter().sum();
                assert!((carried - 2.0).abs() < 0.7, "{carried}");
            }
        }
    }
    assert_eq!(by_time.iter().sum::<i32>(), 80);
    assert!(by_time.iter().all(|&count| count <= 20), "{by_time:?}");
}

#[test]
fn the_critic_sees_what_the_layout_says() {
    let config = EnvironmentConfig {
        randomization: Randomization {
            friction: Some([0.5, 0.5]),
            hand_mass: MassRange::Kilograms([1.5, 1.5]),
            motor_delay: Some([0.004, 0.004]),
            motor_damping: Some([2.0, 2.0]),
            d_gain: Some([1.2, 1.2]),
            ..Randomization::nominal()
        },
        ..EnvironmentConfig::default()
    };
    let mut environments = environments(config, 3, 1);
    let layout = environments.privileged_layout().clone();
    let observation = *environments.layout();
    let first_actions = actions(&environments, 0);
    let mut goals = Vec::new();
    let mut seen = Vec::new();
    for t in 0..8 {
        let actions = actions(&environments, t);
        goals.push(environments.observations()[observation.newest_goal()].to_vec());
        seen.push(environments.privileged()[..layout.width()].to_vec());
        let newest = &environments.observations()[observation.newest()];
        let privileged = &environments.privileged()[..layout.width()];
        assert_eq!(privileged[layout.frame.clone()], *newest);
        let close = |range: &std::ops::Range<usize>, expected: &[f32]| {
            let found = &privileged[range.clone()];
            assert_eq!(found.len(), expected.len());
            let near = found
                .iter()
                .zip(expected)
                .all(|(a, b)| (a - b).abs() < 1e-4);
            assert!(near, "{found:?} {expected:?}");
        };
        close(&layout.friction, &[-0.5]);
        close(&layout.added_masses, &[0.0, 0.5, 0.5, 1.0]);
        close(&layout.base_com, &[0.0; 3]);
        close(&layout.motor_delay, &[0.4]);
        close(&layout.p_gain, &[0.0; 12]);
        close(&layout.d_gain, &[1.0; 12]);
        close(&layout.motor_damping, &[1.0; 12]);
        let [x, y, z] = privileged[layout.gravity.clone()] else {
            panic!()
        };
        assert!((x * x + y * y + z * z - 1.0).abs() < 1e-5 && z < -0.9);
        assert!(privileged[layout.height.start].abs() < 0.5);
        if t == 2 {
            let before = vec![0.0; 12];
            let first = first_actions[..12].to_vec();
            assert_eq!(seen[1][layout.action_before.clone()], before);
            assert_eq!(privileged[layout.action_before.clone()], first);
        }
        let ended = environments.step(&actions).ends[0];
        assert_eq!(ended, None);
    }
    for t in 0..3 {
        for (range, ahead, scale) in [(&layout.goal_next, 1, 10.0), (&layout.goal_later, 5, 3.0)] {
            for (i, &found) in seen[t][range.clone()].iter().enumerate() {
                let expected = scale * (goals[t + ahead][i] - goals[t][i]);
                assert!((found - expected).abs() < 1e-5, "{found} {expected}");
            }
        }
    }
    assert_eq!(layout.width(), seen[0].len());
}

/// Velocity of the base in its heading frame, by environment.
fn velocities(environments: &VecEnvironment) -> Vec<Vector3<f32>> {
    let layout = environments.privileged_layout();
    environments
        .privileged()
        .chunks(layout.width())
        .map(|row| Vector3::from_column_slice(&row[layout.linear_velocity.clone()]))
        .collect()
}

#[test]
fn pushes_come_at_their_interval_at_any_phase() {
    let config = EnvironmentConfig {
        randomization: Randomization {
            push: Some(Push {
                ratio: 1.0,
                interval: 0.2,
                linear: 3.0,
                angular: 0.0,
            }),
            ..Randomization::nominal()
        },
        // Pushed like this no robot stands for long.
        tilt_limit: 1.0,
        height_limit: 0.0,
        ..EnvironmentConfig::default()
    };
    let mut environments = environments(config, 30, 2);
    let mut first = [None; 30];
    for t in 0..10 {
        let before = velocities(&environments);
        environments.step(&vec![0.0; 30 * 12]);
        for (n, (now, before)) in velocities(&environments).iter().zip(&before).enumerate() {
            if (now - before).xy().norm() > 0.7 && first[n].is_none() {
                first[n] = Some(t);
            }
        }
    }
    let phases: std::collections::BTreeSet<_> = first.iter().flatten().collect();
    assert!(first.iter().flatten().count() > 20, "{first:?}");
    assert!(phases.len() > 6, "{phases:?}");
}

#[test]
fn some_episodes_start_above_the_floor() {
    let share = |ratio: f64| {
        let hang = Some(Hang { height: 0.1, ratio });
        let config = EnvironmentConfig {
            randomization: Randomization {
                hang,
                ..Randomization::nominal()
            },
            ..EnvironmentConfig::default()
        };
        let environments = environments(config, 200, 2);
        let layout = environments.privileged_layout();
        let rows = environments.privileged().chunks(layout.width());
        let hanging = rows.filter(|row| {
            let hangs = (row[layout.height.start] - 1.0).abs() < 1e-3;
            assert!(hangs || row[layout.height.start].abs() < 1e-3);
            assert!(!hangs || row[layout.foot_forces.clone()] == [0.0; 2]);
            hangs
        });
        hanging.count() as f64 / 200.0
    };
    assert_eq!((share(0.0), share(1.0)), (0.0, 1.0));
    assert!((share(0.2) - 0.2).abs() < 0.08);
}

#[test]
fn joints_start_at_the_first_goal_and_the_default_pose_but_for_their_noise() {
    let offsets = |range: Option<[f64; 2]>| -> Vec<f32> {
        let config = EnvironmentConfig {
            randomization: Randomization {
                initial_joints: range,
                ..Randomization::nominal()
            },
            ..EnvironmentConfig::default()
        };
        let environments = environments(config, 50, 2);
        let layout = *environments.layout();
        let robot = environments.robot().clone();
        let rows = environments.observations().chunks(layout.width());
        rows.flat_map(|row| {
            let frame = &row[layout.newest()];
            let goal = frame[layout.goal()].iter().copied();
            let legs = robot.leg_joints().iter().map(|joint| joint.default as f32);
            let start = goal.chain(legs).collect::<Vec<_>>();
            let joints = frame[layout.joint_positions()].iter().zip(start);
            joints.map(|(q, start)| q - start).collect::<Vec<_>>()
        })
        .collect()
    };
    assert!(offsets(None).iter().all(|offset| offset.abs() < 1e-6));
    let noisy = offsets(Some([-0.1, 0.1]));
    let most = noisy.iter().copied().fold(0.0_f32, |a, b| a.max(b.abs()));
    assert!((0.095..0.100001).contains(&most), "{most}");
}

#[test]
fn action_noise_scales_the_offset_from_the_default_pose() {
    let with = |factor: Option<[f64; 2]>| EnvironmentConfig {
        randomization: Randomization {
            action: factor,
            ..Randomization::nominal()
        },
        ..EnvironmentConfig::default()
    };
    let mut noisy = environments(with(Some([2.0, 2.0])), 2, 1);
    let mut plain = environments(with(None), 2, 1);
    let layout = *plain.layout();
    for t in 0..4 {
        let actions = actions(&plain, t);
        let twice: Vec<f32> = actions.iter().map(|action| 2.0 * action).collect();
        noisy.step(&actions);
        plain.step(&twice);
        let [a, b] = [&noisy, &plain].map(|environments| {
            environments.observations()[layout.newest()][layout.joint_positions()].to_vec()
        });
        assert_eq!(a, b);
    }
}

#[test]
fn a_robot_that_falls_pays_for_it_once_and_any_foot_will_do() {
    for_each_robot(|robot| {
        let mut reading = still(robot);
        reading.feet[1].force = 0.0;
        let zero = [0.0_f32; 12];
        let legs: Vec<f32> = robot
            .leg_joints()
            .iter()
            .map(|joint| joint.default as f32)
            .collect();
        let terms = |rewards: RewardWeights, fell: bool| {
            rewards.terms(&Outcome {
                reading: &reading,
                standing_height: robot.standing_height(),
                leg_default: &legs,
                action_scale: robot.action_scale(),
                actions: [&zero, &zero, &zero],
                fell,
            })
        };
        let place = |name: &str| REWARD_NAMES.iter().position(|&n| n == name).unwrap();
        let (paper, robust) = (RewardWeights::default(), RewardWeights::robust());
        assert_eq!(terms(paper, true)[place("fall")], 0.0);
        assert_eq!(terms(paper, false)[place("feet_contact")], 0.25);
        assert_eq!(terms(robust, false)[place("feet_contact")], 0.0);
        assert_eq!(terms(robust, false)[place("any_foot_contact")], 0.5);
        assert_eq!(terms(robust, false)[place("fall")], 0.0);
        assert_eq!(terms(robust, true)[place("fall")], -250.0);
    });
}

#[test]
fn the_mirrored_robot_has_the_mirrored_privileged_observation() {
    for_each_robot(|robot| {
        let robot = Arc::new(
            Robot::load(
                &std::path::Path::new(env!("CARGO_MANIFEST_DIR"))
                    .join("../robots")
                    .join(robot.name()),
            )
            .unwrap(),
        );
        let observation = ObservationLayout::new(&robot, HISTORY);
        let kind = Kind::new(Arc::clone(&robot), observation);
        let mirror = kind.privileged.mirror(&robot, &observation).unwrap();
        let joints = robot.mirror().unwrap();
        let numbers = |count: usize, shift: usize| -> Vec<f32> {
            let number = |i: usize| (((i + shift) * 7) as f32 * 0.37).sin();
            (0..count).map(number).collect()
        };
        let observed = |mirrored: bool| {
            let mut stage = Stage::new(&robot).unwrap();
            let mut rng = ChaCha8Rng::seed_from_u64(1);
            let mut subject = Subject::new(&kind, &mut stage);
            let mut parameters = BodyParameters {
                hand_mass: [0.5, 1.5],
                base_mass: 2.0,
                base_com: [0.01, 0.02, -0.01],
                p_gain: numbers(27, 3)
                    .iter()
                    .map(|x| 1.0 + 0.1 * f64::from(*x))
                    .collect(),
                ..BodyParameters::default()
            };
            if mirrored {
                parameters.hand_mass.swap(0, 1);
                parameters.base_com[1] *= -1.0;
                let gains = parameters.p_gain.clone();
                for (gain, &joint) in parameters.p_gain.iter_mut().zip(joints.permutation()) {
                    *gain = gains[joint];
                }
            }
            let seen = |values: &[f32], map: &dyn Fn(&[f32], &mut [f32])| {
                let mut image = values.to_vec();
                if mirrored {
                    map(values, &mut image);
                }
                image
            };
            let goal_at = |t: usize| {
                let rest = robot.goal_joints().iter().zip(numbers(15, t));
                let goal: Vec<f32> = rest
                    .map(|(joint, x)| joint.default as f32 + 0.2 * x)
                    .collect();
                seen(&goal, &|from, to| joints.goal(from, to))
            };
            subject.goal = goal_at(0);
            let setup = EpisodeSetup {
                parameters,
                ranges: &Randomization::nominal(),
                pushes: None,
            };
            subject.place(&kind, &mut stage, setup, &mut rng);
            subject.observe();
            for t in 0..8 {
                let action = numbers(12, t).iter().map(|x| 0.3 * x).collect::<Vec<f32>>();
                let action = seen(&action, &|from, to| joints.legs(from, to));
                subject.execute(&kind, &mut stage, &action, &mut rng);
                subject.remember(&action);
                subject.goal = goal_at(t + 1);
                subject.look_ahead(|ahead, goal| goal.copy_from_slice(&goal_at(t + 1 + ahead)));
                subject.observe();
            }
            let mut privileged = vec![0.0; kind.privileged.width()];
            subject.write_privileged(&kind, &mut privileged);
            privileged
        };
        let (seen, image) = (observed(false), observed(true));
        assert_eq!(mirror.rows(&mirror.rows(&seen)), seen);
        for (i, (a, b)) in mirror.rows(&seen).iter().zip(&image).enumerate() {
            // The solver's steps are not symmetric to the last bit.
            assert!(
                (a - b).abs() < 2e-2 * (1.0 + a.abs()),
                "{}: {i}: {a} {b}",
                robot.name()
            );
        }
        assert!(
            seen.iter()
                .zip(&image)
                .filter(|(a, b)| (*a - *b).abs() > 0.05)
                .count()
                > 20
        );
    });
}

#[test]
fn the_robust_preset_can_be_run_and_its_sensors_are_not_the_truth() {
    let robot = emp27();
    let config = EnvironmentConfig::robust(&robot);
    config.check(&robot).unwrap();
    let json = serde_json::to_string(&config).unwrap();
    assert_eq!(
        serde_json::from_str::<EnvironmentConfig>(&json).unwrap(),
        config
    );
    let mut environments = environments(config, 6, 2);
    let (layout, privileged) = (
        *environments.layout(),
        environments.privileged_layout().clone(),
    );
    assert!(layout.heading_periods() > 0);
    let mut noisy = 0;
    for t in 0..100 {
        let actions = actions(&environments, t);
        environments.step(&actions);
        let stacks = environments.observations().chunks_exact(layout.width());
        let truths = environments.privileged().chunks_exact(privileged.width());
        for (stack, truth) in stacks.zip(truths) {
            // Roll is in the frame, what it does to gravity is known to the critic alone.
            let roll = stack[layout.newest()][layout.orientation()][0];
            let gravity = &truth[privileged.gravity.clone()];
            let off = (roll - (-gravity[1]).atan2(-gravity[2])).abs();
            assert!(off < 0.021, "{off}");
            noisy += u32::from(off > 1e-4);
        }
    }
    assert!(noisy > 500, "{noisy}");
}
