//! What every reader shares: from poses in a source's world to a heading-free [`Clip`].

use std::path::Path;

use nalgebra::{Rotation3, Vector3};

use crate::{Clip, KEY_NODES, KeyNode, KeyNodeFrame, MotionError};

/// No motion file holds more frames than this (over an hour at 120 frames a second).
pub(crate) const MAX_FRAMES: usize = 500_000;
/// No motion file is larger than this, bytes.
const MAX_FILE: u64 = 512 << 20;
/// Frame rates accepted, frames a second.
const FRAME_RATES: std::ops::RangeInclusive<f64> = 1.0..=1000.0;
/// A left–right line steeper than this (length of its horizontal part over its length) says nothing about the heading.
const LEVEL_ENOUGH: f64 = 0.2;
/// Standard deviation of the Gaussian that steadies a heading, seconds.
const HEADING_SMOOTHING: f64 = 0.1;

/// One pose before normalisation: metres, z up, any heading, any origin.
#[derive(Clone)]
pub(crate) struct WorldFrame {
    pub(crate) positions: [Vector3<f64>; KEY_NODES],
    /// Points to the person's left; its direction in the ground plane defines the heading.
    pub(crate) left: Vector3<f64>,
    pub(crate) wrists: [Option<Rotation3<f64>>; 2],
}

/// Whether the heading follows its left–right line exactly or steadied.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum Heading {
    /// The line is the shoulders': the trunk's yaw is unknown and must come out as zero.
    Exact,
    /// The line is the pelvis's.
    Steady,
}

/// Reads a whole file, refusing one too large to be a motion.
pub(crate) fn read_file(path: &Path) -> Result<Vec<u8>, MotionError> {
    let size = std::fs::metadata(path)
        .map_err(|e| MotionError::io(path, e))?
        .len();
    if size > MAX_FILE {
        return Err(MotionError::format(
            path,
            format!("{size} bytes is more than the {MAX_FILE} a motion may have"),
        ));
    }
    std::fs::read(path).map_err(|e| MotionError::io(path, e))
}

/// A clip's name: the file's stem.
pub(crate) fn name_of(path: &Path) -> String {
    path.file_stem().map_or_else(
        || "unnamed".to_owned(),
        |stem| stem.to_string_lossy().into_owned(),
    )
}

/// Refuses a frame rate or a frame count no motion has.
pub(crate) fn check_size(path: &Path, fps: f64, frames: usize) -> Result<(), MotionError> {
    if !FRAME_RATES.contains(&fps) {
        let reason = format!(
            "frame rate {fps} is not between {} and {}",
            FRAME_RATES.start(),
            FRAME_RATES.end()
        );
        return Err(MotionError::format(path, reason));
    }
    if frames == 0 || frames > MAX_FRAMES {
        return Err(MotionError::format(
            path,
            format!("{frames} frames; expected 1 to {MAX_FRAMES}"),
        ));
    }
    Ok(())
}

/// Moves the origin to the waist, removes the heading and checks every frame.
pub(crate) fn into_clip(
    path: &Path,
    fps: f64,
    frames: &[WorldFrame],
    heading: Heading,
) -> Result<Clip, MotionError> {
    check_size(path, fps, frames.len())?;
    let mut yaw = headings(frames).ok_or_else(|| {
        MotionError::format(
            path,
            "no frame has a level line from right to left, so the heading is unknown",
        )
    })?;
    if heading == Heading::Steady {
        yaw = smoothed(&yaw, HEADING_SMOOTHING * fps);
    }
    let frames = frames
        .iter()
        .zip(yaw)
        .map(|(frame, yaw)| normalised(frame, yaw))
        .collect();
    validated(
        path,
        Clip {
            name: name_of(path),
            fps,
            frames,
        },
    )
}

/// The clip itself, or the error that names the file and the faulty frame.
pub(crate) fn validated(path: &Path, clip: Clip) -> Result<Clip, MotionError> {
    match clip.validate() {
        Ok(()) => Ok(clip),
        Err((frame, reason)) => Err(MotionError::Frame {
            path: path.to_owned(),
            frame,
            reason,
        }),
    }
}

fn normalised(frame: &WorldFrame, yaw: f64) -> KeyNodeFrame {
    let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), -yaw);
    let waist = frame.positions[KeyNode::Waist as usize];
    KeyNodeFrame {
        positions: frame.positions.map(|p| (turn * (p - waist)).cast::<f32>()),
        wrist_rotations: frame.wrists.map(|r| r.map(|r| (turn * r).cast::<f32>())),
    }
}

/// The continuous yaw of each frame, radians; a frame without one takes its neighbour's. `None` if no frame has one.
fn headings(frames: &[WorldFrame]) -> Option<Vec<f64>> {
    let mut last = frames.iter().find_map(|frame| yaw_of(&frame.left))?;
    let unwrapped = frames.iter().map(|frame| {
        if let Some(yaw) = yaw_of(&frame.left) {
            last += nalgebra::wrap(yaw - last, -std::f64::consts::PI, std::f64::consts::PI);
        }
        last
    });
    Some(unwrapped.collect())
}

/// The yaw of a body whose left is `left`; forward is left × up.
fn yaw_of(left: &Vector3<f64>) -> Option<f64> {
    let level = left.xy().norm();
    (level.is_finite() && level > LEVEL_ENOUGH * left.norm()).then(|| (-left.x).atan2(left.y))
}

/// Zero-phase Gaussian, `sigma` in frames; the window narrows toward the ends.
fn smoothed(values: &[f64], sigma: f64) -> Vec<f64> {
    let widest = (3.0 * sigma).ceil() as usize;
    let kernel: Vec<f64> = (0..=widest)
        .map(|k| (-0.5 * (k as f64 / sigma).powi(2)).exp())
        .collect();
    (0..values.len())
        .map(|i| {
            let half = widest.min(i).min(values.len() - 1 - i);
            let window = &values[i - half..=i + half];
            let weights = (0..window.len()).map(|k| kernel[k.abs_diff(half)]);
            let (sum, total) = window
                .iter()
                .zip(weights)
                .fold((0.0, 0.0), |(s, t), (v, w)| (s + v * w, t + w));
            sum / total
        })
        .collect()
}
