//! A stream on which each frame is sent when the one before it was answered or given up.

use anyhow::{Context, Result, bail, ensure};
use emp_client::{DropCause, DropReason, Event, FrameSender, StreamEvents};

const SUPERSEDED: DropCause = DropCause::Server(DropReason::Superseded);

/// Both ends of a stream to the server.
pub(crate) struct Stream<F, A> {
    sender: FrameSender<F>,
    events: StreamEvents<A>,
}

impl<F: Clone, A: Numbered> Stream<F, A> {
    pub(crate) fn new((sender, events): (FrameSender<F>, StreamEvents<A>)) -> Self {
        Self { sender, events }
    }

    /// Refuses a server whose joints are not these.
    pub(crate) fn check_joints<'a>(&self, expected: impl Iterator<Item = &'a str>) -> Result<()> {
        let expected: Vec<&str> = expected.collect();
        let names = self.events.joint_names();
        ensure!(
            expected == names,
            "the server's joints are {names:?}, the robot's {expected:?}"
        );
        Ok(())
    }

    /// Sends a frame and waits for its answer; answers to earlier frames come too late and are thrown away.
    pub(crate) async fn ask(&mut self, frame: &F) -> Result<A> {
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
            match event {
                Event::Answer(answer) => return Ok(answer),
                // A period that was not answered in time is over.
                Event::Dropped(dropped) if dropped.cause == SUPERSEDED => {}
                Event::Dropped(dropped) => bail!(
                    "dropped ({}) {} {}",
                    dropped.cause.name(),
                    dropped.field,
                    dropped.description
                ),
                Event::ConnectionLost { reason, .. } => eprintln!("connection lost: {reason}"),
                Event::GoingAway { .. } => eprintln!("the server is being stopped"),
                Event::Reconnected { .. } => eprintln!("connection restored"),
            }
        }
    }

    /// Ends the stream and waits for what is still on its way.
    pub(crate) async fn finish(mut self) -> Result<()> {
        drop(self.sender);
        while self.events.next().await?.is_some() {}
        Ok(())
    }
}

/// An answer that says which frame it answers.
pub(crate) trait Numbered {
    fn number(&self) -> u64;
}

impl Numbered for emp_client::Answer {
    fn number(&self) -> u64 {
        self.sequence_number
    }
}
