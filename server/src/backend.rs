//! What the batcher asks of a model: a batch in, as many answers out. The transport knows models only through this.

use std::{path::PathBuf, sync::Arc};

use emp_models::{
    ModelError,
    controller::{Controller, ControllerInput, ControllerOutput, ControllerState},
    observation::RobotState,
    policy::Policy,
    retarget::{RetargetInput, RetargetOutput, Retargeter},
};
use emp_robot::Robot;
use nalgebra::UnitQuaternion;

/// A model that answers whole batches. It lives on one thread of its own and may block there.
pub trait Backend: Send + 'static {
    /// One item of a batch.
    type Input: Send + 'static;
    /// The answer to one item.
    type Output: Send + 'static;

    /// Answers a batch of at least one input, in order. A panic counts as a failure of the model: it fails the batch,
    /// and the model is built anew.
    ///
    /// # Errors
    /// Fails the whole batch; the model stays in use.
    fn run(&mut self, batch: &[Self::Input]) -> Result<Vec<Self::Output>, BackendError>;
}

/// Why a model could not be built or could not answer a batch, in words for a person to read.
#[derive(Debug, Clone, thiserror::Error)]
#[error("{0}")]
pub struct BackendError(String);

impl BackendError {
    /// An error with this explanation.
    pub fn new(explanation: impl Into<String>) -> Self {
        Self(explanation.into())
    }
}

impl From<ModelError> for BackendError {
    fn from(error: ModelError) -> Self {
        Self::new(error.to_string())
    }
}

/// A model of whatever make that answers these inputs with these outputs.
pub type BoxedBackend<I, O> = Box<dyn Backend<Input = I, Output = O>>;

/// A model that retargets human poses.
pub type RetargetBackend = BoxedBackend<RetargetInput, RetargetOutput>;

/// Builds a model, at the start and again after it panicked. Runs on the model's own thread.
pub type Build<I, O> = Box<dyn FnMut() -> Result<BoxedBackend<I, O>, BackendError> + Send>;

/// One control period of one robot, and its past.
#[derive(Debug, Clone)]
pub struct PolicyInput {
    /// The robot's past, without this control period.
    pub state: ControllerState,
    /// Angles of all joints, goal joints first, rad.
    pub joint_positions: Vec<f32>,
    /// Orientation of the base in a world frame with z up.
    pub orientation: UnitQuaternion<f64>,
    /// The goal that is asked for: angles of the goal joints, rad.
    pub goal: Vec<f32>,
}

/// The answer to one control period.
#[derive(Debug, Clone, PartialEq)]
pub struct PolicyOutput {
    /// The robot's past, this control period included.
    pub state: ControllerState,
    /// What the robot is told.
    pub output: ControllerOutput,
}

/// A model as it was loaded first, then loaded again from its file.
pub(crate) fn first_then<I: 'static, O: 'static, B>(
    first: B,
    mut again: impl FnMut() -> Result<B, ModelError> + Send + 'static,
) -> Build<I, O>
where
    B: Backend<Input = I, Output = O>,
{
    let mut first = Some(first);
    Box::new(move || {
        let backend = match first.take() {
            Some(loaded) => loaded,
            None => again()?,
        };
        Ok(Box::new(backend))
    })
}

/// Loads the shipped retargeting network from a weights file, each time anew.
pub(crate) fn retargeter_from(
    weights: PathBuf,
    robot: Arc<Robot>,
) -> impl FnMut() -> Result<Arc<Retargeter>, ModelError> + Send + 'static {
    move || Retargeter::load(&weights, Arc::clone(&robot)).map(Arc::new)
}

/// Loads the shipped policy from a weights file, each time anew.
pub(crate) fn policy_from(
    weights: PathBuf,
    robot: Arc<Robot>,
) -> impl FnMut() -> Result<Controller, ModelError> + Send + 'static {
    move || {
        let policy = Policy::load(&weights, Arc::clone(&robot))?;
        Ok(Controller::new(Arc::new(policy), None))
    }
}

impl Backend for Arc<Retargeter> {
    type Input = RetargetInput;
    type Output = RetargetOutput;

    fn run(&mut self, batch: &[RetargetInput]) -> Result<Vec<RetargetOutput>, BackendError> {
        Ok(self.retarget(batch)?)
    }
}

impl Backend for Controller {
    type Input = PolicyInput;
    type Output = PolicyOutput;

    fn run(&mut self, batch: &[PolicyInput]) -> Result<Vec<PolicyOutput>, BackendError> {
        let mut states: Vec<ControllerState> =
            batch.iter().map(|input| input.state.clone()).collect();
        let inputs = batch.iter().map(|input| ControllerInput {
            state: RobotState {
                joint_positions: &input.joint_positions,
                orientation: input.orientation,
            },
            goal: &input.goal,
        });
        let outputs = self.step(&mut states.iter_mut().zip(inputs).collect::<Vec<_>>())?;
        let answers = states.into_iter().zip(outputs);
        Ok(answers
            .map(|(state, output)| PolicyOutput { state, output })
            .collect())
    }
}

impl<I: Send + 'static, O: Send + 'static> Backend for BoxedBackend<I, O> {
    type Input = I;
    type Output = O;

    fn run(&mut self, batch: &[I]) -> Result<Vec<O>, BackendError> {
        (**self).run(batch)
    }
}
