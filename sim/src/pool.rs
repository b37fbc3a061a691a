//! Threads that simulate.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use emp_robot::Robot;
use rayon::ThreadPool;
use rayon::prelude::*;
use thread_priority::{ThreadPriority, set_current_thread_priority};

use crate::physics::Rig;
use crate::{SimError, Stage};

/// Bodies that a thread takes at once: few, so that no thread waits long for another at the end of a batch.
const CHUNK: usize = 2;

/// How the system schedules a pool's threads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Priority {
    /// As any thread.
    Normal,
    /// Behind every other thread: the pool takes what time they leave. For work beside a 50 Hz stream.
    Low,
}

/// OS threads for simulation, each with its own [`Stage`].
///
/// Results do not depend on the number of threads, nor on which of them does what.
#[derive(Debug)]
pub struct Pool {
    threads: ThreadPool,
    /// One a thread; only that thread ever locks it.
    stages: Vec<Mutex<Stage>>,
}

impl Pool {
    /// A pool of `threads` (at least one) for bodies of `robot`.
    ///
    /// # Errors
    /// If the system gives no threads or no memory.
    pub fn new(robot: &Robot, threads: usize, priority: Priority) -> Result<Self, SimError> {
        let threads = threads.max(1);
        let model = robot.model();
        let rig = Arc::new(Rig::new(robot, &model)?);
        let stage = |_| Stage::on_rig(Arc::clone(&rig), model.clone()).map(Mutex::new);
        let stages = (0..threads).map(stage).collect::<Result<_, _>>()?;
        let threads = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|index| format!("sim-{index}"))
            .start_handler(move |_| {
                if priority == Priority::Low {
                    // Where the system refuses, the threads work on with its usual priority.
                    let _ = set_current_thread_priority(ThreadPriority::Min);
                }
            })
            .build()?;
        Ok(Self { threads, stages })
    }

    /// Number of threads.
    pub fn threads(&self) -> usize {
        self.stages.len()
    }

    /// Does `work` on every item, on all threads, and returns when all is done. `work` has the thread's stage to itself; it
    /// must not use the pool again.
    pub fn for_each<I, F>(&self, items: I, work: F)
    where
        I: IndexedParallelIterator,
        F: Fn(&mut Stage, I::Item) + Sync + Send,
    {
        self.threads.install(|| {
            items
                .with_min_len(CHUNK)
                .with_max_len(CHUNK)
                .for_each_init(|| self.stage(), |stage, item| work(stage, item));
        });
    }

    /// The calling thread's stage. A stage on which a panic happened is as good as any: each step puts its body on it anew.
    fn stage(&self) -> MutexGuard<'_, Stage> {
        let index = rayon::current_thread_index().unwrap_or(0);
        let stage = &self.stages[index];
        stage.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
