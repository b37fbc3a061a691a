//! Domain randomisation (paper, table "Domain Randomization"), and the noise of sensors beside it.

use emp_robot::Robot;
use rand::Rng;
use serde::{Deserialize, Serialize};

use crate::pushes::Push;
use crate::ranges::{check_range, within};
use crate::sensors::SensorNoise;
use crate::{BodyParameters, Physics, SimError};

/// A range of masses to add.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MassRange {
    /// The range in the robot's `robot.toml`: the paper's, scaled to the robot's mass.
    Robot,
    /// None is added.
    Off,
    /// Between these, kg.
    Kilograms([f64; 2]),
}

impl MassRange {
    fn kilograms(self, robot: [f64; 2]) -> Option<[f64; 2]> {
        match self {
            Self::Robot => Some(robot),
            Self::Off => None,
            Self::Kilograms(range) => Some(range),
        }
    }
}

/// Episodes that start above the floor.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Hang {
    /// How far above it, metres.
    pub height: f64,
    /// Share of episodes.
    pub ratio: f64,
}

/// What differs between episodes. Each row is a range to draw from uniformly, or none: then that row is nominal.
///
/// The default is the paper's table. "Factor" rows multiply what the robot's files say.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Randomization {
    /// Sliding friction of both feet.
    pub friction: Option<[f64; 2]>,
    /// Mass added to the base.
    pub base_mass: MassRange,
    /// Mass added to each hand, drawn separately.
    pub hand_mass: MassRange,
    /// Displacement of the base's centre of mass on each axis, metres.
    pub base_com: Option<[f64; 2]>,
    /// Factor on each link's inertia.
    pub link_inertia: Option<[f64; 2]>,
    /// Factor on each link's mass.
    pub link_mass: Option<[f64; 2]>,
    /// Factor on each joint's stiffness.
    pub p_gain: Option<[f64; 2]>,
    /// Factor on each joint's servo damping.
    pub d_gain: Option<[f64; 2]>,
    /// Factor on each joint's torque limit.
    pub motor_torque: Option<[f64; 2]>,
    /// Factor on each joint's passive damping, which is 1 N·m·s/rad at the legs of emp27.
    pub motor_damping: Option<[f64; 2]>,
    /// Delay of the motors, seconds.
    pub motor_delay: Option<[f64; 2]>,
    /// Pushes.
    pub push: Option<Push>,
    /// Starts above the floor.
    pub hang: Option<Hang>,
    /// Offset of each joint at the start, rad.
    pub initial_joints: Option<[f64; 2]>,
    /// Factor on each action, drawn anew in every control period.
    pub action: Option<[f64; 2]>,
    /// What sensors add to what they measure; not in the paper's table.
    pub sensors: Option<SensorNoise>,
}

impl Default for Randomization {
    fn default() -> Self {
        let fifth = Some([0.8, 1.2]);
        Self {
            friction: Some([0.1, 2.0]),
            base_mass: MassRange::Robot,
            hand_mass: MassRange::Robot,
            base_com: Some([-0.05, 0.05]),
            link_inertia: fifth,
            link_mass: fifth,
            p_gain: fifth,
            d_gain: fifth,
            motor_torque: fifth,
            motor_damping: Some([0.3, 4.0]),
            motor_delay: Some([0.0, 0.01]),
            push: Some(Push {
                ratio: 1.0,
                interval: 5.0,
                linear: 0.5,
                angular: 0.4,
            }),
            hang: Some(Hang {
                height: 0.1,
                ratio: 0.2,
            }),
            initial_joints: Some([-0.1, 0.1]),
            action: Some([0.98, 1.02]),
            sensors: None,
        }
    }
}

/// The robust preset: largest load of a hand, as a multiple of the paper's (3 kg for 60 kg of robot), and its pushes.
const ROBUST_LOAD: f64 = 1.2;
const ROBUST_PUSH: Push = Push {
    ratio: 0.6,
    interval: 1.5,
    linear: 0.8,
    angular: 0.5,
};

impl Randomization {
    /// Nothing differs from the robot's files.
    pub fn nominal() -> Self {
        Self {
            friction: None,
            base_mass: MassRange::Off,
            hand_mass: MassRange::Off,
            base_com: None,
            link_inertia: None,
            link_mass: None,
            p_gain: None,
            d_gain: None,
            motor_torque: None,
            motor_damping: None,
            motor_delay: None,
            push: None,
            hang: None,
            initial_joints: None,
            action: None,
            sensors: None,
        }
    }

    /// The paper's table with heavier hands, harder and more frequent pushes in most episodes, and the noise of sensors.
    pub fn robust(robot: &Robot) -> Self {
        let heaviest = ROBUST_LOAD * robot.added_masses().hand[1];
        Self {
            hand_mass: MassRange::Kilograms([0.0, heaviest]),
            push: Some(ROBUST_PUSH),
            sensors: Some(SensorNoise::default()),
            ..Self::default()
        }
    }

    /// The same rows, each range shrunk by `scale` about its nominal value: 1 leaves them, 0 is nominal. The interval of
    /// pushes and how many episodes have them stay, and so does the height of hanging.
    #[must_use]
    pub fn scaled(&self, robot: &Robot, scale: f64) -> Self {
        let about = |nominal: f64| {
            move |range: [f64; 2]| range.map(|limit| nominal + scale * (limit - nominal))
        };
        let (added, factor) = (about(0.0), about(1.0));
        let masses = robot.added_masses();
        let mass = |range: MassRange, of_robot| match range.kilograms(of_robot) {
            Some(range) => MassRange::Kilograms(added(range)),
            None => MassRange::Off,
        };
        Self {
            friction: self.friction.map(factor),
            base_mass: mass(self.base_mass, masses.base),
            hand_mass: mass(self.hand_mass, masses.hand),
            base_com: self.base_com.map(added),
            link_inertia: self.link_inertia.map(factor),
            link_mass: self.link_mass.map(factor),
            p_gain: self.p_gain.map(factor),
            d_gain: self.d_gain.map(factor),
            motor_torque: self.motor_torque.map(factor),
            motor_damping: self.motor_damping.map(factor),
            motor_delay: self.motor_delay.map(added),
            push: self.push.map(|push| Push {
                linear: scale * push.linear,
                angular: scale * push.angular,
                ..push
            }),
            hang: self.hang.map(|hang| Hang {
                ratio: scale * hang.ratio,
                ..hang
            }),
            initial_joints: self.initial_joints.map(added),
            action: self.action.map(factor),
            sensors: self.sensors.map(|noise| noise.scaled(scale)),
        }
    }

    /// Draws the parameters of one episode's body. The same numbers are drawn whatever rows are on.
    pub fn draw(&self, robot: &Robot, bodies: usize, rng: &mut impl Rng) -> BodyParameters {
        let joints = robot.joints().count();
        let masses = robot.added_masses();
        let (base, hand) = (
            self.base_mass.kilograms(masses.base),
            self.hand_mass.kilograms(masses.hand),
        );
        let mut factors =
            |range, count| -> Vec<f64> { (0..count).map(|_| within(range, 1.0, rng)).collect() };
        let link_mass = factors(self.link_mass, bodies);
        let link_inertia = factors(self.link_inertia, bodies);
        let p_gain = factors(self.p_gain, joints);
        let d_gain = factors(self.d_gain, joints);
        let motor_torque = factors(self.motor_torque, joints);
        let motor_damping = factors(self.motor_damping, joints);
        BodyParameters {
            friction: within(self.friction, 1.0, rng),
            base_mass: within(base, 0.0, rng),
            hand_mass: [0, 1].map(|_| within(hand, 0.0, rng)),
            base_com: [0, 1, 2].map(|_| within(self.base_com, 0.0, rng)),
            link_mass,
            link_inertia,
            p_gain,
            d_gain,
            motor_torque,
            motor_damping,
            motor_delay: within(self.motor_delay, 0.0, rng),
            physics: Physics::Exact,
        }
    }

    /// Refuses rows from which nothing sensible can be drawn for `robot`.
    ///
    /// # Errors
    /// [`SimError::Setting`] names the row.
    pub fn check(&self, robot: &Robot) -> Result<(), SimError> {
        let masses = robot.added_masses();
        let period = 1.0 / robot.control_rate_hz();
        let (least, most) = (f64::MIN, f64::MAX);
        let rows = [
            ("friction", self.friction, 0.0, most),
            (
                "base_mass",
                self.base_mass.kilograms(masses.base),
                least,
                most,
            ),
            (
                "hand_mass",
                self.hand_mass.kilograms(masses.hand),
                0.0,
                most,
            ),
            ("base_com", self.base_com, least, most),
            ("link_inertia", self.link_inertia, 0.01, most),
            ("link_mass", self.link_mass, 0.01, most),
            ("p_gain", self.p_gain, 0.0, most),
            ("d_gain", self.d_gain, 0.0, most),
            ("motor_torque", self.motor_torque, 0.0, most),
            ("motor_damping", self.motor_damping, 0.0, most),
            ("motor_delay", self.motor_delay, 0.0, period),
            ("initial_joints", self.initial_joints, least, most),
            ("action", self.action, least, most),
            (
                "push.ratio",
                self.push.map(|push| [push.ratio; 2]),
                0.0,
                1.0,
            ),
            (
                "push.interval",
                self.push.map(|push| [push.interval; 2]),
                period,
                most,
            ),
            (
                "push.linear",
                self.push.map(|push| [push.linear; 2]),
                0.0,
                most,
            ),
            (
                "push.angular",
                self.push.map(|push| [push.angular; 2]),
                0.0,
                most,
            ),
            (
                "hang.height",
                self.hang.map(|hang| [hang.height; 2]),
                0.0,
                most,
            ),
            (
                "hang.ratio",
                self.hang.map(|hang| [hang.ratio; 2]),
                0.0,
                1.0,
            ),
        ];
        for (name, range, least, most) in rows {
            if let Some(range) = range {
                check_range(&format!("randomization.{name}"), range, least, most)?;
            }
        }
        self.sensors.map_or(Ok(()), |noise| noise.check())
    }
}

/// Leg targets (rad, inside the joints' ranges) of an action (policy units), each number of it times a factor from `noise`.
pub(crate) fn leg_targets(
    robot: &Robot,
    action: &[f32],
    noise: Option<[f64; 2]>,
    rng: &mut impl Rng,
    legs: &mut [f32],
) {
    for ((target, &action), joint) in legs.iter_mut().zip(action).zip(robot.leg_joints()) {
        let factor = within(noise, 1.0, rng);
        let angle = joint.default + robot.action_scale() * factor * f64::from(action);
        *target = angle.clamp(joint.range[0], joint.range[1]) as f32;
    }
}
