//! The MuJoCo model: the MJCF file with what `robot.toml` says applied on top.

use std::path::Path;

use mujoco_rs::prelude::*;
use mujoco_rs::wrappers::mj_editing::{MjtLimited, PositionConfig};

use crate::RobotError;
use crate::config::{Config, FootConfig};

/// Foot friction (slide, spin, roll) before any randomisation.
const FOOT_FRICTION: [f64; 3] = [1.0, 0.005, 0.0001];

/// What shapes a compiled model keeps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Shapes {
    /// Only those that carry mass or touch: what a simulation needs.
    Physical,
    /// The visual ones too.
    All,
}

/// The files a model is made from; errors name them.
pub(crate) struct Files<'a> {
    pub(crate) config: &'a Path,
    pub(crate) model: &'a Path,
}

/// A compiled model, and what of the MJCF was left out.
pub(crate) struct Compiled {
    pub(crate) model: MjModel,
    /// Counts in words, such as `23 actuators`.
    pub(crate) left_out: Vec<String>,
}

/// Compiles the MJCF: what belongs to another way of driving it left out, locked joints removed, joint properties,
/// position actuators (in the order goal joints, leg joints; named like their joints), foot spheres, contact pairs and a
/// floor added, all other contacts off.
pub(crate) fn compile(
    files: &Files<'_>,
    config: &Config,
    shapes: Shapes,
) -> Result<Compiled, RobotError> {
    let mut edit = Edit {
        files,
        spec: open(files, config)?,
    };
    let left_out = edit.leave_out()?;
    edit.options(config);
    edit.lock(&config.joints.locked)?;
    edit.joints(config)?;
    edit.disable_contacts();
    edit.pairs(&config.contacts.pairs)?;
    for (key, foot) in config.contacts.feet() {
        edit.foot(key, foot)?;
    }
    edit.floor();
    edit.spec
        .compiler_mut()
        .set_discardvisual(shapes == Shapes::Physical);
    let model = edit
        .spec
        .compile()
        .map_err(|error| RobotError::mujoco(files.model, error))?;
    Ok(Compiled { model, left_out })
}

fn open(files: &Files<'_>, config: &Config) -> Result<MjSpec, RobotError> {
    if let Some(command) = config.fetch.as_ref().filter(|_| !files.model.exists()) {
        return Err(RobotError::NotFetched {
            file: files.config.to_path_buf(),
            model: files.model.to_path_buf(),
            command: command.clone(),
        });
    }
    check_text(files)?;
    MjSpec::from_xml(files.model).map_err(|error| RobotError::mujoco(files.model, error))
}

/// Refuses what MuJoCo would let through: bytes that are no text, and NaN, which it takes for "not given".
fn check_text(files: &Files<'_>) -> Result<(), RobotError> {
    let text = std::fs::read_to_string(files.model).map_err(|reason| RobotError::Read {
        file: files.model.to_path_buf(),
        reason,
    })?;
    let is_nan = |word: &str| word.eq_ignore_ascii_case("nan");
    let in_word = |c: char| c.is_alphanumeric() || c == '_' || c == '-';
    let line = text
        .lines()
        .position(|line| line.split(|c| !in_word(c)).any(is_nan));
    line.map_or(Ok(()), |line| {
        let found = format!("NaN in line {} of {}", line + 1, files.model.display());
        Err(RobotError::value(files.config, "model", "numbers", found))
    })
}

/// Name of a foot's contact sphere in the compiled model.
pub(crate) fn foot_geom(body: &str, index: usize) -> String {
    format!("{body}_contact_{index}")
}

struct Edit<'a> {
    files: &'a Files<'a>,
    spec: MjSpec,
}

impl Edit<'_> {
    fn missing(&self, key: &str, what: &str, name: &str) -> RobotError {
        let expected = format!("{what} of {}", self.files.model.display());
        RobotError::value(self.files.config, key, expected, format!("{name:?}"))
    }

    /// Deletes what the model has for other users: its own actuators, sensors, keyframes, cameras and contact pairs.
    /// `robot.toml` says how the robot is driven and what touches.
    fn leave_out(&mut self) -> Result<Vec<String>, RobotError> {
        let mut left_out = Vec::new();
        macro_rules! delete_all {
            ($($elements:ident: $one:literal, $many:literal;)*) => {$(
                let mut count = 0;
                while let Some(element) = self.spec.$elements().next() {
                    // SAFETY: the handle comes from the spec just now and ends here.
                    unsafe { element.delete() }
                        .map_err(|error| RobotError::mujoco(self.files.model, error))?;
                    count += 1;
                }
                match count {
                    0 => {}
                    1 => left_out.push(format!("1 {}", $one)),
                    _ => left_out.push(format!("{count} {}", $many)),
                }
            )*};
        }
        delete_all! {
            sensor_iter_mut: "sensor", "sensors";
            key_iter_mut: "keyframe", "keyframes";
            actuator_iter_mut: "actuator", "actuators";
            camera_iter_mut: "camera", "cameras";
            pair_iter_mut: "contact pair", "contact pairs";
            exclude_iter_mut: "contact exclusion", "contact exclusions";
        }
        Ok(left_out)
    }

    fn options(&mut self, config: &Config) {
        let option = self.spec.option_mut();
        option.timestep = config.control.timestep;
        // Servo damping is stiff against the armature of small joints: integrate it implicitly.
        option.integrator = MjtIntegrator::mjINT_IMPLICITFAST as i32;
        // One robot is one island, and its few geoms need no tree: the same numbers, 6 % sooner.
        option.disableflags |=
            MjtDisableBit::mjDSBL_ISLAND as i32 | MjtDisableBit::mjDSBL_MIDPHASE as i32;
    }

    fn lock(&mut self, joints: &[String]) -> Result<(), RobotError> {
        for (i, name) in joints.iter().enumerate() {
            let missing = self.missing(&format!("joints.locked[{i}]"), "a joint", name);
            let joint = self.spec.joint_mut(name).ok_or(missing)?;
            // SAFETY: names in `locked` are unique, so each joint is deleted once, and its handle ends here.
            unsafe { joint.delete() }
                .map_err(|error| RobotError::mujoco(self.files.model, error))?;
        }
        Ok(())
    }

    fn joints(&mut self, config: &Config) -> Result<(), RobotError> {
        for (key, joint) in config.joints.keyed() {
            let missing = self.missing(&format!("{key}.name"), "a joint", &joint.name);
            let element = self.spec.joint_mut(&joint.name).ok_or(missing)?;
            element.set_armature(joint.armature);
            element.set_frictionloss(0.0);
            *element.damping_mut() = Default::default();
            element.damping_mut()[0] = joint.damping;

            let actuator = self.spec.add_actuator();
            let servo = PositionConfig {
                kp: joint.kp,
                kv: Some(joint.kd),
                ..PositionConfig::default()
            };
            actuator
                .set_name(&joint.name)
                .and_then(|()| actuator.set_to_position(servo))
                .map_err(|error| RobotError::mujoco(self.files.model, error))?;
            actuator.set_trntype(MjtTrn::mjTRN_JOINT);
            actuator.set_target(&joint.name);
            actuator.set_forcelimited(MjtLimited::mjLIMITED_TRUE);
            *actuator.forcerange_mut() = [-joint.torque_limit, joint.torque_limit];
        }
        Ok(())
    }

    fn disable_contacts(&mut self) {
        for geom in self.spec.geom_iter_mut() {
            geom.set_contype(0);
            geom.set_conaffinity(0);
        }
    }

    fn pairs(&mut self, pairs: &[[String; 2]]) -> Result<(), RobotError> {
        for (i, pair) in pairs.iter().enumerate() {
            for name in pair {
                if self.spec.geom(name).is_none() {
                    return Err(self.missing(&format!("contacts.pairs[{i}]"), "geoms", name));
                }
            }
            let element = self.spec.add_pair();
            element.set_geomname1(&pair[0]);
            element.set_geomname2(&pair[1]);
            element.set_condim(1);
        }
        Ok(())
    }

    fn foot(&mut self, key: &str, foot: &FootConfig) -> Result<(), RobotError> {
        let missing = self.missing(&format!("{key}.body"), "a body", &foot.body);
        let body = self.spec.body_mut(&foot.body).ok_or(missing)?;
        for (i, center) in foot.centers.iter().enumerate() {
            let geom = body.add_geom();
            geom.set_name(&foot_geom(&foot.body, i))
                .map_err(|error| RobotError::mujoco(self.files.model, error))?;
            geom.set_type(MjtGeomBase::mjGEOM_SPHERE);
            *geom.size_mut() = [foot.radius, 0.0, 0.0];
            *geom.pos_mut() = *center;
            geom.set_mass(0.0);
            geom.set_group(3);
            geom.set_contype(1);
            geom.set_conaffinity(0);
            geom.set_condim(3);
            // The foot's friction counts, not the larger of foot and floor: it is what gets randomised.
            geom.set_priority(1);
            *geom.friction_mut() = FOOT_FRICTION;
        }
        Ok(())
    }

    /// Lets the world's plane carry the feet; adds one where the model has none.
    fn floor(&mut self) {
        let world = self.spec.world_body_mut();
        let plane = world
            .geom_iter_mut(false)
            .find(|geom| geom.type_() == MjtGeomBase::mjGEOM_PLANE);
        if let Some(plane) = plane {
            plane.set_conaffinity(1);
            return;
        }
        let plane = world.add_geom();
        plane.set_type(MjtGeomBase::mjGEOM_PLANE);
        *plane.size_mut() = [0.0, 0.0, 1.0];
        plane.set_contype(0);
        plane.set_conaffinity(1);
    }
}
