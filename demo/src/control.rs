//! The control loop: at 50 Hz a person's pose and the robot's state over the wire, joint targets back, into the physics.

use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use emp_client::{
    Answer, Client, Counted, Event, FrameSender, PolicyAnswer, PolicyConfig, RobotFrame,
    Statistics, StreamConfig, StreamEvents,
};
use emp_motion::{Clip, KeyNodeFrame};
use emp_robot::Robot;
use emp_sim::Reading;
use emp_sim::environment::{EndReason, EnvironmentConfig};
use tokio::time::{Instant, sleep_until, timeout_at};

use crate::conditions::Conditions;
use crate::simulator::{JointTargets, Simulator};

/// One control period.
pub(crate) struct Period {
    /// The goal that the retargeter answered, radians; that of the period before if it did not answer in time.
    pub(crate) goal: Vec<f32>,
    /// What the robot's motors followed.
    pub(crate) targets: JointTargets,
    /// Whether the server's answers came before the period's end. If not, the robot kept the targets that it had.
    pub(crate) answered: bool,
    /// From the robot's state to its new targets, over both streams; of an unanswered period, how long the robot waited.
    pub(crate) round_trip: Duration,
    /// Whether the robot was pushed at its beginning.
    pub(crate) pushed: bool,
    /// What was measured at its end.
    pub(crate) reading: Reading,
}

/// Everything that happened.
pub(crate) struct Run {
    /// What was measured before the first period.
    pub(crate) start: Reading,
    /// The control periods that the robot went through: all of the motion, or those up to its fall.
    pub(crate) periods: Vec<Period>,
    /// Why the robot fell in the last of them, if it did.
    pub(crate) fall: Option<EndReason>,
    /// From the first period's beginning to the last one's end.
    pub(crate) wall_time: Duration,
    /// How the stream of poses went.
    pub(crate) retargeting: StreamReport,
    /// How the stream of robot states went.
    pub(crate) policy: StreamReport,
}

/// How one stream went.
pub(crate) struct StreamReport {
    /// Name and version of the model that answered.
    pub(crate) model: (String, String),
    /// Latencies and batches.
    pub(crate) statistics: emp_client::Summary,
}

/// Lets the robot follow the clip in real time, until the clip's end or the robot's fall.
///
/// The clock sets the pace. In each period a pose goes to the retargeter, and its goal with the robot's state to the policy. If
/// the answers are not there when the period ends, the robot keeps the targets that it has, as a real one would, and what
/// comes late is thrown away.
pub(crate) async fn run(
    url: &str,
    robot: &Arc<Robot>,
    clip: &Clip,
    mut conditions: Conditions,
) -> Result<Run> {
    let mut server = Server::connect(url, robot).await?;
    let first = clip.frames.first().context("the motion has no frames")?;
    // Before the clock runs: the robot begins in the motion's first pose.
    let mut goal = server
        .poses
        .ask(first)
        .await
        .context("the first pose")?
        .joint_angles;
    let (mut simulator, start) = Simulator::start(robot, conditions.hand_load, &goal).await?;
    let legs = robot.leg_joints().iter();
    let mut targets = JointTargets {
        goal: goal.clone(),
        legs: legs.map(|joint| joint.default as f32).collect(),
    };

    let limits = EnvironmentConfig::default();
    let period = Duration::from_secs_f64(1.0 / robot.control_rate_hz());
    let begin = Instant::now();
    let mut periods: Vec<Period> = Vec::with_capacity(clip.frames.len());
    let mut fall = None;
    for (number, pose) in clip.frames.iter().enumerate() {
        let due = begin + period * number as u32;
        sleep_until(due).await;
        let woke = Instant::now();
        let reading = periods.last().map_or(&start, |period| &period.reading);
        let answer = timeout_at(due + period, server.step(pose, &mut goal, reading)).await;
        let answered = answer.is_ok();
        if let Ok(answer) = answer {
            targets = answer.with_context(|| format!("frame {number}"))?;
        }
        let round_trip = woke.elapsed();
        let push = conditions.push(number);
        let reading = simulator.step(targets.clone(), push).await?;
        fall = limits.fall(&reading, robot.standing_height());
        periods.push(Period {
            goal: goal.clone(),
            targets: targets.clone(),
            answered,
            round_trip,
            pushed: push.is_some(),
            reading,
        });
        if fall.is_some() {
            break;
        }
    }
    sleep_until(begin + period * periods.len() as u32).await;
    let wall_time = begin.elapsed();
    Ok(Run {
        start,
        periods,
        fall,
        wall_time,
        retargeting: server.poses.finish().await?,
        policy: server.states.finish().await?,
    })
}

/// Both streams to the server.
struct Server {
    poses: Stream<KeyNodeFrame, Answer>,
    states: Stream<RobotFrame, PolicyAnswer>,
}

impl Server {
    async fn connect(url: &str, robot: &Robot) -> Result<Self> {
        let client = Client::connect(url).await?;
        let config = StreamConfig {
            refine: true,
            smoothing: true,
            ..StreamConfig::for_robot(robot.name())
        };
        let poses = Stream::new(client.stream(config).await?);
        let states = Stream::new(
            client
                .policy_stream(PolicyConfig::for_robot(robot.name()))
                .await?,
        );
        let goals = robot.goal_joints().iter();
        poses.check_joints(goals.map(|joint| joint.name.as_str()))?;
        states.check_joints(robot.joints().map(|joint| joint.name.as_str()))?;
        Ok(Self { poses, states })
    }

    /// A pose and the robot's state become targets, and the pose a goal.
    async fn step(
        &mut self,
        pose: &KeyNodeFrame,
        goal: &mut Vec<f32>,
        reading: &Reading,
    ) -> Result<JointTargets> {
        *goal = self
            .poses
            .ask(pose)
            .await
            .context("retargeting")?
            .joint_angles;
        let state = RobotFrame {
            joint_positions: reading.joint_positions.clone(),
            orientation: reading.orientation,
            goal: goal.clone(),
            reset: false,
        };
        let answer = self.states.ask(&state).await.context("policy")?;
        Ok(JointTargets {
            goal: answer.executable_goal,
            legs: answer.leg_targets,
        })
    }
}

/// A stream on which each frame is sent when the one before it was answered or given up.
struct Stream<F, A> {
    sender: FrameSender<F>,
    events: StreamEvents<A>,
    statistics: Statistics,
}

impl<F: Clone, A: Counted + Numbered> Stream<F, A> {
    fn new((sender, events): (FrameSender<F>, StreamEvents<A>)) -> Self {
        Self {
            sender,
            events,
            statistics: Statistics::new(),
        }
    }

    fn check_joints<'a>(&self, expected: impl Iterator<Item = &'a str>) -> Result<()> {
        let expected: Vec<&str> = expected.collect();
        let names = self.events.joint_names();
        ensure!(
            expected == names,
            "the server's joints are {names:?}, the robot's {expected:?}"
        );
        Ok(())
    }

    /// Sends a frame and waits for its answer; answers to earlier frames come too late and are thrown away.
    async fn ask(&mut self, frame: &F) -> Result<A> {
        let number = self.sender.send(frame, None).await?;
        loop {
            let answer = self.answer().await?;
            if answer.number() == number {
                return Ok(answer);
            }
        }
    }

    /// The next answer; a dropped frame is an error, since nothing is known to be wrong with any.
    async fn answer(&mut self) -> Result<A> {
        loop {
            let event = self
                .events
                .next()
                .await?
                .context("the stream ended early")?;
            self.statistics.record(&event);
            match event {
                Event::Answer(answer) => return Ok(answer),
                Event::Dropped(dropped) => bail!(
                    "dropped ({}) {} {}",
                    dropped.cause.name(),
                    dropped.field,
                    dropped.description
                ),
                Event::ConnectionLost { reason, .. } => eprintln!("connection lost: {reason}"),
                Event::Reconnected { .. } => eprintln!("connection restored"),
            }
        }
    }

    /// Ends the stream and waits for what is still on its way.
    async fn finish(mut self) -> Result<StreamReport> {
        let (name, version) = self.events.model();
        let model = (name.to_owned(), version.to_owned());
        drop(self.sender);
        while let Some(event) = self.events.next().await? {
            self.statistics.record(&event);
        }
        Ok(StreamReport {
            model,
            statistics: self.statistics.summary(),
        })
    }
}

/// An answer that says which frame it answers.
trait Numbered {
    fn number(&self) -> u64;
}

impl Numbered for Answer {
    fn number(&self) -> u64 {
        self.sequence_number
    }
}

impl Numbered for PolicyAnswer {
    fn number(&self) -> u64 {
        self.sequence_number
    }
}
