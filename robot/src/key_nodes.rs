//! The key nodes: the points of a body that retargeting follows.

/// Number of key nodes.
pub const KEY_NODES: usize = 8;

/// Names of the key nodes, in the order in which they stand everywhere.
pub const KEY_NODE_NAMES: [&str; KEY_NODES] = [
    "waist",
    "torso",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
];

/// Where a key node sits.
#[derive(Clone, Debug, PartialEq)]
pub struct KeyNodeSite {
    /// One of [`KEY_NODE_NAMES`].
    pub name: &'static str,
    /// Body that carries it.
    pub body: String,
    /// Position in the body's frame, metres.
    pub offset: [f64; 3],
}
