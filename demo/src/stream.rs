//! The motion's way over the wire.

use anyhow::{Context, Result, bail, ensure};
use emp_client::{Answer, Client, Event, Statistics, StreamConfig, StreamEvents};
use emp_motion::Clip;
use emp_robot::Robot;

/// What came back.
pub(crate) struct Answers {
    /// Joint targets, one row a frame, in goal order, radians.
    pub(crate) targets: Vec<Vec<f32>>,
    /// Name and version of the model that answered.
    pub(crate) model: (String, String),
    /// Rates, latencies and batches.
    pub(crate) statistics: emp_client::Summary,
}

/// Streams the clip with refinement and smoothing, each frame sent when the one before it is answered: the latencies are
/// those of an unhurried stream, and the rate is what one such stream can reach.
pub(crate) async fn play(url: &str, robot: &Robot, clip: &Clip) -> Result<Answers> {
    let client = Client::connect(url).await?;
    let config = StreamConfig {
        refine: true,
        smoothing: true,
        ..StreamConfig::for_robot(robot.name())
    };
    let (mut sender, mut events) = client.stream(config).await?;
    check_joints(robot, events.joint_names())?;
    let (name, version) = events.model();
    let model = (name.to_owned(), version.to_owned());

    let mut statistics = Statistics::new();
    let mut targets = Vec::with_capacity(clip.frames.len());
    for (index, frame) in clip.frames.iter().enumerate() {
        let number = sender.send(frame, None).await?;
        let answer = answer(&mut events, &mut statistics)
            .await
            .with_context(|| format!("frame {index}"))?;
        ensure!(
            answer.sequence_number == number,
            "frame {index} got the answer to frame {}",
            answer.sequence_number
        );
        targets.push(answer.joint_angles);
    }
    let statistics = statistics.summary();
    drop(sender);
    while events.next().await?.is_some() {}
    Ok(Answers {
        targets,
        model,
        statistics,
    })
}

/// The next answer; a dropped frame is an error, since nothing is known to be wrong with any.
async fn answer(events: &mut StreamEvents, statistics: &mut Statistics) -> Result<Answer> {
    loop {
        let event = events.next().await?.context("the stream ended early")?;
        statistics.record(&event);
        match event {
            Event::Answer(answer) => return Ok(answer),
            Event::Dropped(dropped) => {
                bail!(
                    "dropped ({}) {} {}",
                    dropped.cause.name(),
                    dropped.field,
                    dropped.description
                )
            }
            Event::ConnectionLost { reason, .. } => eprintln!("connection lost: {reason}"),
            Event::Reconnected { .. } => eprintln!("connection restored"),
        }
    }
}

fn check_joints(robot: &Robot, names: &[String]) -> Result<()> {
    let expected: Vec<&str> = robot
        .goal_joints()
        .iter()
        .map(|joint| joint.name.as_str())
        .collect();
    ensure!(
        expected == names,
        "the server's joints are {names:?}, the robot's {expected:?}"
    );
    Ok(())
}
