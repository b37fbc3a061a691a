//! Goal-joint angles over time.

use emp_models::retarget::{Retargeter, predict_clip, retarget_clips};
use emp_motion::Clip;
use emp_robot::{JointMirror, Robot};
use serde::{Deserialize, Serialize};

use super::GoalError;

/// Where a clip's motion comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Source {
    /// Motion of a person, recorded.
    Recorded,
    /// A procedural skill.
    Procedural,
}

/// A sequence of goals: rows of goal-joint angles (rad, goal order), one each control period, inside the joints' ranges.
#[derive(Clone, Debug, PartialEq)]
pub struct GoalClip {
    /// Where it comes from: a file's stem or a skill and its seed, with `@frame` where it is a window of a longer clip.
    pub name: String,
    /// The recording or procedural motion that it is a piece of: pieces of one are not independent.
    pub motion: String,
    /// Whether a person moved.
    pub source: Source,
    joints: usize,
    /// Frame by frame.
    angles: Vec<f32>,
}

impl GoalClip {
    /// The shortest clip that [`windows`](Self::windows) keeps, frames.
    pub const SHORTEST_WINDOW: usize = 60;

    /// A clip of the frames `rows`; angles outside a joint's range are moved to its limit.
    ///
    /// # Errors
    /// If there is no frame, or one is not one finite angle for each goal joint.
    pub fn new(
        robot: &Robot,
        name: impl Into<String>,
        source: Source,
        rows: &[impl AsRef<[f32]>],
    ) -> Result<Self, GoalError> {
        let name = name.into();
        let joints = robot.goal_joints();
        if rows.is_empty() {
            return Err(GoalError::Empty { clip: name });
        }
        let mut angles = Vec::with_capacity(rows.len() * joints.len());
        for (frame, row) in rows.iter().enumerate() {
            let row = row.as_ref();
            if row.len() != joints.len() || row.iter().any(|angle| !angle.is_finite()) {
                return Err(GoalError::Frame {
                    clip: name,
                    frame,
                    expected: joints.len(),
                    found: row.to_vec(),
                });
            }
            angles.extend(row);
        }
        let mut clip = Self::from_angles(name, source, joints.len(), angles);
        clip.clamp(robot);
        Ok(clip)
    }

    /// A clip of goals that are known to be some.
    pub(super) fn from_angles(
        name: String,
        source: Source,
        joints: usize,
        angles: Vec<f32>,
    ) -> Self {
        Self {
            motion: name.clone(),
            name,
            source,
            joints,
            angles,
        }
    }

    /// What `retargeter` makes of human motion: a clip of goals for each clip, in order, on `threads` threads.
    ///
    /// # Errors
    /// If a frame of `motion` is no pose, or the network fails.
    pub fn retargeted(
        retargeter: &Retargeter,
        motion: &[Clip],
        source: Source,
        threads: usize,
    ) -> Result<Vec<Self>, GoalError> {
        let rows = retarget_clips(retargeter, motion, threads)?;
        let clips = motion.iter().zip(rows);
        clips
            .map(|(clip, rows)| Self::new(retargeter.robot(), &clip.name, source, &rows))
            .collect()
    }

    /// What `retargeter` makes of one clip of human motion without refinement and smoothing, as a live stream may.
    ///
    /// # Errors
    /// If a frame of `motion` is no pose, or the network fails.
    pub fn retargeted_live(
        retargeter: &Retargeter,
        motion: &Clip,
        source: Source,
    ) -> Result<Self, GoalError> {
        let rows = predict_clip(retargeter, motion)?;
        Self::new(retargeter.robot(), &motion.name, source, &rows)
    }

    /// Number of frames, at least 1.
    #[expect(clippy::len_without_is_empty, reason = "a clip is never empty")]
    pub fn len(&self) -> usize {
        self.angles.len() / self.joints
    }

    /// Number of goal joints.
    pub fn joints(&self) -> usize {
        self.joints
    }

    /// The goal of control period `t`, the last one's beyond the end.
    pub fn frame(&self, t: usize) -> &[f32] {
        let start = t.min(self.len() - 1) * self.joints;
        &self.angles[start..start + self.joints]
    }

    /// All goals in order.
    pub fn frames(&self) -> impl ExactSizeIterator<Item = &[f32]> {
        self.angles.chunks_exact(self.joints)
    }

    /// The motion with its distance from the robot's default pose multiplied by `factor`, held inside the joints' ranges.
    #[must_use]
    pub fn scaled_amplitude(&self, robot: &Robot, factor: f32) -> Self {
        let mut clip = self.clone();
        for frame in clip.angles.chunks_exact_mut(self.joints) {
            for (angle, joint) in frame.iter_mut().zip(robot.goal_joints()) {
                let default = joint.default as f32;
                *angle = default + factor * (*angle - default);
            }
        }
        clip.clamp(robot);
        clip
    }

    /// The motion `factor` (above 0) times as fast: resampled, so that its number of frames changes.
    #[must_use]
    pub fn at_speed(&self, robot: &Robot, factor: f64) -> Self {
        let frames = ((self.len() - 1) as f64 / factor + 1e-9) as usize + 1;
        let mut clip = Self {
            angles: vec![0.0; frames * self.joints],
            ..self.clone()
        };
        for (t, frame) in clip.angles.chunks_exact_mut(self.joints).enumerate() {
            self.interpolate(t as f64 * factor, |joint| joint, frame);
        }
        clip.clamp(robot);
        clip
    }

    /// The motion in the mirror.
    #[must_use]
    pub fn mirrored(&self, mirror: &JointMirror) -> Self {
        let mut clip = self.clone();
        for (frame, image) in self.frames().zip(clip.angles.chunks_exact_mut(self.joints)) {
            mirror.goal(frame, image);
        }
        clip
    }

    /// The clip cut into consecutive pieces of `frames` for evaluation.
    ///
    /// What remains at the end is dropped. A clip that is shorter than one piece stays whole, unless it has fewer than
    /// [`SHORTEST_WINDOW`](Self::SHORTEST_WINDOW) frames: then nothing of it is left.
    #[must_use]
    pub fn windows(&self, frames: usize) -> Vec<Self> {
        let frames = frames.max(1);
        if self.len() < frames {
            let long_enough = self.len() >= Self::SHORTEST_WINDOW;
            return long_enough.then(|| self.clone()).into_iter().collect();
        }
        let pieces = self.angles.chunks_exact(frames * self.joints);
        let piece = |(index, angles): (usize, &[f32])| Self {
            name: match self.len() / frames {
                1 => self.name.clone(),
                _ => format!("{}@{}", self.name, index * frames),
            },
            motion: self.motion.clone(),
            source: self.source,
            joints: self.joints,
            angles: angles.to_vec(),
        };
        pieces.enumerate().map(piece).collect()
    }

    /// The goal at a time between frames (`at` in frames, cubic, continuous velocity); beyond the ends the end's.
    /// Joint j of `out` is joint `joint(j)` of the clip.
    pub(super) fn interpolate(&self, at: f64, joint: impl Fn(usize) -> usize, out: &mut [f32]) {
        let last = self.len() - 1;
        let at = at.clamp(0.0, last as f64);
        let i = at as usize;
        let [a, b, c, d] = catmull_rom((at - i as f64) as f32);
        let samples = [i.saturating_sub(1), i, i + 1, i + 2].map(|t| self.frame(t));
        let [before, here, next, after] = samples;
        for (j, out) in out.iter_mut().enumerate() {
            let j = joint(j);
            *out = a * before[j] + b * here[j] + c * next[j] + d * after[j];
        }
    }

    fn clamp(&mut self, robot: &Robot) {
        for frame in self.angles.chunks_exact_mut(self.joints) {
            robot.clamp_goal(frame);
        }
    }
}

/// Weights of four samples around a point at `u` in 0..1 between the middle two.
fn catmull_rom(u: f32) -> [f32; 4] {
    let (u2, u3) = (u * u, u * u * u);
    [
        0.5 * (-u3 + 2.0 * u2 - u),
        0.5 * (3.0 * u3 - 5.0 * u2 + 2.0),
        0.5 * (-3.0 * u3 + 4.0 * u2 + u),
        0.5 * (u3 - u2),
    ]
}
