//! What a rollout looks like in the mirror.

use emp_models::policy::PolicyConfig;
use emp_robot::{JointMirror, Robot, RobotError};

/// Mirrors a policy's features and actions.
#[derive(Clone, Debug)]
pub struct FeatureMirror {
    /// For each number of a frame, the number whose value it takes.
    permutation: Vec<usize>,
    /// For each number of a frame, its sign.
    signs: Vec<f32>,
    joints: JointMirror,
    /// Actions of one robot.
    actions: usize,
}

impl FeatureMirror {
    /// The mirror for `config`'s frames of `robot`. The history map mixes whole frames, so its blocks mirror as frames do.
    ///
    /// # Errors
    /// When the robot has no mirror image.
    pub fn new(robot: &Robot, config: &PolicyConfig) -> Result<Self, RobotError> {
        let joints = robot.mirror()?;
        let layout = &config.observation;
        let mut permutation = vec![0; layout.frame_width()];
        let mut signs = vec![1.0; layout.frame_width()];
        let goals = layout.goal().len();
        let mut part = |start: usize, range: std::ops::Range<usize>| {
            for (i, joint) in range.clone().enumerate() {
                permutation[start + i] = start + joints.permutation()[joint] - range.start;
                signs[start + i] = joints.signs()[joint];
            }
        };
        let all = layout.joint_positions().len();
        part(layout.joint_positions().start, 0..all);
        part(layout.last_action().start, goals..all);
        part(layout.goal().start, 0..goals);
        for (i, sign) in layout.orientation().zip(JointMirror::ROLL_PITCH_YAW) {
            permutation[i] = i;
            signs[i] = sign;
        }
        Ok(Self {
            permutation,
            signs,
            joints,
            actions: all - goals,
        })
    }

    /// Mirrors rows of features that are not normalised.
    pub fn features(&self, rows: &[f32]) -> Vec<f32> {
        let frames = rows.chunks_exact(self.permutation.len());
        let mirrored = frames.flat_map(|frame| {
            let pairs = self.permutation.iter().zip(&self.signs);
            pairs.map(|(&from, sign)| sign * frame[from])
        });
        mirrored.collect()
    }

    /// Mirrors rows of actions.
    pub fn actions(&self, rows: &[f32]) -> Vec<f32> {
        let mut mirrored = vec![0.0; rows.len()];
        let pairs = rows
            .chunks_exact(self.actions)
            .zip(mirrored.chunks_exact_mut(self.actions));
        for (from, to) in pairs {
            self.joints.legs(from, to);
        }
        mirrored
    }
}
