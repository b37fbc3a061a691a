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
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio_util::sync::CancellationToken;
use tonic::Status;

use crate::{deadline, error::ServiceError, metrics::metrics, settings::RolloutSettings};

/// Messages that wait for a slow reader before its job stops.
const OUTBOUND: usize = 16;
/// When to ask again for a place; jobs are long.
const RETRY: Duration = Duration::from_secs(5);

/// Places for jobs, and the threads that each may use.
pub(crate) struct Jobs {
    places: Arc<Semaphore>,
    threads: usize,
}

/// A job's place, free again when it is dropped.
pub(crate) struct Place {
    _permit: OwnedSemaphorePermit,
    threads: usize,
}

impl Drop for Place {
    fn drop(&mut self) {
        metrics().job_ended();
    }
}

impl Jobs {
    pub(crate) fn new(settings: &RolloutSettings) -> Self {
        let places = settings.max_jobs.get().min(Semaphore::MAX_PERMITS);
        metrics().job_places(places);
        let cores = thread::available_parallelism().map_or(1, usize::from);
        Self {
            places: Arc::new(Semaphore::new(places)),
            threads: match settings.threads {
                0 => cores,
                threads => threads,
            },
        }
    }

    /// A place, if one is free.
    pub(crate) fn enter(&self) -> Result<Place, ServiceError> {
        let permit =
            Arc::clone(&self.places)
                .try_acquire_owned()
                .map_err(|_| ServiceError::Overloaded {
                    what: "as many rollout jobs run as the server allows",
                    retry: RETRY,
                })?;
        metrics().job_began();
        Ok(Place {
            _permit: permit,
            threads: self.threads,
        })
    }
}

/// The way from a job to its client. Its clones end up in the call's task and on the job's thread.
pub(crate) struct Line<T> {
    sender: mpsc::Sender<Result<T, Status>>,
    drain: CancellationToken,
    deadline: Option<Instant>,
}

impl<T> Clone for Line<T> {
    fn clone(&self) -> Self {
        Self {
            sender: self.sender.clone(),
            drain: self.drain.clone(),
            deadline: self.deadline,
        }
    }
}

impl<T: Send + 'static> Line<T> {
    pub(crate) fn new(
        drain: CancellationToken,
        deadline: Option<Instant>,
    ) -> (Self, mpsc::Receiver<Result<T, Status>>) {
        let (sender, receiver) = mpsc::channel(OUTBOUND);
        let line = Self {
            sender,
            drain,
            deadline,
        };
        (line, receiver)
    }

    /// Why the job has to stop, if it has to. Cheap: to be asked once a control period.
    pub(crate) fn check(&self) -> Result<(), ServiceError> {
        if self.sender.is_closed() {
            Err(gone())
        } else if self.drain.is_cancelled() {
            Err(ServiceError::ShuttingDown)
        } else if deadline::has_passed(self.deadline) {
            Err(ServiceError::DeadlineExceeded)
        } else {
            Ok(())
        }
    }

    /// Sends a message from the job's thread; waits for a slow reader.
    pub(crate) fn send(&self, message: T) -> Result<(), ServiceError> {
        self.sender.blocking_send(Ok(message)).map_err(|_| gone())
    }

    /// Resolves when the job has to stop, with the reason.
    pub(crate) async fn ended(&self) -> ServiceError {
        tokio::select! {
            () = self.sender.closed() => gone(),
            () = self.drain.cancelled() => ServiceError::ShuttingDown,
            () = deadline::passed(self.deadline) => ServiceError::DeadlineExceeded,
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
        place: Place,
        work: impl FnOnce(&Self, usize) -> Result<(), ServiceError> + Send + 'static,
    ) {
        let span = tracing::Span::current();
        let reply = self.sender.clone();
        let job = move || {
            let _entered = span.enter();
            // Where the system refuses, the job runs on with the usual priority.
            let _ = set_current_thread_priority(ThreadPriority::Min);
            let started = Instant::now();
            let worked = catch_unwind(AssertUnwindSafe(|| work(&self, place.threads)));
            let end = worked.unwrap_or_else(|panic| Err(panicked(&*panic)));
            let seconds = started.elapsed().as_secs_f64();
            // The place is free before the client hears of the end and asks for the next.
            drop(place);
            match end {
                Ok(()) => tracing::info!(seconds, "job done"),
                Err(error) => {
                    tracing::info!(seconds, %error, "job ended early");
                    let _ = self.sender.blocking_send(Err(error.into()));
                }
            }
        };
        if let Err(error) = thread::Builder::new()
            .name("rollout job".to_owned())
            .spawn(job)
        {
            let error = ServiceError::JobFailed(format!("no thread for it: {error}"));
            // The channel is new and has room.
            let _ = reply.try_send(Err(error.into()));
        }
    }
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
