use std::sync::Arc;

use emp_robot::Robot;
use nalgebra::Vector3;

use super::apply::apply;
use super::*;
use crate::testing::{for_each_robot, pose};
use crate::{Divergence, Pool, Priority};
use rayon::prelude::*;

/// Angles of all joints in the default pose.
fn rest(robot: &Robot) -> Vec<f64> {
    robot.joints().map(|joint| joint.default).collect()
}

fn legs(robot: &Robot) -> Vec<f32> {
    robot
        .leg_joints()
        .iter()
        .map(|joint| joint.default as f32)
        .collect()
}

/// Every parameter off its nominal value, differently for each `seed`.
fn odd(robot: &Robot, seed: usize) -> BodyParameters {
    let factors = |count: usize, of: usize| -> Vec<f64> {
        let factor = |i: usize| 0.8 + 0.4 * (((i * 7 + of * 3 + seed * 5) % 11) as f64 / 10.0);
        (0..count).map(factor).collect()
    };
    let (bodies, joints) = (robot.model().body_mass().len(), robot.joints().count());
    let step = seed as f64;
    BodyParameters {
        friction: 0.5 + 0.1 * step,
        base_mass: 1.0 - 0.2 * step,
        hand_mass: [0.3 + 0.1 * step, 0.2],
        base_com: [0.02, -0.01 * step, 0.03],
        link_mass: factors(bodies, 0),
        link_inertia: factors(bodies, 1),
        p_gain: factors(joints, 2),
        d_gain: factors(joints, 3),
        motor_torque: factors(joints, 4),
        motor_damping: factors(joints, 5),
        motor_delay: 0.001 * step,
        physics: Physics::Exact,
    }
}

fn place(robot: &Robot, stage: &mut Stage, parameters: BodyParameters) -> Body {
    stage.place(&Start {
        joint_positions: &rest(robot),
        lift: 0.0,
        parameters,
    })
}

/// Goal targets of control period `t`, different for each `seed`.
fn goal(robot: &Robot, seed: usize, t: usize) -> Vec<f32> {
    let elbow = (0.02 * t as f32 * (1.0 + seed as f32)).sin();
    pose(
        robot,
        &[
            ("shoulder_pitch", 0.3 * elbow),
            ("elbow", -0.6 - 0.2 * elbow),
        ],
    )
}

fn step(robot: &Robot, stage: &mut Stage, body: &mut Body, seed: usize, t: usize) {
    let targets = Targets {
        goal: &goal(robot, seed, t),
        legs: &legs(robot),
    };
    stage.step(body, &targets);
}

/// The bits of a body's state.
fn bits(body: &Body) -> Vec<u64> {
    let numbers = body.qpos.iter().chain(&body.qvel).chain(&body.warm_start);
    numbers.map(|number| number.to_bits()).collect()
}

#[test]
fn a_body_at_rest_stands_on_both_feet() {
    for_each_robot(|robot| {
        let mut stage = Stage::new(robot).unwrap();
        let mut body = place(robot, &mut stage, BodyParameters::default());
        let height = body.reading().position.z;
        assert!((height - robot.standing_height()).abs() < 1e-9, "{height}");
        for t in 0..20 {
            step(robot, &mut stage, &mut body, 0, t);
        }
        let reading = body.reading();
        let weight = robot.mass() * 9.81;
        let force: f64 = reading.feet.iter().map(|foot| foot.force).sum();
        assert!((force / weight - 1.0).abs() < 0.15, "{force} N, {weight} N");
        for (foot, side) in reading.feet.iter().zip([1.0, -1.0]) {
            assert!(foot.force > 0.3 * weight, "{foot:?}");
            assert!(foot.velocity.norm() < 0.02, "{foot:?}");
            assert!(side * foot.position.y > 0.05, "{foot:?}");
            assert!(foot.position.z.abs() < 0.01, "{foot:?}");
        }
        let middle = (reading.feet[0].position + reading.feet[1].position) / 2.0;
        let offset = reading.center_of_mass - middle;
        assert!(offset.xy().norm() < 0.08, "{offset}");
        assert!((0.3..1.2).contains(&offset.z), "{offset}");
        assert!(!reading.self_contact.touched);
        assert_eq!(reading.self_contact.force, 0.0);
        assert_eq!(reading.divergence, None);
    });
}

/// All bytes of a model but those for pictures: where lights and cameras are relative to the centre of mass.
fn bytes(stage: &mut Stage) -> Vec<u8> {
    let model = stage.model_mut();
    model.light_poscom0_mut().fill([0.0; 3]);
    model.cam_poscom0_mut().fill([0.0; 3]);
    let mut bytes = vec![0_u8; model.size()];
    model.save_to_buffer(&mut bytes).unwrap();
    bytes
}

#[test]
fn the_model_on_stage_is_the_one_that_would_be_made_for_the_body() {
    for_each_robot(|robot| {
        let mut stage = Stage::new(robot).unwrap();
        let mut body = place(robot, &mut stage, odd(robot, 3));
        let mut other = place(robot, &mut stage, odd(robot, 5));
        let mut plain = place(robot, &mut stage, BodyParameters::default());
        step(robot, &mut stage, &mut other, 0, 0);
        step(robot, &mut stage, &mut body, 0, 0);
        let on_stage = bytes(&mut stage);

        let mut made = Stage::new(robot).unwrap();
        let nominal = bytes(&mut made);
        let rig = Arc::clone(&made.rig);
        apply(&odd(robot, 3), &rig, made.model_mut());
        made.data.set_const();
        assert!(on_stage == bytes(&mut made), "{}", robot.name());
        assert!(on_stage != nominal);

        step(robot, &mut stage, &mut plain, 0, 0);
        assert!(bytes(&mut stage) == nominal, "{}", robot.name());
    });
}

#[test]
fn parameters_change_the_fields_that_they_name() {
    for_each_robot(|robot| {
        let mut stage = Stage::new(robot).unwrap();
        let rig = Arc::clone(&stage.rig);
        let nominal = robot.model();
        let parameters = BodyParameters {
            friction: 0.3,
            base_mass: 0.5,
            hand_mass: [1.0, 2.0],
            base_com: [0.01, 0.02, -0.03],
            link_mass: vec![1.1; nominal.body_mass().len()],
            link_inertia: vec![0.9; nominal.body_mass().len()],
            p_gain: vec![1.2; 27],
            d_gain: vec![0.8; 27],
            motor_torque: vec![0.7; 27],
            motor_damping: vec![3.0; 27],
            motor_delay: 0.0,
            physics: Physics::Exact,
        };
        let _ = place(robot, &mut stage, parameters);
        let model = stage.data.model();
        let close = |a: f64, b: f64| assert!((a - b).abs() <= 1e-12 * b.abs().max(1.0), "{a} {b}");
        for &geom in rig.feet.iter().flat_map(|foot| &foot.geoms) {
            assert_eq!(
                model.geom_friction()[geom][0],
                0.3 * nominal.geom_friction()[geom][0]
            );
            assert_eq!(model.geom_priority()[geom], 1);
        }
        let added = |body: usize| match body {
            b if b == rig.base => 0.5,
            b if b == rig.hands[0] => 1.0,
            b if b == rig.hands[1] => 2.0,
            _ => 0.0,
        };
        for body in 1..nominal.body_mass().len() {
            let mass = nominal.body_mass()[body];
            close(model.body_mass()[body], 1.1 * mass + added(body));
            let scale = 0.9 * (1.1 * mass + added(body)) / mass;
            let inertia = nominal.body_inertia()[body][1];
            close(model.body_inertia()[body][1], scale * inertia);
        }
        let moved = model.body_ipos()[rig.base][2] - nominal.body_ipos()[rig.base][2];
        close(moved, -0.03);
        close(model.body_subtreemass()[rig.base], 1.1 * robot.mass() + 3.5);
        for (actuator, joint) in robot.joints().enumerate() {
            close(model.actuator_gainprm()[actuator][0], 1.2 * joint.kp);
            close(model.actuator_biasprm()[actuator][1], -1.2 * joint.kp);
            close(model.actuator_biasprm()[actuator][2], -0.8 * joint.kd);
            close(
                model.actuator_forcerange()[actuator][1],
                0.7 * joint.torque_limit,
            );
            close(model.dof_damping()[joint.dof_address], 3.0 * joint.damping);
        }
        let light = BodyParameters {
            base_mass: -1000.0,
            ..BodyParameters::default()
        };
        let _ = place(robot, &mut stage, light);
        close(
            stage.data.model().body_mass()[rig.base],
            0.1 * nominal.body_mass()[rig.base],
        );
    });
}

#[test]
fn a_step_depends_on_the_body_alone() {
    for_each_robot(|robot| {
        let alone = |seed: usize| {
            let mut stage = Stage::new(robot).unwrap();
            let mut body = place(robot, &mut stage, odd(robot, seed));
            for t in 0..30 {
                step(robot, &mut stage, &mut body, seed, t);
            }
            bits(&body)
        };
        let expected: Vec<_> = (0..7).map(alone).collect();
        for threads in [1, 2, 3] {
            let pool = Pool::new(robot, threads, Priority::Normal).unwrap();
            let mut stage = Stage::new(robot).unwrap();
            let mut bodies: Vec<Body> = (0..7)
                .map(|seed| place(robot, &mut stage, odd(robot, seed)))
                .collect();
            for t in 0..30 {
                pool.for_each(bodies.par_iter_mut().enumerate(), |stage, (seed, body)| {
                    step(robot, stage, body, seed, t);
                });
            }
            let found: Vec<_> = bodies.iter().map(bits).collect();
            assert!(found == expected, "{threads} threads");
        }
    });
}

#[test]
fn a_stored_body_goes_on_bit_for_bit() {
    for_each_robot(|robot| {
        let mut stage = Stage::new(robot).unwrap();
        let mut body = place(robot, &mut stage, odd(robot, 2));
        for t in 0..10 {
            step(robot, &mut stage, &mut body, 2, t);
        }
        let stored = postcard::to_stdvec(&body).unwrap();
        let mut restored: Body = postcard::from_bytes(&stored).unwrap();
        assert_eq!(restored.reading(), body.reading());
        let mut elsewhere = Stage::new(robot).unwrap();
        for t in 10..20 {
            step(robot, &mut stage, &mut body, 2, t);
            step(robot, &mut elsewhere, &mut restored, 2, t);
        }
        assert_eq!(bits(&restored), bits(&body));
        assert_eq!(restored.reading(), body.reading());
    });
}

#[test]
fn a_divergence_is_the_bodys_own() {
    for_each_robot(|robot| {
        let mut stage = Stage::new(robot).unwrap();
        let mut body = place(robot, &mut stage, odd(robot, 1));
        let mut neighbour = place(robot, &mut stage, odd(robot, 2));
        let mut undisturbed = neighbour.clone();
        let sick = |body: &Body, change: &dyn Fn(&mut Body)| {
            let mut sick = body.clone();
            change(&mut sick);
            sick
        };
        let mut cases = [
            (sick(&body, &|b| b.qvel[8] = f64::NAN), Divergence::Velocity),
            (sick(&body, &|b| b.qpos[2] = 1e11), Divergence::Position),
            (sick(&body, &|b| b.qvel[3] = 1e9), Divergence::Acceleration),
        ];
        for t in 0..6 {
            let (case, expected) = &mut cases[t % 3];
            let before = case.reading().joint_positions.clone();
            step(robot, &mut stage, case, 0, t);
            assert_eq!(case.reading().divergence, Some(*expected));
            assert_eq!(case.reading().joint_positions, before);
            step(robot, &mut stage, &mut neighbour, 0, t);
            assert_eq!(neighbour.reading().divergence, None);
        }
        let nan = pose(robot, &[("elbow", f32::NAN)]);
        let targets = Targets {
            goal: &nan,
            legs: &legs(robot),
        };
        let divergence = stage.step(&mut body, &targets).divergence;
        assert_eq!(divergence, Some(Divergence::Control));
        step(robot, &mut stage, &mut neighbour, 0, 6);
        let mut elsewhere = Stage::new(robot).unwrap();
        for t in 0..7 {
            step(robot, &mut elsewhere, &mut undisturbed, 0, t);
        }
        assert_eq!(bits(&neighbour), bits(&undisturbed));
    });
}

#[test]
fn less_friction_slips_more() {
    for_each_robot(|robot| {
        let slip = |friction: f64| {
            let mut stage = Stage::new(robot).unwrap();
            let parameters = BodyParameters {
                friction,
                ..BodyParameters::default()
            };
            let mut body = place(robot, &mut stage, parameters);
            body.push(Vector3::new(0.0, 0.5, 0.0), Vector3::zeros());
            let mut slip = 0.0;
            for t in 0..10 {
                step(robot, &mut stage, &mut body, 0, t);
                slip += body
                    .reading()
                    .feet
                    .iter()
                    .map(|f| f.velocity.xy().norm())
                    .sum::<f64>();
            }
            slip
        };
        let (little, much) = (slip(0.1), slip(2.0));
        assert!(little > 2.0 * much, "{}: {little} {much}", robot.name());
    });
}

#[test]
fn targets_take_effect_after_the_delay() {
    for_each_robot(|robot| {
        let period = 1.0 / robot.control_rate_hz();
        let after = |delay: f64, new: bool| {
            let mut stage = Stage::new(robot).unwrap();
            let parameters = BodyParameters {
                motor_delay: delay,
                ..BodyParameters::default()
            };
            let mut body = place(robot, &mut stage, parameters);
            let goal = pose(robot, &[("elbow", if new { -0.2 } else { -0.6 })]);
            let goal = if new { goal } else { pose(robot, &[]) };
            let legs = legs(robot);
            stage.step(
                &mut body,
                &Targets {
                    goal: &goal,
                    legs: &legs,
                },
            );
            bits(&body)
        };
        // The default pose in f32 is the target that the body was placed with, to within rounding.
        let late = after(period, true);
        let never = after(0.0, false);
        let difference = |a: &[u64], b: &[u64]| {
            let numbers = a.iter().zip(b).take(robot.model().qpos0().len());
            let differences = numbers.map(|(&a, &b)| (f64::from_bits(a) - f64::from_bits(b)).abs());
            differences.fold(0.0, f64::max)
        };
        assert!(difference(&late, &never) < 1e-6);
        let moved: Vec<f64> = [0.0, 0.25, 0.3, 0.5, 0.75]
            .map(|share| difference(&after(share * period, true), &never))
            .to_vec();
        assert!(moved.is_sorted_by(|a, b| a > b), "{moved:?}");
    });
}

#[test]
fn a_push_is_no_acceleration_and_moves_the_base() {
    for_each_robot(|robot| {
        let mut stage = Stage::new(robot).unwrap();
        let mut body = place(robot, &mut stage, BodyParameters::default());
        body.push(Vector3::new(0.4, -0.2, 0.0), Vector3::new(0.0, 0.0, 0.3));
        step(robot, &mut stage, &mut body, 0, 0);
        let reading = body.reading();
        assert!(reading.position.x > 0.003 && reading.position.y < -0.001);
        assert!(reading.velocity_change.norm() < 0.35);
        let expected = reading.linear_velocity - Vector3::new(0.4, -0.2, 0.0);
        assert!((reading.velocity_change - expected).norm() < 1e-12);
    });
}

#[test]
fn a_hand_on_the_body_is_pushed_off() {
    for_each_robot(|robot| {
        // The left arm hangs straight and presses the hand against the body, from its left.
        let angles = [
            ("left_shoulder_roll", -0.4),
            ("left_elbow", if robot.name() == "g1" { 1.5 } else { 0.0 }),
            ("left_shoulder_pitch", 0.0),
        ];
        let goal = pose(robot, &angles);
        let legs = legs(robot);
        let targets = Targets {
            goal: &goal,
            legs: &legs,
        };
        let mut stage = Stage::new(robot).unwrap();
        let mut body = place(robot, &mut stage, BodyParameters::default());
        let mut contacts = (0..25).map(|_| stage.step(&mut body, &targets).self_contact.clone());
        let contact = contacts.find(|contact| contact.touched).unwrap();
        assert!(contact.force > 1.0, "{}: {contact:?}", robot.name());
    });
}

#[test]
fn a_lifted_body_hangs_above_the_floor() {
    for_each_robot(|robot| {
        let mut stage = Stage::new(robot).unwrap();
        let mut joints = rest(robot);
        joints[robot.goal_joints().len() + 3] += 0.1;
        let body = stage.place(&Start {
            joint_positions: &joints,
            lift: 0.1,
            parameters: BodyParameters::default(),
        });
        assert!(body.reading().feet.iter().all(|foot| foot.force == 0.0));
        // The foot of the straighter leg reaches lowest; a bent knee tilts the other one.
        let lowest = body.reading().feet.iter().map(|foot| foot.position.z);
        let lowest = lowest.fold(f64::INFINITY, f64::min);
        assert!((0.09..0.12).contains(&lowest), "{lowest}");
    });
}

#[test]
fn nominal_bodies_share_their_fields() {
    for_each_robot(|robot| {
        let mut stage = Stage::new(robot).unwrap();
        let parameters = BodyParameters {
            motor_delay: 0.004,
            p_gain: vec![1.0; 27],
            ..BodyParameters::default()
        };
        let bodies = [parameters, BodyParameters::default()].map(|p| place(robot, &mut stage, p));
        let [first, second] = bodies.map(|body| body.fields.unwrap());
        assert!(Arc::ptr_eq(&first, &second));
    });
}

#[test]
fn fast_physics_is_about_the_same_and_leaves_no_trace_on_the_stage() {
    for_each_robot(|robot| {
        let mut stage = Stage::new(robot).unwrap();
        let run = |stage: &mut Stage, physics: Physics| {
            let parameters = BodyParameters {
                physics,
                ..odd(robot, 1)
            };
            let mut body = place(robot, stage, parameters);
            for t in 0..25 {
                let goal = goal(robot, 0, t);
                stage.step(
                    &mut body,
                    &Targets {
                        goal: &goal,
                        legs: &legs(robot),
                    },
                );
            }
            body.reading().clone()
        };
        let exact = run(&mut stage, Physics::Exact);
        let fast = run(&mut stage, Physics::Fast);
        assert_ne!(exact, fast, "{}", robot.name());
        // Half a second on, the base is where it would be, but for millimetres.
        let apart = (exact.position - fast.position).norm();
        assert!(apart < 0.01, "{}: {apart} m", robot.name());
        let turned = exact.orientation.angle_to(&fast.orientation);
        assert!(turned < 0.03, "{}: {turned} rad", robot.name());
        assert_eq!(run(&mut stage, Physics::Exact), exact, "{}", robot.name());
    });
}
