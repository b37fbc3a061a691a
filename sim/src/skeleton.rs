//! Where the limbs of a robot are, given its joint angles: for pictures and for comparing it with a person.

use emp_robot::{FrameKinematics, KEY_NODES, Robot};
use mujoco_rs::prelude::*;
use nalgebra::{Matrix3, Vector3};

use crate::SimError;
use crate::collision::geom_id;

/// MuJoCo's kinematics of one robot, without physics.
pub struct Skeleton {
    data: MjData<Box<MjModel>>,
    /// Indices of each joint's angle in `qpos`, goal joints first.
    positions: Vec<usize>,
    goals: usize,
    kinematics: FrameKinematics,
    legs: [Leg; 2],
}

/// Points of a robot in the frame of its base, metres.
#[derive(Clone, Debug)]
pub struct SkeletonPose {
    /// Positions of the key nodes, in the order of [`emp_robot::KEY_NODE_NAMES`].
    pub key_nodes: [Vector3<f64>; KEY_NODES],
    /// Rotations of the wrists, left and right: columns x from wrist to fingers, z toward the thumb, y = z × x.
    pub wrist_rotations: [Matrix3<f64>; 2],
    /// Points along the left and the right leg, from the pelvis down: its joints, then heel and toes.
    pub legs: [Vec<Vector3<f64>>; 2],
    /// Centres of the spheres with which the left and the right foot touch the floor.
    pub soles: [Vec<Vector3<f64>>; 2],
}

impl Skeleton {
    /// For `robot`.
    ///
    /// # Errors
    /// If MuJoCo has no memory for it.
    pub fn new(robot: &Robot) -> Result<Self, SimError> {
        let model = Box::new(robot.model());
        let legs = [Leg::new(robot, &model, 0)?, Leg::new(robot, &model, 1)?];
        Ok(Self {
            data: MjData::try_new(model)?,
            positions: robot.joints().map(|joint| joint.qpos_address).collect(),
            goals: robot.goal_joints().len(),
            kinematics: robot.kinematics().frame(),
            legs,
        })
    }

    /// The robot with its joints at these angles (goal joints first, rad).
    ///
    /// # Panics
    /// If there is not one angle for each joint.
    pub fn pose(&mut self, joint_positions: &[f32]) -> SkeletonPose {
        assert_eq!(
            joint_positions.len(),
            self.positions.len(),
            "joint positions"
        );
        let qpos = self.data.qpos_mut();
        qpos[..7].copy_from_slice(&[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]);
        for (&address, &angle) in self.positions.iter().zip(joint_positions) {
            qpos[address] = f64::from(angle);
        }
        self.data.kinematics();
        let goal: Vec<f64> = joint_positions[..self.goals]
            .iter()
            .map(|&angle| f64::from(angle))
            .collect();
        self.kinematics.update(&goal);
        SkeletonPose {
            key_nodes: *self.kinematics.positions(),
            wrist_rotations: *self.kinematics.wrist_rotations(),
            legs: [0, 1].map(|side: usize| self.legs[side].points(&self.data)),
            soles: [0, 1].map(|side: usize| self.legs[side].soles(&self.data)),
        }
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
    fn new(robot: &Robot, model: &MjModel, side: usize) -> Result<Self, SimError> {
        let foot = &robot.feet()[side];
        let id = model.name_to_id(MjtObjBase::mjOBJ_BODY, &foot.body);
        let mut body = id.ok_or_else(|| SimError::MissingBody {
            body: foot.body.clone(),
        })?;
        let mut joints = Vec::new();
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
            sole[usize::from(center[0] > middle)].push(geom_id(model, name)?);
        }
        Ok(Self { joints, sole })
    }

    /// The points as MuJoCo placed them last.
    fn points(&self, data: &MjData<Box<MjModel>>) -> Vec<Vector3<f64>> {
        let joints = self
            .joints
            .iter()
            .map(|&joint| Vector3::from(data.xanchor()[joint]));
        let ends = self.sole.iter().filter(|geoms| !geoms.is_empty());
        let ends = ends.map(|geoms| {
            let sum: Vector3<f64> = geoms.iter().map(|&geom| geom_position(data, geom)).sum();
            sum / geoms.len() as f64
        });
        joints.chain(ends).collect()
    }

    fn soles(&self, data: &MjData<Box<MjModel>>) -> Vec<Vector3<f64>> {
        let geoms = self.sole.iter().flatten();
        geoms.map(|&geom| geom_position(data, geom)).collect()
    }
}

fn geom_position(data: &MjData<Box<MjModel>>, geom: usize) -> Vector3<f64> {
    Vector3::from(data.geom_xpos()[geom])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::for_each_robot;
    use crate::{BodyParameters, Stage, Start};

    #[test]
    fn legs_run_from_the_hip_down_to_the_toes() {
        for_each_robot(|robot| {
            let angles: Vec<f32> = robot.default_pose();
            let pose = Skeleton::new(robot).unwrap().pose(&angles);
            for (leg, side) in pose.legs.iter().zip([1.0, -1.0]) {
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
    fn soles_are_where_the_physics_has_them() {
        for_each_robot(|robot| {
            let angles: Vec<f64> = robot.joints().map(|joint| joint.default).collect();
            let body = Stage::new(robot).unwrap().place(&Start {
                joint_positions: &angles,
                lift: 0.0,
                parameters: BodyParameters::default(),
            });
            let reading = body.reading();
            let pose = Skeleton::new(robot).unwrap().pose(&reading.joint_positions);
            for (foot, (points, measured)) in robot
                .feet()
                .iter()
                .zip(pose.soles.iter().zip(&reading.feet))
            {
                assert_eq!(points.len(), foot.centers.len());
                let mut corners = [
                    Vector3::repeat(f64::INFINITY),
                    Vector3::repeat(-f64::INFINITY),
                ];
                for point in points {
                    let point = reading.orientation * point + reading.position;
                    corners = [corners[0].inf(&point), corners[1].sup(&point)];
                }
                let middle = (corners[0] + corners[1]) / 2.0 - foot.radius * Vector3::z();
                // g1's soles are not quite level.
                assert!(
                    (middle - measured.position).norm() < 1e-3,
                    "{}: {middle}",
                    robot.name()
                );
            }
        });
    }
}
