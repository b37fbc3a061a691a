//! The robot's state as the policy and the EMP see it: one frame `s_t`, and the stack `S_t` of the last frames (paper, section
//! IV-B; erratum E1).
//!
//! A frame is `[q | a_{t−1} | roll, pitch, yaw | g]`: joint positions (goal joints, then leg joints; rad), the last action
//! (policy units), the orientation of the base (rad; yaw relative to the heading at reset, since the absolute heading
//! cannot be observed) and the goal (rad). A stack holds its frames oldest first.

use std::ops::Range;

use candle_core::{IndexOp as _, Tensor};
use emp_robot::Robot;
use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

/// Frames in a stack, as in the paper.
pub const HISTORY: usize = 15;

/// Roll, pitch and yaw.
const ORIENTATION: usize = 3;

/// Where each part of an observation stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObservationLayout {
    /// Joint positions in a frame.
    joint_positions: usize,
    /// Actions in a frame: one for each leg joint.
    actions: usize,
    /// Goal angles in a frame.
    goals: usize,
    /// Frames in a stack.
    history: usize,
}

impl ObservationLayout {
    /// The layout for `robot` with `history` frames (at least 1) in a stack.
    pub fn new(robot: &Robot, history: usize) -> Self {
        let (goals, actions) = (robot.goal_joints().len(), robot.leg_joints().len());
        Self {
            joint_positions: goals + actions,
            actions,
            goals,
            history: history.max(1),
        }
    }

    /// Numbers in one frame.
    pub fn frame_width(&self) -> usize {
        self.goal().end
    }

    /// Numbers in a stack.
    pub fn width(&self) -> usize {
        self.history * self.frame_width()
    }

    /// Frames in a stack.
    pub fn history(&self) -> usize {
        self.history
    }

    /// The joint positions within a frame.
    pub fn joint_positions(&self) -> Range<usize> {
        0..self.joint_positions
    }

    /// The last action within a frame.
    pub fn last_action(&self) -> Range<usize> {
        let start = self.joint_positions().end;
        start..start + self.actions
    }

    /// Roll, pitch and yaw within a frame.
    pub fn orientation(&self) -> Range<usize> {
        let start = self.last_action().end;
        start..start + ORIENTATION
    }

    /// The goal within a frame.
    pub fn goal(&self) -> Range<usize> {
        let start = self.orientation().end;
        start..start + self.goals
    }

    /// The newest frame within a stack.
    pub fn newest(&self) -> Range<usize> {
        self.width() - self.frame_width()..self.width()
    }

    /// The newest frame's goal within a stack.
    pub fn newest_goal(&self) -> Range<usize> {
        self.width() - self.goals..self.width()
    }
}

/// The constant first layer of the networks that read stacks: feature block k is `Σ_t map[k][t] · s_t`, frames oldest first.
///
/// It mixes the frames of a stack, the same way for each number of a frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct HistoryMap(Vec<Vec<f32>>);

impl HistoryMap {
    /// Every frame as it is: the features are the stack.
    pub fn identity(history: usize) -> Self {
        let row = |frame| {
            (0..history)
                .map(|t| f32::from(u8::from(t == frame)))
                .collect()
        };
        Self((0..history).map(row).collect())
    }

    /// `s_t`, `s_t` − `s_{t−1}`, `s_{t−1}` − `s_{t−3}` and `s_t` − mean, over [`HISTORY`] frames.
    pub fn differences() -> Self {
        let newest = HISTORY - 1;
        let mut map = vec![vec![0.0; HISTORY]; 4];
        map[0][newest] = 1.0;
        map[1][newest] = 1.0;
        map[1][newest - 1] = -1.0;
        map[2][newest - 1] = 1.0;
        map[2][newest - 3] = -1.0;
        map[3].fill(-1.0 / HISTORY as f32);
        map[3][newest] += 1.0;
        Self(map)
    }

    /// Numbers that come out for one stack.
    pub fn features(&self, layout: &ObservationLayout) -> usize {
        self.0.len() * layout.frame_width()
    }

    /// Applies the map to stacks (N × [`ObservationLayout::width`]); `features` becomes N × [`features`](Self::features).
    pub fn apply(&self, layout: &ObservationLayout, stacks: &[f32], features: &mut Vec<f32>) {
        let width = layout.frame_width();
        features.clear();
        for stack in stacks.chunks_exact(layout.width()) {
            for weights in &self.0 {
                let start = features.len();
                features.resize(start + width, 0.0);
                let block = &mut features[start..];
                for (frame, &weight) in stack.chunks_exact(width).zip(weights) {
                    if weight != 0.0 {
                        for (feature, value) in block.iter_mut().zip(frame) {
                            *feature += weight * value;
                        }
                    }
                }
            }
        }
    }

    /// As [`apply`](Self::apply), differentiable: stacks N × [`ObservationLayout::width`] to features.
    ///
    /// # Errors
    /// When `stacks` has another width.
    pub fn project(
        &self,
        layout: &ObservationLayout,
        stacks: &Tensor,
    ) -> candle_core::Result<Tensor> {
        let (rows, width) = (stacks.dim(0)?, layout.frame_width());
        let frames = stacks.reshape((rows, layout.history(), width))?;
        let blocks = self.0.iter().map(|weights| {
            let used = weights
                .iter()
                .enumerate()
                .filter(|(_, weight)| **weight != 0.0);
            let mut block = Tensor::zeros((rows, width), stacks.dtype(), stacks.device())?;
            for (t, &weight) in used {
                block = (block + (frames.i((.., t))? * f64::from(weight))?)?;
            }
            Ok(block)
        });
        Tensor::cat(&blocks.collect::<candle_core::Result<Vec<_>>>()?, 1)
    }

    /// Refuses a map for stacks of another length.
    pub(crate) fn check(&self, layout: &ObservationLayout) -> Result<(), String> {
        let history = layout.history();
        let rows = self.0.len();
        if !(1..=history).contains(&rows) {
            return Err(format!(
                "history_map has {rows} rows, expected 1 to {history}"
            ));
        }
        match self.0.iter().find(|row| row.len() != history) {
            Some(row) => Err(format!(
                "a row of history_map has {} numbers, expected {history}",
                row.len()
            )),
            None => Ok(()),
        }
    }
}

/// What a robot measures of itself.
#[derive(Clone, Copy, Debug)]
pub struct RobotState<'a> {
    /// Angles of all joints, goal joints first, rad.
    pub joint_positions: &'a [f32],
    /// Orientation of the base in a world frame with z up.
    pub orientation: UnitQuaternion<f64>,
}

/// The last frames of one robot. Empty until the first [`push`](Self::push), which fills it with copies of that frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct History {
    layout: ObservationLayout,
    /// The stack, oldest frame first.
    frames: Vec<f32>,
    last_action: Vec<f32>,
    /// Yaw of the base when the episode started, rad; none until it is known.
    heading: Option<f64>,
    is_empty: bool,
}

impl History {
    /// An empty history.
    pub fn new(layout: ObservationLayout) -> Self {
        Self {
            layout,
            frames: vec![0.0; layout.width()],
            last_action: vec![0.0; layout.actions],
            heading: None,
            is_empty: true,
        }
    }

    /// Forgets everything: the next frame is the first of an episode.
    pub fn reset(&mut self) {
        self.last_action.fill(0.0);
        self.heading = None;
        self.is_empty = true;
    }

    /// Whether no frame was pushed since the last reset.
    pub fn is_empty(&self) -> bool {
        self.is_empty
    }

    /// Yaw of the base when the episode started, rad: that of the first frame, unless it was set; none before it.
    pub fn heading(&self) -> Option<f64> {
        self.heading
    }

    /// Sets the yaw of the base at the episode's start, rad, for a history that does not begin there. Frames that were
    /// pushed before keep the heading that they had.
    pub fn set_heading(&mut self, heading: f64) {
        self.heading = Some(heading);
    }

    /// Adds the frame of this moment: the state, the last action, and the goal (rad). The oldest frame goes.
    ///
    /// # Panics
    /// If the state or the goal has another number of joints than the layout.
    pub fn push(&mut self, state: &RobotState<'_>, goal: &[f32]) {
        let [roll, pitch, yaw] = roll_pitch_yaw(&state.orientation);
        let is_first = std::mem::take(&mut self.is_empty);
        let heading = *self.heading.get_or_insert(yaw);
        let width = self.layout.frame_width();
        self.frames.copy_within(width.., 0);
        let newest = &mut self.frames[self.layout.newest()];
        newest[self.layout.joint_positions()].copy_from_slice(state.joint_positions);
        newest[self.layout.last_action()].copy_from_slice(&self.last_action);
        let orientation = [roll, pitch, wrapped(yaw - heading)].map(|angle| angle as f32);
        newest[self.layout.orientation()].copy_from_slice(&orientation);
        newest[self.layout.goal()].copy_from_slice(goal);
        if is_first {
            let newest = self.layout.newest().start;
            for start in (0..newest).step_by(width) {
                self.frames.copy_within(newest.., start);
            }
        }
    }

    /// Replaces the goal of the newest frame: what is executed instead (erratum E9).
    ///
    /// # Panics
    /// If the goal has another number of joints than the layout.
    pub fn set_newest_goal(&mut self, goal: &[f32]) {
        self.frames[self.layout.newest_goal()].copy_from_slice(goal);
    }

    /// Remembers the action that follows the newest frame, for the next one.
    ///
    /// # Panics
    /// If it has another number of joints than the layout.
    pub fn set_last_action(&mut self, action: &[f32]) {
        self.last_action.copy_from_slice(action);
    }

    /// The stack `S_t`, oldest frame first: [`ObservationLayout::width`] numbers.
    pub fn stack(&self) -> &[f32] {
        &self.frames
    }

    /// The newest frame `s_t`.
    pub fn newest(&self) -> &[f32] {
        &self.frames[self.layout.newest()]
    }
}

/// Roll, pitch and yaw (extrinsic x, y, z) of a rotation, rad.
pub fn roll_pitch_yaw(orientation: &UnitQuaternion<f64>) -> [f64; 3] {
    let (roll, pitch, yaw) = orientation.euler_angles();
    [roll, pitch, yaw]
}

/// The direction of gravity in the base's frame; (0, 0, −1) when upright.
pub fn projected_gravity(orientation: &UnitQuaternion<f64>) -> [f64; 3] {
    orientation.inverse_transform_vector(&-Vector3::z()).into()
}

/// An angle in −π..π.
fn wrapped(angle: f64) -> f64 {
    use std::f64::consts::{PI, TAU};
    (angle + PI).rem_euclid(TAU) - PI
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layout() -> ObservationLayout {
        let robot = Robot::load("../robots/emp27".as_ref()).unwrap();
        ObservationLayout::new(&robot, HISTORY)
    }

    fn yawed(yaw: f64) -> UnitQuaternion<f64> {
        UnitQuaternion::from_euler_angles(0.1, -0.2, yaw)
    }

    #[test]
    fn the_papers_sizes() {
        let layout = layout();
        assert_eq!((layout.frame_width(), layout.width()), (57, 855));
        assert_eq!(layout.newest_goal(), 840..855);
    }

    #[test]
    fn frames_stand_oldest_first_and_the_first_fills_the_stack() {
        let layout = layout();
        let mut history = History::new(layout);
        for t in 0..HISTORY + 2 {
            let state = RobotState {
                joint_positions: &[t as f32; 27],
                orientation: yawed(3.0 + 0.1 * t as f64),
            };
            history.push(&state, &[-(t as f32); 15]);
            history.set_last_action(&[0.5 + t as f32; 12]);
            let oldest = t.saturating_sub(HISTORY - 1);
            let first: Vec<f32> = history
                .stack()
                .chunks(layout.frame_width())
                .map(|frame| frame[0])
                .collect();
            let expected: Vec<f32> = (0..HISTORY)
                .map(|i| (t + i).saturating_sub(HISTORY - 1).max(oldest) as f32)
                .collect();
            assert_eq!(first, expected);
            let newest = history.newest();
            let last_action = if t == 0 { 0.0 } else { t as f32 - 0.5 };
            assert_eq!(newest[layout.last_action()], [last_action; 12]);
            assert_eq!(newest[layout.goal()], [-(t as f32); 15]);
            let [roll, pitch, yaw] = newest[layout.orientation()] else {
                panic!("three angles")
            };
            assert!((roll - 0.1).abs() < 1e-6 && (pitch + 0.2).abs() < 1e-6);
            // Relative to the heading at reset, past the jump at π.
            assert!((yaw - 0.1 * t as f32).abs() < 1e-5, "{yaw}");
        }
        history.reset();
        assert!(history.is_empty());
        history.push(
            &RobotState {
                joint_positions: &[9.0; 27],
                orientation: yawed(-2.0),
            },
            &[1.0; 15],
        );
        let frame = history.newest().to_vec();
        assert!(
            history
                .stack()
                .chunks(layout.frame_width())
                .all(|f| f == frame)
        );
        assert_eq!(frame[layout.last_action()], [0.0; 12]);
        history.set_newest_goal(&[2.0; 15]);
        assert_eq!(history.stack()[layout.newest_goal()], [2.0; 15]);
    }

    #[test]
    fn the_heading_can_be_that_of_a_frame_before_the_first() {
        let layout = layout();
        let mut history = History::new(layout);
        history.set_heading(0.5);
        assert!(history.is_empty());
        let state = RobotState {
            joint_positions: &[0.0; 27],
            orientation: yawed(0.75),
        };
        history.push(&state, &[0.0; 15]);
        for frame in history.stack().chunks(layout.frame_width()) {
            let yaw = frame[layout.orientation()][2];
            assert!((yaw - 0.25).abs() < 1e-6, "{yaw}");
        }
    }

    #[test]
    fn gravity_points_down_when_upright_and_forward_when_pitched_forward() {
        let gravity = projected_gravity(&UnitQuaternion::identity());
        assert_eq!(gravity, [0.0, 0.0, -1.0]);
        let pitched = UnitQuaternion::from_euler_angles(0.0, 0.3, 1.0);
        let [x, y, z] = projected_gravity(&pitched);
        assert!((x - 0.3_f64.sin()).abs() < 1e-12 && y.abs() < 1e-12);
        assert!((z + 0.3_f64.cos()).abs() < 1e-12);
    }

    /// One stack whose frame t holds t² everywhere.
    fn squares(layout: &ObservationLayout) -> Vec<f32> {
        let width = layout.frame_width();
        (0..layout.width())
            .map(|i| ((i / width) as f32).powi(2))
            .collect()
    }

    #[test]
    fn the_map_of_differences_is_differences_and_a_deviation() {
        let layout = layout();
        let map = HistoryMap::differences();
        let mut features = Vec::new();
        map.apply(&layout, &squares(&layout), &mut features);
        let mean = 1015.0 / 15.0;
        let expected = [196.0, 196.0 - 169.0, 169.0 - 121.0, 196.0 - mean];
        assert_eq!(features.len(), map.features(&layout));
        for (block, expected) in features.chunks(layout.frame_width()).zip(expected) {
            assert!(
                block.iter().all(|x| (x - expected).abs() < 1e-3),
                "{block:?} {expected}"
            );
        }
    }

    #[test]
    fn projecting_tensors_is_applying_to_numbers() {
        let layout = layout();
        let stacks: Vec<f32> = (0..3 * layout.width())
            .map(|i| (i as f32 * 0.37).sin())
            .collect();
        let tensor = Tensor::new(stacks.as_slice(), &candle_core::Device::Cpu).unwrap();
        let tensor = tensor.reshape((3, layout.width())).unwrap();
        for map in [HistoryMap::differences(), HistoryMap::identity(HISTORY)] {
            let mut expected = Vec::new();
            map.apply(&layout, &stacks, &mut expected);
            let projected = map.project(&layout, &tensor).unwrap();
            assert_eq!(projected.dims(), [3, map.features(&layout)]);
            let projected: Vec<f32> = projected.flatten_all().unwrap().to_vec1().unwrap();
            for (a, b) in projected.iter().zip(&expected) {
                assert!((a - b).abs() < 1e-5, "{a} {b}");
            }
        }
        let mut features = Vec::new();
        HistoryMap::identity(HISTORY).apply(&layout, &stacks, &mut features);
        assert_eq!(features, stacks);
    }
}
