//! Benchmarks of the models: the linear op against candle's own matrix multiply, packed inference, the kinematics op against the same maths
//! composed of candle ops, and the retargeter by batch size. Ratios within one run are what counts.

use std::{hint::black_box, path::Path, sync::Arc};

use candle_core::{D, DType, Device, Tensor, Var};
use candle_nn::{Module as _, VarBuilder, VarMap};
use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use emp_models::{
    emp::{EmpConfig, EmpNetwork},
    kinematics::ForwardKinematics,
    linear::{self, Linear},
    mlp::Normalizer,
    policy::Policy,
    retarget::{Effort, Mode, RetargetInput, Retargeter, Solver, Target},
};
use emp_motion::skills;
use emp_robot::Robot;

fn root() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
}

fn emp27() -> Arc<Robot> {
    Arc::new(Robot::load(&root().join("robots/emp27")).expect("robots/emp27 loads"))
}

/// The layers of an EMP-sized network: 11.9 M parameters.
const EMP_LAYERS: [&[usize]; 4] = [
    &[855, 1024, 1024, 64],
    &[15, 1024, 1024, 64],
    &[128, 2048, 2048, 32],
    &[32, 2048, 2048, 15],
];

enum Layer {
    Ours(Linear),
    Candles(candle_nn::Linear),
}

impl Layer {
    fn forward(&self, x: &Tensor) -> candle_core::Result<Tensor> {
        match self {
            Self::Ours(layer) => layer.forward(x),
            Self::Candles(layer) => layer.forward(x),
        }
    }
}

struct Mlps {
    mlps: Vec<Vec<Layer>>,
    vars: VarMap,
}

impl Mlps {
    fn new(ours: bool) -> candle_core::Result<Self> {
        let vars = VarMap::new();
        let builder = VarBuilder::from_varmap(&vars, DType::F32, &Device::Cpu);
        let layer = |name: String, widths: &[usize]| {
            let builder = builder.pp(name);
            Ok(if ours {
                Layer::Ours(Linear::new(widths[0], widths[1], &builder)?)
            } else {
                Layer::Candles(candle_nn::linear(widths[0], widths[1], builder)?)
            })
        };
        let mlps = EMP_LAYERS.iter().enumerate().map(|(m, widths)| {
            widths
                .windows(2)
                .enumerate()
                .map(|(l, widths)| layer(format!("{m}.{l}"), widths))
                .collect()
        });
        Ok(Self {
            mlps: mlps.collect::<candle_core::Result<_>>()?,
            vars,
        })
    }

    /// The layers alone: activations are the same ops on either side.
    fn forward(&self, state: &Tensor, goal: &Tensor) -> candle_core::Result<Tensor> {
        let run = |mlp: &[Layer], x: &Tensor| {
            mlp.iter().try_fold(x.clone(), |x, layer| layer.forward(&x))
        };
        let latent = Tensor::cat(
            &[run(&self.mlps[0], state)?, run(&self.mlps[1], goal)?],
            D::Minus1,
        )?;
        run(&self.mlps[3], &run(&self.mlps[2], &latent.contiguous()?)?)
    }
}

/// An EMP-sized network, forward and forward + backward, on our linear op and on candle's.
fn linear_op(c: &mut Criterion) {
    let networks = [("ours", Mlps::new(true)), ("candle", Mlps::new(false))];
    for threads in [1, 2] {
        linear::set_threads(threads);
        let mut group = c.benchmark_group(format!("emp_sized_forward_{threads}_threads"));
        for batch in [1, 8, 32, 128] {
            let state = Tensor::randn(0f32, 1.0, (batch, 855), &Device::Cpu).expect("a tensor");
            let goal = Tensor::randn(0f32, 1.0, (batch, 15), &Device::Cpu).expect("a tensor");
            for (name, network) in &networks {
                let network = network.as_ref().expect("the network");
                group.bench_function(BenchmarkId::new(*name, batch), |b| {
                    b.iter(|| black_box(network.forward(&state, &goal).expect("forward")));
                });
            }
        }
        group.finish();
    }
    let mut group = c.benchmark_group("emp_sized_training_step_2_threads");
    let state = Tensor::randn(0f32, 1.0, (256, 855), &Device::Cpu).expect("a tensor");
    let goal = Tensor::randn(0f32, 1.0, (256, 15), &Device::Cpu).expect("a tensor");
    for (name, network) in &networks {
        let network = network.as_ref().expect("the network");
        assert!(!network.vars.all_vars().is_empty());
        group.bench_function(*name, |b| {
            b.iter(|| {
                let loss = network
                    .forward(&state, &goal)
                    .and_then(|y| y.sqr()?.mean_all());
                black_box(loss.and_then(|loss| loss.backward()).expect("backward"))
            });
        });
    }
    group.finish();
    linear::set_threads(1);
}

/// An EMP of the paper's size: packed as f32 and as f16, and through candle's tensors; the shipped policy beside it.
fn inference(c: &mut Criterion) {
    let robot = emp27();
    let config = EmpConfig::paper(&robot);
    let vars = VarMap::new();
    let builder = VarBuilder::from_varmap(&vars, DType::F32, &Device::Cpu);
    let normalizer = Normalizer::identity(config.features());
    let network = EmpNetwork::new(config.clone(), normalizer.clone(), &builder);
    let network = network.expect("a network");
    let single = network.pack().expect("the network packs");
    for var in vars.all_vars() {
        let rounded = var
            .to_dtype(DType::F16)
            .and_then(|x| x.to_dtype(DType::F32));
        var.set(&rounded.expect("a conversion")).expect("its shape");
    }
    let half = network.pack().expect("the network packs");
    let weights = root().join("models/weights/emp27-policy.safetensors");
    let policy = Policy::load(&weights, robot).expect("the shipped weights load");
    for threads in [1, 2] {
        linear::set_threads(threads);
        let mut group = c.benchmark_group(format!("emp_inference_{threads}_threads"));
        group.measurement_time(std::time::Duration::from_secs(2));
        for batch in [1, 4, 8, 16, 32, 64] {
            let numbers = |width: usize| -> Vec<f32> {
                (0..batch * width)
                    .map(|i| (i as f32 * 0.37).sin())
                    .collect()
            };
            let (features, goals) = (
                numbers(config.features()),
                numbers(config.observation.goal().len()),
            );
            let tensor = |numbers: &[f32]| {
                let shape = (batch, numbers.len() / batch);
                Tensor::from_slice(numbers, shape, &Device::Cpu).expect("a tensor")
            };
            let tensors = [tensor(&features), tensor(&goals)];
            for (name, packed) in [("packed f32", &single), ("packed f16", &half)] {
                group.bench_function(BenchmarkId::new(name, batch), |b| {
                    b.iter(|| black_box(packed.forward(&features, &goals).expect("an answer")));
                });
            }
            group.bench_function(BenchmarkId::new("tensors", batch), |b| {
                b.iter(|| black_box(network.forward_features(&tensors[0], &tensors[1])));
            });
            let stacks = numbers(policy.layout().width());
            let tensor = tensor(&stacks);
            group.bench_function(BenchmarkId::new("policy, packed", batch), |b| {
                b.iter(|| black_box(policy.actions(&stacks).expect("actions")));
            });
            group.bench_function(BenchmarkId::new("policy, tensors", batch), |b| {
                b.iter(|| black_box(policy.forward(&tensor).expect("actions")));
            });
        }
        group.finish();
    }
    linear::set_threads(1);
}

/// Positions and rotations along the goal joints' chain, composed of candle ops: what the custom op replaces, without its
/// link centres and centre of mass.
fn composed(robot: &Robot, q: &Tensor) -> candle_core::Result<Tensor> {
    let batch = q.dim(0)?;
    let device = q.device();
    let constant = |values: Vec<f64>, shape: (usize, usize)| {
        Tensor::from_vec(values, shape, device)?.to_dtype(q.dtype())
    };
    let mut frames: Vec<(Tensor, Tensor)> = Vec::new();
    for (joint, node) in robot.goal_tree().iter().enumerate() {
        let [x, y, z] = node.axis;
        let cross = constant(vec![0.0, -z, y, z, 0.0, -x, -y, x, 0.0], (3, 3))?;
        let identity = constant(vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], (3, 3))?;
        let angle = q.narrow(1, joint, 1)?.unsqueeze(2)?;
        let turned = angle.sin()?.broadcast_mul(&cross)?;
        let squared = (1.0 - angle.cos()?)?.broadcast_mul(&cross.matmul(&cross)?)?;
        let rotation = (turned + squared)?.broadcast_add(&identity)?;
        let offset = constant(node.origin_xyz.to_vec(), (3, 1))?
            .unsqueeze(0)?
            .expand((batch, 3, 1))?
            .contiguous()?;
        let [roll, pitch, yaw] = node.origin_rpy;
        let origin = nalgebra::Rotation3::from_euler_angles(roll, pitch, yaw)
            .matrix()
            .transpose();
        let origin = constant(origin.as_slice().to_vec(), (3, 3))?
            .unsqueeze(0)?
            .expand((batch, 3, 3))?
            .contiguous()?;
        let local = origin.matmul(&rotation)?;
        frames.push(match node.parent {
            None => (local, offset),
            Some(parent) => {
                let (rotation, position) = &frames[parent];
                (
                    rotation.matmul(&local)?,
                    (position + rotation.matmul(&offset)?)?,
                )
            }
        });
    }
    let positions: Vec<Tensor> = frames.into_iter().map(|(_, position)| position).collect();
    Tensor::cat(&positions, 1)
}

/// 1,024 poses, forward and backward: the custom op (all outputs) against candle ops (joint origins only).
fn kinematics_op(c: &mut Criterion) {
    const POSES: usize = 1024;
    let robot = emp27();
    let op = ForwardKinematics::new(robot.clone());
    let q = Tensor::rand(-1f32, 1.0, (POSES, robot.goal_joints().len()), &Device::Cpu)
        .and_then(|q| Var::from_tensor(&q));
    let q = q.expect("a tensor");
    let mut group = c.benchmark_group("kinematics_1024_poses_forward_backward");
    group.throughput(Throughput::Elements(POSES as u64));
    group.bench_function("custom op", |b| {
        b.iter(|| {
            black_box(
                op.forward_goal(&q)
                    .and_then(|y| y.sum_all()?.backward())
                    .expect("backward"),
            )
        });
    });
    group.bench_function("candle ops", |b| {
        b.iter(|| {
            black_box(
                composed(&robot, &q)
                    .and_then(|y| y.sum_all()?.backward())
                    .expect("backward"),
            )
        });
    });
    group.finish();
}

/// The retargeter by batch size with and without refinement, and converged inverse kinematics from the last answer.
fn retargeter(c: &mut Criterion) {
    let robot = emp27();
    let weights = root().join("models/weights/emp27-retargeter.safetensors");
    let retargeter = Retargeter::load(&weights, robot.clone()).expect("the shipped weights load");
    let frames = skills::medley(1)
        .resampled(50.0)
        .expect("an ordinary rate")
        .frames;
    let mut group = c.benchmark_group("retargeter");
    for batch in [1, 4, 16, 64, 256] {
        group.throughput(Throughput::Elements(batch as u64));
        for refine in [false, true] {
            let inputs: Vec<RetargetInput> = frames
                .iter()
                .step_by(5)
                .cycle()
                .take(batch)
                .map(|frame| RetargetInput {
                    frame: frame.clone(),
                    mode: if refine { Mode::Begin } else { Mode::Network },
                })
                .collect();
            let name = if refine {
                "network + refine"
            } else {
                "network"
            };
            group.bench_function(BenchmarkId::new(name, batch), |b| {
                b.iter(|| black_box(retargeter.retarget(&inputs).expect("answers")));
            });
        }
    }
    group.throughput(Throughput::Elements(frames.len() as u64));
    group.sample_size(10);
    group.bench_function("converged IK, medley", |b| {
        b.iter(|| {
            let mut solver = Solver::new(&robot);
            let mut angles: Vec<f64> = robot
                .goal_joints()
                .iter()
                .map(|joint| joint.default)
                .collect();
            for frame in &frames {
                solver.minimise(&Target::new(frame), &mut angles, Effort::CONVERGE);
            }
            black_box(angles)
        });
    });
    group.finish();
}

criterion_group!(benches, linear_op, inference, kinematics_op, retargeter);
criterion_main!(benches);
