//! Contacts of a robot with itself.

use std::collections::HashSet;

use emp_robot::Robot;
use mujoco_rs::prelude::*;
use mujoco_rs::wrappers::mj_auxiliary::MjContact;

use crate::SimError;

/// The base hangs this far above its standing height, metres: the floor is out of reach.
const LIFT: f64 = 1.0;

/// The pairs of geoms whose contact is a self-collision, by their numbers in a model, the smaller first.
#[derive(Debug)]
pub(crate) struct ContactPairs(HashSet<[i32; 2]>);

impl ContactPairs {
    pub(crate) fn new(robot: &Robot, model: &MjModel) -> Result<Self, SimError> {
        let id = |geom: &String| geom_id(model, geom).map(|id| id as i32);
        let pairs = robot.contact_pairs().iter();
        let pairs = pairs.map(|[first, second]| Ok(ordered([id(first)?, id(second)?])));
        Ok(Self(pairs.collect::<Result<_, SimError>>()?))
    }

    /// Whether one of the pairs touches, by the contacts that MuJoCo found last.
    pub(crate) fn touch(&self, contacts: &[MjContact]) -> bool {
        contacts
            .iter()
            .any(|contact| self.touching(contact).is_some())
    }

    /// The pair that touches here, the smaller number first, if one does.
    pub(crate) fn touching(&self, contact: &MjContact) -> Option<[i32; 2]> {
        let pair = (contact.dist <= 0.0).then(|| ordered(contact.geom))?;
        self.0.contains(&pair).then_some(pair)
    }
}

fn ordered([first, second]: [i32; 2]) -> [i32; 2] {
    [first.min(second), first.max(second)]
}

/// Number of a geom of the compiled model.
pub(crate) fn geom_id(model: &MjModel, name: &str) -> Result<usize, SimError> {
    let id = model.name_to_id(MjtObjBase::mjOBJ_GEOM, name);
    id.ok_or_else(|| SimError::MissingGeom {
        geom: name.to_owned(),
    })
}

/// Tells whether poses of the goal joints touch themselves: geometry alone, legs in their default pose.
pub struct SelfCollision<'a> {
    robot: &'a Robot,
    data: MjData<Box<MjModel>>,
    pairs: ContactPairs,
}

impl<'a> SelfCollision<'a> {
    /// For the robot's collision pairs.
    ///
    /// # Errors
    /// If MuJoCo has no memory for it.
    pub fn new(robot: &'a Robot) -> Result<Self, SimError> {
        let model = Box::new(robot.model());
        let pairs = ContactPairs::new(robot, &model)?;
        Ok(Self {
            robot,
            data: MjData::try_new(model)?,
            pairs,
        })
    }

    /// Whether the pose `angles` (goal order, radians) touches itself.
    ///
    /// # Errors
    /// If it is not one finite angle for each goal joint; the error calls the pose frame 0.
    pub fn touches(&mut self, angles: &[f32]) -> Result<bool, SimError> {
        check_angles(self.robot, 0, angles)?;
        self.place(angles);
        self.data.kinematics();
        self.data.collision();
        Ok(self.pairs.touch(self.data.contact()))
    }

    /// Share of the frames (rows of goal-joint angles, radians) that touch themselves; 0 of no frames.
    ///
    /// # Errors
    /// If a frame is not one finite angle for each goal joint.
    pub fn share(&mut self, frames: &[impl AsRef<[f32]>]) -> Result<f64, SimError> {
        let mut touching = 0_usize;
        for (frame, angles) in frames.iter().enumerate() {
            check_angles(self.robot, frame, angles.as_ref())?;
            touching += usize::from(self.touches(angles.as_ref())?);
        }
        Ok(touching as f64 / frames.len().max(1) as f64)
    }

    /// Hangs the robot upright above the floor with the goal joints at `angles` and the legs in their default pose.
    fn place(&mut self, angles: &[f32]) {
        let height = self.robot.standing_height() + LIFT;
        let qpos = self.data.qpos_mut();
        qpos[..7].copy_from_slice(&[0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0]);
        for (joint, &angle) in self.robot.goal_joints().iter().zip(angles) {
            qpos[joint.qpos_address] = f64::from(angle);
        }
        for joint in self.robot.leg_joints() {
            qpos[joint.qpos_address] = joint.default;
        }
    }
}

/// Refuses what is not one finite angle for each goal joint.
fn check_angles(robot: &Robot, frame: usize, angles: &[f32]) -> Result<(), SimError> {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{for_each_robot, pose};
    use crate::{BodyParameters, Stage, Start, Targets};

    /// Both arms hang straight down and are pressed against the thighs or each other.
    fn pressed(robot: &Robot) -> Vec<f32> {
        let arms = [
            ("left_shoulder_roll", -0.4),
            ("right_shoulder_roll", 0.4),
            ("elbow", if robot.name() == "g1" { 1.5 } else { 0.0 }),
            ("shoulder_pitch", 0.0),
        ];
        pose(robot, &arms)
    }

    #[test]
    fn hands_on_the_body_touch_and_hanging_arms_do_not() {
        for_each_robot(|robot| {
            let mut collision = SelfCollision::new(robot).unwrap();
            let (free, pressed) = (pose(robot, &[]), pressed(robot));
            assert!(!collision.touches(&free).unwrap(), "{}", robot.name());
            assert!(collision.touches(&pressed).unwrap(), "{}", robot.name());
            assert_eq!(
                collision.share(&[&free, &pressed, &free, &free]).unwrap(),
                0.25,
                "{}",
                robot.name()
            );
            assert_eq!(collision.share(&[] as &[Vec<f32>]).unwrap(), 0.0);
        });
    }

    #[test]
    fn physics_reports_the_contact_that_geometry_sees() {
        for_each_robot(|robot| {
            let goal = pressed(robot);
            let legs: Vec<f32> = robot.default_legs();
            let angles: Vec<f64> = goal.iter().chain(&legs).map(|&a| f64::from(a)).collect();
            let mut stage = Stage::new(robot).unwrap();
            let mut body = stage.place(&Start {
                joint_positions: &angles,
                lift: 0.0,
                parameters: BodyParameters::default(),
            });
            let targets = Targets {
                goal: &goal,
                legs: &legs,
            };
            let touched = (0..10).filter(|_| stage.step(&mut body, &targets).self_contact.touched);
            // The contact pushes the hands off, the servos press them on again.
            assert!(touched.count() >= 5, "{}", robot.name());
        });
    }

    /// Arms that hang, those of these sides turned inward by `roll` (rad).
    fn inward(robot: &Robot, sides: &[&str], roll: f32) -> Vec<f32> {
        let angles = [
            ("left_shoulder_roll", -roll),
            ("right_shoulder_roll", roll),
            ("elbow", 0.0),
            ("shoulder_pitch", 0.0),
        ];
        let (hanging, pressed) = (pose(robot, &[]), pose(robot, &angles));
        let joints = robot.goal_joints().iter().zip(hanging.iter().zip(&pressed));
        joints
            .map(|(joint, (&hanging, &pressed))| {
                let is_pressed = sides.iter().any(|side| joint.name.starts_with(side));
                if is_pressed { pressed } else { hanging }
            })
            .collect()
    }

    /// Mean contact force over some control periods in a pose, N.
    fn force(robot: &Robot, goal: &[f32]) -> f64 {
        let legs = robot.leg_joints().iter().map(|joint| joint.default as f32);
        let legs: Vec<f32> = legs.collect();
        let angles: Vec<f64> = goal.iter().chain(&legs).map(|&a| f64::from(a)).collect();
        let mut stage = Stage::new(robot).unwrap();
        let mut body = stage.place(&Start {
            joint_positions: &angles,
            lift: 0.0,
            parameters: BodyParameters::default(),
        });
        let targets = Targets { goal, legs: &legs };
        let forces = (0..10).map(|_| stage.step(&mut body, &targets).self_contact.force);
        forces.sum::<f64>() / 10.0
    }

    #[test]
    fn two_hands_that_press_from_both_sides_do_not_cancel() {
        let robot = crate::testing::emp27();
        let mut collision = SelfCollision::new(&robot).unwrap();
        // As far as the hands just press on the thighs.
        let mut rolls = (0..40).map(|step| 0.01 * step as f32);
        let roll = rolls.find(|&roll| {
            let goal = inward(&robot, &["left"], roll);
            collision.touches(&goal).unwrap()
        });
        let roll = roll.unwrap() + 0.02;
        let [left, right, both] = [&["left"][..], &["right"], &["left", "right"]]
            .map(|sides| force(&robot, &inward(&robot, sides, roll)));
        assert!(left > 5.0 && right > 5.0, "{left} {right} at {roll}");
        // As vectors the two would add up to nearly nothing.
        let sum = left + right;
        assert!((both / sum - 1.0).abs() < 0.1, "{both}, {left} + {right}");
        assert_eq!(force(&robot, &inward(&robot, &[], roll)), 0.0);
    }

    #[test]
    fn bad_poses_are_refused() {
        for_each_robot(|robot| {
            let mut collision = SelfCollision::new(robot).unwrap();
            assert!(collision.touches(&[0.0; 2]).is_err());
            let mut nan = pose(robot, &[]);
            nan[0] = f32::NAN;
            let error = collision
                .share(&[pose(robot, &[]), nan])
                .unwrap_err()
                .to_string();
            assert!(error.contains("frame 1"), "{error}");
        });
    }
}
