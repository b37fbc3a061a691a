//! The robot: what its two files say, checked against each other.

use std::path::{Path, PathBuf};

use mujoco_rs::prelude::*;
use nalgebra::Vector3;

use crate::config::{Config, FootConfig, SphereConfig};
use crate::foot::Foot;
use crate::joint::{GoalNode, Joint};
use crate::key_nodes::{KEY_NODE_NAMES, KeyNodeSite};
use crate::kinematics::Kinematics;
use crate::loader::{self, Found, Joints};
use crate::model::{self, Compiled, Files, Shapes};
use crate::{RobotError, goal_tree};

/// The file in a robot's folder that describes it.
const CONFIG_FILE: &str = "robot.toml";

/// A link as a sphere, for the collision loss of the EMP.
#[derive(Clone, Debug, PartialEq)]
pub struct LinkSphere {
    /// Name, unique in the robot.
    pub name: String,
    /// Body that carries it.
    pub body: String,
    /// Centre in the body's frame, metres.
    pub center: [f64; 3],
    /// Radius, metres.
    pub radius: f64,
}

/// Ranges of masses that are added to the robot, kg: the paper's for a robot of 60 kg, scaled to this one's mass.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AddedMasses {
    /// To the base, in training.
    pub base: [f64; 2],
    /// To each hand, in training.
    pub hand: [f64; 2],
    /// To each hand, in tests.
    pub test_hand: [f64; 2],
}

/// A robot, loaded and checked. Immutable; share it in an [`Arc`](std::sync::Arc).
#[derive(Debug)]
pub struct Robot {
    config_file: PathBuf,
    model_file: PathBuf,
    config: Config,
    goal_joints: Vec<Joint>,
    leg_joints: Vec<Joint>,
    goal_tree: Vec<GoalNode>,
    key_nodes: Vec<KeyNodeSite>,
    link_spheres: Vec<LinkSphere>,
    link_pairs: Vec<[usize; 2]>,
    feet: [Foot; 2],
    base_body: String,
    standing_height: f64,
    kinematics: Kinematics,
    model: MjModel,
}

impl Robot {
    /// Loads the robot whose `robot.toml` is in the folder `dir`, and the MJCF model that it names.
    ///
    /// # Errors
    /// If a file is missing or malformed, or if the two disagree; see [`RobotError`].
    pub fn load(dir: &Path) -> Result<Self, RobotError> {
        let config_file = dir.join(CONFIG_FILE);
        let config = Config::load(&config_file)?;
        let model_file = dir.join(&config.model);
        let files = Files {
            config: &config_file,
            model: &model_file,
        };
        let Compiled { model, left_out } = model::compile(&files, &config, Shapes::Physical)?;
        if !left_out.is_empty() {
            let left_out = left_out.join(", ");
            tracing::info!(
                robot = config.name,
                "left out of {}: {left_out}",
                model_file.display()
            );
        }
        let feet = config.contacts.feet().map(|(_, config)| foot(config));
        let Found {
            base,
            joints,
            attached,
        } = loader::find(&files, &config, &model, &feet)?;
        let Joints { goal, leg, columns } = joints;
        let dof = goal.len() + leg.len();
        let robot = Self {
            goal_tree: goal_tree::build(&model, base, &columns, goal.len()),
            key_nodes: key_nodes(&config),
            link_spheres: link_spheres(&config),
            link_pairs: link_pairs(&config),
            base_body: loader::body_name(&model, base),
            standing_height: standing_height(&model, &goal, &leg, &feet),
            kinematics: Kinematics::new(&model, base, &columns, dof, goal.len(), &attached),
            feet,
            goal_joints: goal,
            leg_joints: leg,
            model,
            config_file,
            model_file,
            config,
        };
        robot.check_default_pose()?;
        Ok(robot)
    }

    /// Name of the robot, as requests and checkpoints give it.
    pub fn name(&self) -> &str {
        &self.config.name
    }

    /// The joints that retargeting and the EMP move, in goal order.
    pub fn goal_joints(&self) -> &[Joint] {
        &self.goal_joints
    }

    /// The joints that the standing policy moves, in leg order.
    pub fn leg_joints(&self) -> &[Joint] {
        &self.leg_joints
    }

    /// Goal joints, then leg joints: the order of every joint vector, and of the model's actuators.
    pub fn joints(&self) -> impl Iterator<Item = &Joint> {
        self.goal_joints.iter().chain(&self.leg_joints)
    }

    /// The goal joints as a graph, in goal order.
    pub fn goal_tree(&self) -> &[GoalNode] {
        &self.goal_tree
    }

    /// Default angles of all joints, in the order of [`joints`](Self::joints), rad.
    pub fn default_pose(&self) -> Vec<f32> {
        self.joints().map(|joint| joint.default as f32).collect()
    }

    /// Default angles of the goal joints, rad.
    pub fn default_goal(&self) -> Vec<f32> {
        let joints = self.goal_joints.iter();
        joints.map(|joint| joint.default as f32).collect()
    }

    /// Default angles of the leg joints, rad.
    pub fn default_legs(&self) -> Vec<f32> {
        let joints = self.leg_joints.iter();
        joints.map(|joint| joint.default as f32).collect()
    }

    /// Moves each angle of a goal (rad, goal order) into its joint's range.
    pub fn clamp_goal(&self, goal: &mut [f32]) {
        for (angle, joint) in goal.iter_mut().zip(&self.goal_joints) {
            *angle = joint.clamp(*angle);
        }
    }

    /// How often joint targets change, Hz.
    pub fn control_rate_hz(&self) -> f64 {
        self.config.control.rate_hz
    }

    /// Timestep of the physics, seconds.
    pub fn timestep(&self) -> f64 {
        self.config.control.timestep
    }

    /// Physics steps in one control period.
    pub fn substeps(&self) -> usize {
        (1.0 / (self.control_rate_hz() * self.timestep())).round() as usize
    }

    /// Radians of leg target, away from the default pose, for one unit of a policy's action.
    pub fn action_scale(&self) -> f64 {
        self.config.control.action_scale
    }

    /// The key nodes, in the order of [`KEY_NODE_NAMES`].
    pub fn key_nodes(&self) -> &[KeyNodeSite] {
        &self.key_nodes
    }

    /// Names of the bodies that turn with the hands, left and right; the wrist rotations are theirs.
    pub fn hand_bodies(&self) -> [&str; 2] {
        self.config
            .key_nodes
            .wrists()
            .map(|wrist| wrist.hand.as_str())
    }

    /// The links as spheres.
    pub fn link_spheres(&self) -> &[LinkSphere] {
        &self.link_spheres
    }

    /// Pairs of indices into [`link_spheres`](Self::link_spheres) that may touch.
    pub fn link_pairs(&self) -> &[[usize; 2]] {
        &self.link_pairs
    }

    /// Pairs of geoms of the model that may touch: the robot's self-collisions.
    pub fn contact_pairs(&self) -> &[[String; 2]] {
        &self.config.contacts.pairs
    }

    /// The feet, left and right.
    pub fn feet(&self) -> &[Foot; 2] {
        &self.feet
    }

    /// Name of the floating base's body, the pelvis.
    pub fn base_body(&self) -> &str {
        &self.base_body
    }

    /// Name of the inertial measurement unit's site in the model.
    pub fn imu_site(&self) -> &str {
        &self.config.imu_site
    }

    /// Height of the base above the floor when the robot stands in its default pose, metres.
    pub fn standing_height(&self) -> f64 {
        self.standing_height
    }

    /// Mass of the whole robot, kg.
    pub fn mass(&self) -> f64 {
        self.model.totalmass()
    }

    /// Ranges of masses that training and tests add.
    pub fn added_masses(&self) -> AddedMasses {
        let ranges = &self.config.randomization;
        AddedMasses {
            base: ranges.base_mass,
            hand: ranges.hand_mass,
            test_hand: ranges.test_hand_load,
        }
    }

    /// Forward kinematics.
    pub fn kinematics(&self) -> &Kinematics {
        &self.kinematics
    }

    /// A copy of the compiled model: locked joints removed, a position actuator for each joint (named like it, in the
    /// order of [`joints`](Self::joints)), contacts as [`feet`](Self::feet) and
    /// [`contact_pairs`](Self::contact_pairs) say, a floor, and no visual shapes.
    pub fn model(&self) -> MjModel {
        self.model.clone()
    }

    /// As [`model`](Self::model), with the visual shapes: for pictures. Reads the MJCF and its meshes again.
    ///
    /// # Errors
    /// If the files have gone or changed into something that MuJoCo refuses.
    pub fn visual_model(&self) -> Result<MjModel, RobotError> {
        let files = Files {
            config: &self.config_file,
            model: &self.model_file,
        };
        model::compile(&files, &self.config, Shapes::All).map(|compiled| compiled.model)
    }

    /// The `robot.toml`, which errors name.
    pub(crate) fn config_file(&self) -> &Path {
        &self.config_file
    }

    /// Refuses a default pose in which links that may touch do so.
    fn check_default_pose(&self) -> Result<(), RobotError> {
        let q: Vec<f64> = self.joints().map(|joint| joint.default).collect();
        let mut out = vec![0.0; self.kinematics.output_width()];
        self.kinematics.forward(&q, &mut out);
        let links = &out[self.kinematics.layout().link_centers.clone()];
        for (i, &[first, second]) in self.link_pairs.iter().enumerate() {
            let center = |link: usize| Vector3::from_column_slice(&links[3 * link..3 * link + 3]);
            let distance = (center(first) - center(second)).norm();
            let touching = self.link_spheres[first].radius + self.link_spheres[second].radius;
            if distance <= touching {
                return Err(RobotError::value(
                    &self.config_file,
                    format!("links.pairs[{i}]"),
                    format!("spheres more than {touching} m apart in the default pose"),
                    format!("{distance:.4} m between {:?}", self.config.links.pairs[i]),
                ));
            }
        }
        Ok(())
    }
}

/// The robot folders in `dir` (`robots/` of the project): those that hold a `robot.toml`, sorted by name.
///
/// # Errors
/// If the folder cannot be read.
pub fn robot_folders(dir: &Path) -> Result<Vec<PathBuf>, RobotError> {
    let read = |reason| RobotError::Read {
        file: dir.to_path_buf(),
        reason,
    };
    let mut folders = Vec::new();
    for entry in std::fs::read_dir(dir).map_err(read)? {
        let path = entry.map_err(read)?.path();
        if path.join(CONFIG_FILE).is_file() {
            folders.push(path);
        }
    }
    folders.sort();
    Ok(folders)
}

fn foot(config: &FootConfig) -> Foot {
    let FootConfig {
        body,
        radius,
        centers,
    } = config;
    Foot {
        body: body.clone(),
        radius: *radius,
        centers: centers.clone(),
        geoms: (0..centers.len())
            .map(|i| model::foot_geom(body, i))
            .collect(),
    }
}

fn key_nodes(config: &Config) -> Vec<KeyNodeSite> {
    let site = |(name, (body, offset)): (&'static str, (&str, [f64; 3]))| KeyNodeSite {
        name,
        body: body.to_owned(),
        offset,
    };
    KEY_NODE_NAMES
        .into_iter()
        .zip(config.key_nodes.points())
        .map(site)
        .collect()
}

fn link_spheres(config: &Config) -> Vec<LinkSphere> {
    let sphere = |sphere: &SphereConfig| LinkSphere {
        name: sphere.name.clone(),
        body: sphere.body.clone(),
        center: sphere.center,
        radius: sphere.radius,
    };
    config.links.spheres.iter().map(sphere).collect()
}

/// The pairs by index; their names are known to exist.
fn link_pairs(config: &Config) -> Vec<[usize; 2]> {
    let spheres = &config.links.spheres;
    let index = |name: &String| spheres.iter().position(|sphere| sphere.name == *name);
    config
        .links
        .pairs
        .iter()
        .filter_map(|[first, second]| Some([index(first)?, index(second)?]))
        .collect()
}

/// Height of the base at which the lowest foot sphere touches the floor in the default pose, base upright.
fn standing_height(model: &MjModel, goal: &[Joint], leg: &[Joint], feet: &[Foot; 2]) -> f64 {
    let mut data = model.make_data();
    let qpos = data.qpos_mut();
    qpos.fill(0.0);
    qpos[3] = 1.0;
    for joint in goal.iter().chain(leg) {
        qpos[joint.qpos_address] = joint.default;
    }
    data.kinematics();
    let bottoms = feet
        .iter()
        .flat_map(|foot| foot.geoms.iter().map(|name| (name, foot.radius)));
    bottoms
        .filter_map(|(name, radius)| {
            Some((model.name_to_id(MjtObjBase::mjOBJ_GEOM, name)?, radius))
        })
        .map(|(geom, radius)| radius - data.geom_xpos()[geom][2])
        .fold(f64::NEG_INFINITY, f64::max)
}
