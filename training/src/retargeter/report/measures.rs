//! How a robot's arms move beside a person's.

use emp_models::retarget::{Solver, Target};
use nalgebra::Vector3;
use serde::Serialize;

/// Unit directions of the arm bones in one frame.
type Bones = [Vector3<f64>; 4];

/// Mean, 95th percentile and maximum.
#[derive(Clone, Debug, Serialize)]
pub struct Spread {
    /// Mean.
    pub mean: f64,
    /// 95th percentile.
    pub p95: f64,
    /// Largest.
    pub max: f64,
}

impl Spread {
    /// Nothing where there are no values.
    pub(super) fn of(mut values: Vec<f64>) -> Option<Self> {
        values.sort_by(f64::total_cmp);
        Some(Self {
            mean: values.iter().sum::<f64>() / values.len() as f64,
            p95: *values.get(values.len().saturating_sub(1) * 95 / 100)?,
            max: *values.last()?,
        })
    }
}

/// One clip as a person and the robot move through it.
pub(super) struct Played<'a> {
    pub(super) person: Vec<Bones>,
    pub(super) robot: Vec<Bones>,
    track: &'a [Vec<f64>],
    arms: [Vec<usize>; 2],
    /// How far the person's arms turn in the interval that ends with a frame: the most of two bones and hand, radians.
    turns: Vec<[f64; 2]>,
    rate: f64,
}

impl<'a> Played<'a> {
    pub(super) fn new(
        solver: &mut Solver<'_>,
        targets: &[Target],
        track: &'a [Vec<f64>],
        rate: f64,
    ) -> Self {
        let mut turns = vec![[0.0; 2]];
        turns.extend(targets.windows(2).map(|pair| pair[0].arm_turns(&pair[1])));
        Self {
            person: targets.iter().map(|target| target.bones).collect(),
            robot: track
                .iter()
                .map(|angles| solver.bone_directions(angles))
                .collect(),
            track,
            arms: solver.arms().clone(),
            turns,
            rate,
        }
    }

    /// Frames in which an arm joint turns faster than 2 rad/s + 1.5 × the fastest turn of the person's arm (its bones and
    /// its hand) in the last 0.1 s.
    pub(super) fn spins(&self) -> usize {
        const SLOW: f64 = 2.0;
        const GAIN: f64 = 1.5;
        const WINDOW: f64 = 0.1;
        let window = (WINDOW * self.rate).round() as usize;
        let spins = |frame: usize, side: usize| {
            let recent = &self.turns[(frame + 1).saturating_sub(window)..=frame];
            let fastest = recent.iter().map(|turn| turn[side]).fold(0.0, f64::max);
            // A millionth for the rounding of angles to single precision.
            let allowed = SLOW / self.rate + GAIN * fastest + 1e-6;
            let step = |joint: &usize| self.track[frame][*joint] - self.track[frame - 1][*joint];
            self.arms[side]
                .iter()
                .any(|joint| step(joint).abs() > allowed)
        };
        let frames = 1..self.track.len();
        frames
            .filter(|frame| (0..2).any(|side| spins(*frame, side)))
            .count()
    }

    /// How often an arm takes another branch: one of its joints is more than 2 rad from where it was half a second before,
    /// while the person's arm has turned less than half as far along its way.
    pub(super) fn flips(&self) -> usize {
        const FAR: f64 = 2.0;
        const SECONDS: f64 = 0.5;
        let window = (SECONDS * self.rate).round() as usize;
        let mut count = 0;
        for (side, arm) in self.arms.iter().enumerate() {
            let mut frame = window;
            while frame < self.track.len() {
                let way = |joint: &usize| {
                    (self.track[frame][*joint] - self.track[frame - window][*joint]).abs()
                };
                let farthest = arm.iter().map(way).fold(0.0, f64::max);
                let turned: f64 = self.turns[frame + 1 - window..=frame]
                    .iter()
                    .map(|turn| turn[side])
                    .sum();
                if farthest > FAR && turned < 0.5 * farthest {
                    count += 1;
                    frame += window;
                } else {
                    frame += 1;
                }
            }
        }
        count
    }

    /// Largest change of a joint from one frame to the next, radians.
    pub(super) fn largest_step(&self) -> f64 {
        let step = |pair: &[Vec<f64>]| {
            let changes = pair[0].iter().zip(&pair[1]).map(|(a, b)| (b - a).abs());
            changes.fold(0.0, f64::max)
        };
        self.track.windows(2).map(step).fold(0.0, f64::max)
    }
}

/// Sum over frames and bones of the norm of a direction's third difference.
pub(super) fn jerk(bones: &[Bones]) -> f64 {
    let third = |window: &[Bones], i: usize| {
        (window[3][i] - 3.0 * window[2][i] + 3.0 * window[1][i] - window[0][i]).norm()
    };
    let windows = bones.windows(4);
    windows
        .map(|window| (0..4).map(|i| third(window, i)).sum::<f64>())
        .sum()
}

/// How far the robot is behind: the delay at which the changes of its arm directions correlate best with the person's.
pub(super) struct Lag {
    /// Σ robot(t) · person(t − delay) over frames and bones, for each delay.
    sums: [f64; Self::EARLIEST + Self::LATEST + 1],
}

impl Default for Lag {
    fn default() -> Self {
        Self {
            sums: [0.0; Self::EARLIEST + Self::LATEST + 1],
        }
    }
}

impl Lag {
    /// Frames by which the robot may be ahead.
    const EARLIEST: usize = 3;
    /// Frames by which it may be behind.
    const LATEST: usize = 12;

    pub(super) fn add(&mut self, played: &Played<'_>) {
        let changes = |bones: &[Bones]| -> Vec<Bones> {
            let change = |pair: &[Bones]| std::array::from_fn(|i| pair[1][i] - pair[0][i]);
            bones.windows(2).map(change).collect()
        };
        let (robot, person) = (changes(&played.robot), changes(&played.person));
        let end = robot.len().saturating_sub(Self::EARLIEST);
        for (delay, sum) in self.sums.iter_mut().enumerate() {
            for t in Self::LATEST..end {
                let person = &person[t + Self::EARLIEST - delay];
                let products = robot[t].iter().zip(person).map(|(a, b)| a.dot(b));
                *sum += products.sum::<f64>();
            }
        }
    }

    /// The best delay, between frames by a parabola through its neighbours; nothing where nothing moves together.
    pub(super) fn milliseconds(&self, rate: f64) -> Option<f64> {
        let best = (0..self.sums.len()).max_by(|a, b| self.sums[*a].total_cmp(&self.sums[*b]))?;
        if self.sums[best] <= 0.0 {
            return None;
        }
        let frames = best as f64 - Self::EARLIEST as f64;
        let between = match (best.checked_sub(1), self.sums.get(best + 1)) {
            (Some(before), Some(after)) => {
                let (before, at) = (self.sums[before], self.sums[best]);
                let bend = before - 2.0 * at + after;
                if bend < 0.0 {
                    0.5 * (before - after) / bend
                } else {
                    0.0
                }
            }
            _ => 0.0,
        };
        Some((frames + between) / rate * 1000.0)
    }
}
