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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::emp27;

    #[test]
    #[cfg(target_os = "linux")]
    fn low_priority_threads_stand_behind_the_others() {
        let robot = emp27();
        let niceness = |priority: Priority| {
            let pool = Pool::new(&robot, 2, priority).unwrap();
            let mut found = [0_i64; 8];
            pool.for_each(found.par_iter_mut(), |_, found| {
                let statistics = std::fs::read_to_string("/proc/thread-self/stat").unwrap();
                // Field 19, counted from the one after the thread's name in brackets, which is field 2.
                let mut fields = statistics.rsplit(')').next().unwrap().split_whitespace();
                *found = fields.nth(16).unwrap().parse().unwrap();
            });
            found
        };
        let own = niceness(Priority::Normal);
        assert_eq!(niceness(Priority::Low), [19; 8]);
        assert!(own.iter().all(|&nice| nice < 19), "{own:?}");
    }

    #[test]
    fn every_item_is_worked_on_once_and_a_panic_stops_no_later_work() {
        let robot = emp27();
        let pool = Pool::new(&robot, 3, Priority::Normal).unwrap();
        let mut items = [0; 100];
        let failed = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            pool.for_each(items.par_iter_mut().enumerate(), |_, (index, _)| {
                assert_ne!(index, 50, "this test's panic");
            });
        }));
        assert!(failed.is_err());
        pool.for_each(items.par_iter_mut(), |_, item| *item += 1);
        assert_eq!(items, [1; 100]);
    }
}
