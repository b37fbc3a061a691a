//! What makes one simulated robot differ from the next.

use serde::{Deserialize, Serialize};

/// How exactly a robot is simulated.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Physics {
    /// As the robot's files say. Every judgement is made in it.
    #[default]
    Exact,
    /// Fewer and longer physics steps, and a solver that stops sooner: for training alone.
    Fast,
}

/// Physical parameters of one simulated robot, relative to the robot as its files describe it. The default is that robot.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BodyParameters {
    /// Factor on the sliding friction of the feet, which is 1 in the model.
    pub friction: f64,
    /// Mass added to the base, kg.
    pub base_mass: f64,
    /// Mass added to the left and the right hand, kg.
    pub hand_mass: [f64; 2],
    /// Displacement of the base's centre of mass in its own frame, metres.
    pub base_com: [f64; 3],
    /// Factor on each link's mass (and on its inertia with it), by the model's body number; those missing are 1.
    pub link_mass: Vec<f64>,
    /// Factor on each link's inertia at a given mass, by the model's body number; those missing are 1.
    pub link_inertia: Vec<f64>,
    /// Factor on each joint's stiffness, goal joints first; those missing are 1.
    pub p_gain: Vec<f64>,
    /// Factor on each joint's servo damping, goal joints first; those missing are 1.
    pub d_gain: Vec<f64>,
    /// Factor on each joint's torque limit, goal joints first; those missing are 1.
    pub motor_torque: Vec<f64>,
    /// Factor on each joint's passive damping, goal joints first; those missing are 1.
    pub motor_damping: Vec<f64>,
    /// Time from a new target to when the motors follow it, seconds, at most one control period. It changes nothing of the
    /// model: the stage blends two targets.
    pub motor_delay: f64,
    /// How exactly it is simulated. It changes nothing of the robot either.
    #[serde(default)]
    pub physics: Physics,
}

impl Default for BodyParameters {
    fn default() -> Self {
        Self {
            friction: 1.0,
            base_mass: 0.0,
            hand_mass: [0.0; 2],
            base_com: [0.0; 3],
            link_mass: Vec::new(),
            link_inertia: Vec::new(),
            p_gain: Vec::new(),
            d_gain: Vec::new(),
            motor_torque: Vec::new(),
            motor_damping: Vec::new(),
            motor_delay: 0.0,
            physics: Physics::Exact,
        }
    }
}

impl BodyParameters {
    /// Whether the model is the robot's own: all is nominal but perhaps the delay.
    pub(crate) fn leave_the_model(&self) -> bool {
        let factors = [
            &self.link_mass,
            &self.link_inertia,
            &self.p_gain,
            &self.d_gain,
            &self.motor_torque,
            &self.motor_damping,
        ];
        let [left, right] = self.hand_mass;
        let [x, y, z] = self.base_com;
        self.friction == 1.0
            && [self.base_mass, left, right, x, y, z] == [0.0; 6]
            && factors.into_iter().flatten().all(|&factor| factor == 1.0)
    }
}

/// The factor of one link or joint.
pub(crate) fn factor(factors: &[f64], index: usize) -> f64 {
    factors.get(index).copied().unwrap_or(1.0)
}
