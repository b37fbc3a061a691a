//! `CollectRollouts`: a learner's environments live here for as long as its call.

use std::{path::Path, sync::Arc};

use emp_models::{policy::Policy, retarget::Retargeter};
use emp_proto::v1::{
    CollectFinished, CollectRequest, CollectRolloutsRequest, CollectRolloutsResponse,
    CollectStarted, EnvironmentSnapshot, PolicyPart, SnapshotRestored,
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
    blocks, clips,
    context::{IDLE, RolloutContext},
    job::{self, JobStream, failed},
    jobs::{JobPermit, Listed},
};
use crate::{
    decode::{environment, fields, rollouts as decode},
    encode,
    error::{FieldError, ServiceError},
    session::Reader,
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
/// Most bytes of a snapshot, and of a policy.
const MAX_SNAPSHOT: usize = 1 << 30;
const MAX_POLICY: usize = 64 << 20;
/// Bytes of a snapshot in one message: the message is below 1 MiB.
const SNAPSHOT_PART: usize = (1 << 20) - 64;
/// Bounds of the exploration noise's logarithm.
const LOG_DEVIATION: [f32; 2] = [-20.0, 5.0];
/// Requests that wait while one is worked on.
const INBOUND: usize = 2;

type CollectStream = JobStream<CollectRolloutsResponse>;

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
pub(crate) async fn run(
    context: RolloutContext,
    inbound: Streaming<CollectRolloutsRequest>,
    stream: CollectStream,
) {
    let mut inbound = Reader::new(inbound, IDLE);
    let prepared = stream.prepare(read_plan(&context, &mut inbound)).await;
    let Some((plan, place)) = prepared else {
        return;
    };
    let listed = context
        .jobs
        .list_rollouts(plan.robot.name(), stream.cancellation().clone());
    let (forward, requests) = mpsc::channel(INBOUND);
    stream.clone().start(place, move |stream, threads| {
        let _listed: Listed = listed;
        plan.learner(stream, threads)?.serve(requests)
    });
    forward_requests(&stream, inbound, forward).await;
}

impl Plan {
    /// Makes the library and places the robots, on the job's thread.
    fn learner(self, stream: &CollectStream, threads: usize) -> Result<Learner<'_>, ServiceError> {
        let mut library = self.clips;
        if let Some((retargeter, which)) = self.procedural {
            let motions = clips::procedural(which, || stream.check())?;
            let stop = |_| stream.check();
            let source = Source::Procedural;
            library.extend(clips::retarget(
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
            stream,
            robot: self.robot,
            collector: Collector::new(environments, first, self.seed),
            policy: None,
            policy_parts: Vec::new(),
            restoring: Vec::new(),
        })
    }
}

/// Hands requests to the job until the client half-closes or the job has to stop; letting go of `forward` wakes the job.
async fn forward_requests(
    stream: &CollectStream,
    mut inbound: Reader<CollectRolloutsRequest>,
    forward: mpsc::Sender<Result<Request, ServiceError>>,
) {
    let forwarding = async {
        loop {
            let request = match inbound.next().await {
                Ok(Some(request)) => request
                    .message
                    .ok_or_else(|| FieldError::new("message", "it is missing").into()),
                Ok(None) => return,
                // A learner thinks for as long as it likes; that it is there the connection's keep-alive knows.
                Err(ServiceError::Silent(_)) => continue,
                Err(error) => Err(error),
            };
            if forward.send(request).await.is_err() {
                return;
            }
        }
    };
    tokio::select! {
        () = forwarding => {}
        _ = stream.ended() => {}
    }
}

async fn read_plan(
    context: &RolloutContext,
    inbound: &mut Reader<CollectRolloutsRequest>,
) -> Result<(Plan, JobPermit), ServiceError> {
    let first = inbound.next().await?;
    let Some(Request::Config(config)) = first.and_then(|first| first.message) else {
        return Err(FieldError::missing_config().into());
    };
    let robot = context.catalog.robot_for(&config.robot)?;
    let environment = environment::read(config.environment.as_ref(), &robot)?;
    let number = u64::from(fields::within(
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
    let number = fields::within("config.clips", config.clips, 0..=MAX_CLIPS)?;
    let mut budget = context.budget();
    let rate = robot.control_rate_hz();
    let which = clips::read_procedural(config.procedural.as_ref(), rate, &mut budget)?;
    let procedural = match which.0 {
        0 if number == 0 => {
            let description = "0, and no procedural motions; a library needs clips";
            return Err(FieldError::new("config.clips", description).into());
        }
        0 => None,
        _ => {
            let model = context.catalog.retargeter_for(&config.robot, "", "")?;
            Some((clips::network(&model)?, which))
        }
    };
    let upload = context.enter_upload()?;
    context.jobs.check_room()?;
    let clips = read_clips(budget, inbound, &robot, number).await?;
    drop(upload);
    // A place is taken once the client has sent all that it has to.
    let place = context.jobs.enter()?;
    let plan = Plan {
        clips,
        robot,
        environments: first..end,
        seed: config.seed,
        config: environment,
        procedural,
    };
    Ok((plan, place))
}

async fn read_clips(
    mut budget: decode::Budget,
    inbound: &mut Reader<CollectRolloutsRequest>,
    robot: &Arc<Robot>,
    number: u32,
) -> Result<Vec<GoalClip>, ServiceError> {
    let mut clips = Vec::new();
    for _ in 0..number {
        let clip = match inbound.next().await?.and_then(|next| next.message) {
            Some(Request::Clip(clip)) => clip,
            Some(Request::Config(_)) => return Err(FieldError::second_config().into()),
            _ => {
                let description = format!("{} came; the config says {number}", clips.len());
                return Err(FieldError::new("clip", description).into());
            }
        };
        budget.spend(
            "clip.goals",
            clip.goals.len() / robot.goal_joints().len() + 1,
        )?;
        let robot = Arc::clone(robot);
        // A clip may have hundreds of thousands of angles: too many for the threads that serve streams.
        let reading = tokio::task::spawn_blocking(move || read_clip(clip, &robot));
        clips.push(reading.await.map_err(failed)??);
    }
    Ok(clips)
}

fn read_clip(clip: emp_proto::v1::GoalClip, robot: &Robot) -> Result<GoalClip, FieldError> {
    let source = decode::source("clip.source", clip.source)?;
    let name = decode::name("clip.name", clip.name)?;
    let joints = robot.goal_joints().len();
    if clip.goals.is_empty() || clip.goals.len() % joints != 0 {
        let description = format!(
            "{} angles; expected a multiple of the {joints} goal joints",
            clip.goals.len()
        );
        return Err(FieldError::new("clip.goals", description));
    }
    let rows: Vec<&[f32]> = clip.goals.chunks_exact(joints).collect();
    GoalClip::new(robot, name, source, &rows)
        .map_err(|error| FieldError::new("clip.goals", error.to_string()))
}

fn response(message: Response) -> CollectRolloutsResponse {
    CollectRolloutsResponse {
        message: Some(message),
    }
}

/// The environments of one call, on the job's thread.
struct Learner<'a> {
    stream: &'a CollectStream,
    robot: Arc<Robot>,
    collector: Collector,
    /// The policy that was sent last, and parts of one that has not come to its end.
    policy: Option<Policy>,
    policy_parts: Vec<u8>,
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
            privileged: encode::count(environments.privileged_layout().width()),
            actions: encode::count(self.robot.leg_joints().len()),
        }))?;
        while let Some(request) = requests.blocking_recv() {
            match request? {
                Request::Collect(request) => self.collect(&request)?,
                Request::TakeSnapshot(_) => self.send_snapshot()?,
                Request::Restore(part) => self.restore(part)?,
                Request::Policy(part) => self.take_policy(part)?,
                Request::Config(_) => return Err(FieldError::second_config().into()),
                Request::Clip(_) => {
                    let description = "the library is complete, as the config says";
                    return Err(FieldError::new("clip", description).into());
                }
            }
        }
        // The requests end when the client half-closes, and when the job has to stop.
        self.stream.check()
    }

    fn send(&self, message: Response) -> Result<(), ServiceError> {
        self.stream.send(response(message))
    }

    fn collect(&mut self, request: &CollectRequest) -> Result<(), ServiceError> {
        let CollectRequest {
            iteration,
            log_standard_deviation,
            horizon,
            randomization,
            difficulty,
        } = request;
        let environments = self.collector.environments().len() as u64;
        let longest = u32::try_from(MAX_ROWS / environments).unwrap_or(u32::MAX);
        let horizon = fields::within("collect.horizon", *horizon, 1..=longest)?;
        let randomization =
            fields::within("collect.randomization", *randomization, 0.0..=MAX_SCALE)?;
        let difficulty = fields::within("collect.difficulty", *difficulty, 0.0..=MAX_SCALE)?;
        let legs = self.robot.leg_joints().len();
        let field = "collect.log_standard_deviation";
        fields::numbers(field, log_standard_deviation, legs, "numbers")?;
        let [least, most] = LOG_DEVIATION;
        for (index, &value) in log_standard_deviation.iter().enumerate() {
            fields::within(&format!("{field}[{index}]"), value, least..=most)?;
        }
        let policy = self
            .policy
            .take()
            .ok_or_else(|| FieldError::new("policy", "none was sent"))?;
        let numbers = u64::from(horizon) * environments * policy.config().features() as u64;
        fields::within("policy", numbers, 0..=MAX_NUMBERS)?;
        self.collector
            .set_curriculum(randomization, difficulty as f32);
        let rollout = self.run(&policy, log_standard_deviation, horizon)?;
        self.policy = Some(policy);
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
        let stream = self.stream;
        let stop = || stream.check().is_err();
        let rollout = self
            .collector
            .collect_unless(policy, log_std, horizon as usize, stop)
            .map_err(failed)?;
        stream.check()?;
        Ok(rollout)
    }

    fn take_policy(&mut self, part: PolicyPart) -> Result<(), ServiceError> {
        let size = self.policy_parts.len() + part.data.len();
        fields::within("policy.data", size, 0..=MAX_POLICY)?;
        self.policy_parts.extend(part.data);
        if part.last {
            let parts = std::mem::take(&mut self.policy_parts);
            let policy = Policy::decode(&parts, Path::new("policy"), Arc::clone(&self.robot))
                .map_err(|error| FieldError::new("policy", error.to_string()))?;
            self.policy = Some(policy);
        }
        Ok(())
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
        fields::within("restore.data", size, 0..=MAX_SNAPSHOT)?;
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
