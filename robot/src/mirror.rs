//! The robot seen in a mirror: which joint stands for which, and which way round.

use mujoco_rs::prelude::*;
use nalgebra::Vector3;

use crate::{Robot, RobotError};

/// How far mirrored axes, anchors, limits and default angles may be off (a cosine, metres, radians).
const TOLERANCE: f64 = 1e-3;

/// The reflection in the plane between left and right (x–z), for joint vectors.
///
/// Where joint vector q is a pose, [`joints`](Self::joints) of it is the same pose in the mirror:
/// `mirrored[i] = signs[i] · q[permutation[i]]`. Velocities, torques and targets turn alike; so do a policy's actions
/// (offsets from the default pose, which is its own mirror image). Roll, pitch and yaw take the signs of
/// [`ROLL_PITCH_YAW`](Self::ROLL_PITCH_YAW).
#[derive(Clone, Debug, PartialEq)]
pub struct JointMirror {
    permutation: Vec<usize>,
    signs: Vec<f32>,
    goal_joints: usize,
}

impl JointMirror {
    /// Signs of a base's roll, pitch and yaw in the mirror.
    pub const ROLL_PITCH_YAW: [f32; 3] = [-1.0, 1.0, -1.0];

    /// For each joint, in the order of [`Robot::joints`], the joint whose value it takes. Goal joints take goal
    /// joints', leg joints take leg joints'.
    pub fn permutation(&self) -> &[usize] {
        &self.permutation
    }

    /// For each joint, in the order of [`Robot::joints`], the sign that the value gets: 1 or −1.
    pub fn signs(&self) -> &[f32] {
        &self.signs
    }

    /// Number of goal joints.
    pub fn goal_joints(&self) -> usize {
        self.goal_joints
    }

    /// Mirrors a vector over all joints, goal joints first.
    ///
    /// # Panics
    /// If `from` or `to` is not one number for each joint.
    pub fn joints(&self, from: &[f32], to: &mut [f32]) {
        self.map(0..self.permutation.len(), from, to);
    }

    /// Mirrors a vector over the goal joints.
    ///
    /// # Panics
    /// If `from` or `to` is not one number for each goal joint.
    pub fn goal(&self, from: &[f32], to: &mut [f32]) {
        self.map(0..self.goal_joints, from, to);
    }

    /// Mirrors a vector over the leg joints: angles or actions.
    ///
    /// # Panics
    /// If `from` or `to` is not one number for each leg joint.
    pub fn legs(&self, from: &[f32], to: &mut [f32]) {
        self.map(self.goal_joints..self.permutation.len(), from, to);
    }

    fn map(&self, part: std::ops::Range<usize>, from: &[f32], to: &mut [f32]) {
        assert_eq!(
            (from.len(), to.len()),
            (part.len(), part.len()),
            "one number for each joint"
        );
        let pairs = self.permutation[part.clone()]
            .iter()
            .zip(&self.signs[part.clone()]);
        for (to, (&joint, sign)) in to.iter_mut().zip(pairs) {
            *to = sign * from[joint - part.start];
        }
    }
}

impl Robot {
    /// The robot's mirror image, read off the model: a joint's partner is the one whose name has `left` for `right`
    /// or the other way round, in any case of letters (a joint without either is its own), and the sign follows from the two axes.
    ///
    /// # Errors
    /// If a joint has no partner, or partners differ in place, axis, limits or default angle by more than a
    /// thousandth: such a robot has no mirror image.
    pub fn mirror(&self) -> Result<JointMirror, RobotError> {
        let hinges = Hinges::new(self);
        let joints: Vec<_> = self.joints().collect();
        let goal_joints = self.goal_joints().len();
        let (mut permutation, mut signs) = (Vec::new(), Vec::new());
        for (i, joint) in joints.iter().enumerate() {
            let name = partner(&joint.name);
            let fault = |expected: String, found: String| {
                RobotError::value(
                    self.config_file(),
                    format!("joints: {:?}", joint.name),
                    expected,
                    found,
                )
            };
            let other = joints
                .iter()
                .position(|joint| joint.name == name)
                .filter(|&other| (other < goal_joints) == (i < goal_joints))
                .ok_or_else(|| fault(format!("a partner named {name:?}"), "none".to_owned()))?;
            let sign = hinges.sign(i, other).ok_or_else(|| {
                fault(
                    format!("the place and the axis of {name:?} in the mirror"),
                    format!("{:?} and {:?}", hinges.0[i], hinges.0[other]),
                )
            })?;
            let numbers = |joint: &crate::Joint| [joint.range[0], joint.range[1], joint.default];
            let [lower, upper, default] = numbers(joints[other]).map(|value| sign * value);
            let mirrored = [lower.min(upper), lower.max(upper), default];
            if differ(mirrored, numbers(joint)) {
                return Err(fault(
                    format!(
                        "lower limit, upper limit and default angle {mirrored:?}, as of {name:?} in the mirror"
                    ),
                    format!("{:?}", numbers(joint)),
                ));
            }
            permutation.push(other);
            signs.push(sign as f32);
        }
        Ok(JointMirror {
            permutation,
            signs,
            goal_joints,
        })
    }
}

/// Anchor and unit axis of each joint in the base's frame, all joints at zero.
struct Hinges(Vec<[Vector3<f64>; 2]>);

impl Hinges {
    fn new(robot: &Robot) -> Self {
        let model = robot.model();
        let mut data = model.make_data();
        let qpos = data.qpos_mut();
        qpos.fill(0.0);
        qpos[3] = 1.0;
        data.kinematics();
        let ids = robot
            .joints()
            .filter_map(|joint| model.name_to_id(MjtObjBase::mjOBJ_JOINT, &joint.name));
        Self(
            ids.map(|id| [data.xanchor()[id], data.xaxis()[id]].map(Vector3::from))
                .collect(),
        )
    }

    /// The sign that `other`'s angle gets when `joint` takes it, if the two are mirror images.
    ///
    /// A mirror turns a rotation by q about axis a into one by −q about the reflected axis.
    fn sign(&self, joint: usize, other: usize) -> Option<f64> {
        let reflect = |v: Vector3<f64>| Vector3::new(v.x, -v.y, v.z);
        let [[anchor, axis], [other_anchor, other_axis]] = [self.0[joint], self.0[other]];
        let cosine = -axis.dot(&reflect(other_axis));
        let off_axis = (anchor - reflect(other_anchor)).cross(&axis).norm();
        (cosine.abs() > 1.0 - TOLERANCE && off_axis < TOLERANCE).then(|| cosine.signum())
    }
}

/// The joint's name on the other side: the first of these words that it has is exchanged.
fn partner(name: &str) -> String {
    const SIDES: [[&str; 2]; 3] = [["left", "right"], ["Left", "Right"], ["LEFT", "RIGHT"]];
    let exchanged = SIDES.into_iter().find_map(|[left, right]| {
        if name.contains(left) {
            Some(name.replace(left, right))
        } else {
            name.contains(right).then(|| name.replace(right, left))
        }
    });
    exchanged.unwrap_or_else(|| name.to_owned())
}

fn differ(a: [f64; 3], b: [f64; 3]) -> bool {
    a.iter().zip(b).any(|(a, b)| (a - b).abs() > TOLERANCE)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    fn outputs(robot: &Robot, q: &[f32]) -> Vec<f32> {
        let mut row = vec![0.0; robot.kinematics().output_width()];
        robot.kinematics().forward(q, &mut row);
        row
    }

    fn robots() -> Vec<Robot> {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots");
        let load = |folder: &std::path::PathBuf| match Robot::load(folder) {
            Ok(robot) => Some(robot),
            Err(error @ RobotError::NotFetched { .. }) => {
                println!("skipped: {error}");
                None
            }
            Err(error) => panic!("{error}"),
        };
        crate::robot_folders(&folder)
            .expect("robots/ can be read")
            .iter()
            .filter_map(load)
            .collect()
    }

    /// A pose within the limits that differs in every joint.
    fn pose(robot: &Robot) -> Vec<f32> {
        let share = |i: usize| 0.3 + 0.4 * ((i as f64 * 0.61).fract());
        robot
            .joints()
            .enumerate()
            .map(|(i, joint)| {
                (joint.range[0] + share(i) * (joint.range[1] - joint.range[0])) as f32
            })
            .collect()
    }

    #[test]
    fn key_nodes_of_the_mirrored_pose_are_the_mirrored_key_nodes() {
        for robot in robots() {
            let mirror = robot.mirror().unwrap();
            let q = pose(&robot);
            let mut mirrored = vec![0.0; q.len()];
            mirror.joints(&q, &mut mirrored);
            let (row, image) = (outputs(&robot, &q), outputs(&robot, &mirrored));
            // Waist, torso, then left and right in turn.
            for (node, other) in [0, 1, 3, 2, 5, 4, 7, 6].into_iter().enumerate() {
                for (axis, sign) in [1.0, -1.0, 1.0].into_iter().enumerate() {
                    let (a, b) = (image[3 * node + axis], sign * row[3 * other + axis]);
                    assert!(
                        (a - b).abs() < 2e-3,
                        "{}: node {node}: {a} and {b}",
                        robot.name()
                    );
                }
            }
            let feet = robot.kinematics().layout().foot_support.clone();
            assert!((image[feet.start + 1] + row[feet.start + 1]).abs() < 2e-3);
            assert!((image[feet.start + 2] - row[feet.start + 2]).abs() < 2e-3);
        }
    }

    #[test]
    fn twice_in_the_mirror_is_the_pose_itself_and_inside_the_limits() {
        for robot in robots() {
            let mirror = robot.mirror().unwrap();
            let q = pose(&robot);
            let (mut once, mut twice) = (vec![0.0; q.len()], vec![0.0; q.len()]);
            mirror.joints(&q, &mut once);
            mirror.joints(&once, &mut twice);
            assert_eq!(q, twice);
            for (angle, joint) in once.iter().zip(robot.joints()) {
                assert!(
                    (joint.range[0] - 1e-3..=joint.range[1] + 1e-3).contains(&f64::from(*angle))
                );
            }
            let goals = robot.goal_joints().len();
            let (mut goal, mut legs) = (vec![0.0; goals], vec![0.0; q.len() - goals]);
            mirror.goal(&q[..goals], &mut goal);
            mirror.legs(&q[goals..], &mut legs);
            assert_eq!([goal, legs].concat(), once);
        }
    }

    #[test]
    fn signs_are_those_of_a_body() {
        for robot in robots() {
            let mirror = robot.mirror().unwrap();
            for (joint, sign) in robot.joints().zip(mirror.signs()) {
                let turns_in_the_plane = ["pitch", "elbow", "knee"]
                    .iter()
                    .any(|part| joint.name.contains(part));
                let expected = if turns_in_the_plane { 1.0 } else { -1.0 };
                assert_eq!(*sign, expected, "{}: {}", robot.name(), joint.name);
            }
        }
    }
}
