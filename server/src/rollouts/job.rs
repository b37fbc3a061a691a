//! Jobs: long work on OS threads of their own that stand behind every stream. How many run at once is limited; a job that
//! nobody waits for any more stops at its next question.

use std::{
    any::Any,
    fmt::Display,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::Arc,
    thread,
    time::{Duration, Instant},
};

use emp_sim::{Pool, Priority, SimError};
use thread_priority::{ThreadPriority, set_current_thread_priority};
use tokio::sync::mpsc::{self, error::TrySendError};
use tokio_util::sync::CancellationToken;
use tonic::Status;

use super::jobs::JobPermit;
use crate::error::ServiceError;
use crate::inference::due;

/// Messages that wait for a slow reader before its job stops.
const OUTBOUND: usize = 16;
/// How long a client may take no message before its job is given up.
const READ_PATIENCE: Duration = Duration::from_secs(30);
/// How often a job that waits for its client asks whether it has to stop.
const GLANCE: Duration = Duration::from_millis(20);

/// The way from a job to its client. Its clones end up in the call's task and on the job's thread.
pub(crate) struct JobStream<T> {
    sender: mpsc::Sender<Result<T, Status>>,
    drain: CancellationToken,
    /// Cancelled when somebody cancels the job.
    cancelled: CancellationToken,
    deadline: Option<Instant>,
}

impl<T> Clone for JobStream<T> {
    fn clone(&self) -> Self {
        Self {
            sender: self.sender.clone(),
            drain: self.drain.clone(),
            cancelled: self.cancelled.clone(),
            deadline: self.deadline,
        }
    }
}

impl<T: Send + 'static> JobStream<T> {
    pub(crate) fn new(
        drain: CancellationToken,
        deadline: Option<Instant>,
    ) -> (Self, mpsc::Receiver<Result<T, Status>>) {
        let (sender, receiver) = mpsc::channel(OUTBOUND);
        let stream = Self {
            sender,
            drain,
            cancelled: CancellationToken::new(),
            deadline,
        };
        (stream, receiver)
    }

    /// Why the job has to stop, if it has to. Cheap: to be asked once a control period.
    pub(crate) fn check(&self) -> Result<(), ServiceError> {
        if self.sender.is_closed() {
            Err(gone())
        } else if self.drain.is_cancelled() {
            Err(ServiceError::ShuttingDown)
        } else if self.cancelled.is_cancelled() {
            Err(ServiceError::JobCancelled)
        } else if due::has_passed(self.deadline) {
            Err(ServiceError::DeadlineExceeded)
        } else {
            Ok(())
        }
    }

    /// Cancelled to stop the job.
    pub(crate) fn cancellation(&self) -> &CancellationToken {
        &self.cancelled
    }

    /// Sends a message from the job's thread; waits a while for a slow reader, unless the job has to stop.
    pub(crate) fn send(&self, message: T) -> Result<(), ServiceError> {
        let mut message = Ok(message);
        let start = Instant::now();
        loop {
            match self.sender.try_send(message) {
                Ok(()) => return Ok(()),
                Err(TrySendError::Closed(_)) => return Err(gone()),
                Err(TrySendError::Full(back)) => message = back,
            }
            self.check()?;
            if start.elapsed() > READ_PATIENCE {
                return Err(ServiceError::Silent("the client reads too slowly"));
            }
            thread::sleep(GLANCE);
        }
    }

    /// Resolves when the job has to stop, with the reason.
    pub(crate) async fn ended(&self) -> ServiceError {
        tokio::select! {
            () = self.sender.closed() => gone(),
            () = self.drain.cancelled() => ServiceError::ShuttingDown,
            () = self.cancelled.cancelled() => ServiceError::JobCancelled,
            () = due::passed(self.deadline) => ServiceError::DeadlineExceeded,
        }
    }

    /// Runs `prepare` in the call's task until the job has to stop; a failure is the call's end.
    pub(crate) async fn prepare<P>(
        &self,
        prepare: impl Future<Output = Result<P, ServiceError>>,
    ) -> Option<P> {
        let prepared = tokio::select! {
            prepared = prepare => prepared,
            error = self.ended() => Err(error),
        };
        match prepared {
            Ok(prepared) => Some(prepared),
            Err(error) => {
                tracing::info!(%error, "job refused");
                // The client may be gone; then nobody waits for the reason.
                let _ = self.sender.send(Err(error.into())).await;
                None
            }
        }
    }

    /// Runs `work` on a thread of its own with the lowest priority. `place` is free again when that has ended; a failure
    /// or a panic is the call's end.
    pub(crate) fn start(
        self,
        place: JobPermit,
        work: impl FnOnce(&Self, usize) -> Result<(), ServiceError> + Send + 'static,
    ) {
        let reply = self.sender.clone();
        let started = start(place, move |threads| {
            let worked = guarded(|| work(&self, threads));
            move || {
                if let Err(error) = worked {
                    // A client that does not read is not waited for.
                    let _ = self.sender.try_send(Err(error.into()));
                }
            }
        });
        if let Err(error) = started {
            // The channel is new and has room.
            let _ = reply.try_send(Err(error.into()));
        }
    }
}

/// Runs `work` on a thread of its own with the lowest priority, gives its place back, and then runs what it answers: so the place is
/// free before anybody hears of the end and asks for the next.
pub(super) fn start<A: FnOnce()>(
    place: JobPermit,
    work: impl FnOnce(usize) -> A + Send + 'static,
) -> Result<(), ServiceError> {
    let span = tracing::Span::current();
    let job = move || {
        let _entered = span.enter();
        // Where the system refuses, the job runs on with the usual priority.
        let _ = set_current_thread_priority(ThreadPriority::Min);
        let started = Instant::now();
        let afterwards = work(place.threads);
        drop(place);
        tracing::info!(seconds = started.elapsed().as_secs_f64(), "job ended");
        afterwards();
    };
    let spawned = thread::Builder::new()
        .name("rollout job".to_owned())
        .spawn(job);
    match spawned {
        Ok(_) => Ok(()),
        Err(error) => Err(ServiceError::JobFailed(format!(
            "no thread for it: {error}"
        ))),
    }
}

/// Runs a job's work; a panic becomes an error.
pub(super) fn guarded(work: impl FnOnce() -> Result<(), ServiceError>) -> Result<(), ServiceError> {
    let worked = catch_unwind(AssertUnwindSafe(work));
    let end = worked.unwrap_or_else(|panic| Err(panicked(&*panic)));
    if let Err(error) = &end {
        tracing::info!(%error, "job ended early");
    }
    end
}

fn gone() -> ServiceError {
    ServiceError::Transport(Status::cancelled("the client left"))
}

fn panicked(payload: &(dyn Any + Send)) -> ServiceError {
    let message = payload
        .downcast_ref::<&str>()
        .copied()
        .or_else(|| payload.downcast_ref::<String>().map(String::as_str))
        .unwrap_or("without a message");
    ServiceError::JobFailed(format!("panic: {message}"))
}

/// A job cannot go on.
pub(crate) fn failed(error: impl Display) -> ServiceError {
    ServiceError::JobFailed(error.to_string())
}

/// Threads that simulate for a job.
pub(crate) fn pool(robot: &emp_robot::Robot, threads: usize) -> Result<Arc<Pool>, SimError> {
    Pool::new(robot, threads, Priority::Low).map(Arc::new)
}
