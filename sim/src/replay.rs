//! Joint targets played on a robot whose pelvis is held.

use emp_robot::{FrameKinematics, Joint, KEY_NODES, Robot};
use mujoco_rs::prelude::*;
use nalgebra::{Matrix3, Vector3};

use crate::collision::ContactPairs;
use crate::{Divergence, SimError};

/// The base hangs this far above its standing height, metres: the floor is out of reach.
const LIFT: f64 = 1.0;

/// Armature that holds the base, kg and kg·m²: some 10⁷ times the robot's own inertia, so that neither gravity nor the
/// arms' reactions move it by more than a micrometre between the frames at which it is put back.
const HOLDING_ARMATURE: f64 = 1e9;

/// Share of its torque limit from which an actuator counts as saturated.
const SATURATED: f64 = 0.999;

/// Numbers of the base's position and orientation in `qpos`, and of its velocity in `qvel`.
const BASE_POSITION: usize = 7;
const BASE_VELOCITY: usize = 6;

/// What the robot did.
#[derive(Clone, Debug)]
pub struct Replay {
    /// One for each frame of targets, at the end of its control period.
    pub frames: Vec<ReplayFrame>,
    /// Share of goal actuators and physics steps at the torque limit.
    pub saturated_share: f64,
}

/// The robot at the end of one control period, in its pelvis frame.
#[derive(Clone, Debug)]
pub struct ReplayFrame {
    /// Angles of the goal joints, radians.
    pub angles: Vec<f64>,
    /// Positions of the key nodes, in the order of [`emp_robot::KEY_NODE_NAMES`], metres.
    pub key_nodes: [Vector3<f64>; KEY_NODES],
    /// Rotations of the wrists, left and right: columns x from wrist to fingers, z toward the thumb, y = z × x.
    pub wrist_rotations: [Matrix3<f64>; 2],
    /// Points along the left and the right leg, from the pelvis down: its joints, then heel and toes, metres.
    pub legs: [Vec<Vector3<f64>>; 2],
    /// Whether two links that may touch did so at any physics step of the period.
    pub self_collision: bool,
}

impl Replay {
    /// Share of frames in which the robot touched itself; 0 of no frames.
    #[must_use]
    pub fn self_collision_share(&self) -> f64 {
        let touching = self
            .frames
            .iter()
            .filter(|frame| frame.self_collision)
            .count();
        touching as f64 / self.frames.len().max(1) as f64
    }
}

/// Plays `targets` (rows of goal-joint angles in radians, one each control period) on the robot in MuJoCo.
///
/// The pelvis is held upright above the floor, the legs are told to keep their default pose, and the robot starts at
/// the first target. Position servos with the robot's gains and torque limits do the rest, under gravity.
///
/// # Errors
/// If a frame is not one finite angle for each goal joint, or if the simulation diverges: the error names the frame.
pub fn replay(robot: &Robot, targets: &[impl AsRef<[f32]>]) -> Result<Replay, SimError> {
    for (frame, angles) in targets.iter().enumerate() {
        check_angles(robot, frame, angles.as_ref())?;
    }
    let mut held = HeldRobot::new(robot)?;
    if let Some(first) = targets.first() {
        held.start(first.as_ref());
    }
    let mut frames = Vec::with_capacity(targets.len());
    for (frame, angles) in targets.iter().enumerate() {
        frames.push(held.play(frame, angles.as_ref())?);
    }
    Ok(Replay {
        saturated_share: held.saturated_share(targets.len()),
        frames,
    })
}

/// Refuses what is not one finite angle for each goal joint.
pub(crate) fn check_angles(robot: &Robot, frame: usize, angles: &[f32]) -> Result<(), SimError> {
    let joints = robot.goal_joints();
    if angles.len() != joints.len() {
        return Err(SimError::Width {
            frame,
            expected: joints.len(),
            found: angles.len(),
        });
    }
    match angles
        .iter()
        .zip(joints)
        .find(|(angle, _)| !angle.is_finite())
    {
        Some((&value, joint)) => Err(SimError::NotFinite {
            frame,
            joint: joint.name.clone(),
            value,
        }),
        None => Ok(()),
    }
}

/// Hangs the robot upright with the goal joints at `angles` and the legs in their default pose, at rest.
pub(crate) fn set_pose(robot: &Robot, data: &mut MjData<Box<MjModel>>, angles: &[f32]) {
    hold_base(robot, data);
    data.qvel_mut().fill(0.0);
    let qpos = data.qpos_mut();
    for (joint, &angle) in robot.goal_joints().iter().zip(angles) {
        qpos[joint.qpos_address] = f64::from(angle);
    }
    for joint in robot.leg_joints() {
        qpos[joint.qpos_address] = joint.default;
    }
}

fn hold_base(robot: &Robot, data: &mut MjData<Box<MjModel>>) {
    let height = robot.standing_height() + LIFT;
    data.qpos_mut()[..BASE_POSITION].copy_from_slice(&[0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0]);
    data.qvel_mut()[..BASE_VELOCITY].fill(0.0);
}

/// A simulation of one robot with its pelvis held.
struct HeldRobot<'a> {
    robot: &'a Robot,
    data: MjData<Box<MjModel>>,
    pairs: ContactPairs,
    kinematics: FrameKinematics,
    legs: [Leg; 2],
    saturated: usize,
}

impl<'a> HeldRobot<'a> {
    fn new(robot: &'a Robot) -> Result<Self, SimError> {
        let mut model = Box::new(robot.model());
        model.dof_armature_mut()[..BASE_VELOCITY].fill(HOLDING_ARMATURE);
        let pairs = ContactPairs::new(robot, &model)?;
        let legs = [0, 1].map(|side| Leg::new(robot, &model, side));
        let mut data = MjData::try_new(model)?;
        data.set_const();
        Ok(Self {
            robot,
            data,
            pairs,
            kinematics: robot.kinematics().frame(),
            legs,
            saturated: 0,
        })
    }

    /// At rest in the pose `angles`.
    fn start(&mut self, angles: &[f32]) {
        set_pose(self.robot, &mut self.data, angles);
        for (control, joint) in self.data.ctrl_mut().iter_mut().zip(self.robot.joints()) {
            *control = joint.default;
        }
    }

    /// One control period with `angles` as the goal joints' targets.
    fn play(&mut self, frame: usize, angles: &[f32]) -> Result<ReplayFrame, SimError> {
        // Actuators stand in the order of joints: goal, then legs.
        for (control, &angle) in self.data.ctrl_mut().iter_mut().zip(angles) {
            *control = f64::from(angle);
        }
        let mut self_collision = false;
        for _ in 0..self.robot.substeps() {
            self.data.step();
            if let Some(reason) = Divergence::warned(self.data.warning(), 0) {
                return Err(SimError::Diverged { frame, reason });
            }
            self_collision |= self.pairs.touch(self.data.contact());
            self.saturated += self.count_saturated();
        }
        hold_base(self.robot, &mut self.data);
        Ok(self.observe(self_collision))
    }

    fn observe(&mut self, self_collision: bool) -> ReplayFrame {
        self.data.kinematics();
        let qpos = self.data.qpos();
        let angles: Vec<f64> = self
            .robot
            .goal_joints()
            .iter()
            .map(|joint| qpos[joint.qpos_address])
            .collect();
        self.kinematics.update(&angles);
        let pelvis = Vector3::new(qpos[0], qpos[1], qpos[2]);
        ReplayFrame {
            angles,
            key_nodes: *self.kinematics.positions(),
            wrist_rotations: *self.kinematics.wrist_rotations(),
            legs: [0, 1].map(|side: usize| self.legs[side].points(&self.data, &pelvis)),
            self_collision,
        }
    }

    fn count_saturated(&self) -> usize {
        let forces = self
            .data
            .actuator_force()
            .iter()
            .zip(self.robot.goal_joints());
        let at_limit =
            |(force, joint): &(&f64, &Joint)| force.abs() >= SATURATED * joint.torque_limit;
        forces.filter(at_limit).count()
    }

    fn saturated_share(&self, frames: usize) -> f64 {
        let all = frames * self.robot.substeps() * self.robot.goal_joints().len();
        self.saturated as f64 / all.max(1) as f64
    }
}

/// Where the points along one leg come from.
struct Leg {
    /// Numbers of the joints from the pelvis down.
    joints: Vec<usize>,
    /// Numbers of the contact spheres at the heel and at the toes.
    sole: [Vec<usize>; 2],
}

impl Leg {
    fn new(robot: &Robot, model: &MjModel, side: usize) -> Self {
        let foot = &robot.feet()[side];
        let mut joints = Vec::new();
        let mut body = model
            .name_to_id(MjtObjBase::mjOBJ_BODY, &foot.body)
            .unwrap_or(0);
        // The pelvis stands directly in the world, body 0.
        while model.body_parentid()[body] != 0 {
            let first = model.body_jntadr()[body].max(0) as usize;
            joints.extend((first..first + model.body_jntnum()[body] as usize).rev());
            body = model.body_parentid()[body] as usize;
        }
        joints.reverse();

        let middle = foot.sole_center()[0];
        let mut sole = [Vec::new(), Vec::new()];
        for (name, center) in foot.geoms.iter().zip(&foot.centers) {
            if let Some(geom) = model.name_to_id(MjtObjBase::mjOBJ_GEOM, name) {
                sole[usize::from(center[0] > middle)].push(geom);
            }
        }
        Self { joints, sole }
    }

    /// The points as MuJoCo placed them last, relative to the pelvis, which stands upright.
    fn points(&self, data: &MjData<Box<MjModel>>, pelvis: &Vector3<f64>) -> Vec<Vector3<f64>> {
        let joints = self
            .joints
            .iter()
            .map(|&joint| Vector3::from(data.xanchor()[joint]));
        let soles = self
            .sole
            .iter()
            .filter(|geoms| !geoms.is_empty())
            .map(|geoms| {
                let sum: Vector3<f64> = geoms
                    .iter()
                    .map(|&geom| Vector3::from(data.geom_xpos()[geom]))
                    .sum();
                sum / geoms.len() as f64
            });
        joints.chain(soles).map(|point| point - pelvis).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{for_each_robot, pose};

    #[test]
    fn a_pose_that_is_asked_for_is_held_against_gravity() {
        for_each_robot(|robot| {
            let targets = vec![pose(robot, &[]); 100];
            let replay = replay(robot, &targets).unwrap();
            assert_eq!(replay.frames.len(), targets.len());
            assert_eq!(replay.self_collision_share(), 0.0);
            assert_eq!(replay.saturated_share, 0.0);
            let last = &replay.frames[99];
            let mut kinematics = robot.kinematics().frame();
            kinematics.update(
                &targets[0]
                    .iter()
                    .map(|&angle| f64::from(angle))
                    .collect::<Vec<_>>(),
            );
            for (node, (reached, asked)) in last
                .key_nodes
                .iter()
                .zip(kinematics.positions())
                .enumerate()
            {
                let sag = (reached - asked).norm();
                assert!(
                    sag < 0.05,
                    "{}: {} sags by {sag} m",
                    robot.name(),
                    emp_robot::KEY_NODE_NAMES[node]
                );
            }
            let still: f64 = last
                .angles
                .iter()
                .zip(&replay.frames[98].angles)
                .map(|(a, b)| (a - b).abs())
                .sum();
            assert!(
                still < 1e-3,
                "{}: still moves by {still} rad a frame",
                robot.name()
            );
        });
    }

    #[test]
    fn a_slow_swing_is_followed() {
        for_each_robot(|robot| {
            let swing = |frame: usize| (0.5 * (frame as f64 / 25.0).sin()) as f32;
            let targets: Vec<Vec<f32>> = (0..200)
                .map(|frame| {
                    let mut angles = pose(robot, &[]);
                    for (angle, joint) in angles.iter_mut().zip(robot.goal_joints()) {
                        *angle = (*angle + swing(frame))
                            .clamp(joint.range[0] as f32, joint.range[1] as f32);
                    }
                    angles
                })
                .collect();
            for (target, frame) in targets.iter().zip(&replay(robot, &targets).unwrap().frames) {
                for ((angle, asked), joint) in
                    frame.angles.iter().zip(target).zip(robot.goal_joints())
                {
                    let error = (angle - f64::from(*asked)).abs();
                    assert!(
                        error < 0.3,
                        "{}: {} is {error} rad behind",
                        robot.name(),
                        joint.name
                    );
                }
            }
        });
    }

    #[test]
    fn a_sudden_step_meets_the_torque_limit_and_moves_the_pelvis_nowhere() {
        for_each_robot(|robot| {
            let rest = pose(robot, &[]);
            let far: Vec<f32> = robot
                .goal_joints()
                .iter()
                .map(|joint| 0.8 * joint.range[1] as f32)
                .collect();
            let targets = [rest.clone(), far.clone(), rest, far];
            assert!(replay(robot, &targets).unwrap().saturated_share > 0.1);

            let mut held = HeldRobot::new(robot).unwrap();
            held.start(&targets[0]);
            for target in &targets {
                held.data.ctrl_mut()[..target.len()]
                    .copy_from_slice(&target.iter().map(|&a| f64::from(a)).collect::<Vec<_>>());
                for _ in 0..robot.substeps() {
                    held.data.step();
                }
            }
            let height = robot.standing_height() + LIFT;
            let qpos = held.data.qpos();
            let moved =
                (Vector3::new(qpos[0], qpos[1], qpos[2]) - Vector3::new(0.0, 0.0, height)).norm();
            assert!(
                moved < 1e-6,
                "{}: the pelvis moved by {moved} m",
                robot.name()
            );
        });
    }

    #[test]
    fn legs_run_from_the_hip_down_to_the_toes() {
        for_each_robot(|robot| {
            let replay = replay(robot, &[pose(robot, &[])]).unwrap();
            for (leg, side) in replay.frames[0].legs.iter().zip([1.0, -1.0]) {
                let [hip, .., heel, toes] = leg.as_slice() else {
                    panic!("{}: {leg:?}", robot.name())
                };
                assert!(
                    side * hip.y > 0.03 && side * toes.y > 0.03,
                    "{}: {leg:?}",
                    robot.name()
                );
                assert!(
                    hip.z - heel.z > 0.5 * robot.standing_height(),
                    "{}: {leg:?}",
                    robot.name()
                );
                assert!(toes.x - heel.x > 0.08, "{}: {leg:?}", robot.name());
            }
        });
    }

    #[test]
    fn the_same_targets_give_the_same_bits() {
        for_each_robot(|robot| {
            let targets: Vec<Vec<f32>> = (0..20)
                .map(|frame| pose(robot, &[("elbow", -0.02 * frame as f32)]))
                .collect();
            let [first, second] = [0, 1].map(|_| replay(robot, &targets).unwrap());
            for (a, b) in first.frames.iter().zip(&second.frames) {
                assert_eq!(a.angles, b.angles);
            }
        });
    }

    #[test]
    fn bad_targets_are_refused_by_frame_and_joint() {
        for_each_robot(|robot| {
            let good = pose(robot, &[]);
            let mut bad = good.clone();
            bad[3] = f32::NAN;
            let error = replay(robot, &[good.clone(), bad]).unwrap_err().to_string();
            assert!(
                error.contains("frame 1") && error.contains(&robot.goal_joints()[3].name),
                "{error}"
            );
            let error = replay(robot, &[good.clone(), good.clone(), vec![0.0; 3]])
                .unwrap_err()
                .to_string();
            assert!(
                error.contains("frame 2") && error.contains("found 3"),
                "{error}"
            );
            assert!(replay(robot, &[] as &[Vec<f32>]).unwrap().frames.is_empty());
        });
    }

    #[test]
    fn a_diverged_simulation_is_an_error_with_its_frame() {
        for_each_robot(|robot| {
            let rest = pose(robot, &[]);
            let mut held = HeldRobot::new(robot).unwrap();
            held.start(&rest);
            held.play(0, &rest).unwrap();
            held.data.qvel_mut()[10] = f64::NAN;
            let error = held.play(1, &rest).unwrap_err().to_string();
            assert!(
                error.contains("frame 1") && error.contains("velocity"),
                "{error}"
            );
        });
    }
}
