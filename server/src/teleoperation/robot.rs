//! The end that sets the pace: frames in, control periods out. Frames are read, poses retargeted and control periods computed side
//! by side; none waits for another.

use std::time::Instant;

use emp_models::guard::GuardSettings;
use emp_proto::v1::{
    BothFrame, Delivery, FrameHeader, OperatorFrame, TeleoperateRequest, TeleoperateResponse,
    teleoperate_request::Message as Request,
};
use tokio::time::{Instant as Clock, sleep_until};

use super::{
    joined::{Joined, LossCounter},
    messages::Notice,
    operator::{Memory, Operator, Pose, Taken},
    pipeline::{Pipeline, RobotFrame},
    sessions::{ROBOT_SILENCE, Role},
};
use crate::decode::deadline;
use crate::{
    decode::robot_state,
    dropped::NotComputed,
    error::{FieldError, ServiceError},
    session::{Gone, Inbox, Next, Outbound, Queued, Reader, StreamContext},
};

/// Serves a robot's stream after it was accepted.
pub(super) async fn run(
    context: &StreamContext,
    joined: &Joined,
    guard: &GuardSettings,
    inbound: Reader<TeleoperateRequest>,
    outbound: &Outbound<TeleoperateResponse>,
) -> Result<(), ServiceError> {
    let retargeting = joined.retargeting.as_deref();
    let operator = retargeting.map(|retargeting| Operator::new(joined, retargeting));
    let robot = RobotStream {
        context,
        joined,
        operator: operator.as_ref(),
        inbox: Inbox::new(Delivery::Latest, context.buffer),
        outbound,
    };
    let reading = async {
        let end = robot.read(inbound).await;
        robot.inbox.close();
        operator.as_ref().inspect(|operator| operator.close());
        end.map_err(Some)
    };
    let pipeline = Pipeline::new(joined, guard);
    let computing = async { robot.compute(pipeline).await.map_err(|Gone| None) };
    let retargeting = async {
        if let Some(operator) = &operator {
            operator.retarget().await;
        }
        Ok(())
    };
    match tokio::try_join!(reading, computing, retargeting) {
        Ok((None, (), ())) | Err(None) => Ok(()),
        Ok((Some(end), (), ())) | Err(Some(end)) => Err(end),
    }
}

struct RobotStream<'a> {
    context: &'a StreamContext,
    joined: &'a Joined,
    /// The person's side, where the client holds that end too.
    operator: Option<&'a Operator<'a>>,
    inbox: Inbox<Waiting>,
    outbound: &'a Outbound<TeleoperateResponse>,
}

/// A robot's frame that waits, with the pose that it waits for where the robot is simulated.
struct Waiting {
    frame: RobotFrame,
    pose: Option<Pose>,
}

impl Queued for Waiting {
    fn header(&self) -> Option<FrameHeader> {
        self.frame.header
    }

    fn supersede(&mut self, old: &Self) {
        self.frame.resets |= old.frame.resets;
    }
}

/// What reading remembers.
#[derive(Default)]
struct Read {
    /// A frame that was to start an episode has arrived; the next good one does.
    must_reset: bool,
    lost: LossCounter,
    taken: Taken,
}

impl RobotStream<'_> {
    /// Reads frames until the client or the server wants no more of them; gives the reason where it is the server.
    async fn read(
        &self,
        mut inbound: Reader<TeleoperateRequest>,
    ) -> Result<Option<ServiceError>, ServiceError> {
        let drain = &self.context.drain;
        let over = drain.over();
        tokio::pin!(over);
        let mut is_told = false;
        let mut read = Read::default();
        let mut silent_at = Clock::now() + ROBOT_SILENCE;
        let mut is_silent = false;
        loop {
            let message = tokio::select! {
                message = inbound.next() => message?,
                () = sleep_until(silent_at), if !is_silent => {
                    is_silent = true;
                    self.joined.member.is_silent();
                    continue;
                }
                () = drain.begun.cancelled(), if !is_told => {
                    is_told = true;
                    let notice = Notice::GoingAway(drain.notice());
                    // A client that is gone ends the stream elsewhere.
                    let _ = self.outbound.send(notice.into()).await;
                    continue;
                }
                () = &mut over => return Ok(Some(ServiceError::ShuttingDown)),
            };
            let Some(message) = message else {
                return Ok(None);
            };
            (silent_at, is_silent) = (Clock::now() + ROBOT_SILENCE, false);
            self.accept(message, &mut read)?;
        }
    }

    fn accept(&self, request: TeleoperateRequest, read: &mut Read) -> Result<(), ServiceError> {
        let arrived = Instant::now();
        let role = self.joined.member.role();
        let (frame, person) = match (request.message, role) {
            (Some(Request::Robot(frame)), Role::Robot) => (Some(frame), None),
            (Some(Request::Both(BothFrame { robot, operator })), Role::Both) => (robot, operator),
            (Some(Request::Config(_)), _) => return Err(FieldError::second_config().into()),
            (None, _) => return Err(FieldError::missing_frame().into()),
            (Some(frame), _) => return self.refuse(frame),
        };
        let Some(frame) = frame else {
            let error = FieldError::new("robot", "it is missing");
            return self.drop_frame(None, error);
        };
        let header = frame.header;
        let lost = read.lost.count(header.as_ref());
        self.joined.member.heard(lost);
        let mut pose = person.and_then(|person| self.take_person(&person, header, arrived, read));
        if !self.joined.simulated
            && let (Some(operator), Some(pose)) = (self.operator, pose.take())
        {
            operator.push(pose)?;
        }
        read.must_reset |= frame.reset;
        match self.read_frame(&frame, arrived, read.must_reset) {
            Ok(frame) => {
                read.must_reset = false;
                self.inbox.push(Waiting { frame, pose })
            }
            Err(error) => self.drop_frame(header, error),
        }
    }

    /// Takes the person's part of a frame. A bad one is said in the answers to come; the robot's part stands on its own.
    fn take_person(
        &self,
        person: &OperatorFrame,
        header: Option<FrameHeader>,
        arrived: Instant,
        read: &mut Read,
    ) -> Option<Pose> {
        let operator = self.operator?;
        match operator.take(person, header, arrived, &mut read.taken) {
            Ok(pose) => pose,
            Err(FieldError { field, description }) => {
                let error = FieldError::new(format!("operator.{field}"), description);
                let notice = NotComputed::from(error).notice(header);
                self.joined.member.set_no_goal(notice);
                None
            }
        }
    }

    /// Refuses a frame of another role.
    fn refuse(&self, frame: Request) -> Result<(), ServiceError> {
        let (header, sent) = match frame {
            Request::Operator(frame) => (frame.header, "operator"),
            Request::Robot(frame) => (frame.header, "robot"),
            Request::Both(frame) => (frame.robot.and_then(|robot| robot.header), "both"),
            Request::Config(_) => (None, "config"),
        };
        let description = match self.joined.member.role() {
            Role::Both => "this client holds both ends; expected `both`",
            _ => "this client is the session's robot; expected `robot`",
        };
        self.drop_frame(header, FieldError::new(sent, description))
    }

    fn drop_frame(
        &self,
        header: Option<FrameHeader>,
        error: FieldError,
    ) -> Result<(), ServiceError> {
        let notice = NotComputed::from(error).notice(header);
        self.inbox.push_notice(notice)
    }

    fn read_frame(
        &self,
        frame: &emp_proto::v1::RobotFrame,
        arrived: Instant,
        resets: bool,
    ) -> Result<RobotFrame, FieldError> {
        let robot = &self.joined.policy.robot;
        Ok(RobotFrame {
            header: frame.header,
            measured: robot_state::read_state("state", frame.state.as_ref(), robot)?,
            resets,
            arrived,
            deadline: deadline::of_frame(frame.header.as_ref(), arrived)?,
        })
    }

    /// Computes what waits, until nothing more comes.
    async fn compute(&self, mut pipeline: Pipeline<'_>) -> Result<(), Gone> {
        let mut memory = Memory::default();
        while let Some(mut next) = self.inbox.next().await {
            if let (Next::Frame(Waiting { pose, .. }), Some(operator)) = (&mut next, self.operator)
                && let Some(pose) = pose.take()
            {
                operator.advance(pose, &mut memory).await;
            }
            let notice = match next {
                Next::Frame(Waiting { frame, .. }) => match pipeline.step(frame).await {
                    Ok(result) => Notice::Result(Box::new(result)),
                    Err(notice) => Notice::Dropped(notice),
                },
                Next::Notice(notice) => Notice::Dropped(notice),
            };
            self.outbound.send(notice.into()).await?;
        }
        Ok(())
    }
}
