//! What the batcher asks of a model: a batch in, as many answers out. The transport knows models only through this.

use std::{path::PathBuf, sync::Arc};

use emp_models::retarget::{RetargetInput, RetargetOutput, Retargeter};
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

/// A model that retargets human poses, of whatever make.
pub type RetargetBackend = Box<dyn Backend<Input = RetargetInput, Output = RetargetOutput>>;

/// Builds a retargeting model, at the start and again after it panicked. Runs on the model's own thread.
pub type BuildRetargeter = Box<dyn FnMut() -> Result<RetargetBackend, BackendError> + Send>;

/// Builds the shipped retargeting network from a weights file.
pub(crate) fn retargeter_from(weights: PathBuf, robot: Arc<Robot>) -> BuildRetargeter {
    Box::new(move || {
        Retargeter::load(&weights, Arc::clone(&robot))
            .map(|model| Box::new(model) as RetargetBackend)
            .map_err(|error| BackendError::new(error.to_string()))
    })
}

impl Backend for Retargeter {
    type Input = RetargetInput;
    type Output = RetargetOutput;

    fn run(&mut self, batch: &[RetargetInput]) -> Result<Vec<RetargetOutput>, BackendError> {
        self.retarget(batch)
            .map_err(|error| BackendError::new(error.to_string()))
    }
}

impl<I: Send + 'static, O: Send + 'static> Backend for Box<dyn Backend<Input = I, Output = O>> {
    type Input = I;
    type Output = O;

    fn run(&mut self, batch: &[I]) -> Result<Vec<O>, BackendError> {
        (**self).run(batch)
    }
}
