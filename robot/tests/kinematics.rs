//! The kinematics against MuJoCo, against finite differences, and against themselves.

mod common;

use emp_robot::{KEY_NODE_NAMES, Kinematics, Robot};
use mujoco_rs::prelude::*;
use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};
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
            let body = self.body(&data, &robot.key_nodes()[6 + side].body);
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
        let [left, right] = robot.feet().each_ref().map(|foot| {
            let bottoms = foot
                .centers
                .iter()
                .map(|&[x, y, z]| point(&foot.body, [x, y, z - foot.radius]));
            bottoms.sum::<Vector3<f64>>() / foot.centers.len() as f64
        });
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
