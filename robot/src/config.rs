//! `robot.toml`: its shape, and the checks that need no model.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use serde::Deserialize;

use crate::RobotError;
use crate::key_nodes::{KEY_NODE_NAMES, KEY_NODES};

/// Allowed error of unit vectors and right angles in the file.
const UNIT_TOLERANCE: f64 = 1e-6;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Config {
    pub(crate) name: String,
    /// MJCF file, relative to the folder of `robot.toml`.
    pub(crate) model: PathBuf,
    /// The command that fetches the MJCF where it does not ship with the project.
    pub(crate) fetch: Option<String>,
    pub(crate) imu_site: String,
    pub(crate) control: Control,
    pub(crate) joints: Joints,
    pub(crate) key_nodes: KeyNodes,
    pub(crate) links: Links,
    pub(crate) contacts: Contacts,
    pub(crate) randomization: RandomizationConfig,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Control {
    pub(crate) rate_hz: f64,
    pub(crate) timestep: f64,
    pub(crate) action_scale: f64,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Joints {
    pub(crate) locked: Vec<String>,
    pub(crate) goal: Vec<JointConfig>,
    pub(crate) leg: Vec<JointConfig>,
}

impl Joints {
    /// Goal joints, then leg joints, each with its key.
    pub(crate) fn keyed(&self) -> impl Iterator<Item = (String, &JointConfig)> {
        let goal = self
            .goal
            .iter()
            .enumerate()
            .map(|(i, joint)| (format!("joints.goal[{i}]"), joint));
        let leg = self
            .leg
            .iter()
            .enumerate()
            .map(|(i, joint)| (format!("joints.leg[{i}]"), joint));
        goal.chain(leg)
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct JointConfig {
    pub(crate) name: String,
    pub(crate) kp: f64,
    pub(crate) kd: f64,
    pub(crate) torque_limit: f64,
    pub(crate) velocity_limit: f64,
    pub(crate) armature: f64,
    pub(crate) damping: f64,
    pub(crate) default: f64,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct KeyNodes {
    pub(crate) waist: PointConfig,
    pub(crate) torso: PointConfig,
    pub(crate) left_shoulder: PointConfig,
    pub(crate) right_shoulder: PointConfig,
    pub(crate) left_elbow: PointConfig,
    pub(crate) right_elbow: PointConfig,
    pub(crate) left_wrist: WristConfig,
    pub(crate) right_wrist: WristConfig,
}

impl KeyNodes {
    /// Body and offset of each node, in the order of [`KEY_NODE_NAMES`].
    pub(crate) fn points(&self) -> [(&str, [f64; 3]); KEY_NODES] {
        [
            (&self.waist.body, self.waist.offset),
            (&self.torso.body, self.torso.offset),
            (&self.left_shoulder.body, self.left_shoulder.offset),
            (&self.right_shoulder.body, self.right_shoulder.offset),
            (&self.left_elbow.body, self.left_elbow.offset),
            (&self.right_elbow.body, self.right_elbow.offset),
            (&self.left_wrist.body, self.left_wrist.offset),
            (&self.right_wrist.body, self.right_wrist.offset),
        ]
    }

    /// The wrists' nodes, left and right.
    pub(crate) fn wrists(&self) -> [&WristConfig; 2] {
        [&self.left_wrist, &self.right_wrist]
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct PointConfig {
    pub(crate) body: String,
    pub(crate) offset: [f64; 3],
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct WristConfig {
    pub(crate) body: String,
    pub(crate) offset: [f64; 3],
    /// The body that turns with the hand: `body` itself or one below it.
    pub(crate) hand: String,
    /// Unit vector from the wrist to the fingers, in the hand's frame.
    pub(crate) fingers: [f64; 3],
    /// Unit vector toward the thumb, at a right angle to `fingers`, in the hand's frame.
    pub(crate) thumb: [f64; 3],
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Links {
    pub(crate) spheres: Vec<SphereConfig>,
    pub(crate) pairs: Vec<[String; 2]>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SphereConfig {
    pub(crate) name: String,
    pub(crate) body: String,
    pub(crate) center: [f64; 3],
    pub(crate) radius: f64,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Contacts {
    /// Geoms of the model that may touch each other.
    pub(crate) pairs: Vec<[String; 2]>,
    pub(crate) left_foot: FootConfig,
    pub(crate) right_foot: FootConfig,
}

impl Contacts {
    /// The feet, left and right, each with its key.
    pub(crate) fn feet(&self) -> [(&'static str, &FootConfig); 2] {
        [
            ("contacts.left_foot", &self.left_foot),
            ("contacts.right_foot", &self.right_foot),
        ]
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct FootConfig {
    pub(crate) body: String,
    pub(crate) radius: f64,
    pub(crate) centers: Vec<[f64; 3]>,
}

/// Ranges of masses, kg.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct RandomizationConfig {
    pub(crate) base_mass: [f64; 2],
    pub(crate) hand_mass: [f64; 2],
    pub(crate) test_hand_load: [f64; 2],
}

impl Config {
    /// Reads `file` and checks every value that can be judged without the model.
    pub(crate) fn load(file: &Path) -> Result<Self, RobotError> {
        let text = std::fs::read_to_string(file).map_err(|reason| RobotError::Read {
            file: file.to_path_buf(),
            reason,
        })?;
        let config = Self::parse(file, &text)?;
        Checks { file }.config(&config)?;
        Ok(config)
    }

    fn parse(file: &Path, text: &str) -> Result<Self, RobotError> {
        let parse_error = |key: String, message: &toml::de::Error| RobotError::Parse {
            file: file.to_path_buf(),
            key,
            message: message.to_string().trim_end().to_owned(),
        };
        let deserializer =
            toml::Deserializer::parse(text).map_err(|error| parse_error(".".into(), &error))?;
        serde_path_to_error::deserialize(deserializer)
            .map_err(|error| parse_error(error.path().to_string(), error.inner()))
    }
}

/// Checks of single values and of names that must agree within the file.
struct Checks<'a> {
    file: &'a Path,
}

impl Checks<'_> {
    fn config(&self, config: &Config) -> Result<(), RobotError> {
        self.name("name", &config.name)?;
        self.name("model", &config.model.to_string_lossy())?;
        self.name("imu_site", &config.imu_site)?;
        self.control(&config.control)?;
        self.joints(&config.joints)?;
        self.key_nodes(&config.key_nodes)?;
        self.links(&config.links)?;
        self.contacts(&config.contacts)?;
        self.randomization(&config.randomization)
    }

    fn fail(
        &self,
        key: &str,
        expected: &str,
        found: impl std::fmt::Display,
    ) -> Result<(), RobotError> {
        Err(RobotError::value(
            self.file,
            key,
            expected,
            found.to_string(),
        ))
    }

    /// A name that MuJoCo can take: it ends names at a NUL byte.
    fn name(&self, key: &str, name: &str) -> Result<(), RobotError> {
        if name.is_empty() || name.contains('\0') {
            return self.fail(
                key,
                "a name that is not empty and has no NUL character",
                format!("{name:?}"),
            );
        }
        Ok(())
    }

    fn positive(&self, key: &str, value: f64) -> Result<(), RobotError> {
        if !(value.is_finite() && value > 0.0) {
            return self.fail(key, "a finite number above 0", value);
        }
        Ok(())
    }

    fn not_negative(&self, key: &str, value: f64) -> Result<(), RobotError> {
        if !(value.is_finite() && value >= 0.0) {
            return self.fail(key, "a finite number, 0 or above", value);
        }
        Ok(())
    }

    fn finite(&self, key: &str, vector: [f64; 3]) -> Result<(), RobotError> {
        if !vector.iter().all(|value| value.is_finite()) {
            return self.fail(key, "three finite numbers", format!("{vector:?}"));
        }
        Ok(())
    }

    fn control(&self, control: &Control) -> Result<(), RobotError> {
        self.positive("control.rate_hz", control.rate_hz)?;
        self.positive("control.timestep", control.timestep)?;
        self.positive("control.action_scale", control.action_scale)?;
        let steps = 1.0 / (control.rate_hz * control.timestep);
        if steps < 0.5 || (steps - steps.round()).abs() > 1e-6 {
            let expected = "a whole number of steps in one control period (1 / control.rate_hz)";
            return self.fail(
                "control.timestep",
                expected,
                format!("{} ({steps} steps)", control.timestep),
            );
        }
        Ok(())
    }

    fn randomization(&self, ranges: &RandomizationConfig) -> Result<(), RobotError> {
        let rows = [
            ("randomization.base_mass", ranges.base_mass, f64::MIN),
            ("randomization.hand_mass", ranges.hand_mass, 0.0),
            ("randomization.test_hand_load", ranges.test_hand_load, 0.0),
        ];
        for (key, [low, high], least) in rows {
            // Comparisons with NaN are false.
            if !(least <= low && low <= high && high <= f64::MAX) {
                let expected = "a range of masses from low to high, those of hands 0 or above";
                return self.fail(key, expected, format!("[{low}, {high}]"));
            }
        }
        Ok(())
    }

    fn joints(&self, joints: &Joints) -> Result<(), RobotError> {
        for (key, list) in [("joints.goal", &joints.goal), ("joints.leg", &joints.leg)] {
            if list.is_empty() {
                return self.fail(key, "at least one joint", "none");
            }
        }
        let mut seen = HashMap::new();
        for (key, joint) in joints.keyed() {
            self.joint(&key, joint)?;
            self.unique(&mut seen, format!("{key}.name"), &joint.name)?;
        }
        for (i, name) in joints.locked.iter().enumerate() {
            let key = format!("joints.locked[{i}]");
            self.name(&key, name)?;
            self.unique(&mut seen, key, name)?;
        }
        Ok(())
    }

    fn joint(&self, key: &str, joint: &JointConfig) -> Result<(), RobotError> {
        self.name(&format!("{key}.name"), &joint.name)?;
        self.positive(&format!("{key}.kp"), joint.kp)?;
        self.not_negative(&format!("{key}.kd"), joint.kd)?;
        self.positive(&format!("{key}.torque_limit"), joint.torque_limit)?;
        self.positive(&format!("{key}.velocity_limit"), joint.velocity_limit)?;
        self.not_negative(&format!("{key}.armature"), joint.armature)?;
        self.not_negative(&format!("{key}.damping"), joint.damping)
        // `default` is checked against the joint's range, which is in the model.
    }

    fn unique<'n>(
        &self,
        seen: &mut HashMap<&'n str, String>,
        key: String,
        name: &'n str,
    ) -> Result<(), RobotError> {
        if let Some(first) = seen.get(name) {
            return self.fail(
                &key,
                &format!("a name that is not taken by {first}"),
                format!("{name:?}"),
            );
        }
        seen.insert(name, key);
        Ok(())
    }

    fn key_nodes(&self, nodes: &KeyNodes) -> Result<(), RobotError> {
        for (name, (body, offset)) in KEY_NODE_NAMES.iter().zip(nodes.points()) {
            self.name(&format!("key_nodes.{name}.body"), body)?;
            self.finite(&format!("key_nodes.{name}.offset"), offset)?;
        }
        for (name, wrist) in ["left_wrist", "right_wrist"].iter().zip(nodes.wrists()) {
            self.name(&format!("key_nodes.{name}.hand"), &wrist.hand)?;
            let [fingers, thumb] = [
                format!("key_nodes.{name}.fingers"),
                format!("key_nodes.{name}.thumb"),
            ];
            self.unit(&fingers, wrist.fingers)?;
            self.unit(&thumb, wrist.thumb)?;
            let cosine: f64 = wrist
                .fingers
                .iter()
                .zip(wrist.thumb)
                .map(|(a, b)| a * b)
                .sum();
            if cosine.abs() > UNIT_TOLERANCE {
                self.fail(
                    &thumb,
                    "a direction at a right angle to fingers",
                    format!("{:?}", wrist.thumb),
                )?;
            }
        }
        Ok(())
    }

    fn unit(&self, key: &str, vector: [f64; 3]) -> Result<(), RobotError> {
        self.finite(key, vector)?;
        let norm = vector.iter().map(|value| value * value).sum::<f64>().sqrt();
        if (norm - 1.0).abs() > UNIT_TOLERANCE {
            return self.fail(
                key,
                "a vector of length 1",
                format!("{vector:?} of length {norm}"),
            );
        }
        Ok(())
    }

    fn links(&self, links: &Links) -> Result<(), RobotError> {
        let mut seen = HashMap::new();
        for (i, sphere) in links.spheres.iter().enumerate() {
            let key = format!("links.spheres[{i}]");
            self.name(&format!("{key}.name"), &sphere.name)?;
            self.name(&format!("{key}.body"), &sphere.body)?;
            self.finite(&format!("{key}.center"), sphere.center)?;
            self.positive(&format!("{key}.radius"), sphere.radius)?;
            self.unique(&mut seen, format!("{key}.name"), &sphere.name)?;
        }
        for (i, pair) in links.pairs.iter().enumerate() {
            self.pair(&format!("links.pairs[{i}]"), pair)?;
            for name in pair.iter().filter(|name| !seen.contains_key(name.as_str())) {
                self.fail(
                    &format!("links.pairs[{i}]"),
                    "the names of two of links.spheres",
                    format!("{name:?}"),
                )?;
            }
        }
        Ok(())
    }

    fn contacts(&self, contacts: &Contacts) -> Result<(), RobotError> {
        for (i, pair) in contacts.pairs.iter().enumerate() {
            self.pair(&format!("contacts.pairs[{i}]"), pair)?;
        }
        for (key, foot) in contacts.feet() {
            self.name(&format!("{key}.body"), &foot.body)?;
            self.positive(&format!("{key}.radius"), foot.radius)?;
            if foot.centers.len() < 3 {
                let found = foot.centers.len();
                return self.fail(
                    &format!("{key}.centers"),
                    "at least 3 spheres for a foot to stand on",
                    found,
                );
            }
            for (i, center) in foot.centers.iter().enumerate() {
                self.finite(&format!("{key}.centers[{i}]"), *center)?;
            }
        }
        Ok(())
    }

    fn pair(&self, key: &str, [first, second]: &[String; 2]) -> Result<(), RobotError> {
        self.name(key, first)?;
        self.name(key, second)?;
        if first == second {
            return self.fail(key, "two different names", format!("{first:?} twice"));
        }
        Ok(())
    }
}
