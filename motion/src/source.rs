//! What every reader shares: from poses in a file's own axes and unit to a heading-free [`Clip`], and what was understood.

use std::path::Path;

use nalgebra::{Matrix3, Rotation3, Vector3};

use crate::hands::{self, HandAxes};
use crate::options::{UNIT_NAMES, UpAxis};
use crate::orientation::{self, Probe, mean};
use crate::understanding::{NodeJoint, Reading, Understanding};
use crate::world_frame::WorldFrame;
use crate::{BodyJoint, Clip, KeyNode, KeyNodeFrame, MotionError, ReadOptions, Side};

/// No motion file holds more frames than this (over an hour at 120 frames a second).
pub(crate) const MAX_FRAMES: usize = 500_000;
/// No motion file is larger than this, bytes.
const MAX_FILE: u64 = 512 << 20;
/// Frame rates accepted, frames a second.
const FRAME_RATES: std::ops::RangeInclusive<f64> = 1.0..=1000.0;
/// Frame times that are milliseconds, although a file's unit is the second: 250 down to 2 frames a second.
const MILLISECONDS: std::ops::RangeInclusive<f64> = 4.0..=500.0;
/// Metres in one file unit, for the units that occur: metre, centimetre, millimetre, inch, and the CMU database's own.
const UNITS: [f64; 5] = [1.0, 0.01, 0.001, 0.0254, 0.0254 / 0.45];
/// Upper arm and forearm of an average adult, metres.
const ARM_LENGTH: f64 = 0.53;
/// Arm lengths that a known unit may result in, metres; outside, the skeleton is scaled to the average adult.
const PLAUSIBLE_ARM: std::ops::RangeInclusive<f64> = 0.33..=0.80;
/// Poses looked at to find what a file does not say.
const PROBES: usize = 200;
/// A left–right line steeper than this (length of its horizontal part over its length) says nothing about the heading.
const LEVEL_ENOUGH: f64 = 0.2;
/// Standard deviation of the Gaussian that steadies a heading, seconds.
const HEADING_SMOOTHING: f64 = 0.1;

/// Whether the heading follows its left–right line exactly or steadied.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum Heading {
    /// The line is the shoulders': the trunk's yaw is unknown and must come out as zero.
    Exact,
    /// The line is the pelvis's.
    Steady,
}

/// A frame rate, and what is doubtful about it.
#[derive(Debug)]
pub(crate) struct Rate {
    pub(crate) fps: f64,
    pub(crate) warning: Option<String>,
}

impl Rate {
    /// The rate that the caller gives.
    pub(crate) fn given(fps: f64) -> Result<Self, String> {
        let accepted = FRAME_RATES.contains(&fps);
        accepted
            .then_some(Self { fps, warning: None })
            .ok_or_else(|| implausible_rate(fps))
    }

    /// The rate that a file says; one below the least accepted is raised to it.
    pub(crate) fn found(fps: f64) -> Result<Self, String> {
        let least = *FRAME_RATES.start();
        if fps > 0.0 && fps < least {
            let warning = format!(
                "a rate of {fps:.3} Hz is below {least} Hz, which is taken instead; --fps gives the right one"
            );
            return Ok(Self {
                fps: least,
                warning: Some(warning),
            });
        }
        Self::given(fps)
    }

    /// The rate of frames that follow each other by `seconds`, which some files give in milliseconds.
    pub(crate) fn from_frame_time(seconds: f64) -> Result<Self, String> {
        if MILLISECONDS.contains(&seconds) {
            let warning = format!(
                "a frame time of {seconds} s is taken as milliseconds; --fps gives another rate"
            );
            return Ok(Self {
                fps: 1000.0 / seconds,
                warning: Some(warning),
            });
        }
        let refused =
            || format!("a frame time of {seconds} s is no plausible one; --fps gives the rate");
        if seconds > 0.0 {
            Self::found(1.0 / seconds).map_err(|_| refused())
        } else {
            Err(refused())
        }
    }
}

fn implausible_rate(fps: f64) -> String {
    let (least, most) = (FRAME_RATES.start(), FRAME_RATES.end());
    format!("frame rate {fps} is not between {least} and {most}")
}

/// A motion in its file's axes and unit, and what the file's format tells about it.
pub(crate) struct Take {
    pub(crate) format: &'static str,
    pub(crate) naming: String,
    pub(crate) fps: f64,
    /// Wrists are the wrist joints' own orientations; `hands` turns them.
    pub(crate) frames: Vec<WorldFrame>,
    /// Some of the poses, with the legs.
    pub(crate) probes: Vec<Probe>,
    /// The pose without any rotation.
    pub(crate) rest: Option<Probe>,
    pub(crate) heading: Heading,
    pub(crate) joints: Vec<NodeJoint>,
    /// Metres a unit where the format says them.
    pub(crate) unit: Option<f64>,
    /// The axis that the format or the file says is up.
    pub(crate) up: Option<UpAxis>,
    pub(crate) hands: [HandAxes; 2],
    /// How far the thumbs point forward in the rest pose, −1 to 1.
    pub(crate) thumbs: Option<f64>,
    pub(crate) warnings: Vec<String>,
}

/// Finds out what the file does not say, and brings the motion into our axes.
pub(crate) fn finish(
    path: &Path,
    take: Take,
    options: &ReadOptions,
) -> Result<Reading, MotionError> {
    check_size(path, take.fps, take.frames.len())?;
    let mut warnings = take.warnings;
    let rest = take.rest.as_ref();
    let up = options.up.unwrap_or_else(|| {
        let (up, unsure) = orientation::up_axis(&take.probes, rest, take.up);
        warnings.extend(unsure);
        up
    });
    let unit = metres_per_unit(path, &take.probes, take.unit, options, &mut warnings)?;
    let seen = orientation::is_mirrored(&take.probes, rest, up, take.thumbs);
    let mirrored = options.mirror.or(seen).unwrap_or(false);
    if mirrored && options.mirror.is_none() {
        warnings.push("the file holds a mirror image (toes, knees, thumbs or elbows point backward), which is mended; --mirror no leaves it".to_owned());
    }
    let direction = up.direction();
    let hands = Side::BOTH.map(|side| {
        hands::solve(
            &take.hands[side as usize],
            side,
            &take.frames,
            &direction,
            mirrored,
        )
    });
    let upright = upright(up);
    let frames: Vec<WorldFrame> = take
        .frames
        .iter()
        .map(|frame| oriented(frame, unit, &upright, mirrored, &hands))
        .collect();
    let clip = into_clip(path, take.fps, &frames, take.heading)?;
    let understanding = Understanding {
        format: take.format,
        naming: take.naming,
        frames: clip.frames.len(),
        fps: clip.fps,
        unit: Some(unit_name(unit)),
        up: Some(up.to_string()),
        handedness: match (mirrored, options.mirror.is_some() || seen.is_some()) {
            (true, _) => Some("mirrored"),
            (false, true) => Some("right-handed"),
            (false, false) => None,
        },
        height: orientation::height(&take.probes, up).map(|height| height * unit),
        joints: take.joints,
        hands: hands.map(|hand| match hand {
            Ok((_, how)) => format!("followed {how}"),
            Err(reason) => format!("not followed: {reason}"),
        }),
        warnings,
    };
    Ok(Reading {
        clip,
        understanding,
    })
}

/// Indices of the frames that are looked at.
pub(crate) fn probed(frames: usize) -> impl Iterator<Item = usize> {
    (0..frames).step_by(frames.div_ceil(PROBES).max(1))
}

/// A joint's name for [`Understanding::joints`].
pub(crate) fn node_joint(node: KeyNode, joint: impl Into<String>) -> NodeJoint {
    NodeJoint {
        node: node.name(),
        joint: joint.into(),
    }
}

/// The error for a map that names a joint which the file does not have.
pub(crate) fn unknown_mapped<'a>(
    path: &Path,
    joint: BodyJoint,
    name: &str,
    there: impl Iterator<Item = &'a str>,
) -> MotionError {
    let there: Vec<&str> = there.filter(|name| !name.is_empty()).take(60).collect();
    let reason = format!(
        "no joint is called {name:?}, which is to be {}; there are {}",
        joint.name(),
        there.join(", ")
    );
    MotionError::format(path, reason)
}

fn metres_per_unit(
    path: &Path,
    probes: &[Probe],
    told: Option<f64>,
    options: &ReadOptions,
    warnings: &mut Vec<String>,
) -> Result<f64, MotionError> {
    if let Some(scale) = options.metres_per_unit {
        let reason = || format!("{scale} metres a unit: expected a positive number");
        let usable = scale.is_finite() && scale > 0.0;
        return usable
            .then_some(scale)
            .ok_or_else(|| MotionError::format(path, reason()));
    }
    let arm = mean(probes.iter().map(arm_length));
    if let Some(told) = told {
        if PLAUSIBLE_ARM.contains(&(arm * told)) {
            return Ok(told);
        }
        warnings.push(format!(
            "arms of {:.2} m are no person's, so the file's unit is not what it says",
            arm * told
        ));
    }
    let miss = |unit: f64| (arm * unit / ARM_LENGTH).ln().abs();
    let best = UNITS
        .into_iter()
        .min_by(|a, b| miss(*a).total_cmp(&miss(*b)))
        .unwrap_or(1.0);
    if PLAUSIBLE_ARM.contains(&(arm * best)) {
        return Ok(best);
    }
    warnings.push("no known unit gives a person's arms: the person is scaled to an average adult; --unit tells".to_owned());
    Ok(ARM_LENGTH / arm)
}

/// Upper arm and forearm, mean of both sides, file units.
fn arm_length(probe: &Probe) -> f64 {
    let bone =
        |a: KeyNode, b: KeyNode| (probe.positions[b as usize] - probe.positions[a as usize]).norm();
    mean(Side::BOTH.iter().map(|side| {
        let [shoulder, elbow, wrist] = side.arm();
        bone(shoulder, elbow) + bone(elbow, wrist)
    }))
}

fn unit_name(unit: f64) -> String {
    let known = UNIT_NAMES.iter().find(|(_, metres)| *metres == unit);
    known.map_or_else(|| format!("{unit:.5} m"), |(name, _)| (*name).to_owned())
}

/// The rotation that takes the up axis to z.
fn upright(up: UpAxis) -> Rotation3<f64> {
    use std::f64::consts::{FRAC_PI_2, PI};
    let (axis, angle) = match up {
        UpAxis::X => (Vector3::y_axis(), -FRAC_PI_2),
        UpAxis::Y => (Vector3::x_axis(), FRAC_PI_2),
        UpAxis::Z => (Vector3::z_axis(), 0.0),
        UpAxis::MinusX => (Vector3::y_axis(), FRAC_PI_2),
        UpAxis::MinusY => (Vector3::x_axis(), -FRAC_PI_2),
        UpAxis::MinusZ => (Vector3::x_axis(), PI),
    };
    Rotation3::from_axis_angle(&axis, angle)
}

/// A frame in metres with z up, hands in the convention, seen in a mirror where it was a mirror image.
fn oriented(
    frame: &WorldFrame,
    to_metres: f64,
    upright: &Rotation3<f64>,
    mirrored: bool,
    hands: &[Result<(Rotation3<f64>, &'static str), &'static str>; 2],
) -> WorldFrame {
    let flip = |v: Vector3<f64>| {
        if mirrored {
            Vector3::new(v.x, -v.y, v.z)
        } else {
            v
        }
    };
    // The reflection turns y = z × x around.
    let hand = |r: Rotation3<f64>| {
        let columns = [0, 1, 2].map(|i| {
            let column = flip(r.matrix().column(i).into_owned());
            if mirrored && i == 1 { -column } else { column }
        });
        Rotation3::from_matrix_unchecked(Matrix3::from_columns(&columns))
    };
    let wrist = |side: Side| {
        let (turn, _) = hands[side as usize].as_ref().ok()?;
        Some(hand(upright * frame.wrists[side as usize]? * turn))
    };
    WorldFrame {
        positions: frame.positions.map(|p| flip(upright * p) * to_metres),
        left: flip(upright * frame.left),
        wrists: Side::BOTH.map(wrist),
    }
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
        return Err(MotionError::format(path, implausible_rate(fps)));
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
