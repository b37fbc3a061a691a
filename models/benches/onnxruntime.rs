//! EMP inference against ONNX Runtime on the same network in the same run: rounds of both in turn.
//!
//! ```text
//! python -m venv venv && venv/bin/pip install numpy onnx onnxruntime
//! EMP_BENCH_PYTHON=venv/bin/python cargo bench -p emp-models --bench onnxruntime
//! ```
//!
//! The network has the paper's size; ONNX Runtime gets the weights of the f32 column. Prints medians of rounds, each the
//! median of some calls, and medians of the rounds' ratios (above 1: we are faster).

use std::{
    io::{BufRead as _, BufReader, Write as _},
    path::Path,
    process::{Child, ChildStdin, ChildStdout, Command, Stdio},
    sync::Arc,
    time::{Duration, Instant},
};

use candle_core::{DType, Device, Tensor};
use candle_nn::{VarBuilder, VarMap};
use emp_models::{
    emp::{EmpConfig, EmpNetwork, PackedNetwork},
    linear,
    mlp::Normalizer,
};
use emp_robot::Robot;

/// Rounds of each kind.
const ROUNDS: usize = 15;
/// Calls of a round.
const RUNS: usize = 10;
/// Between rounds, so that one side's threads no longer wait by spinning when the other's start.
const PAUSE: Duration = Duration::from_millis(20);

fn main() {
    let Ok(python) = std::env::var("EMP_BENCH_PYTHON") else {
        println!("skipped: EMP_BENCH_PYTHON names no Python with numpy, onnx and onnxruntime");
        return;
    };
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/emp27");
    let robot = Arc::new(Robot::load(&folder).expect("robots/emp27 loads"));
    let config = EmpConfig::paper(&robot);
    let network = network(&config);
    let scratch = tempfile::tempdir().expect("a temporary folder");
    let weights = scratch.path().join("weights.f32");
    std::fs::write(&weights, numbers(&network, &config)).expect("a writable file");
    let Some(mut theirs) = OnnxRuntime::start(&python, &weights, &config) else {
        println!("skipped: {python} has no numpy, onnx and onnxruntime");
        return;
    };
    println!(
        "ONNX Runtime {}; ms, medians of {ROUNDS} rounds",
        theirs.version
    );
    println!(
        "| threads | batch | ONNX Runtime f32 | packed f32 | ratio | packed f16 | ratio | tensors f32 | ratio |"
    );
    println!("|---|---|---|---|---|---|---|---|---|");
    let ours = Ours {
        single: network.pack().expect("the network packs"),
        half: halved(&network, &config).pack().expect("the network packs"),
        tensors: network,
        config,
    };
    for threads in [1, 2] {
        linear::set_threads(threads);
        for batch in [1, 4, 8, 16, 32, 64] {
            compare(&ours, &mut theirs, threads, batch);
        }
    }
}

/// A network of `config`'s shape with random weights.
fn network(config: &EmpConfig) -> EmpNetwork {
    let vars = VarMap::new();
    let builder = VarBuilder::from_varmap(&vars, DType::F32, &Device::Cpu);
    let normalizer = Normalizer::identity(config.features());
    EmpNetwork::new(config.clone(), normalizer, &builder).expect("a network")
}

/// The same network with weights that f16 holds exactly.
fn halved(network: &EmpNetwork, config: &EmpConfig) -> EmpNetwork {
    let round = |tensor: &Tensor| tensor.to_dtype(DType::F16)?.to_dtype(DType::F32);
    let tensors = network.tensors().into_iter();
    let tensors = tensors.map(|(name, tensor)| (name, round(&tensor).expect("a conversion")));
    let builder = VarBuilder::from_tensors(tensors.collect(), DType::F32, &Device::Cpu);
    let normalizer = Normalizer::identity(config.features());
    EmpNetwork::new(config.clone(), normalizer, &builder).expect("a network")
}

/// The widths of the four MLPs.
fn widths(config: &EmpConfig) -> [(&'static str, Vec<usize>); 4] {
    let goals = config.observation.goal().len();
    let widths = |inputs, hidden: &[usize], outputs| [&[inputs], hidden, &[outputs]].concat();
    let (encoding, latent) = (config.encoding, config.latent);
    [
        (
            "state",
            widths(config.features(), &config.state_hidden, encoding),
        ),
        ("target", widths(goals, &config.target_hidden, encoding)),
        (
            "fusion",
            widths(2 * encoding, &config.fusion_hidden, latent),
        ),
        ("decoder", widths(latent, &config.decoder_hidden, goals)),
    ]
}

/// The network's numbers in the order that `reference.py` reads.
fn numbers(network: &EmpNetwork, config: &EmpConfig) -> Vec<u8> {
    let tensors = network.tensors();
    let mut bytes = Vec::new();
    for (name, widths) in widths(config) {
        for layer in 0..widths.len() - 1 {
            for part in ["weight", "bias"] {
                let tensor = tensors[&format!("{name}.{layer}.{part}")].flatten_all();
                let numbers = tensor.and_then(|tensor| tensor.to_vec1::<f32>());
                bytes.extend(numbers.expect("f32").into_iter().flat_map(f32::to_le_bytes));
            }
        }
    }
    bytes
}

/// The child that runs ONNX Runtime.
struct OnnxRuntime {
    child: Child,
    requests: Option<ChildStdin>,
    answers: BufReader<ChildStdout>,
    version: String,
}

impl OnnxRuntime {
    /// `None` where `python` lacks a package.
    fn start(python: &str, weights: &Path, config: &EmpConfig) -> Option<Self> {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/reference.py");
        let widths: Vec<Vec<usize>> = widths(config).map(|(_, widths)| widths).to_vec();
        let mut child = Command::new(python)
            .arg(script)
            .arg(weights)
            .arg(format!("{widths:?}"))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .ok()?;
        let requests = child.stdin.take();
        let mut answers = BufReader::new(child.stdout.take()?);
        let mut line = String::new();
        answers.read_line(&mut line).ok()?;
        let version = line.trim().strip_prefix("ready ")?.to_owned();
        Some(Self {
            child,
            requests,
            answers,
            version,
        })
    }

    /// Seconds a call, and the answer's first row.
    fn run(&mut self, threads: usize, batch: usize) -> (f64, Vec<f64>) {
        let requests = self.requests.as_mut().expect("an open pipe");
        writeln!(requests, "{threads} {batch} {RUNS}").expect("a live child");
        let mut line = String::new();
        self.answers.read_line(&mut line).expect("a live child");
        let answer: serde_json::Value = serde_json::from_str(&line).expect("JSON");
        let row = answer["answer"].as_array().expect("an array");
        let row = row.iter().map(|number| number.as_f64().expect("a number"));
        (answer["seconds"].as_f64().expect("a number"), row.collect())
    }
}

impl Drop for OnnxRuntime {
    /// The child ends with its input.
    fn drop(&mut self) {
        self.requests.take();
        self.child.wait().ok();
    }
}

struct Ours {
    single: PackedNetwork,
    half: PackedNetwork,
    tensors: EmpNetwork,
    config: EmpConfig,
}

/// Rounds of all kinds in turn, one row of the table.
fn compare(ours: &Ours, theirs: &mut OnnxRuntime, threads: usize, batch: usize) {
    let goal_width = ours.config.observation.goal().len();
    let features = inputs(batch * ours.config.features());
    let goals = inputs(batch * goal_width);
    let tensor = |numbers: &[f32]| {
        let shape = (batch, numbers.len() / batch);
        Tensor::from_slice(numbers, shape, &Device::Cpu).expect("a tensor")
    };
    let tensors = [tensor(&features), tensor(&goals)];
    let mut times: [Vec<f64>; 4] = Default::default();
    for _ in 0..ROUNDS {
        let (seconds, expected) = theirs.run(threads, batch);
        times[0].push(seconds);
        std::thread::sleep(PAUSE);
        let answer = ours.single.forward(&features, &goals).expect("an answer").0;
        for (a, b) in answer.iter().zip(&expected) {
            assert!((f64::from(*a) - b).abs() < 1e-4, "{a}, ONNX Runtime {b}");
        }
        times[1].push(round(|| drop(ours.single.forward(&features, &goals))));
        times[2].push(round(|| drop(ours.half.forward(&features, &goals))));
        times[3].push(round(|| {
            drop(ours.tensors.forward_features(&tensors[0], &tensors[1]));
        }));
        std::thread::sleep(PAUSE);
    }
    print!(
        "| {threads} | {batch} | {:.2}",
        1e3 * median(times[0].iter().copied())
    );
    for kind in &times[1..] {
        let ratios = times[0]
            .iter()
            .zip(kind)
            .map(|(theirs, ours)| theirs / ours);
        let time = 1e3 * median(kind.iter().copied());
        print!(" | {time:.2} | {:.2}", median(ratios));
    }
    println!(" |");
}

/// What `reference.py` feeds.
fn inputs(count: usize) -> Vec<f32> {
    (0..count).map(|i| (i as f64 * 0.37).sin() as f32).collect()
}

/// Seconds a call, the median of [`RUNS`].
fn round(mut call: impl FnMut()) -> f64 {
    let times = (0..RUNS).map(|_| {
        let start = Instant::now();
        call();
        start.elapsed().as_secs_f64()
    });
    median(times)
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}
