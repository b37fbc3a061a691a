//! C3D files: labelled markers (Plug-in-Gait and other usual names) or joint centres.
//!
//! Joints under a marker on the skin are estimated: the shoulder below its marker, the elbow inside of its outer one.
//! Frames before and after the markers are all seen are left out, gaps between are bridged.

mod file;
mod markers;

use std::path::Path;

use nalgebra::{Rotation3, Vector3};

use crate::hands::HandAxes;
use crate::source::{self, Heading, Rate, Take, node_joint};
use crate::understanding::Reading;
use crate::world_frame::WorldFrame;
use crate::{KeyNode, MotionError, ReadOptions, Side, UpAxis, parse_unit};
use file::Points;
use markers::Markers;

/// Gaps longer than this are worth a word, seconds.
const LONG_GAP: f64 = 0.2;

/// Reads a C3D file.
///
/// # Errors
/// [`MotionError`] with what is wrong with the file, the marker that is missing, or the frame.
pub fn read(path: &Path, options: &ReadOptions) -> Result<Reading, MotionError> {
    from_bytes(path, &source::read_file(path)?, options)
}

/// Reads a C3D file's content; `path` names the clip and the errors.
///
/// # Errors
/// As [`read`].
pub fn from_bytes(
    path: &Path,
    bytes: &[u8],
    options: &ReadOptions,
) -> Result<Reading, MotionError> {
    let error = |reason: String| MotionError::format(path, reason);
    let points = Points::parse(path, bytes)?;
    let mut warnings = Vec::new();
    if points.frames < points.announced {
        warnings.push(format!(
            "the file announces {} frames and has {}",
            points.announced, points.frames
        ));
    }
    let rate = match options.fps {
        Some(fps) => Rate::given(fps),
        None => Rate::found(points.rate).map_err(|reason| format!("{reason}; --fps gives it")),
    };
    let rate = rate.map_err(error)?;
    warnings.extend(rate.warning);
    let markers = Markers::find(&points, options).map_err(error)?;
    let trajectories =
        Trajectories::new(&points, &markers, rate.fps, &mut warnings).map_err(error)?;
    let mut axes = first_axes(&markers, &trajectories);
    let frames: Vec<WorldFrame> = (0..trajectories.frames)
        .map(|frame| markers.frame(&|point| trajectories.at(frame, point), &mut axes))
        .collect();
    let probe = |i: usize| markers.probe(&frames[i], &|point| trajectories.at(i, point));
    let probes = source::probed(frames.len()).map(probe).collect();
    let up = points
        .screen_up
        .as_deref()
        .and_then(|axis| axis.to_lowercase().parse::<UpAxis>().ok());
    let take = Take {
        format: "C3D",
        naming: "marker".to_owned(),
        fps: rate.fps,
        probes,
        rest: None,
        heading: Heading::Steady,
        joints: KeyNode::ALL
            .into_iter()
            .map(|node| node_joint(node, markers.labels_of(&points, node)))
            .collect(),
        unit: points
            .unit
            .as_deref()
            .and_then(|unit| parse_unit(&unit.to_lowercase()).ok()),
        up,
        hands: Side::BOTH.map(|side| {
            if markers.hand_is_seen(side) {
                HandAxes::Fixed(Rotation3::identity())
            } else {
                HandAxes::None("the wrist has no markers on both sides")
            }
        }),
        thumbs: None,
        frames,
        warnings,
    };
    source::finish(path, take, options)
}

/// The elbows' axes before the first frame: those of the first frame in which an elbow is bent.
fn first_axes(markers: &Markers, trajectories: &Trajectories) -> [Option<Vector3<f64>>; 2] {
    let mut axes = [None; 2];
    for frame in 0..trajectories.frames {
        let mut found = [None; 2];
        markers.frame(&|point| trajectories.at(frame, point), &mut found);
        for (axis, found) in axes.iter_mut().zip(found) {
            *axis = axis.or(found);
        }
        if axes.iter().all(Option::is_some) {
            break;
        }
    }
    axes
}

/// The used points over the frames in which the needed ones are there, without gaps.
struct Trajectories {
    frames: usize,
    /// By point; empty for one that is not used.
    points: Vec<Vec<Vector3<f64>>>,
}

impl Trajectories {
    fn new(
        points: &Points,
        markers: &Markers,
        fps: f64,
        warnings: &mut Vec<String>,
    ) -> Result<Self, String> {
        let needed = markers.needed();
        let whole = |frame: &usize| needed.iter().all(|p| points.position(*frame, *p).is_some());
        let begin = (0..points.frames).find(whole);
        let end = (0..points.frames).rfind(whole);
        let Some((begin, end)) = begin.zip(end) else {
            return Err("no frame has all the needed markers".to_owned());
        };
        if end - begin + 1 < points.frames {
            warnings.push(format!(
                "frames {begin} to {end} of {} are read: before and after, needed markers are not seen",
                points.frames
            ));
        }
        let mut trajectories = vec![Vec::new(); points.labels.len()];
        let mut longest: (usize, &str) = (0, "");
        for point in markers.used() {
            let seen: Vec<Option<Vector3<f64>>> = (begin..=end)
                .map(|frame| points.position(frame, point))
                .collect();
            let (bridged, gap) = bridged(&seen);
            trajectories[point] = bridged;
            if gap > longest.0 {
                longest = (gap, &points.labels[point]);
            }
        }
        if longest.0 as f64 > LONG_GAP * fps {
            let seconds = longest.0 as f64 / fps;
            warnings.push(format!(
                "gaps up to {seconds:.1} s are bridged by straight lines, the longest in {}",
                longest.1
            ));
        }
        Ok(Self {
            frames: end - begin + 1,
            points: trajectories,
        })
    }

    fn at(&self, frame: usize, point: usize) -> Vector3<f64> {
        self.points[point][frame]
    }
}

/// A trajectory with straight lines over its gaps, and the longest gap, frames. Ends stay where they are.
fn bridged(seen: &[Option<Vector3<f64>>]) -> (Vec<Vector3<f64>>, usize) {
    let mut filled = Vec::with_capacity(seen.len());
    let mut longest = 0;
    let mut before: Option<Vector3<f64>> = None;
    while filled.len() < seen.len() {
        let start = filled.len();
        if let Some(here) = seen[start] {
            filled.push(here);
            before = Some(here);
            continue;
        }
        let length = seen[start..].iter().take_while(|p| p.is_none()).count();
        let after = seen.get(start + length).copied().flatten();
        let (a, b) = match (before, after) {
            (Some(a), Some(b)) => (a, b),
            (Some(a), None) | (None, Some(a)) => (a, a),
            (None, None) => (Vector3::zeros(), Vector3::zeros()),
        };
        longest = longest.max(length);
        let step = |k: usize| a.lerp(&b, (k + 1) as f64 / (length + 1) as f64);
        filled.extend((0..length).map(step));
    }
    (filled, longest)
}
