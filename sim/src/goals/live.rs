//! Goals as a live stream brings them: frames that come late, at odd times, or not at all.

use rand::{Rng, RngExt as _};
use serde::{Deserialize, Serialize};

/// Frames a second of a live source.
const RATE: [f64; 2] = [25.0, 60.0];
/// Control periods that a frame travels.
const DELAY: [f64; 2] = [0.0, 1.5];
/// Share of frames that are lost on their own.
const LOST: f64 = 0.05;
/// Frames of a block that may be lost as a whole, and the share of such blocks.
const BLOCK: u64 = 6;
const LOST_BLOCKS: f64 = 0.02;
/// Frames that are looked back for one that came.
const LONGEST_GAP: u64 = 4 * BLOCK;

/// When the frames of a live source reach a robot, which holds the newest one's goal. Any time of it can be asked for: what
/// happens to a frame follows from the seed and the frame's number.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct LiveStream {
    seed: u64,
    /// Control periods from one frame to the next.
    spacing: f64,
}

impl LiveStream {
    /// Draws a stream for robots with this control period, seconds.
    pub(super) fn draw(period: f64, rng: &mut impl Rng) -> Self {
        Self {
            seed: rng.next_u64(),
            spacing: 1.0 / (period * rng.random_range(RATE[0]..=RATE[1])),
        }
    }

    /// When the newest frame that has come by `now` was captured; both in control periods from the stream's start, before
    /// which the person stood as at it.
    pub(crate) fn captured(self, now: f64) -> f64 {
        let newest = (now / self.spacing) as u64;
        let frames = (newest.saturating_sub(LONGEST_GAP)..=newest).rev();
        let mut captured = frames
            .filter(|&frame| !self.is_lost(frame))
            .map(|frame| (frame as f64 * self.spacing, self.delay(frame)))
            .filter(|(captured, delay)| captured + delay <= now);
        captured.next().map_or(0.0, |(captured, _)| captured)
    }

    fn is_lost(self, frame: u64) -> bool {
        self.share(2 * frame) < LOST || self.share(2 * (frame / BLOCK) + 1) < LOST_BLOCKS
    }

    fn delay(self, frame: u64) -> f64 {
        let [least, most] = DELAY;
        least + (most - least) * self.share(u64::MAX - frame)
    }

    /// A number in 0..1 that follows from the seed and `index` (splitmix64).
    fn share(self, index: u64) -> f64 {
        let mut x = self.seed ^ index.wrapping_mul(0x9e37_79b9_7f4a_7c15);
        x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((x ^ (x >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng as _;

    #[test]
    fn frames_come_late_irregularly_and_in_order_and_some_never() {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(2);
        let (mut lags, mut longest, mut repeats) = (0.0, 0.0_f64, 0);
        for _ in 0..50 {
            let stream = LiveStream::draw(0.02, &mut rng);
            let mut last = 0.0;
            for t in 0..200 {
                let captured = stream.captured(f64::from(t));
                assert!(
                    (last..=f64::from(t)).contains(&captured),
                    "{captured} at {t}"
                );
                repeats += u32::from(captured == last);
                lags += f64::from(t) - captured;
                longest = longest.max(f64::from(t) - captured);
                last = captured;
            }
        }
        // Of 10,000 control periods. At 25 to 60 Hz a frame lasts 1.3 periods on average, and travels 0.75.
        let mean = lags / 10_000.0;
        assert!((0.8..2.5).contains(&mean), "{mean}");
        assert!((6.0..40.0).contains(&longest), "{longest}");
        assert!((1500..6000).contains(&repeats), "{repeats}");
    }
}
