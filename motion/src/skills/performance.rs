//! How a skill is performed: by whom, with which arms, how fast.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::body::Body;
use crate::Side;

/// How a skill is performed this time.
pub(super) struct Performance<'a> {
    pub(super) body: &'a Body,
    /// The arms in use.
    pub(super) sides: Vec<Side>,
    /// Speed, 1 being usual.
    pub(super) tempo: f64,
    /// Shortest recognisable form, for a medley.
    pub(super) brief: bool,
}

impl Performance<'_> {
    /// The arm of a one-armed skill.
    pub(super) fn side(&self) -> Side {
        self.sides.first().copied().unwrap_or(Side::Right)
    }

    pub(super) fn repeats(&self, rng: &mut ChaCha8Rng, most: usize) -> usize {
        if self.brief {
            1
        } else {
            rng.random_range(2..=most)
        }
    }

    /// Length of a cyclic part of `cycles` periods (fewer when brief) at `hertz`, and the rate at this tempo.
    pub(super) fn cycles(
        &self,
        rng: &mut ChaCha8Rng,
        brief: f64,
        usual: std::ops::Range<f64>,
        hertz: f64,
    ) -> (f64, f64) {
        let rate = hertz * self.tempo;
        let cycles = if self.brief {
            brief
        } else {
            rng.random_range(usual)
        };
        (cycles / rate, rate)
    }

    /// Seconds of rest, none when brief.
    pub(super) fn pause(&self, rng: &mut ChaCha8Rng, usual: std::ops::Range<f64>) -> f64 {
        let seconds = rng.random_range(usual);
        if self.brief { 0.0 } else { seconds }
    }

    /// +1 where the trunk turns left to bring this arm forward, −1 where right.
    pub(super) fn turn(&self) -> f64 {
        if self.side() == Side::Left { -1.0 } else { 1.0 }
    }
}
