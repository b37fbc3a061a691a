//! Changing the rate of a pose sequence without bending bones or aliasing.

use nalgebra::{Rotation3, UnitQuaternion, Vector3};

use crate::{KEY_NODES, KeyNode, KeyNodeFrame, ResampleError};

/// Share of the new Nyquist frequency that the low-pass lets through.
const PASS_BAND: f64 = 0.9;
/// Half-width of the low-pass, in frames of the new rate.
const LOW_PASS_HALF_WIDTH: f64 = 4.0;
/// Rates that differ by less than this share are the same rate.
const SAME_RATE: f64 = 1e-6;
/// Resampling makes no more frames than this: five and a half hours at 50 Hz, about 0.5 GB while it works.
pub(crate) const MAX_RESAMPLED: usize = 1_000_000;

/// A pose as directions on spheres, where interpolation is meaningful.
#[derive(Clone)]
struct Joints {
    /// Unit direction of the bone that ends at each node (the waist's is unused).
    directions: [Vector3<f64>; KEY_NODES],
    /// Its length, metres.
    lengths: [f64; KEY_NODES],
    wrists: [Option<UnitQuaternion<f64>>; 2],
}

/// How many frames `count` frames at `from` frames a second become at `to`; both rates positive. Saturates.
pub(crate) fn resampled_len(count: usize, from: f64, to: f64) -> usize {
    if count < 2 || (from / to - 1.0).abs() < SAME_RATE {
        return count;
    }
    (((count - 1) as f64 / from * to + SAME_RATE).floor() as usize).saturating_add(1)
}

/// Frames at `to` frames a second of a motion given at `from`; empty in, empty out.
///
/// # Errors
/// A rate that is not a positive number, or more than [`MAX_RESAMPLED`] frames to make; nothing is made then.
pub(crate) fn resample(
    frames: &[KeyNodeFrame],
    from: f64,
    to: f64,
) -> Result<Vec<KeyNodeFrame>, ResampleError> {
    for rate in [from, to] {
        if !(rate.is_finite() && rate > 0.0) {
            return Err(ResampleError::Rate { rate });
        }
    }
    let count = resampled_len(frames.len(), from, to);
    if frames.len() < 2 || (from / to - 1.0).abs() < SAME_RATE {
        return Ok(frames.to_vec());
    }
    if count > MAX_RESAMPLED {
        return Err(ResampleError::TooManyFrames {
            frames: count,
            limit: MAX_RESAMPLED,
        });
    }
    let mut joints: Vec<Joints> = frames.iter().map(Joints::new).collect();
    if to < from {
        joints = low_passed(&joints, to / from);
    }
    let last = joints.len() - 1;
    let origin = frames[0].position(KeyNode::Waist);
    Ok((0..count)
        .map(|i| at(&joints, (i as f64 * from / to).min(last as f64)).frame(origin))
        .collect())
}

/// Catmull–Rom interpolation at `index` (frames, fractional). Beyond its ends the motion is taken to go on straight, which
/// is a matter of weights: the missing sample is twice the end's minus its neighbour's.
fn at(joints: &[Joints], index: f64) -> Joints {
    let last = joints.len() - 1;
    let i = (index.floor() as usize).min(last - 1);
    let mut weights = catmull_rom(index - i as f64);
    if i == 0 {
        weights = [
            0.0,
            weights[1] + 2.0 * weights[0],
            weights[2] - weights[0],
            weights[3],
        ];
    }
    if i + 2 > last {
        weights = [
            weights[0],
            weights[1] - weights[3],
            weights[2] + 2.0 * weights[3],
            0.0,
        ];
    }
    let samples = [i.saturating_sub(1), i, i + 1, (i + 2).min(last)].map(|k| &joints[k]);
    blend(&joints[i], &samples, &weights)
}

/// Weights of the four samples around a point at `u` in 0..1 between the middle two.
fn catmull_rom(u: f64) -> [f64; 4] {
    let (u2, u3) = (u * u, u * u * u);
    [
        0.5 * (-u3 + 2.0 * u2 - u),
        0.5 * (3.0 * u3 - 5.0 * u2 + 2.0),
        0.5 * (-3.0 * u3 + 4.0 * u2 + u),
        0.5 * (u3 - u2),
    ]
}

/// Zero-phase windowed-sinc low-pass at `PASS_BAND` of the new Nyquist frequency; `ratio` is new rate / old rate.
/// The window narrows toward the ends, which keeps it symmetric: no lag, and the end frames stay as they are.
fn low_passed(joints: &[Joints], ratio: f64) -> Vec<Joints> {
    let widest = (LOW_PASS_HALF_WIDTH / ratio).round() as usize;
    let cutoff = PASS_BAND * ratio;
    (0..joints.len())
        .map(|i| {
            let half = widest.min(i).min(joints.len() - 1 - i);
            let samples: Vec<&Joints> = joints[i - half..=i + half].iter().collect();
            let weights = low_pass_weights(half, cutoff);
            blend(&joints[i], &samples, &weights)
        })
        .collect()
}

/// Hann-windowed sinc of 2·half + 1 taps, `cutoff` as a share of the old Nyquist frequency; the taps sum to 1.
fn low_pass_weights(half: usize, cutoff: f64) -> Vec<f64> {
    use std::f64::consts::PI;
    let taps: Vec<f64> = (0..=2 * half)
        .map(|k| {
            let x = k as f64 - half as f64;
            let sinc = if x == 0.0 {
                1.0
            } else {
                (PI * cutoff * x).sin() / (PI * cutoff * x)
            };
            sinc * 0.5 * (1.0 + (PI * x / (half + 1) as f64).cos())
        })
        .collect();
    let sum: f64 = taps.iter().sum();
    taps.into_iter().map(|w| w / sum).collect()
}

/// Weighted mean of poses near `base`, taken in `base`'s tangent spaces. Weights sum to 1.
fn blend(base: &Joints, samples: &[&Joints], weights: &[f64]) -> Joints {
    let mut out = base.clone();
    for node in 0..KEY_NODES {
        let sum: Vector3<f64> = samples
            .iter()
            .zip(weights)
            .map(|(s, w)| s.directions[node] * *w)
            .sum();
        out.directions[node] = sum.try_normalize(1e-9).unwrap_or(base.directions[node]);
        out.lengths[node] = samples
            .iter()
            .zip(weights)
            .map(|(s, w)| s.lengths[node] * w)
            .sum();
    }
    for side in 0..2 {
        out.wrists[side] = blend_wrist(base, samples, weights, side);
    }
    out
}

/// A wrist is known between two samples only where every sample that counts knows it.
fn blend_wrist(
    base: &Joints,
    samples: &[&Joints],
    weights: &[f64],
    side: usize,
) -> Option<UnitQuaternion<f64>> {
    let centre = base.wrists[side]?;
    let mut mean = Vector3::zeros();
    for (sample, weight) in samples.iter().zip(weights).filter(|(_, w)| **w != 0.0) {
        mean += (centre.inverse() * sample.wrists[side]?).scaled_axis() * *weight;
    }
    Some(centre * UnitQuaternion::from_scaled_axis(mean))
}

impl Joints {
    fn new(frame: &KeyNodeFrame) -> Self {
        let mut directions = [Vector3::x(); KEY_NODES];
        let mut lengths = [0.0; KEY_NODES];
        for (parent, node) in KeyNode::bones() {
            let bone = frame.bone(parent, node).cast::<f64>();
            lengths[node as usize] = bone.norm();
            directions[node as usize] = bone
                .try_normalize(f64::MIN_POSITIVE)
                .unwrap_or_else(Vector3::x);
        }
        let quaternion =
            |r: &Rotation3<f32>| UnitQuaternion::from_rotation_matrix(&r.cast::<f64>());
        Self {
            directions,
            lengths,
            wrists: frame
                .wrist_rotations
                .each_ref()
                .map(|r| r.as_ref().map(quaternion)),
        }
    }

    fn frame(&self, origin: Vector3<f32>) -> KeyNodeFrame {
        let mut positions = [origin; KEY_NODES];
        for (parent, node) in KeyNode::bones() {
            let bone = self.directions[node as usize] * self.lengths[node as usize];
            positions[node as usize] = positions[parent as usize] + bone.cast::<f32>();
        }
        let rotation = |q: &UnitQuaternion<f64>| q.to_rotation_matrix().cast::<f32>();
        KeyNodeFrame {
            positions,
            wrist_rotations: self.wrists.each_ref().map(|q| q.as_ref().map(rotation)),
        }
    }
}
