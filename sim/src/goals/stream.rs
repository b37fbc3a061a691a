//! Endless goals for training.

use emp_motion::{MINIMUM_JERK_PEAK, minimum_jerk};
use rand::{Rng, RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::piece::Piece;
use super::{GoalClip, GoalLibrary, Source};

/// Peak joint speeds of the movement from one piece to the next, rad/s: from leisurely to brisk.
const JOIN_SPEED: [f32; 2] = [1.0, 4.0];
/// Frames of the shortest such movement.
const SHORTEST_JOIN: usize = 15;
/// Control periods in which the motion of the piece before fades, and that of the piece after is taken up.
const FADE: f32 = (SHORTEST_JOIN + 1) as f32;
/// Frames of a piece in which a robot that falls does so because of the piece before.
const ECHO: usize = 20;

/// An endless sequence of goals: random pieces of clips, at least 60 frames where the clip has them, each mirrored or not,
/// faster or slower, wider or narrower about the default pose, some as a live stream would bring them, joined by minimum-jerk movements that keep position and velocity
/// continuous and take as long as a person's joints need for the way (paper, section VI).
///
/// The stream is a few numbers: indices, a generator, and the ends of the movements between pieces. It is cheap to
/// clone, a stored one goes on exactly, and every call needs the library that it was drawn from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct GoalStream {
    rng: ChaCha8Rng,
    difficulty: f32,
    /// Frames of the current segment that were given.
    given: usize,
    /// The clip of the piece before the current one.
    clip_before: usize,
    current: Segment,
    next: Segment,
}

/// A movement to a piece, then the piece.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Segment {
    join: Option<Join>,
    piece: Piece,
}

/// A movement between two states of motion, both left out.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Join {
    frames: usize,
    from: State,
    to: State,
}

/// Goal angles, rad, and their velocities, rad a control period.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct State {
    position: Vec<f32>,
    velocity: Vec<f32>,
}

impl GoalLibrary {
    /// An endless stream of goals that follows from `seed`. `difficulty` is the largest amplitude of a piece: 1 is the
    /// clips' own, 0 the default pose.
    pub fn stream(&self, seed: u64, difficulty: f32) -> GoalStream {
        GoalStream::new(self, seed, difficulty)
    }

    /// The first goals of a stream as a clip: for tests that last longer than the clips do. Its source counts as
    /// procedural, whatever the pieces are.
    pub fn sample(&self, seed: u64, difficulty: f32, frames: usize) -> GoalClip {
        let mut stream = self.stream(seed, difficulty);
        let mut angles = vec![0.0; frames.max(1) * self.joints()];
        for goal in angles.chunks_exact_mut(self.joints()) {
            stream.next(self, goal);
        }
        GoalClip::from_angles(
            format!("stream-{seed}"),
            Source::Procedural,
            self.joints(),
            angles,
        )
    }
}

impl GoalStream {
    fn new(library: &GoalLibrary, seed: u64, difficulty: f32) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let current = Segment {
            join: None,
            piece: library.draw(&mut rng, difficulty),
        };
        Self {
            next: Segment::after(&current.piece, library, difficulty, &mut rng),
            rng,
            difficulty,
            given: 0,
            clip_before: current.piece.clip,
            current,
        }
    }

    /// Gives the next goal: one angle for each goal joint, rad, inside its range.
    ///
    /// # Panics
    /// If the stream was drawn from another library.
    pub fn next(&mut self, library: &GoalLibrary, goal: &mut [f32]) {
        if self.given == self.current.frames() {
            let after = Segment::after(&self.next.piece, library, self.difficulty, &mut self.rng);
            self.clip_before = self.current.piece.clip;
            self.current = std::mem::replace(&mut self.next, after);
            self.given = 0;
        }
        self.current.goal(library, self.given, goal);
        self.given += 1;
    }

    /// The goal `ahead` frames after the one that [`next`](Self::next) gave last: 1 is what it gives next. Before the
    /// first call, 0 is the first goal too. Looks no further than the end of the next piece, at least 16 frames away.
    ///
    /// # Panics
    /// If the stream was drawn from another library.
    pub fn peek(&self, library: &GoalLibrary, ahead: usize, goal: &mut [f32]) {
        let t = (self.given + ahead).saturating_sub(1);
        match t.checked_sub(self.current.frames()) {
            None => self.current.goal(library, t, goal),
            Some(t) => self.next.goal(library, t.min(self.next.frames() - 1), goal),
        }
    }

    /// The clip that the goals are of, or were of so few frames ago that what they did still shows.
    pub(crate) fn clip(&self) -> usize {
        let started = self.current.frames() - self.current.piece.frames;
        if self.given < started + ECHO {
            self.clip_before
        } else {
            self.current.piece.clip
        }
    }

    /// Whether the goal that was given last came as a live stream brings it.
    #[cfg(test)]
    pub(super) fn is_live(&self) -> bool {
        let started = self.current.frames() - self.current.piece.frames;
        self.given > started && self.current.piece.live.is_some()
    }

    /// The largest amplitude of the pieces.
    pub fn difficulty(&self) -> f32 {
        self.difficulty
    }

    /// Sets the largest amplitude of the pieces that are not drawn yet: those after the next one.
    pub fn set_difficulty(&mut self, difficulty: f32) {
        self.difficulty = difficulty;
    }
}

impl Segment {
    /// Draws what follows a piece.
    fn after(before: &Piece, library: &GoalLibrary, difficulty: f32, rng: &mut impl Rng) -> Self {
        let piece = library.draw(rng, difficulty);
        let speed = rng.random_range(JOIN_SPEED[0]..=JOIN_SPEED[1]);
        Self {
            join: Some(Join::new(library, before, &piece, speed)),
            piece,
        }
    }

    fn frames(&self) -> usize {
        self.join.as_ref().map_or(0, |join| join.frames) + self.piece.frames
    }

    fn goal(&self, library: &GoalLibrary, t: usize, goal: &mut [f32]) {
        match &self.join {
            Some(join) if t < join.frames => join.goal(library, t, goal),
            Some(join) => library.goal(&self.piece, t - join.frames, goal),
            None => library.goal(&self.piece, t, goal),
        }
    }
}

impl Join {
    /// The movement from the end of one piece to the start of another, with a peak speed of about `speed` rad/s.
    fn new(library: &GoalLibrary, from: &Piece, to: &Piece, speed: f32) -> Self {
        let last = from.frames - 1;
        let from = State::new(library, from, last, [last.saturating_sub(1), last]);
        let to = State::new(library, to, 0, [0, 1.min(to.frames - 1)]);
        let ways = from.moved(faded(1.0)).zip(to.moved(-faded(1.0)));
        let farthest = ways.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        let frames = MINIMUM_JERK_PEAK as f32 * farthest / (speed * library.period);
        Self {
            frames: SHORTEST_JOIN.max(frames.ceil() as usize),
            from,
            to,
        }
    }

    /// Goal `t` of the movement: from the fading motion before, by a minimum-jerk weight, to the growing motion after.
    fn goal(&self, library: &GoalLibrary, t: usize, goal: &mut [f32]) {
        let (passed, left) = ((t + 1) as f32, (self.frames - t) as f32);
        let weight = minimum_jerk(f64::from(passed / (passed + left))) as f32;
        let from = self.from.moved(faded(passed / FADE));
        let to = self.to.moved(-faded(left / FADE));
        for (((goal, joint), from), to) in
            goal.iter_mut().zip(library.joints.iter()).zip(from).zip(to)
        {
            let angle = from + weight * (to - from);
            *goal = angle.clamp(joint.range[0], joint.range[1]);
        }
    }
}

impl State {
    /// Position of frame `t` of a piece, velocity between two neighbouring frames.
    fn new(library: &GoalLibrary, piece: &Piece, t: usize, between: [usize; 2]) -> Self {
        let piece = piece.steady();
        let goal = |t: usize| {
            let mut goal = vec![0.0; library.joints()];
            library.goal(&piece, t, &mut goal);
            goal
        };
        let [before, after] = between.map(goal);
        let velocity = before.iter().zip(&after).map(|(a, b)| b - a);
        Self {
            position: goal(t),
            velocity: velocity.collect(),
        }
    }

    /// The position after so many control periods at this velocity.
    fn moved(&self, periods: f32) -> impl Iterator<Item = f32> {
        let joints = self.position.iter().zip(&self.velocity);
        joints.map(move |(position, velocity)| position + periods * velocity)
    }
}

/// Control periods' worth of its first velocity that a motion covers while it comes to rest smoothly over [`FADE`],
/// at time `s` of it; half of [`FADE`] from 1 on.
fn faded(s: f32) -> f32 {
    let s = s.min(1.0);
    FADE * (s - s * s * s * (1.0 - 0.5 * s))
}
