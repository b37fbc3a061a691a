//! The server under load, client and server on one machine, over TCP: the round trip of one frame, how many streams keep
//! 50 Hz, and what an evaluation beside it does to a robot that is teleoperated.

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use anyhow::Context as _;
use criterion::Criterion;
use emp_client::{
    Client, Delivery, EmpMode, EvaluationConfig, EvaluationEvent, Event, ProceduralClips,
    Statistics, StreamConfig, Summary,
};
use emp_tests::{
    TestServer,
    load::{RATE, TELEOPERATED, at, teleoperate},
    policy, poses,
};
use tokio::{runtime::Runtime, time::MissedTickBehavior};

const ROBOT: &str = "emp27";
/// How long each number of streams is held.
const HELD: Duration = Duration::from_secs(5);
/// A number of streams is held when this share of answers comes before the next frame, and no more are dropped.
const ON_TIME: f64 = 0.99;

fn main() -> anyhow::Result<()> {
    let weights = policy::weights()?;
    let server = TestServer::start_with(weights.path(), |_| {})?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()?;
    let client = runtime.block_on(Client::connect(&server.url()))?;
    let mut criterion = Criterion::default().configure_from_args();
    for refine in [false, true] {
        unary(&mut criterion, &runtime, &client, refine);
        stream(&mut criterion, &runtime, &client, refine)?;
    }
    criterion.final_summary();
    // `cargo test --benches` only asks whether the benchmark runs.
    if std::env::args().any(|argument| argument == "--bench") {
        for refine in [false, true] {
            streams_at_rate(&runtime, &client, refine)?;
        }
        runtime.block_on(beside_an_evaluation(&client))?;
    }
    Ok(())
}

fn name(what: &str, refine: bool) -> String {
    format!("round trip/{what}{}", if refine { ", refined" } else { "" })
}

fn unary(criterion: &mut Criterion, runtime: &Runtime, client: &Client, refine: bool) {
    let mut poses = poses(1, 500).into_iter().cycle();
    criterion.bench_function(&name("unary", refine), |bencher| {
        bencher.iter(|| {
            let pose = poses.next().expect("endless");
            runtime
                .block_on(client.retarget(ROBOT, &pose, refine))
                .expect("an answer")
        });
    });
}

fn stream(
    criterion: &mut Criterion,
    runtime: &Runtime,
    client: &Client,
    refine: bool,
) -> anyhow::Result<()> {
    let config = StreamConfig {
        refine,
        ..StreamConfig::for_robot(ROBOT)
    };
    let (mut sender, mut events) = runtime.block_on(client.stream(config))?;
    let mut poses = poses(1, 500).into_iter().cycle();
    criterion.bench_function(&name("stream", refine), |bencher| {
        bencher.iter(|| {
            let pose = poses.next().expect("endless");
            runtime.block_on(async {
                sender.send(&pose, None).await.expect("an open stream");
                events
                    .next()
                    .await
                    .expect("an open stream")
                    .expect("an answer")
            })
        });
    });
    Ok(())
}

/// Doubles the number of streams until they no longer keep the rate.
fn streams_at_rate(runtime: &Runtime, client: &Client, refine: bool) -> anyhow::Result<()> {
    let mut held = 0;
    for exponent in 0..8 {
        let streams = 1 << exponent;
        let summary = runtime.block_on(hold(client, streams, refine))?;
        let on_time = summary.latency_ms.p99 <= 1e3 / RATE
            && summary.answered as f64 >= ON_TIME * summary.frames as f64;
        println!(
            "{streams:>4} streams at {RATE} Hz, refine {refine}: {} of {} frames answered, latency p50 {:.2} ms, p99 {:.2} ms, \
             batch mean {:.1}{}",
            summary.answered,
            summary.frames,
            summary.latency_ms.p50,
            summary.latency_ms.p99,
            summary.batch.mean,
            if on_time { "" } else { "  (not held)" },
        );
        if !on_time {
            break;
        }
        held = streams;
    }
    println!("held at {RATE} Hz, refine {refine}: {held} streams");
    Ok(())
}

/// Runs streams side by side at the rate, each with a motion of its own, and counts them together.
async fn hold(client: &Client, streams: usize, refine: bool) -> anyhow::Result<Summary> {
    let frames = (HELD.as_secs_f64() * RATE) as usize;
    let config = StreamConfig {
        delivery: Delivery::Latest,
        refine,
        smoothing: true,
        ..StreamConfig::for_robot(ROBOT)
    };
    let (to_count, mut to_be_counted) = tokio::sync::mpsc::channel::<Event>(1024);
    let mut statistics = Statistics::new();
    for index in 0..streams {
        let (mut sender, mut events) = client.stream(config.clone()).await?;
        let poses = poses(index as u64, frames);
        tokio::spawn(async move {
            // Sources do not tick together.
            tokio::time::sleep(Duration::from_secs_f64(
                index as f64 / (RATE * streams as f64),
            ))
            .await;
            let mut ticks = tokio::time::interval(Duration::from_secs_f64(1.0 / RATE));
            ticks.set_missed_tick_behavior(MissedTickBehavior::Burst);
            for pose in &poses {
                ticks.tick().await;
                if sender.send(pose, None).await.is_err() {
                    return;
                }
            }
        });
        let to_count = to_count.clone();
        tokio::spawn(async move {
            while let Ok(Some(event)) = events.next().await {
                if to_count.send(event).await.is_err() {
                    return;
                }
            }
        });
    }
    drop(to_count);
    while let Some(event) = to_be_counted.recv().await {
        statistics.record(&event);
    }
    let summary = statistics.summary();
    (summary.frames == (frames * streams) as u64)
        .then_some(summary)
        .context("a stream ended early")
}

/// Teleoperates a robot alone, then while an evaluation takes all the time that the system has left.
async fn beside_an_evaluation(client: &Client) -> anyhow::Result<()> {
    report("alone", &teleoperate(client, EmpMode::Off).await?);
    let config = EvaluationConfig {
        robot: ROBOT.to_owned(),
        episodes: 100_000,
        procedural: Some(ProceduralClips { count: 8, seed: 1 }),
        ..EvaluationConfig::default()
    };
    let mut evaluation = client.evaluate(config, Vec::new()).await?;
    while !matches!(
        evaluation.next().await?.context("an evaluation")?,
        EvaluationEvent::Started(_)
    ) {}
    let count = Arc::new(AtomicU64::new(0));
    let counted = Arc::clone(&count);
    let simulated = tokio::spawn(async move {
        let mut frames = 0_u64;
        while let Ok(Some(event)) = evaluation.next().await {
            if let EvaluationEvent::Episode(episode) = event {
                frames += episode.result.map_or(0, |result| u64::from(result.frames));
                counted.store(frames, Ordering::Relaxed);
            }
        }
    });
    let beside = teleoperate(client, EmpMode::Off).await?;
    simulated.abort();
    report("beside an evaluation", &beside);
    println!(
        "  which simulated {:.0} control periods a second meanwhile",
        count.load(Ordering::Relaxed) as f64 / TELEOPERATED.as_secs_f64()
    );
    Ok(())
}

fn report(what: &str, times: &[Duration]) {
    println!(
        "a robot at {RATE} Hz (retarget, refined, and policy) {what}: p50 {:.2} ms, p99 {:.2} ms, longest {:.2} ms",
        at(times, 0.5),
        at(times, 0.99),
        at(times, 1.0),
    );
}
