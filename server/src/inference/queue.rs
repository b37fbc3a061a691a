//! The bounded queue in front of one model: streams before unary calls, and among those the one that is due first.
//!
//! It is plain data without locks or threads; [`super::batcher`] puts it behind a mutex.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use tokio::sync::oneshot;

/// A job is due between these times after its arrival, whatever its deadline: a short one does not get ahead of everybody, a long
/// one or none does not fall behind everybody.
const DUE: [Duration; 2] = [Duration::from_millis(20), Duration::from_millis(200)];
/// Most unary calls in a batch: streams that come meanwhile do not wait for more.
const UNARY_IN_BATCH: usize = 4;

/// Who waits for a job. The order is the order of service.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Priority {
    /// A frame of a live stream.
    Stream,
    /// A call that stands alone.
    Unary,
}

/// A job's place in the queue: priority, then due time, then arrival.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Key {
    priority: Priority,
    due: Instant,
    number: u64,
}

/// Why a job that was queued got no answer.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum JobError {
    /// Its deadline passed before its batch was formed.
    #[error("the deadline passed before a model was free")]
    DeadlineExceeded,
    /// The model failed while it computed the batch.
    #[error("the model failed: {0}")]
    ModelFailed(String),
    /// The model is not there: it is being rebuilt, or the server stops.
    #[error("the model is being rebuilt")]
    ModelUnavailable,
}

/// The answer to one job and where its time went.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Answer<O> {
    /// What the model answered.
    pub(crate) output: O,
    /// From arrival in the queue to the start of the batch.
    pub(crate) queue_time: Duration,
    /// What the whole batch took.
    pub(crate) inference_time: Duration,
    /// How many jobs the batch had.
    pub(crate) batch_size: usize,
}

/// How a job ended.
pub(crate) type Outcome<O> = Result<Answer<O>, JobError>;

pub(crate) struct Job<I, O> {
    input: I,
    arrived: Instant,
    deadline: Option<Instant>,
    reply: oneshot::Sender<Outcome<O>>,
}

/// What is left of a job while a model has its input.
pub(crate) struct Waiting<O> {
    /// From its arrival to the start of its batch.
    pub(crate) queue_time: Duration,
    arrived: Instant,
    deadline: Option<Instant>,
    reply: oneshot::Sender<Outcome<O>>,
}

impl<O> Waiting<O> {
    pub(crate) fn finish(self, outcome: Outcome<O>) {
        // A receiver that is gone has lost interest: its call was cancelled.
        let _ = self.reply.send(outcome);
    }

    /// The job with its input again.
    pub(crate) fn rejoined<I>(self, input: I) -> Job<I, O> {
        Job {
            input,
            arrived: self.arrived,
            deadline: self.deadline,
            reply: self.reply,
        }
    }
}

impl<I, O> Job<I, O> {
    pub(crate) fn new(
        input: I,
        deadline: Option<Instant>,
    ) -> (Self, oneshot::Receiver<Outcome<O>>) {
        let (reply, outcome) = oneshot::channel();
        (
            Self {
                input,
                arrived: Instant::now(),
                deadline,
                reply,
            },
            outcome,
        )
    }

    /// The input for the model, whose batch begins now, and what waits meanwhile.
    pub(crate) fn split(self, now: Instant) -> (I, Waiting<O>) {
        let waiting = Waiting {
            queue_time: now - self.arrived,
            arrived: self.arrived,
            deadline: self.deadline,
            reply: self.reply,
        };
        (self.input, waiting)
    }

    fn due(&self) -> Instant {
        let [soonest, latest] = DUE.map(|after| self.arrived + after);
        self.deadline.unwrap_or(latest).clamp(soonest, latest)
    }

    fn is_late(&self, now: Instant) -> bool {
        self.deadline.is_some_and(|deadline| deadline <= now)
    }

    fn finish(self, outcome: Outcome<O>) {
        // A receiver that is gone has lost interest: its call was cancelled.
        let _ = self.reply.send(outcome);
    }
}

/// Waiting jobs; at most `limit` of each priority, so that neither kind can crowd out the other.
pub(crate) struct Queue<I, O> {
    jobs: BTreeMap<Key, Job<I, O>>,
    /// How many of them are unary calls.
    unary: usize,
    limit: usize,
    next_number: u64,
}

impl<I, O> Queue<I, O> {
    pub(crate) fn new(limit: usize) -> Self {
        Self {
            jobs: BTreeMap::new(),
            unary: 0,
            limit,
            next_number: 0,
        }
    }

    pub(crate) fn len(&self) -> usize {
        self.jobs.len()
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.jobs.is_empty()
    }

    fn is_full(&self, priority: Priority) -> bool {
        let waiting = match priority {
            Priority::Stream => self.jobs.len() - self.unary,
            Priority::Unary => self.unary,
        };
        waiting >= self.limit
    }

    /// Whether there is room for another job, once those are gone that nobody waits for any more.
    pub(crate) fn has_room(&mut self, priority: Priority) -> bool {
        if self.is_full(priority) {
            self.discard_dead(Instant::now());
        }
        !self.is_full(priority)
    }

    /// Adds a job, or gives it back when there is no room. Cancelled and late jobs make room first.
    pub(crate) fn push(&mut self, priority: Priority, job: Job<I, O>) -> Result<(), Job<I, O>> {
        if !self.has_room(priority) {
            return Err(job);
        }
        let key = Key {
            priority,
            due: job.due(),
            number: self.next_number,
        };
        self.next_number += 1;
        self.unary += usize::from(priority == Priority::Unary);
        self.jobs.insert(key, job);
        Ok(())
    }

    /// Takes up to `max` jobs that are still wanted, in order of service. Late ones are told so.
    pub(crate) fn take_batch(&mut self, max: usize) -> Vec<Job<I, O>> {
        let now = Instant::now();
        let mut batch: Vec<Job<I, O>> = Vec::new();
        let mut unary = 0;
        while batch.len() < max && unary < UNARY_IN_BATCH {
            let Some((key, job)) = self.jobs.pop_first() else {
                break;
            };
            let is_unary = usize::from(key.priority == Priority::Unary);
            self.unary -= is_unary;
            if job.is_late(now) {
                job.finish(Err(JobError::DeadlineExceeded));
            } else if !job.reply.is_closed() {
                unary += is_unary;
                batch.push(job);
            }
        }
        batch
    }

    /// Ends every waiting job with an error.
    pub(crate) fn fail_all(&mut self, error: &JobError) {
        self.unary = 0;
        for job in std::mem::take(&mut self.jobs).into_values() {
            job.finish(Err(error.clone()));
        }
    }

    fn discard_dead(&mut self, now: Instant) {
        let dead = |_: &Key, job: &mut Job<I, O>| job.reply.is_closed() || job.is_late(now);
        for (key, job) in self.jobs.extract_if(.., dead) {
            self.unary -= usize::from(key.priority == Priority::Unary);
            job.finish(Err(JobError::DeadlineExceeded));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    type TestQueue = Queue<u32, u32>;

    fn push(
        queue: &mut TestQueue,
        priority: Priority,
        input: u32,
        due_in_ms: Option<u64>,
    ) -> oneshot::Receiver<Outcome<u32>> {
        let deadline = due_in_ms.map(|ms| Instant::now() + Duration::from_millis(ms));
        let (job, outcome) = Job::new(input, deadline);
        queue.push(priority, job).map_err(|_| "full").expect("room");
        outcome
    }

    fn inputs(batch: &[Job<u32, u32>]) -> Vec<u32> {
        batch.iter().map(|job| job.input).collect()
    }

    #[test]
    fn streams_come_first_then_the_earliest_deadline() {
        let mut queue = TestQueue::new(8);
        let _waiting = [
            push(&mut queue, Priority::Unary, 1, Some(1_000)),
            push(&mut queue, Priority::Stream, 2, Some(60_000)),
            push(&mut queue, Priority::Unary, 3, Some(500)),
            push(&mut queue, Priority::Stream, 4, None),
            push(&mut queue, Priority::Stream, 5, Some(50)),
        ];
        assert_eq!(inputs(&queue.take_batch(2)), [5, 2]);
        assert_eq!(inputs(&queue.take_batch(8)), [4, 1, 3]);
    }

    #[test]
    fn each_priority_has_its_own_room_and_cancelled_jobs_make_some() {
        let mut queue = TestQueue::new(1);
        let unary = push(&mut queue, Priority::Unary, 1, None);
        let _stream = push(&mut queue, Priority::Stream, 2, None);
        let (refused, _outcome) = Job::new(3, None);
        assert!(queue.push(Priority::Unary, refused).is_err());
        drop(unary);
        let _unary = push(&mut queue, Priority::Unary, 4, None);
        assert_eq!(inputs(&queue.take_batch(8)), [2, 4]);
    }

    #[test]
    fn late_jobs_are_told_and_not_computed() {
        let mut queue = TestQueue::new(8);
        let mut late = push(&mut queue, Priority::Stream, 1, Some(0));
        let _on_time = push(&mut queue, Priority::Stream, 2, Some(60_000));
        assert_eq!(inputs(&queue.take_batch(1)), [2]);
        assert_eq!(
            late.try_recv().expect("an outcome"),
            Err(JobError::DeadlineExceeded)
        );
    }

    #[test]
    fn a_deadline_gains_and_loses_a_little_only() {
        let mut queue = TestQueue::new(8);
        let _waiting = [
            push(&mut queue, Priority::Stream, 1, Some(60_000)),
            push(&mut queue, Priority::Stream, 2, None),
            push(&mut queue, Priority::Stream, 3, Some(19)),
            push(&mut queue, Priority::Stream, 4, Some(15)),
        ];
        assert_eq!(inputs(&queue.take_batch(8)), [3, 4, 1, 2]);
    }

    #[test]
    fn a_flood_of_calls_leaves_room_for_the_streams_that_come_next() {
        let mut queue = TestQueue::new(64);
        let _calls: Vec<_> = (0..40)
            .map(|call| push(&mut queue, Priority::Unary, call, None))
            .collect();
        assert_eq!(queue.take_batch(32).len(), UNARY_IN_BATCH);
        let _frame = push(&mut queue, Priority::Stream, 99, None);
        assert_eq!(inputs(&queue.take_batch(32))[0], 99);
    }
}
