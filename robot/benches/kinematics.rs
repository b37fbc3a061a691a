//! Forward and reverse pass over 1,024 poses of emp27, in both precisions, on one thread.

use std::hint::black_box;
use std::path::Path;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use emp_robot::{Real, Robot};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const POSES: usize = 1024;

fn passes<T: Real>(criterion: &mut Criterion, robot: &Robot, precision: &str, to: fn(f64) -> T) {
    let kinematics = robot.kinematics();
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    let q: Vec<T> = (0..POSES)
        .flat_map(|_| robot.joints())
        .map(|joint| to(rng.random_range(joint.range[0]..=joint.range[1])))
        .collect();
    let width = POSES * kinematics.output_width();
    let mut out = vec![to(0.0); width];
    let grad_out: Vec<T> = (0..width)
        .map(|_| to(rng.random_range(-1.0..=1.0)))
        .collect();
    let mut grad_q = q.clone();

    let mut group = criterion.benchmark_group("kinematics");
    group.throughput(Throughput::Elements(POSES as u64));
    group.bench_function(BenchmarkId::new("forward", precision), |bencher| {
        bencher.iter(|| kinematics.forward(black_box(&q), black_box(&mut out)));
    });
    group.bench_function(BenchmarkId::new("backward", precision), |bencher| {
        bencher.iter(|| {
            kinematics.backward(black_box(&q), black_box(&grad_out), black_box(&mut grad_q));
        });
    });
    group.finish();
}

/// One pose at a time, as inverse kinematics goes.
fn frame(criterion: &mut Criterion, robot: &Robot) {
    let mut frame = robot.kinematics().frame();
    let q: Vec<f64> = robot
        .goal_joints()
        .iter()
        .map(|joint| joint.default)
        .collect();
    criterion.bench_function("kinematics/frame", |bencher| {
        bencher.iter(|| {
            frame.update(black_box(&q));
            black_box(frame.positions());
        });
    });
}

fn kinematics(criterion: &mut Criterion) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/emp27");
    let robot = Robot::load(&folder).expect("emp27 ships with the project");
    passes(criterion, &robot, "f32", |value| value as f32);
    passes(criterion, &robot, "f64", |value| value);
    frame(criterion, &robot);
}

criterion_group!(benches, kinematics);
criterion_main!(benches);
