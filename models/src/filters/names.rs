//! Names of the goal filters, and what each does.

/// The name of the controller without a filter: the goal goes to the robot as it is.
pub const DECOUPLED: &str = "decoupled";
/// The name of the EMP that always filters.
pub const EMP: &str = "emp";
/// The name of the EMP that filters when there is danger.
pub const EMP_WHEN_DANGER: &str = "emp-when-danger";
pub(super) const VELOCITY_LIMIT: &str = "velocity-limit";
pub(super) const ONE_EURO: &str = "one-euro";
pub(super) const AMPLITUDE_CUT: &str = "amplitude-cut";
pub(super) const LOW_PASS: &str = "low-pass";
pub(super) const SOFT_KNEE: &str = "soft-knee";
pub(super) const STATIC_CLAMP: &str = "static-clamp";

/// A filter that can be called by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FilterDescription {
    /// Its name.
    pub name: &'static str,
    /// Its parameters with their defaults, as in a specification; empty if it has none.
    pub parameters: &'static str,
    /// What it does, in a line.
    pub summary: &'static str,
}

/// All of them.
pub const LIST: [FilterDescription; 9] = [
    FilterDescription {
        name: DECOUPLED,
        parameters: "",
        summary: "no filter: the goal goes to the robot as it is",
    },
    FilterDescription {
        name: EMP,
        parameters: "",
        summary: "the robot's Executable Motion Prior",
    },
    FilterDescription {
        name: EMP_WHEN_DANGER,
        parameters: "regloss=<the checkpoint's gate>,tilt=<none>",
        summary: "the EMP while regloss, or the base's tilt (rad), is above its limit; one limit at most",
    },
    FilterDescription {
        name: VELOCITY_LIMIT,
        parameters: "limit=<each joint's own>,joints=<all>",
        summary: "no joint's goal moves faster than limit (rad/s)",
    },
    FilterDescription {
        name: ONE_EURO,
        parameters: "cutoff=2,beta=0.5,derivative=1,joints=<all>",
        summary: "low-pass at cutoff (Hz) that opens by beta (Hz per rad/s) as a joint speeds up; derivative (Hz) smooths that speed",
    },
    FilterDescription {
        name: AMPLITUDE_CUT,
        parameters: "factor=0.9,joints=<all>",
        summary: "every goal's distance from the default pose times factor (0 to 1)",
    },
    FilterDescription {
        name: LOW_PASS,
        parameters: "cutoff=2,order=1,joints=<all>",
        summary: "low-pass at cutoff (Hz, half power), order equal first-order sections in a row, no overshoot",
    },
    FilterDescription {
        name: SOFT_KNEE,
        parameters: "shoulder_pitch=-1.5,slope=0.6",
        summary: "joints whose name holds the word (any number of word=angle) go on at slope (0 to 1) beyond the angle (rad)",
    },
    FilterDescription {
        name: STATIC_CLAMP,
        parameters: "margin=<0.7 of the default pose's>,legs=default",
        summary: "goals are pulled to the default pose until the centre of mass is margin (m) inside the feet's support; legs default or measured",
    },
];
