//! Frames of a stream between the part of its task that reads them and the one that computes them: the one place that knows what
//! `ALL` and `LATEST` mean.

use std::{
    collections::VecDeque,
    sync::{Mutex, MutexGuard, PoisonError},
};

use emp_proto::v1::{Delivery, DroppedFrame, FrameHeader};
use tokio::sync::Notify;

use crate::{
    dropped::NotComputed,
    error::{FieldError, ServiceError},
};

/// Most notices that wait for a client that does not read.
const MOST_NOTICES: usize = 4_096;

/// What waits in an inbox.
pub(crate) trait Queued {
    fn header(&self) -> Option<FrameHeader>;

    /// Takes the place of an older one.
    fn supersede(&mut self, _old: &Self) {}
}

/// What comes next.
#[derive(Debug, PartialEq)]
pub(crate) enum Next<F> {
    Frame(F),
    /// A frame has no answer. With `ALL`, notices wait their turn, so that the answers keep the order of the frames.
    Notice(DroppedFrame),
}

/// A bounded queue (`ALL`), or a slot for the newest frame (`LATEST`).
pub(crate) struct Inbox<F> {
    delivery: Delivery,
    limit: usize,
    inner: Mutex<Inner<F>>,
    /// Something came in, or nothing will any more.
    filled: Notify,
    /// Something was taken out.
    emptied: Notify,
}

struct Inner<F> {
    waiting: VecDeque<Next<F>>,
    closed: bool,
}

impl<F: Queued> Inbox<F> {
    pub(crate) fn new(delivery: Delivery, limit: usize) -> Self {
        Self {
            delivery,
            limit,
            inner: Mutex::new(Inner {
                waiting: VecDeque::new(),
                closed: false,
            }),
            filled: Notify::new(),
            emptied: Notify::new(),
        }
    }

    /// Waits for room. With `LATEST` there always is.
    pub(crate) async fn room(&self) {
        while self.delivery != Delivery::Latest && self.lock().waiting.len() >= self.limit {
            self.emptied.notified().await;
        }
    }

    /// Adds a frame. With `LATEST` it takes the place of one that waits.
    ///
    /// # Errors
    /// When the client reads too slowly for all that it must be told.
    pub(crate) fn push(&self, mut frame: F) -> Result<(), ServiceError> {
        let mut inner = self.lock();
        if self.delivery == Delivery::Latest
            && let Some(Next::Frame(old)) = inner.waiting.pop_back_if(|next| next.is_frame())
        {
            frame.supersede(&old);
            let notice = NotComputed::superseded().notice(old.header());
            inner.waiting.push_back(Next::Notice(notice));
        }
        inner.waiting.push_back(Next::Frame(frame));
        self.filled.notify_one();
        inner.check()
    }

    /// Adds a notice: in its turn with `ALL`, before the frame that waits with `LATEST`.
    ///
    /// # Errors
    /// When the client reads too slowly for all that it must be told.
    pub(crate) fn push_notice(&self, notice: DroppedFrame) -> Result<(), ServiceError> {
        let mut inner = self.lock();
        let last = inner
            .waiting
            .pop_back_if(|next| self.delivery == Delivery::Latest && next.is_frame());
        inner.waiting.push_back(Next::Notice(notice));
        inner.waiting.extend(last);
        self.filled.notify_one();
        inner.check()
    }

    /// Says that nothing more comes.
    pub(crate) fn close(&self) {
        self.lock().closed = true;
        self.filled.notify_one();
    }

    /// Waits for what is next; none once the inbox is closed and empty.
    pub(crate) async fn next(&self) -> Option<Next<F>> {
        loop {
            let (next, closed) = {
                let mut inner = self.lock();
                (inner.waiting.pop_front(), inner.closed)
            };
            if next.is_some() {
                self.emptied.notify_one();
                return next;
            }
            if closed {
                return None;
            }
            self.filled.notified().await;
        }
    }

    /// No code that can panic runs under the lock, so a poisoned one still holds sound data.
    fn lock(&self) -> MutexGuard<'_, Inner<F>> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<F> Inner<F> {
    fn check(&self) -> Result<(), ServiceError> {
        if self.waiting.len() > MOST_NOTICES {
            return Err(ServiceError::Silent("the client reads too slowly"));
        }
        Ok(())
    }
}

impl<F> Next<F> {
    fn is_frame(&self) -> bool {
        matches!(self, Self::Frame(_))
    }
}

/// Reads a config's delivery; a stream of robots and poses alike has the newest frame where nothing is said.
pub(crate) fn read_delivery(number: i32) -> Result<Delivery, FieldError> {
    match Delivery::try_from(number) {
        Ok(Delivery::Unspecified | Delivery::Latest) => Ok(Delivery::Latest),
        Ok(Delivery::All) => Ok(Delivery::All),
        Err(_) => Err(FieldError::not_in("Delivery", "config.delivery", number)),
    }
}

#[cfg(test)]
mod tests {
    use emp_proto::v1::DropReason;

    use super::*;

    impl Queued for u64 {
        fn header(&self) -> Option<FrameHeader> {
            Some(FrameHeader {
                sequence_number: *self,
                ..FrameHeader::default()
            })
        }

        fn supersede(&mut self, old: &Self) {
            *self += old;
        }
    }

    fn notice() -> DroppedFrame {
        DroppedFrame::default()
    }

    #[tokio::test]
    async fn with_all_everything_waits_in_order_and_a_full_inbox_has_no_room() {
        let inbox = Inbox::new(Delivery::All, 2);
        inbox.push(1).expect("room");
        inbox.push_notice(notice()).expect("room");
        let room = inbox.room();
        tokio::pin!(room);
        assert!(polled_once(room.as_mut()).await.is_none(), "full");
        assert_eq!(inbox.next().await, Some(Next::Frame(1)));
        room.await;
        inbox.close();
        assert_eq!(inbox.next().await, Some(Next::Notice(notice())));
        assert_eq!(inbox.next().await, None);
    }

    #[tokio::test]
    async fn with_latest_the_newest_takes_the_place_of_the_one_that_waits() {
        let inbox = Inbox::new(Delivery::Latest, 2);
        for frame in [1, 2, 4] {
            inbox.room().await;
            inbox.push(frame).expect("room");
        }
        inbox.push_notice(notice()).expect("room");
        inbox.close();
        for superseded in [1, 3] {
            let Some(Next::Notice(notice)) = inbox.next().await else {
                panic!("a notice")
            };
            assert_eq!(notice.reason(), DropReason::Superseded);
            assert_eq!(notice.header, superseded.header());
        }
        assert_eq!(inbox.next().await, Some(Next::Notice(notice())));
        assert_eq!(inbox.next().await, Some(Next::Frame(7)));
        assert_eq!(inbox.next().await, None);
    }

    #[tokio::test]
    async fn a_client_that_does_not_read_is_given_up() {
        let inbox = Inbox::new(Delivery::Latest, 2);
        let pushed = (0..2 * MOST_NOTICES).map(|_| inbox.push(0)).collect();
        let error: Result<(), ServiceError> = pushed;
        assert!(matches!(error, Err(ServiceError::Silent(_))), "{error:?}");
    }

    #[tokio::test]
    async fn whoever_waits_for_a_frame_is_woken() {
        let inbox = Inbox::new(Delivery::All, 2);
        let push = async {
            tokio::task::yield_now().await;
            inbox.push(1)
        };
        let (next, pushed) = tokio::join!(inbox.next(), push);
        pushed.expect("room");
        assert_eq!(next, Some(Next::Frame(1)));
    }

    async fn polled_once<T>(mut future: std::pin::Pin<&mut impl Future<Output = T>>) -> Option<T> {
        std::future::poll_fn(|context| {
            std::task::Poll::Ready(match future.as_mut().poll(context) {
                std::task::Poll::Ready(value) => Some(value),
                std::task::Poll::Pending => None,
            })
        })
        .await
    }
}
