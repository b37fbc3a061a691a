//! `emp retarget`: a motion file through a stream into a CSV table.

use std::{process::ExitCode, time::Duration};

use anyhow::Context as _;
use emp_client::{
    Client, ClientError, Delivery, Event, FrameSender, Percentiles, Statistics, StreamConfig,
    StreamEvents, Summary,
};
use emp_motion::{Clip, joint_csv::JointCsvWriter};
use indicatif::ProgressBar;
use tokio::time::MissedTickBehavior;

use crate::{
    cli::Retarget,
    command::{self, INTERRUPTED, progress_bar},
};

const FRAMES_MISSING: u8 = 3;

/// How a stream ended.
enum End {
    Complete,
    Interrupted,
    Failed(ClientError),
}

pub(crate) async fn run(
    client: &Client,
    command: &Retarget,
    json: bool,
) -> anyhow::Result<ExitCode> {
    let (clip, rate) = command::recording(
        client,
        &command.file,
        command.reading.options(),
        &command.robot,
    )
    .await?;
    let config = StreamConfig {
        delivery: if command.realtime {
            Delivery::Latest
        } else {
            Delivery::All
        },
        refine: command.refine,
        smoothing: command.smooth,
        ..StreamConfig::for_robot(&command.robot)
    };
    let client = match command.realtime {
        true => client.clone().with_backoff(command::LIVE),
        false => client.clone(),
    };
    let (sender, mut events) = client.stream(config).await?;
    let mut table = JointCsvWriter::create(&command.out, events.joint_names())?;
    let frames = clip.frames.len() as u64;
    let template = "{bar:40} {pos}/{len} frames  {per_sec}  {eta} left";
    let bar = progress_bar(Some(frames), template);
    let mut statistics = Statistics::new();
    let pace = command
        .realtime
        .then(|| Duration::from_secs_f64(1.0 / rate));
    tokio::spawn(send(clip, sender, pace));

    let end = receive(&mut events, &mut statistics, &mut table, rate, &bar).await?;
    table.finish()?;
    bar.finish_and_clear();
    let summary = statistics.summary();
    if json {
        println!("{}", serde_json::to_string(&summary).context("summary")?);
    } else {
        print_summary(&summary, command);
    }
    Ok(match end {
        End::Failed(error) => return Err(error.into()),
        End::Interrupted => ExitCode::from(INTERRUPTED),
        End::Complete if !command.realtime && summary.answered < frames => {
            ExitCode::from(FRAMES_MISSING)
        }
        End::Complete => ExitCode::SUCCESS,
    })
}

/// Sends every frame, as fast as the stream takes them or at the pace given.
async fn send(clip: Clip, mut sender: FrameSender, pace: Option<Duration>) {
    let mut ticks = pace.map(tokio::time::interval);
    if let Some(ticks) = &mut ticks {
        ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    }
    for frame in &clip.frames {
        if let Some(ticks) = &mut ticks {
            ticks.tick().await;
        }
        // The receiving end says why a stream ended.
        if sender.send(frame, None).await.is_err() {
            return;
        }
    }
}

async fn receive(
    events: &mut StreamEvents,
    statistics: &mut Statistics,
    table: &mut JointCsvWriter,
    rate: f64,
    bar: &ProgressBar,
) -> anyhow::Result<End> {
    let interrupt = tokio::signal::ctrl_c();
    tokio::pin!(interrupt);
    loop {
        let event = tokio::select! {
            event = events.next() => match event {
                Ok(Some(event)) => event,
                Ok(None) => return Ok(End::Complete),
                Err(error) => return Ok(End::Failed(error)),
            },
            _ = &mut interrupt => return Ok(End::Interrupted),
        };
        statistics.record(&event);
        match event {
            Event::Answer(answer) => {
                table.write_row(answer.sequence_number as f64 / rate, &answer.joint_angles)?;
                bar.inc(1);
            }
            Event::Dropped(_) => bar.inc(1),
            Event::ConnectionLost {
                reason,
                attempt,
                retry_in,
            } => bar.suspend(|| command::say_lost(&reason, attempt, retry_in)),
            Event::GoingAway { .. } => {
                bar.suspend(|| eprintln!("emp: the server is being stopped"))
            }
            Event::Reconnected { resent } => bar.suspend(|| {
                eprintln!("emp: reconnected; {resent} frames sent again");
            }),
        }
    }
}

fn print_summary(summary: &Summary, command: &Retarget) {
    println!(
        "{} of {} frames written to {}",
        summary.answered,
        summary.frames,
        command.out.display()
    );
    println!(
        "  rate       {:.0} frames/s over {:.2} s",
        summary.fps, summary.seconds
    );
    print_percentiles("latency", &summary.latency_ms);
    print_percentiles("queue", &summary.queue_ms);
    print_percentiles("inference", &summary.inference_ms);
    println!(
        "  batch      mean {:.2}, largest {}",
        summary.batch.mean, summary.batch.max
    );
    if let Some(retargeting) = &summary.retargeting {
        let error = &retargeting.direction_error_deg;
        println!(
            "  direction  mean {:.2}°, p95 {:.2}° off the person's arms",
            error.mean, error.p95
        );
        println!(
            "  limits     {:.1} % of frames with a joint at a limit",
            100.0 * retargeting.limit_share
        );
    }
    let dropped: Vec<_> = summary
        .dropped
        .iter()
        .map(|(reason, count)| format!("{count} {reason}"))
        .collect();
    println!(
        "  dropped    {}",
        if dropped.is_empty() {
            "none".to_owned()
        } else {
            dropped.join(", ")
        }
    );
    if summary.reconnects > 0 {
        println!("  reconnects {}", summary.reconnects);
    }
}

fn print_percentiles(what: &str, values: &Percentiles) {
    let Percentiles { p50, p90, p99, max } = values;
    println!("  {what:<10} p50 {p50:.2} ms, p90 {p90:.2} ms, p99 {p99:.2} ms, max {max:.2} ms");
}
