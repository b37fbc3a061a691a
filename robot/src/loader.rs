//! `robot.toml` against the compiled model: everything it names has to be there and to fit.

use mujoco_rs::prelude::*;
use nalgebra::{Matrix3, Vector3};

use crate::RobotError;
use crate::config::{Config, JointConfig, WristConfig};
use crate::foot::Foot;
use crate::joint::Joint;
use crate::key_nodes::{KEY_NODE_NAMES, KEY_NODES};
use crate::kinematics::Attached;
use crate::model::Files;

/// The joints of `robot.toml`, found in the model.
pub(crate) struct Joints {
    pub(crate) goal: Vec<Joint>,
    pub(crate) leg: Vec<Joint>,
    /// Column in a joint vector of each joint id; the base's free joint has none.
    pub(crate) columns: Vec<usize>,
}

/// What `robot.toml` names, found in the model.
pub(crate) struct Found {
    /// Body id of the floating base.
    pub(crate) base: usize,
    pub(crate) joints: Joints,
    pub(crate) attached: Attached,
}

/// Finds everything that `config` names in `model`; errors say what is missing or does not fit.
pub(crate) fn find(
    files: &Files<'_>,
    config: &Config,
    model: &MjModel,
    feet: &[Foot; 2],
) -> Result<Found, RobotError> {
    let loader = Loader {
        files,
        config,
        model,
    };
    let base = loader.base()?;
    let joints = loader.joints(base)?;
    let attached = loader.attached(base, &joints, feet)?;
    loader.check_masses()?;
    loader.check_imu()?;
    loader.check_state(&joints)?;
    Ok(Found {
        base,
        joints,
        attached,
    })
}

/// Name of a body.
pub(crate) fn body_name(model: &MjModel, body: usize) -> String {
    model
        .id_to_name(MjtObjBase::mjOBJ_BODY, body)
        .unwrap_or_default()
        .to_owned()
}

/// Checks the configuration against the compiled model.
struct Loader<'a> {
    files: &'a Files<'a>,
    config: &'a Config,
    model: &'a MjModel,
}

impl Loader<'_> {
    fn error(
        &self,
        key: impl Into<String>,
        expected: impl Into<String>,
        found: impl Into<String>,
    ) -> RobotError {
        RobotError::value(self.files.config, key, expected, found)
    }

    fn body(&self, key: String, name: &str) -> Result<usize, RobotError> {
        let missing = || {
            let expected = format!("a body of {}", self.files.model.display());
            self.error(key, expected, format!("{name:?}"))
        };
        self.model
            .name_to_id(MjtObjBase::mjOBJ_BODY, name)
            .ok_or_else(missing)
    }

    /// The body that floats: the only one with a free joint, standing directly in the world.
    fn base(&self) -> Result<usize, RobotError> {
        let free: Vec<usize> = (0..self.model.jnt_type().len())
            .filter(|&joint| self.model.jnt_type()[joint] == MjtJoint::mjJNT_FREE)
            .collect();
        // MuJoCo allows free joints in top-level bodies only; `qpos` starts with the base's.
        match free[..] {
            [0] => Ok(self.model.jnt_bodyid()[0] as usize),
            _ => Err(self.error(
                "model",
                "a model with one free joint, that of the base, before all others",
                format!("{} free joints", free.len()),
            )),
        }
    }

    fn joints(&self, base: usize) -> Result<Joints, RobotError> {
        let joints = self.model.jnt_type().len();
        let mut columns = vec![usize::MAX; joints];
        let mut goal = Vec::new();
        for (column, (key, config)) in self.config.joints.keyed().enumerate() {
            let (id, joint) = self.joint(&key, config, base)?;
            columns[id] = column;
            goal.push(joint);
        }
        for (id, column) in columns.iter().enumerate().skip(1) {
            if *column == usize::MAX {
                let name = self
                    .model
                    .id_to_name(MjtObjBase::mjOBJ_JOINT, id)
                    .unwrap_or("a joint without a name");
                let expected =
                    "every joint of the model in joints.goal, joints.leg or joints.locked";
                return Err(self.error("joints", expected, format!("{name:?} in none of them")));
            }
        }
        let leg = goal.split_off(self.config.joints.goal.len());
        Ok(Joints { goal, leg, columns })
    }

    fn joint(
        &self,
        key: &str,
        config: &JointConfig,
        base: usize,
    ) -> Result<(usize, Joint), RobotError> {
        let model = self.model;
        let name_key = format!("{key}.name");
        let expect = |expected: &str, found: String| self.error(&name_key, expected, found);
        let id = model
            .name_to_id(MjtObjBase::mjOBJ_JOINT, &config.name)
            .ok_or_else(|| expect("a joint of the model", format!("{:?}", config.name)))?;
        if model.jnt_type()[id] != MjtJoint::mjJNT_HINGE {
            return Err(expect(
                "a hinge",
                format!("{:?} of another type", config.name),
            ));
        }
        if model.body_rootid()[model.jnt_bodyid()[id] as usize] as usize != base {
            return Err(expect(
                "a joint below the base",
                format!("{:?} elsewhere", config.name),
            ));
        }
        let qpos_address = model.jnt_qposadr()[id] as usize;
        if model.qpos0()[qpos_address] != 0.0 {
            let found = format!("ref {} of {:?}", model.qpos0()[qpos_address], config.name);
            return Err(expect("a joint with reference angle 0", found));
        }
        let range = model.jnt_range()[id];
        let limited = model.jnt_limited()[id] && range.iter().all(|limit| limit.is_finite());
        if !limited || range[0] >= range[1] {
            let found = if limited {
                format!("{range:?} of {:?}", config.name)
            } else {
                "none".to_owned()
            };
            return Err(expect(
                "a joint with a range from its lower to its upper limit",
                found,
            ));
        }
        if !(range[0]..=range[1]).contains(&config.default) {
            let expected = format!("an angle within the joint's range {range:?}");
            return Err(self.error(
                format!("{key}.default"),
                expected,
                config.default.to_string(),
            ));
        }
        Ok((
            id,
            Joint {
                name: config.name.clone(),
                range,
                kp: config.kp,
                kd: config.kd,
                torque_limit: config.torque_limit,
                velocity_limit: config.velocity_limit,
                armature: config.armature,
                damping: config.damping,
                default: config.default,
                qpos_address,
                dof_address: model.jnt_dofadr()[id] as usize,
            },
        ))
    }

    /// What is attached to bodies: key nodes, wrist frames, link spheres, soles.
    fn attached(
        &self,
        base: usize,
        joints: &Joints,
        feet: &[Foot; 2],
    ) -> Result<Attached, RobotError> {
        let mut key_nodes = Vec::new();
        for (name, (body, offset)) in KEY_NODE_NAMES
            .into_iter()
            .zip(self.config.key_nodes.points())
        {
            let key = format!("key_nodes.{name}.body");
            let id = self.robot_body(key.clone(), body, base)?;
            let is_goal = |joint: usize| joints.columns[joint] < joints.goal.len();
            if !self.carriers(id, base).all(is_goal) {
                return Err(self.error(key, "a body that no leg joint moves", format!("{body:?}")));
            }
            key_nodes.push((id, Vector3::from(offset)));
        }
        if key_nodes[0].0 != base {
            let expected = format!("the base, {:?}", body_name(self.model, base));
            return Err(self.error(
                "key_nodes.waist.body",
                expected,
                format!("{:?}", self.config.key_nodes.waist.body),
            ));
        }
        let [left, right] = self.config.key_nodes.wrists();
        let wrists = [
            (
                self.hand("left_wrist", left, key_nodes[KEY_NODES - 2].0, base)?,
                wrist_axes(left),
            ),
            (
                self.hand("right_wrist", right, key_nodes[KEY_NODES - 1].0, base)?,
                wrist_axes(right),
            ),
        ];
        Ok(Attached {
            key_nodes,
            links: self.links(base)?,
            wrists,
            soles: [
                self.sole("contacts.left_foot", &feet[0], base)?,
                self.sole("contacts.right_foot", &feet[1], base)?,
            ],
            foot_contacts: self.foot_contacts(feet, base)?,
        })
    }

    /// The hand of a wrist: the node's body or one that it carries.
    fn hand(
        &self,
        name: &str,
        wrist: &WristConfig,
        body: usize,
        base: usize,
    ) -> Result<usize, RobotError> {
        let key = format!("key_nodes.{name}.hand");
        let hand = self.robot_body(key.clone(), &wrist.hand, base)?;
        let parent =
            |&body: &usize| (body != base).then(|| self.model.body_parentid()[body] as usize);
        if !std::iter::successors(Some(hand), parent).any(|ancestor| ancestor == body) {
            let expected = format!("{:?} or a body that it carries", wrist.body);
            return Err(self.error(key, expected, format!("{:?}", wrist.hand)));
        }
        Ok(hand)
    }

    fn links(&self, base: usize) -> Result<Vec<(usize, Vector3<f64>)>, RobotError> {
        let spheres = self.config.links.spheres.iter().enumerate();
        spheres
            .map(|(i, sphere)| {
                let body =
                    self.robot_body(format!("links.spheres[{i}].body"), &sphere.body, base)?;
                Ok((body, Vector3::from(sphere.center)))
            })
            .collect()
    }

    fn sole(
        &self,
        key: &str,
        foot: &Foot,
        base: usize,
    ) -> Result<(usize, Vector3<f64>), RobotError> {
        let body = self.robot_body(format!("{key}.body"), &foot.body, base)?;
        Ok((body, Vector3::from(foot.sole_center())))
    }

    fn foot_contacts(
        &self,
        feet: &[Foot; 2],
        base: usize,
    ) -> Result<Vec<(usize, Vector3<f64>)>, RobotError> {
        let mut contacts = Vec::new();
        for (key, foot) in ["contacts.left_foot", "contacts.right_foot"]
            .into_iter()
            .zip(feet)
        {
            let body = self.robot_body(format!("{key}.body"), &foot.body, base)?;
            contacts.extend(
                foot.centers
                    .iter()
                    .map(|&center| (body, Vector3::from(center))),
            );
        }
        Ok(contacts)
    }

    /// A body of the robot: the base or one below it.
    fn robot_body(&self, key: String, name: &str, base: usize) -> Result<usize, RobotError> {
        let body = self.body(key.clone(), name)?;
        if self.model.body_rootid()[body] as usize != base {
            return Err(self.error(key, "a body of the robot", format!("{name:?}")));
        }
        Ok(body)
    }

    /// The joints that carry `body`, the base's excluded.
    fn carriers(&self, body: usize, base: usize) -> impl Iterator<Item = usize> {
        let parent = |&body: &usize| Some(self.model.body_parentid()[body] as usize);
        std::iter::successors(Some(body), parent)
            .take_while(move |&body| body != base)
            .flat_map(|body| {
                let first = self.model.body_jntadr()[body].max(0) as usize;
                first..first + self.model.body_jntnum()[body] as usize
            })
    }

    fn check_masses(&self) -> Result<(), RobotError> {
        for (body, &mass) in self.model.body_mass().iter().enumerate() {
            if !(mass.is_finite() && mass >= 0.0) {
                let found = format!("{mass} of body {:?}", body_name(self.model, body));
                return Err(self.error("model", "bodies with finite masses", found));
            }
        }
        Ok(())
    }

    /// The state and the controls are the base's and the joints', in their order: whatever else a model has would shift them.
    fn check_state(&self, joints: &Joints) -> Result<(), RobotError> {
        let model = self.model;
        let names = joints
            .goal
            .iter()
            .chain(&joints.leg)
            .map(|joint| joint.name.as_str());
        let expected: Vec<Option<&str>> = names.map(Some).collect();
        let count = model.actuator_trntype().len();
        let actuators: Vec<Option<&str>> = (0..count)
            .map(|id| model.id_to_name(MjtObjBase::mjOBJ_ACTUATOR, id))
            .collect();
        if actuators != expected {
            let found = format!(
                "{count} actuators, {:?} …",
                actuators.iter().take(3).collect::<Vec<_>>()
            );
            return Err(self.error(
                "joints",
                "one actuator a joint, in the joints' order",
                found,
            ));
        }
        let sizes = [
            model.ffi().nq,
            model.ffi().nv,
            model.ffi().na,
            model.ffi().nmocap,
        ];
        let joints = expected.len() as i64;
        let wanted = [7 + joints, 6 + joints, 0, 0];
        if sizes != wanted {
            return Err(self.error(
                "model",
                format!("nq, nv, na, nmocap of {wanted:?}: one floating base and hinges"),
                format!("{sizes:?}"),
            ));
        }
        Ok(())
    }

    fn check_imu(&self) -> Result<(), RobotError> {
        let name = &self.config.imu_site;
        match self.model.name_to_id(MjtObjBase::mjOBJ_SITE, name) {
            Some(_) => Ok(()),
            None => {
                let expected = format!("a site of {}", self.files.model.display());
                Err(self.error("imu_site", expected, format!("{name:?}")))
            }
        }
    }
}

/// The wrist convention in the hand's frame: x to the fingers, z to the thumb, y = z × x, as columns.
///
/// The configuration's vectors are unit and at right angles to within rounding; the result is an exact rotation.
fn wrist_axes(wrist: &WristConfig) -> Matrix3<f64> {
    let x = Vector3::from(wrist.fingers).normalize();
    let y = Vector3::from(wrist.thumb).cross(&x).normalize();
    Matrix3::from_columns(&[x, y, x.cross(&y)])
}
