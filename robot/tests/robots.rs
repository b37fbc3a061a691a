//! What both robots have to be.

mod common;

use emp_robot::{KEY_NODE_NAMES, Robot, robot_folders};
use mujoco_rs::prelude::*;

const fn is_shared<T: Send + Sync + 'static>() {}
const _: () = is_shared::<Robot>();

fn default_pose(robot: &Robot) -> Vec<f64> {
    robot.joints().map(|joint| joint.default).collect()
}

fn output_row(robot: &Robot, q: &[f64]) -> Vec<f64> {
    let mut row = vec![0.0; robot.kinematics().output_width()];
    robot.kinematics().forward(q, &mut row);
    row
}

fn body(model: &MjModel, name: &str) -> usize {
    model
        .name_to_id(MjtObjBase::mjOBJ_BODY, name)
        .expect("the body is there")
}

fn geom_name(model: &MjModel, geom: usize) -> String {
    model
        .id_to_name(MjtObjBase::mjOBJ_GEOM, geom)
        .unwrap_or("floor")
        .to_owned()
}

/// The model with the base upright at `height`, joints at `q`.
fn placed<'m>(robot: &Robot, model: &'m MjModel, height: f64, q: &[f64]) -> MjData<&'m MjModel> {
    let mut data = model.make_data();
    let qpos = data.qpos_mut();
    qpos[..7].copy_from_slice(&[0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0]);
    for (joint, angle) in robot.joints().zip(q) {
        qpos[joint.qpos_address] = *angle;
    }
    data.forward();
    data
}

#[test]
fn the_project_has_both_robots() {
    let folders = robot_folders(&common::robots()).expect("robots/ can be read");
    let names: Vec<_> = folders
        .iter()
        .filter_map(|folder| folder.file_name()?.to_str())
        .collect();
    assert_eq!(names, ["emp27", "g1"]);
}

#[test]
fn both_have_the_27_joint_layout() {
    for robot in common::all() {
        assert_eq!(
            (robot.goal_joints().len(), robot.leg_joints().len()),
            (15, 12),
            "{}",
            robot.name()
        );
        assert_eq!(robot.kinematics().dof(), 27);
        let names: Vec<_> = robot.key_nodes().iter().map(|node| node.name).collect();
        assert_eq!(names, KEY_NODE_NAMES);
        let tree: Vec<_> = robot.goal_tree().iter().map(|node| node.parent).collect();
        let arm = |first: usize| std::iter::once(Some(0)).chain((first..first + 6).map(Some));
        let expected: Vec<_> = std::iter::once(None).chain(arm(1)).chain(arm(8)).collect();
        assert_eq!(tree, expected, "{}", robot.name());
        assert_eq!((robot.control_rate_hz(), robot.substeps()), (50.0, 4));
    }
}

#[test]
fn the_model_is_what_the_configuration_says() {
    for robot in common::all() {
        let model = robot.model();
        assert_eq!(model.opt().timestep, robot.timestep());
        let actuators = model.actuator_trnid();
        assert_eq!(actuators.len(), 27);
        for (i, joint) in robot.joints().enumerate() {
            let id = model
                .name_to_id(MjtObjBase::mjOBJ_JOINT, &joint.name)
                .expect("the joint is there");
            assert_eq!(
                actuators[i][0], id as i32,
                "actuators are in the order of joints"
            );
            assert_eq!(
                model.id_to_name(MjtObjBase::mjOBJ_ACTUATOR, i),
                Some(joint.name.as_str())
            );
            assert_eq!(model.actuator_gainprm()[i][0], joint.kp);
            assert_eq!(
                model.actuator_biasprm()[i][..3],
                [0.0, -joint.kp, -joint.kd]
            );
            assert_eq!(
                model.actuator_forcerange()[i],
                [-joint.torque_limit, joint.torque_limit]
            );
            assert_eq!(model.dof_armature()[joint.dof_address], joint.armature);
            assert_eq!(model.dof_damping()[joint.dof_address], joint.damping);
            assert_eq!(model.jnt_range()[id], joint.range);
        }
    }
}

#[test]
fn visual_shapes_weigh_nothing() {
    for robot in common::all() {
        let (model, visual) = (
            robot.model(),
            robot.visual_model().expect("it was just loaded"),
        );
        assert!(
            visual.geom_type().len() > model.geom_type().len() + 20,
            "{}",
            robot.name()
        );
        for id in 0..model.body_mass().len() {
            let name = model
                .id_to_name(MjtObjBase::mjOBJ_BODY, id)
                .expect("bodies have names");
            assert_eq!(
                model.body_mass()[id],
                visual.body_mass()[body(&visual, name)],
                "{name}"
            );
        }
    }
}

#[test]
fn emp27_has_the_size_and_masses_it_claims() {
    let robot = Robot::load(&common::robots().join("emp27")).expect("emp27 ships with the project");
    let model = robot.visual_model().expect("it was just loaded");
    let mass_below = |name: &str| model.body_subtreemass()[body(&model, name)];
    let close = |value: f64, expected: f64| {
        assert!((value - expected).abs() < 1e-9, "{value} is not {expected}");
    };
    close(robot.mass(), 60.0);
    close(mass_below("left_shoulder_pitch"), 6.0);
    close(mass_below("right_shoulder_pitch"), 6.0);
    close(mass_below("left_hip_pitch"), 11.5);
    close(mass_below("right_hip_pitch"), 11.5);

    let data = placed(&robot, &model, 0.0, &[0.0; 27]);
    let head = model
        .name_to_id(MjtObjBase::mjOBJ_GEOM, "head")
        .expect("it has a head");
    let top = data.geom_xpos()[head][2] + model.geom_size()[head][2];
    let sole = output_row(&robot, &[0.0; 27])[robot.kinematics().layout().foot_support.clone()][2];
    close(top - sole, 1.65);
    for foot in robot.feet() {
        let x = foot.centers.iter().map(|center| center[0]);
        let [low, high] = [
            x.clone().fold(f64::MAX, f64::min),
            x.fold(f64::MIN, f64::max),
        ];
        close(high - low + 2.0 * foot.radius, 0.24);
    }
}

#[test]
fn the_default_pose_stands_over_its_feet() {
    for robot in common::all() {
        let row = output_row(&robot, &default_pose(&robot));
        let layout = robot.kinematics().layout();
        let center = &row[layout.center_of_mass.clone()];
        let support = &row[layout.foot_support.clone()];
        println!(
            "{}: {:.2} kg, base {:.4} m high, centre of mass {:.4} m high and {:.4} m ahead of the feet's centre",
            robot.name(),
            robot.mass(),
            robot.standing_height(),
            center[2] - support[2],
            center[0] - support[0],
        );
        assert!((center[0] - support[0]).abs() < 0.005, "{}", robot.name());
        assert!((center[1] - support[1]).abs() < 0.001, "{}", robot.name());

        let model = robot.model();
        let data = placed(
            &robot,
            &model,
            robot.standing_height(),
            &default_pose(&robot),
        );
        for foot in robot.feet() {
            for name in &foot.geoms {
                let geom = model
                    .name_to_id(MjtObjBase::mjOBJ_GEOM, name)
                    .expect("the sphere is there");
                let gap = data.geom_xpos()[geom][2] - foot.radius;
                // g1's ankles are told to lean back against its weight, so its heels stand a little higher than its toes.
                assert!(
                    (-1e-9..6e-3).contains(&gap),
                    "{} {name} is {gap} m above the floor",
                    robot.name()
                );
            }
        }
    }
}

/// Servos, feet and floor work together: for a moment, the robot stands without any policy.
#[test]
fn the_default_pose_is_held_for_a_moment() {
    for robot in common::all() {
        let model = robot.model();
        let pose = default_pose(&robot);
        let mut data = placed(&robot, &model, robot.standing_height(), &pose);
        data.ctrl_mut().copy_from_slice(&pose);
        for _ in 0..60 {
            data.step();
        }
        let sunk = robot.standing_height() - data.qpos()[2];
        assert!(
            (-0.005..0.02).contains(&sunk),
            "{} sank by {sunk} m",
            robot.name()
        );
        let tilt = 2.0 * data.qpos()[4].hypot(data.qpos()[5]).asin();
        assert!(tilt < 0.1, "{} tilted by {tilt} rad", robot.name());
        let weight = robot.mass() * 9.81;
        let carried: f64 = (0..data.contact().len())
            .map(|i| data.contact_force(i)[0])
            .sum();
        assert!(
            (carried / weight - 1.0).abs() < 0.2,
            "{}: {carried} N of {weight} N",
            robot.name()
        );
    }
}

/// In random poses only listed pairs touch, and they do touch.
#[test]
fn only_listed_pairs_touch() {
    for robot in common::all() {
        let model = robot.model();
        let poses = common::random_poses(&robot, &mut common::seeded(2), 1000);
        let mut touched = 0;
        for q in poses.chunks(27) {
            let data = placed(&robot, &model, 3.0, q);
            for contact in data.contact() {
                let pair = contact.geom.map(|geom| geom_name(&model, geom as usize));
                let listed = robot
                    .contact_pairs()
                    .iter()
                    .any(|[a, b]| pair == [a.clone(), b.clone()] || pair == [b.clone(), a.clone()]);
                assert!(listed, "{}: {pair:?}", robot.name());
                touched += 1;
            }
        }
        println!(
            "{}: {touched} self-contacts in 1000 random poses",
            robot.name()
        );
        assert!(touched > 10, "{}", robot.name());
    }
}
