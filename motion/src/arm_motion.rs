//! How an arm moves in a clip: speeds and rhythm, whatever the person's size.

use nalgebra::Vector3;

use crate::{Clip, Side};

/// Upper arm to which every person is scaled, metres.
const UPPER_ARM: f64 = 0.28;
/// Frames a second at which motion is measured.
const RATE: f64 = 50.0;
/// Highest frequency of the spectrum that counts, Hz.
const HIGHEST: f64 = 8.0;
/// Shortest clip that says something of a rhythm, seconds.
const SHORTEST: f64 = 1.0;

/// Figures of one arm in one clip, scaled to an upper arm of 0.28 m.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ArmMotion {
    /// Speed of the wrist in the waist's frame, 95th percentile and largest, m/s.
    pub hand_speed: [f64; 2],
    /// Its acceleration, 95th percentile, m/s².
    pub hand_acceleration: f64,
    /// How fast the upper arm turns, 95th percentile and largest, rad/s.
    pub turn_rate: [f64; 2],
    /// Centre of the spectrum of the wrist's velocity, Hz.
    pub frequency: f64,
}

impl ArmMotion {
    /// Measures an arm; none where the clip is shorter than a second, or too long to be sampled anew.
    #[must_use]
    pub fn of(clip: &Clip, side: Side) -> Option<Self> {
        let clip = clip.resampled(RATE).ok()?;
        if clip.duration() < SHORTEST {
            return None;
        }
        let [shoulder, elbow, wrist] = side.arm();
        let place = |node, frame: &crate::KeyNodeFrame| frame.position(node).cast::<f64>();
        let upper_arm = |frame| place(elbow, frame) - place(shoulder, frame);
        let scale = UPPER_ARM / upper_arm(clip.frames.first()?).norm();
        let wrists: Vec<Vector3<f64>> = clip
            .frames
            .iter()
            .map(|frame| scale * place(wrist, frame))
            .collect();
        let velocities: Vec<Vector3<f64>> = wrists
            .windows(2)
            .map(|pair| (pair[1] - pair[0]) * RATE)
            .collect();
        let speeds = sorted(velocities.iter().map(Vector3::norm));
        // Over three frames: a recording's noise is no acceleration.
        let accelerations = velocities
            .windows(3)
            .map(|v| ((v[2] - v[0]) * RATE / 2.0).norm());
        let turns = clip.frames.windows(2);
        let turns = turns.map(|pair| upper_arm(&pair[0]).angle(&upper_arm(&pair[1])) * RATE);
        let turns = sorted(turns);
        Some(Self {
            hand_speed: [quantile(&speeds, 0.95), quantile(&speeds, 1.0)],
            hand_acceleration: quantile(&sorted(accelerations), 0.95),
            turn_rate: [quantile(&turns, 0.95), quantile(&turns, 1.0)],
            frequency: spectral_centre(&velocities),
        })
    }
}

/// Mean frequency of a motion, each weighted by its power.
fn spectral_centre(velocities: &[Vector3<f64>]) -> f64 {
    let count = velocities.len() as f64;
    let (mut power, mut weighted) = (0.0, 0.0);
    for index in 1..=(HIGHEST * count / RATE) as usize {
        let turn = std::f64::consts::TAU * index as f64 / count;
        let (mut cosines, mut sines) = (Vector3::zeros(), Vector3::zeros());
        for (t, velocity) in velocities.iter().enumerate() {
            let (sine, cosine) = (turn * t as f64).sin_cos();
            cosines += velocity * cosine;
            sines += velocity * sine;
        }
        let here = cosines.norm_squared() + sines.norm_squared();
        power += here;
        weighted += here * index as f64 * RATE / count;
    }
    weighted / power.max(1e-12)
}

fn sorted(values: impl Iterator<Item = f64>) -> Vec<f64> {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values
}

/// The number below which this share of sorted numbers lies; 0 where there are none.
#[must_use]
pub fn quantile(sorted: &[f64], share: f64) -> f64 {
    let index = (sorted.len().saturating_sub(1) as f64 * share).round() as usize;
    sorted.get(index).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::skills::{Skill, generate};
    use crate::{KeyNode, KeyNodeFrame};

    /// A right forearm that swings up and down about the elbow at 2 Hz, 0.3 m to either side; all else stands still.
    fn swinging(scale: f32) -> Clip {
        let rest = generate(Skill::Idle, 1).frames[0].clone();
        let frame = |t: usize| {
            let mut frame: KeyNodeFrame = rest.clone();
            let phase = std::f64::consts::TAU * 2.0 * t as f64 / 100.0;
            let shoulder = rest.position(KeyNode::RightShoulder);
            let down = Vector3::new(0.0, 0.0, -0.28);
            frame.positions[KeyNode::RightElbow as usize] = shoulder + down;
            let wrist = Vector3::new(0.25, 0.0, (0.3 * phase.sin()) as f32);
            frame.positions[KeyNode::RightWrist as usize] = shoulder + down + wrist;
            for position in &mut frame.positions {
                *position *= scale;
            }
            frame
        };
        Clip {
            name: "swing".to_owned(),
            fps: 100.0,
            frames: (0..500).map(frame).collect(),
        }
    }

    #[test]
    fn a_swing_has_its_speed_and_its_rhythm_whatever_the_persons_size() {
        let peak = 0.3 * std::f64::consts::TAU * 2.0;
        for scale in [0.8, 1.0, 1.2] {
            let motion = ArmMotion::of(&swinging(scale), Side::Right).unwrap();
            assert!(
                (motion.hand_speed[1] / peak - 1.0).abs() < 0.02,
                "{motion:?}"
            );
            assert!(
                (motion.hand_speed[0] / peak - 1.0).abs() < 0.03,
                "{motion:?}"
            );
            let acceleration = peak * std::f64::consts::TAU * 2.0;
            assert!((motion.hand_acceleration / acceleration - 1.0).abs() < 0.05);
            assert!((motion.frequency - 2.0).abs() < 0.1, "{motion:?}");
            assert!(motion.turn_rate[1] < 1e-3, "{motion:?}");
        }
        let still = ArmMotion::of(&swinging(1.0), Side::Left).unwrap();
        assert_eq!(still.hand_speed, [0.0; 2]);
    }

    #[test]
    fn a_clip_without_time_has_no_figures() {
        let mut clip = swinging(1.0);
        clip.frames.truncate(50);
        assert_eq!(ArmMotion::of(&clip, Side::Right), None);
    }
}
