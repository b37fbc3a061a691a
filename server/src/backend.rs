//! What the batcher asks of a model: a batch in, as many answers out. The transport knows models only through this.

use std::{path::PathBuf, sync::Arc};

use emp_models::{
    ModelError,
    retarget::{RetargetInput, RetargetOutput, Retargeter},
};
use emp_robot::Robot;

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

/// Loads a retargeter from its weights file, each time anew; without one it is inverse kinematics alone.
pub(crate) fn retargeter_from(
    weights: Option<PathBuf>,
    robot: Arc<Robot>,
) -> impl Fn() -> Result<Arc<Retargeter>, ModelError> + Send + 'static {
    move || {
        let robot = Arc::clone(&robot);
        match &weights {
            Some(weights) => Retargeter::load(weights, robot).map(Arc::new),
            None => Ok(Arc::new(Retargeter::without_network(robot))),
        }
    }
}

impl Backend for Arc<Retargeter> {
    type Input = RetargetInput;
    type Output = RetargetOutput;

    fn run(&mut self, batch: &[RetargetInput]) -> Result<Vec<RetargetOutput>, BackendError> {
        Ok(self.retarget(batch)?)
    }
}

impl<I: Send + 'static, O: Send + 'static> Backend for BoxedBackend<I, O> {
    type Input = I;
    type Output = O;

    fn run(&mut self, batch: &[I]) -> Result<Vec<O>, BackendError> {
        (**self).run(batch)
    }
}
