//! The end that sets the pace: frames in, control periods out. One task reads, another computes.

use std::time::Instant;

use emp_proto::v1::{Delivery, DroppedFrame, TeleoperateRequest, TeleoperationFrame};
use tonic::Streaming;

use super::{
    Joined, Outbound, Role, frame_of,
    inbox::{Inbox, Waiting},
    messages,
    path::{Path, RobotFrame},
};
use crate::{
    deadline,
    error::{FieldError, ServiceError},
    pose, robot_state,
    session::{NotComputed, SessionContext},
};

/// Serves a robot's stream after it was accepted.
pub(super) async fn run(
    context: &SessionContext,
    joined: &Joined,
    delivery: Delivery,
    path: Path<'_>,
    inbound: Streaming<TeleoperateRequest>,
    outbound: &Outbound,
) -> Result<(), ServiceError> {
    let inbox = Inbox::new(delivery, context.buffer);
    let reading = async {
        let end = read(context, joined, &inbox, inbound, outbound).await;
        inbox.close();
        end
    };
    let computing = async {
        compute(path, &inbox, outbound).await;
        Ok(())
    };
    let (end, ()) = tokio::try_join!(reading, computing)?;
    end.map_or(Ok(()), Err)
}

/// Reads frames until the client or the server wants no more of them; gives the reason where it is the server.
async fn read(
    context: &SessionContext,
    joined: &Joined,
    inbox: &Inbox<RobotFrame>,
    mut inbound: Streaming<TeleoperateRequest>,
    outbound: &Outbound,
) -> Result<Option<ServiceError>, ServiceError> {
    // A frame that was to start an episode has arrived; the next good one does.
    let mut must_reset = false;
    loop {
        let next = async {
            inbox.room().await;
            inbound.message().await
        };
        let message = tokio::select! {
            message = next => message.map_err(ServiceError::Transport)?,
            () = context.drain.cancelled() => return Ok(Some(ServiceError::ShuttingDown)),
        };
        let Some(message) = message else {
            return Ok(None);
        };
        let frame = frame_of(message)?;
        let header = frame.header;
        must_reset |= frame.reset;
        let notice = match read_frame(joined, &frame, must_reset) {
            Ok(frame) => {
                must_reset = false;
                inbox.push(frame, inherit).as_ref().map(superseded)
            }
            Err(error) => inbox.push_notice(NotComputed::from(error).notice(header)),
        };
        if let Some(notice) = notice {
            // A client that is gone ends the stream elsewhere.
            let _ = outbound.send(Ok(messages::dropped(notice))).await;
        }
    }
}

fn superseded(old: &RobotFrame) -> DroppedFrame {
    NotComputed::superseded().notice(old.header)
}

/// What a frame takes over from the one whose place it takes.
fn inherit(old: &RobotFrame, new: &mut RobotFrame) {
    new.reset |= old.reset;
    new.emp_mode = new.emp_mode.or(old.emp_mode);
    if new.pose.is_none() {
        new.pose.clone_from(&old.pose);
    }
}

fn read_frame(
    joined: &Joined,
    frame: &TeleoperationFrame,
    reset: bool,
) -> Result<RobotFrame, FieldError> {
    let arrived = Instant::now();
    let deadline = deadline::of_frame(frame.header.as_ref(), arrived)?;
    let (joint_positions, orientation) =
        robot_state::read_state("state", frame.state.as_ref(), &joined.policy.robot)?;
    let pose = match (&frame.pose, joined.member.role()) {
        (None, _) => None,
        (Some(pose), Role::Both) => Some(pose::read(Some(pose))?),
        (Some(_), _) => {
            let description = "poses come from the session's operator; expected a state";
            return Err(FieldError::new("pose", description));
        }
    };
    Ok(RobotFrame {
        emp_mode: joined.mode_of(frame)?,
        header: frame.header,
        pose,
        joint_positions,
        orientation,
        reset,
        arrived,
        deadline,
    })
}

/// Computes what waits, until nothing more comes.
async fn compute(mut path: Path<'_>, inbox: &Inbox<RobotFrame>, outbound: &Outbound) {
    while let Some(next) = inbox.next().await {
        let answer = match next {
            Waiting::Frame(frame) => match path.step(frame).await {
                Ok(result) => messages::result(result),
                Err(notice) => messages::dropped(notice),
            },
            Waiting::Notice(notice) => messages::dropped(notice),
        };
        if outbound.send(Ok(answer)).await.is_err() {
            return;
        }
    }
}
