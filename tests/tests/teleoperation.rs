//! Teleoperation over the wire: every role, every guard, and robots that stand meanwhile.

use std::{
    process::{Command, Stdio},
    sync::{
        Arc,
        atomic::{AtomicU32, Ordering},
    },
    time::Duration,
};

use emp_client::{
    ChangeReason, Client, ClientError, ControlCommand, ControlRequest, EmpMode, Event, FrameSender,
    GoalPhase, GuardReport, OperatorInput, PoseSender, RampCause, SessionEvent, SessionEvents,
    SessionPresence, SessionState, StreamEvents, TeleoperatedFrame, TeleoperationAnswer,
    TeleoperationConfig, TeleoperationFrame,
};
use emp_motion::{KeyNodeFrame, key_nodes, skills};
use emp_proto::v1::{
    BothConfig, BothFrame, DropReason, FrameHeader, HumanPose, ObserveRequest, ObserverConfig,
    OperatorConfig, OperatorFrame, RobotConfig, RobotFrame, RobotState, TeleoperateConfig,
    TeleoperateRequest, TeleoperateResponse, observe_response, teleoperate_config::Role,
    teleoperate_request::Message as Request, teleoperate_response::Message as Response,
    teleoperation_service_client::TeleoperationServiceClient,
};
use emp_robot::Robot;
use emp_server::{Catalog, Settings};
use emp_sim::{Body, BodyParameters, Stage, Start, Targets};
use emp_tests::{
    TestServer, assert_near, emp, emp27, fake, policy,
    process::{ServerProcess, binaries},
    raw::{self, RawStream},
    within,
};
use nalgebra::UnitQuaternion;
use serde_json::Value;
use tempfile::TempDir;
use tonic::{Code, Status};

/// Control periods of a ramp of the test server.
const RAMP: usize = 10;
const PERIOD: Duration = Duration::from_millis(20);
const STALE: Duration = Duration::from_millis(500);
/// Rounding of angles, rad.
const TOLERANCE: f32 = 1e-5;

/// A server whose ramps are short, with a random policy and a random EMP.
fn server() -> anyhow::Result<(TestServer, TempDir)> {
    let weights = emp::weights(&emp::small(&*emp27()?, 3.0))?;
    let server = server_with(&weights)?;
    Ok((server, weights))
}

fn server_with(weights: &TempDir) -> anyhow::Result<TestServer> {
    TestServer::start_with(weights.path(), |settings| {
        settings.teleoperation.ramp_seconds = 0.2;
        settings.teleoperation.stale_after = STALE.as_secs_f64();
        settings.teleoperation.return_after = 2.0 * STALE.as_secs_f64();
    })
}

/// A session's config without smoothing, so that a goal can be predicted.
fn config(session: &str) -> TeleoperationConfig {
    TeleoperationConfig {
        refine: false,
        smoothing: false,
        ..TeleoperationConfig::new("emp27", session)
    }
}

/// A robot that stands still, its goal joints `offset` off their default, rad.
fn still(robot: &Robot, offset: f32) -> TeleoperationFrame {
    let mut joint_positions: Vec<f32> = robot.joints().map(|joint| joint.default as f32).collect();
    for angle in &mut joint_positions[..robot.goal_joints().len()] {
        *angle += offset;
    }
    TeleoperationFrame {
        operator: None,
        joint_positions,
        orientation: UnitQuaternion::identity(),
        measured: None,
        reset: false,
    }
}

/// The same with a person's pose.
fn with_pose(frame: &TeleoperationFrame, pose: &KeyNodeFrame) -> TeleoperationFrame {
    TeleoperationFrame {
        operator: Some(OperatorInput::pose(pose)),
        ..frame.clone()
    }
}

fn measured(frame: &TeleoperationFrame) -> Vec<f32> {
    frame.joint_positions[..15].to_vec()
}

/// A person with one arm at an angle, −0.5 to 0.5.
fn pose(angle: f32) -> KeyNodeFrame {
    fake::pose(angle)
}

/// A tremor, as every person and every sensor has one: it is never the same twice in a row.
fn tremor() -> f32 {
    static COUNT: AtomicU32 = AtomicU32::new(0);
    1e-5 * (COUNT.fetch_add(1, Ordering::Relaxed) % 2) as f32
}

/// The end of a session with the robot.
struct RobotEnd {
    sender: FrameSender<TeleoperationFrame>,
    events: StreamEvents<TeleoperationAnswer>,
    /// A simulated robot's clock.
    clock: Option<Duration>,
}

impl RobotEnd {
    async fn join(client: &Client, session: &str) -> anyhow::Result<Self> {
        let (sender, events) = client.join_as_robot(config(session)).await?;
        Ok(Self {
            sender,
            events,
            clock: None,
        })
    }

    /// Both ends, with a robot that is simulated in step with the answers.
    async fn both(client: &Client, config: TeleoperationConfig) -> anyhow::Result<Self> {
        let config = TeleoperationConfig {
            simulated: true,
            ..config
        };
        let (sender, events) = client.teleoperate(config).await?;
        Ok(Self {
            sender,
            events,
            clock: Some(Duration::ZERO),
        })
    }

    async fn step(&mut self, frame: &TeleoperationFrame) -> anyhow::Result<TeleoperatedFrame> {
        let mut frame = frame.clone();
        frame.orientation *= UnitQuaternion::from_euler_angles(0.0, 0.0, f64::from(tremor()));
        if let Some(clock) = &mut self.clock {
            *clock += PERIOD;
            frame.measured = Some(*clock);
        }
        let number = self.sender.send(&frame, None).await?;
        match within("an answer", self.events.next()).await?? {
            Some(Event::Answer(answer)) => {
                assert_eq!(answer.sequence_number, number);
                Ok(answer.result)
            }
            other => panic!("{other:?}"),
        }
    }

    /// Steps until the guard is in this phase.
    async fn until(
        &mut self,
        frame: &TeleoperationFrame,
        phase: GoalPhase,
    ) -> anyhow::Result<TeleoperatedFrame> {
        for _ in 0..1_000 {
            let result = self.step(frame).await?;
            if guard(&result).phase() == phase {
                return Ok(result);
            }
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
        panic!("never {phase:?}")
    }
}

fn guard(result: &TeleoperatedFrame) -> GuardReport {
    result.guard.clone().expect("a guard's report")
}

fn executed(result: &TeleoperatedFrame) -> &[f32] {
    &result
        .filter
        .as_ref()
        .expect("a filter's result")
        .executable_goal
}

/// The next event of a listener that is about this.
async fn next<T>(
    events: &mut SessionEvents,
    mut wanted: impl FnMut(SessionEvent) -> Option<T>,
) -> anyhow::Result<T> {
    loop {
        let event = within("an event", events.next()).await??.expect("an event");
        if let Some(found) = wanted(event) {
            return Ok(found);
        }
    }
}

async fn next_executed(events: &mut SessionEvents) -> anyhow::Result<TeleoperatedFrame> {
    next(events, |event| match event {
        SessionEvent::Executed(result) => Some(*result),
        _ => None,
    })
    .await
}

async fn next_presence(events: &mut SessionEvents) -> anyhow::Result<SessionPresence> {
    next(events, |event| match event {
        SessionEvent::Presence(presence) => Some(presence),
        _ => None,
    })
    .await
}

async fn send(operator: &mut PoseSender, angle: f32) -> anyhow::Result<()> {
    operator.send(&pose(angle + tremor())).await?;
    Ok(())
}

/// Sends a pose until the robot's answer has one that is fresh.
async fn arrive(
    operator: &mut PoseSender,
    end: &mut RobotEnd,
    frame: &TeleoperationFrame,
    angle: f32,
) -> anyhow::Result<TeleoperatedFrame> {
    send(operator, angle).await?;
    for _ in 0..1_000 {
        let result = end.step(frame).await?;
        let phase = guard(&result).phase();
        if matches!(phase, GoalPhase::Ramping | GoalPhase::Following) {
            return Ok(result);
        }
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
    panic!("the pose never arrived")
}

/// Sends a pose with every step until it is followed.
async fn follow(
    operator: &mut PoseSender,
    end: &mut RobotEnd,
    frame: &TeleoperationFrame,
    angle: f32,
) -> anyhow::Result<TeleoperatedFrame> {
    for _ in 0..1_000 {
        send(operator, angle).await?;
        let result = end.step(frame).await?;
        if guard(&result).phase() == GoalPhase::Following {
            return Ok(result);
        }
    }
    panic!("the pose was never followed")
}

#[tokio::test]
async fn one_client_with_both_ends_gets_the_whole_path() -> anyhow::Result<()> {
    let (server, _weights) = server()?;
    let robot = emp27()?;
    let client = Client::connect(&server.url()).await?;
    let mut end = RobotEnd::both(&client, config("")).await?;
    assert_eq!(end.events.joint_names().len(), 27);
    assert_eq!(end.events.model().0, "emp27-policy");
    let frame = with_pose(&still(&robot, 0.05), &pose(0.4));
    let retargeted = client.retarget("emp27", &pose(0.4), false).await?;
    let first = end.step(&frame).await?;
    assert_near(&first.goal, &measured(&frame), TOLERANCE);
    assert_near(executed(&first), &measured(&frame), TOLERANCE);
    assert_eq!(first.state(), SessionState::Active);
    assert_eq!(guard(&first).phase(), GoalPhase::Ramping);
    assert_eq!(guard(&first).cause(), RampCause::FirstFrame);
    assert_eq!(first.emp_mode(), EmpMode::On);
    let (mut last, mut periods) = (first, 1);
    while guard(&last).phase() != GoalPhase::Following {
        let result = end.step(&frame).await?;
        for (index, joint) in robot.goal_joints().iter().enumerate() {
            let step = (executed(&result)[index] - executed(&last)[index]).abs();
            let largest = (joint.velocity_limit / robot.control_rate_hz()) as f32;
            assert!(step <= largest + TOLERANCE, "{}: {step}", joint.name);
        }
        last = result;
        periods += 1;
    }
    assert!(periods > RAMP);
    assert_near(&last.goal, &retargeted.joint_angles, 1e-4);
    let filter = last.filter.expect("a filter's result");
    let change: Vec<f32> = last
        .goal
        .iter()
        .zip(&filter.executable_goal)
        .map(|(g, e)| e - g)
        .collect();
    assert_near(&filter.change, &change, TOLERANCE);
    assert!(filter.regloss.is_some() && filter.applied == 1.0);
    assert_eq!(filter.nearest_links.len(), 2);
    assert_eq!((last.action.len(), last.leg_targets.len()), (12, 12));
    let pose = last.pose.expect("a pose's report");
    assert_near(&pose.goal, &last.goal, TOLERANCE);
    assert_eq!(pose.header, last.header);
    assert!(pose.timing.is_some() && pose.dropped.is_none());
    assert!(last.timing.is_some() && last.total_time.is_some());
    let frame = still(&robot, 0.05);
    let without = end.step(&frame).await?;
    assert!(
        without.pose.is_some_and(|pose| pose.timing.is_none()),
        "no new pose"
    );
    drop(end.sender);
    assert_eq!(within("the end", end.events.next()).await??, None);
    Ok(())
}

#[tokio::test]
async fn an_operator_comes_leaves_and_comes_back() -> anyhow::Result<()> {
    let (server, _weights) = server()?;
    let robot = emp27()?;
    let client = Client::connect(&server.url()).await?;
    let frame = still(&robot, 0.1);
    let mut end = RobotEnd::join(&client, "lab").await?;
    let alone = end.step(&frame).await?;
    assert_eq!(guard(&alone).phase(), GoalPhase::Holding);
    assert_near(&alone.goal, &measured(&frame), TOLERANCE);
    assert!(alone.pose.is_none());

    let (mut operator, mut events) = client.operate(config("lab")).await?;
    let presence = events.started().presence.expect("who is there");
    assert!(presence.robot && presence.operator);
    let result = arrive(&mut operator, &mut end, &frame, 0.4).await?;
    assert_near(&result.goal, &measured(&frame), TOLERANCE);
    let told = next(&mut events, |event| match event {
        SessionEvent::Executed(told) if told.header == result.header => Some(*told),
        _ => None,
    })
    .await?;
    assert_eq!(told, result, "the operator is told what the robot executes");
    let following = follow(&mut operator, &mut end, &frame, 0.4).await?;
    assert_ne!(following.goal, measured(&frame));

    drop((operator, events));
    let held = end.until(&frame, GoalPhase::Holding).await?;
    assert_near(&held.goal, &following.goal, TOLERANCE);
    let returning = end.until(&frame, GoalPhase::Returning).await?;
    assert_near(&returning.goal, &following.goal, TOLERANCE);
    let resting = end.until(&frame, GoalPhase::Resting).await?;
    assert_near(&resting.goal, &measured(&still(&robot, 0.0)), TOLERANCE);
    let age = resting.pose.and_then(|pose| pose.age).expect("an age");
    assert!(Duration::try_from(age)? > 2 * STALE);

    let (mut operator, _events) = client.operate(config("lab")).await?;
    let back = arrive(&mut operator, &mut end, &frame, -0.4).await?;
    assert_eq!(guard(&back).cause(), RampCause::OperatorReturned);
    assert_near(&back.goal, &resting.goal, TOLERANCE);
    Ok(())
}

#[tokio::test]
async fn a_session_waits_for_a_robot_that_left() -> anyhow::Result<()> {
    let (server, _weights) = server()?;
    let robot = emp27()?;
    let client = Client::connect(&server.url()).await?;
    let (mut operator, mut events) = client.operate(config("lab")).await?;
    assert!(
        events
            .started()
            .presence
            .is_some_and(|presence| !presence.robot)
    );
    for offset in [0.1, 0.2] {
        let mut end = RobotEnd::join(&client, "lab").await?;
        assert!(next_presence(&mut events).await?.robot);
        let frame = still(&robot, offset);
        let first = arrive(&mut operator, &mut end, &frame, 0.4).await?;
        assert_eq!(guard(&first).cause(), RampCause::FirstFrame);
        assert_near(&first.goal, &measured(&frame), TOLERANCE);
        drop(end);
        assert!(!next_presence(&mut events).await?.robot);
    }
    Ok(())
}

#[tokio::test]
async fn a_session_has_one_robot_and_one_operator() -> anyhow::Result<()> {
    let (server, _weights) = server()?;
    let client = Client::connect(&server.url()).await?;
    let _robot = RobotEnd::join(&client, "lab").await?;
    let _operator = client.operate(config("lab")).await?;
    let refused = |error: ClientError| {
        assert_eq!(error.code(), Some(Code::AlreadyExists), "{error}");
        assert_eq!(error.reason().as_deref(), Some("SEAT_TAKEN"));
    };
    refused(
        client
            .join_as_robot(config("lab"))
            .await
            .expect_err("a robot"),
    );
    refused(
        client
            .operate(config("lab"))
            .await
            .expect_err("an operator"),
    );
    refused(client.teleoperate(config("lab")).await.expect_err("both"));
    let _another_session = RobotEnd::join(&client, "hall").await?;
    Ok(())
}

#[tokio::test]
async fn observers_are_told_what_the_robot_executes() -> anyhow::Result<()> {
    let (server, _weights) = server()?;
    let robot = emp27()?;
    let client = Client::connect(&server.url()).await?;
    let mut observers = [
        client.observe(config("lab")).await?,
        client.observe(config("lab")).await?,
    ];
    let mut end = RobotEnd::both(&client, config("lab")).await?;
    let frame = with_pose(&still(&robot, 0.0), &pose(0.3));
    let mut results = Vec::new();
    for _ in 0..5 {
        results.push(end.step(&frame).await?);
    }
    for observer in &mut observers {
        for result in &results {
            assert_eq!(&next_executed(observer).await?, result);
        }
    }
    drop(end);
    let presence = next_presence(&mut observers[0]).await?;
    assert_eq!(
        (presence.robot, presence.operator, presence.observers),
        (false, false, 2)
    );
    Ok(())
}

#[tokio::test]
async fn sixteen_sessions_at_once_keep_apart() -> anyhow::Result<()> {
    let (server, _weights) = server()?;
    let robot = emp27()?;
    let sessions = (0..16).map(|number| {
        let (url, robot) = (server.url(), Arc::clone(&robot));
        tokio::spawn(async move {
            let client = Client::connect(&url).await?;
            let session = format!("session {number}");
            let mut end = RobotEnd::join(&client, &session).await?;
            let (mut operator, mut events) = client.operate(config(&session)).await?;
            let angle = 0.05 * number as f32 - 0.4;
            let frame = still(&robot, 0.0);
            let result = follow(&mut operator, &mut end, &frame, angle).await?;
            let expected = client.retarget("emp27", &pose(angle), false).await?;
            assert_near(&result.goal, &expected.joint_angles, 1e-4);
            next(&mut events, |event| match event {
                SessionEvent::Executed(told) => (told.header == result.header).then_some(()),
                _ => None,
            })
            .await
        })
    });
    for session in sessions.collect::<Vec<_>>() {
        session.await??;
    }
    Ok(())
}

#[tokio::test]
async fn a_robot_that_was_silent_is_ramped_from_its_measured_pose() -> anyhow::Result<()> {
    let (server, _weights) = server()?;
    let robot = emp27()?;
    let client = Client::connect(&server.url()).await?;
    let mut end = RobotEnd::join(&client, "lab").await?;
    let (mut operator, _events) = client.operate(config("lab")).await?;
    let frame = still(&robot, 0.0);
    follow(&mut operator, &mut end, &frame, 0.4).await?;
    tokio::time::sleep(STALE + Duration::from_millis(100)).await;
    let mut frame = still(&robot, 0.2);
    let resumed = arrive(&mut operator, &mut end, &frame, 0.4).await?;
    assert_eq!(guard(&resumed).cause(), RampCause::RobotResumed);
    assert_near(executed(&resumed), &measured(&frame), TOLERANCE);
    follow(&mut operator, &mut end, &frame, 0.4).await?;
    frame.reset = true;
    let reset = end.step(&frame).await?;
    assert_eq!(guard(&reset).cause(), RampCause::FirstFrame);
    assert_near(executed(&reset), &measured(&frame), TOLERANCE);
    Ok(())
}

#[tokio::test]
async fn a_switch_of_the_emps_mode_is_blended() -> anyhow::Result<()> {
    let (server, _weights) = server()?;
    let robot = emp27()?;
    let client = Client::connect(&server.url()).await?;
    let off = TeleoperationConfig {
        emp_mode: Some(EmpMode::Off),
        ..config("lab")
    };
    let mut end = RobotEnd::join(&client, "lab").await?;
    let (mut operator, _events) = client.operate(off).await?;
    let frame = still(&robot, 0.0);
    let mut last = follow(&mut operator, &mut end, &frame, 0.3).await?;
    assert_eq!(last.emp_mode(), EmpMode::Off);
    assert_near(executed(&last), &last.goal, TOLERANCE);
    // The operator switches it on, a controller off again.
    let switch = OperatorInput {
        emp_mode: Some(EmpMode::On),
        ..OperatorInput::pose(&pose(0.3 + tremor()))
    };
    operator.send_input(&switch).await?;
    while last.emp_mode() != EmpMode::On {
        send(&mut operator, 0.3).await?;
        let result = end.step(&frame).await?;
        if result.emp_mode() == EmpMode::On {
            assert_near(executed(&result), executed(&last), 1e-3);
            assert_eq!(guard(&result).emp_progress, Some(0.0));
        }
        last = result;
    }
    let mut periods = 1;
    while guard(&last).emp_progress.is_some() {
        send(&mut operator, 0.3).await?;
        last = end.step(&frame).await?;
        periods += 1;
    }
    assert!(periods >= RAMP / 2, "{periods}");
    let corrected = last.filter.clone().expect("a filter's result");
    assert!(corrected.change.iter().any(|change| change.abs() > 0.01));
    let off = ControlRequest {
        session: "lab".to_owned(),
        emp_mode: Some(EmpMode::Off.into()),
        ..ControlRequest::default()
    };
    client.control(off).await?;
    send(&mut operator, 0.3).await?;
    let result = end.step(&frame).await?;
    assert_eq!(result.emp_mode(), EmpMode::Off);
    assert_eq!(guard(&result).emp_progress, Some(0.0));
    assert_near(executed(&result), &corrected.executable_goal, 0.02);
    Ok(())
}

#[tokio::test]
async fn a_jump_of_the_pose_is_limited_in_speed() -> anyhow::Result<()> {
    let (server, _weights) = server()?;
    let robot = emp27()?;
    let client = Client::connect(&server.url()).await?;
    let off = TeleoperationConfig {
        emp_mode: Some(EmpMode::Off),
        ..config("")
    };
    let mut end = RobotEnd::both(&client, off).await?;
    let frame = still(&robot, 0.0);
    let before = end
        .until(&with_pose(&frame, &pose(-0.5)), GoalPhase::Following)
        .await?;
    let jump = end.step(&with_pose(&frame, &pose(0.5))).await?;
    assert_eq!(guard(&jump).phase(), GoalPhase::Following);
    let limited = guard(&jump).speed_limited_joints;
    assert!(!limited.is_empty());
    let filter = jump.filter.clone().expect("a filter's result");
    assert!(filter.reasons().any(|reason| reason == ChangeReason::Speed));
    for (index, joint) in robot.goal_joints().iter().enumerate() {
        let step = (executed(&jump)[index] - executed(&before)[index]).abs();
        let largest = (joint.velocity_limit / robot.control_rate_hz()) as f32;
        assert!(step <= largest + TOLERANCE);
        assert_eq!(
            limited.contains(&(index as u32)),
            executed(&jump)[index] != jump.goal[index]
        );
    }
    Ok(())
}

type RawSession = RawStream<TeleoperateRequest, TeleoperateResponse>;

/// Joins a session as any gRPC client would.
async fn open(server: &TestServer, config: TeleoperateConfig) -> anyhow::Result<RawSession> {
    let mut client = raw_client(server).await?;
    let stream = RawStream::open(async |requests| client.teleoperate(requests).await).await?;
    stream.send(Request::Config(config)).await;
    Ok(stream)
}

async fn raw_client(
    server: &TestServer,
) -> anyhow::Result<TeleoperationServiceClient<tonic::transport::Channel>> {
    Ok(TeleoperationServiceClient::connect(server.url()).await?)
}

/// [`open`] for a config that is accepted.
async fn started(server: &TestServer, config: TeleoperateConfig) -> anyhow::Result<RawSession> {
    let mut stream = open(server, config).await?;
    let first = stream.next().await?;
    assert!(matches!(first, Ok(Some(Response::Started(_)))), "{first:?}");
    Ok(stream)
}

/// The next message that does not tell who came or went, which may come at any time.
async fn next_but_presence(
    stream: &mut RawSession,
) -> anyhow::Result<Result<Option<Response>, Status>> {
    loop {
        let message = stream.next().await?;
        if !matches!(message, Ok(Some(Response::Presence(_)))) {
            return Ok(message);
        }
    }
}

fn raw_config(session: &str, role: Role) -> TeleoperateConfig {
    TeleoperateConfig {
        session: session.to_owned(),
        robot: "emp27".to_owned(),
        role: Some(role),
        ..TeleoperateConfig::default()
    }
}

fn robot_role() -> Role {
    Role::RobotEnd(RobotConfig::default())
}

fn operator_role() -> Role {
    Role::Operator(OperatorConfig::default())
}

fn observer_role() -> Role {
    Role::Observer(ObserverConfig {})
}

fn raw_state(frame: &TeleoperationFrame) -> RobotState {
    raw::state(&frame.joint_positions, &frame.orientation)
}

fn robot_frame(number: u64, state: Option<RobotState>) -> Request {
    Request::Robot(RobotFrame {
        header: Some(raw::header(number)),
        state,
        reset: false,
    })
}

fn operator_frame(number: u64, pose: Option<HumanPose>) -> Request {
    Request::Operator(OperatorFrame {
        header: Some(raw::header(number)),
        pose,
        ..OperatorFrame::default()
    })
}

#[tokio::test]
async fn a_bad_config_is_refused_by_name() -> anyhow::Result<()> {
    let weights = policy::weights()?;
    let server = server_with(&weights)?;
    type Change = fn(&mut TeleoperateConfig);
    let bad: [(&str, Change); 7] = [
        ("config.role", |config| config.role = None),
        ("config.session", |config| config.session.clear()),
        ("config.session", |config| config.session = "x".repeat(65)),
        ("config.emp_mode", |config| config.emp_mode = Some(9)),
        ("config.emp_mode", |config| {
            config.emp_mode = Some(EmpMode::On.into());
        }),
        ("robot", |config| config.robot = "nobody".to_owned()),
        ("model", |config| {
            config.role = Some(Role::Operator(OperatorConfig {
                retargeter: "nothing".to_owned(),
                ..OperatorConfig::default()
            }));
        }),
    ];
    for (field, change) in bad {
        let mut config = raw_config("lab", robot_role());
        change(&mut config);
        let mut stream = open(&server, config).await?;
        let status = stream.next().await?.expect_err("refused");
        assert_eq!(status.code(), Code::InvalidArgument, "{status:?}");
        assert!(status.message().starts_with(field), "{field}: {status:?}");
    }
    Ok(())
}

#[tokio::test]
async fn a_bad_frame_is_named_and_the_stream_lives_on() -> anyhow::Result<()> {
    let weights = policy::weights()?;
    let server = server_with(&weights)?;
    let good = still(&*emp27()?, 0.0);
    let person = || Some(raw::pose(&pose(0.3)));
    let with_state = |change: &dyn Fn(&mut RobotState)| {
        let mut state = raw_state(&good);
        change(&mut state);
        robot_frame(7, Some(state))
    };
    let broken_pose = || {
        let mut pose = raw::pose(&pose(0.3));
        pose.left_elbow.as_mut().expect("an elbow").x = f32::NAN;
        Some(pose)
    };
    let head_and_hands = || {
        let whole = raw::pose(&pose(0.3));
        Some(HumanPose {
            head: whole.torso,
            left_wrist: whole.left_wrist,
            right_wrist: whole.right_wrist,
            ..HumanPose::default()
        })
    };
    let robots = vec![
        ("state", robot_frame(7, None)),
        ("operator", operator_frame(7, person())),
        (
            "state.joint_positions",
            with_state(&|state| state.joint_positions.truncate(26)),
        ),
        (
            "state.joint_positions[2]",
            with_state(&|state| state.joint_positions[2] = f32::NAN),
        ),
        (
            "state.joint_velocities",
            with_state(&|state| state.joint_velocities = vec![0.0; 3]),
        ),
        (
            "state.joint_velocities[26]",
            with_state(&|state| {
                state.joint_velocities = vec![0.0; 27];
                state.joint_velocities[26] = 1e9;
            }),
        ),
        (
            "state.measurement_time",
            with_state(&|state| {
                let (seconds, nanos) = (i64::MIN, 0);
                state.measurement_time = Some(prost_types::Duration { seconds, nanos });
            }),
        ),
        (
            "state.base_orientation",
            with_state(&|state| state.base_orientation = None),
        ),
    ];
    let operators = vec![
        ("pose", operator_frame(7, None)),
        ("robot", robot_frame(7, Some(raw_state(&good)))),
        ("pose.left_elbow.x", operator_frame(7, broken_pose())),
        ("pose.waist", operator_frame(7, head_and_hands())),
        (
            "emp_mode",
            Request::Operator(OperatorFrame {
                header: Some(raw::header(7)),
                pose: person(),
                emp_mode: Some(EmpMode::On.into()),
                ..OperatorFrame::default()
            }),
        ),
    ];
    let observers = vec![("operator", operator_frame(7, person()))];
    for (role, frames) in [
        (robot_role(), robots),
        (operator_role(), operators),
        (observer_role(), observers),
    ] {
        let mut stream = started(&server, raw_config("lab", role.clone())).await?;
        for (field, frame) in frames {
            stream.send(frame).await;
            let answer = next_but_presence(&mut stream).await?;
            let Ok(Some(Response::Dropped(dropped))) = answer else {
                panic!("{role:?}: {field} is not refused but {answer:?}")
            };
            assert_eq!(
                (dropped.reason(), dropped.field.as_str()),
                (DropReason::Invalid, field)
            );
            assert_eq!(dropped.header.unwrap_or_default().sequence_number, 7);
        }
        if matches!(role, Role::RobotEnd(_)) {
            stream.send(robot_frame(99, Some(raw_state(&good)))).await;
            let answer = next_but_presence(&mut stream).await?;
            assert!(
                matches!(answer, Ok(Some(Response::Result(_)))),
                "{answer:?}"
            );
        }
    }
    // Of a client with both ends, a bad pose does not keep the robot from its answer.
    let config = raw_config("", Role::Both(BothConfig::default()));
    let mut stream = started(&server, config).await?;
    let both = |number, pose| {
        Request::Both(BothFrame {
            robot: Some(RobotFrame {
                header: Some(raw::header(number)),
                state: Some(raw_state(&good)),
                reset: false,
            }),
            operator: Some(OperatorFrame {
                pose,
                ..OperatorFrame::default()
            }),
        })
    };
    stream.send(both(0, broken_pose())).await;
    let Ok(Some(Response::Result(result))) = stream.next().await? else {
        panic!("no answer")
    };
    let dropped = result.pose.expect("a report").dropped.expect("a notice");
    assert_eq!(dropped.field, "operator.pose.left_elbow.x");
    Ok(())
}

#[tokio::test]
async fn a_pose_that_cannot_be_retargeted_in_time_is_not_used() -> anyhow::Result<()> {
    let weights = policy::weights()?;
    let server = server_with(&weights)?;
    let client = Client::connect(&server.url()).await?;
    let mut end = RobotEnd::join(&client, "lab").await?;
    let operator = started(&server, raw_config("lab", operator_role())).await?;
    operator
        .send(Request::Operator(OperatorFrame {
            header: Some(FrameHeader {
                time_budget: Some(prost_types::Duration::default()),
                ..raw::header(7)
            }),
            pose: Some(raw::pose(&pose(0.3))),
            ..OperatorFrame::default()
        }))
        .await;
    let frame = still(&*emp27()?, 0.0);
    loop {
        let result = end.step(&frame).await?;
        let Some(pose) = result.pose else {
            tokio::time::sleep(Duration::from_millis(2)).await;
            continue;
        };
        let dropped = pose.dropped.expect("it was too late");
        assert_eq!(dropped.reason(), DropReason::DeadlineExceeded);
        assert_eq!(dropped.header.unwrap_or_default().sequence_number, 7);
        assert!(pose.goal.is_empty());
        assert_eq!(
            result.leg_targets.len(),
            12,
            "the robot is told what to do all the same"
        );
        return Ok(());
    }
}

#[tokio::test]
async fn every_frame_of_a_robot_is_answered_or_superseded_and_gaps_are_counted()
-> anyhow::Result<()> {
    let (server, _weights) = server()?;
    let frame = still(&*emp27()?, 0.0);
    let mut stream = started(&server, raw_config("lab", robot_role())).await?;
    let numbers: Vec<u64> = (0..40).filter(|number| number % 8 != 5).collect();
    for &number in &numbers {
        stream
            .send(robot_frame(number, Some(raw_state(&frame))))
            .await;
    }
    stream.finish();
    let (mut seen, mut last) = (Vec::new(), None);
    while let Some(message) = stream.next().await?? {
        let header = match message {
            Response::Result(result) => {
                let header = result.header;
                last = Some(result);
                header
            }
            Response::Dropped(dropped) => {
                assert_eq!(dropped.reason(), DropReason::Superseded);
                dropped.header
            }
            other => panic!("{other:?}"),
        };
        seen.push(header.unwrap_or_default().sequence_number);
    }
    let last = last.expect("an answer");
    let number = last.header.unwrap_or_default().sequence_number;
    assert_eq!(number, 39, "the newest is computed");
    assert_eq!(last.robot_frames_lost, 5);
    seen.sort_unstable();
    assert_eq!(seen, numbers);
    Ok(())
}

#[tokio::test]
async fn an_observer_who_half_closed_still_hears() -> anyhow::Result<()> {
    let (server, _weights) = server()?;
    let mut observer = started(&server, raw_config("lab", observer_role())).await?;
    observer.finish();
    // And so does one who cannot stream both ways.
    let request = ObserveRequest {
        session: "lab".to_owned(),
        robot: String::new(),
    };
    let mut raw = raw_client(&server).await?;
    let mut listener = raw.observe(request).await?.into_inner();
    let first = within("a start", listener.message())
        .await??
        .expect("a start");
    assert!(matches!(
        first.message,
        Some(observe_response::Message::Started(_))
    ));
    let client = Client::connect(&server.url()).await?;
    let mut end = RobotEnd::join(&client, "lab").await?;
    let result = end.step(&still(&*emp27()?, 0.0)).await?;
    let told = loop {
        match observer.next().await? {
            Ok(Some(Response::Result(told))) => break told,
            Ok(Some(Response::Presence(_))) => {}
            other => panic!("{other:?}"),
        }
    };
    assert_eq!(told, result);
    let told = loop {
        let message = within("a message", listener.message()).await??;
        match message.expect("a message").message {
            Some(observe_response::Message::Result(told)) => break told,
            Some(observe_response::Message::Presence(_)) => {}
            other => panic!("{other:?}"),
        }
    };
    assert_eq!(told, result);
    let request = ObserveRequest {
        session: "nowhere".to_owned(),
        robot: String::new(),
    };
    let mut listener = raw.observe(request).await?.into_inner();
    let status = within("an end", listener.message())
        .await?
        .expect_err("none");
    assert_eq!(status.code(), Code::NotFound, "{status:?}");
    Ok(())
}

#[tokio::test]
async fn a_server_that_drains_serves_its_robots_through_the_grace_time() -> anyhow::Result<()> {
    let weights = emp::weights(&emp::small(&*emp27()?, 3.0))?;
    let server = TestServer::start_with(weights.path(), |settings| {
        settings.shutdown.grace_seconds = 2.0;
    })?;
    let frame = still(&*emp27()?, 0.0);
    let mut streams = Vec::new();
    for role in [robot_role(), operator_role(), observer_role()] {
        streams.push(started(&server, raw_config("lab", role)).await?);
    }
    server.begin_shutdown();
    let mut robot = streams.remove(0);
    let Ok(Some(Response::GoingAway(notice))) = next_but_presence(&mut robot).await? else {
        panic!("not told")
    };
    assert_eq!(notice.grace.expect("a time").seconds, 2);
    for number in 0..20 {
        robot
            .send(robot_frame(number, Some(raw_state(&frame))))
            .await;
        let answer = next_but_presence(&mut robot).await?;
        assert!(
            matches!(answer, Ok(Some(Response::Result(_)))),
            "{answer:?}"
        );
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    streams.push(robot);
    for stream in &mut streams {
        let (_, status) = stream.failure().await?;
        assert_eq!(status.code(), Code::Unavailable, "{status:?}");
        let details = tonic_types::StatusExt::get_error_details(&status);
        assert!(
            details.retry_info().is_none(),
            "another may be there at once"
        );
    }
    drop(streams);
    assert_eq!(server.ended().await?, emp_server::Drain::Complete);
    Ok(())
}

#[tokio::test]
async fn states_that_queued_behind_a_stall_move_no_joint_further_than_the_time_allows()
-> anyhow::Result<()> {
    let (server, _weights) = server()?;
    let robot = emp27()?;
    let client = Client::connect(&server.url()).await?;
    let config = TeleoperateConfig {
        emp_mode: Some(EmpMode::Off.into()),
        ..raw_config("lab", robot_role())
    };
    let mut stream = started(&server, config).await?;
    let (mut operator, _events) = client.operate(self::config("lab")).await?;
    let mut number = 0;
    let mut state = |robot: &Robot| {
        let frame = still(robot, 0.0);
        let mut state = raw_state(&frame);
        number += 1;
        let measured = PERIOD * u32::try_from(number).expect("a small number");
        state.measurement_time = measured.try_into().ok();
        state.joint_positions[0] += tremor();
        robot_frame(number, Some(state))
    };
    async fn answer(stream: &mut RawSession) -> anyhow::Result<TeleoperatedFrame> {
        loop {
            match next_but_presence(stream).await? {
                Ok(Some(Response::Result(result))) => return Ok(result),
                Ok(Some(Response::Dropped(_))) => {}
                other => panic!("{other:?}"),
            }
        }
    }
    // Followed at one pose, and then the person jumps to another.
    let mut last = None;
    for _ in 0..100 {
        send(&mut operator, -0.5).await?;
        stream.send(state(&robot)).await;
        let result = answer(&mut stream).await?;
        let phase = guard(&result).phase();
        last = Some(result);
        if phase == GoalPhase::Following {
            break;
        }
        tokio::time::sleep(PERIOD).await;
    }
    let before = last.expect("an answer");
    assert_eq!(guard(&before).phase(), GoalPhase::Following);
    tokio::time::sleep(Duration::from_millis(250)).await;
    send(&mut operator, 0.5).await?;
    tokio::time::sleep(Duration::from_millis(50)).await;
    send(&mut operator, 0.5).await?;
    for _ in 0..12 {
        stream.send(state(&robot)).await;
    }
    let mut after = answer(&mut stream).await?;
    while after.header.unwrap_or_default().sequence_number < number {
        after = answer(&mut stream).await?;
    }
    let mut moved = false;
    for (index, joint) in robot.goal_joints().iter().enumerate() {
        let way = (executed(&after)[index] - executed(&before)[index]).abs();
        // Two control periods, and the few milliseconds in which the twelve are answered.
        let allowed = joint.velocity_limit as f32 * 0.08;
        assert!(
            way <= allowed,
            "{}: {way} rad, allowed {allowed}",
            joint.name
        );
        moved |= way > 0.0;
    }
    assert!(moved);
    Ok(())
}

#[tokio::test]
async fn legs_never_wait_for_the_arms() -> anyhow::Result<()> {
    let weights = emp::weights(&emp::small(&*emp27()?, 3.0))?;
    let settings = Settings {
        weights: Some(weights.path().to_owned()),
        robots: Some(emp_tests::root().join("robots")),
        ..Settings::default()
    };
    let robot = emp27()?;
    let gate = fake::Gate::closed();
    let mut catalog = Catalog::load(&settings)?;
    fake::add(&mut catalog, &settings, &robot, &gate)?;
    let server = TestServer::start(settings, catalog)?;
    let client = Client::connect(&server.url()).await?;
    let mut end = RobotEnd::join(&client, "lab").await?;
    let slow = TeleoperationConfig {
        retargeter: "fake".to_owned(),
        ..config("lab")
    };
    let (mut operator, _events) = client.operate(slow).await?;
    send(&mut operator, 0.25).await?;
    within("the retargeter to be busy", gate.has_entered(1)).await?;
    let frame = still(&robot, 0.0);
    for _ in 0..20 {
        let result = end.step(&frame).await?;
        assert_eq!(guard(&result).phase(), GoalPhase::Holding);
        assert_eq!(result.leg_targets.len(), 12);
    }
    gate.let_batches_pass();
    arrive(&mut operator, &mut end, &frame, 0.25).await?;
    Ok(())
}

#[tokio::test]
async fn sources_that_stand_still_are_stale_however_fresh_their_packets() -> anyhow::Result<()> {
    let (server, _weights) = server()?;
    let robot = emp27()?;
    let client = Client::connect(&server.url()).await?;
    let mut end = RobotEnd::join(&client, "lab").await?;
    let (mut operator, _events) = client.operate(config("lab")).await?;
    let frame = still(&robot, 0.0);
    follow(&mut operator, &mut end, &frame, 0.3).await?;
    // The same pose again and again.
    let frozen = pose(0.3);
    let mut phase = GoalPhase::Following;
    for _ in 0..1_000 {
        operator.send(&frozen).await?;
        phase = guard(&end.step(&frame).await?).phase();
        if phase == GoalPhase::Holding {
            break;
        }
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
    assert_eq!(phase, GoalPhase::Holding);
    // The same state again and again.
    follow(&mut operator, &mut end, &frame, 0.3).await?;
    let mut report = GuardReport::default();
    for _ in 0..1_000 {
        send(&mut operator, 0.3).await?;
        end.sender.send(&frame, None).await?;
        let Some(Event::Answer(answer)) = within("an answer", end.events.next()).await?? else {
            panic!("no answer")
        };
        report = guard(&answer.result);
        if report.state_frozen {
            break;
        }
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
    assert!(report.state_frozen);
    assert_eq!(report.phase(), GoalPhase::Holding);
    Ok(())
}

#[tokio::test]
async fn a_person_lets_go_stops_and_starts_again() -> anyhow::Result<()> {
    let (server, _weights) = server()?;
    let robot = emp27()?;
    let client = Client::connect(&server.url()).await?;
    let mut end = RobotEnd::join(&client, "lab").await?;
    let (mut operator, mut events) = client.operate(config("lab")).await?;
    let frame = still(&robot, 0.0);
    let followed = follow(&mut operator, &mut end, &frame, 0.3).await?;
    let let_go = |angle: f32| OperatorInput {
        clutch: true,
        ..OperatorInput::pose(&pose(angle + tremor()))
    };
    let mut held = followed.clone();
    for _ in 0..200 {
        operator.send_input(&let_go(-0.3)).await?;
        held = end.step(&frame).await?;
        if guard(&held).phase() == GoalPhase::Holding {
            break;
        }
    }
    assert_eq!(guard(&held).phase(), GoalPhase::Holding);
    let back = arrive(&mut operator, &mut end, &frame, -0.3).await?;
    assert_eq!(guard(&back).cause(), RampCause::OperatorReturned);
    assert_near(&back.goal, &held.goal, 1e-3);

    let stop = OperatorInput {
        stop: true,
        ..OperatorInput::default()
    };
    operator.send_input(&stop).await?;
    let presence = next(&mut events, |event| match event {
        SessionEvent::Presence(presence) => {
            (presence.state() == SessionState::Stopped).then_some(presence)
        }
        _ => None,
    })
    .await?;
    assert!(presence.robot);
    let returning = end.until(&frame, GoalPhase::Returning).await?;
    assert_eq!(returning.state(), SessionState::Stopped);
    end.until(&frame, GoalPhase::Resting).await?;
    send(&mut operator, 0.3).await?;
    let resting = end.step(&frame).await?;
    assert_eq!(
        guard(&resting).phase(),
        GoalPhase::Resting,
        "until it is armed"
    );
    let arm = ControlRequest {
        session: "lab".to_owned(),
        command: ControlCommand::Arm.into(),
        caution: Some(0.5),
        ..ControlRequest::default()
    };
    let armed = client.control(arm.clone()).await?;
    assert!(!armed.lease.is_empty());
    assert_eq!(armed.session.expect("a session").caution, 0.5);
    let refused = client.control(arm).await.expect_err("another's lease");
    assert_eq!(refused.code(), Some(Code::FailedPrecondition), "{refused}");
    follow(&mut operator, &mut end, &frame, 0.3).await?;

    let sessions = client.sessions().await?;
    assert_eq!(sessions.len(), 1);
    assert!(sessions[0].controlled && sessions[0].periods > 0);
    client.end_session("lab").await?;
    let error = loop {
        match within("the end", end.events.next()).await? {
            Ok(Some(_)) => {}
            Ok(None) => panic!("it ended well"),
            Err(error) => break error,
        }
    };
    assert_eq!(error.code(), Some(Code::Aborted), "{error}");
    Ok(())
}

#[tokio::test]
async fn a_robot_that_comes_back_takes_its_seat_over() -> anyhow::Result<()> {
    let (server, _weights) = server()?;
    let frame = still(&*emp27()?, 0.0);
    let mut first = open(&server, raw_config("lab", robot_role())).await?;
    let Ok(Some(Response::Started(accepted))) = first.next().await? else {
        panic!("not started")
    };
    assert!(!accepted.resume_token.is_empty());
    first.send(robot_frame(0, Some(raw_state(&frame)))).await;
    assert!(matches!(first.next().await?, Ok(Some(Response::Result(_)))));
    let config = TeleoperateConfig {
        resume_token: accepted.resume_token,
        ..raw_config("lab", robot_role())
    };
    // Its old stream is still there as far as the server knows.
    let second = started(&server, config).await?;
    second.send(robot_frame(0, Some(raw_state(&frame)))).await;
    let (_, status) = first.failure().await?;
    assert_eq!(status.code(), Code::Aborted, "{status:?}");
    // Nobody else gets it while it sends, anybody once it is silent.
    let mut other = open(&server, raw_config("lab", robot_role())).await?;
    let status = other.next().await?.expect_err("taken");
    assert_eq!(status.code(), Code::AlreadyExists, "{status:?}");
    let mut observer = started(&server, raw_config("lab", observer_role())).await?;
    let silent = loop {
        match observer.next().await? {
            Ok(Some(Response::Presence(presence))) if presence.robot_silent => break presence,
            Ok(Some(_)) => {}
            other => panic!("{other:?}"),
        }
    };
    assert!(silent.robot);
    started(&server, raw_config("lab", robot_role())).await?;
    Ok(())
}

/// A robot in MuJoCo at its end of a session.
struct Simulated {
    stage: Stage,
    body: Body,
}

impl Simulated {
    fn new(robot: &Robot) -> anyhow::Result<Self> {
        let mut stage = Stage::new(robot)?;
        let default: Vec<f64> = robot.joints().map(|joint| joint.default).collect();
        let body = stage.place(&Start {
            joint_positions: &default,
            lift: 0.0,
            parameters: BodyParameters::default(),
        });
        Ok(Self { stage, body })
    }

    fn frame(&self) -> TeleoperationFrame {
        let reading = self.body.reading();
        TeleoperationFrame {
            operator: None,
            joint_positions: reading.joint_positions.clone(),
            orientation: reading.orientation,
            measured: None,
            reset: false,
        }
    }

    fn execute(&mut self, result: &TeleoperatedFrame) {
        let targets = Targets {
            goal: executed(result),
            legs: &result.leg_targets,
        };
        self.stage.step(&mut self.body, &targets);
    }

    /// Cosine of the base's tilt.
    fn upright(&self) -> f64 {
        let down = self.body.reading().orientation.inverse() * nalgebra::Vector3::z();
        down.z
    }
}

/// `emp operate` or `emp observe` as a process of its own.
fn emp_command(server: &str, arguments: &[&str]) -> anyhow::Result<Command> {
    let mut command = Command::new(binaries()?.join("emp"));
    command
        .args(["--server", server])
        .args(arguments)
        .args(["--robot", "emp27", "--session", "lab", "--json"])
        .stdout(Stdio::piped());
    Ok(command)
}

#[tokio::test]
async fn a_robot_stands_while_operators_in_other_processes_come_and_go() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let server = ServerProcess::start(folder.path())?;
    let motion = folder.path().join("wave.npz");
    let mut clip = skills::generate(skills::Skill::Wave, 3)
        .resampled(50.0)
        .expect("an ordinary rate");
    clip.frames.truncate(125);
    key_nodes::write(&motion, &clip)?;
    let motion = motion.to_string_lossy().into_owned();

    let robot = emp27()?;
    let client = Client::connect(&server.url).await?;
    let mut end = RobotEnd::join(&client, "lab").await?;
    let mut simulated = Simulated::new(&robot)?;
    let mut ticks = tokio::time::interval(Duration::from_millis(20));
    let observer = emp_command(&server.url, &["observe", "--seconds", "4"])?.spawn()?;
    let mut phases = Vec::new();
    for _ in 0..2 {
        let mut operator = emp_command(&server.url, &["operate", &motion])?.spawn()?;
        let mut after = 0;
        // A second after the operator has gone, the next one comes.
        while after < 50 {
            ticks.tick().await;
            let result = end.step(&simulated.frame()).await?;
            simulated.execute(&result);
            assert!(simulated.upright() > 0.9, "the robot tilts");
            phases.push(guard(&result).phase());
            after += usize::from(operator.try_wait()?.is_some());
        }
        let output = operator.wait_with_output()?;
        assert!(output.status.success());
        let summary: Value = serde_json::from_slice(&output.stdout)?;
        assert!(
            summary["executed"].as_u64().is_some_and(|count| count > 60),
            "{summary}"
        );
        assert!(
            summary["phases"]["following"]
                .as_u64()
                .is_some_and(|count| count > 0),
            "{summary}"
        );
    }
    let count = |wanted| phases.iter().filter(|phase| **phase == wanted).count();
    assert!(count(GoalPhase::Following) > 60, "{phases:?}");
    assert!(count(GoalPhase::Holding) > 0, "{phases:?}");
    let observed = tokio::task::spawn_blocking(move || observer.wait_with_output()).await??;
    assert!(observed.status.success());
    let lines: Vec<Value> = observed
        .stdout
        .split(|byte| *byte == b'\n')
        .filter(|line| !line.is_empty())
        .map(serde_json::from_slice)
        .collect::<Result<_, _>>()?;
    assert!(lines.len() > 60, "{} lines", lines.len());
    assert!(lines.iter().any(|line| line["phase"] == "ramping"));
    Ok(())
}

#[tokio::test]
async fn the_command_prints_a_table_for_people() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let server = ServerProcess::start(folder.path())?;
    let client = Client::connect(&server.url).await?;
    let mut end = RobotEnd::join(&client, "lab").await?;
    let observer = Command::new(binaries()?.join("emp"))
        .args([
            "--server",
            &server.url,
            "observe",
            "--robot",
            "emp27",
            "--session",
            "lab",
        ])
        .args(["--seconds", "1.5"])
        .stdout(Stdio::piped())
        .spawn()?;
    let frame = still(&*emp27()?, 0.0);
    for _ in 0..100 {
        end.step(&frame).await?;
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    let output = tokio::task::spawn_blocking(move || observer.wait_with_output()).await??;
    assert!(output.status.success());
    let table = String::from_utf8(output.stdout)?;
    assert!(table.starts_with("frame "), "{table}");
    assert!(table.contains("holding"), "{table}");
    Ok(())
}
