//! What the batcher asks of a model: a batch in, as many answers out. The transport knows models only through this.

use std::sync::Arc;

use emp_models::{
    ModelError,
    retarget::{RetargetInput, RetargetOutput, Retargeter},
};

/// A model that answers whole batches. It lives on one thread of its own and may block there.
pub trait Backend: Send + 'static {
    /// One item of a batch.
    type Input: Send + 'static;
    /// The answer to one item.
    type Output: Send + 'static;

    /// Answers a batch of at least one input, in order. A panic counts as a failure of the model, which is then built anew.
    ///
    /// # Errors
    /// Fails the whole batch, whose items are then tried one by one; the model stays in use.
    fn run(&mut self, batch: &[Self::Input]) -> Result<Vec<Self::Output>, BackendError>;

    /// Refuses an answer that must not leave the server. It fails its item only.
    ///
    /// # Errors
    /// When a number is not finite or absurd.
    fn check(&self, _output: &Self::Output) -> Result<(), BackendError> {
        Ok(())
    }
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

/// Builds a model, at the start and again after it panicked, from what is in memory. Runs on the model's own thread.
pub type Build<I, O> = Box<dyn FnMut() -> Result<BoxedBackend<I, O>, BackendError> + Send>;

/// Builds a model that is there: nothing of it changes while it runs, so a panic leaves nothing to mend.
pub(crate) fn from_memory<I: 'static, O: 'static, B>(model: B) -> Build<I, O>
where
    B: Backend<Input = I, Output = O> + Clone,
{
    Box::new(move || Ok(Box::new(model.clone())))
}

/// Refuses numbers that are not finite or beyond `most`, whatever their sign.
pub(crate) fn sound(what: &str, numbers: &[f32], most: f32) -> Result<(), BackendError> {
    match numbers.iter().find(|number| !(number.abs() <= most)) {
        Some(number) => Err(BackendError::new(format!(
            "it answered {number} as a number of {what}"
        ))),
        None => Ok(()),
    }
}

/// Most that an angle may be, radians: more than any joint can turn.
pub(crate) const LARGEST_ANGLE: f32 = 100.0;

impl Backend for Arc<Retargeter> {
    type Input = RetargetInput;
    type Output = RetargetOutput;

    fn run(&mut self, batch: &[RetargetInput]) -> Result<Vec<RetargetOutput>, BackendError> {
        Ok(self.retarget(batch)?)
    }

    fn check(&self, output: &RetargetOutput) -> Result<(), BackendError> {
        sound("the goal", &output.angles, LARGEST_ANGLE)?;
        sound(
            "the direction error",
            &[output.direction_error],
            LARGEST_ANGLE,
        )
    }
}

impl<I: Send + 'static, O: Send + 'static> Backend for BoxedBackend<I, O> {
    type Input = I;
    type Output = O;

    fn run(&mut self, batch: &[I]) -> Result<Vec<O>, BackendError> {
        (**self).run(batch)
    }

    fn check(&self, output: &O) -> Result<(), BackendError> {
        (**self).check(output)
    }
}
