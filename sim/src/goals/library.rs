//! Many clips, to draw training goals from.

use emp_robot::Robot;
use rand::{Rng, RngExt as _};

use super::piece::{GoalJoint, Piece, check_clips};
use super::{GoalClip, GoalError, GoalStatistics, Source};

/// Frames of a piece, as in the paper (section VI).
pub(super) const PIECE: usize = 60;
/// Frames for which a clip counts at most when one is drawn: a few long recordings of people who stand about do not
/// fill the stream.
const LARGEST_WEIGHT: usize = 1000;
/// Mean speed of the faster hand below which a recording is slow, m/s.
const SLOW: f64 = 0.2;
/// Tempo of pieces of slow recordings (a person who drinks, seated, moves the hand at 0.07 m/s on average), and of others.
const SLOW_TEMPO: [f32; 2] = [0.8, 2.5];
const TEMPO: [f32; 2] = [0.8, 1.3];
/// A piece's amplitude is at least this share of the stream's difficulty.
const LEAST_AMPLITUDE: f32 = 0.5;

/// Clips of one robot, from which [`GoalStream`](super::GoalStream)s draw. Immutable; share it in an [`Arc`](std::sync::Arc).
#[derive(Debug)]
pub struct GoalLibrary {
    clips: Vec<Entry>,
    /// Recorded and procedural clips, those of the two that there are; each is drawn from as often as the other.
    groups: Vec<Group>,
    pub(super) joints: Vec<GoalJoint>,
    /// Control period, seconds.
    pub(super) period: f32,
}

#[derive(Debug)]
struct Entry {
    clip: GoalClip,
    tempo: [f32; 2],
}

/// Clips of one source.
#[derive(Debug)]
struct Group {
    /// Indices of the clips.
    clips: Vec<usize>,
    /// Weight of each clip and those before it.
    cumulative: Vec<usize>,
}

impl GoalLibrary {
    /// A library of `clips`.
    ///
    /// # Errors
    /// If there is no clip, one has another number of joints than the robot, or the robot has no mirror image.
    pub fn new(robot: &Robot, clips: Vec<GoalClip>) -> Result<Self, GoalError> {
        check_clips(robot, &clips)?;
        let groups =
            [Source::Recorded, Source::Procedural].map(|source| Group::new(&clips, source));
        let tempo = |clip: &GoalClip| match clip.source {
            Source::Recorded if is_slow(robot, clip) => SLOW_TEMPO,
            _ => TEMPO,
        };
        Ok(Self {
            groups: groups.into_iter().flatten().collect(),
            joints: GoalJoint::all(robot)?,
            period: (1.0 / robot.control_rate_hz()) as f32,
            clips: clips
                .into_iter()
                .map(|clip| Entry {
                    tempo: tempo(&clip),
                    clip,
                })
                .collect(),
        })
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
        let group = &self.groups[rng.random_range(0..self.groups.len())];
        let clip = group.draw(rng);
        let Entry { clip: goals, tempo } = &self.clips[clip];
        let tempo = rng.random_range(tempo[0]..=tempo[1]);
        let frames = Piece::periods(goals.len(), tempo, PIECE);
        let spare = Piece::spare(goals.len(), tempo, frames);
        Piece {
            clip,
            start: rng.random_range(0.0..=spare),
            tempo,
            frames,
            amplitude: difficulty * rng.random_range(LEAST_AMPLITUDE..=1.0),
            mirrored: rng.random_bool(0.5),
        }
    }

    /// The goal of frame `t` of a piece.
    pub(super) fn goal(&self, piece: &Piece, t: usize, out: &mut [f32]) {
        piece.goal(&self.clips[piece.clip].clip, &self.joints, t, out);
    }
}

impl Group {
    /// The clips of `source`, none if there is none.
    fn new(clips: &[GoalClip], source: Source) -> Option<Self> {
        let indices = (0..clips.len()).filter(|&i| clips[i].source == source);
        let clips_of: Vec<usize> = indices.collect();
        let mut sum = 0;
        let weigh = |&i: &usize| {
            sum += clips[i].len().min(LARGEST_WEIGHT);
            sum
        };
        let cumulative: Vec<usize> = clips_of.iter().map(weigh).collect();
        (!clips_of.is_empty()).then_some(Self {
            clips: clips_of,
            cumulative,
        })
    }

    fn draw(&self, rng: &mut impl Rng) -> usize {
        let total = self.cumulative[self.cumulative.len() - 1];
        let drawn = rng.random_range(0..total);
        self.clips[self.cumulative.partition_point(|&sum| sum <= drawn)]
    }
}

fn is_slow(robot: &Robot, clip: &GoalClip) -> bool {
    GoalStatistics::of(robot, [clip]).is_some_and(|statistics| statistics.hand_speed.mean < SLOW)
}
