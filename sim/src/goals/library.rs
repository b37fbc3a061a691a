//! Many clips, to draw training goals from.

use std::collections::BTreeMap;
use std::sync::Arc;

use emp_robot::Robot;
use rand::{Rng, RngExt as _};

use super::live::LiveStream;
use super::piece::{GoalJoint, Piece, check_clips};
use super::statistics::hand_speeds;
use super::{GoalClip, GoalError, Source};

/// Frames of a piece: at least as in the paper (section VI), at most long enough for somebody to wave.
pub(super) const PIECE: [usize; 2] = [60, 180];
/// Frames for which a clip counts at most within its class: long recordings of people who stand about do not fill it.
const LONGEST: usize = 1000;
/// Bounds of the classes of hardness, by the 95th percentile of the faster hand's speed, m/s. Slow work, gestures, lively
/// gestures, sport and dance.
const CLASSES: [f64; 3] = [0.5, 1.5, 3.0];
/// Slowest and fastest tempo of a piece, and the fastest at difficulty 1.
const TEMPO: [f64; 2] = [0.6, 2.5];
const TEMPO_AT_ONE: f64 = 1.25;
/// Speed that no person's hand has, m/s: recordings are not sped up beyond it.
const FASTEST_HAND: f64 = 7.0;
/// Smallest amplitude of a piece.
const LEAST_AMPLITUDE: f32 = 0.5;
/// Share of pieces that come as a live stream would bring them.
const LIVE: f64 = 0.3;

/// Clips of one robot, from which [`GoalStream`](super::GoalStream)s draw. Immutable and cheap to clone.
///
/// Recorded and procedural clips are drawn from half and half. Within each, every class of hardness that there is counts the
/// same, however much of it there is: most recordings are of people who hardly move.
#[derive(Clone, Debug)]
pub struct GoalLibrary {
    clips: Arc<[Entry]>,
    /// Probability with which each clip is drawn, added up from the first to it.
    cumulative: Arc<[f64]>,
    pub(super) joints: Arc<[GoalJoint]>,
    /// Control period, seconds.
    pub(super) period: f32,
}

#[derive(Debug)]
struct Entry {
    clip: GoalClip,
    /// Speed that its faster hand does not surpass but in one frame of a hundred, m/s.
    top_speed: f64,
    /// Probability with which it is drawn while no clip is known to be harder than another.
    share: f64,
}

impl GoalLibrary {
    /// A library of `clips`.
    ///
    /// # Errors
    /// If there is no clip, one has another number of joints than the robot, or the robot has no mirror image.
    pub fn new(robot: &Robot, clips: Vec<GoalClip>) -> Result<Self, GoalError> {
        check_clips(robot, &clips)?;
        let speeds: Vec<[f64; 2]> = clips
            .iter()
            .map(|clip| {
                let speeds = hand_speeds(robot, clip);
                [0.95, 0.99].map(|share| quantile(&speeds, share))
            })
            .collect();
        let shares = shares(&clips, &speeds);
        let entries = clips.into_iter().zip(speeds).zip(shares);
        let clips: Arc<[Entry]> = entries
            .map(|((clip, [_, top_speed]), share)| Entry {
                clip,
                top_speed,
                share,
            })
            .collect();
        let library = Self {
            cumulative: Arc::new([]),
            joints: GoalJoint::all(robot)?.into(),
            period: (1.0 / robot.control_rate_hz()) as f32,
            clips,
        };
        Ok(library.weighted(&[]))
    }

    /// The same clips, each drawn `weights` times as often as when all weights are alike. Clips without a weight have 1.
    #[must_use]
    pub fn weighted(&self, weights: &[f32]) -> Self {
        let weights = weights.iter().copied().chain(std::iter::repeat(1.0));
        let mut sum = 0.0;
        let cumulative = self.clips.iter().zip(weights).map(|(entry, weight)| {
            sum += entry.share * f64::from(weight);
            sum
        });
        Self {
            cumulative: cumulative.collect(),
            ..self.clone()
        }
    }

    /// Probability with which each clip is drawn.
    pub fn probabilities(&self) -> Vec<f64> {
        let total = self.cumulative.last().copied().unwrap_or(1.0);
        let mut before = 0.0;
        let shares = self.cumulative.iter().map(|&sum| {
            let share = (sum - before) / total;
            before = sum;
            share
        });
        shares.collect()
    }

    /// The clips.
    pub fn clips(&self) -> impl ExactSizeIterator<Item = &GoalClip> {
        self.clips.iter().map(|entry| &entry.clip)
    }

    /// Number of goal joints.
    pub fn joints(&self) -> usize {
        self.joints.len()
    }

    /// Draws a piece of a clip.
    pub(super) fn draw(&self, rng: &mut impl Rng, difficulty: f32) -> Piece {
        let clip = self.draw_clip(rng);
        let entry = &self.clips[clip];
        let amplitude = rng.random_range(difficulty.min(LEAST_AMPLITUDE)..=difficulty);
        let tempo = entry.draw_tempo(rng, difficulty, amplitude);
        let frames = entry.clip.len();
        let longest = rng.random_range(PIECE[0]..=PIECE[1]);
        let periods = Piece::periods(frames, tempo, longest);
        let spare = Piece::spare(frames, tempo, periods);
        Piece {
            clip,
            start: rng.random_range(0.0..=spare),
            tempo,
            frames: periods,
            amplitude,
            mirrored: rng.random_bool(0.5),
            live: rng
                .random_bool(LIVE)
                .then(|| LiveStream::draw(f64::from(self.period), rng)),
        }
    }

    fn draw_clip(&self, rng: &mut impl Rng) -> usize {
        let last = self.clips.len() - 1;
        let drawn = rng.random_range(0.0..self.cumulative[last]);
        self.cumulative
            .partition_point(|&sum| sum <= drawn)
            .min(last)
    }

    /// The goal of frame `t` of a piece.
    pub(super) fn goal(&self, piece: &Piece, t: usize, out: &mut [f32]) {
        piece.goal(&self.clips[piece.clip].clip, &self.joints, t, out);
    }
}

impl Entry {
    /// A tempo, slow ones as often as fast ones; the faster the harder it may be, but no faster than people are.
    fn draw_tempo(&self, rng: &mut impl Rng, difficulty: f32, amplitude: f32) -> f32 {
        let human = FASTEST_HAND / (self.top_speed * f64::from(amplitude).max(1.0)).max(1e-6);
        let most = (TEMPO_AT_ONE * f64::from(difficulty)).min(human);
        let most = most.clamp(1.0, TEMPO[1]);
        let drawn = rng.random_range(TEMPO[0].ln()..=most.ln());
        drawn.exp() as f32
    }
}

/// Probability of each clip: sources count the same, classes within them, and clips within these by their length.
fn shares(clips: &[GoalClip], speeds: &[[f64; 2]]) -> Vec<f64> {
    let class = |index: usize| {
        let hardness = CLASSES.partition_point(|&bound| bound <= speeds[index][0]);
        (clips[index].source == Source::Procedural, hardness)
    };
    let weight = |index: usize| clips[index].len().min(LONGEST) as f64;
    let mut classes: BTreeMap<(bool, usize), f64> = BTreeMap::new();
    for index in 0..clips.len() {
        *classes.entry(class(index)).or_default() += weight(index);
    }
    let of_source = |procedural: bool| classes.keys().filter(|key| key.0 == procedural).count();
    let share = |index: usize| {
        let class = class(index);
        weight(index) / (classes[&class] * of_source(class.0) as f64)
    };
    (0..clips.len()).map(share).collect()
}

/// The number below which this share of sorted numbers lies; 0 where there are none.
fn quantile(sorted: &[f64], share: f64) -> f64 {
    let index = (sorted.len().saturating_sub(1) as f64 * share) as usize;
    sorted.get(index).copied().unwrap_or(0.0)
}
