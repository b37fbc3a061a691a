//! A structure-aware attack on the wire: valid messages of every call, with one thing or a few changed by what the contract's own
//! descriptors say of them (numbers at their extremes, lists cut and grown, fields left out, texts too long), alone and in streams in
//! any order. After every round the server must still answer, with finite numbers.

use std::{
    fmt,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use anyhow::{Context as _, ensure};
use emp_proto::{FILE_DESCRIPTOR_SET, v1};
use prost::Message as _;
use prost_reflect::{
    DescriptorPool, DynamicMessage, FieldDescriptor, Kind, MessageDescriptor, MethodDescriptor,
    ReflectMessage as _, Value,
};
use rand::{RngExt as _, SeedableRng as _, rngs::StdRng, seq::IndexedRandom as _};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, client::Grpc, codegen::http::uri::PathAndQuery, transport::Channel};

use crate::{emp27, fake, raw, within};

/// Streams and calls at once.
const WORKERS: usize = 8;
/// Messages of a stream at most.
const LONGEST_STREAM: usize = 24;
/// How long a call may take to end once nothing more is sent.
const PATIENCE: Duration = Duration::from_secs(30);
/// Calls that go on for as long as there is something to tell, or a job runs.
const ENDLESS: [&str; 5] = [
    "CollectRollouts",
    "Observe",
    "StartEvaluation",
    "Teleoperate",
    "WatchEvaluation",
];

/// When to stop.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// Once so many messages were sent.
    pub messages: u64,
    /// Or after this time.
    pub time: Option<Duration>,
}

/// What happened.
#[derive(Debug, Clone, Copy, Default)]
pub struct Report {
    /// Messages sent.
    pub sent: u64,
    /// Calls made.
    pub calls: u64,
    /// Messages received.
    pub received: u64,
    /// Calls that ended with an error.
    pub refused: u64,
    /// Resident memory of this process at the start and now, bytes; the server's too where it runs in it.
    pub memory: [u64; 2],
    /// How long it took.
    pub time: Duration,
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [before, now] = self.memory.map(|bytes| bytes >> 20);
        write!(
            f,
            "{} messages in {} calls ({} refused), {} answers, {:.0} s, {before} MiB at first, {now} MiB now",
            self.sent,
            self.calls,
            self.refused,
            self.received,
            self.time.as_secs_f64()
        )
    }
}

#[derive(Default)]
struct Counts {
    sent: AtomicU64,
    calls: AtomicU64,
    received: AtomicU64,
    refused: AtomicU64,
}

/// Attacks the server at `url`; `progress` hears of it every ten seconds.
///
/// # Errors
/// When the server dies, hangs, answers with numbers that are not finite, or ends a stream well without its answer.
pub async fn run(
    url: &str,
    seed: u64,
    limits: Limits,
    mut progress: impl FnMut(&Report),
) -> anyhow::Result<Report> {
    let corpus = Arc::new(Corpus::new()?);
    let counts = Arc::new(Counts::default());
    let begin = Instant::now();
    let memory = resident();
    let is_over = move |counts: &Counts| {
        counts.sent.load(Ordering::Relaxed) >= limits.messages
            || limits.time.is_some_and(|time| begin.elapsed() >= time)
    };
    let report = |counts: &Counts| Report {
        sent: counts.sent.load(Ordering::Relaxed),
        calls: counts.calls.load(Ordering::Relaxed),
        received: counts.received.load(Ordering::Relaxed),
        refused: counts.refused.load(Ordering::Relaxed),
        memory: [memory, resident()],
        time: begin.elapsed(),
    };
    let mut workers = tokio::task::JoinSet::new();
    for worker in 0..WORKERS {
        let (corpus, counts, url) = (Arc::clone(&corpus), Arc::clone(&counts), url.to_owned());
        let mut rng = StdRng::seed_from_u64(seed.wrapping_add(worker as u64 * 0x9e37_79b9));
        workers.spawn(async move {
            let channel = Channel::from_shared(url)?.connect().await?;
            let mut client = Grpc::new(channel);
            while !is_over(&counts) {
                corpus.call(&mut client, &mut rng, &counts).await?;
            }
            anyhow::Ok(())
        });
    }
    let mut ticks = tokio::time::interval(Duration::from_secs(10));
    ticks.tick().await;
    loop {
        tokio::select! {
            ended = workers.join_next() => match ended {
                Some(ended) => ended??,
                None => break,
            },
            _ = ticks.tick() => progress(&report(&counts)),
        }
    }
    // It still answers.
    let client = emp_client::Client::connect(url).await?;
    let answer = within(
        "an answer",
        client.retarget("emp27", &fake::pose(0.1), true),
    )
    .await??;
    ensure!(answer.joint_angles.iter().all(|angle| angle.is_finite()));
    Ok(report(&counts))
}

/// Resident memory of this process, bytes; 0 where the system does not say.
fn resident() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find(|line| line.starts_with("VmRSS:"));
    let number = line.and_then(|line| line.split_whitespace().nth(1));
    number.and_then(|kib| kib.parse::<u64>().ok()).unwrap_or(0) << 10
}

/// Every call with valid messages for it.
struct Corpus {
    methods: Vec<(MethodDescriptor, PathAndQuery)>,
    /// Valid requests, by the full name of their message.
    requests: Vec<(String, Vec<DynamicMessage>)>,
}

impl Corpus {
    fn new() -> anyhow::Result<Self> {
        let pool = DescriptorPool::decode(FILE_DESCRIPTOR_SET)?;
        let services = pool
            .services()
            .filter(|service| service.full_name().starts_with("emp.v1."));
        let mut methods = Vec::new();
        for service in services {
            for method in service.methods() {
                let path = format!("/{}/{}", service.full_name(), method.name()).parse()?;
                methods.push((method, path));
            }
        }
        let mut corpus = Self {
            methods,
            requests: Vec::new(),
        };
        for (name, bytes) in valid()? {
            let descriptor = pool
                .get_message_by_name(&format!("emp.v1.{name}"))
                .with_context(|| format!("no message {name}"))?;
            let message = DynamicMessage::decode(descriptor, &bytes[..])?;
            match corpus.requests.iter_mut().find(|(known, _)| known == name) {
                Some((_, messages)) => messages.push(message),
                None => corpus.requests.push((name.to_owned(), vec![message])),
            }
        }
        Ok(corpus)
    }

    /// One request for a call: a valid one, often changed; a made-up one where none is known.
    fn request(&self, descriptor: &MessageDescriptor, rng: &mut StdRng) -> DynamicMessage {
        let known = self
            .requests
            .iter()
            .find(|(name, _)| name == descriptor.name())
            .and_then(|(_, messages)| messages.choose(rng));
        let mut message = match known {
            Some(message) => message.clone(),
            None => DynamicMessage::new(descriptor.clone()),
        };
        // Half of them stay as they are, so that streams get far.
        if rng.random_bool(0.5) {
            for _ in 0..rng.random_range(1..4) {
                mutate(&mut message, rng, 0);
            }
        }
        message
    }

    /// Makes one call, whichever.
    async fn call(
        &self,
        client: &mut Grpc<Channel>,
        rng: &mut StdRng,
        counts: &Counts,
    ) -> anyhow::Result<()> {
        let (method, path) = self.methods.choose(rng).context("no calls")?;
        // Loading weights over and over measures the disk.
        if method.name() == "Reload" && rng.random_bool(0.95) {
            return Ok(());
        }
        let count = match method.is_client_streaming() {
            true => rng.random_range(0..LONGEST_STREAM),
            false => 1,
        };
        let mut messages: Vec<Vec<u8>> = Vec::with_capacity(count);
        for index in 0..count {
            // A stream's first message is mostly its config, and the others mostly are not.
            let mut message = self.request(&method.input(), rng);
            if method.is_client_streaming() && rng.random_bool(0.9) {
                for _ in 0..16 {
                    if is_config(&message) == (index == 0) {
                        break;
                    }
                    message = self.request(&method.input(), rng);
                }
            }
            messages.push(message.encode_to_vec());
        }
        client.ready().await.context("the server is gone")?;
        counts.calls.fetch_add(1, Ordering::Relaxed);
        counts
            .sent
            .fetch_add(messages.len() as u64, Ordering::Relaxed);
        let (sender, outbound) = mpsc::channel(messages.len().max(1));
        for message in messages {
            sender.try_send(message).ok().context("room")?;
        }
        // Some never half-close, some are gone before the end.
        let half_closes = rng.random_bool(0.8);
        let goes_on = ENDLESS.contains(&method.name());
        let patience = match (half_closes && !goes_on, rng.random_bool(0.05)) {
            (_, true) => Duration::from_millis(2),
            (true, false) => PATIENCE,
            (false, false) => Duration::from_millis(15),
        };
        let kept = (!half_closes).then(|| sender.clone());
        drop(sender);
        let request = Request::new(ReceiverStream::new(outbound));
        let answers = client.streaming(request, path.clone(), raw::Bytes);
        let output = method.output();
        let reading = async {
            let mut stream = match answers.await {
                Ok(response) => response.into_inner(),
                Err(status) => return anyhow::Ok(Some(status)),
            };
            loop {
                match stream.message().await {
                    Ok(Some(bytes)) => {
                        counts.received.fetch_add(1, Ordering::Relaxed);
                        let answer = DynamicMessage::decode(output.clone(), &bytes[..])?;
                        check_finite(&answer, "")
                            .with_context(|| format!("{}: {answer}", method.full_name()))?;
                    }
                    Ok(None) => return Ok(None),
                    Err(status) => return Ok(Some(status)),
                }
            }
        };
        match tokio::time::timeout(patience, reading).await {
            Ok(ended) => {
                if let Some(status) = ended? {
                    counts.refused.fetch_add(1, Ordering::Relaxed);
                    ensure!(
                        !status.message().contains("panic") && !is_failure(&status),
                        "{}: {status:?}",
                        method.full_name()
                    );
                }
            }
            // It was not to end, or the client has gone.
            Err(_) if patience < PATIENCE => {}
            Err(_) => anyhow::bail!("{} hangs", method.full_name()),
        }
        drop(kept);
        Ok(())
    }
}

/// Whether a status says that the server failed, not the client.
fn is_failure(status: &tonic::Status) -> bool {
    use tonic_types::StatusExt as _;
    let reason = status.get_details_error_info().map(|info| info.reason);
    matches!(reason.as_deref(), Some("TASK_FAILED" | "MODEL_FAILED"))
}

fn is_config(message: &DynamicMessage) -> bool {
    message.has_field_by_name("config")
}

/// Refuses numbers that are not finite, but where the contract has them.
fn check_finite(message: &DynamicMessage, path: &str) -> anyhow::Result<()> {
    // An interval over one episode has no ends.
    if message.descriptor().name() == "Metric" {
        return Ok(());
    }
    for (field, value) in message.fields() {
        check_value(value, &format!("{path}.{}", field.name()))?;
    }
    Ok(())
}

fn check_value(value: &Value, path: &str) -> anyhow::Result<()> {
    match value {
        Value::F32(number) => ensure!(number.is_finite(), "{path} is {number}"),
        Value::F64(number) => ensure!(number.is_finite(), "{path} is {number}"),
        Value::Message(message) => check_finite(message, path)?,
        Value::List(values) => {
            for value in values {
                check_value(value, path)?;
            }
        }
        _ => {}
    }
    Ok(())
}

/// Changes one thing, somewhere in the message.
fn mutate(message: &mut DynamicMessage, rng: &mut StdRng, depth: usize) {
    let fields: Vec<FieldDescriptor> = message.descriptor().fields().collect();
    // Mostly a field that is there: deep in the message is where most of it is.
    let present: Vec<FieldDescriptor> = fields
        .iter()
        .filter(|field| message.has_field(field))
        .cloned()
        .collect();
    let pool = match present.is_empty() || rng.random_bool(0.2) {
        true => &fields,
        false => &present,
    };
    let Some(field) = pool.choose(rng).cloned() else {
        return;
    };
    if rng.random_bool(0.1) {
        message.clear_field(&field);
        return;
    }
    let mut value = message.get_field(&field).into_owned();
    match &mut value {
        Value::Message(inner) if depth < 8 => mutate(inner, rng, depth + 1),
        Value::List(values) => mutate_list(values, &field, rng, depth),
        Value::Map(_) => return,
        scalar => *scalar = extreme(&field.kind(), rng),
    }
    message.set_field(&field, value);
}

fn mutate_list(values: &mut Vec<Value>, field: &FieldDescriptor, rng: &mut StdRng, depth: usize) {
    let place = match values.len() {
        0 => 0,
        length => rng.random_range(0..length),
    };
    match (rng.random_range(0..5), values.get_mut(place)) {
        (0, _) => values.truncate(place),
        (1, Some(value)) => {
            let again = value.clone();
            values.extend(std::iter::repeat_n(again, rng.random_range(1..40)));
        }
        (2, Some(_)) => drop(values.remove(place)),
        (_, Some(Value::Message(inner))) if depth < 8 => mutate(inner, rng, depth + 1),
        (_, Some(value)) => *value = extreme(&field.kind(), rng),
        (_, None) => match field.kind() {
            Kind::Message(descriptor) => {
                values.push(Value::Message(DynamicMessage::new(descriptor)));
            }
            kind => values.push(extreme(&kind, rng)),
        },
    }
}

/// A value that nobody means.
fn extreme(kind: &Kind, rng: &mut StdRng) -> Value {
    let float = [
        0.0,
        -0.0,
        1.0,
        -1.0,
        0.5,
        1e-9,
        -1e-9,
        1e9,
        -1e9,
        3e38,
        -3e38,
        1e300,
        -1e300,
        f64::MIN_POSITIVE,
        f64::NAN,
        f64::INFINITY,
        f64::NEG_INFINITY,
        std::f64::consts::PI,
    ];
    let integer = [
        0,
        1,
        -1,
        2,
        3,
        7,
        15,
        16,
        100,
        255,
        256,
        65_535,
        1_000_000,
        i64::MAX,
        i64::MIN,
        i64::from(i32::MAX),
        i64::from(i32::MIN),
        i64::from(u32::MAX),
    ];
    let number = *float.choose(rng).unwrap_or(&0.0);
    let whole = *integer.choose(rng).unwrap_or(&0);
    match kind {
        Kind::Double => Value::F64(number),
        Kind::Float => Value::F32(number as f32),
        Kind::Int32 | Kind::Sint32 | Kind::Sfixed32 => Value::I32(whole as i32),
        Kind::Int64 | Kind::Sint64 | Kind::Sfixed64 => Value::I64(whole),
        Kind::Uint32 | Kind::Fixed32 => Value::U32(whole as u32),
        Kind::Uint64 | Kind::Fixed64 => Value::U64(whole as u64),
        Kind::Bool => Value::Bool(rng.random()),
        Kind::Enum(_) => Value::EnumNumber(whole as i32),
        Kind::String => Value::String(match rng.random_range(0..6) {
            0 => String::new(),
            1 => "x".repeat(rng.random_range(1..100_000)),
            2 => "emp27\n\0\u{202e}forged".to_owned(),
            3 => "nobody".to_owned(),
            4 => "../../../etc/passwd".to_owned(),
            _ => "emp27".to_owned(),
        }),
        Kind::Bytes => {
            let length = rng.random_range(0..4_096);
            Value::Bytes((0..length).map(|_| rng.random::<u8>()).collect())
        }
        Kind::Message(descriptor) => Value::Message(DynamicMessage::new(descriptor.clone())),
    }
}

/// Valid requests with the names of their messages, encoded.
fn valid() -> anyhow::Result<Vec<(&'static str, Vec<u8>)>> {
    let robot = emp27()?;
    let name = || robot.name().to_owned();
    let joint_positions: Vec<f32> = robot.joints().map(|joint| joint.default as f32).collect();
    let goal = joint_positions[..robot.goal_joints().len()].to_vec();
    let mut state = raw::state(&joint_positions, &nalgebra::UnitQuaternion::identity());
    state.joint_velocities = vec![0.0; joint_positions.len()];
    state.measurement_time = Duration::from_millis(20).try_into().ok();
    let state = || Some(state.clone());
    let pose = || Some(raw::pose(&fake::pose(0.2)));
    let header = || Some(raw::header(3));
    let observation = || v1::PolicyObservation {
        state: state(),
        goal: goal.clone(),
        last_action: Vec::new(),
    };
    let mut all = Vec::new();
    let mut add = |name: &'static str, bytes: Vec<u8>| all.push((name, bytes));
    add(
        "RetargetRequest",
        v1::RetargetRequest {
            header: header(),
            robot: name(),
            refine: true,
            pose: pose(),
            ..v1::RetargetRequest::default()
        }
        .encode_to_vec(),
    );
    add(
        "FilterGoalRequest",
        v1::FilterGoalRequest {
            robot: name(),
            history: vec![observation(); 3],
            start_heading: Some(0.1),
            last_applied: 0.5,
            ..v1::FilterGoalRequest::default()
        }
        .encode_to_vec(),
    );
    add(
        "StepPolicyRequest",
        v1::StepPolicyRequest {
            robot: name(),
            history: vec![observation(); 3],
            ..v1::StepPolicyRequest::default()
        }
        .encode_to_vec(),
    );
    {
        use v1::stream_retarget_request::Message;
        let config = v1::StreamRetargetConfig {
            robot: name(),
            refine: true,
            smoothing: true,
            ..v1::StreamRetargetConfig::default()
        };
        let frame = v1::RetargetFrame {
            header: header(),
            pose: pose(),
        };
        for message in [Message::Config(config), Message::Frame(frame)] {
            let message = Some(message);
            let request = v1::StreamRetargetRequest { message };
            add("StreamRetargetRequest", request.encode_to_vec());
        }
    }
    {
        use v1::stream_filter_goal_request::Message;
        let config = v1::StreamFilterGoalConfig {
            robot: name(),
            ..v1::StreamFilterGoalConfig::default()
        };
        let frame = v1::FilterGoalFrame {
            header: header(),
            state: state(),
            goal: goal.clone(),
            ..v1::FilterGoalFrame::default()
        };
        for message in [Message::Config(config), Message::Frame(frame)] {
            let message = Some(message);
            let request = v1::StreamFilterGoalRequest { message };
            add("StreamFilterGoalRequest", request.encode_to_vec());
        }
    }
    {
        use v1::stream_policy_request::Message;
        let config = v1::StreamPolicyConfig {
            robot: name(),
            ..v1::StreamPolicyConfig::default()
        };
        let frame = v1::PolicyFrame {
            header: header(),
            state: state(),
            goal: goal.clone(),
            reset: true,
        };
        for message in [Message::Config(config), Message::Frame(frame)] {
            let message = Some(message);
            let request = v1::StreamPolicyRequest { message };
            add("StreamPolicyRequest", request.encode_to_vec());
        }
    }
    {
        use v1::{teleoperate_config::Role, teleoperate_request::Message};
        let operator = || v1::OperatorFrame {
            header: header(),
            pose: pose(),
            recentre: true,
            ..v1::OperatorFrame::default()
        };
        let robot_frame = || v1::RobotFrame {
            header: header(),
            state: state(),
            reset: false,
        };
        let roles = [
            Role::Operator(v1::OperatorConfig::default()),
            Role::RobotEnd(v1::RobotConfig::default()),
            Role::Both(v1::BothConfig::default()),
            Role::Observer(v1::ObserverConfig {}),
        ];
        let configs = roles.map(|role| {
            Message::Config(v1::TeleoperateConfig {
                session: "lab".to_owned(),
                robot: name(),
                role: Some(role),
                ..v1::TeleoperateConfig::default()
            })
        });
        let frames = [
            Message::Operator(operator()),
            Message::Robot(robot_frame()),
            Message::Both(v1::BothFrame {
                robot: Some(robot_frame()),
                operator: Some(operator()),
            }),
        ];
        for message in configs.into_iter().chain(frames) {
            let message = Some(message);
            let request = v1::TeleoperateRequest { message };
            add("TeleoperateRequest", request.encode_to_vec());
        }
        let session = || "lab".to_owned();
        let observe = v1::ObserveRequest {
            session: session(),
            robot: name(),
        };
        add("ObserveRequest", observe.encode_to_vec());
        let control = v1::ControlRequest {
            session: session(),
            command: v1::ControlCommand::Pause.into(),
            caution: Some(0.5),
            emp_mode: Some(v1::EmpMode::On.into()),
            release: true,
            ..v1::ControlRequest::default()
        };
        add("ControlRequest", control.encode_to_vec());
        let get = v1::GetSessionRequest { name: session() };
        add("GetSessionRequest", get.encode_to_vec());
        let end = v1::EndSessionRequest { name: session() };
        add("EndSessionRequest", end.encode_to_vec());
    }
    add(
        "GetRobotRequest",
        v1::GetRobotRequest { name: name() }.encode_to_vec(),
    );
    let model = v1::GetModelRequest {
        name: "emp27-policy".to_owned(),
    };
    add("GetModelRequest", model.encode_to_vec());
    {
        use v1::start_evaluation_request::Message;
        let config = v1::EvaluationConfig {
            robot: name(),
            controller: Some(emp_client::controller("velocity-limit:limit=3")?),
            episodes: 1,
            hand_load: Some(v1::MassRange {
                least: 0.5,
                most: 1.0,
            }),
            push: Some(v1::Push {
                speed: 0.5,
                interval: 1.0,
            }),
            clip_frames: 60,
            ..v1::EvaluationConfig::default()
        };
        let clip = v1::MotionClip {
            name: "motion".to_owned(),
            fps: 50.0,
            poses: vec![raw::pose(&fake::pose(0.2)); 60],
        };
        let poses = v1::MotionPoses {
            poses: vec![raw::pose(&fake::pose(0.1)); 3],
        };
        for message in [
            Message::Config(config),
            Message::Clip(clip),
            Message::Poses(poses),
        ] {
            let message = Some(message);
            let request = v1::StartEvaluationRequest { message };
            add("StartEvaluationRequest", request.encode_to_vec());
        }
    }
    {
        use v1::collect_rollouts_request::Message;
        let range = |least, most| Some(v1::Range { least, most });
        let config = v1::CollectRolloutsConfig {
            robot: name(),
            environments: 2,
            environment: Some(v1::EnvironmentSettings {
                randomization: Some(v1::EnvironmentRandomization {
                    friction: range(0.5, 1.5),
                    link_mass: range(0.9, 1.1),
                    p_gain: range(0.9, 1.1),
                    push: Some(v1::TrainingPush {
                        interval: 1.0,
                        linear: 0.5,
                        angular: 0.5,
                    }),
                    ..v1::EnvironmentRandomization::default()
                }),
                episode_frames: Some(5),
                ..v1::EnvironmentSettings::default()
            }),
            clips: 1,
            ..v1::CollectRolloutsConfig::default()
        };
        let clip = v1::GoalClip {
            name: "clip".to_owned(),
            goals: goal.repeat(20),
            ..v1::GoalClip::default()
        };
        let collect = v1::CollectRequest {
            iteration: 1,
            log_standard_deviation: vec![-1.0; robot.leg_joints().len()],
            horizon: 2,
            randomization: 1.0,
            difficulty: 1.0,
        };
        let part = v1::PolicyPart {
            data: vec![1, 2, 3],
            last: true,
        };
        for message in [
            Message::Config(config),
            Message::Clip(clip),
            Message::Collect(collect),
            Message::Policy(part),
            Message::TakeSnapshot(v1::SnapshotRequest {}),
        ] {
            let message = Some(message);
            let request = v1::CollectRolloutsRequest { message };
            add("CollectRolloutsRequest", request.encode_to_vec());
        }
    }
    Ok(all)
}
