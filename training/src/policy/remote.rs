//! Environments on servers, by `RolloutService.CollectRollouts`.
//!
//! A server that goes away may come back, or another may take its address: the source keeps a snapshot and the requests
//! since, and brings the environments back to where they were. So a rollout is the same whoever fails meanwhile.

use std::{
    ops::Range,
    sync::Arc,
    time::{Duration, Instant},
};

use anyhow::{Context as _, Result, bail, ensure};
use emp_client::{
    Backoff, Client, ClientError, ClipSource, CollectFinished, CollectRequest,
    CollectRolloutsConfig, Collection, GoalClip, RolloutBlock, StepEnd, TrainingEnd,
    TrainingEpisode,
};
use emp_robot::Robot;
use emp_sim::{
    Divergence, End, Episode, Rollout, RolloutStatistics,
    environment::EndReason,
    goals::{GoalLibrary, Source},
};
use tokio::runtime::Runtime;
use tonic::Code;

use super::{
    Settings, environment,
    source::{Collected, PolicySnapshot, RolloutSource},
};

/// Requests after which a new snapshot replaces them.
const JOURNAL: usize = 16;

/// The environments of a run, spread over servers by their numbers.
pub struct RemoteSource {
    /// Keeps connections alive while the learner works.
    runtime: Runtime,
    servers: Vec<Server>,
    environments: usize,
    iteration: u64,
}

impl RemoteSource {
    /// Places the environments of a run on the servers at `urls`, with goals from `library`.
    ///
    /// # Errors
    /// When there are fewer environments than servers, or a server cannot be reached or refuses.
    pub fn new(
        urls: &[String],
        robot: &Robot,
        settings: &Settings,
        library: &GoalLibrary,
    ) -> Result<Self> {
        let environments = settings.environments;
        ensure!(
            !urls.is_empty() && urls.len() <= environments,
            "{environments} environments cannot be spread over {} servers",
            urls.len()
        );
        let library: Arc<Vec<GoalClip>> = Arc::new(library.clips().map(clip).collect());
        let share = |index: usize| environments * index / urls.len();
        let servers = urls.iter().enumerate().map(|(index, url)| {
            let range = share(index)..share(index + 1);
            Ok(Server {
                url: url.clone(),
                config: CollectRolloutsConfig {
                    robot: robot.name().to_owned(),
                    environments: u32::try_from(range.len())?,
                    first_environment: range.start as u64,
                    seed: settings.seed,
                    environment: Some(environment::message(&settings.environment)),
                    ..CollectRolloutsConfig::default()
                },
                library: Arc::clone(&library),
                range,
                collection: None,
                snapshot: None,
                journal: Vec::new(),
            })
        });
        let mut source = Self {
            runtime: tokio::runtime::Builder::new_multi_thread()
                .worker_threads(1)
                .enable_all()
                .build()?,
            servers: servers.collect::<Result<_>>()?,
            environments,
            iteration: 0,
        };
        source.each(|server| async move {
            let result = server.connected().await.map(|_| ());
            result.map_err(|error| server.failed(error))
        })?;
        Ok(source)
    }

    /// Does `work` with all servers at once.
    fn each<'a, T, F, W>(&'a mut self, work: F) -> Result<Vec<T>>
    where
        F: Fn(&'a mut Server) -> W,
        W: Future<Output = Result<T>> + 'a,
    {
        let works = self.servers.iter_mut().map(work);
        self.runtime
            .block_on(futures_util::future::try_join_all(works))
    }
}

impl RolloutSource for RemoteSource {
    fn collect(&mut self, snapshot: &PolicySnapshot, horizon: usize) -> Result<Collected> {
        self.iteration += 1;
        let request = CollectRequest {
            iteration: self.iteration,
            log_standard_deviation: snapshot.log_std.clone(),
            horizon: u32::try_from(horizon)?,
            randomization: snapshot.randomization,
            difficulty: snapshot.difficulty,
        };
        let environments = self.environments;
        let policy: Arc<[u8]> = snapshot.policy.encode()?.into();
        let request = Request { policy, request };
        let parts = self.each(|server| server.collect(request.clone()))?;
        Ok(Collected {
            rollout: assembled(&parts, environments, horizon)?,
            inference: Duration::ZERO,
        })
    }

    fn snapshot(&mut self) -> Result<Vec<u8>> {
        let snapshots = self.each(Server::take_snapshot)?;
        Ok(postcard::to_stdvec(&snapshots)?)
    }

    fn restore(&mut self, snapshot: &[u8]) -> Result<()> {
        let snapshots: Vec<Vec<u8>> = postcard::from_bytes(snapshot)
            .context("the environments' snapshot is not one of servers")?;
        ensure!(
            snapshots.len() == self.servers.len(),
            "the run used {} servers, not {}",
            snapshots.len(),
            self.servers.len()
        );
        for (server, snapshot) in self.servers.iter_mut().zip(snapshots) {
            server.collection = None;
            server.snapshot = Some(snapshot);
            server.journal.clear();
        }
        // The next request connects anew, and waits where a server has not yet seen that the call before is over.
        Ok(())
    }
}

/// One server's share of the environments.
struct Server {
    url: String,
    config: CollectRolloutsConfig,
    library: Arc<Vec<GoalClip>>,
    /// Numbers of its environments.
    range: Range<usize>,
    /// The call in which the environments live, while it lasts.
    collection: Option<Collection>,
    /// Where the environments stood before the requests in the journal; none: at their start.
    snapshot: Option<Vec<u8>>,
    journal: Vec<Request>,
}

/// A request and the policy that it is about.
#[derive(Clone)]
struct Request {
    policy: Arc<[u8]>,
    request: CollectRequest,
}

/// What one server collected.
struct Part {
    range: Range<usize>,
    blocks: Vec<RolloutBlock>,
    finished: CollectFinished,
}

impl Server {
    /// Runs the environments, again and again if the server goes away.
    async fn collect(&mut self, request: Request) -> Result<Part> {
        let backoff = Backoff::default();
        let (start, mut pause) = (Instant::now(), backoff.first);
        let (blocks, finished) = loop {
            match self.attempt(&request).await {
                Ok(collected) => break collected,
                Err(error) if may_pass(&error) && start.elapsed() < backoff.give_up => {
                    self.collection = None;
                    tokio::time::sleep(pause).await;
                    pause = (2 * pause).min(backoff.longest);
                }
                Err(error) => return Err(self.failed(error)),
            }
        };
        self.journal.push(request);
        if self.journal.len() >= JOURNAL {
            // Where it fails, the journal grows on, and the next request finds out what is wrong.
            let _ = self.take_snapshot().await;
        }
        Ok(Part {
            range: self.range.clone(),
            blocks,
            finished,
        })
    }

    async fn attempt(
        &mut self,
        Request { policy, request }: &Request,
    ) -> Result<(Vec<RolloutBlock>, CollectFinished), ClientError> {
        let collection = self.connected().await?;
        collection.collect(policy, request.clone()).await
    }

    /// The call in which the environments live; a new one is brought to where the last one was.
    async fn connected(&mut self) -> Result<&mut Collection, ClientError> {
        let collection = match self.collection.take() {
            Some(collection) => collection,
            None => {
                let client = Client::connect(&self.url).await?;
                let library = self.library.as_ref().clone();
                let mut collection = client
                    .collect_rollouts(self.config.clone(), library)
                    .await?;
                if let Some(snapshot) = &self.snapshot {
                    collection.restore(snapshot).await?;
                }
                for Request { policy, request } in &self.journal {
                    collection.collect(policy, request.clone()).await?;
                }
                collection
            }
        };
        Ok(self.collection.insert(collection))
    }

    async fn take_snapshot(&mut self) -> Result<Vec<u8>> {
        let taken = match self.connected().await {
            Ok(collection) => collection.snapshot().await,
            Err(error) => Err(error),
        };
        let snapshot = taken.map_err(|error| {
            self.collection = None;
            self.failed(error)
        })?;
        self.snapshot = Some(snapshot.clone());
        self.journal.clear();
        Ok(snapshot)
    }

    fn failed(&self, error: ClientError) -> anyhow::Error {
        anyhow::Error::new(error).context(format!("rollout server {}", self.url))
    }
}

/// Whether the same request may succeed later.
fn may_pass(error: &ClientError) -> bool {
    match error {
        ClientError::Contract(_) => false,
        ClientError::Status(_) => !matches!(
            error.code(),
            Some(
                Code::InvalidArgument
                    | Code::NotFound
                    | Code::FailedPrecondition
                    | Code::OutOfRange
                    | Code::PermissionDenied
                    | Code::Unauthenticated
                    | Code::Unimplemented
            )
        ),
        _ => true,
    }
}

fn clip(clip: &emp_sim::goals::GoalClip) -> GoalClip {
    let source = match clip.source {
        Source::Recorded => ClipSource::Recorded,
        Source::Procedural => ClipSource::Procedural,
    };
    GoalClip {
        name: clip.name.clone(),
        source: source.into(),
        goals: clip.frames().flatten().copied().collect(),
    }
}

/// Puts the servers' blocks together as one machine would have collected them.
fn assembled(parts: &[Part], environments: usize, horizon: usize) -> Result<Rollout> {
    let rows = environments * horizon;
    let mut rollout = Rollout {
        environments,
        horizon,
        ends: vec![End::None; rows],
        ..Rollout::default()
    };
    let mut covered = 0;
    for part in parts {
        for block in &part.blocks {
            let first = part.range.start + block.first_environment as usize;
            let first_step = block.first_step as usize;
            let place = Place {
                environments,
                range: first..first + block.environments as usize,
                steps: first_step..first_step + block.horizon as usize,
            };
            ensure!(
                place.range.end <= part.range.end && place.steps.end <= horizon,
                "a server answered with robots or control periods that it was not asked for"
            );
            covered += place.range.len() * place.steps.len();
            place.write(block, horizon, &mut rollout)?;
        }
    }
    ensure!(
        covered == rows,
        "the servers answered with {covered} rows, expected {rows}"
    );
    rollout.timed_out_privileged.sort_by_key(|(row, _)| *row);
    rollout.statistics = statistics(parts, &rollout)?;
    Ok(rollout)
}

/// Where a block's robots and control periods stand among all.
struct Place {
    environments: usize,
    range: Range<usize>,
    steps: Range<usize>,
}

impl Place {
    fn write(&self, block: &RolloutBlock, horizon: usize, rollout: &mut Rollout) -> Result<()> {
        self.scatter(&block.features, horizon, &mut rollout.features)?;
        self.scatter(&block.privileged, horizon, &mut rollout.privileged)?;
        if self.steps.end == horizon {
            let last = Self {
                range: self.range.clone(),
                steps: 0..1,
                ..*self
            };
            last.scatter(&block.last_privileged, 1, &mut rollout.last_privileged)?;
        }
        self.scatter(&block.means, horizon, &mut rollout.means)?;
        self.scatter(&block.actions, horizon, &mut rollout.actions)?;
        self.scatter(&block.rewards, horizon, &mut rollout.rewards)?;
        let expected = self.steps.len() * self.range.len();
        ensure!(
            block.ends.len() == expected,
            "a server answered with {} ends, expected {expected}",
            block.ends.len()
        );
        for (index, end) in block.ends().enumerate() {
            let (t, n) = (index / self.range.len(), index % self.range.len());
            rollout.ends[self.row(t, n)] = step_end(end)?;
        }
        for state in &block.timed_out {
            let (t, n) = (state.step as usize, state.environment as usize);
            ensure!(
                t < self.steps.len() && n < self.range.len(),
                "a server answered with a state of no robot"
            );
            let privileged = state.privileged.clone();
            rollout
                .timed_out_privileged
                .push((self.row(t, n), privileged));
        }
        Ok(())
    }

    /// The row of the block's control period t and robot n among all.
    fn row(&self, t: usize, n: usize) -> usize {
        (self.steps.start + t) * self.environments + self.range.start + n
    }

    /// Copies a block's rows to where they stand among those of `horizon` control periods of all robots.
    fn scatter(&self, values: &[f32], horizon: usize, all: &mut Vec<f32>) -> Result<()> {
        let (steps, count) = (self.steps.len(), self.range.len());
        let width = values.len() / (steps * count).max(1);
        ensure!(
            values.len() == steps * count * width,
            "a server answered with {} numbers, expected a multiple of {}",
            values.len(),
            steps * count
        );
        let size = horizon * self.environments * width;
        if all.is_empty() {
            all.resize(size, 0.0);
        }
        ensure!(
            all.len() == size,
            "servers answered with rows of unlike width"
        );
        for (t, batch) in values.chunks_exact((count * width).max(1)).enumerate() {
            let start = self.row(t, 0) * width;
            all[start..start + batch.len()].copy_from_slice(batch);
        }
        Ok(())
    }
}

/// The statistics of all servers: means over all robots, episodes in the order of the rows.
fn statistics(parts: &[Part], rollout: &Rollout) -> Result<RolloutStatistics> {
    let terms = parts
        .first()
        .map_or(0, |part| part.finished.reward_terms.len());
    let mut reward_terms = vec![0.0; terms];
    let mut episodes = Vec::new();
    for part in parts {
        let share = part.range.len() as f64 / rollout.environments as f64;
        for (sum, term) in reward_terms.iter_mut().zip(&part.finished.reward_terms) {
            *sum += share * term.mean;
        }
        let ended = rollout.ends.iter().enumerate().filter(|(row, end)| {
            **end != End::None && part.range.contains(&(row % rollout.environments))
        });
        let rows: Vec<usize> = ended.map(|(row, _)| row).collect();
        ensure!(
            rows.len() == part.finished.episodes.len(),
            "a server answered with {} episodes, expected {}",
            part.finished.episodes.len(),
            rows.len()
        );
        for (row, episode) in rows.into_iter().zip(&part.finished.episodes) {
            let end = end_reason(episode)?;
            let length = episode.length;
            episodes.push((row, Episode { length, end }));
        }
    }
    episodes.sort_by_key(|(row, _)| *row);
    Ok(RolloutStatistics {
        reward_terms,
        episodes: episodes.into_iter().map(|(_, episode)| episode).collect(),
    })
}

fn step_end(end: StepEnd) -> Result<End> {
    Ok(match end {
        StepEnd::None => End::None,
        StepEnd::Terminated => End::Terminated,
        StepEnd::TimedOut => End::TimedOut,
        StepEnd::Diverged => End::Diverged,
        StepEnd::Unspecified => bail!("a server answered with no end; is it newer?"),
    })
}

fn end_reason(episode: &TrainingEpisode) -> Result<EndReason> {
    Ok(match episode.end() {
        TrainingEnd::Tilted => EndReason::Tilted,
        TrainingEnd::Sank => EndReason::Sank,
        TrainingEnd::TimedOut => EndReason::TimedOut,
        TrainingEnd::Diverged => {
            let divergence = Divergence::named(&episode.divergence).with_context(|| {
                format!(
                    "a server answered that {:?} diverged; is it newer?",
                    episode.divergence
                )
            })?;
            EndReason::Diverged(divergence)
        }
        TrainingEnd::Unspecified => bail!("a server answered with no end; is it newer?"),
    })
}
