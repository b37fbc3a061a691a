//! Operators and observers: poses in, or nothing, and everything out that is told in the session.

use std::{collections::VecDeque, time::Instant};

use emp_proto::v1::{
    TeleoperateRequest, TeleoperateResponse, TeleoperatedFrame, TeleoperationFrame,
};
use tokio::sync::broadcast::{self, error::RecvError};
use tonic::Streaming;

use super::{Joined, Outbound, Role, frame_of, messages, sessions::Told};
use crate::{
    deadline,
    error::{FieldError, ServiceError},
    pose,
    session::{NotComputed, SessionContext},
};

/// Serves the stream of an operator or an observer after it was accepted.
///
/// An operator who half-closes leaves. An observer has nothing to send, and goes on listening.
pub(super) async fn run(
    context: &SessionContext,
    joined: &Joined,
    mut told: broadcast::Receiver<Told>,
    mut inbound: Streaming<TeleoperateRequest>,
    outbound: &Outbound,
) -> Result<(), ServiceError> {
    let mut listener = Listener {
        joined,
        outbox: VecDeque::new(),
        missed: 0,
    };
    let mut reading = true;
    loop {
        let has_room = listener.outbox.len() < context.buffer;
        tokio::select! {
            permit = outbound.reserve(), if !listener.outbox.is_empty() => match permit {
                Ok(permit) => {
                    if let Some(message) = listener.outbox.pop_front() {
                        permit.send(Ok(message));
                    }
                }
                Err(_) => return Ok(()),
            },
            message = inbound.message(), if reading && has_room => {
                match message.map_err(ServiceError::Transport)? {
                    Some(message) => listener.accept(&frame_of(message)?),
                    None if joined.member.role() == Role::Operator => break,
                    None => reading = false,
                }
            }
            // What is told waits in the channel, which forgets what a slow reader leaves there for long.
            news = told.recv(), if listener.outbox.is_empty() => match news {
                Ok(told) => listener.pass_on(told),
                Err(RecvError::Lagged(missed)) => listener.catch_up(missed),
                Err(RecvError::Closed) => break,
            },
            () = context.drain.cancelled() => return Err(ServiceError::ShuttingDown),
        }
    }
    for message in listener.outbox {
        if outbound.send(Ok(message)).await.is_err() {
            break;
        }
    }
    Ok(())
}

struct Listener<'a> {
    joined: &'a Joined,
    outbox: VecDeque<TeleoperateResponse>,
    /// Control periods that were not told since the last that was.
    missed: u64,
}

impl Listener<'_> {
    fn accept(&mut self, frame: &TeleoperationFrame) {
        let header = frame.header;
        if let Err(error) = self.take_pose(frame) {
            let notice = NotComputed::from(error).notice(header);
            self.outbox.push_back(messages::dropped(notice));
        }
    }

    fn take_pose(&self, frame: &TeleoperationFrame) -> Result<(), FieldError> {
        let member = &self.joined.member;
        if member.role() == Role::Observer {
            return Err(FieldError::new("frame", "an observer sends no frames"));
        }
        if frame.state.is_some() {
            let description = "states come from the session's robot; expected a pose";
            return Err(FieldError::new("state", description));
        }
        let arrived = Instant::now();
        let deadline = deadline::of_frame(frame.header.as_ref(), arrived)?;
        let mode = self.joined.mode_of(frame)?;
        let pose = pose::read(frame.pose.as_ref())?;
        if let Some(mode) = mode {
            member.set_emp_mode(mode);
        }
        member.set_pose(
            frame.header,
            pose,
            arrived,
            deadline,
            &self.joined.retargeting,
        );
        Ok(())
    }

    fn pass_on(&mut self, told: Told) {
        let message = match told {
            Told::Result(result) => messages::result(TeleoperatedFrame {
                missed: std::mem::take(&mut self.missed),
                ..TeleoperatedFrame::clone(&result)
            }),
            Told::Presence(presence) => messages::presence(presence),
        };
        self.outbox.push_back(message);
    }

    /// What was missed may have been about who is there.
    fn catch_up(&mut self, missed: u64) {
        self.missed += missed;
        let presence = self.joined.member.presence();
        self.outbox.push_back(messages::presence(presence));
    }
}
