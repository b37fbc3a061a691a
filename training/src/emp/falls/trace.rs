//! What is kept of every frame of an evaluation.

use std::sync::Arc;

use emp_models::observation::projected_gravity;
use emp_robot::Robot;
use emp_sim::evaluation::{ExecutedFrame, Observer};
use nalgebra::{UnitQuaternion, Vector2};

use super::reach::{Reach, ReachMeter};

/// What is kept of one frame.
#[derive(Clone, Copy, Debug)]
pub(super) struct TracedFrame {
    /// From the feet's middle to the centre of mass of the robot upright with its legs in the default pose and its arms at the
    /// executed goal: x forward, y left, metres.
    pub(super) static_com: Vector2<f64>,
    /// From the feet's middle to the centre of mass, as simulated, heading frame, metres.
    pub(super) measured_com: Vector2<f64>,
    /// Angle between the base's vertical axis and the world's, rad.
    pub(super) tilt: f64,
    /// Direction of gravity along the base's forward and left axes: to where it leans.
    pub(super) lean: Vector2<f64>,
    /// Where the goal that was asked for has the hands.
    pub(super) reach: Reach,
    /// The regloss, with an EMP.
    pub(super) regloss: Option<f64>,
}

/// Angle between the base's vertical axis and the world's, rad.
fn tilt(orientation: &UnitQuaternion<f64>) -> f64 {
    let [_, _, down] = projected_gravity(orientation);
    (-down).clamp(-1.0, 1.0).acos()
}

/// Keeps every frame of every episode.
pub(super) struct Tracer {
    robot: Arc<Robot>,
    reach: ReachMeter,
    /// Default angles of all joints, rad.
    pose: Vec<f64>,
    /// A row of the kinematics.
    row: Vec<f64>,
    /// Frames by episode.
    pub(super) episodes: Vec<Vec<TracedFrame>>,
}

impl Tracer {
    pub(super) fn new(robot: &Arc<Robot>) -> Self {
        Self {
            reach: ReachMeter::new(robot),
            pose: robot.joints().map(|joint| joint.default).collect(),
            row: vec![0.0; robot.kinematics().output_width()],
            robot: Arc::clone(robot),
            episodes: Vec::new(),
        }
    }

    fn static_com(&mut self, goal: &[f32]) -> Vector2<f64> {
        for (angle, &goal) in self.pose.iter_mut().zip(goal) {
            *angle = f64::from(goal);
        }
        let kinematics = self.robot.kinematics();
        kinematics.forward(&self.pose, &mut self.row);
        let layout = kinematics.layout();
        let [com, feet] = [&layout.center_of_mass, &layout.foot_support]
            .map(|part| Vector2::new(self.row[part.start], self.row[part.start + 1]));
        com - feet
    }
}

impl Observer for Tracer {
    fn executed(&mut self, frame: &ExecutedFrame<'_>) {
        let gravity = projected_gravity(&frame.reading.orientation);
        let traced = TracedFrame {
            static_com: self.static_com(&frame.output.goal),
            measured_com: frame.reading.center_of_mass_over_feet(),
            tilt: tilt(&frame.reading.orientation),
            lean: Vector2::new(gravity[0], gravity[1]),
            reach: self.reach.measure(frame.asked),
            regloss: frame.output.risk.map(|risk| f64::from(risk.regloss)),
        };
        if self.episodes.len() <= frame.episode {
            self.episodes.resize(frame.episode + 1, Vec::new());
        }
        self.episodes[frame.episode].push(traced);
    }
}
