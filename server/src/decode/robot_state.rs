//! A robot's state, goal and past off the wire: checked field by field against the robot.

use std::time::Duration;

use emp_models::{
    controller::ControllerState,
    filters::EmpFilter,
    observation::{ObservationLayout, RobotState},
};
use emp_proto::v1;
use emp_robot::Robot;
use nalgebra::UnitQuaternion;

use super::deadline;
use super::fields::{self, LARGEST_ACTION};
use crate::{
    error::FieldError,
    inference::controllers::{ControlInput, EmpMode},
};

/// Largest speed of a joint or of the base, rad/s.
const LARGEST_SPEED: f32 = 1_000.0;

/// What a robot measures at one moment.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Measured {
    /// Angles of all joints, goal joints first, rad.
    pub(crate) joint_positions: Vec<f32>,
    /// Orientation of the base.
    pub(crate) orientation: UnitQuaternion<f64>,
    /// When, on the robot's own clock.
    pub(crate) time: Option<Duration>,
}

impl Measured {
    /// Whether the sensors say the same, number for number.
    pub(crate) fn is_same_as(&self, other: &Self) -> bool {
        self.joint_positions == other.joint_positions && self.orientation == other.orientation
    }
}

/// What a robot measures and what it is to do, of one control period.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ControlPeriod {
    pub(crate) measured: Measured,
    pub(crate) goal: Vec<f32>,
}

impl ControlPeriod {
    /// Reads the fields `state` and `goal`; field paths start with `prefix`.
    pub(crate) fn read(
        prefix: &str,
        state: Option<&v1::RobotState>,
        goal: &[f32],
        robot: &Robot,
    ) -> Result<Self, FieldError> {
        let measured = read_state(&format!("{prefix}state"), state, robot)?;
        fields::angles(&format!("{prefix}goal"), goal, robot.goal_joints().iter())?;
        Ok(Self {
            measured,
            goal: goal.to_vec(),
        })
    }

    /// This control period after `past`.
    pub(crate) fn after(self, past: ControllerState, mode: EmpMode) -> ControlInput {
        let Self { measured, goal } = self;
        ControlInput {
            mode,
            state: past,
            joint_positions: measured.joint_positions,
            orientation: measured.orientation,
            goal,
        }
    }
}

/// Reads what a robot measures; `path` is where it stands in its message.
pub(crate) fn read_state(
    path: &str,
    state: Option<&v1::RobotState>,
    robot: &Robot,
) -> Result<Measured, FieldError> {
    let state = state.ok_or_else(|| FieldError::new(path, "it is missing"))?;
    let below = |name: &str| format!("{path}.{name}");
    let positions = &state.joint_positions;
    fields::angles(&below("joint_positions"), positions, robot.joints())?;
    let velocities = &state.joint_velocities;
    if !velocities.is_empty() {
        let path = below("joint_velocities");
        fields::bounded(&path, velocities, positions.len(), LARGEST_SPEED)?;
    }
    if let Some(v1::AngularVelocity { x, y, z }) = state.base_angular_velocity {
        let path = below("base_angular_velocity");
        for (name, value) in [("x", x), ("y", y), ("z", z)] {
            fields::finite(&path, [(name, value)])?;
            fields::within(
                &format!("{path}.{name}"),
                value,
                -LARGEST_SPEED..=LARGEST_SPEED,
            )?;
        }
    }
    let path = below("base_orientation");
    let orientation = state.base_orientation.as_ref();
    let orientation = orientation.ok_or_else(|| FieldError::new(&path, "it is missing"))?;
    let time = state.measurement_time.as_ref();
    let time = time.map(|time| deadline::duration(&below("measurement_time"), time));
    Ok(Measured {
        joint_positions: positions.clone(),
        orientation: fields::rotation(&path, orientation)?,
        time: time.transpose()?,
    })
}

/// The mode that a field asks for: on where it is not specified and the robot has an EMP.
pub(crate) fn read_mode(field: &str, number: i32, has_emp: bool) -> Result<EmpMode, FieldError> {
    let mode = match v1::EmpMode::try_from(number) {
        Ok(v1::EmpMode::Unspecified) => EmpMode::usual(has_emp),
        Ok(v1::EmpMode::Off) => EmpMode::Off,
        Ok(v1::EmpMode::On) => EmpMode::On,
        Ok(v1::EmpMode::WhenDanger) => EmpMode::WhenDanger,
        Err(_) => return Err(FieldError::not_in("EmpMode", field, number)),
    };
    if mode != EmpMode::Off && !has_emp {
        let description = "the robot has no EMP here; expected EMP_MODE_OFF";
        return Err(FieldError::new(field, description));
    }
    Ok(mode)
}

/// The part of a unary call that is about a robot's last control periods.
pub(crate) struct Past<'a> {
    /// The last of them is now, the others are the past.
    pub(crate) history: &'a [v1::PolicyObservation],
    pub(crate) start_heading: Option<f32>,
    pub(crate) last_applied: f32,
}

impl Past<'_> {
    /// Reads it for a model that sees a robot through `layout`.
    pub(crate) fn read(
        &self,
        robot: &Robot,
        layout: &ObservationLayout,
        mode: EmpMode,
    ) -> Result<ControlInput, FieldError> {
        let (longest, given) = (layout.history(), self.history.len());
        let Some((now, before)) = self.history.split_last() else {
            return Err(FieldError::new(
                "history",
                format!("it is empty; expected 1 to {longest} control periods"),
            ));
        };
        if given > longest {
            return Err(FieldError::new(
                "history",
                format!("{given} control periods; expected 1 to {longest}"),
            ));
        }
        let mut past = self.start(layout)?;
        for (index, observation) in before.iter().enumerate() {
            let period = read_observation(index, observation, robot, &mut past)?;
            let state = RobotState {
                joint_positions: &period.measured.joint_positions,
                orientation: period.measured.orientation,
            };
            past.history_mut().push(&state, &period.goal);
        }
        Ok(read_observation(before.len(), now, robot, &mut past)?.after(past, mode))
    }

    /// The past before the first of its control periods.
    fn start(&self, layout: &ObservationLayout) -> Result<ControllerState, FieldError> {
        let mut past = ControllerState::new(*layout);
        if let Some(heading) = self.start_heading {
            if !heading.is_finite() {
                let description = format!("{heading}; expected a finite number");
                return Err(FieldError::new("start_heading", description));
            }
            past.history_mut().set_heading(f64::from(heading));
        }
        let applied = self.last_applied;
        if !(0.0..=1.0).contains(&applied) {
            let description = format!("{applied}; expected 0 to 1");
            return Err(FieldError::new("last_applied", description));
        }
        past.set_filter_memory(EmpFilter::memory(applied));
        Ok(past)
    }
}

/// Reads one entry of a history and tells the past which action led to it.
fn read_observation(
    index: usize,
    observation: &v1::PolicyObservation,
    robot: &Robot,
    past: &mut ControllerState,
) -> Result<ControlPeriod, FieldError> {
    let prefix = format!("history[{index}].");
    let v1::PolicyObservation {
        state,
        goal,
        last_action,
    } = observation;
    let period = ControlPeriod::read(&prefix, state.as_ref(), goal, robot)?;
    let action = read_last_action(&format!("{prefix}last_action"), last_action, robot)?;
    past.history_mut().set_last_action(&action);
    Ok(period)
}

/// The last action: all zero where there is none.
pub(crate) fn read_last_action(
    path: &str,
    action: &[f32],
    robot: &Robot,
) -> Result<Vec<f32>, FieldError> {
    let legs = robot.leg_joints().len();
    if action.is_empty() {
        return Ok(vec![0.0; legs]);
    }
    fields::bounded(path, action, legs, LARGEST_ACTION)?;
    Ok(action.to_vec())
}
