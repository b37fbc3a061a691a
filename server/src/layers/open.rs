//! A call from when it was let in until it ends: its place, its caller, what is written about it.

use std::time::Instant;

use crate::{
    identity::{
        Caller, Place,
        methods::{Kind, Method},
    },
    metrics::metrics,
};

/// A call that was let in, until it ends.
pub(super) struct Open {
    pub(super) method: &'static Method,
    pub(super) caller: Caller,
    began: Instant,
    _place: Place,
}

impl Open {
    pub(super) fn begin(method: &'static Method, caller: Caller, place: Place) -> Self {
        metrics().call_began(method.path);
        if method.audited {
            caller.record("call", serde_json::json!({"method": method.path}));
        }
        Self {
            method,
            caller,
            began: Instant::now(),
            _place: place,
        }
    }

    pub(super) fn end(&self, code: &'static str) {
        let time = self.began.elapsed();
        let single = (self.method.kind == Kind::Call).then_some(time);
        metrics().call_ended(self.method.path, code, single);
        let seconds = time.as_secs_f64();
        tracing::debug!(method = self.method.path, code, seconds, "call ended");
        if self.method.audited {
            let facts =
                serde_json::json!({"method": self.method.path, "code": code, "seconds": seconds});
            self.caller.record("call ended", facts);
        }
    }
}
