//! The goal joints as a graph, for networks that work on it.

use mujoco_rs::prelude::*;
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};

use crate::joint::GoalNode;

/// The first `count` columns of a joint vector as a graph; `columns[joint id]` is a joint's column.
pub(crate) fn build(
    model: &MjModel,
    base: usize,
    columns: &[usize],
    count: usize,
) -> Vec<GoalNode> {
    let frames = Frames::new(model, base);
    (0..count)
        .filter_map(|column| frames.node(columns, column))
        .collect()
}

/// Frames of bodies and joints in the pose where every joint is zero.
struct Frames<'a> {
    model: &'a MjModel,
    data: MjData<&'a MjModel>,
    base: usize,
}

impl<'a> Frames<'a> {
    fn new(model: &'a MjModel, base: usize) -> Self {
        let mut data = model.make_data();
        let qpos = data.qpos_mut();
        qpos.fill(0.0);
        qpos[3] = 1.0;
        data.kinematics();
        Self { model, data, base }
    }

    fn node(&self, columns: &[usize], column: usize) -> Option<GoalNode> {
        let joint = columns.iter().position(|&c| c == column)?;
        let parent = self.parent(joint);
        let frame = parent.map_or_else(Isometry3::identity, |parent| self.joint(parent));
        let origin = frame.inv_mul(&self.joint(joint));
        let (roll, pitch, yaw) = origin.rotation.euler_angles();
        Some(GoalNode {
            parent: parent.map(|parent| columns[parent]),
            origin_xyz: origin.translation.vector.into(),
            origin_rpy: [roll, pitch, yaw],
            axis: Vector3::from(self.model.jnt_axis()[joint])
                .normalize()
                .into(),
        })
    }

    /// The joint that carries `joint`, none if the base does.
    fn parent(&self, joint: usize) -> Option<usize> {
        let model = self.model;
        let mut body = model.jnt_bodyid()[joint] as usize;
        if model.body_jntadr()[body] as usize != joint {
            return Some(joint - 1);
        }
        loop {
            body = model.body_parentid()[body] as usize;
            if body == self.base || body == 0 {
                return None;
            }
            let joints = model.body_jntnum()[body] as usize;
            if joints > 0 {
                return Some(model.body_jntadr()[body] as usize + joints - 1);
            }
        }
    }

    /// A joint's frame: its body's orientation, at the joint's anchor.
    fn joint(&self, joint: usize) -> Isometry3<f64> {
        let [w, x, y, z] = self.data.xquat()[self.model.jnt_bodyid()[joint] as usize];
        let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
        Isometry3::from_parts(Translation3::from(self.data.xanchor()[joint]), rotation)
    }
}
