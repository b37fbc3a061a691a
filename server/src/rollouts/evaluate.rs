//! Evaluations: a controller on a set of motions. The call that starts one sends what it needs; the job goes on without it.

use std::sync::Arc;

use emp_models::{controller::Controller, retarget::Retargeter};
use emp_motion::Clip;
use emp_proto::v1::{
    EpisodeFinished, EvaluationConfig, EvaluationPreparing, EvaluationStarted, HumanPose,
    MotionClip, Push, Randomization, StartEvaluationRequest,
    start_evaluation_request::Message as Request, watch_evaluation_response::Message as Event,
};
use emp_robot::Robot;
use emp_sim::{
    SimError,
    evaluation::{EpisodeResult, EvaluationSettings, Progress, RandomizationLevel, evaluate},
    goals::{GoalClip, Source},
    pushes::Kick,
};
use tokio_util::sync::CancellationToken;
use tonic::Streaming;

use super::{
    clips,
    context::{IDLE, RolloutContext},
    controllers,
    job::{self, failed, guarded},
    jobs::EvaluationJob,
    scores,
};
use crate::{
    catalog::{FilterModel, PolicyModel, RetargetModel},
    decode::{fields, pose, rollouts as decode, rollouts::Budget},
    encode,
    error::{FieldError, ServiceError},
    session::Reader,
};

/// Frames of an evaluation clip, as in the paper.
const CLIP_FRAMES: usize = 200;
/// Time between pushes, as in the paper, seconds.
const PUSH_INTERVAL: f64 = 5.0;
/// Most frames of an evaluation clip, and most episodes.
const MAX_COUNT: u32 = 100_000;
/// Least and most frames a second of a motion.
const FPS: [f64; 2] = [1.0, 1_000.0];
/// Most frames of one motion at the control rate: while it is retargeted the job does not ask whether to stop.
const LONGEST_MOTION: usize = 30_000;
/// Largest mass in a hand, kilograms.
const MAX_LOAD: f64 = 20.0;

/// What a call asks for.
struct Plan {
    policy: Arc<PolicyModel>,
    emp: Option<Arc<FilterModel>>,
    retargeter: Arc<RetargetModel>,
    network: Arc<Retargeter>,
    controller: Controller,
    settings: EvaluationSettings,
    clip_frames: usize,
    /// Number and seed of the procedural motions.
    procedural: (usize, u64),
}

/// Takes what a job needs, and starts it. Answers with its id.
pub(crate) async fn start(
    context: RolloutContext,
    inbound: Streaming<StartEvaluationRequest>,
) -> Result<String, ServiceError> {
    let _upload = context.enter_upload()?;
    let mut inbound = Reader::new(inbound, IDLE);
    let first = inbound.next().await?;
    let Some(Request::Config(config)) = first.and_then(|first| first.message) else {
        return Err(FieldError::missing_config().into());
    };
    let mut motions = Motions::new(context.budget());
    let plan = Plan::read(&context, &config, &mut motions)?;
    context.jobs.check_room()?;
    motions.control_rate = plan.policy.robot.control_rate_hz();
    while let Some(request) = inbound.next().await? {
        // A message may hold thousands of poses: too many for the threads that serve streams.
        let reading = tokio::task::spawn_blocking(move || motions.take(request));
        motions = reading.await.map_err(failed)??;
    }
    let motions = motions.finish(plan.procedural.0, plan.clip_frames)?;
    let place = context.jobs.enter()?;
    let job = context.jobs.add(&config.robot);
    let id = job.id.clone();
    let task = Task {
        job,
        drain: context.drain.clone(),
    };
    job::start(place, move |threads| {
        let end = guarded(|| plan.run(&task, &motions, threads));
        move || task.job.finish(end)
    })?;
    Ok(id)
}

/// A job on its thread.
struct Task {
    job: Arc<EvaluationJob>,
    drain: CancellationToken,
}

impl Task {
    /// Why the job has to stop, if it has to. Cheap: to be asked once a control period.
    fn check(&self) -> Result<(), ServiceError> {
        if self.job.is_cancelled() {
            Err(ServiceError::JobCancelled)
        } else if self.drain.is_cancelled() {
            Err(ServiceError::ShuttingDown)
        } else {
            Ok(())
        }
    }
}

impl Plan {
    fn read(
        context: &RolloutContext,
        config: &EvaluationConfig,
        motions: &mut Motions,
    ) -> Result<Self, ServiceError> {
        let EvaluationConfig {
            robot,
            policy,
            policy_version,
            emp,
            emp_version,
            retargeter,
            retargeter_version,
            ..
        } = config;
        let catalog = &context.catalog;
        let policy = catalog.policy_for(robot, policy, policy_version)?;
        let retargeter = catalog.retargeter_for(robot, retargeter, retargeter_version)?;
        let has_emp = policy.model.emp().is_some();
        let emp = (has_emp || !emp.is_empty() || !emp_version.is_empty())
            .then(|| catalog.filter_for(robot, emp, emp_version))
            .transpose()?;
        let model = emp.as_ref().map(|emp| emp.model.emp());
        let controller =
            controllers::read(config.controller.as_ref(), policy.model.policy(), model)?;
        let rate = policy.robot.control_rate_hz();
        let procedural = config.procedural.as_ref();
        let procedural = clips::read_procedural(procedural, rate, &mut motions.budget)?;
        let settings = read_settings(config, &policy.robot)?;
        let clip_frames = fields::within("config.clip_frames", config.clip_frames, 0..=MAX_COUNT)?;
        Ok(Self {
            network: clips::network(&retargeter)?,
            policy,
            emp,
            retargeter,
            controller,
            settings,
            clip_frames: match clip_frames {
                0 => CLIP_FRAMES,
                frames => frames as usize,
            },
            procedural,
        })
    }

    /// The job, on its own thread.
    fn run(&self, task: &Task, motions: &[Clip], threads: usize) -> Result<(), ServiceError> {
        let clips = self.prepare(task, motions, threads)?;
        let Self {
            policy,
            retargeter,
            controller,
            settings,
            ..
        } = self;
        let uses_emp = controller.name().starts_with("emp");
        let emp = self.emp.as_ref().filter(|_| uses_emp).map(|emp| &emp.card);
        let episodes = settings.episodes.unwrap_or(clips.len());
        task.job.tell(Event::Started(EvaluationStarted {
            robot: policy.card.robot.clone(),
            controller: controller.name().to_owned(),
            policy: policy.card.name.clone(),
            policy_version: policy.card.version.clone(),
            emp: emp.map(|emp| emp.name.clone()).unwrap_or_default(),
            emp_version: emp.map(|emp| emp.version.clone()).unwrap_or_default(),
            retargeter: retargeter.card.name.clone(),
            retargeter_version: retargeter.card.version.clone(),
            episodes: encode::count(episodes),
            control_rate: policy.robot.control_rate_hz(),
        }));
        let pool = job::pool(&policy.robot, threads).map_err(failed)?;
        let mut reporter = Reporter::new(task, &policy.robot);
        let evaluation =
            evaluate(&pool, controller, &clips, settings, &mut reporter).map_err(failed)?;
        // A job that had to stop has no metrics: they would be those of other episodes every time.
        task.check()?;
        task.job.tell(Event::Result(scores::result(&evaluation)));
        Ok(())
    }

    /// Retargets the recorded and the procedural motions, and cuts them into clips.
    fn prepare(
        &self,
        task: &Task,
        motions: &[Clip],
        threads: usize,
    ) -> Result<Vec<GoalClip>, ServiceError> {
        let procedural = clips::procedural(self.procedural, || task.check())?;
        let total = motions.len() + procedural.len();
        let sources = [
            (motions, Source::Recorded),
            (&procedural, Source::Procedural),
        ];
        let mut before = 0;
        let mut clips = Vec::new();
        for (motions, source) in sources {
            let progress = |done: usize| {
                task.check()?;
                task.job.tell(Event::Preparing(EvaluationPreparing {
                    done: encode::count(before + done),
                    motions: encode::count(total),
                }));
                Ok(())
            };
            let goals = clips::retarget(&self.network, motions, source, threads, progress)?;
            clips.extend(goals.iter().flat_map(|clip| clip.windows(self.clip_frames)));
            before += motions.len();
        }
        Ok(clips)
    }
}

/// Reports episodes as they end.
struct Reporter<'a> {
    task: &'a Task,
    robot: &'a Robot,
    finished: usize,
    stood: usize,
}

impl<'a> Reporter<'a> {
    fn new(task: &'a Task, robot: &'a Robot) -> Self {
        Self {
            task,
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
        self.task.job.tell(Event::Episode(EpisodeFinished {
            result: Some(scores::episode(episode, self.robot)),
            finished: encode::count(self.finished),
            success: self.stood as f64 / self.finished as f64,
        }));
    }

    fn is_cancelled(&self) -> bool {
        self.task.check().is_err()
    }
}

fn read_settings(
    config: &EvaluationConfig,
    robot: &Robot,
) -> Result<EvaluationSettings, FieldError> {
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
            let least = fields::within("config.hand_load.least", load.least, 0.0..=MAX_LOAD)?;
            let most = fields::within("config.hand_load.most", load.most, least..=MAX_LOAD)?;
            Some([least, most])
        }
        None => None,
    };
    let episodes = fields::within("config.episodes", config.episodes, 0..=MAX_COUNT)?;
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

/// Control periods that a motion of so many frames has at another rate.
fn control_periods(frames: usize, fps: f64, control_rate: f64) -> usize {
    match frames {
        0 => 0,
        // As many as resampling makes, give or take rounding.
        frames => ((frames - 1) as f64 / fps * control_rate + 1e-6).floor() as usize + 1,
    }
}

/// Motions as they come.
struct Motions {
    clips: Vec<Clip>,
    budget: Budget,
    control_rate: f64,
    /// Frames that the last clip is at the control rate.
    last: usize,
}

impl Motions {
    fn new(budget: Budget) -> Self {
        Self {
            clips: Vec::new(),
            budget,
            control_rate: 0.0,
            last: 0,
        }
    }

    /// Takes a clip, or more of the last one.
    fn take(mut self, request: StartEvaluationRequest) -> Result<Self, ServiceError> {
        match request.message {
            Some(Request::Clip(MotionClip { name, fps, poses })) => {
                self.check_last()?;
                self.clips.push(Clip {
                    name: decode::name("clip.name", name)?,
                    fps: fields::within("clip.fps", fps, FPS[0]..=FPS[1])?,
                    frames: Vec::new(),
                });
                self.last = 0;
                // Even the shortest one is a clip.
                self.budget.spend("clip.poses", 1)?;
                self.read_poses("clip.poses", &poses)?;
            }
            Some(Request::Poses(more)) => {
                if self.clips.is_empty() {
                    let description = "they come before the first clip";
                    return Err(FieldError::new("poses", description).into());
                }
                self.read_poses("poses.poses", &more.poses)?;
            }
            Some(Request::Config(_)) => return Err(FieldError::second_config().into()),
            None => {
                return Err(FieldError::new("message", "it is missing; expected a clip").into());
            }
        }
        Ok(self)
    }

    fn read_poses(&mut self, field: &str, poses: &[HumanPose]) -> Result<(), FieldError> {
        let Some(clip) = self.clips.last_mut() else {
            return Ok(());
        };
        // What they will become is counted before it is made.
        let all = clip.frames.len() + poses.len();
        let becomes = control_periods(all, clip.fps, self.control_rate).max(all);
        if becomes > LONGEST_MOTION {
            let description = format!(
                "motion {:?} is longer than {LONGEST_MOTION} control periods; send it as several",
                clip.name
            );
            return Err(FieldError::new(field, description));
        }
        self.budget
            .spend(field, becomes.saturating_sub(self.last))?;
        self.last = becomes;
        clip.frames.reserve_exact(poses.len());
        for (index, pose) in poses.iter().enumerate() {
            let frame = pose::read(Some(pose)).map_err(|error| {
                let rest = error.field.strip_prefix("pose").unwrap_or(&error.field);
                FieldError::new(format!("{field}[{index}]{rest}"), error.description)
            })?;
            clip.frames.push(frame);
        }
        Ok(())
    }

    fn check_last(&self) -> Result<(), FieldError> {
        match self.clips.last() {
            Some(clip) if clip.frames.is_empty() => {
                let description = format!("motion {:?} has none", clip.name);
                Err(FieldError::new("clip.poses", description))
            }
            _ => Ok(()),
        }
    }

    /// All of them, where there is something to run in clips of `frames`.
    fn finish(self, procedural: usize, frames: usize) -> Result<Vec<Clip>, ServiceError> {
        self.check_last()?;
        let shortest = frames.min(GoalClip::SHORTEST_WINDOW);
        let is_short = |clip: &Clip| {
            control_periods(clip.frames.len(), clip.fps, self.control_rate) < shortest
        };
        if procedural == 0 && !self.clips.is_empty() && self.clips.iter().all(is_short) {
            let description = format!("every motion is shorter than {shortest} control periods");
            return Err(FieldError::new("clip.poses", description).into());
        }
        if self.clips.is_empty() && procedural == 0 {
            let description = "no motion was sent, and no procedural motion asked for";
            return Err(FieldError::new("config.procedural", description).into());
        }
        Ok(self.clips)
    }
}
