//! Filtered goals under load, client and server on one machine, over TCP: calls a second from many clients beside those of
//! Python's grpcio with ONNX Runtime, and the round trip of a robot's whole path.
//!
//!     cargo bench -p emp-tests --bench filter -- --python venv/bin/python
//!     cargo bench -p emp-tests --bench filter -- --path
//!
//! Without `--python` (see `filter_reference.py` for what it needs) only our server is measured. With `--path` only the path is:
//! run the benchmark's binary under `taskset -c 0` for one core.

use std::{
    io::{BufRead as _, BufReader},
    net::TcpListener,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    sync::Arc,
    time::{Duration, Instant},
};

use anyhow::Context as _;
use emp_client::{Client, EmpMode, FilterConfig, GoalFrame, GoalHistory};
use emp_models::{
    emp::{Emp, EmpConfig},
    observation::{History, RobotState},
};
use emp_robot::Robot;
use emp_tests::{
    TestServer, emp, emp27,
    load::{self, RATE, at},
    raw,
};
use nalgebra::UnitQuaternion;
use tonic::{client::Grpc, transport::Endpoint};

const ROBOT: &str = "emp27";
const CLIENTS: usize = 8;
/// Rounds in which both servers are measured, one after the other.
const ROUNDS: usize = 5;
/// How long a server is asked in a round, and how long before without counting.
const ROUND: [Duration; 2] = [Duration::from_secs(3), Duration::from_millis(500)];
/// Largest difference between the two servers' answers, rad.
const TOLERANCE: f32 = 1e-3;

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().collect();
    // `cargo test --benches` only asks whether the benchmark runs.
    let is_smoke = !arguments.iter().any(|argument| argument == "--bench");
    let python = arguments.iter().position(|argument| argument == "--python");
    let python = python.and_then(|flag| arguments.get(flag + 1));
    let robot = emp27()?;
    let config = if is_smoke {
        emp::small(&robot, 0.2)
    } else {
        EmpConfig::paper(&robot)
    };
    let weights = emp::weights(&config)?;
    let server = TestServer::start_with(weights.path(), |_| {})?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()?;
    let calls = Arc::new(Calls::new(&robot)?);
    if is_smoke {
        let served =
            runtime.block_on(ours(&server.url(), &calls, [Duration::from_millis(50); 2]))?;
        anyhow::ensure!(served.rate > 0.0, "no call was answered");
        return Ok(());
    }
    if !arguments.iter().any(|argument| argument == "--path") {
        let reference = python.map(|python| Reference::start(python, &emp::file(&weights)));
        let reference = reference.transpose()?;
        if let Some(reference) = &reference {
            let emp = emp::load(&weights)?;
            runtime.block_on(check(reference, &emp, &calls))?;
        }
        runtime.block_on(compare(&server, reference.as_ref(), &calls))?;
    }
    for mode in [EmpMode::Off, EmpMode::On] {
        runtime.block_on(teleoperate(&server, mode))?;
    }
    Ok(())
}

/// The same question for both servers.
struct Calls {
    robot: Arc<Robot>,
    /// A full history of a robot whose arms swing.
    frames: Vec<GoalFrame>,
    /// The stack of that history and its newest goal.
    numbers: Vec<f32>,
}

impl Calls {
    fn new(robot: &Arc<Robot>) -> anyhow::Result<Self> {
        let layout = EmpConfig::paper(robot).observation;
        let mut history = History::new(layout);
        let frames: Vec<GoalFrame> = (0..layout.history()).map(|t| frame(robot, t)).collect();
        for frame in &frames {
            let state = RobotState {
                joint_positions: &frame.joint_positions,
                orientation: frame.orientation,
            };
            history.push(&state, &frame.goal);
        }
        let newest = frames.last().context("a history")?;
        let numbers = [history.stack(), &newest.goal].concat();
        Ok(Self {
            robot: Arc::clone(robot),
            frames,
            numbers,
        })
    }
}

fn frame(robot: &Robot, t: usize) -> GoalFrame {
    let swing = 0.2 * (0.1 * t as f32).sin();
    let positions = robot.joints().map(|joint| joint.default as f32);
    let goals = robot.goal_joints().iter();
    GoalFrame {
        joint_positions: positions.collect(),
        orientation: UnitQuaternion::identity(),
        goal: goals.map(|joint| joint.default as f32 + swing).collect(),
        last_action: Vec::new(),
        reset: false,
    }
}

/// What a server did in a round.
struct Served {
    /// Calls a second, all clients together.
    rate: f64,
    /// Latencies in order.
    latencies: Vec<Duration>,
}

impl Served {
    fn new(length: Duration, mut latencies: Vec<Duration>) -> Self {
        latencies.sort_unstable();
        Self {
            rate: latencies.len() as f64 / length.as_secs_f64(),
            latencies,
        }
    }
}

/// Asks our server from [`CLIENTS`] connections, each as soon as it has its answer.
async fn ours(
    url: &str,
    calls: &Arc<Calls>,
    [length, warm_up]: [Duration; 2],
) -> anyhow::Result<Served> {
    let start = Instant::now() + warm_up;
    let mut clients = Vec::new();
    for _ in 0..CLIENTS {
        let (client, calls) = (Client::connect(url).await?, Arc::clone(calls));
        clients.push(tokio::spawn(async move {
            let config = FilterConfig::for_robot(ROBOT);
            let mut times = Vec::new();
            while Instant::now() < start + length {
                let asked = Instant::now();
                let history = GoalHistory {
                    frames: &calls.frames,
                    start_heading: None,
                    last_applied: 0.0,
                };
                client.filter_goal(&config, history).await?;
                times.extend((asked >= start).then(|| asked.elapsed()));
            }
            anyhow::Ok(times)
        }));
    }
    collect(length, clients).await
}

/// As [`ours`], the reference.
async fn theirs(
    url: &str,
    calls: &Arc<Calls>,
    [length, warm_up]: [Duration; 2],
) -> anyhow::Result<Served> {
    let start = Instant::now() + warm_up;
    let mut clients = Vec::new();
    for _ in 0..CLIENTS {
        let (mut client, calls) = (RawClient::connect(url).await?, Arc::clone(calls));
        clients.push(tokio::spawn(async move {
            let mut times = Vec::new();
            while Instant::now() < start + length {
                let asked = Instant::now();
                client.filter(&calls.numbers).await?;
                times.extend((asked >= start).then(|| asked.elapsed()));
            }
            anyhow::Ok(times)
        }));
    }
    collect(length, clients).await
}

async fn collect(
    length: Duration,
    clients: Vec<tokio::task::JoinHandle<anyhow::Result<Vec<Duration>>>>,
) -> anyhow::Result<Served> {
    let mut latencies = Vec::new();
    for client in clients {
        latencies.extend(client.await??);
    }
    Ok(Served::new(length, latencies))
}

async fn compare(
    server: &TestServer,
    reference: Option<&Reference>,
    calls: &Arc<Calls>,
) -> anyhow::Result<()> {
    let (mut ratios, mut rates) = (Vec::new(), [Vec::new(), Vec::new()]);
    for round in 1..=ROUNDS {
        let served = ours(&server.url(), calls, ROUND).await?;
        report(round, "emp-server", &served);
        rates[0].push(served.rate);
        if let Some(reference) = reference {
            let other = theirs(&reference.url, calls, ROUND).await?;
            report(round, "grpcio + ONNX Runtime", &other);
            ratios.push(served.rate / other.rate);
            rates[1].push(other.rate);
        }
    }
    let [ours, theirs] = rates.map(median);
    println!(
        "{CLIENTS} clients, medians: emp-server {ours:.0} calls/s, grpcio + ONNX Runtime {theirs:.0}, ratio {:.2}",
        median(ratios)
    );
    Ok(())
}

fn report(round: usize, what: &str, served: &Served) {
    println!(
        "round {round}, {what}: {:.0} calls/s, p50 {:.2} ms, p99 {:.2} ms",
        served.rate,
        at(&served.latencies, 0.5),
        at(&served.latencies, 0.99),
    );
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

/// Both servers must compute the same network.
async fn check(reference: &Reference, emp: &Emp, calls: &Calls) -> anyhow::Result<()> {
    let mut client = RawClient::connect(&reference.url).await?;
    let theirs = client.filter(&calls.numbers).await?;
    let stack = &calls.numbers[..emp.config().observation.width()];
    let ours = &emp.answer(stack)?[0].goal;
    for ((joint, ours), theirs) in calls.robot.goal_joints().iter().zip(ours).zip(theirs) {
        let theirs = joint.clamp(theirs);
        anyhow::ensure!(
            (ours - theirs).abs() < TOLERANCE,
            "{}: {ours} rad here, {theirs} rad there",
            joint.name
        );
    }
    Ok(())
}

/// The Python server; it ends with this.
struct Reference {
    process: Child,
    url: String,
}

impl Reference {
    fn start(python: &str, weights: &Path) -> anyhow::Result<Self> {
        let port = TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
        let script = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("benches/filter_reference.py");
        let mut process = Command::new(python)
            .arg(script)
            .arg(weights)
            .arg(port.to_string())
            .stdout(Stdio::piped())
            .spawn()
            .with_context(|| format!("start {python}"))?;
        let output = process.stdout.take().context("its output")?;
        let mut line = String::new();
        BufReader::new(output).read_line(&mut line)?;
        anyhow::ensure!(line.trim() == "ready", "the reference did not start");
        let url = format!("http://127.0.0.1:{port}");
        Ok(Self { process, url })
    }
}

impl Drop for Reference {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// A client of the reference.
struct RawClient(Grpc<tonic::transport::Channel>);

impl RawClient {
    async fn connect(url: &str) -> anyhow::Result<Self> {
        let endpoint = Endpoint::from_shared(url.to_owned())?.tcp_nodelay(true);
        Ok(Self(Grpc::new(endpoint.connect().await?)))
    }

    async fn filter(&mut self, numbers: &[f32]) -> anyhow::Result<Vec<f32>> {
        self.0.ready().await?;
        let bytes = numbers.iter().flat_map(|number| number.to_le_bytes());
        let request = tonic::Request::new(bytes.collect::<Vec<u8>>());
        let path = "/reference/Filter".parse()?;
        let answer = self.0.unary(request, path, raw::Bytes).await?.into_inner();
        let (numbers, _) = answer.as_chunks::<4>();
        Ok(numbers
            .iter()
            .map(|bytes| f32::from_le_bytes(*bytes))
            .collect())
    }
}

/// The round trips of a robot's whole path.
async fn teleoperate(server: &TestServer, mode: EmpMode) -> anyhow::Result<()> {
    let client = Client::connect(&server.url()).await?;
    let times = load::teleoperate(&client, mode).await?;
    println!(
        "a robot at {RATE} Hz (retarget, refined; EMP {mode:?}; policy): p50 {:.2} ms, p99 {:.2} ms, longest {:.2} ms",
        at(&times, 0.5),
        at(&times, 0.99),
        at(&times, 1.0),
    );
    Ok(())
}
