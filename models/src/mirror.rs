//! Numbers of a robot seen in a mirror.
//!
//! The mirror image of a vector has the same numbers in other places, some with the other sign. So turning it twice is
//! exact, and so is the symmetry of what is built on it.

use candle_core::{Device, Tensor};
use emp_robot::{JointMirror, Robot, RobotError};

use crate::observation::ObservationLayout;

/// The reflection between left and right, for rows of some kind: `mirrored[i] = signs[i] · row[permutation[i]]`.
#[derive(Clone, Debug, PartialEq)]
pub struct Mirror {
    permutation: Vec<usize>,
    signs: Vec<f32>,
}

impl Mirror {
    /// Numbers that keep their places and take these signs, each 1 or −1.
    pub fn signs(signs: &[f32]) -> Self {
        Self {
            permutation: (0..signs.len()).collect(),
            signs: signs.to_vec(),
        }
    }

    /// Numbers of which the first belongs to the left side and the second to the right.
    pub fn sides() -> Self {
        Self {
            permutation: vec![1, 0],
            signs: vec![1.0, 1.0],
        }
    }

    /// One angle, speed or action for each goal joint.
    pub fn goal_joints(joints: &JointMirror) -> Self {
        Self::part(joints, 0..joints.goal_joints())
    }

    /// One angle, speed or action for each leg joint.
    pub fn leg_joints(joints: &JointMirror) -> Self {
        Self::part(joints, joints.goal_joints()..joints.permutation().len())
    }

    fn part(joints: &JointMirror, part: std::ops::Range<usize>) -> Self {
        let partner = |&joint: &usize| joint - part.start;
        Self {
            permutation: joints.permutation()[part.clone()]
                .iter()
                .map(partner)
                .collect(),
            signs: joints.signs()[part].to_vec(),
        }
    }

    /// One angle, speed or target for each joint, goal joints first.
    pub fn joints(joints: &JointMirror) -> Self {
        Self::chain([Self::goal_joints(joints), Self::leg_joints(joints)])
    }

    /// One frame of `robot`'s observation.
    ///
    /// # Errors
    /// When the robot has no mirror image.
    pub fn frame(robot: &Robot, layout: &ObservationLayout) -> Result<Self, RobotError> {
        let joints = robot.mirror()?;
        let mirror = Self::chain([
            Self::joints(&joints),
            Self::leg_joints(&joints),
            Self::signs(&JointMirror::ROLL_PITCH_YAW),
            Self::goal_joints(&joints),
        ]);
        debug_assert_eq!(mirror.width(), layout.frame_width());
        Ok(mirror)
    }

    /// The same numbers, of which none has a sign: factors on what the numbers are.
    #[must_use]
    pub fn unsigned(self) -> Self {
        Self {
            signs: vec![1.0; self.signs.len()],
            ..self
        }
    }

    /// Rows that consist of the parts, one after the other.
    pub fn chain(parts: impl IntoIterator<Item = Self>) -> Self {
        let mut chain = Self::signs(&[]);
        for part in parts {
            let start = chain.width();
            chain
                .permutation
                .extend(part.permutation.iter().map(|from| start + from));
            chain.signs.extend(part.signs);
        }
        chain
    }

    /// Rows that consist of so many of these rows.
    #[must_use]
    pub fn repeated(&self, times: usize) -> Self {
        Self::chain(std::iter::repeat_n(self.clone(), times))
    }

    /// Numbers in a row.
    pub fn width(&self) -> usize {
        self.permutation.len()
    }

    /// Adds the mirror images of `rows` (whole rows) to the end of `images`.
    pub fn extend(&self, images: &mut Vec<f32>, rows: &[f32]) {
        for row in rows.chunks_exact(self.width()) {
            images.extend(self.image(row));
        }
    }

    /// The mirror images of rows.
    pub fn rows(&self, rows: &[f32]) -> Vec<f32> {
        let mut images = Vec::with_capacity(rows.len());
        self.extend(&mut images, rows);
        images
    }

    /// The mirror image of one row, number by number.
    pub fn image<'a>(&'a self, row: &'a [f32]) -> impl Iterator<Item = f32> + 'a {
        let places = self.permutation.iter().zip(&self.signs);
        places.map(|(&from, sign)| sign * row[from])
    }

    /// For each number, its partner and its sign.
    pub fn places(&self) -> impl Iterator<Item = (usize, f32)> + '_ {
        self.permutation
            .iter()
            .copied()
            .zip(self.signs.iter().copied())
    }

    /// As [`rows`](Self::rows), differentiable: N × [`width`](Self::width).
    ///
    /// # Errors
    /// When `rows` has another width.
    pub fn forward(&self, rows: &Tensor) -> candle_core::Result<Tensor> {
        let from: Vec<u32> = self.permutation.iter().map(|&from| from as u32).collect();
        let from = Tensor::from_vec(from, self.width(), &Device::Cpu)?;
        let signs = Tensor::new(self.signs.as_slice(), &Device::Cpu)?;
        rows.index_select(&from, 1)?.broadcast_mul(&signs)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::observation::{HISTORY, History, RobotState};
    use nalgebra::UnitQuaternion;

    fn robot() -> Robot {
        Robot::load("../robots/emp27".as_ref()).unwrap()
    }

    /// The stack of a robot that was pushed around, or of its mirror image.
    fn stack(robot: &Robot, layout: ObservationLayout, mirrored: bool) -> Vec<f32> {
        let mirror = robot.mirror().unwrap();
        let mut history = History::new(layout);
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
        history.stack().to_vec()
    }

    #[test]
    fn mirrored_frames_are_those_of_the_mirrored_robot_and_twice_is_none() {
        let robot = robot();
        for periods in [0, 50] {
            let layout = ObservationLayout::new(&robot, HISTORY).with_heading_periods(periods);
            let mirror = Mirror::frame(&robot, &layout).unwrap();
            let (seen, expected) = (stack(&robot, layout, false), stack(&robot, layout, true));
            let mirrored = mirror.rows(&seen);
            for (a, b) in mirrored.iter().zip(&expected) {
                assert!((a - b).abs() < 1e-5, "{a} {b}");
            }
            assert_ne!(mirrored, seen);
            assert_eq!(mirror.rows(&mirrored), seen);
            assert_eq!(mirror.repeated(HISTORY).rows(&seen), mirrored);
        }
    }

    #[test]
    fn tensors_turn_as_rows_do() {
        let robot = robot();
        let mirror = Mirror::leg_joints(&robot.mirror().unwrap());
        let actions: Vec<f32> = (0..24).map(|i| i as f32).collect();
        let tensor = Tensor::from_slice(&actions, (2, 12), &Device::Cpu).unwrap();
        let tensor = mirror.forward(&tensor).unwrap().flatten_all().unwrap();
        let mirrored = mirror.rows(&actions);
        assert_eq!(tensor.to_vec1::<f32>().unwrap(), mirrored);
        assert_ne!(mirrored, actions);
        let factors: Vec<f32> = mirror.clone().unsigned().rows(&actions);
        assert!(factors.iter().all(|factor| *factor >= 0.0));
        for (i, (partner, sign)) in mirror.places().enumerate() {
            assert_eq!(mirrored[i], sign * actions[partner]);
        }
    }
}
