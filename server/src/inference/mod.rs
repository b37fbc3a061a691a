//! Models behind their queues: what a model is asked ([`backend`]), a robot's controllers as such ([`controllers`]), the queue in
//! front of a model ([`queue`]), and the thread between them that forms batches ([`batcher`]).
//!
//! It knows inputs, answers and deadlines, and no message of the wire.

pub(crate) mod backend;
pub(crate) mod batcher;
pub(crate) mod controllers;
pub(crate) mod due;
pub(crate) mod queue;
