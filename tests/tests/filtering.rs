//! Goals filtered over the wire: streams, single calls and policies behind an EMP against the same in this process, and what
//! they refuse.

use std::sync::Arc;

use emp_client::{
    ChangeReason, Client, Delivery, DropReason, EmpMode, EvaluationConfig, EvaluationEvent, Event,
    FilterAnswer, FilterConfig, FilterResult, GoalFrame, GoalHistory, PolicyConfig,
    ProceduralClips, RobotFrame,
};
use emp_models::{
    assessment::{GoalPath, assess},
    controller::{Controller, ControllerInput, ControllerState, FilteredGoal, filter_goals},
    emp::Emp,
    filters::{EmpFilter, GoalFilter},
    observation::RobotState,
};
use emp_proto::v1::{
    self, FilterGoalFrame, FilterGoalRequest, PolicyObservation, StepPolicyRequest,
    StreamFilterGoalConfig, StreamFilterGoalRequest, StreamFilterGoalResponse,
    motion_service_client::MotionServiceClient, stream_filter_goal_request::Message as Request,
    stream_filter_goal_response::Message as Response,
};
use emp_robot::Robot;
use emp_tests::{
    TestServer, emp, emp27, policy,
    raw::{self, OneOf as _, RawStream, wrong_field},
    within,
};
use nalgebra::UnitQuaternion;
use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};
use tempfile::TempDir;
use tonic::{Code, transport::Channel};

/// Largest difference between an answer of the server and one of this process. The orientation travels as f32, and a batch
/// adds in another order.
const TOLERANCE: f32 = 1e-4;
/// Control periods of an episode: longer than the history.
const FRAMES: usize = 60;
/// Tilt from which on the test's EMP sees danger, rad.
const DANGER: f32 = 0.2;
/// The modes, and the names of their controllers.
const MODES: [(EmpMode, &str); 3] = [
    (EmpMode::Off, "decoupled"),
    (EmpMode::On, "emp"),
    (EmpMode::WhenDanger, "emp-when-danger"),
];

struct Fixture {
    server: TestServer,
    robot: Arc<Robot>,
    emp: Arc<Emp>,
    weights: TempDir,
}

fn fixture() -> anyhow::Result<Fixture> {
    let robot = emp27()?;
    let weights = emp::weights(&emp::small(&robot, DANGER))?;
    Ok(Fixture {
        server: TestServer::start_with(weights.path(), |_| {})?,
        robot,
        emp: emp::load(&weights)?,
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

    fn controller(&self, name: &str) -> anyhow::Result<Controller> {
        let policy = policy::load(&self.weights)?;
        Ok(Controller::by_name(name, &policy, Some(&self.emp))?)
    }

    /// What the filter of a mode makes of an episode, in this process.
    fn filtered(&self, mode: EmpMode, frames: &[GoalFrame]) -> anyhow::Result<Vec<FilteredGoal>> {
        let mut reference = Reference::new(&self.emp, mode);
        frames.iter().map(|frame| reference.step(frame)).collect()
    }
}

/// A filter in this process, and a robot's past.
struct Reference {
    emp: Arc<Emp>,
    filter: Option<EmpFilter>,
    state: ControllerState,
}

impl Reference {
    fn new(emp: &Arc<Emp>, mode: EmpMode) -> Self {
        let filter = match mode {
            EmpMode::Off => None,
            EmpMode::WhenDanger => Some(EmpFilter::when_danger(Arc::clone(emp), emp.config().gate)),
            EmpMode::On | EmpMode::Unspecified => Some(EmpFilter::always(Arc::clone(emp))),
        };
        Self {
            emp: Arc::clone(emp),
            filter,
            state: ControllerState::new(emp.config().observation),
        }
    }

    fn step(&mut self, frame: &GoalFrame) -> anyhow::Result<FilteredGoal> {
        if frame.reset {
            self.state.reset();
        }
        let legs = self.emp.robot().leg_joints().len();
        let action = match frame.last_action.as_slice() {
            [] => vec![0.0; legs],
            action => action.to_vec(),
        };
        self.state.history_mut().set_last_action(&action);
        let input = controller_input(frame);
        let filter = self.filter.as_ref().map(|filter| filter as &dyn GoalFilter);
        let layout = &self.emp.config().observation;
        Ok(filter_goals(layout, filter, &mut [(&mut self.state, input)])?.remove(0))
    }
}

fn controller_input(frame: &GoalFrame) -> ControllerInput<'_> {
    ControllerInput {
        state: RobotState {
            joint_positions: &frame.joint_positions,
            orientation: frame.orientation,
        },
        goal: &frame.goal,
    }
}

/// A robot whose arms swing, that leans more and more until the middle of the episode and then less, its world turned.
fn episode(robot: &Robot) -> Vec<GoalFrame> {
    let frame = |t: usize| {
        let (time, lean) = (t as f32, t.min(FRAMES - t) as f64);
        let swing = |start: f32| 0.3 * (0.1 * time + start).sin();
        let inside = |(i, joint): (usize, &emp_robot::Joint)| {
            let angle = joint.default as f32 + swing(i as f32);
            joint.clamp(angle)
        };
        let goals = robot.goal_joints().iter().enumerate().map(inside);
        GoalFrame {
            joint_positions: robot.joints().enumerate().map(inside).collect(),
            orientation: UnitQuaternion::from_euler_angles(0.0, 0.01 * lean, 2.5 + 0.01 * lean),
            goal: goals.collect(),
            last_action: match t {
                0 => Vec::new(),
                _ => vec![0.2 * swing(1.0); robot.leg_joints().len()],
            },
            reset: false,
        }
    };
    (0..FRAMES).map(frame).collect()
}

fn assert_near(served: &[f32], expected: &[f32]) {
    emp_tests::assert_near(served, expected, TOLERANCE);
}

fn assert_equal(served: &FilterResult, expected: &FilteredGoal) {
    assert_near(&served.executable_goal, &expected.goal);
    let Some(risk) = expected.risk else {
        assert_eq!((served.regloss, served.danger), (None, false));
        return;
    };
    let regloss = served.regloss.expect("an EMP's answer");
    assert!((regloss - risk.regloss).abs() <= TOLERANCE * (1.0 + risk.regloss));
    assert_eq!(served.danger, risk.danger);
    assert!((served.applied - risk.applied).abs() < 1e-6);
}

/// Streams frames one by one and gives the answers.
async fn answers(
    client: &Client,
    config: FilterConfig,
    frames: &[GoalFrame],
) -> anyhow::Result<Vec<FilterAnswer>> {
    let (mut sender, mut events) = client.filter_stream(config).await?;
    assert_eq!(events.joint_names().len(), 27);
    assert_eq!(events.model().0, "emp27-emp");
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

fn with_mode(emp_mode: EmpMode) -> FilterConfig {
    FilterConfig {
        emp_mode,
        ..FilterConfig::for_robot("emp27")
    }
}

#[tokio::test]
async fn a_stream_answers_as_the_filter_in_process() -> anyhow::Result<()> {
    let fixture = fixture()?;
    let client = fixture.client().await?;
    let mut frames = episode(&fixture.robot);
    frames[40].reset = true;
    for (mode, _) in MODES {
        let expected = fixture.filtered(mode, &frames)?;
        let served = answers(&client, with_mode(mode), &frames).await?;
        for (served, expected) in served.iter().zip(&expected) {
            assert_equal(&served.result, expected);
            assert_eq!(served.times.batch_size, 1);
        }
    }
    let unspecified = answers(&client, with_mode(EmpMode::Unspecified), &frames).await?;
    let on = fixture.filtered(EmpMode::On, &frames)?;
    assert_equal(&unspecified[FRAMES - 1].result, &on[FRAMES - 1]);
    Ok(())
}

#[tokio::test]
async fn a_single_call_with_the_history_answers_as_the_stream() -> anyhow::Result<()> {
    let fixture = fixture()?;
    let client = fixture.client().await?;
    let frames = episode(&fixture.robot);
    let heading = frames[0].orientation.euler_angles().2 as f32;
    for (mode, _) in MODES {
        let expected = fixture.filtered(mode, &frames)?;
        // In between, what fills the stream's history up is the first frame as it was asked for.
        for now in [0, 14, 15, FRAMES / 2, FRAMES - 1] {
            let first = now.saturating_sub(14);
            // The past has the goals that were executed.
            let past = (first..now).map(|t| GoalFrame {
                goal: expected[t].goal.clone(),
                ..frames[t].clone()
            });
            let history: Vec<_> = past.chain([frames[now].clone()]).collect();
            let before = now.checked_sub(1).and_then(|before| expected[before].risk);
            let history = GoalHistory {
                frames: &history,
                start_heading: (first > 0).then_some(heading),
                last_applied: before.map_or(0.0, |risk| risk.applied),
            };
            let config = with_mode(mode);
            let answer = client.filter_goal(&config, history);
            let answer = within("an answer", answer).await??;
            assert_equal(&answer.result, &expected[now]);
        }
    }
    Ok(())
}

fn reasons(result: &FilterResult) -> Vec<ChangeReason> {
    result.reasons().collect()
}

#[tokio::test]
async fn when_danger_lets_goals_pass_until_the_robot_leans() -> anyhow::Result<()> {
    let fixture = fixture()?;
    let client = fixture.client().await?;
    let frames = episode(&fixture.robot);
    let served = answers(&client, with_mode(EmpMode::WhenDanger), &frames).await?;
    let leans = |t: usize| frames[t].orientation.euler_angles().1 > f64::from(DANGER);
    let dangers = (0..FRAMES).filter(|&t| leans(t)).count();
    assert!((10..FRAMES / 2).contains(&dangers));
    let mut opened = false;
    for (t, answer) in served.iter().enumerate() {
        let result = &answer.result;
        assert_eq!(result.danger, leans(t), "frame {t}");
        opened |= result.danger;
        if !opened {
            assert_eq!(result.executable_goal, frames[t].goal);
            assert_eq!(result.applied, 0.0);
            assert!(result.reasons.is_empty() && result.regloss.is_some());
        }
    }
    let middle = &served[FRAMES / 2].result;
    assert_eq!(middle.applied, 1.0);
    assert_near(
        &middle.executable_goal,
        &fixture.filtered(EmpMode::WhenDanger, &frames)?[FRAMES / 2].goal,
    );
    let last = served[FRAMES - 1].result.applied;
    assert!(0.0 < last && last < 1.0, "it is taken back slowly: {last}");
    Ok(())
}

#[tokio::test]
async fn answers_say_how_the_robot_stands_and_why_a_goal_was_changed() -> anyhow::Result<()> {
    let fixture = fixture()?;
    let client = fixture.client().await?;
    let mut frames = episode(&fixture.robot);
    let elbow = fixture.robot.goal_joints().iter();
    let elbow = elbow
        .enumerate()
        .find(|(_, joint)| joint.name == "left_elbow");
    let (elbow, joint) = elbow.expect("an elbow");
    frames[1].goal[elbow] = joint.range[1] as f32 + 0.4;
    for (mode, _) in MODES {
        let served = answers(&client, with_mode(mode), &frames[..2]).await?;
        for (answer, frame) in served.iter().zip(&frames) {
            let result = &answer.result;
            let state = controller_input(frame).state;
            let goal = GoalPath {
                asked: &frame.goal,
                filtered: &result.executable_goal,
                executable: &result.executable_goal,
            };
            let expected = assess(&fixture.robot, &state, &goal)?;
            let nearest = expected.nearest_links.expect("links that may touch");
            let links = nearest.links.map(|link| link as u32);
            assert_eq!(result.change, expected.change);
            assert_eq!(result.nearest_links, links);
            assert_near(
                &[
                    result.center_of_mass_margin,
                    result.smallest_link_distance.expect("a distance"),
                ],
                &[expected.center_of_mass_margin, nearest.distance],
            );
        }
        let reasons = reasons(&served[1].result);
        let is_on = mode == EmpMode::On;
        assert_eq!(
            reasons.contains(&ChangeReason::JointLimit),
            is_on,
            "{mode:?}"
        );
        assert_eq!(reasons.contains(&ChangeReason::Balance), is_on, "{mode:?}");
    }
    Ok(())
}

fn robot_frame(frame: &GoalFrame) -> RobotFrame {
    RobotFrame {
        joint_positions: frame.joint_positions.clone(),
        orientation: frame.orientation,
        goal: frame.goal.clone(),
        reset: frame.reset,
    }
}

async fn check_policy(
    client: &Client,
    mode: EmpMode,
    controller: &Controller,
    frames: &[GoalFrame],
) -> anyhow::Result<()> {
    let config = PolicyConfig {
        emp_mode: mode,
        ..PolicyConfig::for_robot("emp27")
    };
    let (mut sender, mut events) = client.policy_stream(config).await?;
    let mut state = controller.state();
    for frame in frames {
        sender.send(&robot_frame(frame), None).await?;
        let Some(Event::Answer(served)) = within("an answer", events.next()).await?? else {
            panic!("unanswered")
        };
        let input = controller_input(frame);
        let expected = controller.step(&mut [(&mut state, input)])?.remove(0);
        assert_near(&served.executable_goal, &expected.goal);
        assert_near(&served.action, &expected.action);
        assert_near(&served.leg_targets, &expected.leg_targets);
        let Some(filter) = served.filter else {
            assert_eq!(mode, EmpMode::Off);
            continue;
        };
        assert_eq!(filter.executable_goal, served.executable_goal);
        let filtered = FilteredGoal {
            goal: expected.goal,
            risk: expected.risk,
            execution: expected.execution,
        };
        assert_equal(&filter, &filtered);
    }
    Ok(())
}

#[tokio::test]
async fn policies_of_every_mode_share_a_model() -> anyhow::Result<()> {
    let fixture = fixture()?;
    let client = fixture.client().await?;
    let frames = Arc::new(episode(&fixture.robot));
    let mut streams = Vec::new();
    for (mode, name) in MODES.repeat(3) {
        let (client, frames) = (client.clone(), Arc::clone(&frames));
        let controller = fixture.controller(name)?;
        assert_eq!(controller.name(), name);
        streams.push(tokio::spawn(async move {
            check_policy(&client, mode, &controller, &frames).await
        }));
    }
    for stream in streams {
        stream.await??;
    }
    Ok(())
}

fn observation(frame: &FilterGoalFrame) -> PolicyObservation {
    PolicyObservation {
        state: frame.state.clone(),
        goal: frame.goal.clone(),
        last_action: frame.last_action.clone(),
    }
}

fn wire_frame(number: u64, frame: &GoalFrame) -> FilterGoalFrame {
    FilterGoalFrame {
        header: Some(raw::header(number)),
        state: Some(raw::state(&frame.joint_positions, &frame.orientation)),
        goal: frame.goal.clone(),
        last_action: frame.last_action.clone(),
        reset: frame.reset,
    }
}

#[tokio::test]
async fn a_single_policy_step_goes_through_the_emp_when_asked() -> anyhow::Result<()> {
    let fixture = fixture()?;
    let mut client = fixture.raw_client().await?;
    let frame = &episode(&fixture.robot)[0];
    for (mode, name) in MODES {
        let request = StepPolicyRequest {
            robot: "emp27".to_owned(),
            history: vec![observation(&wire_frame(0, frame))],
            emp_mode: mode.into(),
            ..StepPolicyRequest::default()
        };
        let response = client.step_policy(request).await?.into_inner();
        let result = response.result.expect("a result");
        assert_eq!(result.filter.is_some(), mode != EmpMode::Off);
        let controller = fixture.controller(name)?;
        let input = controller_input(frame);
        let expected = controller.step(&mut [(&mut controller.state(), input)])?;
        assert_near(&result.executable_goal, &expected[0].goal);
        assert_near(&result.action, &expected[0].action);
    }
    Ok(())
}

#[tokio::test]
async fn a_robot_without_an_emp_serves_the_rest_with_the_mode_off() -> anyhow::Result<()> {
    let weights = policy::weights()?;
    let server = TestServer::start_with(weights.path(), |_| {})?;
    let mut client = server.raw_client().await?;
    let frame = wire_frame(0, &episode(&*emp27()?)[0]);
    let step = |mode: EmpMode| StepPolicyRequest {
        robot: "emp27".to_owned(),
        history: vec![observation(&frame)],
        emp_mode: mode.into(),
        ..StepPolicyRequest::default()
    };
    client.step_policy(step(EmpMode::Unspecified)).await?;
    client.step_policy(step(EmpMode::Off)).await?;
    for mode in [EmpMode::On, EmpMode::WhenDanger] {
        let status = client.step_policy(step(mode)).await.expect_err("no EMP");
        assert_eq!(wrong_field(&status), "emp_mode");
        assert!(status.message().contains("no EMP"), "{status:?}");
        let config = PolicyConfig {
            emp_mode: mode,
            ..PolicyConfig::for_robot("emp27")
        };
        let typed = Client::connect(&server.url()).await?;
        let Err(error) = typed.policy_stream(config).await else {
            panic!("an EMP from nowhere")
        };
        assert_eq!(error.code(), Some(Code::InvalidArgument));
        assert!(error.to_string().contains("config.emp_mode"), "{error}");
    }
    let request = FilterGoalRequest {
        robot: "emp27".to_owned(),
        history: vec![observation(&frame)],
        ..FilterGoalRequest::default()
    };
    let status = client.filter_goal(request).await.expect_err("no EMP");
    assert_eq!(wrong_field(&status), "robot");
    assert!(status.message().contains("robot with an EMP"), "{status:?}");
    Ok(())
}

#[tokio::test]
async fn evaluations_take_the_emp_by_name() -> anyhow::Result<()> {
    let fixture = fixture()?;
    let without = policy::weights()?;
    let server_without = TestServer::start_with(without.path(), |_| {})?;
    let config = |controller: &str| EvaluationConfig {
        robot: "emp27".to_owned(),
        controller: Some(emp_client::controller(controller).expect(controller)),
        episodes: 2,
        procedural: Some(ProceduralClips { count: 1, seed: 1 }),
        ..EvaluationConfig::default()
    };
    let client = fixture.client().await?;
    for (specification, name) in [
        ("emp", "emp"),
        ("emp-when-danger:tilt=0.1", "emp-when-danger"),
    ] {
        let mut evaluation = client.evaluate(config(specification), Vec::new()).await?;
        let (mut started, mut result) = (None, None);
        while let Some(event) = within("an event", evaluation.next()).await?? {
            match event {
                EvaluationEvent::Started(event) => started = Some(event.controller),
                EvaluationEvent::Result(event) => result = Some(event),
                _ => {}
            }
        }
        assert_eq!(started.as_deref(), Some(name));
        assert_eq!(
            result.and_then(|result| result.all).map(|all| all.episodes),
            Some(2)
        );

        let client = Client::connect(&server_without.url()).await?;
        let error = client.evaluate(config(specification), Vec::new()).await;
        let error = error.expect_err("no EMP");
        assert_eq!(error.code(), Some(Code::InvalidArgument));
        assert!(error.to_string().contains("emp27 has no EMP"), "{error}");
    }
    Ok(())
}

#[tokio::test]
async fn a_robot_with_a_damaged_emp_is_not_served_and_says_why() -> anyhow::Result<()> {
    let fixture = fixture()?;
    let client = fixture.client().await?;
    let before = client.model("emp27-emp").await?;
    let (mut sender, mut events) = client.filter_stream(with_mode(EmpMode::On)).await?;
    let frames = episode(&fixture.robot);

    // While it serves, a damaged file changes nothing.
    let file = emp::file(&fixture.weights);
    let good = std::fs::read(&file)?;
    std::fs::write(&file, b"not a checkpoint")?;
    let reloaded = client.reload("").await?;
    assert!(
        reloaded
            .iter()
            .all(|model| model.error.contains("emp27-emp"))
    );
    assert_eq!(client.model("emp27-emp").await?, before);

    // A server that starts with it does not serve the robot, least of all without its EMP.
    match TestServer::start_with(fixture.weights.path(), |_| {}) {
        // It was the only robot.
        Err(error) => assert!(error.to_string().contains("no robot of"), "{error}"),
        Ok(server) => {
            let client = Client::connect(&server.url()).await?;
            let robots = client.robots().await?;
            let emp27 = robots.iter().find(|robot| robot.name == "emp27");
            let emp27 = emp27.expect("it is known");
            assert!(!emp27.serving && emp27.reason.contains("emp27-emp"));
            let refused = client.policy_stream(PolicyConfig::for_robot("emp27")).await;
            let error = refused.err().expect("not served");
            assert_eq!(error.reason().as_deref(), Some("NOT_SERVING"), "{error}");
        }
    }

    // Another EMP becomes the next version; the stream that is open keeps its own.
    let shape = emp::small(&fixture.robot, 0.5);
    emp::write(&file, &fixture.robot, &shape, 77)?;
    let reloaded = client.reload("emp27").await?;
    assert!(
        reloaded.iter().all(|model| model.error.is_empty()),
        "{reloaded:?}"
    );
    let after = client.model("emp27-emp").await?;
    assert_ne!(after.version, before.version);
    let expected = fixture.filtered(EmpMode::On, &frames[..1])?;
    sender.send(&frames[0], None).await?;
    let Some(Event::Answer(answer)) = within("an answer", events.next()).await?? else {
        panic!("unanswered")
    };
    assert_equal(&answer.result, &expected[0]);
    let pinned = |version: &str| FilterConfig {
        model_version: version.to_owned(),
        ..with_mode(EmpMode::On)
    };
    answers(&client, pinned(&before.version), &frames[..1]).await?;
    drop((sender, events));
    answers(&client, pinned(&after.version), &frames[..1]).await?;
    std::fs::write(&file, good)?;
    Ok(())
}

#[tokio::test]
async fn emps_are_listed_with_their_versions() -> anyhow::Result<()> {
    let fixture = fixture()?;
    let client = fixture.client().await?;
    let model = client.model("emp27-emp").await?;
    assert_eq!(model.kind(), v1::ModelKind::Emp);
    assert_eq!(model.version, fixture.emp.metadata().version());
    let goals = fixture.robot.goal_joints().iter().map(|joint| &joint.name);
    assert!(goals.eq(&model.joint_names));
    assert!(client.robot("emp27").await?.action_scale > 0.0);
    let frames = episode(&fixture.robot);
    let exact = FilterConfig {
        model: "emp27-emp".to_owned(),
        model_version: model.version,
        ..with_mode(EmpMode::On)
    };
    answers(&client, exact, &frames[..1]).await?;
    Ok(())
}

/// Frames with one thing wrong each, and the field that is.
fn bad_frames(good: &GoalFrame) -> Vec<(&'static str, FilterGoalFrame)> {
    let with = |change: &dyn Fn(&mut FilterGoalFrame)| {
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
            state(&|state| state.joint_positions.truncate(26)),
        ),
        (
            "state.joint_positions[3]",
            state(&|state| state.joint_positions[3] = f32::NAN),
        ),
        (
            "state.base_orientation",
            state(&|state| state.base_orientation = None),
        ),
        ("goal", with(&|frame| frame.goal.push(0.0))),
        ("goal[14]", with(&|frame| frame.goal[14] = f32::INFINITY)),
        ("goal[0]", with(&|frame| frame.goal[0] = -10.0)),
        (
            "last_action",
            with(&|frame| frame.last_action = vec![0.0; 13]),
        ),
        (
            "last_action[11]",
            with(&|frame| frame.last_action = [vec![0.0; 11], vec![f32::NAN]].concat()),
        ),
    ]
}

type FilterStream = RawStream<StreamFilterGoalRequest, StreamFilterGoalResponse>;

async fn open(client: &MotionServiceClient<Channel>) -> anyhow::Result<FilterStream> {
    RawStream::open(async |requests| client.clone().stream_filter_goal(requests).await).await
}

async fn started(
    client: &MotionServiceClient<Channel>,
    delivery: Delivery,
) -> anyhow::Result<FilterStream> {
    let mut stream = open(client).await?;
    let config = StreamFilterGoalConfig {
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
async fn result(stream: &mut FilterStream) -> anyhow::Result<FilterResult> {
    match stream.next().await? {
        Ok(Some(Response::Result(answered))) => Ok(answered.result.expect("a result")),
        other => panic!("{other:?}"),
    }
}

fn config(robot: &str) -> StreamFilterGoalConfig {
    StreamFilterGoalConfig {
        robot: robot.to_owned(),
        ..StreamFilterGoalConfig::default()
    }
}

#[tokio::test]
async fn bad_frames_are_dropped_by_field_and_leave_no_trace() -> anyhow::Result<()> {
    let fixture = fixture()?;
    let client = fixture.raw_client().await?;
    let frames = episode(&fixture.robot);
    for delivery in [Delivery::All, Delivery::Latest] {
        let mut stream = started(&client, delivery).await?;
        let mut reference = Reference::new(&fixture.emp, EmpMode::On);
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
            assert_equal(&result(&mut stream).await?, &reference.step(frame)?);
        }
        // The `reset` of a bad frame holds for the frame after it.
        let bad = FilterGoalFrame {
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
        let anew = &fixture.filtered(EmpMode::On, &frames[30..31])?[0];
        assert_equal(&result(&mut stream).await?, anew);
    }
    Ok(())
}

#[tokio::test]
async fn bad_configs_end_the_stream_by_field() -> anyhow::Result<()> {
    let fixture = fixture()?;
    let client = fixture.raw_client().await?;
    let frame = || Request::Frame(wire_frame(0, &episode(&fixture.robot)[0]));
    let changed = |change: &dyn Fn(&mut StreamFilterGoalConfig)| {
        let mut config = config("emp27");
        change(&mut config);
        vec![Request::Config(config)]
    };
    let cases = [
        ("robot", vec![Request::Config(config("nobody"))]),
        (
            "model",
            changed(&|config| config.model = "emp27-policy".to_owned()),
        ),
        (
            "model_version",
            changed(&|config| config.model_version = "0".to_owned()),
        ),
        ("config.delivery", changed(&|config| config.delivery = 99)),
        ("config.emp_mode", changed(&|config| config.emp_mode = 99)),
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
    let good = &episode(&fixture.robot)[0];
    let one = observation(&wire_frame(0, good));
    let request = |history: Vec<PolicyObservation>| FilterGoalRequest {
        robot: "emp27".to_owned(),
        history,
        ..FilterGoalRequest::default()
    };
    let changed = |change: &dyn Fn(&mut FilterGoalRequest)| {
        let mut request = request(vec![one.clone()]);
        change(&mut request);
        request
    };
    let mut cases = vec![
        ("history".to_owned(), request(Vec::new())),
        ("history".to_owned(), request(vec![one.clone(); 16])),
        (
            "start_heading".to_owned(),
            changed(&|request| request.start_heading = Some(f32::NAN)),
        ),
        (
            "last_applied".to_owned(),
            changed(&|request| request.last_applied = 1.5),
        ),
        (
            "last_applied".to_owned(),
            changed(&|request| request.last_applied = f32::NAN),
        ),
        (
            "emp_mode".to_owned(),
            changed(&|request| request.emp_mode = -1),
        ),
        (
            "robot".to_owned(),
            changed(&|request| request.robot = "nobody".to_owned()),
        ),
        (
            "robot".to_owned(),
            changed(&|request| request.robot = String::new()),
        ),
        (
            "model".to_owned(),
            changed(&|request| request.model = "emp27-policy".to_owned()),
        ),
        (
            "model_version".to_owned(),
            changed(&|request| request.model_version = "0".to_owned()),
        ),
    ];
    for (field, bad) in bad_frames(good) {
        let history = vec![one.clone(), observation(&bad)];
        cases.push((format!("history[1].{field}"), request(history)));
    }
    for (field, request) in cases {
        let status = client.filter_goal(request).await.expect_err(&field);
        assert_eq!(wrong_field(&status), field);
    }
    client.filter_goal(request(vec![one])).await?;
    Ok(())
}

#[tokio::test]
async fn half_close_answers_what_waits() -> anyhow::Result<()> {
    let fixture = fixture()?;
    let client = fixture.raw_client().await?;
    let frames = episode(&fixture.robot);
    let mut stream = started(&client, Delivery::All).await?;
    for (number, frame) in (0..).zip(&frames) {
        stream.send(Request::Frame(wire_frame(number, frame))).await;
    }
    stream.finish();
    for expected in fixture.filtered(EmpMode::On, &frames)? {
        assert_equal(&result(&mut stream).await?, &expected);
    }
    assert!(matches!(stream.next().await?, Ok(None)));
    Ok(())
}

/// Sends bursts of which only the newest frames are computed, until a frame with `reset` was superseded, and compares
/// each answer with a history in which that `reset` held for the next frame that was computed.
#[tokio::test]
async fn the_reset_of_a_superseded_frame_holds() -> anyhow::Result<()> {
    let fixture = fixture()?;
    let client = fixture.raw_client().await?;
    let mut stream = started(&client, Delivery::Latest).await?;
    let mut reference = Reference::new(&fixture.emp, EmpMode::On);
    let mut frames = episode(&fixture.robot);
    for frame in frames.iter_mut().skip(10).step_by(7) {
        frame.reset = true;
    }
    let mut held = false;
    for _burst in 0..200 {
        let mut superseded = 0;
        let mut results = Vec::new();
        for (number, frame) in (0..).zip(&frames) {
            stream.send(Request::Frame(wire_frame(number, frame))).await;
        }
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
            let frame = GoalFrame {
                reset: frames[number].reset || skipped,
                ..frames[number].clone()
            };
            assert_equal(&result, &reference.step(&frame)?);
            next = number + 1;
        }
        assert_eq!(next, FRAMES, "the newest frame is always answered");
        if held {
            return Ok(());
        }
    }
    panic!("no frame with `reset` was ever superseded")
}

/// Whatever bytes come in place of a request, the call ends with an error or an answer, and the next call is answered.
#[tokio::test]
async fn hostile_bytes_harm_nobody() -> anyhow::Result<()> {
    use prost::Message as _;

    let fixture = fixture()?;
    let mut good_client = fixture.raw_client().await?;
    let frame = wire_frame(0, &episode(&fixture.robot)[0]);
    let request = FilterGoalRequest {
        robot: "emp27".to_owned(),
        history: vec![observation(&frame)],
        ..FilterGoalRequest::default()
    };
    let messages = [Request::Config(config("emp27")), Request::Frame(frame)];
    let [config, frame] =
        messages.map(|message| StreamFilterGoalRequest::holding(Some(message)).encode_to_vec());
    let channel = tonic::transport::Endpoint::from_shared(fixture.server.url())?;
    let mut client = tonic::client::Grpc::new(channel.connect().await?);
    let mut rng = StdRng::seed_from_u64(5);
    let mut spoiled = |bytes: &[u8]| {
        let mut bytes = bytes.to_vec();
        for _ in 0..rng.random_range(1..8) {
            let place = rng.random_range(0..bytes.len());
            match rng.random_range(0..3) {
                0 => bytes[place] = rng.random(),
                1 => bytes.truncate(place.max(1)),
                _ => bytes.insert(place, rng.random()),
            }
        }
        bytes
    };
    let mut refused = 0;
    for _ in 0..300 {
        client.ready().await?;
        let bytes = tonic::Request::new(spoiled(&request.encode_to_vec()));
        let path = "/emp.v1.MotionService/FilterGoal".parse()?;
        let answer = client.unary(bytes, path, raw::Bytes);
        refused += usize::from(within("an answer", answer).await?.is_err());

        client.ready().await?;
        let messages = [
            spoiled(&config),
            config.clone(),
            spoiled(&frame),
            frame.clone(),
        ];
        let path = "/emp.v1.MotionService/StreamFilterGoal".parse()?;
        let messages = tonic::Request::new(tokio_stream::iter(messages));
        let stream = client.streaming(messages, path, raw::Bytes);
        if let Ok(stream) = within("a stream", stream).await? {
            let mut stream = stream.into_inner();
            while let Ok(Some(_)) = within("a message", stream.message()).await? {}
        }
    }
    assert!(refused > 100, "{refused} of 300");
    good_client.filter_goal(request).await?;
    Ok(())
}
