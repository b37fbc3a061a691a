//! Where in a robot's model everything is that stages write and read.

use std::sync::Arc;

use emp_robot::Robot;
use mujoco_rs::prelude::*;
use nalgebra::Vector3;

use super::fields::ModelFields;
use crate::SimError;
use crate::collision::{ContactPairs, geom_id};

/// What all stages of one robot share.
#[derive(Debug)]
pub(crate) struct Rig {
    /// Indices of each joint's angle in `qpos`, goal joints first.
    pub(crate) positions: Vec<usize>,
    /// Indices of each joint's speed in `qvel`, goal joints first.
    pub(crate) velocities: Vec<usize>,
    /// Body of the floating base.
    pub(crate) base: usize,
    /// Bodies that turn with the hands, left and right.
    pub(crate) hands: [usize; 2],
    /// The feet, left and right.
    pub(crate) feet: [FootRig; 2],
    /// Geoms that touch themselves.
    pub(crate) pairs: ContactPairs,
    /// Physics steps in one control period.
    pub(crate) substeps: usize,
    /// The fields of the model as the robot's files describe it.
    pub(crate) nominal: Arc<ModelFields>,
}

/// One foot in the model.
#[derive(Debug)]
pub(crate) struct FootRig {
    pub(crate) body: usize,
    /// Its contact spheres.
    pub(crate) geoms: Vec<usize>,
    /// Their radius, metres.
    pub(crate) radius: f64,
    /// Centre of the sole in the body's frame, metres.
    pub(crate) sole: Vector3<f64>,
}

impl Rig {
    /// For `model`, which is the robot's.
    pub(crate) fn new(robot: &Robot, model: &MjModel) -> Result<Self, SimError> {
        let body = |name: &str| {
            let id = model.name_to_id(MjtObjBase::mjOBJ_BODY, name);
            id.ok_or_else(|| SimError::MissingBody {
                body: name.to_owned(),
            })
        };
        let foot = |index: usize| {
            let foot = &robot.feet()[index];
            let geoms = foot.geoms.iter().map(|name| geom_id(model, name));
            Ok::<_, SimError>(FootRig {
                body: body(&foot.body)?,
                geoms: geoms.collect::<Result<_, _>>()?,
                radius: foot.radius,
                sole: Vector3::from(foot.sole_center()),
            })
        };
        let [left, right] = robot.hand_bodies();
        Ok(Self {
            positions: robot.joints().map(|joint| joint.qpos_address).collect(),
            velocities: robot.joints().map(|joint| joint.dof_address).collect(),
            base: body(robot.base_body())?,
            hands: [body(left)?, body(right)?],
            feet: [foot(0)?, foot(1)?],
            pairs: ContactPairs::new(robot, model)?,
            substeps: robot.substeps(),
            nominal: Arc::new(ModelFields::read(model)),
        })
    }

    /// The foot that a geom belongs to.
    pub(crate) fn foot_of(&self, geom: i32) -> Option<usize> {
        let has = |foot: &FootRig| foot.geoms.iter().any(|&of_foot| of_foot as i32 == geom);
        self.feet.iter().position(has)
    }
}
