//! Messages off the wire as the server's own values, checked field by field: whatever is wrong is refused by the field's name.

pub(crate) mod deadline;
pub(crate) mod environment;
pub(crate) mod fields;
pub(crate) mod pose;
pub(crate) mod robot_state;
pub(crate) mod rollouts;
