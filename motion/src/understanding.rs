//! What a reader took a motion file for, so that a person can see a misreading.

use std::fmt;

use serde::Serialize;

use crate::Clip;

/// A motion as read, and what it was taken for.
#[derive(Clone, Debug)]
pub struct Reading {
    /// The motion.
    pub clip: Clip,
    /// What the file was taken for.
    pub understanding: Understanding,
}

/// What a file was taken for.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Understanding {
    /// The file format.
    pub format: &'static str,
    /// Whose names the joints (or markers) have; `unknown` where the tree's structure alone told.
    pub naming: String,
    /// Frames read.
    pub frames: usize,
    /// Frames a second.
    pub fps: f64,
    /// The file's unit of length: a name, or metres; `None` where the format has no lengths.
    pub unit: Option<String>,
    /// The file's axis that points up; `None` where the format leaves no choice.
    pub up: Option<String>,
    /// `right-handed`, or `mirrored` where a mirror image was mended; `None` where the body does not tell.
    pub handedness: Option<&'static str>,
    /// About how tall the person is, metres; `None` where the file has no legs or no head.
    pub height: Option<f64>,
    /// The file's joint (or markers) of each key node, in the order of the nodes.
    pub joints: Vec<NodeJoint>,
    /// Left and right hand: how its axes were found, or `not followed: …`.
    pub hands: [String; 2],
    /// What the reader decided or mended that may be wrong.
    pub warnings: Vec<String>,
}

/// The joint that carries a key node.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct NodeJoint {
    /// The key node.
    pub node: &'static str,
    /// The file's name for it.
    pub joint: String,
}

impl Understanding {
    /// The same in two lines, warnings counted only.
    #[must_use]
    pub fn summary(&self) -> String {
        let joints: Vec<&str> = self.joints.iter().map(|j| j.joint.as_str()).collect();
        let joints = if joints.is_empty() {
            String::new()
        } else {
            format!("joints {}; ", joints.join(", "))
        };
        let hands = if self.hands[0] == self.hands[1] {
            self.hands[0].clone()
        } else {
            format!("left {}, right {}", self.hands[0], self.hands[1])
        };
        format!("{}\n  {joints}hands {hands}", self.headline())
    }

    fn headline(&self) -> String {
        let mut parts = vec![
            format!("{}, {} names", self.format, self.naming),
            format!(
                "{} frames at {} Hz ({:.1} s)",
                self.frames,
                rounded(self.fps),
                self.frames.saturating_sub(1) as f64 / self.fps
            ),
        ];
        parts.extend(self.unit.as_ref().map(|unit| format!("unit {unit}")));
        parts.extend(self.up.as_ref().map(|up| format!("{up} up")));
        parts.extend(self.handedness.map(str::to_owned));
        parts.extend(self.height.map(|height| format!("{height:.2} m tall")));
        parts.join(", ")
    }
}

impl fmt::Display for Understanding {
    /// Everything, a line each.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let unknown = || "unknown".to_owned();
        writeln!(f, "format      {}", self.format)?;
        writeln!(f, "names       {}", self.naming)?;
        writeln!(f, "frames      {}", self.frames)?;
        writeln!(f, "rate        {} Hz", rounded(self.fps))?;
        writeln!(
            f,
            "unit        {}",
            self.unit
                .clone()
                .unwrap_or_else(|| "the format's own".to_owned())
        )?;
        writeln!(
            f,
            "up          {}",
            self.up
                .clone()
                .unwrap_or_else(|| "the format's own".to_owned())
        )?;
        writeln!(
            f,
            "handedness  {}",
            self.handedness.map_or_else(unknown, str::to_owned)
        )?;
        let height = self.height.map(|height| format!("{height:.2} m"));
        writeln!(f, "height      {}", height.unwrap_or_else(unknown))?;
        for NodeJoint { node, joint } in &self.joints {
            writeln!(f, "{node:<15} {joint}")?;
        }
        writeln!(f, "left hand   {}", self.hands[0])?;
        writeln!(f, "right hand  {}", self.hands[1])?;
        for warning in &self.warnings {
            writeln!(f, "warning: {warning}")?;
        }
        Ok(())
    }
}

/// At most three digits after the point, none where they are zeros.
fn rounded(value: f64) -> f64 {
    (value * 1000.0).round() / 1000.0
}
