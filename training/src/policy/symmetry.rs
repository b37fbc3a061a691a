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

#[cfg(test)]
mod tests {
    use super::*;
    use emp_models::observation::{HISTORY, History, RobotState};
    use nalgebra::UnitQuaternion;

    /// Features of a robot that was pushed around, or of its mirror image.
    fn features(robot: &Robot, config: &PolicyConfig, mirrored: bool) -> Vec<f32> {
        let mirror = robot.mirror().unwrap();
        let mut history = History::new(config.observation);
        let (all, goals) = (robot.joints().count(), robot.goal_joints().len());
        for t in 0..HISTORY + 3 {
            let wave = |i: usize, count: usize| ((t * count + i) as f32 * 0.7).sin();
            let numbers = |count: usize| (0..count).map(|i| wave(i, count)).collect::<Vec<f32>>();
            let (mut joints, mut goal) = (numbers(all), numbers(goals));
            let mut action = numbers(all - goals);
            let [roll, pitch, yaw] = [0.1, 0.2, 0.3].map(|x| x * f64::from(wave(1, 3)));
            let mut angles = [roll, pitch, yaw];
            if mirrored {
                let before = (joints.clone(), goal.clone(), action.clone());
                mirror.joints(&before.0, &mut joints);
                mirror.goal(&before.1, &mut goal);
                mirror.legs(&before.2, &mut action);
                angles = [-roll, pitch, -yaw];
            }
            let [roll, pitch, yaw] = angles;
            let state = RobotState {
                joint_positions: &joints,
                orientation: UnitQuaternion::from_euler_angles(roll, pitch, yaw),
            };
            history.push(&state, &goal);
            history.set_last_action(&action);
        }
        let mut features = Vec::new();
        config
            .history_map
            .apply(&config.observation, history.stack(), &mut features);
        features
    }

    #[test]
    fn mirrored_features_are_those_of_the_mirrored_robot_and_twice_is_none() {
        let robot = Robot::load("../robots/emp27".as_ref()).unwrap();
        let config = PolicyConfig::new(&robot, vec![8]);
        let mirror = FeatureMirror::new(&robot, &config).unwrap();
        let (seen, expected) = (
            features(&robot, &config, false),
            features(&robot, &config, true),
        );
        let mirrored = mirror.features(&seen);
        for (a, b) in mirrored.iter().zip(&expected) {
            assert!((a - b).abs() < 1e-5, "{a} {b}");
        }
        assert_ne!(mirrored, seen);
        assert_eq!(mirror.features(&mirrored), seen);
        let actions: Vec<f32> = (0..24).map(|i| i as f32).collect();
        assert_ne!(mirror.actions(&actions), actions);
        assert_eq!(mirror.actions(&mirror.actions(&actions)), actions);
    }
}
