//! The joints: their limits and gains, and the graph that the goal joints form.

/// A hinge joint with its position servo: torque = kp (target − q) − kd q̇, at most `torque_limit` either way.
#[derive(Clone, Debug, PartialEq)]
pub struct Joint {
    /// Name of the joint, and of its actuator, in the model.
    pub name: String,
    /// Lower and upper limit, rad.
    pub range: [f64; 2],
    /// Stiffness of the servo, N·m/rad.
    pub kp: f64,
    /// Damping of the servo, N·m·s/rad.
    pub kd: f64,
    /// Largest torque, N·m.
    pub torque_limit: f64,
    /// Largest speed, rad/s.
    pub velocity_limit: f64,
    /// Inertia of the rotor seen at the joint, kg·m².
    pub armature: f64,
    /// Passive damping of the joint, N·m·s/rad.
    pub damping: f64,
    /// Angle in the default pose, rad.
    pub default: f64,
    /// Index of the angle in MuJoCo's `qpos`.
    pub qpos_address: usize,
    /// Index of the speed in MuJoCo's `qvel`.
    pub dof_address: usize,
}

impl Joint {
    /// The nearest angle inside the joint's range, rad.
    pub fn clamp(&self, angle: f32) -> f32 {
        let [lower, upper] = self.range.map(|limit| limit as f32);
        angle.clamp(lower, upper)
    }
}

/// A goal joint as a node of the robot's joint graph.
#[derive(Clone, Debug, PartialEq)]
pub struct GoalNode {
    /// Index of the goal joint that carries this one; none if the base does.
    pub parent: Option<usize>,
    /// Origin of the joint in the frame of its parent joint (of the base without one), all joints at zero, metres.
    pub origin_xyz: [f64; 3],
    /// Orientation of that frame: roll, pitch, yaw about fixed axes x, y, z, rad.
    pub origin_rpy: [f64; 3],
    /// Unit axis of the joint in its own frame.
    pub axis: [f64; 3],
}
