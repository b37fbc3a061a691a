//! The control periods that were collected last.
//!
//! Consecutive stacks share all but one frame; a `Segment` keeps each frame once.

use std::collections::VecDeque;

use anyhow::{Result, ensure};
use emp_models::observation::ObservationLayout;
use emp_sim::{
    End,
    tracking::{TrackingEnvironments, TrackingStep},
};
use serde::{Deserialize, Serialize};

use super::sequences::{Period, Sequences};

/// Consecutive control periods of one robot: the frames of the first stack, then one a period. Goals in them are the executed
/// ones, but for the last frame's, which is not.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Segment {
    frames: Vec<f32>,
    fell: bool,
}

/// Where a sequence starts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Start {
    segment: usize,
    period: usize,
    /// Control periods from its start to the fall that ends the segment, if one does.
    pub until_fall: Option<usize>,
    /// Whether the robot is tilted at the start or the end of the sequence.
    pub is_tilted: bool,
}

/// The control periods that were collected last, of many robots.
#[derive(Clone, Debug)]
pub struct Replay {
    layout: ObservationLayout,
    /// Control periods that are kept.
    capacity: usize,
    segments: VecDeque<Segment>,
    /// The segments that still grow, one a robot.
    open: Vec<Option<Segment>>,
}

impl Replay {
    /// Keeps about `capacity` control periods.
    pub fn new(layout: ObservationLayout, capacity: usize) -> Self {
        Self {
            layout,
            capacity,
            segments: VecDeque::new(),
            open: Vec::new(),
        }
    }

    /// Runs `environments` for one control period with the goals `executed`, and keeps what came of it.
    ///
    /// # Errors
    /// As [`TrackingEnvironments::step`].
    pub fn step(
        &mut self,
        environments: &mut TrackingEnvironments,
        executed: &[f32],
    ) -> Result<()> {
        self.begin(environments.observations(), executed);
        let step = environments.step(executed)?;
        self.add(&step);
        Ok(())
    }

    /// Ends what still grows: control periods that follow start new segments. Forgets what is too much.
    pub fn cut(&mut self) {
        let open = std::mem::take(&mut self.open);
        for segment in open.into_iter().flatten() {
            self.close(segment);
        }
        let mut kept: usize = self.segments.iter().map(|s| self.periods(s)).sum();
        while kept > self.capacity {
            let Some(oldest) = self.segments.pop_front() else {
                break;
            };
            kept -= self.periods(&oldest);
        }
    }

    /// Every start of a sequence of `steps` control periods. A robot is tilted where |roll| + |pitch| is more than `tilt`, rad.
    pub fn starts(&self, steps: usize, tilt: f64) -> Vec<Start> {
        let mut starts = Vec::new();
        for (index, segment) in self.segments.iter().enumerate() {
            let periods = self.periods(segment);
            let is_tilted = |period: usize| self.tilt(segment, period) > tilt;
            starts.extend(
                (0..(periods + 1).saturating_sub(steps)).map(|period| Start {
                    segment: index,
                    period,
                    until_fall: segment.fell.then_some(periods - period),
                    is_tilted: is_tilted(period) || is_tilted(period + steps),
                }),
            );
        }
        starts
    }

    /// The sequences of `steps` control periods from `starts`, which [`starts`](Self::starts) gave for as many.
    pub fn sequences(&self, starts: &[Start], steps: usize) -> Sequences {
        let layout = &self.layout;
        let width = layout.frame_width();
        let mut sequences = Sequences {
            stacks: Vec::with_capacity(starts.len() * layout.width()),
            periods: vec![Period::default(); steps],
        };
        for start in starts {
            let frames = &self.segments[start.segment].frames[start.period * width..];
            let (stack, following) = frames.split_at(layout.width());
            sequences.stacks.extend_from_slice(stack);
            for (period, frame) in sequences
                .periods
                .iter_mut()
                .zip(following.chunks_exact(width))
            {
                period.actions.extend(&frame[layout.last_action()]);
                period.next.extend(&frame[layout.joint_positions()]);
                period.next.extend(&frame[layout.orientation()]);
                period.goals.extend(&frame[layout.goal()]);
            }
        }
        sequences
    }

    /// Everything that is kept.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn snapshot(&self) -> Result<Vec<u8>> {
        Ok(postcard::to_stdvec(&(&self.segments, &self.open))?)
    }

    /// Goes on from a [`snapshot`](Self::snapshot).
    ///
    /// # Errors
    /// If it is not a snapshot of a replay, or of other observations.
    pub fn restore(&mut self, snapshot: &[u8]) -> Result<()> {
        let (segments, open): (VecDeque<Segment>, Vec<Option<Segment>>) =
            postcard::from_bytes(snapshot)?;
        let width = self.layout.frame_width();
        let mut all = segments.iter().chain(open.iter().flatten());
        ensure!(
            all.all(|s| s.frames.len() >= self.layout.width() && s.frames.len() % width == 0),
            "the kept control periods are of another robot"
        );
        (self.segments, self.open) = (segments, open);
        Ok(())
    }

    /// Opens segments where none grows, and puts the executed goals into the newest frames.
    fn begin(&mut self, observations: &[f32], executed: &[f32]) {
        let layout = &self.layout;
        let goals = executed.chunks_exact(layout.goal().len());
        self.open.resize(goals.len(), None);
        let stacks = observations.chunks_exact(layout.width());
        for ((segment, stack), goal) in self.open.iter_mut().zip(stacks).zip(goals) {
            let segment = segment.get_or_insert_with(|| Segment {
                frames: stack.to_vec(),
                fell: false,
            });
            let newest = segment.frames.len() - goal.len();
            segment.frames[newest..].copy_from_slice(goal);
        }
    }

    /// Adds a frame to each segment; closes those whose episode ended.
    fn add(&mut self, step: &TrackingStep<'_>) {
        let joints = self.layout.joint_positions().len();
        let next = step
            .next
            .chunks_exact(joints + self.layout.orientation().len());
        let actions = step.actions.chunks_exact(self.layout.last_action().len());
        let goals = self.layout.goal().len();
        for (row, ((next, action), end)) in next.zip(actions).zip(step.ends).enumerate() {
            let Some(segment) = &mut self.open[row] else {
                continue;
            };
            if *end != End::Diverged {
                let (positions, orientation) = next.split_at(joints);
                for part in [positions, action, orientation] {
                    segment.frames.extend_from_slice(part);
                }
                segment.frames.resize(segment.frames.len() + goals, 0.0);
            }
            segment.fell = *end == End::Terminated;
            if *end != End::None
                && let Some(segment) = self.open[row].take()
            {
                self.close(segment);
            }
        }
    }

    fn close(&mut self, segment: Segment) {
        if self.periods(&segment) > 0 {
            self.segments.push_back(segment);
        }
    }

    /// Control periods of a segment.
    fn periods(&self, segment: &Segment) -> usize {
        segment.frames.len() / self.layout.frame_width() - self.layout.history()
    }

    /// |roll| + |pitch| at the start of a period, rad.
    fn tilt(&self, segment: &Segment, period: usize) -> f64 {
        let frame = (period + self.layout.history() - 1) * self.layout.frame_width();
        let start = frame + self.layout.orientation().start;
        let [roll, pitch] = [0, 1].map(|i| f64::from(segment.frames[start + i].abs()));
        roll + pitch
    }
}

#[cfg(test)]
mod tests {
    use emp_sim::tracking::TrackingSettings;

    use super::*;
    use crate::world_model::testing::environments;

    /// What the environments showed, row by row: stacks with the executed goal, and when episodes start.
    struct Shown {
        stacks: Vec<Vec<Vec<f32>>>,
        starts: Vec<Vec<bool>>,
    }

    fn short() -> TrackingSettings {
        TrackingSettings {
            episode_frames: 12,
            ..TrackingSettings::default()
        }
    }

    fn collect(replay: &mut Replay, environments: &mut TrackingEnvironments, n: usize) -> Shown {
        let layout = *environments.layout();
        let (mut stacks, mut starts) = (Vec::new(), Vec::new());
        for t in 0..n {
            let goals = environments.goals().iter().enumerate();
            let executed: Vec<f32> = goals
                .map(|(i, g)| g + 0.01 * ((i + t) as f32).sin())
                .collect();
            let mut rows: Vec<Vec<f32>> = environments
                .observations()
                .chunks(layout.width())
                .map(<[f32]>::to_vec)
                .collect();
            for (row, goal) in rows.iter_mut().zip(executed.chunks(layout.goal().len())) {
                row[layout.newest_goal()].copy_from_slice(goal);
            }
            stacks.push(rows);
            starts.push(environments.starts().to_vec());
            replay.step(environments, &executed).unwrap();
        }
        replay.cut();
        Shown { stacks, starts }
    }

    #[test]
    fn sequences_are_what_the_environments_showed() {
        let mut environments = environments(3, short());
        let layout = *environments.layout();
        let mut replay = Replay::new(layout, 10_000);
        let shown = collect(&mut replay, &mut environments, 40);
        let starts = replay.starts(3, 0.15);
        let sequences = replay.sequences(&starts, 3);
        assert_eq!(sequences.len(&layout), starts.len());
        // Every moment that is followed by three control periods of its episode and of the collection.
        let mut expected = 0;
        for row in 0..3 {
            let episode = |t: usize| shown.starts[..=t].iter().filter(|s| s[row]).count();
            for t in 0..38 {
                let lasts = t == 37 || episode(t + 2) == episode(t);
                expected += usize::from(lasts);
            }
        }
        assert_eq!(starts.len(), expected);
        let part = |values: &[f32], i: usize, width: usize| values[i * width..][..width].to_vec();
        let mut followed = 0;
        for i in 0..starts.len() {
            let stack = part(&sequences.stacks, i, layout.width());
            let found = (0..40).flat_map(|t| (0..3).map(move |row| (t, row)));
            let (t, row) = found
                .clone()
                .find(|&(t, row)| shown.stacks[t][row] == stack)
                .expect("a stack that was shown");
            for (ahead, period) in sequences.periods.iter().enumerate().take(2) {
                let newest = &shown.stacks[t + ahead + 1][row][layout.newest()];
                let next = part(&period.next, i, 30);
                assert_eq!(next[..27], newest[layout.joint_positions()]);
                assert_eq!(next[27..], newest[layout.orientation()]);
                assert_eq!(part(&period.actions, i, 12), newest[layout.last_action()]);
                assert_eq!(part(&period.goals, i, 15), newest[layout.goal()]);
                followed += 1;
            }
        }
        assert!(followed > 100, "{followed}");
    }

    #[test]
    fn falls_are_known_and_tilted_robots_found() {
        let settings = TrackingSettings {
            pushed: 1.0,
            push_speed: [3.0, 3.0],
            push_interval: 0.3,
            ..TrackingSettings::default()
        };
        let mut environments = environments(4, settings);
        let mut replay = Replay::new(*environments.layout(), 10_000);
        collect(&mut replay, &mut environments, 120);
        let starts = replay.starts(5, 0.15);
        let last = starts.iter().filter(|s| s.until_fall == Some(5)).count();
        assert!(last >= 4, "{last}");
        for start in &starts {
            if start.until_fall == Some(5) {
                assert!(start.is_tilted);
            }
        }
        assert!(starts.iter().any(|start| !start.is_tilted));
    }

    #[test]
    fn the_oldest_goes_first_and_a_snapshot_holds_all() {
        let mut environments = environments(3, short());
        let mut replay = Replay::new(*environments.layout(), 60);
        collect(&mut replay, &mut environments, 30);
        let kept = replay.starts(1, 1.0).len();
        assert!((40..=60).contains(&kept), "{kept}");
        let before = replay.sequences(&replay.starts(1, 1.0), 1);
        let mut restored = Replay::new(*environments.layout(), 60);
        restored.restore(&replay.snapshot().unwrap()).unwrap();
        assert_eq!(restored.sequences(&restored.starts(1, 1.0), 1), before);
        collect(&mut replay, &mut environments, 30);
        let after = replay.sequences(&replay.starts(1, 1.0), 1);
        let width = environments.layout().width();
        let mut stacks = after.stacks.chunks(width);
        assert!(stacks.all(|stack| !before.stacks.chunks(width).any(|old| old == stack)));
        assert!(restored.restore(&[1, 2, 3]).is_err());
    }
}
