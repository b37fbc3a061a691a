//! Evaluations and rollouts as jobs: same bits as in this process, refusals, places, deadlines, the end.

use std::{sync::Arc, time::Duration};

use emp_client::{
    Client, ClientError, CollectFinished, CollectRequest, CollectRolloutsConfig, Collection,
    EnvironmentRandomization, EnvironmentSettings, EpisodeEnd, EpisodeResult, Evaluation,
    EvaluationConfig, EvaluationEvent, EvaluationMetrics, EvaluationResult, GoalClip as SentClip,
    JobState, MassRange, Metric, ProceduralClips, Push, Range, RewardWeight, RolloutBlock, StepEnd,
};
use emp_models::{controller::Controller, retarget::Retargeter};
use emp_motion::{Clip, skills};
use emp_proto::v1::{
    MotionClip, MotionPoses, StartEvaluationRequest, WatchEvaluationRequest,
    rollout_service_client::RolloutServiceClient, start_evaluation_request::Message,
};
use emp_server::Drain;
use emp_sim::{
    Collector, End, Pool, Priority, Rollout,
    environment::{EnvironmentConfig, VecEnvironment},
    evaluation::{self, EvaluationSettings},
    goals::{GoalClip, GoalLibrary, Source},
    metrics::Interval,
    pushes,
};
use emp_tests::{
    TestServer, emp27, fake, policy,
    raw::{self, wrong_field},
    within,
};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Request, Status, metadata::MetadataValue};
use tonic_types::StatusExt as _;

/// How far the rounding of motion on the wire may move a metric, in the metric's unit.
const ROUNDING: f64 = 1e-3;
/// Episodes that no test waits for.
const ENDLESS: u32 = 100_000;

fn config() -> EvaluationConfig {
    EvaluationConfig {
        robot: "emp27".to_owned(),
        seed: 7,
        ..EvaluationConfig::default()
    }
}

fn controller(text: &str) -> Option<emp_client::Controller> {
    Some(emp_client::controller(text).expect("a controller"))
}

fn procedural(count: u32) -> Option<ProceduralClips> {
    Some(ProceduralClips { count, seed: 3 })
}

fn endless() -> EvaluationConfig {
    EvaluationConfig {
        procedural: procedural(1),
        episodes: ENDLESS,
        ..config()
    }
}

fn recorded() -> Vec<Clip> {
    let mut clip = skills::generate(skills::Skill::Wave, 5);
    clip.name = "a wave".to_owned();
    // Longer than one message holds.
    let mut long = skills::medley(2);
    long.name = "a medley".to_owned();
    let long = long.resampled(200.0).expect("an ordinary rate");
    assert!(long.frames.len() > 4096);
    vec![clip, long]
}

async fn next(evaluation: &mut Evaluation) -> anyhow::Result<Option<EvaluationEvent>> {
    Ok(within("a message", evaluation.next()).await??)
}

/// Follows an evaluation to its result; the clips of its episodes come first.
async fn finish(mut evaluation: Evaluation) -> anyhow::Result<Finished> {
    let (mut clips, mut failures, mut result) = (Vec::new(), Vec::new(), None);
    while let Some(event) = next(&mut evaluation).await? {
        match event {
            EvaluationEvent::Preparing(preparing) => assert!(preparing.done <= preparing.motions),
            EvaluationEvent::Started(started) => {
                assert_eq!(started.robot, "emp27");
                assert_eq!(started.policy, "emp27-policy");
                assert_eq!(started.retargeter, "emp27-retargeter");
            }
            EvaluationEvent::Episode(episode) => {
                let result = episode.result.expect("a result");
                clips.push(result.clip.clone());
                if result.end() != EpisodeEnd::Completed {
                    failures.push(result);
                }
                assert_eq!(episode.finished as usize, clips.len());
            }
            EvaluationEvent::Result(last) => result = Some(last),
        }
    }
    failures.sort_by_key(|episode| episode.episode);
    Ok(Finished {
        clips,
        failures,
        result: result.expect("a result"),
    })
}

/// What came of an evaluation.
#[derive(Debug, PartialEq)]
struct Finished {
    clips: Vec<String>,
    /// By number.
    failures: Vec<EpisodeResult>,
    result: EvaluationResult,
}

/// Waits until an evaluation's episodes begin.
async fn begun(evaluation: &mut Evaluation) -> anyhow::Result<()> {
    loop {
        match next(evaluation).await? {
            Some(EvaluationEvent::Started(_)) => return Ok(()),
            Some(EvaluationEvent::Preparing(_)) => {}
            other => panic!("{other:?}"),
        }
    }
}

/// How an evaluation that cannot go on ends.
async fn refusal(evaluation: Result<Evaluation, ClientError>) -> anyhow::Result<Status> {
    let mut evaluation = match evaluation {
        Ok(evaluation) => evaluation,
        Err(ClientError::Status(status)) => return Ok(status),
        Err(error) => panic!("{error}"),
    };
    loop {
        match within("the end", evaluation.next()).await? {
            Ok(Some(_)) => {}
            Ok(None) => panic!("it ended well"),
            Err(ClientError::Status(status)) => return Ok(status),
            Err(error) => panic!("{error}"),
        }
    }
}

fn assert_close(served: Option<Metric>, here: Interval, tolerance: f64) {
    let Metric { mean, low, high } = served.expect("a metric");
    for (served, here) in [(mean, here.mean), (low, here.low), (high, here.high)] {
        assert!((served - here).abs() <= tolerance, "{served} {here}");
    }
}

/// Compares metrics with those of this process.
fn assert_metrics(served: &EvaluationMetrics, here: &evaluation::Scores, tolerance: f64) {
    assert_eq!(served.episodes as usize, here.episodes);
    let metrics = here.metrics;
    assert_close(served.suc, metrics.suc, tolerance);
    assert_close(served.mjp, metrics.mjp, tolerance);
    assert_close(served.msc, metrics.msc, tolerance);
    assert_close(
        served.self_collision_share,
        metrics.self_collision_share,
        tolerance,
    );
    assert_close(served.mbv, metrics.mbv, tolerance);
    assert_close(served.mba, metrics.mba, tolerance);
    assert_close(served.mbo, metrics.mbo, tolerance);
    assert_close(served.mus, metrics.mus, tolerance);
    let (goals, goals_here) = (
        served.goals.expect("goal statistics"),
        here.goals.expect("goal statistics"),
    );
    let close = |served: f64, here: f64| assert!((served - here).abs() <= tolerance);
    close(
        goals.hand_speed.expect("hand speed").p95,
        goals_here.hand_speed.p95,
    );
    close(
        goals.amplitude.expect("amplitude").mean,
        goals_here.amplitude.mean,
    );
}

#[tokio::test]
async fn an_evaluation_gives_the_same_bits_twice_and_those_of_this_process() -> anyhow::Result<()> {
    let weights = policy::weights()?;
    let config = EvaluationConfig {
        controller: controller("velocity-limit:limit=3"),
        procedural: procedural(2),
        amplitude: Some(1.2),
        push: Some(Push {
            speed: 0.4,
            interval: 0.0,
        }),
        ..config()
    };
    let mut results = Vec::new();
    for threads in [1, 2] {
        let server = TestServer::start_with(weights.path(), |settings| {
            settings.rollouts.threads = threads;
        })?;
        let client = Client::connect(&server.url()).await?;
        let evaluation = client.evaluate(config.clone(), recorded()).await?;
        results.push(finish(evaluation).await?);
    }
    assert_eq!(results[0], results[1]);
    let Finished {
        clips,
        failures,
        result: served,
    } = results.remove(0);

    let robot = emp27()?;
    let retargeter = Retargeter::load(
        &weights.path().join("emp27-retargeter.safetensors"),
        Arc::clone(&robot),
    )?;
    let goals = |clips: &[Clip], source| GoalClip::retargeted(&retargeter, clips, source, 1);
    let whole = [
        goals(&recorded(), Source::Recorded)?,
        goals(&skills::library(3, 2), Source::Procedural)?,
    ];
    let cut: Vec<GoalClip> = whole
        .iter()
        .flatten()
        .flat_map(|clip| clip.windows(200))
        .collect();
    let policy = policy::load(&weights)?;
    let controller = Controller::by_name("velocity-limit:limit=3", &policy, None)?;
    let pool = Pool::new(&robot, 1, Priority::Normal)?;
    let settings = EvaluationSettings {
        seed: 7,
        amplitude: 1.2,
        push: Some(pushes::Kick {
            speed: 0.4,
            interval: 5.0,
        }),
        ..EvaluationSettings::default()
    };
    let here = evaluation::evaluate(&pool, &controller, &cut, &settings, &mut ())?;

    assert_eq!(clips.len(), cut.len());
    // Procedural motion does not travel; of recorded motion, the wire rounds positions and orientations.
    let procedural_here = here.procedural.as_ref().expect("procedural");
    assert_metrics(
        &served.procedural.expect("procedural"),
        procedural_here,
        0.0,
    );
    let recorded_here = here.recorded.as_ref().expect("recorded");
    assert_metrics(&served.recorded.expect("recorded"), recorded_here, ROUNDING);
    assert_metrics(&served.all.expect("all"), &here.all, ROUNDING);
    assert!(!here.failures.is_empty(), "a random policy falls");
    assert_eq!(failures.len(), here.failures.len());
    for (served, here) in failures.iter().zip(&here.failures) {
        assert_eq!(
            (&served.clip, served.failure_time, &served.reason),
            (&here.clip, Some(here.time), &here.reason)
        );
    }
    Ok(())
}

#[tokio::test]
async fn wrong_evaluations_are_refused_by_field() -> anyhow::Result<()> {
    let weights = policy::weights()?;
    let server = TestServer::start_with(weights.path(), |settings| {
        settings.rollouts.max_frames = 1_500.try_into().expect("not zero");
    })?;
    let client = Client::connect(&server.url()).await?;
    let with = |change: &dyn Fn(&mut EvaluationConfig)| {
        let mut config = EvaluationConfig {
            procedural: procedural(1),
            ..config()
        };
        change(&mut config);
        config
    };
    let cases = [
        ("robot", with(&|config| config.robot = "nobody".to_owned())),
        ("model", with(&|config| config.policy = "other".to_owned())),
        (
            "model_version",
            with(&|config| config.policy_version = "0".to_owned()),
        ),
        (
            "model",
            with(&|config| config.retargeter = "other".to_owned()),
        ),
        ("robot", with(&|config| config.emp = "other".to_owned())),
        (
            "config.procedural.count",
            with(&|config| config.procedural = procedural(2)),
        ),
        (
            "config.controller",
            with(&|config| config.controller = controller("wishful-thinking")),
        ),
        (
            "config.controller",
            with(&|config| config.controller = controller("velocity-limit:limit=-1")),
        ),
        (
            "config.procedural",
            with(&|config| config.procedural = None),
        ),
        (
            "config.procedural.count",
            with(&|config| config.procedural = procedural(ENDLESS)),
        ),
        (
            "config.episodes",
            with(&|config| config.episodes = ENDLESS + 1),
        ),
        (
            "config.clip_frames",
            with(&|config| config.clip_frames = ENDLESS + 1),
        ),
        (
            "config.randomization",
            with(&|config| config.randomization = 9),
        ),
        (
            "config.hand_load.most",
            with(&|config| {
                config.hand_load = Some(MassRange {
                    least: 2.0,
                    most: 1.0,
                });
            }),
        ),
        (
            "config.hand_load.least",
            with(&|config| {
                config.hand_load = Some(MassRange {
                    least: f64::NAN,
                    most: 1.0,
                });
            }),
        ),
        (
            "config.push.speed",
            with(&|config| {
                config.push = Some(Push {
                    speed: f64::NAN,
                    interval: 1.0,
                });
            }),
        ),
        (
            "config.push.interval",
            with(&|config| {
                config.push = Some(Push {
                    speed: 1.0,
                    interval: -1.0,
                });
            }),
        ),
        ("config.speed", with(&|config| config.speed = Some(0.0))),
        (
            "config.amplitude",
            with(&|config| config.amplitude = Some(-1.0)),
        ),
    ];
    for (field, config) in cases {
        let status = refusal(client.evaluate(config, Vec::new()).await).await?;
        assert_eq!(wrong_field(&status), field, "{}", status.message());
    }

    let good = || raw::pose(&fake::pose(0.1));
    let clip = |poses| {
        Message::Clip(MotionClip {
            name: "motion".to_owned(),
            fps: 50.0,
            poses,
        })
    };
    let at_rate = |fps, frames| {
        Message::Clip(MotionClip {
            name: "motion".to_owned(),
            fps,
            poses: vec![good(); frames],
        })
    };
    let bad = || {
        let mut pose = good();
        pose.left_elbow = None;
        pose
    };
    let cases = [
        ("config", vec![clip(vec![good()])]),
        (
            "config",
            vec![Message::Config(config()), Message::Config(config())],
        ),
        (
            "poses",
            vec![
                Message::Config(config()),
                Message::Poses(MotionPoses { poses: Vec::new() }),
            ],
        ),
        (
            "clip.poses[1].left_elbow",
            vec![Message::Config(config()), clip(vec![good(), bad()])],
        ),
        (
            "poses.poses[0].left_elbow",
            vec![
                Message::Config(config()),
                clip(vec![good()]),
                Message::Poses(MotionPoses { poses: vec![bad()] }),
            ],
        ),
        (
            "clip.poses",
            vec![Message::Config(config()), clip(Vec::new())],
        ),
        (
            "clip.poses",
            vec![Message::Config(config()), clip(vec![good(); 1_501])],
        ),
        (
            "clip.poses",
            vec![Message::Config(config()), clip(vec![good(); 10])],
        ),
        (
            "clip.name",
            vec![
                Message::Config(config()),
                Message::Clip(MotionClip {
                    fps: 50.0,
                    ..MotionClip::default()
                }),
            ],
        ),
        (
            "clip.name",
            vec![
                Message::Config(config()),
                Message::Clip(MotionClip {
                    name: "x".repeat(129),
                    fps: 50.0,
                    poses: vec![good()],
                }),
            ],
        ),
        // What two poses become counts, not that they are two.
        (
            "clip.poses",
            vec![Message::Config(config()), at_rate(1.0, 40)],
        ),
        ("clip.fps", vec![Message::Config(config()), at_rate(0.0, 2)]),
        (
            "clip.fps",
            vec![Message::Config(config()), at_rate(1e-9, 2)],
        ),
        (
            "clip.fps",
            vec![Message::Config(config()), at_rate(f64::MIN_POSITIVE, 2)],
        ),
        (
            "clip.fps",
            vec![Message::Config(config()), at_rate(f64::NAN, 2)],
        ),
    ];
    let mut raw = RolloutServiceClient::connect(server.url()).await?;
    for (field, messages) in cases {
        let requests = messages.into_iter().map(|message| StartEvaluationRequest {
            message: Some(message),
        });
        let requests = tokio_stream::iter(requests.collect::<Vec<_>>());
        let answer = within("an answer", raw.start_evaluation(requests)).await?;
        let status = answer.expect_err(field);
        assert_eq!(wrong_field(&status), field, "{}", status.message());
    }
    Ok(())
}

/// Tries until there is a place again.
async fn place_again(client: &Client) -> anyhow::Result<Evaluation> {
    within("a place", async {
        loop {
            match client.evaluate(endless(), Vec::new()).await {
                Ok(evaluation) => return Ok(evaluation),
                Err(error) => {
                    assert_eq!(error.code(), Some(Code::ResourceExhausted), "{error}");
                    tokio::time::sleep(Duration::from_millis(5)).await;
                }
            }
        }
    })
    .await?
}

#[tokio::test]
async fn a_job_beyond_the_limit_is_refused_and_a_cancelled_one_makes_room() -> anyhow::Result<()> {
    let weights = policy::weights()?;
    let server = TestServer::start_with(weights.path(), |_| {})?;
    let client = Client::connect(&server.url()).await?;
    let mut running = client.evaluate(endless(), Vec::new()).await?;
    begun(&mut running).await?;

    let status = refusal(client.evaluate(endless(), Vec::new()).await).await?;
    assert_eq!(status.code(), Code::ResourceExhausted, "{status:?}");
    let details = status.get_error_details();
    assert_eq!(
        details.error_info().expect("ErrorInfo").reason,
        "OVERLOADED"
    );
    assert!(
        details
            .retry_info()
            .and_then(|info| info.retry_delay)
            .is_some_and(|delay| !delay.is_zero())
    );
    // The limit is on jobs of either kind.
    let learner = client
        .collect_rollouts(collect_config(0..4), library()?)
        .await;
    let error = learner.expect_err("no place");
    assert_eq!(error.code(), Some(Code::ResourceExhausted));

    // Nobody watches it, and it goes on.
    let job = running.job().to_owned();
    drop(running);
    let jobs = client.jobs().await?;
    assert_eq!(jobs.len(), 1);
    assert_eq!((&jobs[0].id, jobs[0].state()), (&job, JobState::Running));
    client.cancel_job(&job).await?;
    place_again(&client).await?;
    let status = refusal(client.watch(&job, 0).await).await?;
    assert_eq!(status.code(), Code::Aborted, "{status:?}");
    client.cancel_job(&job).await?;
    let status = refusal(client.watch(&job, 0).await).await?;
    assert_eq!(status.code(), Code::NotFound, "{status:?}");
    Ok(())
}

#[tokio::test]
async fn a_place_is_not_held_by_a_call_that_has_not_sent_all() -> anyhow::Result<()> {
    let weights = policy::weights()?;
    let server = TestServer::start_with(weights.path(), |_| {})?;
    let mut raw = RolloutServiceClient::connect(server.url()).await?;
    let (requests, outbound) = tokio::sync::mpsc::channel(4);
    let message = Some(Message::Config(endless()));
    requests.send(StartEvaluationRequest { message }).await?;
    let silent =
        tokio::spawn(async move { raw.start_evaluation(ReceiverStream::new(outbound)).await });
    let client = Client::connect(&server.url()).await?;
    let config = EvaluationConfig {
        procedural: procedural(1),
        episodes: 1,
        ..config()
    };
    finish(client.evaluate(config, Vec::new()).await?).await?;
    assert!(!silent.is_finished());
    Ok(())
}

#[tokio::test]
async fn a_watcher_that_was_cut_off_goes_on_where_it_was() -> anyhow::Result<()> {
    let weights = policy::weights()?;
    let server = TestServer::start_with(weights.path(), |_| {})?;
    let client = Client::connect(&server.url()).await?;
    let config = EvaluationConfig {
        procedural: procedural(2),
        episodes: 6,
        ..config()
    };
    let mut first = client.evaluate(config, Vec::new()).await?;
    begun(&mut first).await?;
    let (job, next_event) = (first.job().to_owned(), first.next_event());
    drop(first);
    let rest = finish(client.watch(&job, next_event).await?).await?;
    assert_eq!(rest.clips.len(), 6);
    // After the end, too, and from the start.
    assert_eq!(finish(client.watch(&job, 0).await?).await?, rest);
    let jobs = client.jobs().await?;
    assert_eq!((jobs[0].state(), jobs[0].finished), (JobState::Done, 6));
    Ok(())
}

#[tokio::test]
async fn a_watchers_deadline_ends_its_watch_and_not_the_job() -> anyhow::Result<()> {
    let weights = policy::weights()?;
    let server = TestServer::start_with(weights.path(), |_| {})?;
    let client = Client::connect(&server.url()).await?;
    let mut running = client.evaluate(endless(), Vec::new()).await?;
    begun(&mut running).await?;
    let mut call = Request::new(WatchEvaluationRequest {
        job: running.job().to_owned(),
        first_event: 0,
    });
    call.metadata_mut()
        .insert("grpc-timeout", MetadataValue::from_static("1S"));
    let mut raw = RolloutServiceClient::connect(server.url()).await?;
    let mut responses = raw.watch_evaluation(call).await?.into_inner();
    let status = loop {
        match within("the deadline", responses.message()).await? {
            Ok(Some(_)) => {}
            Ok(None) => panic!("it ended well"),
            Err(status) => break status,
        }
    };
    assert_eq!(status.code(), Code::DeadlineExceeded, "{status:?}");
    assert!(status.get_error_details().error_info().is_some());
    assert!(matches!(
        next(&mut running).await?,
        Some(EvaluationEvent::Episode(_))
    ));
    Ok(())
}

#[tokio::test]
async fn controllers_are_listed() -> anyhow::Result<()> {
    let weights = policy::weights()?;
    let server = TestServer::start_with(weights.path(), |_| {})?;
    let client = Client::connect(&server.url()).await?;
    let names = |controllers: Vec<emp_client::ControllerDescription>| -> Vec<String> {
        controllers.into_iter().map(|one| one.name).collect()
    };
    let all = names(client.controllers("").await?);
    assert!(all.contains(&"emp".to_owned()) && all.contains(&"one-euro".to_owned()));
    let without_emp = names(client.controllers("emp27").await?);
    assert!(!without_emp.contains(&"emp".to_owned()));
    assert_eq!(without_emp[0], "decoupled");
    Ok(())
}

#[tokio::test]
async fn draining_ends_jobs_as_unavailable() -> anyhow::Result<()> {
    let weights = policy::weights()?;
    let server = TestServer::start_with(weights.path(), |settings| {
        settings.rollouts.max_jobs = 2.try_into().expect("not zero");
    })?;
    let client = Client::connect(&server.url()).await?;
    let mut running = client.evaluate(endless(), Vec::new()).await?;
    begun(&mut running).await?;
    let mut learner = client
        .collect_rollouts(collect_config(0..4), library()?)
        .await?;
    server.begin_shutdown();
    let status = refusal(Ok(running)).await?;
    assert_eq!(status.code(), Code::Unavailable, "{status:?}");
    let error = within("the end", learner.snapshot())
        .await?
        .expect_err("it is gone");
    assert_eq!(error.reason().as_deref(), Some("SHUTTING_DOWN"), "{error}");
    assert_eq!(server.ended().await?, Drain::Complete);
    Ok(())
}

fn goals() -> anyhow::Result<Vec<GoalClip>> {
    let robot = emp27()?;
    let clip = |name: &str, frequency: f32| {
        let rows: Vec<Vec<f32>> = (0..150)
            .map(|t| {
                let swing = 0.3 * (frequency * t as f32).sin();
                let joints = robot.goal_joints().iter();
                joints.map(|joint| joint.default as f32 + swing).collect()
            })
            .collect();
        GoalClip::new(&robot, name, Source::Recorded, &rows)
    };
    Ok(vec![clip("slow", 0.05)?, clip("fast", 0.2)?])
}

fn library() -> anyhow::Result<Vec<SentClip>> {
    let sent = |clip: &GoalClip| SentClip {
        name: clip.name.clone(),
        goals: clip.frames().flatten().copied().collect(),
        ..SentClip::default()
    };
    Ok(goals()?.iter().map(sent).collect())
}

/// Episodes that end within the rollouts of these tests.
fn environment() -> EnvironmentConfig {
    EnvironmentConfig {
        episode_frames: 20,
        ..EnvironmentConfig::default()
    }
}

fn collect_config(environments: std::ops::Range<u64>) -> CollectRolloutsConfig {
    CollectRolloutsConfig {
        robot: "emp27".to_owned(),
        environments: (environments.end - environments.start) as u32,
        first_environment: environments.start,
        seed: 11,
        environment: Some(EnvironmentSettings {
            episode_frames: Some(20),
            ..EnvironmentSettings::default()
        }),
        ..CollectRolloutsConfig::default()
    }
}

fn collect_request(iteration: u64) -> CollectRequest {
    CollectRequest {
        iteration,
        log_standard_deviation: vec![-1.0; 12],
        horizon: 24,
        randomization: 0.5,
        difficulty: 0.8,
    }
}

fn collector(environments: std::ops::Range<u64>) -> anyhow::Result<Collector> {
    let robot = emp27()?;
    let pool = Arc::new(Pool::new(&robot, 2, Priority::Normal)?);
    let library = Arc::new(GoalLibrary::new(&robot, goals()?)?);
    let first = environments.start;
    let environments = VecEnvironment::new(robot, pool, environment(), library, environments, 11)?;
    Ok(Collector::new(environments, first, 11))
}

fn assert_rollout(
    (blocks, finished): &(Vec<RolloutBlock>, CollectFinished),
    expected: &Rollout,
    width: usize,
) {
    let [block] = &blocks[..] else {
        panic!("so few robots fit one block")
    };
    assert_eq!(block.environments as usize, expected.environments);
    assert_eq!(block.features, expected.features);
    assert_eq!(block.privileged, expected.privileged);
    assert_eq!(block.privileged.len(), width * block.rewards.len());
    assert_eq!(block.last_privileged, expected.last_privileged);
    assert_eq!(block.means, expected.means);
    assert_eq!(block.actions, expected.actions);
    assert_eq!(block.rewards, expected.rewards);
    let ends = expected.ends.iter().map(|end| match end {
        End::None => StepEnd::None,
        End::Terminated => StepEnd::Terminated,
        End::TimedOut => StepEnd::TimedOut,
        End::Diverged => StepEnd::Diverged,
    });
    assert!(ends.eq(block.ends()));
    assert!(!expected.timed_out_privileged.is_empty());
    let timed_out = block.timed_out.iter().map(|state| {
        let row = state.step as usize * expected.environments + state.environment as usize;
        (row, state.privileged.clone())
    });
    assert!(timed_out.eq(expected.timed_out_privileged.iter().cloned()));
    let means = finished.reward_terms.iter().map(|term| term.mean);
    assert!(means.eq(expected.statistics.reward_terms.iter().copied()));
    let lengths = finished.episodes.iter().map(|episode| episode.length);
    assert!(lengths.eq(expected.statistics.episodes.iter().map(|e| e.length)));
}

#[tokio::test]
async fn rollouts_are_those_of_this_process_whoever_collects_them() -> anyhow::Result<()> {
    let weights = policy::weights()?;
    let policy = policy::load(&weights)?;
    let bytes = policy.encode()?;
    let server = TestServer::start_with(weights.path(), |settings| {
        settings.rollouts.max_jobs = 2.try_into().expect("not zero");
        settings.rollouts.threads = 1;
    })?;
    let client = Client::connect(&server.url()).await?;
    for range in [0..3, 3..8] {
        let mut here = collector(range.clone())?;
        let width = here.environments().privileged_layout().width();
        let mut learner = client
            .collect_rollouts(collect_config(range), library()?)
            .await?;
        assert_eq!(learner.started().privileged as usize, width);
        let mut snapshot = Vec::new();
        for iteration in 0..3 {
            if iteration == 1 {
                snapshot = within("a snapshot", learner.snapshot()).await??;
                assert_eq!(snapshot, here.snapshot()?);
            }
            here.set_curriculum(0.5, 0.8);
            let expected = here.collect(&policy, &[-1.0; 12], 24)?;
            let request = collect_request(iteration);
            let rollout = within("a rollout", learner.collect(&bytes, request)).await??;
            assert_rollout(&rollout, &expected, width);
        }
        here.restore(&snapshot)?;
        within("a restored snapshot", learner.restore(&snapshot)).await??;
        here.set_curriculum(0.5, 0.8);
        let expected = here.collect(&policy, &[-1.0; 12], 24)?;
        let request = collect_request(9);
        let rollout = within("a rollout", learner.collect(&bytes, request)).await??;
        assert_rollout(&rollout, &expected, width);
    }
    Ok(())
}

async fn refused(learner: Result<Collection, ClientError>) -> String {
    match learner {
        Err(ClientError::Status(status)) => wrong_field(&status),
        Err(error) => panic!("{error}"),
        Ok(_) => panic!("it was accepted"),
    }
}

#[tokio::test]
async fn wrong_rollouts_are_refused_by_field() -> anyhow::Result<()> {
    let weights = policy::weights()?;
    let policy = policy::load(&weights)?;
    let server = TestServer::start_with(weights.path(), |settings| {
        settings.rollouts.max_jobs = 64.try_into().expect("not zero");
    })?;
    let client = Client::connect(&server.url()).await?;
    let with = |change: &dyn Fn(&mut CollectRolloutsConfig)| {
        let mut config = collect_config(0..2);
        change(&mut config);
        config
    };
    let environment = |change: &dyn Fn(&mut EnvironmentSettings)| {
        with(&|config| change(config.environment.as_mut().expect("settings")))
    };
    let cases = [
        ("robot", with(&|config| config.robot = "nobody".to_owned())),
        (
            "config.environments",
            with(&|config| config.environments = 0),
        ),
        (
            "config.environment.rewards[0].term",
            environment(&|settings| {
                settings.rewards.push(RewardWeight {
                    term: "applause".to_owned(),
                    weight: 1.0,
                });
            }),
        ),
        (
            "config.environment.episode_frames",
            environment(&|settings| settings.episode_frames = Some(0)),
        ),
        (
            "config.environment.tilt_limit",
            environment(&|settings| settings.tilt_limit = Some(f64::NAN)),
        ),
        (
            "config.environment.randomization.friction.most",
            environment(&|settings| {
                settings.randomization = Some(EnvironmentRandomization {
                    friction: Some(Range {
                        least: 0.0,
                        most: 1e300,
                    }),
                    ..EnvironmentRandomization::default()
                });
            }),
        ),
        (
            "config.first_environment",
            with(&|config| config.first_environment = u64::MAX),
        ),
    ];
    for (field, config) in cases {
        let learner = client.collect_rollouts(config, library()?).await;
        assert_eq!(refused(learner).await, field);
    }
    let no_library = client.collect_rollouts(collect_config(0..2), Vec::new());
    assert_eq!(refused(no_library.await).await, "config.clips");
    let mut clips = library()?;
    clips[1].goals.pop();
    let learner = client.collect_rollouts(collect_config(0..2), clips).await;
    assert_eq!(refused(learner).await, "clip.goals");

    let other_robot = {
        let mut bytes = policy.encode()?;
        let at = bytes
            .windows(5)
            .position(|part| part == b"emp27")
            .expect("the robot's name");
        bytes[at..at + 5].copy_from_slice(b"emp99");
        bytes
    };
    let good = collect_request(0);
    let bytes = policy.encode()?;
    let requests = [
        ("policy", vec![1, 2, 3], good.clone()),
        ("policy", other_robot, good.clone()),
        // No policy at all.
        ("policy", Vec::new(), good.clone()),
        (
            "collect.log_standard_deviation",
            bytes.clone(),
            CollectRequest {
                log_standard_deviation: vec![0.0; 3],
                ..good.clone()
            },
        ),
        (
            "collect.log_standard_deviation[0]",
            bytes.clone(),
            CollectRequest {
                log_standard_deviation: vec![3e38; 12],
                ..good.clone()
            },
        ),
        (
            "collect.horizon",
            bytes.clone(),
            CollectRequest {
                horizon: 0,
                ..good.clone()
            },
        ),
        (
            "collect.difficulty",
            bytes.clone(),
            CollectRequest {
                difficulty: f64::NAN,
                ..good
            },
        ),
    ];
    for (field, policy, request) in requests {
        let mut learner = client
            .collect_rollouts(collect_config(0..2), library()?)
            .await?;
        let error = within("a refusal", learner.collect(&policy, request))
            .await?
            .expect_err("refused");
        let ClientError::Status(status) = error else {
            panic!("{error}")
        };
        assert_eq!(wrong_field(&status), field);
    }
    let mut learner = client
        .collect_rollouts(collect_config(0..2), library()?)
        .await?;
    let error = learner.restore(b"nonsense").await.expect_err("refused");
    let ClientError::Status(status) = error else {
        panic!("{error}")
    };
    assert_eq!(wrong_field(&status), "restore");
    Ok(())
}
