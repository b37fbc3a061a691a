//! Operators and observers: an operator's frames in, and everything out that is told in the session.

use std::{collections::VecDeque, time::Instant};

use emp_proto::v1::{TeleoperateRequest, teleoperate_request::Message as Request};
use tokio::sync::broadcast::{self, error::RecvError};

use super::{
    joined::{Joined, LossCounter},
    messages::Notice,
    operator::{Operator, Taken},
    sessions::SessionEvent,
};
use crate::{
    dropped::NotComputed,
    error::{FieldError, ServiceError},
    session::{Outbound, Reader, StreamContext},
};

/// Serves the stream of an operator or an observer after it was accepted.
///
/// An operator who half-closes leaves. An observer has nothing to send, and goes on listening.
pub(super) async fn run<R: From<Notice>>(
    context: &StreamContext,
    joined: &Joined,
    told: broadcast::Receiver<SessionEvent>,
    inbound: Option<Reader<TeleoperateRequest>>,
    outbound: &Outbound<R>,
) -> Result<(), ServiceError> {
    let retargeting = joined.retargeting.as_deref();
    let operator = retargeting.map(|retargeting| Operator::new(joined, retargeting));
    let listener = Listener {
        joined,
        operator: operator.as_ref(),
        outbox: VecDeque::new(),
        taken: Taken::default(),
        lost: LossCounter::default(),
        next: joined.member.periods(),
    };
    let listening = async {
        let end = listener.run(context, told, inbound, outbound).await;
        operator.as_ref().inspect(|operator| operator.close());
        end
    };
    match &operator {
        Some(operator) => tokio::join!(listening, operator.retarget()).0,
        None => listening.await,
    }
}

struct Listener<'a> {
    joined: &'a Joined,
    operator: Option<&'a Operator<'a>>,
    outbox: VecDeque<Notice>,
    taken: Taken,
    lost: LossCounter,
    /// Number of the control period that is told next.
    next: u64,
}

impl Listener<'_> {
    async fn run<R: From<Notice>>(
        mut self,
        context: &StreamContext,
        mut told: broadcast::Receiver<SessionEvent>,
        mut inbound: Option<Reader<TeleoperateRequest>>,
        outbound: &Outbound<R>,
    ) -> Result<(), ServiceError> {
        let drain = &context.drain;
        let over = drain.over();
        tokio::pin!(over);
        let mut is_told = false;
        loop {
            let has_room = self.outbox.len() < context.buffer;
            tokio::select! {
                permit = outbound.reserve(), if !self.outbox.is_empty() => match permit {
                    Ok(permit) => {
                        if let Some(notice) = self.outbox.pop_front() {
                            permit.send(notice.into());
                        }
                    }
                    Err(_) => return Ok(()),
                },
                message = next(&mut inbound), if has_room => match message {
                    Ok(Some(message)) => self.accept(message)?,
                    Ok(None) if self.operator.is_some() => break,
                    Ok(None) => inbound = None,
                    // An observer is silent by trade.
                    Err(ServiceError::Silent(_)) if self.operator.is_none() => {}
                    Err(error) => return Err(error),
                },
                // What is told waits in the channel, which forgets what a slow reader leaves there for long.
                news = told.recv(), if self.outbox.is_empty() => match news {
                    Ok(event) => self.pass_on(event),
                    Err(RecvError::Lagged(_)) => {}
                    Err(RecvError::Closed) => break,
                },
                () = drain.begun.cancelled(), if !is_told => {
                    is_told = true;
                    self.outbox.push_back(Notice::GoingAway(drain.notice()));
                }
                () = &mut over => return Err(ServiceError::ShuttingDown),
            }
            // Without a robot there is nothing to wait for.
            if is_told && self.outbox.is_empty() && !self.joined.member.presence().robot {
                return Err(ServiceError::ShuttingDown);
            }
        }
        for notice in self.outbox {
            if outbound.send(notice.into()).await.is_err() {
                break;
            }
        }
        Ok(())
    }

    fn accept(&mut self, request: TeleoperateRequest) -> Result<(), ServiceError> {
        let (header, error) = match (request.message, self.operator) {
            (Some(Request::Operator(frame)), Some(operator)) => {
                let header = frame.header;
                let lost = self.lost.count(header.as_ref());
                self.joined.member.heard(lost);
                let taken = operator.take(&frame, header, Instant::now(), &mut self.taken);
                match taken {
                    Ok(Some(pose)) => return operator.push(pose),
                    Ok(None) => return Ok(()),
                    Err(error) => (header, error),
                }
            }
            (Some(Request::Config(_)), _) => return Err(FieldError::second_config().into()),
            (None, _) => return Err(FieldError::missing_frame().into()),
            (Some(frame), operator) => {
                let (header, sent) = match frame {
                    Request::Operator(frame) => (frame.header, "operator"),
                    Request::Robot(frame) => (frame.header, "robot"),
                    Request::Both(frame) => (frame.robot.and_then(|robot| robot.header), "both"),
                    Request::Config(_) => (None, "config"),
                };
                let description = match operator {
                    Some(_) => "this client is the session's operator; expected `operator`",
                    None => "an observer sends no frames",
                };
                (header, FieldError::new(sent, description))
            }
        };
        let notice = NotComputed::from(error).notice(header);
        self.outbox.push_back(Notice::Dropped(notice));
        Ok(())
    }

    fn pass_on(&mut self, event: SessionEvent) {
        self.outbox.push_back(match event {
            SessionEvent::Presence(presence) => Notice::Presence(presence),
            SessionEvent::Result(result) => {
                let mut result = (*result).clone();
                result.missed = result.number.saturating_sub(self.next);
                self.next = result.number + 1;
                Notice::Result(Box::new(result))
            }
        });
    }
}

/// The client's next message; waits for ever where it sends none.
async fn next(
    inbound: &mut Option<Reader<TeleoperateRequest>>,
) -> Result<Option<TeleoperateRequest>, ServiceError> {
    match inbound {
        Some(inbound) => inbound.next().await,
        None => std::future::pending().await,
    }
}
