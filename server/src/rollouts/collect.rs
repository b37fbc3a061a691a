//! `CollectRollouts`: a learner's environments live here for as long as its call.

use std::{path::Path, sync::Arc};

use emp_models::{policy::Policy, retarget::Retargeter};
use emp_proto::v1::{
    CollectFinished, CollectRequest, CollectRolloutsConfig, CollectRolloutsRequest,
    CollectRolloutsResponse, CollectStarted, EnvironmentSnapshot, SnapshotRestored,
    collect_rollouts_request::Message as Request, collect_rollouts_response::Message as Response,
};
use emp_robot::Robot;
use emp_sim::{
    Collector, Rollout,
    environment::{EnvironmentConfig, VecEnvironment},
    goals::{GoalClip, GoalLibrary, Source},
};
use tokio::sync::mpsc;
use tonic::Streaming;

use super::{
    RolloutContext, blocks,
    job::{self, Line, Place, failed},
    motion, read,
};
use crate::{
    error::{FieldError, ServiceError},
    identity::Role,
    wire,
};

/// Most robots of one call.
const MAX_ENVIRONMENTS: u32 = 16_384;
/// Most rows of one request: robots × control periods.
const MAX_ROWS: u64 = 262_144;
/// Most goal clips of a library.
const MAX_CLIPS: u32 = 1_000_000;
/// Most numbers of a request's features: 2 GiB.
const MAX_NUMBERS: u64 = 1 << 29;
/// Largest scale of randomisation and goals.
const MAX_SCALE: f64 = 10.0;
/// Most often that a clip may be drawn, relative to the others.
const MAX_CLIP_WEIGHT: f32 = 1000.0;
/// Most bytes of a snapshot.
const MAX_SNAPSHOT: usize = 1 << 30;
/// Bytes of a snapshot in one message.
const SNAPSHOT_PART: usize = 4 << 20;
/// Requests that wait while one is worked on.
const INBOUND: usize = 2;

type CollectLine = Line<CollectRolloutsResponse>;

/// What a call asks for before its requests.
struct Plan {
    robot: Arc<Robot>,
    environments: std::ops::Range<u64>,
    seed: u64,
    config: EnvironmentConfig,
    clips: Vec<GoalClip>,
    /// The retargeter, number and seed of the procedural motions, if there are any.
    procedural: Option<(Arc<Retargeter>, (usize, u64))>,
}

/// Serves one call to its end.
pub(super) async fn run(
    context: RolloutContext,
    mut inbound: Streaming<CollectRolloutsRequest>,
    line: CollectLine,
) {
    let prepared = line.prepare(read_plan(&context, &mut inbound)).await;
    let Some((plan, place)) = prepared else {
        return;
    };
    let (forward, requests) = mpsc::channel(INBOUND);
    line.clone().start(place, move |line, threads| {
        plan.learner(line, threads)?.serve(requests)
    });
    forward_requests(&line, inbound, forward).await;
}

impl Plan {
    /// Makes the library and places the robots, on the job's thread.
    fn learner(self, line: &CollectLine, threads: usize) -> Result<Learner<'_>, ServiceError> {
        let mut library = self.clips;
        if let Some((retargeter, which)) = self.procedural {
            let motions = motion::procedural(which);
            let stop = |_| line.check();
            let source = Source::Procedural;
            library.extend(motion::retarget(
                &retargeter,
                &motions,
                source,
                threads,
                stop,
            )?);
        }
        let library = GoalLibrary::new(&self.robot, library).map_err(failed)?;
        let pool = job::pool(&self.robot, threads).map_err(failed)?;
        let first = self.environments.start;
        let environments = VecEnvironment::new(
            Arc::clone(&self.robot),
            pool,
            self.config,
            Arc::new(library),
            self.environments,
            self.seed,
        )
        .map_err(failed)?;
        Ok(Learner {
            line,
            robot: self.robot,
            collector: Collector::new(environments, first, self.seed),
            restoring: Vec::new(),
        })
    }
}

/// Hands requests to the job until the client half-closes or the job has to stop; letting go of `forward` wakes the job.
async fn forward_requests(
    line: &CollectLine,
    mut inbound: Streaming<CollectRolloutsRequest>,
    forward: mpsc::Sender<Result<Request, ServiceError>>,
) {
    let forwarding = async {
        loop {
            let request = match inbound.message().await {
                Ok(Some(request)) => request
                    .message
                    .ok_or_else(|| FieldError::new("message", "it is missing").into()),
                Ok(None) => return,
                Err(status) => Err(ServiceError::Transport(status)),
            };
            if forward.send(request).await.is_err() {
                return;
            }
        }
    };
    tokio::select! {
        () = forwarding => {}
        _ = line.ended() => {}
    }
}

async fn read_plan(
    context: &RolloutContext,
    inbound: &mut Streaming<CollectRolloutsRequest>,
) -> Result<(Plan, Place), ServiceError> {
    let first = read::message(inbound).await?;
    let Some(Request::Config(config)) = first.and_then(|first| first.message) else {
        return Err(FieldError::missing_config().into());
    };
    context.caller.may(Role::Evaluator, &config.robot, "")?;
    let robot = Arc::clone(context.catalog.robot_for(&config.robot)?);
    let environment = read_environment(&config, &robot)?;
    let number = u64::from(read::within(
        "config.environments",
        config.environments,
        1..=MAX_ENVIRONMENTS,
    )?);
    let first = config.first_environment;
    let end = first.checked_add(number).ok_or_else(|| {
        FieldError::new(
            "config.first_environment",
            format!("{first}; expected less than {}", u64::MAX - number + 1),
        )
    })?;
    let number = read::within("config.clips", config.clips, 0..=MAX_CLIPS)?;
    let mut budget = context.budget(&robot);
    let which = motion::read_procedural(config.procedural.as_ref(), &mut budget)?;
    let procedural = match which.0 {
        0 if number == 0 => {
            let description = "0, and no procedural motions; a library needs clips";
            return Err(FieldError::new("config.clips", description).into());
        }
        0 => None,
        _ => {
            let model = context.catalog.retargeter_for(&config.robot, "", "")?;
            Some((motion::network(model)?, which))
        }
    };
    let place = context.jobs.enter()?;
    let plan = Plan {
        clips: read_clips(budget, inbound, &robot, number).await?,
        robot,
        environments: first..end,
        seed: config.seed,
        config: environment,
        procedural,
    };
    Ok((plan, place))
}

fn read_environment(
    config: &CollectRolloutsConfig,
    robot: &Robot,
) -> Result<EnvironmentConfig, FieldError> {
    let wrong = |reason: String| FieldError::new("config.environment_settings", reason);
    let settings = match config.environment_settings.as_str() {
        "" => EnvironmentConfig::default(),
        json => serde_json::from_str(json).map_err(|error| wrong(error.to_string()))?,
    };
    settings
        .check(robot)
        .map_err(|error| wrong(error.to_string()))?;
    Ok(settings)
}

async fn read_clips(
    mut budget: read::Budget,
    inbound: &mut Streaming<CollectRolloutsRequest>,
    robot: &Robot,
    number: u32,
) -> Result<Vec<GoalClip>, ServiceError> {
    let mut clips = Vec::new();
    for _ in 0..number {
        let clip = match read::message(inbound).await?.and_then(|next| next.message) {
            Some(Request::Clip(clip)) => clip,
            Some(Request::Config(_)) => return Err(FieldError::second_config().into()),
            _ => {
                let description = format!("{} came; the config says {number}", clips.len());
                return Err(FieldError::new("clip", description).into());
            }
        };
        let source = read::source("clip.source", clip.source)?;
        let joints = robot.goal_joints().len();
        if clip.goals.len() % joints != 0 {
            let description = format!(
                "{} angles; expected a multiple of the {joints} goal joints",
                clip.goals.len()
            );
            return Err(FieldError::new("clip.goals", description).into());
        }
        let rows: Vec<&[f32]> = clip.goals.chunks_exact(joints).collect();
        // Even one without goals takes room.
        budget.spend("clip.goals", rows.len() + 1)?;
        let name = read::name("clip.name", clip.name)?;
        let made = GoalClip::new(robot, name, source, &rows)
            .map_err(|error| FieldError::new("clip.goals", error.to_string()))?;
        clips.push(made);
    }
    Ok(clips)
}

fn response(message: Response) -> CollectRolloutsResponse {
    CollectRolloutsResponse {
        message: Some(message),
    }
}

/// The environments of one call, on the job's thread.
struct Learner<'a> {
    line: &'a CollectLine,
    robot: Arc<Robot>,
    collector: Collector,
    /// Parts of a snapshot that has not come to its end.
    restoring: Vec<u8>,
}

impl Learner<'_> {
    fn serve(
        mut self,
        mut requests: mpsc::Receiver<Result<Request, ServiceError>>,
    ) -> Result<(), ServiceError> {
        let environments = self.collector.environments();
        self.send(Response::Started(CollectStarted {
            privileged: wire::count(environments.privileged_layout().width()),
            actions: wire::count(self.robot.leg_joints().len()),
        }))?;
        while let Some(request) = requests.blocking_recv() {
            match request? {
                Request::Collect(request) => self.collect(&request)?,
                Request::TakeSnapshot(_) => self.send_snapshot()?,
                Request::Restore(part) => self.restore(part)?,
                Request::Config(_) => return Err(FieldError::second_config().into()),
                Request::Clip(_) => {
                    let description = "the library is complete, as the config says";
                    return Err(FieldError::new("clip", description).into());
                }
            }
        }
        // The requests end when the client half-closes, and when the job has to stop.
        self.line.check()
    }

    fn send(&self, message: Response) -> Result<(), ServiceError> {
        self.line.send(response(message))
    }

    fn collect(&mut self, request: &CollectRequest) -> Result<(), ServiceError> {
        let CollectRequest {
            iteration,
            policy,
            log_standard_deviation,
            horizon,
            randomization,
            difficulty,
            clip_weights,
        } = request;
        let environments = self.collector.environments().len() as u64;
        let longest = u32::try_from(MAX_ROWS / environments).unwrap_or(u32::MAX);
        let horizon = read::within("collect.horizon", *horizon, 1..=longest)?;
        let randomization = read::within("collect.randomization", *randomization, 0.0..=MAX_SCALE)?;
        let difficulty = read::within("collect.difficulty", *difficulty, 0.0..=MAX_SCALE)?;
        let legs = self.robot.leg_joints().len();
        let field = "collect.log_standard_deviation";
        crate::check::numbers(field, log_standard_deviation, legs, "numbers")?;
        let policy = Policy::decode(policy, Path::new("collect.policy"), Arc::clone(&self.robot))
            .map_err(|error| FieldError::new("collect.policy", error.to_string()))?;
        for (index, weight) in clip_weights.iter().enumerate() {
            let field = format!("collect.clip_weights[{index}]");
            read::within(&field, *weight, f32::MIN_POSITIVE..=MAX_CLIP_WEIGHT)?;
        }
        let numbers = u64::from(horizon) * environments * policy.config().features() as u64;
        read::within("collect.policy", numbers, 0..=MAX_NUMBERS)?;
        self.collector
            .set_curriculum(randomization, difficulty as f32);
        self.collector.set_clip_weights(clip_weights);
        let rollout = self.run(&policy, log_standard_deviation, horizon)?;
        for block in blocks::of(&rollout, *iteration) {
            self.send(Response::Block(block))?;
        }
        self.send(Response::Finished(CollectFinished {
            iteration: *iteration,
            reward_terms: blocks::reward_terms(&rollout.statistics),
            episodes: blocks::episodes(&rollout.statistics),
        }))
    }

    /// Runs the robots, unless the job has to stop.
    fn run(
        &mut self,
        policy: &Policy,
        log_std: &[f32],
        horizon: u32,
    ) -> Result<Rollout, ServiceError> {
        let line = self.line;
        let stop = || line.check().is_err();
        let rollout = self
            .collector
            .collect_unless(policy, log_std, horizon as usize, stop)
            .map_err(failed)?;
        line.check()?;
        Ok(rollout)
    }

    fn send_snapshot(&self) -> Result<(), ServiceError> {
        let snapshot = self.collector.snapshot().map_err(failed)?;
        let parts = snapshot.chunks(SNAPSHOT_PART);
        let last = parts.len().saturating_sub(1);
        for (index, part) in parts.enumerate() {
            self.send(Response::Snapshot(EnvironmentSnapshot {
                data: part.to_vec(),
                last: index == last,
            }))?;
        }
        Ok(())
    }

    fn restore(&mut self, part: EnvironmentSnapshot) -> Result<(), ServiceError> {
        let size = self.restoring.len() + part.data.len();
        read::within("restore.data", size, 0..=MAX_SNAPSHOT)?;
        self.restoring.extend(part.data);
        if !part.last {
            return Ok(());
        }
        let snapshot = std::mem::take(&mut self.restoring);
        self.collector
            .restore(&snapshot)
            .map_err(|error| FieldError::new("restore", error.to_string()))?;
        self.send(Response::Restored(SnapshotRestored {}))
    }
}
