//! The controller: history → goal filter → policy → joint targets, batched over robots.
//!
//! The server, the evaluation and the demo all go through [`Controller::step`]: what is evaluated is what is served.

use std::sync::Arc;

use nalgebra::UnitQuaternion;
use serde::{Deserialize, Serialize};

use crate::{
    ModelError,
    emp::Emp,
    filters::{self, DECOUPLED, FilterError, FilterItem, GoalFilter, Risk},
    guard::{Execution, ExecutionGuard},
    observation::{History, ObservationLayout, RobotState},
    policy::Policy,
};

/// Answers after which a robot that stands at the last one stands still: a learned filter's answer depends on where the robot
/// is.
const SETTLING: usize = 3;

/// One robot's past.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ControllerState {
    history: History,
    filter_memory: Vec<f32>,
    /// What comes between the filter and the joints; none where the robot's goals are executed as the filter leaves them.
    guard: Option<ExecutionGuard>,
}

impl ControllerState {
    /// A robot without a past, seen through `layout`.
    pub fn new(layout: ObservationLayout) -> Self {
        Self {
            history: History::new(layout),
            filter_memory: Vec::new(),
            guard: None,
        }
    }

    /// The same robot with a guard between its goal filter and its joints.
    #[must_use]
    pub fn with_guard(self, guard: ExecutionGuard) -> Self {
        let guard = Some(guard);
        Self { guard, ..self }
    }

    /// The guard between the goal filter and the joints.
    pub fn guard_mut(&mut self) -> Option<&mut ExecutionGuard> {
        self.guard.as_mut()
    }

    /// Forgets everything: the next step is the first of an episode.
    pub fn reset(&mut self) {
        self.history.reset();
        self.filter_memory.clear();
        if let Some(guard) = &mut self.guard {
            guard.restart();
        }
    }

    /// The last frames.
    pub fn history(&self) -> &History {
        &self.history
    }

    /// The last frames, to put an episode's past in.
    pub fn history_mut(&mut self) -> &mut History {
        &mut self.history
    }

    /// Puts what a filter remembers in, for an episode that goes on.
    pub fn set_filter_memory(&mut self, memory: Vec<f32>) {
        self.filter_memory = memory;
    }
}

/// What one robot tells the controller in a control period.
#[derive(Clone, Copy, Debug)]
pub struct ControllerInput<'a> {
    /// What the robot measures.
    pub state: RobotState<'a>,
    /// The goal that is asked for: angles of the goal joints, rad.
    pub goal: &'a [f32],
}

/// What the controller tells one robot in a control period.
#[derive(Clone, Debug, PartialEq)]
pub struct ControllerOutput {
    /// The goal to execute: angles of the goal joints, rad.
    pub goal: Vec<f32>,
    /// The policy's action, policy units.
    pub action: Vec<f32>,
    /// Targets of the leg joints, rad, inside their ranges.
    pub leg_targets: Vec<f32>,
    /// How dangerous the filter finds the goal; none without an EMP.
    pub risk: Option<Risk>,
    /// What the guard did; none for a robot without one.
    pub execution: Option<Execution>,
}

/// A goal that went through a filter and, where the robot has one, its guard.
#[derive(Clone, Debug, PartialEq)]
pub struct FilteredGoal {
    /// The goal to execute: angles of the goal joints, rad.
    pub goal: Vec<f32>,
    /// How dangerous the filter finds the goal that was asked for; none without an EMP.
    pub risk: Option<Risk>,
    /// What the guard did; none for a robot without one.
    pub execution: Option<Execution>,
}

/// A controller up to its policy: adds a control period to each robot's history and puts its goal through a filter. The
/// newest frame of a history then holds the goal to execute (erratum E9), which is what a robot's guard leaves of the
/// filter's answer.
///
/// # Errors
/// [`ModelError::Frame`] if an input has another number of joints than `layout`, before any state has changed; when a model
/// fails.
pub fn filter_goals(
    layout: &ObservationLayout,
    filter: Option<&dyn GoalFilter>,
    batch: &mut [(&mut ControllerState, ControllerInput<'_>)],
) -> Result<Vec<FilteredGoal>, ModelError> {
    for (index, (_, input)) in batch.iter().enumerate() {
        check(layout, index, input)?;
    }
    for (robot, input) in batch.iter_mut() {
        robot.history.push(&input.state, input.goal);
    }
    let asked = batch.iter().map(|(_, input)| FilteredGoal {
        goal: input.goal.to_vec(),
        risk: None,
        execution: None,
    });
    let mut goals: Vec<FilteredGoal> = asked.collect();
    if let Some(filter) = filter {
        let robots = batch.iter_mut().zip(&mut goals);
        let mut items: Vec<FilterItem<'_>> = robots
            .map(|((robot, _), filtered)| FilterItem {
                observation: robot.history.stack(),
                goal: &mut filtered.goal,
                memory: &mut robot.filter_memory,
                risk: &mut filtered.risk,
            })
            .collect();
        filter.filter(&mut items)?;
    }
    for ((robot, input), filtered) in batch.iter_mut().zip(&mut goals) {
        if let Some(guard) = &mut robot.guard {
            let measured = &input.state.joint_positions[..input.goal.len()];
            filtered.execution = Some(guard.step(measured, input.goal, &mut filtered.goal));
        }
        robot.history.set_newest_goal(&filtered.goal);
    }
    Ok(goals)
}

fn check(
    layout: &ObservationLayout,
    index: usize,
    input: &ControllerInput<'_>,
) -> Result<(), ModelError> {
    let widths = [
        (
            "joint positions",
            input.state.joint_positions.len(),
            layout.joint_positions().len(),
        ),
        ("goal angles", input.goal.len(), layout.goal().len()),
    ];
    match widths
        .into_iter()
        .find(|(_, found, expected)| found != expected)
    {
        Some((what, found, expected)) => Err(ModelError::Frame {
            index,
            reason: format!("{found} {what}, expected {expected}"),
        }),
        None => Ok(()),
    }
}

/// A policy with an optional goal filter before it.
#[derive(Clone)]
pub struct Controller {
    policy: Arc<Policy>,
    filter: Option<Arc<dyn GoalFilter>>,
}

impl Controller {
    /// A controller; without a filter it is the paper's decoupled policy.
    pub fn new(policy: Arc<Policy>, filter: Option<Arc<dyn GoalFilter>>) -> Self {
        Self { policy, filter }
    }

    /// The controller that `specification` asks for: [`DECOUPLED`] or a filter of [`filters::LIST`], with parameters.
    ///
    /// # Errors
    /// As of [`filters::by_name`].
    pub fn by_name(
        specification: &str,
        policy: &Arc<Policy>,
        emp: Option<&Arc<Emp>>,
    ) -> Result<Self, FilterError> {
        let filter = filters::by_name(specification, policy.robot(), emp)?;
        Ok(Self::new(Arc::clone(policy), filter))
    }

    /// The filter's name, or [`DECOUPLED`].
    pub fn name(&self) -> &str {
        self.filter
            .as_ref()
            .map_or(DECOUPLED, |filter| filter.name())
    }

    /// The policy.
    pub fn policy(&self) -> &Arc<Policy> {
        &self.policy
    }

    /// A robot without a past.
    pub fn state(&self) -> ControllerState {
        ControllerState::new(*self.layout())
    }

    fn layout(&self) -> &ObservationLayout {
        self.policy.layout()
    }

    /// The goals that robots execute which were long asked for `goals` (rad, one a robot) and stand at rest there, legs in
    /// their default pose: the filter's own answers, each with the robot at the answer before. A filter that only slows motion
    /// down leaves them as they are.
    ///
    /// # Errors
    /// As of [`step`](Self::step).
    pub fn settled_goals(&self, goals: &[&[f32]]) -> Result<Vec<Vec<f32>>, ModelError> {
        let mut settled: Vec<Vec<f32>> = goals.iter().map(|goal| goal.to_vec()).collect();
        let Some(filter) = &self.filter else {
            return Ok(settled);
        };
        let legs = self.policy.robot().default_legs();
        for _ in 0..SETTLING {
            let poses: Vec<Vec<f32>> = settled
                .iter()
                .map(|goal| goal.iter().chain(&legs).copied().collect())
                .collect();
            let mut robots = vec![self.state(); goals.len()];
            let inputs = poses.iter().zip(goals).map(|(pose, goal)| ControllerInput {
                state: RobotState {
                    joint_positions: pose,
                    orientation: UnitQuaternion::identity(),
                },
                goal,
            });
            let mut batch: Vec<_> = robots.iter_mut().zip(inputs).collect();
            let answers = filter_goals(self.layout(), Some(filter.as_ref()), &mut batch)?;
            settled = answers.into_iter().map(|answer| answer.goal).collect();
        }
        Ok(settled)
    }

    /// One control period of a batch of robots.
    ///
    /// # Errors
    /// [`ModelError::Frame`] if an input has another number of joints than the robot, before any state has changed; when a
    /// model fails.
    pub fn step(
        &self,
        batch: &mut [(&mut ControllerState, ControllerInput<'_>)],
    ) -> Result<Vec<ControllerOutput>, ModelError> {
        let goals = filter_goals(self.layout(), self.filter.as_deref(), batch)?;
        let mut observations = Vec::with_capacity(batch.len() * self.layout().width());
        for (robot, _) in batch.iter() {
            observations.extend_from_slice(robot.history.stack());
        }
        let actions = self.policy.actions(&observations)?;
        let legs = self.layout().last_action().len();
        let answers = batch.iter_mut().zip(goals);
        Ok(answers
            .zip(actions.chunks_exact(legs))
            .map(|(((robot, _), filtered), action)| {
                robot.history.set_last_action(action);
                let FilteredGoal {
                    goal,
                    risk,
                    execution,
                } = filtered;
                ControllerOutput {
                    goal,
                    action: action.to_vec(),
                    leg_targets: self.policy.leg_targets(action),
                    risk,
                    execution,
                }
            })
            .collect())
    }
}
