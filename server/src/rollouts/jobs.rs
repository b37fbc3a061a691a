//! The jobs of a server: places for those that run, and what evaluations have said, for whoever watches them.

use std::{
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    thread,
    time::{Duration, Instant},
};

use emp_proto::v1::{self, JobKind, JobState, watch_evaluation_response::Message};
use rand::RngExt as _;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};
use tokio_util::sync::CancellationToken;

use super::places::{RETRY, enter};
use crate::{
    encode,
    error::{ServiceError, shortened},
    settings::RolloutSettings,
};

/// How long an evaluation that has ended is kept at most.
const KEPT_FOR: Duration = Duration::from_secs(24 * 3600);

/// Places for jobs, and the threads that each may use.
pub(crate) struct Jobs {
    places: Arc<Semaphore>,
    threads: usize,
    /// How many evaluations that have ended are kept.
    kept: usize,
    evaluations: Mutex<Vec<Arc<EvaluationJob>>>,
    rollouts: Mutex<Vec<RunningRollouts>>,
}

/// A learner's call that holds a place.
struct RunningRollouts {
    id: String,
    robot: String,
    since: Instant,
    stop: CancellationToken,
}

/// A job's place, free again when it is dropped.
pub(crate) struct JobPermit {
    _permit: OwnedSemaphorePermit,
    pub(super) threads: usize,
}

/// A learner's place among the jobs, given back when it is dropped.
pub(super) struct Listed {
    jobs: Arc<Jobs>,
    id: String,
}

impl Jobs {
    pub(crate) fn new(settings: &RolloutSettings) -> Self {
        let places = settings.max_jobs.get().min(Semaphore::MAX_PERMITS);
        let cores = thread::available_parallelism().map_or(1, usize::from);
        Self {
            places: Arc::new(Semaphore::new(places)),
            threads: match settings.threads {
                0 => cores,
                threads => threads,
            },
            kept: settings.kept_jobs.get(),
            evaluations: Mutex::default(),
            rollouts: Mutex::default(),
        }
    }

    /// A place, if one is free.
    pub(super) fn enter(&self) -> Result<JobPermit, ServiceError> {
        Ok(JobPermit {
            _permit: enter(
                &self.places,
                "as many rollout jobs run as the server allows",
            )?,
            threads: self.threads,
        })
    }

    /// Refuses a job that would find no place, before it sends what it needs.
    pub(super) fn check_room(&self) -> Result<(), ServiceError> {
        match self.places.available_permits() {
            0 => Err(ServiceError::Overloaded {
                what: "as many rollout jobs run as the server allows",
                retry: RETRY,
            }),
            _ => Ok(()),
        }
    }

    /// Adds an evaluation; the oldest that have ended make room.
    pub(super) fn add(&self, robot: &str) -> Arc<EvaluationJob> {
        let job = Arc::new(EvaluationJob {
            id: id(),
            robot: robot.to_owned(),
            since: Instant::now(),
            cancelled: CancellationToken::new(),
            log: Mutex::default(),
            progress: watch::Sender::new(()),
        });
        let mut jobs = lock(&self.evaluations);
        jobs.retain(|job| !job.has_ended() || job.since.elapsed() < KEPT_FOR);
        while jobs.iter().filter(|job| job.has_ended()).count() >= self.kept {
            match jobs.iter().position(|job| job.has_ended()) {
                Some(oldest) => drop(jobs.remove(oldest)),
                None => break,
            }
        }
        jobs.push(Arc::clone(&job));
        job
    }

    /// Lists a learner's call; `stop` ends it.
    pub(super) fn list_rollouts(self: &Arc<Self>, robot: &str, stop: CancellationToken) -> Listed {
        let id = id();
        lock(&self.rollouts).push(RunningRollouts {
            id: id.clone(),
            robot: robot.to_owned(),
            since: Instant::now(),
            stop,
        });
        let jobs = Arc::clone(self);
        Listed { jobs, id }
    }

    pub(crate) fn evaluation(&self, id: &str) -> Result<Arc<EvaluationJob>, ServiceError> {
        let jobs = lock(&self.evaluations);
        let found = jobs.iter().find(|job| job.id == id).cloned();
        found.ok_or_else(|| not_found(id))
    }

    pub(crate) fn list(&self) -> Vec<v1::Job> {
        let mut jobs: Vec<v1::Job> = lock(&self.evaluations)
            .iter()
            .map(|job| job.describe())
            .collect();
        jobs.extend(lock(&self.rollouts).iter().map(|running| v1::Job {
            id: running.id.clone(),
            kind: JobKind::Rollouts.into(),
            state: JobState::Running.into(),
            robot: running.robot.clone(),
            age: Some(encode::duration(running.since.elapsed())),
            ..v1::Job::default()
        }));
        let age = |job: &v1::Job| job.age.map(|age| (age.seconds, age.nanos));
        jobs.sort_by_key(|job| std::cmp::Reverse(age(job)));
        jobs
    }

    /// Cancels a job, or forgets one that has ended.
    pub(crate) fn cancel(&self, id: &str) -> Result<(), ServiceError> {
        if let Some(running) = lock(&self.rollouts).iter().find(|job| job.id == id) {
            running.stop.cancel();
            return Ok(());
        }
        let job = self.evaluation(id)?;
        if job.has_ended() {
            lock(&self.evaluations).retain(|job| job.id != id);
        } else {
            job.cancelled.cancel();
        }
        Ok(())
    }
}

impl Drop for Listed {
    fn drop(&mut self) {
        lock(&self.jobs.rollouts).retain(|job| job.id != self.id);
    }
}

/// An evaluation: what it has said so far, and how it ended.
pub(crate) struct EvaluationJob {
    pub(super) id: String,
    robot: String,
    since: Instant,
    cancelled: CancellationToken,
    log: Mutex<Log>,
    /// Changes with every event, and at the end.
    progress: watch::Sender<()>,
}

#[derive(Default)]
struct Log {
    events: Vec<Message>,
    finished: u32,
    episodes: u32,
    end: Option<Result<(), Failure>>,
}

/// Why an evaluation has no result.
#[derive(Clone)]
enum Failure {
    Cancelled,
    ShutDown,
    Failed(String),
}

impl EvaluationJob {
    pub(super) fn is_cancelled(&self) -> bool {
        self.cancelled.is_cancelled()
    }

    pub(super) fn tell(&self, message: Message) {
        let mut log = lock(&self.log);
        match &message {
            Message::Started(started) => log.episodes = started.episodes,
            Message::Episode(episode) => log.finished = episode.finished,
            Message::Preparing(_) | Message::Result(_) => {}
        }
        // Only the newest word of the preparation is worth keeping.
        if matches!(message, Message::Preparing(_))
            && let Some(Message::Preparing(_)) = log.events.last()
            && log.events.len() > 1
        {
            log.events.pop();
        }
        log.events.push(message);
        drop(log);
        self.progress.send_replace(());
    }

    pub(super) fn finish(&self, end: Result<(), ServiceError>) {
        let end = end.map_err(|error| match error {
            ServiceError::JobCancelled => Failure::Cancelled,
            ServiceError::ShuttingDown => Failure::ShutDown,
            error => Failure::Failed(shortened(error.to_string())),
        });
        lock(&self.log).end = Some(end);
        self.progress.send_replace(());
    }

    pub(super) fn progress(&self) -> watch::Receiver<()> {
        self.progress.subscribe()
    }

    pub(super) fn event(&self, number: usize) -> Option<Message> {
        lock(&self.log).events.get(number).cloned()
    }

    /// How it ended, if it has.
    pub(super) fn end(&self) -> Option<Result<(), ServiceError>> {
        let end = lock(&self.log).end.clone()?;
        Some(end.map_err(|failure| match failure {
            Failure::Cancelled => ServiceError::JobCancelled,
            Failure::ShutDown => ServiceError::ShuttingDown,
            Failure::Failed(reason) => ServiceError::JobFailed(reason),
        }))
    }

    fn has_ended(&self) -> bool {
        lock(&self.log).end.is_some()
    }

    fn describe(&self) -> v1::Job {
        let log = lock(&self.log);
        let (state, error) = match &log.end {
            None => (JobState::Running, String::new()),
            Some(Ok(())) => (JobState::Done, String::new()),
            Some(Err(Failure::Cancelled)) => (JobState::Cancelled, String::new()),
            Some(Err(Failure::ShutDown)) => {
                (JobState::Failed, "the server is shutting down".to_owned())
            }
            Some(Err(Failure::Failed(reason))) => (JobState::Failed, reason.clone()),
        };
        v1::Job {
            id: self.id.clone(),
            kind: JobKind::Evaluation.into(),
            state: state.into(),
            robot: self.robot.clone(),
            age: Some(encode::duration(self.since.elapsed())),
            finished: log.finished,
            episodes: log.episodes,
            error,
        }
    }
}

/// An id that nobody guesses: who does not know it cannot watch or cancel a job.
fn id() -> String {
    let bytes: [u8; 8] = rand::rng().random();
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn not_found(id: &str) -> ServiceError {
    ServiceError::NotFound {
        what: "job",
        name: shortened(id.to_owned()),
        served: "see ListJobs".to_owned(),
    }
}

/// No code that can panic runs under these locks, so a poisoned one still holds sound data.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
