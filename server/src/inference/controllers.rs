//! A robot's controllers and goal filters as backends: one of each for every mode of the EMP, all over one policy and one
//! EMP. A batch is split by mode.

use std::sync::Arc;

use emp_models::{
    ModelError,
    assessment::{Assessment, GoalPath, assess},
    controller::{
        Controller, ControllerInput, ControllerOutput, ControllerState, FilteredGoal, filter_goals,
    },
    emp::Emp,
    filters::{EmpFilter, GoalFilter, Risk},
    guard::Execution,
    observation::{ObservationLayout, RobotState},
    policy::Policy,
};
use emp_robot::Robot;
use nalgebra::UnitQuaternion;

use super::backend::{Backend, BackendError, LARGEST_ANGLE, sound};
use crate::decode::fields::LARGEST_ACTION;

/// When an EMP changes a goal.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) enum EmpMode {
    /// Never.
    #[default]
    Off,
    /// In every control period.
    On,
    /// While there is danger.
    WhenDanger,
}

impl EmpMode {
    const ALL: [Self; 3] = [Self::Off, Self::On, Self::WhenDanger];

    /// The mode where none is asked for.
    pub(crate) fn usual(has_emp: bool) -> Self {
        if has_emp { Self::On } else { Self::Off }
    }
}

/// One control period of one robot, and its past.
#[derive(Debug, Clone)]
pub(crate) struct ControlInput {
    /// When the EMP changes the goal.
    pub(crate) mode: EmpMode,
    /// The robot's past, without this control period.
    pub(crate) state: ControllerState,
    /// Angles of all joints, goal joints first, rad.
    pub(crate) joint_positions: Vec<f32>,
    /// Orientation of the base in a world frame with z up.
    pub(crate) orientation: UnitQuaternion<f64>,
    /// The goal that is asked for: angles of the goal joints, rad.
    pub(crate) goal: Vec<f32>,
}

impl ControlInput {
    fn robot_state(&self) -> RobotState<'_> {
        RobotState {
            joint_positions: &self.joint_positions,
            orientation: self.orientation,
        }
    }

    fn controller_input(&self) -> ControllerInput<'_> {
        ControllerInput {
            state: self.robot_state(),
            goal: &self.goal,
        }
    }

    /// What became of the goal.
    fn assess(
        &self,
        robot: &Robot,
        executable: &[f32],
        execution: Option<&Execution>,
    ) -> Result<Assessment, ModelError> {
        let goal = GoalPath {
            asked: &self.goal,
            filtered: execution.map_or(executable, |execution| &execution.wanted),
            executable,
        };
        assess(robot, &self.robot_state(), &goal)
    }
}

/// A policy's answer to one control period.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct PolicyOutput {
    /// The robot's past, this control period included.
    pub(crate) state: ControllerState,
    /// What the robot is told.
    pub(crate) output: ControllerOutput,
    /// What became of the goal.
    pub(crate) assessment: Assessment,
}

/// An EMP's answer to one control period.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct FilterOutput {
    /// The robot's past, this control period included.
    pub(crate) state: ControllerState,
    /// The goal to execute.
    pub(crate) filtered: FilteredGoal,
    /// What became of the goal.
    pub(crate) assessment: Assessment,
}

/// A robot's controllers.
#[derive(Clone)]
pub(crate) struct Controllers {
    off: Controller,
    emp: Option<WithEmp>,
}

#[derive(Clone)]
struct WithEmp {
    emp: Arc<Emp>,
    on: Controller,
    when_danger: Controller,
}

impl Controllers {
    pub(crate) fn new(policy: Arc<Policy>, emp: Option<Arc<Emp>>) -> Self {
        let with = |filter: EmpFilter| Controller::new(Arc::clone(&policy), Some(Arc::new(filter)));
        let emp = emp.map(|emp| WithEmp {
            on: with(always(&emp)),
            when_danger: with(when_danger(&emp)),
            emp,
        });
        let off = Controller::new(policy, None);
        Self { off, emp }
    }

    pub(crate) fn policy(&self) -> &Arc<Policy> {
        self.off.policy()
    }

    pub(crate) fn emp(&self) -> Option<&Arc<Emp>> {
        self.emp.as_ref().map(|with| &with.emp)
    }

    /// A robot without a past.
    pub(crate) fn state(&self) -> ControllerState {
        self.off.state()
    }

    fn controller(&self, mode: EmpMode) -> Result<&Controller, BackendError> {
        match (mode, &self.emp) {
            (EmpMode::Off, _) => Ok(&self.off),
            (EmpMode::On, Some(with)) => Ok(&with.on),
            (EmpMode::WhenDanger, Some(with)) => Ok(&with.when_danger),
            (EmpMode::On | EmpMode::WhenDanger, None) => {
                let robot = self.policy().robot().name();
                Err(BackendError::new(format!("{robot} has no EMP")))
            }
        }
    }

    fn step(
        &self,
        mode: EmpMode,
        inputs: &[&ControlInput],
    ) -> Result<Vec<PolicyOutput>, BackendError> {
        let controller = self.controller(mode)?;
        let mut states = states(inputs);
        let outputs = controller.step(&mut batch(&mut states, inputs))?;
        let robot = self.policy().robot();
        let answers = inputs.iter().zip(states).zip(outputs);
        answers
            .map(|((input, state), output)| {
                Ok(PolicyOutput {
                    assessment: input.assess(robot, &output.goal, output.execution.as_ref())?,
                    state,
                    output,
                })
            })
            .collect()
    }
}

impl Backend for Controllers {
    type Input = ControlInput;
    type Output = PolicyOutput;

    fn run(&mut self, batch: &[ControlInput]) -> Result<Vec<PolicyOutput>, BackendError> {
        by_mode(batch, |mode, inputs| self.step(mode, inputs))
    }

    fn check(&self, output: &PolicyOutput) -> Result<(), BackendError> {
        let ControllerOutput {
            goal,
            action,
            leg_targets,
            risk,
            ..
        } = &output.output;
        sound("the goal", goal, LARGEST_ANGLE)?;
        sound("the action", action, LARGEST_ACTION)?;
        sound("the leg targets", leg_targets, LARGEST_ANGLE)?;
        check_assessment(risk.as_ref(), &output.assessment)
    }
}

fn check_assessment(risk: Option<&Risk>, assessment: &Assessment) -> Result<(), BackendError> {
    if let Some(risk) = risk {
        sound("regloss", &[risk.regloss, risk.applied], f32::MAX)?;
    }
    sound("the change", &assessment.change, 2.0 * LARGEST_ANGLE)?;
    let margin = assessment.center_of_mass_margin;
    sound("the centre of mass", &[margin], f32::MAX)?;
    let nearest = assessment.nearest_links.map(|nearest| nearest.distance);
    sound(
        "the links' distance",
        &[nearest.unwrap_or_default()],
        f32::MAX,
    )
}

/// A robot's goal filters.
#[derive(Clone)]
pub(crate) struct Filters {
    emp: Arc<Emp>,
    on: EmpFilter,
    when_danger: EmpFilter,
}

impl Filters {
    pub(crate) fn new(emp: Arc<Emp>) -> Self {
        Self {
            on: always(&emp),
            when_danger: when_danger(&emp),
            emp,
        }
    }

    pub(crate) fn robot(&self) -> &Arc<Robot> {
        self.emp.robot()
    }

    pub(crate) fn emp(&self) -> &Arc<Emp> {
        &self.emp
    }

    pub(crate) fn layout(&self) -> &ObservationLayout {
        &self.emp.config().observation
    }

    /// A robot without a past.
    pub(crate) fn state(&self) -> ControllerState {
        ControllerState::new(*self.layout())
    }

    fn step(
        &self,
        mode: EmpMode,
        inputs: &[&ControlInput],
    ) -> Result<Vec<FilterOutput>, BackendError> {
        let filter: Option<&dyn GoalFilter> = match mode {
            EmpMode::Off => None,
            EmpMode::On => Some(&self.on),
            EmpMode::WhenDanger => Some(&self.when_danger),
        };
        let mut states = states(inputs);
        let filtered = filter_goals(self.layout(), filter, &mut batch(&mut states, inputs))?;
        let answers = inputs.iter().zip(states).zip(filtered);
        answers
            .map(|((input, state), filtered)| {
                Ok(FilterOutput {
                    assessment: input.assess(
                        self.robot(),
                        &filtered.goal,
                        filtered.execution.as_ref(),
                    )?,
                    state,
                    filtered,
                })
            })
            .collect()
    }
}

impl Backend for Filters {
    type Input = ControlInput;
    type Output = FilterOutput;

    fn run(&mut self, batch: &[ControlInput]) -> Result<Vec<FilterOutput>, BackendError> {
        by_mode(batch, |mode, inputs| self.step(mode, inputs))
    }

    fn check(&self, output: &FilterOutput) -> Result<(), BackendError> {
        let FilteredGoal { goal, risk, .. } = &output.filtered;
        sound("the goal", goal, LARGEST_ANGLE)?;
        check_assessment(risk.as_ref(), &output.assessment)
    }
}

fn always(emp: &Arc<Emp>) -> EmpFilter {
    EmpFilter::always(Arc::clone(emp))
}

/// With the checkpoint's own gate.
fn when_danger(emp: &Arc<Emp>) -> EmpFilter {
    EmpFilter::when_danger(Arc::clone(emp), emp.config().gate)
}

fn states(inputs: &[&ControlInput]) -> Vec<ControllerState> {
    inputs.iter().map(|input| input.state.clone()).collect()
}

fn batch<'a>(
    states: &'a mut [ControllerState],
    inputs: &[&'a ControlInput],
) -> Vec<(&'a mut ControllerState, ControllerInput<'a>)> {
    let inputs = inputs.iter().map(|input| input.controller_input());
    states.iter_mut().zip(inputs).collect()
}

/// Answers a batch mode by mode, in the batch's order.
fn by_mode<O>(
    batch: &[ControlInput],
    mut step: impl FnMut(EmpMode, &[&ControlInput]) -> Result<Vec<O>, BackendError>,
) -> Result<Vec<O>, BackendError> {
    let mut answers: Vec<(usize, O)> = Vec::with_capacity(batch.len());
    for mode in EmpMode::ALL {
        let members = batch.iter().enumerate();
        let (places, inputs): (Vec<usize>, Vec<&ControlInput>) =
            members.filter(|(_, input)| input.mode == mode).unzip();
        if !inputs.is_empty() {
            answers.extend(places.into_iter().zip(step(mode, &inputs)?));
        }
    }
    answers.sort_unstable_by_key(|(place, _)| *place);
    Ok(answers.into_iter().map(|(_, answer)| answer).collect())
}

#[cfg(test)]
mod tests {
    use emp_models::observation::HISTORY;

    use super::*;

    fn robot() -> Arc<Robot> {
        Arc::new(Robot::load("../robots/emp27".as_ref()).expect("it ships"))
    }

    fn input(robot: &Robot, mode: EmpMode, number: f32) -> ControlInput {
        let goals = robot.goal_joints().len();
        ControlInput {
            mode,
            state: ControllerState::new(ObservationLayout::new(robot, HISTORY)),
            joint_positions: robot.joints().map(|joint| joint.default as f32).collect(),
            orientation: UnitQuaternion::identity(),
            goal: vec![number; goals],
        }
    }

    #[test]
    fn a_batch_is_split_by_mode_and_keeps_its_order() {
        let robot = robot();
        let modes = [
            EmpMode::On,
            EmpMode::Off,
            EmpMode::WhenDanger,
            EmpMode::On,
            EmpMode::Off,
        ];
        let batch: Vec<_> = (0_u8..)
            .zip(modes)
            .map(|(number, mode)| input(&robot, mode, f32::from(number)))
            .collect();
        let mut calls = Vec::new();
        let answers = by_mode(&batch, |mode, inputs| {
            assert!(inputs.iter().all(|input| input.mode == mode));
            calls.push((mode, inputs.len()));
            Ok(inputs.iter().map(|input| (mode, input.goal[0])).collect())
        });
        let expected: Vec<_> = modes.into_iter().zip([0.0, 1.0, 2.0, 3.0, 4.0]).collect();
        assert_eq!(answers.expect("no failure"), expected);
        assert_eq!(
            calls,
            [
                (EmpMode::Off, 2),
                (EmpMode::On, 2),
                (EmpMode::WhenDanger, 1)
            ]
        );
    }
}
