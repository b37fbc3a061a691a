//! The bounded queue in front of one model: streams before unary calls, and among those the one that is due first.
//!
//! It is plain data without locks or threads; [`crate::batcher`] puts it behind a mutex.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use tokio::sync::oneshot;

/// A job without a deadline is due this long after its arrival, so that jobs with deadlines cannot starve it.
const PATIENCE: Duration = Duration::from_millis(200);

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
    pub(crate) input: I,
    pub(crate) priority: Priority,
    pub(crate) arrived: Instant,
    deadline: Option<Instant>,
    pub(crate) reply: oneshot::Sender<Outcome<O>>,
}

impl<I, O> Job<I, O> {
    pub(crate) fn new(
        priority: Priority,
        input: I,
        deadline: Option<Instant>,
    ) -> (Self, oneshot::Receiver<Outcome<O>>) {
        let (reply, outcome) = oneshot::channel();
        (
            Self {
                input,
                priority,
                arrived: Instant::now(),
                deadline,
                reply,
            },
            outcome,
        )
    }

    fn due(&self) -> Instant {
        self.deadline.unwrap_or(self.arrived + PATIENCE)
    }

    fn is_late(&self, now: Instant) -> bool {
        self.deadline.is_some_and(|deadline| deadline <= now)
    }

    pub(crate) fn finish(self, outcome: Outcome<O>) {
        // A receiver that is gone has lost interest: its call was cancelled.
        let _ = self.reply.send(outcome);
    }
}

/// Waiting jobs; at most `limit` of each priority, so that neither kind can crowd out the other.
pub(crate) struct Queue<I, O> {
    jobs: BTreeMap<Key, Job<I, O>>,
    limit: usize,
    next_number: u64,
}

impl<I, O> Queue<I, O> {
    pub(crate) fn new(limit: usize) -> Self {
        Self {
            jobs: BTreeMap::new(),
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

    /// How many jobs of a priority wait.
    pub(crate) fn waiting(&self, priority: Priority) -> usize {
        self.jobs
            .keys()
            .filter(|key| key.priority == priority)
            .count()
    }

    pub(crate) fn is_full(&self, priority: Priority) -> bool {
        self.waiting(priority) >= self.limit
    }

    /// Adds a job, or gives it back when there is no room. Cancelled and late jobs make room first.
    pub(crate) fn push(&mut self, job: Job<I, O>) -> Result<Key, Job<I, O>> {
        let priority = job.priority;
        if self.is_full(priority) {
            self.discard_dead(Instant::now());
            if self.is_full(priority) {
                return Err(job);
            }
        }
        let key = Key {
            priority,
            due: job.due(),
            number: self.next_number,
        };
        self.next_number += 1;
        self.jobs.insert(key, job);
        Ok(key)
    }

    /// Puts a newer input in the place of one that still waits and gives back the old one; gives back the new one when
    /// the job has already been taken.
    pub(crate) fn replace(
        &mut self,
        key: &mut Key,
        input: I,
        deadline: Option<Instant>,
    ) -> Result<I, I> {
        let Some(mut job) = self.jobs.remove(key) else {
            return Err(input);
        };
        let old = std::mem::replace(&mut job.input, input);
        job.arrived = Instant::now();
        job.deadline = deadline;
        key.due = job.due();
        self.jobs.insert(*key, job);
        Ok(old)
    }

    /// Takes up to `max` jobs that are still wanted, in order of service. Late ones are told so.
    pub(crate) fn take_batch(&mut self, max: usize) -> Vec<Job<I, O>> {
        let now = Instant::now();
        let mut batch = Vec::new();
        while batch.len() < max {
            let Some((_, job)) = self.jobs.pop_first() else {
                break;
            };
            if job.is_late(now) {
                job.finish(Err(JobError::DeadlineExceeded));
            } else if !job.reply.is_closed() {
                batch.push(job);
            }
        }
        batch
    }

    /// Ends every waiting job with an error.
    pub(crate) fn fail_all(&mut self, error: &JobError) {
        for job in std::mem::take(&mut self.jobs).into_values() {
            job.finish(Err(error.clone()));
        }
    }

    fn discard_dead(&mut self, now: Instant) {
        for (_, job) in self
            .jobs
            .extract_if(.., |_, job| job.reply.is_closed() || job.is_late(now))
        {
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
    ) -> (Key, oneshot::Receiver<Outcome<u32>>) {
        let deadline = due_in_ms.map(|ms| Instant::now() + Duration::from_millis(ms));
        let (job, outcome) = Job::new(priority, input, deadline);
        (queue.push(job).map_err(|_| "full").expect("room"), outcome)
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
        assert_eq!(inputs(&queue.take_batch(2)), [5, 4]);
        assert_eq!(inputs(&queue.take_batch(8)), [2, 3, 1]);
    }

    #[test]
    fn each_priority_has_its_own_room_and_cancelled_jobs_make_some() {
        let mut queue = TestQueue::new(1);
        let (_, unary) = push(&mut queue, Priority::Unary, 1, None);
        let _stream = push(&mut queue, Priority::Stream, 2, None);
        let (refused, _outcome) = Job::new(Priority::Unary, 3, None);
        assert!(queue.push(refused).is_err());
        drop(unary);
        let _unary = push(&mut queue, Priority::Unary, 4, None);
        assert_eq!(inputs(&queue.take_batch(8)), [2, 4]);
    }

    #[test]
    fn late_jobs_are_told_and_not_computed() {
        let mut queue = TestQueue::new(8);
        let (_, mut late) = push(&mut queue, Priority::Stream, 1, Some(0));
        let _on_time = push(&mut queue, Priority::Stream, 2, Some(60_000));
        assert_eq!(inputs(&queue.take_batch(1)), [2]);
        assert_eq!(
            late.try_recv().expect("an outcome"),
            Err(JobError::DeadlineExceeded)
        );
    }

    #[test]
    fn a_waiting_input_can_be_replaced_until_it_is_taken() {
        let mut queue = TestQueue::new(8);
        let (mut key, _outcome) = push(&mut queue, Priority::Stream, 1, Some(60_000));
        let sooner = Instant::now() + Duration::from_secs(5);
        assert_eq!(queue.replace(&mut key, 2, Some(sooner)), Ok(1));
        assert_eq!(queue.len(), 1);
        assert_eq!(inputs(&queue.take_batch(8)), [2]);
        assert_eq!(queue.replace(&mut key, 3, None), Err(3));
    }
}
