//! Frames of a robot between the task that reads them and the one that computes them.

use std::{
    collections::VecDeque,
    sync::{Mutex, MutexGuard, PoisonError},
};

use emp_proto::v1::{Delivery, DroppedFrame};
use tokio::sync::Notify;

/// What waits its turn. Notices wait with `ALL`, so that the answers keep the order of the frames.
#[derive(Debug, PartialEq)]
pub(super) enum Waiting<F> {
    Frame(F),
    Notice(DroppedFrame),
}

/// A bounded queue (`ALL`), or a slot for the newest frame (`LATEST`).
pub(super) struct Inbox<F> {
    delivery: Delivery,
    limit: usize,
    inner: Mutex<Inner<F>>,
    /// Something came in, or nothing will any more.
    filled: Notify,
    /// Something was taken out.
    emptied: Notify,
}

struct Inner<F> {
    waiting: VecDeque<Waiting<F>>,
    closed: bool,
}

impl<F> Inbox<F> {
    pub(super) fn new(delivery: Delivery, limit: usize) -> Self {
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
    pub(super) async fn room(&self) {
        while self.delivery != Delivery::Latest && self.lock().waiting.len() >= self.limit {
            self.emptied.notified().await;
        }
    }

    /// Adds a frame, and gives back the one whose place it takes; `inherit` tells it of that one.
    pub(super) fn push(&self, mut frame: F, inherit: impl FnOnce(&F, &mut F)) -> Option<F> {
        let mut inner = self.lock();
        let old = match self.delivery {
            Delivery::Latest => inner.waiting.pop_front(),
            _ => None,
        };
        let old = match old {
            Some(Waiting::Frame(old)) => Some(old),
            _ => None,
        };
        if let Some(old) = &old {
            inherit(old, &mut frame);
        }
        inner.waiting.push_back(Waiting::Frame(frame));
        self.filled.notify_one();
        old
    }

    /// Adds a notice where it must wait its turn; gives it back where it need not.
    pub(super) fn push_notice(&self, notice: DroppedFrame) -> Option<DroppedFrame> {
        if self.delivery == Delivery::Latest {
            return Some(notice);
        }
        self.lock().waiting.push_back(Waiting::Notice(notice));
        self.filled.notify_one();
        None
    }

    /// Says that nothing more comes.
    pub(super) fn close(&self) {
        self.lock().closed = true;
        self.filled.notify_one();
    }

    /// Waits for what is next; none once the inbox is closed and empty.
    pub(super) async fn next(&self) -> Option<Waiting<F>> {
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

#[cfg(test)]
mod tests {
    use super::*;

    fn sum(old: &u32, new: &mut u32) {
        *new += old;
    }

    fn notice() -> DroppedFrame {
        DroppedFrame::default()
    }

    #[tokio::test]
    async fn with_all_everything_waits_in_order_and_a_full_inbox_has_no_room() {
        let inbox = Inbox::new(Delivery::All, 2);
        assert_eq!(inbox.push(1, sum), None);
        assert_eq!(inbox.push_notice(notice()), None);
        let room = inbox.room();
        tokio::pin!(room);
        assert!(polled_once(room.as_mut()).await.is_none(), "full");
        assert_eq!(inbox.next().await, Some(Waiting::Frame(1)));
        room.await;
        inbox.close();
        assert_eq!(inbox.next().await, Some(Waiting::Notice(notice())));
        assert_eq!(inbox.next().await, None);
    }

    #[tokio::test]
    async fn with_latest_the_newest_takes_the_place_of_the_one_that_waits() {
        let inbox = Inbox::new(Delivery::Latest, 2);
        for (frame, replaced) in [(1, None), (2, Some(1)), (4, Some(3))] {
            inbox.room().await;
            assert_eq!(inbox.push(frame, sum), replaced);
        }
        assert_eq!(inbox.push_notice(notice()), Some(notice()));
        inbox.close();
        assert_eq!(inbox.next().await, Some(Waiting::Frame(7)));
        assert_eq!(inbox.next().await, None);
    }

    #[tokio::test]
    async fn whoever_waits_for_a_frame_is_woken() {
        let inbox = Inbox::new(Delivery::All, 2);
        let push = async {
            tokio::task::yield_now().await;
            inbox.push(1, sum);
        };
        let (next, ()) = tokio::join!(inbox.next(), push);
        assert_eq!(next, Some(Waiting::Frame(1)));
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
