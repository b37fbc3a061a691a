//! One model, one queue, one OS thread. The thread takes what waits whenever the model is free: batches form by
//! themselves while the model is busy, and a lone frame never waits for company.

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    pin::Pin,
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    task::{Context, Poll, ready},
    thread,
    time::{Duration, Instant},
};

use tokio::sync::{oneshot, watch};

use super::due;
use super::{
    backend::{Backend, BackendError},
    queue::{Answer, Job, JobError, Outcome, Priority, Queue},
};

/// Pauses between attempts to rebuild a model: doubled from the first up to the last.
const REBUILD_PAUSE: [Duration; 2] = [Duration::from_millis(200), Duration::from_secs(30)];
/// Bounds of the advice when to try again.
const RETRY_AFTER: [Duration; 2] = [Duration::from_millis(10), Duration::from_secs(5)];

/// Whether a model takes work.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ModelState {
    /// It answers.
    Serving,
    /// It failed and is being built anew.
    Rebuilding,
}

/// Why a job was not queued.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Rejected {
    /// No room; a good time to try again is after this long.
    Full(Duration),
    /// The model is being rebuilt.
    Unavailable,
}

/// How much a batcher takes at once.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Limits {
    /// Most jobs in one batch.
    pub(crate) max_batch: usize,
    /// Most jobs that wait, of each priority.
    pub(crate) queue: usize,
}

/// The front of a model's queue. Dropping it stops the model's thread once its batch is done.
pub(crate) struct Batcher<I, O> {
    shared: Arc<Shared<I, O>>,
    state: watch::Receiver<ModelState>,
}

/// A queued job: a future of its outcome. Dropping it cancels the job, unless its batch has begun.
struct Ticket<O> {
    outcome: oneshot::Receiver<Outcome<O>>,
}

/// Why an input has no answer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Unanswered {
    /// Its deadline passed.
    Late,
    /// It was not queued.
    Rejected(Rejected),
    /// It was queued, and the model did not answer.
    Failed(JobError),
}

struct Shared<I, O> {
    limits: Limits,
    inner: Mutex<Inner<I, O>>,
    changed: Condvar,
}

struct Inner<I, O> {
    queue: Queue<I, O>,
    state: ModelState,
    /// What the last batch took, for the advice when to try again.
    last_batch: Duration,
    closed: bool,
}

impl<I: Send + 'static, O: Send + 'static> Batcher<I, O> {
    /// Starts a model's thread, builds the model on it and waits until it stands.
    ///
    /// # Errors
    /// When the model cannot be built or the thread cannot be started.
    pub(crate) fn start<B>(
        name: &str,
        limits: Limits,
        mut build: impl FnMut() -> Result<B, BackendError> + Send + 'static,
    ) -> Result<Self, BackendError>
    where
        B: Backend<Input = I, Output = O>,
    {
        let shared = Arc::new(Shared {
            limits,
            inner: Mutex::new(Inner {
                queue: Queue::new(limits.queue),
                state: ModelState::Serving,
                last_batch: Duration::ZERO,
                closed: false,
            }),
            changed: Condvar::new(),
        });
        let (state_sender, state) = watch::channel(ModelState::Serving);
        let (built_sender, built) = std::sync::mpsc::sync_channel(1);
        let worker = Worker {
            name: name.to_owned(),
            shared: Arc::clone(&shared),
            state: state_sender,
        };
        thread::Builder::new()
            .name(format!("model {name}"))
            .spawn(move || match guarded(&mut build).flatten() {
                Ok(backend) => {
                    let _ = built_sender.send(Ok(()));
                    worker.run(backend, build);
                }
                Err(error) => {
                    let _ = built_sender.send(Err(error));
                }
            })
            .map_err(|error| {
                BackendError::new(format!("cannot start a thread for {name}: {error}"))
            })?;
        built
            .recv()
            .map_err(|_| BackendError::new(format!("the thread of {name} ended")))??;
        Ok(Self { shared, state })
    }

    /// Brings one input to the model and waits for its answer, until `deadline`. A call that is dropped before its batch begins costs
    /// nothing.
    ///
    /// # Errors
    /// When the queue is full, the deadline passes, or the model fails or is being rebuilt.
    pub(crate) async fn compute(
        &self,
        priority: Priority,
        input: I,
        deadline: Option<Instant>,
    ) -> Result<Answer<O>, Unanswered> {
        if due::has_passed(deadline) {
            return Err(Unanswered::Late);
        }
        let ticket = self.submit(priority, input, deadline);
        let outcome = tokio::select! {
            outcome = ticket.map_err(Unanswered::Rejected)? => outcome,
            () = due::passed(deadline) => return Err(Unanswered::Late),
        };
        match outcome {
            Ok(_) | Err(JobError::DeadlineExceeded) if due::has_passed(deadline) => {
                Err(Unanswered::Late)
            }
            outcome => outcome.map_err(Unanswered::Failed),
        }
    }

    /// Queues a job. A job that is dropped, late or cancelled before its batch begins costs nothing.
    fn submit(
        &self,
        priority: Priority,
        input: I,
        deadline: Option<Instant>,
    ) -> Result<Ticket<O>, Rejected> {
        let mut inner = self.shared.lock();
        if inner.state == ModelState::Rebuilding {
            return Err(Rejected::Unavailable);
        }
        let (job, outcome) = Job::new(input, deadline);
        match inner.queue.push(priority, job) {
            Ok(()) => {
                self.shared.changed.notify_one();
                Ok(Ticket { outcome })
            }
            Err(_) => Err(Rejected::Full(
                inner.retry_after(self.shared.limits.max_batch),
            )),
        }
    }

    /// When to try again, if there is no room for another job of this priority now.
    pub(crate) fn overload(&self, priority: Priority) -> Option<Duration> {
        let mut inner = self.shared.lock();
        let has_room = inner.queue.has_room(priority);
        (!has_room).then(|| inner.retry_after(self.shared.limits.max_batch))
    }

    /// The model's state, now and as it changes.
    pub(crate) fn state(&self) -> watch::Receiver<ModelState> {
        self.state.clone()
    }
}

impl<I, O> Drop for Batcher<I, O> {
    fn drop(&mut self) {
        self.shared.lock().closed = true;
        self.shared.changed.notify_all();
    }
}

impl<O> Future for Ticket<O> {
    type Output = Outcome<O>;

    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Self::Output> {
        let outcome = ready!(Pin::new(&mut self.outcome).poll(context));
        // The sender is only dropped unanswered when the model's thread ends with the server.
        Poll::Ready(outcome.unwrap_or(Err(JobError::ModelUnavailable)))
    }
}

impl<I, O> Inner<I, O> {
    fn retry_after(&self, max_batch: usize) -> Duration {
        let batches = u32::try_from(self.queue.len().div_ceil(max_batch)).unwrap_or(u32::MAX);
        self.last_batch
            .saturating_mul(batches)
            .clamp(RETRY_AFTER[0], RETRY_AFTER[1])
    }
}

impl<I, O> Shared<I, O> {
    /// No code that can panic runs under the lock, so a poisoned one still holds sound data.
    fn lock(&self) -> MutexGuard<'_, Inner<I, O>> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The model's thread.
struct Worker<I, O> {
    name: String,
    shared: Arc<Shared<I, O>>,
    state: watch::Sender<ModelState>,
}

impl<I: Send + 'static, O: Send + 'static> Worker<I, O> {
    fn run<B>(self, mut backend: B, mut build: impl FnMut() -> Result<B, BackendError>)
    where
        B: Backend<Input = I, Output = O>,
    {
        while let Some(batch) = self.next_batch() {
            let mut panicked = false;
            for retried in self.answer(&mut backend, batch, &mut panicked) {
                // Alone, so that only those fail that are to blame.
                self.answer(&mut backend, vec![retried], &mut panicked);
            }
            if panicked {
                let Some(new) = self.rebuild(&mut build) else {
                    return;
                };
                let old = std::mem::replace(&mut backend, new);
                // What the panic left of the old model may panic again when it is dropped.
                if let Err(error) = guarded(|| drop(old)) {
                    tracing::error!(model = self.name, %error, "dropping the failed model");
                }
            }
        }
    }

    /// Waits for work; nothing once the server has let go of the queue.
    fn next_batch(&self) -> Option<Vec<Job<I, O>>> {
        let mut inner = self.shared.lock();
        loop {
            if inner.closed {
                return None;
            }
            let batch = inner.queue.take_batch(self.shared.limits.max_batch);
            if !batch.is_empty() {
                return Some(batch);
            }
            inner = self
                .shared
                .changed
                .wait_while(inner, |inner| inner.queue.is_empty() && !inner.closed)
                .unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Runs one batch and answers its jobs; gives back those of a batch that failed, if there are several. Says whether the model
    /// panicked.
    fn answer<B>(
        &self,
        backend: &mut B,
        batch: Vec<Job<I, O>>,
        panicked: &mut bool,
    ) -> Vec<Job<I, O>>
    where
        B: Backend<Input = I, Output = O>,
    {
        let start = Instant::now();
        let (inputs, waiting): (Vec<_>, Vec<_>) =
            batch.into_iter().map(|job| job.split(start)).unzip();
        let outcome = guarded(|| backend.run(&inputs));
        let inference_time = start.elapsed();
        self.shared.lock().last_batch = inference_time;
        if outcome.is_err() {
            *panicked = true;
            self.set_state(ModelState::Rebuilding);
        }
        let batch_size = inputs.len();
        let explanation = match outcome {
            Ok(Ok(outputs)) if outputs.len() == batch_size => {
                for (output, waiting) in outputs.into_iter().zip(waiting) {
                    let checked = backend.check(&output).map(|()| output);
                    let answer = checked.map(|output| Answer {
                        output,
                        queue_time: waiting.queue_time,
                        inference_time,
                        batch_size,
                    });
                    waiting.finish(answer.map_err(|error| {
                        tracing::warn!(model = self.name, %error, "an answer was refused");
                        JobError::ModelFailed(error.to_string())
                    }));
                }
                return Vec::new();
            }
            Ok(Ok(outputs)) => format!("{} answers to a batch of {batch_size}", outputs.len()),
            Ok(Err(error)) | Err(error) => error.to_string(),
        };
        tracing::warn!(model = self.name, batch_size, explanation, "a batch failed");
        let mut jobs = inputs.into_iter().zip(waiting);
        if batch_size > 1 {
            return jobs
                .map(|(input, waiting)| waiting.rejoined(input))
                .collect();
        }
        if let Some((_, waiting)) = jobs.next() {
            waiting.finish(Err(JobError::ModelFailed(explanation)));
        }
        Vec::new()
    }

    /// Builds the model again, however often it takes. What waits meanwhile is refused, since nobody can say how long.
    fn rebuild<B>(&self, build: &mut impl FnMut() -> Result<B, BackendError>) -> Option<B> {
        let mut pause = REBUILD_PAUSE[0];
        loop {
            match guarded(&mut *build).flatten() {
                Ok(backend) => {
                    self.set_state(ModelState::Serving);
                    tracing::info!(model = self.name, "the model serves again");
                    return Some(backend);
                }
                Err(error) => {
                    tracing::error!(model = self.name, %error, ?pause, "the model cannot be rebuilt; trying again");
                }
            }
            let mut inner = self.shared.lock();
            inner.queue.fail_all(&JobError::ModelUnavailable);
            let (inner, _) = self
                .shared
                .changed
                .wait_timeout_while(inner, pause, |inner| !inner.closed)
                .unwrap_or_else(PoisonError::into_inner);
            if inner.closed {
                return None;
            }
            pause = (pause * 2).min(REBUILD_PAUSE[1]);
        }
    }

    fn set_state(&self, state: ModelState) {
        self.shared.lock().state = state;
        self.state.send_replace(state);
    }
}

/// Runs code of a model; a panic becomes an error.
fn guarded<T>(run: impl FnOnce() -> T) -> Result<T, BackendError> {
    // Whatever the panic left behind is thrown away by the caller.
    catch_unwind(AssertUnwindSafe(run)).map_err(|payload| {
        let message = payload
            .downcast_ref::<&str>()
            .copied()
            .or_else(|| payload.downcast_ref::<String>().map(String::as_str))
            .unwrap_or("without a message");
        BackendError::new(format!("panic: {message}"))
    })
}

#[cfg(test)]
mod tests {
    use std::sync::{
        atomic::{AtomicUsize, Ordering},
        mpsc,
    };

    use super::*;

    const LIMITS: Limits = Limits {
        max_batch: 4,
        queue: 8,
    };
    const PANIC: u32 = 666;
    const REFUSE: u32 = 400;
    const UNSOUND: u32 = 500;

    /// Doubles numbers. Each batch waits for a permit, so that a test decides when the model is busy.
    struct Doubler {
        permits: mpsc::Receiver<()>,
    }

    impl Backend for Doubler {
        type Input = u32;
        type Output = u32;

        fn run(&mut self, batch: &[u32]) -> Result<Vec<u32>, BackendError> {
            let _ = self.permits.recv();
            assert!(!batch.contains(&PANIC), "told to panic");
            if batch.contains(&REFUSE) {
                return Err(BackendError::new("told to refuse"));
            }
            Ok(batch.iter().map(|x| 2 * x).collect())
        }

        fn check(&self, output: &u32) -> Result<(), BackendError> {
            match *output == 2 * UNSOUND {
                true => Err(BackendError::new("told to be unsound")),
                false => Ok(()),
            }
        }
    }

    /// A batcher whose every build takes the next of these permit channels.
    fn start(builds: Vec<mpsc::Receiver<()>>) -> Batcher<u32, u32> {
        let mut builds = builds.into_iter();
        let build = move || {
            let permits = builds
                .next()
                .ok_or_else(|| BackendError::new("no more builds"))?;
            Ok(Doubler { permits })
        };
        Batcher::start("test", LIMITS, build).expect("built")
    }

    fn submit(batcher: &Batcher<u32, u32>, input: u32) -> Ticket<u32> {
        batcher.submit(Priority::Stream, input, None).expect("room")
    }

    #[tokio::test]
    async fn what_waits_while_the_model_is_busy_becomes_a_batch() {
        let (permit, permits) = mpsc::channel();
        let batcher = start(vec![permits]);
        let first = submit(&batcher, 1);
        while !batcher.shared.lock().queue.is_empty() {
            tokio::task::yield_now().await;
        }
        let rest: Vec<_> = (2..7).map(|input| submit(&batcher, input)).collect();
        for _ in 0..3 {
            permit.send(()).expect("the model waits");
        }
        assert_eq!(first.await.expect("answered").batch_size, 1);
        let mut answers = Vec::new();
        for ticket in rest {
            let answer = ticket.await.expect("answered");
            answers.push((answer.output, answer.batch_size));
        }
        assert_eq!(answers, [(4, 4), (6, 4), (8, 4), (10, 4), (12, 1)]);
    }

    #[tokio::test]
    async fn a_full_queue_refuses_and_a_cancelled_job_makes_room() {
        let (permit, permits) = mpsc::channel();
        let batcher = start(vec![permits]);
        let busy = submit(&batcher, 0);
        while !batcher.shared.lock().queue.is_empty() {
            tokio::task::yield_now().await;
        }
        let mut waiting: Vec<_> = (0..8).map(|input| submit(&batcher, input)).collect();
        assert!(batcher.overload(Priority::Stream).is_some());
        assert!(matches!(
            batcher.submit(Priority::Stream, 9, None),
            Err(Rejected::Full(_))
        ));
        assert!(batcher.overload(Priority::Unary).is_none());
        waiting.pop();
        let last = submit(&batcher, 10);
        drop(permit);
        assert_eq!(busy.await.expect("answered").output, 0);
        assert_eq!(last.await.expect("answered").output, 20);
    }

    #[tokio::test]
    async fn a_panic_fails_its_batch_and_the_model_comes_back() {
        let (_first, permits) = mpsc::channel();
        let (_second, more_permits) = mpsc::channel();
        drop((_first, _second));
        let batcher = start(vec![permits, more_permits]);
        let mut state = batcher.state();
        let outcome = submit(&batcher, PANIC).await;
        assert_eq!(
            outcome,
            Err(JobError::ModelFailed("panic: told to panic".to_owned()))
        );
        state
            .wait_for(|state| *state == ModelState::Serving)
            .await
            .expect("it serves again");
        assert_eq!(submit(&batcher, 3).await.expect("answered").output, 6);
    }

    #[tokio::test]
    async fn one_bad_item_fails_alone() {
        for (bad, explanation) in [
            (REFUSE, "told to refuse"),
            (PANIC, "panic: told to panic"),
            (UNSOUND, "told to be unsound"),
        ] {
            let (permit, permits) = mpsc::channel();
            let (_, more_permits) = mpsc::channel();
            let batcher = start(vec![permits, more_permits]);
            let busy = submit(&batcher, 0);
            while !batcher.shared.lock().queue.is_empty() {
                tokio::task::yield_now().await;
            }
            let batch = [1, bad, 3].map(|input| submit(&batcher, input));
            drop(permit);
            assert!(busy.await.is_ok());
            let mut answers = Vec::new();
            for ticket in batch {
                answers.push(ticket.await.map(|answer| answer.output));
            }
            let failed = JobError::ModelFailed(explanation.to_owned());
            assert_eq!(answers, [Ok(2), Err(failed), Ok(6)]);
        }
    }

    #[tokio::test]
    async fn an_error_leaves_the_model_in_use() {
        let (_, permits) = mpsc::channel();
        let batcher = start(vec![permits]);
        let outcome = submit(&batcher, REFUSE).await;
        assert_eq!(
            outcome,
            Err(JobError::ModelFailed("told to refuse".to_owned()))
        );
        assert_eq!(*batcher.state().borrow(), ModelState::Serving);
        assert_eq!(submit(&batcher, 1).await.expect("answered").output, 2);
    }

    #[tokio::test]
    async fn a_model_that_cannot_be_rebuilt_refuses_work() {
        let (_, permits) = mpsc::channel();
        let batcher = start(vec![permits]);
        assert!(submit(&batcher, PANIC).await.is_err());
        assert!(matches!(
            batcher.submit(Priority::Unary, 1, None),
            Err(Rejected::Unavailable)
        ));
        assert_eq!(*batcher.state().borrow(), ModelState::Rebuilding);
    }

    #[test]
    fn a_model_that_cannot_be_built_is_an_error() {
        let build = || Err::<Doubler, _>(BackendError::new("no weights"));
        let error = Batcher::start("test", LIMITS, build)
            .err()
            .expect("refused");
        assert_eq!(error.to_string(), "no weights");
    }

    #[test]
    fn dropping_the_front_ends_the_thread() {
        static DROPPED: AtomicUsize = AtomicUsize::new(0);
        struct Idle;
        impl Backend for Idle {
            type Input = ();
            type Output = ();
            fn run(&mut self, batch: &[()]) -> Result<Vec<()>, BackendError> {
                Ok(batch.to_vec())
            }
        }
        impl Drop for Idle {
            fn drop(&mut self) {
                DROPPED.fetch_add(1, Ordering::SeqCst);
            }
        }
        drop(Batcher::start("test", LIMITS, || Ok(Idle)).expect("built"));
        let patience = Instant::now() + Duration::from_secs(10);
        while DROPPED.load(Ordering::SeqCst) == 0 {
            assert!(Instant::now() < patience, "the thread still runs");
            thread::yield_now();
        }
    }
}
