//! A robot's state, goal and past off the wire: checked field by field against the robot.

use emp_models::{
    controller::{Controller, ControllerState},
    observation::RobotState,
};
use emp_proto::v1;
use emp_robot::Robot;
use nalgebra::UnitQuaternion;

use crate::{backend::PolicyInput, check, error::FieldError};

/// What a robot measures and what it is to do, of one control period.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ControlPeriod {
    pub(crate) joint_positions: Vec<f32>,
    pub(crate) orientation: UnitQuaternion<f64>,
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
        let missing = |field: &str| FieldError::new(format!("{prefix}{field}"), "it is missing");
        let state = state.ok_or_else(|| missing("state"))?;
        check::angles(
            &format!("{prefix}state.joint_positions"),
            &state.joint_positions,
            robot.joints(),
        )?;
        let orientation = state
            .base_orientation
            .as_ref()
            .ok_or_else(|| missing("state.base_orientation"))?;
        let orientation = check::rotation(&format!("{prefix}state.base_orientation"), orientation)?;
        check::angles(&format!("{prefix}goal"), goal, robot.goal_joints().iter())?;
        Ok(Self {
            joint_positions: state.joint_positions.clone(),
            orientation,
            goal: goal.to_vec(),
        })
    }

    /// This control period after `past`.
    pub(crate) fn after(self, past: ControllerState) -> PolicyInput {
        let Self {
            joint_positions,
            orientation,
            goal,
        } = self;
        PolicyInput {
            state: past,
            joint_positions,
            orientation,
            goal,
        }
    }
}

/// Reads the history of a unary call: the last of it is now, the others are the past.
pub(crate) fn read_history(
    history: &[v1::PolicyObservation],
    start_heading: Option<f32>,
    controller: &Controller,
) -> Result<PolicyInput, FieldError> {
    let (longest, given) = (controller.policy().layout().history(), history.len());
    let Some((now, before)) = history.split_last() else {
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
    let robot = controller.policy().robot();
    let mut past = controller.state();
    if let Some(heading) = start_heading {
        if !heading.is_finite() {
            let description = format!("{heading}; expected a finite number");
            return Err(FieldError::new("start_heading", description));
        }
        past.history_mut().set_heading(f64::from(heading));
    }
    for (index, observation) in before.iter().enumerate() {
        let period = read_observation(index, observation, robot, &mut past)?;
        let state = RobotState {
            joint_positions: &period.joint_positions,
            orientation: period.orientation,
        };
        past.history_mut().push(&state, &period.goal);
    }
    Ok(read_observation(before.len(), now, robot, &mut past)?.after(past))
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
    let legs = robot.leg_joints().len();
    if last_action.is_empty() {
        past.history_mut().set_last_action(&vec![0.0; legs]);
    } else {
        check::numbers(
            &format!("{prefix}last_action"),
            last_action,
            legs,
            "numbers",
        )?;
        past.history_mut().set_last_action(last_action);
    }
    Ok(period)
}
