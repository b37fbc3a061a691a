//! Leg targets over the wire: streams and single calls against the controller in this process, and what they refuse.

use std::sync::Arc;

use emp_client::{Client, Delivery, DropReason, Event, PolicyAnswer, PolicyConfig, RobotFrame};
use emp_models::{
    controller::{Controller, ControllerInput, ControllerOutput, ControllerState},
    observation::RobotState,
};
use emp_proto::v1::{
    self, PolicyFrame, PolicyObservation, PolicyResult, Quaternion, StepPolicyRequest,
    StreamPolicyConfig, StreamPolicyRequest, StreamPolicyResponse,
    motion_service_client::MotionServiceClient, stream_policy_request::Message as Request,
    stream_policy_response::Message as Response,
};
use emp_robot::Robot;
use emp_sim::{BodyParameters, Stage, Start, Targets};
use emp_tests::{
    TestServer, emp27, policy,
    raw::{self, RawStream, wrong_field},
    within,
};
use nalgebra::UnitQuaternion;
use tempfile::TempDir;
use tonic::{Code, transport::Channel};

/// Largest difference between an answer of the server and one of this process. The orientation travels as f32, and a batch
/// adds in another order.
const TOLERANCE: f32 = 1e-4;
/// Control periods of the recorded episode: longer than the history.
const FRAMES: usize = 60;

/// An episode as it was recorded, and what the controller answered to each frame.
struct Episode {
    frames: Vec<RobotFrame>,
    answers: Vec<ControllerOutput>,
}

fn step(
    controller: &Controller,
    state: &mut ControllerState,
    frame: &RobotFrame,
) -> anyhow::Result<ControllerOutput> {
    let input = ControllerInput {
        state: RobotState {
            joint_positions: &frame.joint_positions,
            orientation: frame.orientation,
        },
        goal: &frame.goal,
    };
    Ok(controller.step(&mut [(state, input)])?.remove(0))
}

/// A robot in MuJoCo that follows the controller while its arms swing and its world is turned.
fn record(controller: &Controller) -> anyhow::Result<Episode> {
    let robot = controller.policy().robot();
    let mut stage = Stage::new(robot)?;
    let default: Vec<f64> = robot.joints().map(|joint| joint.default).collect();
    let mut body = stage.place(&Start {
        joint_positions: &default,
        lift: 0.0,
        parameters: BodyParameters::default(),
    });
    let turned = UnitQuaternion::from_euler_angles(0.0, 0.0, 2.5);
    let mut state = controller.state();
    let (mut frames, mut answers) = (Vec::new(), Vec::new());
    for t in 0..FRAMES {
        let reading = body.reading();
        let swing = 0.3 * (0.1 * t as f32).sin();
        let frame = RobotFrame {
            joint_positions: reading.joint_positions.clone(),
            orientation: turned * reading.orientation,
            goal: goal(robot, swing),
            reset: false,
        };
        let answer = step(controller, &mut state, &frame)?;
        stage.step(
            &mut body,
            &Targets {
                goal: &answer.goal,
                legs: &answer.leg_targets,
            },
        );
        frames.push(frame);
        answers.push(answer);
    }
    Ok(Episode { frames, answers })
}

/// The default pose with every joint moved by `offset` toward the middle of its range where it must be, rad.
fn goal(robot: &Robot, offset: f32) -> Vec<f32> {
    let joints = robot.goal_joints().iter();
    joints
        .map(|joint| joint.clamp(joint.default as f32 + offset))
        .collect()
}

fn rest(robot: &Robot) -> RobotFrame {
    RobotFrame {
        joint_positions: robot.default_pose(),
        orientation: UnitQuaternion::identity(),
        goal: goal(robot, 0.1),
        reset: false,
    }
}

struct Fixture {
    server: TestServer,
    controller: Controller,
    weights: TempDir,
}

fn fixture() -> anyhow::Result<Fixture> {
    let weights = policy::weights()?;
    let controller = Controller::new(policy::load(&weights)?, None);
    Ok(Fixture {
        server: TestServer::start_with(weights.path(), |_| {})?,
        controller,
        weights,
    })
}

impl Fixture {
    async fn client(&self) -> anyhow::Result<Client> {
        Ok(Client::connect(&self.server.url()).await?)
    }

    async fn raw_client(&self) -> anyhow::Result<MotionServiceClient<Channel>> {
        self.server.raw_client().await
    }
}

fn assert_near(served: &[f32], expected: &[f32]) {
    emp_tests::assert_near(served, expected, TOLERANCE);
}

fn assert_equal(served: &PolicyAnswer, expected: &ControllerOutput) {
    assert_near(&served.executable_goal, &expected.goal);
    assert_near(&served.action, &expected.action);
    assert_near(&served.leg_targets, &expected.leg_targets);
}

/// Streams frames one by one and gives the answers.
async fn answers(client: &Client, frames: &[RobotFrame]) -> anyhow::Result<Vec<PolicyAnswer>> {
    let (mut sender, mut events) = client
        .policy_stream(PolicyConfig::for_robot("emp27"))
        .await?;
    assert_eq!(events.joint_names().len(), 27);
    let mut answers = Vec::new();
    for frame in frames {
        sender.send(frame, None).await?;
        match within("an answer", events.next()).await?? {
            Some(Event::Answer(answer)) => answers.push(answer),
            other => panic!("{other:?}"),
        }
    }
    drop(sender);
    assert_eq!(within("the end", events.next()).await??, None);
    Ok(answers)
}

#[tokio::test]
async fn a_stream_answers_as_the_controller_in_process() -> anyhow::Result<()> {
    let fixture = fixture()?;
    let client = fixture.client().await?;
    let episode = record(&fixture.controller)?;
    let distinct = episode.answers[FRAMES - 1].action[0] - episode.answers[0].action[0];
    assert!(distinct.abs() > 10.0 * TOLERANCE, "the history matters");
    let served = answers(&client, &episode.frames).await?;
    for (served, expected) in served.iter().zip(&episode.answers) {
        assert_equal(served, expected);
        assert_eq!(served.times.batch_size, 1);
    }
    Ok(())
}

#[tokio::test]
async fn reset_starts_the_episode_anew() -> anyhow::Result<()> {
    let fixture = fixture()?;
    let client = fixture.client().await?;
    let mut frames = record(&fixture.controller)?.frames;
    frames.truncate(20);
    frames[10].reset = true;
    let served = answers(&client, &frames).await?;
    let mut state = fixture.controller.state();
    for (served, frame) in served.iter().zip(&frames) {
        if frame.reset {
            state.reset();
        }
        assert_equal(served, &step(&fixture.controller, &mut state, frame)?);
    }
    Ok(())
}

#[tokio::test]
async fn streams_of_many_robots_keep_their_histories_apart() -> anyhow::Result<()> {
    let fixture = fixture()?;
    let client = fixture.client().await?;
    let episode = Arc::new(record(&fixture.controller)?);
    let streams = (0..8).map(|start| {
        let (client, episode) = (client.clone(), Arc::clone(&episode));
        tokio::spawn(async move { answers(&client, &episode.frames[start..]).await })
    });
    for (start, stream) in streams.collect::<Vec<_>>().into_iter().enumerate() {
        let served = stream.await??;
        let mut state = fixture.controller.state();
        for (served, frame) in served.iter().zip(&episode.frames[start..]) {
            assert_equal(served, &step(&fixture.controller, &mut state, frame)?);
        }
    }
    Ok(())
}

fn wire_state(frame: &RobotFrame) -> v1::RobotState {
    raw::state(&frame.joint_positions, &frame.orientation)
}

fn wire_frame(number: u64, frame: &RobotFrame) -> PolicyFrame {
    PolicyFrame {
        header: Some(raw::header(number)),
        state: Some(wire_state(frame)),
        goal: frame.goal.clone(),
        reset: frame.reset,
    }
}

#[tokio::test]
async fn a_single_call_with_the_history_answers_as_the_stream() -> anyhow::Result<()> {
    let fixture = fixture()?;
    let mut client = fixture.raw_client().await?;
    let episode = record(&fixture.controller)?;
    let heading = episode.frames[0].orientation.euler_angles().2 as f32;
    for now in [0, 5, 14, 15, FRAMES - 1] {
        let first = now.saturating_sub(14);
        let history = (first..=now).map(|t| PolicyObservation {
            state: Some(wire_state(&episode.frames[t])),
            goal: episode.frames[t].goal.clone(),
            last_action: match t.checked_sub(1) {
                Some(before) => episode.answers[before].action.clone(),
                None => Vec::new(),
            },
        });
        let request = StepPolicyRequest {
            robot: "emp27".to_owned(),
            history: history.collect(),
            start_heading: (first > 0).then_some(heading),
            ..StepPolicyRequest::default()
        };
        let response = within("an answer", client.step_policy(request)).await??;
        let result = response.into_inner().result.expect("a result");
        let expected = &episode.answers[now];
        assert_near(&result.action, &expected.action);
        assert_eq!(result.leg_targets.len(), expected.leg_targets.len());
        assert_eq!(result.executable_goal, expected.goal);
    }
    Ok(())
}

/// Frames with one thing wrong each, and the field that is.
fn bad_frames(good: &RobotFrame) -> Vec<(&'static str, PolicyFrame)> {
    let with = |change: &dyn Fn(&mut PolicyFrame)| {
        let mut frame = wire_frame(0, good);
        change(&mut frame);
        frame
    };
    let state = |change: &dyn Fn(&mut v1::RobotState)| {
        with(&|frame| change(frame.state.as_mut().expect("a state")))
    };
    vec![
        ("state", with(&|frame| frame.state = None)),
        (
            "state.joint_positions",
            state(&|state| {
                state.joint_positions.pop();
            }),
        ),
        (
            "state.joint_positions[3]",
            state(&|state| state.joint_positions[3] = f32::NAN),
        ),
        (
            "state.joint_positions[26]",
            state(&|state| state.joint_positions[26] = 4.0),
        ),
        (
            "state.base_orientation",
            state(&|state| state.base_orientation = None),
        ),
        (
            "state.base_orientation",
            state(&|state| state.base_orientation = Some(Quaternion::default())),
        ),
        (
            "state.base_orientation.y",
            state(&|state| {
                state.base_orientation.as_mut().expect("a quaternion").y = f32::INFINITY;
            }),
        ),
        ("goal", with(&|frame| frame.goal.clear())),
        ("goal[14]", with(&|frame| frame.goal[14] = f32::INFINITY)),
        ("goal[0]", with(&|frame| frame.goal[0] = -10.0)),
    ]
}

type PolicyStream = RawStream<StreamPolicyRequest, StreamPolicyResponse>;

async fn open(client: &MotionServiceClient<Channel>) -> anyhow::Result<PolicyStream> {
    RawStream::open(async |requests| client.clone().stream_policy(requests).await).await
}

async fn started(
    client: &MotionServiceClient<Channel>,
    delivery: Delivery,
) -> anyhow::Result<PolicyStream> {
    let mut stream = open(client).await?;
    let config = StreamPolicyConfig {
        delivery: delivery.into(),
        ..config("emp27")
    };
    stream.send(Request::Config(config)).await;
    let Ok(Some(Response::Started(started))) = stream.next().await? else {
        panic!("not started")
    };
    assert_eq!(started.history, 15);
    assert_eq!(started.goal_joint_names.len(), 15);
    assert_eq!(started.leg_joint_names.len(), 12);
    Ok(stream)
}

/// The result of the frame that was sent last.
async fn result(stream: &mut PolicyStream) -> anyhow::Result<PolicyResult> {
    match stream.next().await? {
        Ok(Some(Response::Result(answered))) => Ok(answered.result.expect("a result")),
        other => panic!("{other:?}"),
    }
}

fn config(robot: &str) -> StreamPolicyConfig {
    StreamPolicyConfig {
        robot: robot.to_owned(),
        ..StreamPolicyConfig::default()
    }
}

#[tokio::test]
async fn bad_frames_are_dropped_by_field_and_leave_no_trace() -> anyhow::Result<()> {
    let fixture = fixture()?;
    let client = fixture.raw_client().await?;
    let frames = record(&fixture.controller)?.frames;
    for delivery in [Delivery::All, Delivery::Latest] {
        let mut stream = started(&client, delivery).await?;
        let mut state = fixture.controller.state();
        for (frame, (field, bad)) in frames.iter().zip(bad_frames(&frames[0])) {
            stream.send(Request::Frame(bad)).await;
            let Ok(Some(Response::Dropped(dropped))) = stream.next().await? else {
                panic!("{field}: not dropped")
            };
            assert_eq!(
                (dropped.reason(), dropped.field.as_str()),
                (DropReason::Invalid, field)
            );
            stream.send(Request::Frame(wire_frame(7, frame))).await;
            let expected = step(&fixture.controller, &mut state, frame)?;
            assert_near(&result(&mut stream).await?.action, &expected.action);
        }
        // The `reset` of a bad frame holds for the frame after it.
        let bad = PolicyFrame {
            goal: Vec::new(),
            reset: true,
            ..wire_frame(0, &frames[0])
        };
        stream.send(Request::Frame(bad)).await;
        assert!(matches!(
            stream.next().await?,
            Ok(Some(Response::Dropped(_)))
        ));
        stream
            .send(Request::Frame(wire_frame(8, &frames[30])))
            .await;
        let anew = step(
            &fixture.controller,
            &mut fixture.controller.state(),
            &frames[30],
        )?;
        assert_near(&result(&mut stream).await?.action, &anew.action);
    }
    Ok(())
}

/// Sends bursts of which only the newest frames are computed, until a frame with `reset` was superseded, and compares
/// each answer with a history in which that `reset` held for the next frame that was computed.
#[tokio::test]
async fn the_reset_of_a_superseded_frame_holds() -> anyhow::Result<()> {
    let fixture = fixture()?;
    let client = fixture.raw_client().await?;
    let mut stream = started(&client, Delivery::Latest).await?;
    let mut state = fixture.controller.state();
    let mut frames = record(&fixture.controller)?.frames;
    for frame in frames.iter_mut().skip(10).step_by(7) {
        frame.reset = true;
    }
    let mut held = false;
    for _burst in 0..200 {
        for (number, frame) in (0..).zip(&frames) {
            stream.send(Request::Frame(wire_frame(number, frame))).await;
        }
        let mut superseded = 0;
        let mut results = Vec::new();
        while superseded + results.len() < FRAMES {
            match stream.next().await? {
                Ok(Some(Response::Result(answered))) => {
                    let number = answered.header.expect("a header").sequence_number;
                    results.push((number as usize, answered.result.expect("a result")));
                }
                Ok(Some(Response::Dropped(dropped))) => {
                    assert_eq!(dropped.reason(), DropReason::Superseded);
                    superseded += 1;
                }
                other => panic!("{other:?}"),
            }
        }
        let mut next = 0;
        for (number, result) in results {
            let skipped = frames[next..number].iter().any(|frame| frame.reset);
            held |= skipped;
            if skipped || frames[number].reset {
                state.reset();
            }
            let expected = step(&fixture.controller, &mut state, &frames[number])?;
            assert_near(&result.action, &expected.action);
            next = number + 1;
        }
        assert_eq!(next, FRAMES, "the newest frame is always answered");
        if held {
            return Ok(());
        }
    }
    panic!("no frame with `reset` was ever superseded")
}

#[tokio::test]
async fn bad_configs_end_the_stream_by_field() -> anyhow::Result<()> {
    let fixture = fixture()?;
    let client = fixture.raw_client().await?;
    let frame = || Request::Frame(wire_frame(0, &rest(fixture.controller.policy().robot())));
    let changed = |change: &dyn Fn(&mut StreamPolicyConfig)| {
        let mut config = config("emp27");
        change(&mut config);
        vec![Request::Config(config)]
    };
    let cases = [
        ("robot", vec![Request::Config(config("nobody"))]),
        (
            "model",
            changed(&|config| config.model = "emp27-retargeter".to_owned()),
        ),
        (
            "model_version",
            changed(&|config| config.model_version = "0".to_owned()),
        ),
        ("config.delivery", changed(&|config| config.delivery = 99)),
        ("config", vec![frame()]),
        (
            "config",
            vec![
                Request::Config(config("emp27")),
                Request::Config(config("emp27")),
            ],
        ),
    ];
    for (field, messages) in cases {
        let mut stream = open(&client).await?;
        for message in messages {
            stream.send(message).await;
        }
        let (before, status) = stream.failure().await?;
        assert!(
            before.iter().all(|m| matches!(m, Response::Started(_))),
            "{field}: {before:?}"
        );
        assert_eq!(wrong_field(&status), field);
    }
    Ok(())
}

#[tokio::test]
async fn single_calls_are_refused_by_field() -> anyhow::Result<()> {
    let fixture = fixture()?;
    let mut client = fixture.raw_client().await?;
    let good = rest(fixture.controller.policy().robot());
    let observation = |frame: &PolicyFrame| PolicyObservation {
        state: frame.state.clone(),
        goal: frame.goal.clone(),
        last_action: Vec::new(),
    };
    let request = |history: Vec<PolicyObservation>| StepPolicyRequest {
        robot: "emp27".to_owned(),
        history,
        ..StepPolicyRequest::default()
    };
    let one = observation(&wire_frame(0, &good));
    let mut cases = vec![
        ("history".to_owned(), request(Vec::new())),
        ("history".to_owned(), request(vec![one.clone(); 16])),
        (
            "history[0].last_action".to_owned(),
            request(vec![PolicyObservation {
                last_action: vec![0.0; 3],
                ..one.clone()
            }]),
        ),
        (
            "history[0].last_action[2]".to_owned(),
            request(vec![PolicyObservation {
                last_action: [vec![0.0; 2], vec![f32::NAN; 10]].concat(),
                ..one.clone()
            }]),
        ),
        (
            "start_heading".to_owned(),
            StepPolicyRequest {
                start_heading: Some(f32::NAN),
                ..request(vec![one.clone()])
            },
        ),
        (
            "robot".to_owned(),
            StepPolicyRequest {
                robot: "nobody".to_owned(),
                ..request(vec![one.clone()])
            },
        ),
    ];
    for (field, bad) in bad_frames(&good) {
        let history = vec![one.clone(), observation(&bad)];
        cases.push((format!("history[1].{field}"), request(history)));
    }
    for (field, request) in cases {
        let status = client.step_policy(request).await.expect_err(&field);
        assert_eq!(wrong_field(&status), field);
    }
    client.step_policy(request(vec![one])).await?;
    Ok(())
}

#[tokio::test]
async fn a_robot_without_a_policy_says_so() -> anyhow::Result<()> {
    let weights = policy::weights()?;
    std::fs::remove_file(policy::file(&weights))?;
    let server = TestServer::start_with(weights.path(), |_| {})?;
    let client = Client::connect(&server.url()).await?;
    let Err(error) = client.policy_stream(PolicyConfig::for_robot("emp27")).await else {
        panic!("a policy from nowhere")
    };
    assert_eq!(error.code(), Some(Code::InvalidArgument));
    assert!(error.to_string().contains("robot with a policy"), "{error}");
    assert!(
        client
            .models()
            .await?
            .iter()
            .all(|model| model.kind() == v1::ModelKind::Retargeter)
    );
    Ok(())
}

#[tokio::test]
async fn policies_are_listed_beside_retargeters() -> anyhow::Result<()> {
    let fixture = fixture()?;
    let client = fixture.client().await?;
    let model = client.model("emp27-policy").await?;
    assert_eq!(model.kind(), v1::ModelKind::Policy);
    assert_eq!(
        model.version,
        fixture.controller.policy().metadata().version()
    );
    let robot = emp27()?;
    let legs = robot.leg_joints().iter().map(|joint| &joint.name);
    assert!(legs.eq(&model.joint_names));
    let names: Vec<_> = client
        .models()
        .await?
        .into_iter()
        .map(|model| model.name)
        .filter(|name| name.starts_with("emp27"))
        .collect();
    assert_eq!(names, ["emp27-policy", "emp27-retargeter"]);
    Ok(())
}

#[tokio::test]
async fn a_lost_connection_starts_a_new_episode() -> anyhow::Result<()> {
    let fixture = fixture()?;
    let client = fixture.client().await?;
    let (mut sender, mut events) = client
        .policy_stream(PolicyConfig {
            delivery: Delivery::Latest,
            ..PolicyConfig::for_robot("emp27")
        })
        .await?;
    let frames = record(&fixture.controller)?.frames;
    sender.send(&frames[0], None).await?;
    assert!(matches!(
        within("an answer", events.next()).await??,
        Some(Event::Answer(_))
    ));
    let Fixture {
        server,
        controller,
        weights,
    } = fixture;
    let port = server.port();
    server.kill();
    let _server = TestServer::start_with_on(port, weights.path(), |_| {})?;
    loop {
        match within("the connection", events.next()).await?? {
            Some(Event::Reconnected { .. }) => break,
            Some(Event::ConnectionLost { .. }) => {}
            other => panic!("{other:?}"),
        }
    }
    sender.send(&frames[40], None).await?;
    let Some(Event::Answer(answer)) = within("an answer", events.next()).await?? else {
        panic!("unanswered")
    };
    assert_ne!(answer.sequence_number, 0);
    let anew = step(&controller, &mut controller.state(), &frames[40])?;
    assert_equal(&answer, &anew);
    Ok(())
}
