//! The kinematics against MuJoCo, against finite differences, and against themselves.

mod common;

use emp_robot::{Foot, KEY_NODE_NAMES, KEY_NODES, Kinematics, Robot};
use mujoco_rs::prelude::*;
use nalgebra::{Isometry3, Matrix3, Quaternion, Translation3, Unit, UnitQuaternion, Vector3};
use proptest::prelude::*;
use rand::RngExt;

/// A body of the simulated robot, in the world.
struct Body {
    position: Vector3<f64>,
    rotation: UnitQuaternion<f64>,
}

/// MuJoCo with the robot's base at identity.
struct Reference {
    model: MjModel,
}

impl Reference {
    fn new(robot: &Robot) -> Self {
        Self {
            model: robot.model(),
        }
    }

    fn pose(&self, robot: &Robot, q: &[f64]) -> MjData<&MjModel> {
        let mut data = self.model.make_data();
        let qpos = data.qpos_mut();
        qpos.fill(0.0);
        qpos[3] = 1.0;
        for (joint, angle) in robot.joints().zip(q) {
            qpos[joint.qpos_address] = *angle;
        }
        data.forward();
        data
    }

    fn body(&self, data: &MjData<&MjModel>, name: &str) -> Body {
        let id = self
            .model
            .name_to_id(MjtObjBase::mjOBJ_BODY, name)
            .expect("the body is there");
        let [w, x, y, z] = data.xquat()[id];
        Body {
            position: Vector3::from(data.xpos()[id]),
            rotation: UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)),
        }
    }

    /// An output row from MuJoCo's own kinematics.
    fn row(&self, robot: &Robot, q: &[f64]) -> Vec<f64> {
        let data = self.pose(robot, q);
        let point = |body: &str, offset: [f64; 3]| {
            let body = self.body(&data, body);
            body.position + body.rotation * Vector3::from(offset)
        };
        let mut row = Vec::new();
        for node in robot.key_nodes() {
            row.extend_from_slice(point(&node.body, node.offset).as_slice());
        }
        for (side, zero) in wrist_axes(robot).iter().enumerate() {
            let body = self.body(&data, robot.hand_bodies()[side]);
            let rotation = body.rotation.to_rotation_matrix() * zero;
            row.extend_from_slice(rotation.transpose().as_slice());
        }
        for sphere in robot.link_spheres() {
            row.extend_from_slice(point(&sphere.body, sphere.center).as_slice());
        }
        let base = self
            .model
            .name_to_id(MjtObjBase::mjOBJ_BODY, robot.base_body())
            .expect("the base is there");
        row.extend_from_slice(&data.subtree_com()[base]);
        let [left, right] = robot
            .feet()
            .each_ref()
            .map(|foot| point(&foot.body, sole_center(foot)));
        row.extend_from_slice(((left + right) / 2.0).as_slice());
        row
    }
}

/// The wrist convention in the wrist bodies' frames, stated here apart from robot.toml.
fn wrist_axes(robot: &Robot) -> [Matrix3<f64>; 2] {
    let (fingers, thumb) = match robot.name() {
        "emp27" => (-Vector3::z(), Vector3::x()),
        "g1" => (Vector3::x(), Vector3::z()),
        other => panic!("no wrist convention for {other}"),
    };
    [Matrix3::from_columns(&[fingers, thumb.cross(&fingers), thumb]); 2]
}

/// Centre of a foot's sole, stated here apart from the library.
fn sole_center(foot: &Foot) -> [f64; 3] {
    let span = |axis: usize| {
        let mut values: Vec<f64> = foot.centers.iter().map(|center| center[axis]).collect();
        values.sort_by(f64::total_cmp);
        [values[0], values[values.len() - 1]]
    };
    let [x, y, z] = [span(0), span(1), span(2)];
    [(x[0] + x[1]) / 2.0, (y[0] + y[1]) / 2.0, z[0] - foot.radius]
}

fn forward(kinematics: &Kinematics, q: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; q.len() / kinematics.dof() * kinematics.output_width()];
    kinematics.forward(q, &mut out);
    out
}

fn largest_difference(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter()
        .zip(b)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, f64::max)
}

#[test]
fn forward_equals_mujoco() {
    for robot in common::all() {
        let reference = Reference::new(&robot);
        let kinematics = robot.kinematics();
        let q = common::random_poses(&robot, &mut common::seeded(1), 200);
        let out = forward(kinematics, &q);
        let rows = q
            .chunks(kinematics.dof())
            .zip(out.chunks(kinematics.output_width()));
        let mut worst: f64 = 0.0;
        for (q, row) in rows {
            worst = worst.max(largest_difference(row, &reference.row(&robot, q)));
        }
        println!("{}: largest difference to MuJoCo {worst:e}", robot.name());
        assert!(worst < 1e-9, "{}: {worst}", robot.name());
    }
}

/// The scalar whose gradient with respect to the outputs is `weights`.
#[test]
fn foot_contacts_are_where_mujoco_has_them() {
    for robot in common::all() {
        let reference = Reference::new(&robot);
        let q = common::random_poses(&robot, &mut common::seeded(7), 1);
        let data = reference.pose(&robot, &q);
        let geoms = robot.feet().iter().flat_map(|foot| &foot.geoms);
        let expected = geoms.map(|geom| {
            let id = reference.model.name_to_id(MjtObjBase::mjOBJ_GEOM, geom);
            Vector3::from(data.geom_xpos()[id.expect("the geom is there")])
        });
        let found = robot.kinematics().foot_contacts(&q);
        let spheres = robot.feet().iter().map(|foot| foot.centers.len());
        assert_eq!(found.len(), spheres.sum::<usize>());
        let base = reference.body(&data, robot.base_body());
        for (found, expected) in found.iter().zip(expected) {
            assert!((found + base.position - expected).norm() < 1e-9);
        }
    }
}

#[test]
fn goals_move_what_hangs_on_the_waist() {
    let robot = &common::all()[0];
    let moved: Vec<&str> = (0..robot.link_spheres().len())
        .filter(|&link| robot.kinematics().goals_move(link))
        .map(|link| robot.link_spheres()[link].name.as_str())
        .collect();
    assert_eq!(moved, ["torso", "left_hand", "right_hand"]);
}

fn weighted(kinematics: &Kinematics, q: &[f64], weights: &[f64]) -> f64 {
    forward(kinematics, q)
        .iter()
        .zip(weights)
        .map(|(out, weight)| out * weight)
        .sum()
}

#[test]
fn backward_equals_central_differences() {
    const STEP: f64 = 1e-5;
    for robot in common::all() {
        let kinematics = robot.kinematics();
        let mut rng = common::seeded(3);
        let mut worst: f64 = 0.0;
        for _ in 0..20 {
            let q = common::random_poses(&robot, &mut rng, 1);
            let weights: Vec<f64> = (0..kinematics.output_width())
                .map(|_| rng.random_range(-1.0..1.0))
                .collect();
            let mut gradient = vec![f64::NAN; q.len()];
            kinematics.backward(&q, &weights, &mut gradient);
            for joint in 0..q.len() {
                let at = |step: f64| {
                    let mut moved = q.clone();
                    moved[joint] += step;
                    weighted(kinematics, &moved, &weights)
                };
                let expected = (at(STEP) - at(-STEP)) / (2.0 * STEP);
                worst = worst.max((gradient[joint] - expected).abs());
            }
        }
        println!(
            "{}: largest difference to central differences {worst:e}",
            robot.name()
        );
        assert!(worst < 1e-8, "{}: {worst}", robot.name());
    }
}

/// Each output alone, so that an error in one cannot hide behind another.
#[test]
fn every_output_has_its_gradient() {
    const STEP: f64 = 1e-5;
    for robot in common::all() {
        let kinematics = robot.kinematics();
        let (dof, width) = (kinematics.dof(), kinematics.output_width());
        let q = common::random_poses(&robot, &mut common::seeded(4), 1);
        let mut identity = vec![0.0; width * width];
        identity
            .iter_mut()
            .step_by(width + 1)
            .for_each(|one| *one = 1.0);
        let mut jacobian = vec![f64::NAN; width * dof];
        kinematics.backward(&q.repeat(width), &identity, &mut jacobian);
        for joint in 0..dof {
            let at = |step: f64| {
                let mut moved = q.clone();
                moved[joint] += step;
                forward(kinematics, &moved)
            };
            for (output, (ahead, behind)) in at(STEP).iter().zip(at(-STEP)).enumerate() {
                let expected = (ahead - behind) / (2.0 * STEP);
                let found = jacobian[output * dof + joint];
                assert!(
                    (found - expected).abs() < 1e-8,
                    "{}: d{output}/d{joint} {found} {expected}",
                    robot.name()
                );
            }
        }
    }
}

#[test]
fn single_precision_follows_double() {
    for robot in common::all() {
        let kinematics = robot.kinematics();
        let mut rng = common::seeded(5);
        let q = common::random_poses(&robot, &mut rng, 300);
        let single = |values: &[f64]| values.iter().map(|&value| value as f32).collect::<Vec<_>>();
        let double = |values: &[f32]| {
            values
                .iter()
                .map(|&value| f64::from(value))
                .collect::<Vec<_>>()
        };

        let expected = forward(kinematics, &q);
        let mut out = vec![0.0; expected.len()];
        kinematics.forward(&single(&q), &mut out);
        let worst = largest_difference(&double(&out), &expected);
        assert!(worst < 2e-6, "{}: {worst}", robot.name());

        let grad_out: Vec<f64> = expected
            .iter()
            .map(|_| rng.random_range(-1.0..1.0))
            .collect();
        let mut expected = vec![0.0; q.len()];
        kinematics.backward(&q, &grad_out, &mut expected);
        let mut grad_q = vec![0.0; q.len()];
        kinematics.backward(&single(&q), &single(&grad_out), &mut grad_q);
        let worst = largest_difference(&double(&grad_q), &expected);
        assert!(worst < 2e-5, "{}: {worst}", robot.name());
    }
}

#[test]
fn a_batch_equals_its_poses_one_by_one() {
    for robot in common::all() {
        let kinematics = robot.kinematics();
        let (dof, width) = (kinematics.dof(), kinematics.output_width());
        for rows in [0, 1, 7, 8, 9, 33] {
            let mut rng = common::seeded(6);
            let q = common::random_poses(&robot, &mut rng, rows);
            let out = forward(kinematics, &q);
            let grad_out: Vec<f64> = out.iter().map(|_| rng.random_range(-1.0..1.0)).collect();
            let mut grad_q = vec![f64::NAN; q.len()];
            kinematics.backward(&q, &grad_out, &mut grad_q);
            for row in 0..rows {
                let (pose, outputs) = (row * dof..(row + 1) * dof, row * width..(row + 1) * width);
                assert_eq!(forward(kinematics, &q[pose.clone()]), out[outputs.clone()]);
                let mut single = vec![f64::NAN; dof];
                kinematics.backward(&q[pose.clone()], &grad_out[outputs], &mut single);
                assert_eq!(single, grad_q[pose]);
            }
        }
    }
}

#[test]
fn a_frame_equals_the_batch() {
    for robot in common::all() {
        let kinematics = robot.kinematics();
        let layout = kinematics.layout();
        let goal_joints = robot.goal_joints().len();
        let mut frame = kinematics.frame();
        let poses = common::random_poses(&robot, &mut common::seeded(7), 50);
        for q in poses.chunks(kinematics.dof()) {
            let row = forward(kinematics, q);
            frame.update(&q[..goal_joints]);
            let positions: Vec<f64> = frame
                .positions()
                .iter()
                .flat_map(|position| position.iter().copied())
                .collect();
            let wrists: Vec<f64> = frame
                .wrist_rotations()
                .iter()
                .flat_map(|wrist| wrist.transpose().iter().copied().collect::<Vec<_>>())
                .collect();
            assert!(largest_difference(&positions, &row[layout.key_nodes.clone()]) < 1e-12);
            assert!(largest_difference(&wrists, &row[layout.wrist_rotations.clone()]) < 1e-12);
        }
    }
}

#[test]
fn frame_derivatives_equal_central_differences() {
    const STEP: f64 = 1e-5;
    for robot in common::all() {
        let mut frame = robot.kinematics().frame();
        let goal_joints = robot.goal_joints().len();
        let q = common::random_poses(&robot, &mut common::seeded(8), 1)[..goal_joints].to_vec();
        for joint in 0..goal_joints {
            let mut at = |step: f64| {
                let mut moved = q.clone();
                moved[joint] += step;
                frame.update(&moved);
                (*frame.positions(), *frame.wrist_rotations())
            };
            let ((ahead, wrists_ahead), (behind, wrists_behind)) = (at(STEP), at(-STEP));
            frame.update(&q);
            for node in 0..KEY_NODES {
                let expected = (ahead[node] - behind[node]) / (2.0 * STEP);
                let found = frame.position_derivative(node, joint);
                let moves = frame.joints_moving(node).contains(&joint);
                assert!(moves || found.norm() == 0.0);
                assert!(
                    (found - expected).norm() < 1e-8,
                    "{} {} {joint}",
                    robot.name(),
                    KEY_NODE_NAMES[node]
                );
            }
            for side in 0..2 {
                let expected = (wrists_ahead[side] - wrists_behind[side]) / (2.0 * STEP);
                let moves = frame.joints_moving(KEY_NODES - 2 + side).contains(&joint);
                for column in 0..3 {
                    let axis = frame.wrist_rotations()[side].column(column).into_owned();
                    let found = if moves {
                        frame.direction_derivative(&axis, joint)
                    } else {
                        Vector3::zeros()
                    };
                    assert!(
                        (found - expected.column(column)).norm() < 1e-8,
                        "{} {side} {joint}",
                        robot.name()
                    );
                }
            }
        }
    }
}

/// The forearm's direction is the elbow's doing alone: no wrist joint moves the wrist's node.
#[test]
fn bending_a_wrist_does_not_turn_the_forearm() {
    for robot in common::all() {
        let mut frame = robot.kinematics().frame();
        let q = common::random_poses(&robot, &mut common::seeded(10), 1);
        frame.update(&q[..robot.goal_joints().len()]);
        for (joint, name) in robot
            .goal_joints()
            .iter()
            .map(|joint| &joint.name)
            .enumerate()
        {
            for node in (KEY_NODES - 2..KEY_NODES).filter(|_| name.contains("wrist")) {
                let derivative = frame.position_derivative(node, joint);
                assert!(
                    derivative.norm() < 1e-12,
                    "{name} moves {}",
                    KEY_NODE_NAMES[node]
                );
            }
        }
    }
}

/// The graph of the goal joints, put together again, has the joints where the kinematics has them.
#[test]
fn the_goal_tree_composes_to_the_joints() {
    for robot in common::all() {
        let mut frame = robot.kinematics().frame();
        let q = common::random_poses(&robot, &mut common::seeded(9), 1);
        let q = &q[..robot.goal_joints().len()];
        frame.update(q);
        let mut frames: Vec<Isometry3<f64>> = Vec::new();
        for (joint, node) in robot.goal_tree().iter().enumerate() {
            let parent = node
                .parent
                .map_or_else(Isometry3::identity, |parent| frames[parent]);
            let [roll, pitch, yaw] = node.origin_rpy;
            let origin = Isometry3::from_parts(
                Translation3::from(node.origin_xyz),
                UnitQuaternion::from_euler_angles(roll, pitch, yaw),
            );
            let axis = Unit::new_unchecked(Vector3::from(node.axis));
            let turn = UnitQuaternion::from_axis_angle(&axis, q[joint]);
            frames.push(parent * origin * turn);
            let found = &frames[joint];
            assert!((found.rotation * axis.into_inner() - frame.axes()[joint]).norm() < 1e-9);
            assert!((found.translation.vector - frame.anchors()[joint]).norm() < 1e-9);
        }
    }
}

/// For each joint its mirror image and the sign of the angle, from names and the axes of the zero pose.
fn mirror_map(robot: &Robot) -> Vec<(usize, f64)> {
    let reference = Reference::new(robot);
    let data = reference.pose(robot, &[0.0; 27]);
    let axis = |name: &str| {
        let id = reference
            .model
            .name_to_id(MjtObjBase::mjOBJ_JOINT, name)
            .expect("the joint is there");
        Vector3::from(data.xaxis()[id])
    };
    let names: Vec<&str> = robot.joints().map(|joint| joint.name.as_str()).collect();
    names
        .iter()
        .map(|name| {
            let image = swap_sides(name);
            let [x, y, z] = axis(name).into();
            let alignment = Vector3::new(-x, y, -z).dot(&axis(&image));
            assert!(alignment.abs() > 0.999, "{name} has no mirror image");
            let index = names
                .iter()
                .position(|other| *other == image)
                .expect("both sides have it");
            (index, alignment.signum())
        })
        .collect()
}

fn swap_sides(name: &str) -> String {
    match (name.strip_prefix("left"), name.strip_prefix("right")) {
        (Some(rest), _) => format!("right{rest}"),
        (_, Some(rest)) => format!("left{rest}"),
        _ => name.to_owned(),
    }
}

fn check_mirror(robot: &Robot, seed: u64) -> Result<(), TestCaseError> {
    // Unitree's two sides differ by 0.01 mm in the shoulders.
    let tolerance = if robot.name() == "g1" { 1e-4 } else { 1e-12 };
    let kinematics = robot.kinematics();
    let q = common::random_poses(robot, &mut common::seeded(seed), 1);
    let mut image = vec![0.0; q.len()];
    for (angle, (joint, sign)) in q.iter().zip(mirror_map(robot)) {
        image[joint] = sign * angle;
        let range = robot.joints().nth(joint).map(|joint| joint.range);
        let inside =
            range.is_some_and(|[low, high]| (low - 1e-3..=high + 1e-3).contains(&image[joint]));
        prop_assert!(inside, "limits are mirror images");
    }
    let [row, mirrored] = [&q, &image].map(|q| forward(kinematics, q));
    for (node, name) in KEY_NODE_NAMES.iter().enumerate() {
        let other = KEY_NODE_NAMES
            .iter()
            .position(|other| *other == swap_sides(name))
            .expect("both sides have it");
        let [x, y, z] = [0, 1, 2].map(|axis| row[3 * node + axis]);
        let expected = Vector3::new(x, -y, z);
        let found = Vector3::from_column_slice(&mirrored[3 * other..3 * other + 3]);
        prop_assert!(
            (found - expected).norm() < tolerance,
            "{name}: {found} {expected}"
        );
    }
    let flip = Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, 1.0));
    let wrists = kinematics.layout().wrist_rotations.start;
    let wrist = |row: &[f64], side: usize| {
        Matrix3::from_row_slice(&row[wrists + 9 * side..wrists + 9 * side + 9])
    };
    for side in 0..2 {
        let difference = wrist(&mirrored, 1 - side) - flip * wrist(&row, side) * flip;
        prop_assert!(difference.norm() < tolerance, "wrist {side}: {difference}");
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_mirrored_pose_has_mirrored_key_nodes(seed: u64) {
        for robot in common::all() {
            check_mirror(&robot, seed)?;
        }
    }
}

/// The zero poses, from the robots' geometry: emp27 hangs its arms, g1 points its forearms forward.
#[test]
fn zero_poses_point_where_they_should() {
    for robot in common::all() {
        let mut frame = robot.kinematics().frame();
        frame.update(&[0.0; 15]);
        let [
            ..,
            left_shoulder,
            right_shoulder,
            left_elbow,
            right_elbow,
            left_wrist,
            right_wrist,
        ] = *frame.positions();
        let (forearm, fingers, thumb) = match robot.name() {
            "emp27" => (-Vector3::z(), -Vector3::z(), Vector3::x()),
            _ => (Vector3::x(), Vector3::x(), Vector3::z()),
        };
        for (shoulder, elbow, wrist) in [
            (left_shoulder, left_elbow, left_wrist),
            (right_shoulder, right_elbow, right_wrist),
        ] {
            assert!(
                (elbow - shoulder).normalize().dot(&-Vector3::z()) > 0.99,
                "{}",
                robot.name()
            );
            assert!(
                (wrist - elbow).normalize().dot(&forearm) > 0.99,
                "{}",
                robot.name()
            );
        }
        for wrist in frame.wrist_rotations() {
            assert!(wrist.column(0).dot(&fingers) > 0.999, "{}", robot.name());
            assert!(wrist.column(2).dot(&thumb) > 0.999, "{}", robot.name());
        }
    }
}

#[test]
#[should_panic(expected = "rows of 27")]
fn half_a_row_is_refused() {
    let robot = Robot::load(&common::robots().join("emp27")).expect("emp27 ships with the project");
    robot.kinematics().forward(&[0.0; 13], &mut [0.0; 66]);
}
