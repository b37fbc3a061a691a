//! The operator's side: poses become goals here, as they arrive, whatever the robot does meanwhile.

use std::time::Instant;

use emp_models::retarget::{Memory as Previous, Mode, RetargetInput};
use emp_motion::KeyNodeFrame;
use emp_proto::v1::{Delivery, FrameHeader, OperatorFrame};

use super::{
    joined::{Joined, Retargeting},
    sessions::Goal,
};
use crate::decode::deadline;
use crate::{
    decode::pose,
    dropped::NotComputed,
    encode,
    error::{FieldError, ServiceError},
    inference::queue::Priority,
    session::{Inbox, Next, Queued},
};

/// A pose that waits for the retargeter. A newer one takes its place, with its own age and deadline.
pub(super) struct Pose {
    header: Option<FrameHeader>,
    frame: KeyNodeFrame,
    arrived: Instant,
    deadline: Option<Instant>,
}

impl Queued for Pose {
    fn header(&self) -> Option<FrameHeader> {
        self.header
    }
}

/// Takes an operator's frames, and makes goals of their poses.
pub(super) struct Operator<'a> {
    joined: &'a Joined,
    retargeting: &'a Retargeting,
    poses: Inbox<Pose>,
}

/// What taking frames remembers.
#[derive(Default)]
pub(super) struct Taken {
    /// The heading that is taken out of every pose, rad.
    heading: f32,
}

impl<'a> Operator<'a> {
    pub(super) fn new(joined: &'a Joined, retargeting: &'a Retargeting) -> Self {
        Self {
            joined,
            retargeting,
            poses: Inbox::new(Delivery::Latest, 1),
        }
    }

    /// Takes a frame and gives its pose, if it has one: what it commands is done even where that is bad.
    pub(super) fn take(
        &self,
        frame: &OperatorFrame,
        header: Option<FrameHeader>,
        arrived: Instant,
        taken: &mut Taken,
    ) -> Result<Option<Pose>, FieldError> {
        let Joined { member, .. } = self.joined;
        if frame.stop {
            member.stop();
        }
        member.set_clutch(frame.clutch);
        if let Some(mode) = self.joined.mode_of("emp_mode", frame.emp_mode)? {
            member.set_emp_mode(mode);
        }
        let commands = frame.stop || frame.recentre || frame.clutch || frame.emp_mode.is_some();
        let Some(pose) = &frame.pose else {
            return match commands {
                true => Ok(None),
                false => Err(FieldError::new("pose", "it is missing")),
            };
        };
        let deadline = deadline::of_frame(header.as_ref(), arrived)?;
        let mut frame_of_pose = pose::read(Some(pose))?;
        if frame.recentre {
            taken.heading = pose::heading(&frame_of_pose);
        }
        if taken.heading != 0.0 {
            frame_of_pose = pose::turned(&frame_of_pose, -taken.heading);
        }
        Ok(Some(Pose {
            header,
            frame: frame_of_pose,
            arrived,
            deadline,
        }))
    }

    /// Makes a goal of a pose as soon as the retargeter is free.
    pub(super) fn push(&self, pose: Pose) -> Result<(), ServiceError> {
        self.poses.push(pose)
    }

    /// Nothing more comes.
    pub(super) fn close(&self) {
        self.poses.close();
    }

    /// Makes goals of poses until nothing more comes.
    pub(super) async fn retarget(&self) {
        let mut memory = Memory::default();
        while let Some(next) = self.poses.next().await {
            // Of the poses that a newer one took the place of nobody waits to hear.
            let Next::Frame(pose) = next else { continue };
            if memory.last.as_ref() == Some(&pose.frame) {
                // The same again, number for number: its source stands still, and the goal goes on ageing.
                continue;
            }
            self.advance(pose, &mut memory).await;
        }
    }

    /// Makes a goal of one pose.
    pub(super) async fn advance(&self, pose: Pose, memory: &mut Memory) {
        let member = &self.joined.member;
        let header = pose.header;
        match self.goal(pose, memory).await {
            Ok(goal) => member.set_goal(goal),
            Err(why) => member.set_no_goal(why.notice(header)),
        }
    }

    async fn goal(&self, pose: Pose, memory: &mut Memory) -> Result<Goal, NotComputed> {
        let Retargeting {
            model,
            refine,
            smoothing,
        } = self.retargeting;
        let input = RetargetInput {
            frame: pose.frame.clone(),
            mode: match &memory.previous {
                _ if !*refine => Mode::Network,
                None => Mode::Begin,
                Some((previous, before)) => Mode::Follow {
                    memory: previous.clone(),
                    seconds: between(*before, pose.arrived, model.robot.control_rate_hz()),
                },
            },
        };
        let answer = model
            .batcher
            .compute(Priority::Stream, input, pose.deadline)
            .await?;
        let timing = encode::timing(&answer);
        let output = answer.output;
        memory.previous = output.memory.map(|previous| (previous, pose.arrived));
        memory.last = Some(pose.frame);
        Ok(Goal {
            operator: self.joined.member.operator(),
            header: pose.header,
            arrived: pose.arrived,
            angles: output.angles,
            direction_error: output.direction_error,
            timing,
            smoothing: *smoothing,
        })
    }
}

/// What one operator's poses leave behind for the next. Another operator starts without.
#[derive(Default)]
pub(super) struct Memory {
    /// The last pose that became a goal.
    last: Option<KeyNodeFrame>,
    /// What the next refined answer starts from, and when its pose arrived.
    previous: Option<(Box<Previous>, Instant)>,
}

/// Time between the arrivals of two poses, seconds: at least half a control period, for the network may deliver two at
/// once, and at most a fifth of a second.
fn between(before: Instant, after: Instant, control_rate_hz: f64) -> f64 {
    const LONGEST: f64 = 0.2;
    let seconds = after.saturating_duration_since(before).as_secs_f64();
    seconds.clamp(0.5 / control_rate_hz, LONGEST)
}
