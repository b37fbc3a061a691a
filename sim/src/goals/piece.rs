//! A piece of a clip, as it is played.

use emp_robot::Robot;
use serde::{Deserialize, Serialize};

use super::live::LiveStream;
use super::{GoalClip, GoalError};

/// A piece of a clip, as it is played.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Piece {
    /// Index of the clip among those it was drawn from.
    pub(crate) clip: usize,
    /// Where it starts in the clip, frames.
    pub(crate) start: f64,
    /// Frames of the clip in one control period.
    pub(crate) tempo: f32,
    /// Control periods, at least 1.
    pub(crate) frames: usize,
    /// Factor on the distance from the default pose.
    pub(crate) amplitude: f32,
    pub(crate) mirrored: bool,
    /// The stream through which it comes; none: every control period has its own goal.
    pub(crate) live: Option<LiveStream>,
}

impl Piece {
    /// Control periods of at most `longest` that a clip of so many frames lasts at this tempo.
    pub(crate) fn periods(clip_frames: usize, tempo: f32, longest: usize) -> usize {
        longest.min(((clip_frames - 1) as f64 / f64::from(tempo)) as usize + 1)
    }

    /// How far into a clip of so many frames a piece of `periods` can start, frames.
    pub(crate) fn spare(clip_frames: usize, tempo: f32, periods: usize) -> f64 {
        ((clip_frames - 1) as f64 - (periods - 1) as f64 * f64::from(tempo)).max(0.0)
    }

    /// The same piece as it would be if every control period had its own goal.
    pub(crate) fn steady(&self) -> Self {
        Self {
            live: None,
            ..self.clone()
        }
    }

    /// The goal of control period `t` of this piece of `clip`; beyond the piece's end the clip goes on, beyond its own it rests.
    pub(crate) fn goal(&self, clip: &GoalClip, joints: &[GoalJoint], t: usize, out: &mut [f32]) {
        let now = t as f64;
        let seen = self.live.map_or(now, |live| live.captured(now));
        let at = self.start + seen * f64::from(self.tempo);
        if self.mirrored {
            clip.interpolate(at, |joint| joints[joint].partner, out);
        } else {
            clip.interpolate(at, |joint| joint, out);
        }
        for (out, joint) in out.iter_mut().zip(joints) {
            let sign = if self.mirrored { joint.sign } else { 1.0 };
            let offset = self.amplitude * (sign * *out - joint.default);
            *out = (joint.default + offset).clamp(joint.range[0], joint.range[1]);
        }
    }
}

/// What has to be known of a goal joint to play a piece.
#[derive(Clone, Copy, Debug)]
pub(crate) struct GoalJoint {
    pub(crate) range: [f32; 2],
    default: f32,
    /// Whose angle it takes in the mirror, and with what sign.
    partner: usize,
    sign: f32,
}

impl GoalJoint {
    /// The goal joints of `robot`.
    pub(crate) fn all(robot: &Robot) -> Result<Vec<Self>, GoalError> {
        let mirror = robot.mirror()?;
        let joints = robot.goal_joints().iter().enumerate();
        Ok(joints
            .map(|(i, joint)| Self {
                range: joint.range.map(|limit| limit as f32),
                default: joint.default as f32,
                partner: mirror.permutation()[i],
                sign: mirror.signs()[i],
            })
            .collect())
    }
}

/// Refuses clips that `robot` cannot play.
pub(crate) fn check_clips(robot: &Robot, clips: &[GoalClip]) -> Result<(), GoalError> {
    let expected = robot.goal_joints().len();
    if clips.is_empty() {
        return Err(GoalError::NoClip);
    }
    match clips.iter().find(|clip| clip.joints() != expected) {
        Some(clip) => Err(GoalError::Joints {
            clip: clip.name.clone(),
            expected,
            found: clip.joints(),
        }),
        None => Ok(()),
    }
}
