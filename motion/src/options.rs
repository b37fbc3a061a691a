//! What a motion file does not say, or says wrongly, and the caller may know better.

use std::fmt;
use std::str::FromStr;

use nalgebra::Vector3;

use crate::{KeyNode, Side};

/// Metres in one file unit, by the unit's name.
pub(crate) const UNIT_NAMES: [(&str, f64); 5] = [
    ("m", 1.0),
    ("cm", 0.01),
    ("mm", 0.001),
    ("in", 0.0254),
    ("ft", 0.3048),
];

/// How to read a motion file. Everything left open is detected.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ReadOptions {
    /// Frames a second, in place of the file's own rate.
    pub fps: Option<f64>,
    /// Metres in one unit of the file.
    pub metres_per_unit: Option<f64>,
    /// The axis that points up.
    pub up: Option<UpAxis>,
    /// Whether the file holds the mirror image of its person, as left-handed exports do.
    pub mirror: Option<bool>,
    /// The file's own names of joints (or markers), in place of those found.
    pub map: Vec<(BodyJoint, String)>,
}

impl ReadOptions {
    /// The name that the map gives to a joint.
    pub(crate) fn mapped(&self, joint: BodyJoint) -> Option<&str> {
        let entry = self.map.iter().rev().find(|(key, _)| *key == joint);
        entry.map(|(_, name)| name.as_str())
    }
}

/// The axis of a file that points up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum UpAxis {
    /// x points up.
    X,
    /// y points up, as in most BVH files.
    Y,
    /// z points up.
    Z,
    /// x points down.
    MinusX,
    /// y points down, as in camera coordinates.
    MinusY,
    /// z points down.
    MinusZ,
}

impl UpAxis {
    /// All six, positive ones first.
    pub const ALL: [Self; 6] = [
        Self::X,
        Self::Y,
        Self::Z,
        Self::MinusX,
        Self::MinusY,
        Self::MinusZ,
    ];

    /// The direction in the file's axes, unit length.
    #[must_use]
    pub fn direction(self) -> Vector3<f64> {
        match self {
            Self::X => Vector3::x(),
            Self::Y => Vector3::y(),
            Self::Z => Vector3::z(),
            Self::MinusX => -Vector3::x(),
            Self::MinusY => -Vector3::y(),
            Self::MinusZ => -Vector3::z(),
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::X => "x",
            Self::Y => "y",
            Self::Z => "z",
            Self::MinusX => "-x",
            Self::MinusY => "-y",
            Self::MinusZ => "-z",
        }
    }
}

impl fmt::Display for UpAxis {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for UpAxis {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let name = text.trim().trim_start_matches('+').to_ascii_lowercase();
        Self::ALL
            .into_iter()
            .find(|axis| axis.name() == name)
            .ok_or_else(|| format!("expected x, y, z, -x, -y or -z, found {text:?}"))
    }
}

/// A joint whose name in a file can be given.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum BodyJoint {
    /// A key node.
    Node(KeyNode),
    /// The top of a thigh; both hips together tell where the pelvis faces.
    Hip(Side),
}

impl BodyJoint {
    /// The key nodes in order, then both hips.
    pub fn all() -> impl Iterator<Item = Self> {
        let nodes = KeyNode::ALL.into_iter().map(Self::Node);
        nodes.chain(Side::BOTH.map(Self::Hip))
    }

    /// The name by which it is asked for: a key node's, `left_hip` or `right_hip`.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Node(node) => node.name(),
            Self::Hip(Side::Left) => "left_hip",
            Self::Hip(Side::Right) => "right_hip",
        }
    }
}

impl FromStr for BodyJoint {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::all()
            .find(|joint| joint.name() == text)
            .ok_or_else(|| {
                let names: Vec<&str> = Self::all().map(Self::name).collect();
                format!("expected one of {}, found {text:?}", names.join(", "))
            })
    }
}

/// Metres in a unit: `m`, `cm`, `mm`, `in`, `ft`, or a number of metres.
///
/// # Errors
/// What was expected, for anything else and for a number that is not positive.
pub fn parse_unit(text: &str) -> Result<f64, String> {
    let known = UNIT_NAMES.iter().find(|(name, _)| *name == text);
    known
        .map(|(_, metres)| *metres)
        .or_else(|| {
            text.parse()
                .ok()
                .filter(|m: &f64| m.is_finite() && *m > 0.0)
        })
        .ok_or_else(|| {
            format!("expected m, cm, mm, in, ft or a positive number of metres, found {text:?}")
        })
}
