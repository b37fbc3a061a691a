//! Static balance: the centre of mass over the feet.

use std::sync::Arc;

use emp_robot::{Robot, SupportPolygon};
use nalgebra::{UnitQuaternion, Vector2, Vector3};

use super::{error::FilterError, goal_filter::FilterItem, parameters::Parameters, rule::Rule};
use crate::observation::ObservationLayout;

/// The margin without a parameter, as a share of the default pose's own.
const USUAL_SHARE: f64 = 0.7;
/// Halvings of the way to the default pose: to a thousandth of it.
const BISECTIONS: usize = 10;

/// Pulls a goal back along the line to the default pose until the centre of mass, projected on the floor, is far enough
/// inside the feet's support.
///
/// Parameters: `margin`, metres from the support polygon's nearest edge (without it 0.7 of the default pose's own); `legs`, `default` (the robot upright, its legs in
/// the default pose) or `measured` (legs, roll and pitch as in the observation's newest frame). Masses are the robot's own;
/// what the hands carry is unknown. Where even the default pose lacks the margin, that pose is the answer.
pub(super) struct StaticClamp {
    robot: Arc<Robot>,
    layout: ObservationLayout,
    polygon: SupportPolygon,
    margin: f64,
    measured: bool,
    /// Default angles of all joints, rad.
    default: Vec<f32>,
}

impl StaticClamp {
    pub(super) fn new(
        parameters: &mut Parameters<'_>,
        robot: &Arc<Robot>,
    ) -> Result<Self, FilterError> {
        let margin = parameters.number("margin", 0.0..=1.0, " m")?;
        let legs = parameters.word("legs", &["default", "measured"])?;
        parameters.finish("margin or legs")?;
        let mut clamp = Self {
            layout: ObservationLayout::new(robot, 1),
            polygon: robot.support_polygon(),
            margin: 0.0,
            measured: legs == Some("measured"),
            default: robot.default_pose(),
            robot: Arc::clone(robot),
        };
        let most = clamp.margin(&clamp.default, &UnitQuaternion::identity());
        clamp.margin = margin.unwrap_or(USUAL_SHARE * most);
        if clamp.margin > most {
            let expected = format!("at most the default pose's own, {most:.4} m");
            return Err(parameters.value("margin", expected, clamp.margin.to_string()));
        }
        Ok(clamp)
    }

    /// How far inside the support polygon the centre of mass is, metres; `q` are the angles of all joints.
    pub(super) fn margin(&self, q: &[f32], orientation: &UnitQuaternion<f64>) -> f64 {
        let kinematics = self.robot.kinematics();
        let mut row = vec![0.0; kinematics.output_width()];
        kinematics.forward(q, &mut row);
        let layout = kinematics.layout();
        let point = |part: &std::ops::Range<usize>| {
            Vector3::from_column_slice(&row[part.clone()]).cast::<f64>()
        };
        let arm = orientation * (point(&layout.center_of_mass) - point(&layout.foot_support));
        self.polygon.margin(&Vector2::new(arm.x, arm.y))
    }

    /// Legs and tilt that the goals are judged with.
    fn stance(&self, observation: &[f32]) -> (Vec<f32>, UnitQuaternion<f64>) {
        if !self.measured {
            return (self.default.clone(), UnitQuaternion::identity());
        }
        let newest = &observation[observation.len() - self.layout.frame_width()..];
        let orientation = &newest[self.layout.orientation()];
        let [roll, pitch] = [0, 1].map(|i| f64::from(orientation[i]));
        (
            newest[self.layout.joint_positions()].to_vec(),
            UnitQuaternion::from_euler_angles(roll, pitch, 0.0),
        )
    }
}

impl Rule for StaticClamp {
    fn apply(&self, item: &mut FilterItem<'_>) {
        let (mut q, orientation) = self.stance(item.observation);
        let goals = item.goal.len();
        let goal = item.goal.to_vec();
        let mut is_safe = |share: f32| {
            let line = self.default.iter().zip(&goal);
            for (angle, (default, goal)) in q[..goals].iter_mut().zip(line) {
                *angle = default + share * (goal - default);
            }
            self.margin(&q, &orientation) >= self.margin
        };
        if is_safe(1.0) {
            return;
        }
        let (mut safe, mut unsafe_share) = (0.0, 1.0);
        for _ in 0..BISECTIONS {
            let middle = f32::midpoint(safe, unsafe_share);
            if is_safe(middle) {
                safe = middle;
            } else {
                unsafe_share = middle;
            }
        }
        for (angle, default) in item.goal.iter_mut().zip(&self.default) {
            *angle = default + safe * (*angle - default);
        }
    }
}
