//! `Evaluate`: a controller on a set of motions.

use std::sync::Arc;

use emp_models::{controller::Controller, filters::DECOUPLED, retarget::Retargeter};
use emp_motion::Clip;
use emp_proto::v1::{
    EpisodeFinished, EvaluateConfig, EvaluateRequest, EvaluateResponse, EvaluationPreparing,
    EvaluationStarted, HumanPose, MotionClip, Push, Randomization,
    evaluate_request::Message as Request, evaluate_response::Message as Response,
};
use emp_robot::Robot;
use emp_sim::{
    SimError,
    evaluation::{EpisodeResult, EvaluationSettings, Progress, RandomizationLevel, evaluate},
    goals::{GoalClip, Source},
    pushes::Kick,
};
use tonic::Streaming;

use super::{
    RolloutContext,
    job::{self, Line, Place, failed},
    motion,
    read::{self, Budget},
    scores,
};
use crate::{
    catalog::{PolicyModel, RetargetModel},
    error::{FieldError, ServiceError},
    identity::Role,
    pose, wire,
};

/// Frames of an evaluation clip, as in the paper.
const CLIP_FRAMES: usize = 200;
/// Time between pushes, as in the paper, seconds.
const PUSH_INTERVAL: f64 = 5.0;
/// Most frames of an evaluation clip, and most episodes.
const MAX_COUNT: u32 = 100_000;
/// Least and most frames a second of a motion.
const FPS: [f64; 2] = [1.0, 1_000.0];
/// Largest mass in a hand, kilograms.
const MAX_LOAD: f64 = 20.0;

type EvaluateLine = Line<EvaluateResponse>;

/// What a call asks for.
struct Plan {
    policy: Arc<PolicyModel>,
    retargeter: Arc<RetargetModel>,
    network: Arc<Retargeter>,
    controller: Controller,
    settings: EvaluationSettings,
    clip_frames: usize,
    motions: Vec<Clip>,
    /// Number and seed of the procedural motions.
    procedural: (usize, u64),
}

/// Serves one call to its end.
pub(super) async fn run(
    context: RolloutContext,
    mut inbound: Streaming<EvaluateRequest>,
    line: EvaluateLine,
) {
    let prepared = line.prepare(read_plan(&context, &mut inbound)).await;
    if let Some((plan, place)) = prepared {
        line.start(place, move |line, threads| plan.run(line, threads));
    }
}

impl Plan {
    /// The job, on its own thread.
    fn run(self, line: &EvaluateLine, threads: usize) -> Result<(), ServiceError> {
        let clips = self.prepare(line, threads)?;
        let Self {
            policy,
            retargeter,
            controller,
            settings,
            ..
        } = self;
        let episodes = settings.episodes.unwrap_or(clips.len());
        line.send(response(Response::Started(EvaluationStarted {
            robot: policy.card.robot.clone(),
            controller: controller.name().to_owned(),
            model: policy.card.name.clone(),
            model_version: policy.card.version.clone(),
            retargeter: retargeter.card.name.clone(),
            retargeter_version: retargeter.card.version.clone(),
            episodes: wire::count(episodes),
            control_rate: policy.robot.control_rate_hz(),
        })))?;
        let pool = job::pool(&policy.robot, threads).map_err(failed)?;
        let mut reporter = Reporter::new(line, &policy.robot);
        let evaluation =
            evaluate(&pool, &controller, &clips, &settings, &mut reporter).map_err(failed)?;
        // A job that had to stop has no metrics: they would be those of other episodes every time.
        line.check()?;
        line.send(response(Response::Result(scores::result(
            &evaluation,
            &policy.robot,
        ))))
    }

    /// Retargets the recorded and the procedural motions, and cuts them into clips.
    fn prepare(&self, line: &EvaluateLine, threads: usize) -> Result<Vec<GoalClip>, ServiceError> {
        let procedural = motion::procedural(self.procedural);
        let total = self.motions.len() + procedural.len();
        let sources = [
            (&self.motions, Source::Recorded),
            (&procedural, Source::Procedural),
        ];
        let mut before = 0;
        let mut clips = Vec::new();
        for (motions, source) in sources {
            let progress = |done: usize| {
                line.check()?;
                line.send(response(Response::Preparing(EvaluationPreparing {
                    done: wire::count(before + done),
                    motions: wire::count(total),
                })))
            };
            let goals = motion::retarget(&self.network, motions, source, threads, progress)?;
            clips.extend(goals.iter().flat_map(|clip| clip.windows(self.clip_frames)));
            before += motions.len();
        }
        if clips.is_empty() {
            let shortest = GoalClip::SHORTEST_WINDOW;
            let description = format!("every motion is shorter than {shortest} control periods");
            return Err(FieldError::new("clip.poses", description).into());
        }
        Ok(clips)
    }
}

fn response(message: Response) -> EvaluateResponse {
    EvaluateResponse {
        message: Some(message),
    }
}

/// Reports episodes as they end.
struct Reporter<'a> {
    line: &'a EvaluateLine,
    robot: &'a Robot,
    finished: usize,
    stood: usize,
}

impl<'a> Reporter<'a> {
    fn new(line: &'a EvaluateLine, robot: &'a Robot) -> Self {
        Self {
            line,
            robot,
            finished: 0,
            stood: 0,
        }
    }
}

impl Progress for Reporter<'_> {
    fn finished(&mut self, episode: &EpisodeResult) {
        self.finished += 1;
        self.stood += usize::from(episode.failure.is_none());
        // A client that is gone cancels the job, which is asked next.
        let _ = self.line.send(response(Response::Episode(EpisodeFinished {
            result: Some(scores::episode(episode, self.robot)),
            finished: wire::count(self.finished),
            success: self.stood as f64 / self.finished as f64,
        })));
    }

    fn is_cancelled(&self) -> bool {
        self.line.check().is_err()
    }
}

async fn read_plan(
    context: &RolloutContext,
    inbound: &mut Streaming<EvaluateRequest>,
) -> Result<(Plan, Place), ServiceError> {
    let first = read::message(inbound).await?;
    let Some(Request::Config(config)) = first.and_then(|first| first.message) else {
        return Err(FieldError::missing_config().into());
    };
    context.caller.may(Role::Evaluator, &config.robot, "")?;
    let policy = context
        .catalog
        .policy_for(&config.robot, &config.model, &config.model_version)?;
    let retargeter = context.catalog.retargeter_for(&config.robot, "", "")?;
    let network = motion::network(retargeter)?;
    let controller = read_controller(&config.controller, policy)?;
    let mut budget = context.budget(&policy.robot);
    let procedural = motion::read_procedural(config.procedural.as_ref(), &mut budget)?;
    let settings = read_settings(&config, &policy.robot)?;
    let clip_frames = read::within("config.clip_frames", config.clip_frames, 0..=MAX_COUNT)?;
    let place = context.jobs.enter()?;
    let motions = read_motions(inbound, budget).await?;
    if motions.is_empty() && procedural.0 == 0 {
        let description = "no motion was sent, and no procedural motion asked for";
        return Err(FieldError::new("config.procedural", description).into());
    }
    let plan = Plan {
        policy: Arc::clone(policy),
        retargeter: Arc::clone(retargeter),
        network,
        controller,
        settings,
        clip_frames: match clip_frames {
            0 => CLIP_FRAMES,
            frames => frames as usize,
        },
        motions,
        procedural,
    };
    Ok((plan, place))
}

fn read_settings(config: &EvaluateConfig, robot: &Robot) -> Result<EvaluationSettings, FieldError> {
    let conditions = match Randomization::try_from(config.randomization) {
        Ok(Randomization::Unspecified | Randomization::Nominal) => RandomizationLevel::Nominal,
        Ok(Randomization::Full) => RandomizationLevel::Full,
        Err(_) => {
            let (field, number) = ("config.randomization", config.randomization);
            return Err(FieldError::not_in("Randomization", field, number));
        }
    };
    let hand_load = match config.hand_load {
        Some(load) => {
            let least = read::within("config.hand_load.least", load.least, 0.0..=MAX_LOAD)?;
            let most = read::within("config.hand_load.most", load.most, least..=MAX_LOAD)?;
            Some([least, most])
        }
        None => None,
    };
    let episodes = read::within("config.episodes", config.episodes, 0..=MAX_COUNT)?;
    let settings = EvaluationSettings {
        seed: config.seed,
        episodes: (episodes > 0).then_some(episodes as usize),
        conditions,
        hand_load,
        push: config.push.as_ref().map(kick),
        speed: config.speed.unwrap_or(1.0),
        amplitude: config.amplitude.unwrap_or(1.0),
    };
    settings.check(robot).map_err(|error| match error {
        SimError::Setting {
            name,
            expected,
            found,
        } => FieldError::new(
            format!("config.{name}"),
            format!("{found}; expected {expected}"),
        ),
        error => FieldError::new("config", error.to_string()),
    })?;
    Ok(settings)
}

fn kick(push: &Push) -> Kick {
    Kick {
        speed: push.speed,
        interval: if push.interval == 0.0 {
            PUSH_INTERVAL
        } else {
            push.interval
        },
    }
}

fn read_controller(name: &str, policy: &PolicyModel) -> Result<Controller, FieldError> {
    let name = match name {
        "" => DECOUPLED,
        name => name,
    };
    Controller::by_name(name, policy.model.policy(), policy.model.emp())
        .map_err(|error| FieldError::new("config.controller", error.to_string()))
}

/// Reads motions until the client half-closes.
async fn read_motions(
    inbound: &mut Streaming<EvaluateRequest>,
    mut budget: Budget,
) -> Result<Vec<Clip>, ServiceError> {
    let mut motions: Vec<Clip> = Vec::new();
    while let Some(request) = read::message(inbound).await? {
        match request.message {
            Some(Request::Clip(clip)) => motions.push(read_clip(clip, &mut budget)?),
            Some(Request::Poses(more)) => {
                let clip = motions
                    .last_mut()
                    .ok_or_else(|| FieldError::new("poses", "they come before the first clip"))?;
                read_poses("poses.poses", &more.poses, clip, &mut budget)?;
            }
            Some(Request::Config(_)) => return Err(FieldError::second_config().into()),
            None => {
                return Err(FieldError::new("message", "it is missing; expected a clip").into());
            }
        }
    }
    match motions.iter().find(|motion| motion.frames.is_empty()) {
        Some(motion) => {
            Err(FieldError::new("clip.poses", format!("motion {:?} has none", motion.name)).into())
        }
        None => Ok(motions),
    }
}

fn read_clip(clip: MotionClip, budget: &mut Budget) -> Result<Clip, FieldError> {
    let MotionClip { name, fps, poses } = clip;
    let mut clip = Clip {
        name: read::name("clip.name", name)?,
        fps: read::within("clip.fps", fps, FPS[0]..=FPS[1])?,
        frames: Vec::new(),
    };
    // Even one without poses takes room.
    budget.spend("clip.poses", 1)?;
    read_poses("clip.poses", &poses, &mut clip, budget)?;
    Ok(clip)
}

fn read_poses(
    field: &str,
    poses: &[HumanPose],
    clip: &mut Clip,
    budget: &mut Budget,
) -> Result<(), FieldError> {
    // What they will become counts, before it is made.
    let becomes = |frames: usize| {
        let frames_at_rate = (frames as f64 / clip.fps * budget.control_rate).ceil();
        (frames_at_rate as usize).max(frames)
    };
    let (before, after) = (clip.frames.len(), clip.frames.len() + poses.len());
    budget.spend(field, becomes(after) - becomes(before))?;
    for (index, pose) in poses.iter().enumerate() {
        let path = format!("{field}[{index}]");
        clip.frames.push(pose::read_at(&path, pose)?);
    }
    Ok(())
}
