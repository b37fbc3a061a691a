//! Watching evaluations.

use std::sync::Arc;

use emp_proto::v1::WatchEvaluationResponse;

use super::jobs::EvaluationJob;
use crate::{error::ServiceError, session::Outbound};

/// Tells what an evaluation does, from an event on, to its end.
pub(crate) async fn watch(
    job: Arc<EvaluationJob>,
    first_event: u64,
    outbound: Outbound<WatchEvaluationResponse>,
) -> Result<(), ServiceError> {
    let mut number = usize::try_from(first_event).unwrap_or(usize::MAX);
    let mut progress = job.progress();
    loop {
        progress.mark_unchanged();
        while let Some(message) = job.event(number) {
            let response = WatchEvaluationResponse {
                message: Some(message),
                event: number as u64,
            };
            if outbound.send(response).await.is_err() {
                return Ok(());
            }
            number += 1;
        }
        if let Some(end) = job.end() {
            return end;
        }
        if progress.changed().await.is_err() {
            return Ok(());
        }
    }
}
