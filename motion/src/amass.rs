//! AMASS `.npz` files: SMPL-H (`poses`) and SMPL-X (`root_orient`, `pose_body`) motions.
//!
//! Joints are posed on the neutral body's rest offsets whatever the file's `betas` say: bone directions do not depend on
//! them. The wrist's orientation is that of the wrist joint; the world's z points up.

use std::path::Path;

use nalgebra::{Matrix3, Rotation3, Vector3};

use crate::npz::{Array, Npz};
use crate::source::{self, Heading, WorldFrame};
use crate::{Clip, KEY_NODES, KeyNode, MotionError, Side};

/// Columns of the body's joints in `poses`: root and 21 joints.
const BODY_COLUMNS: usize = 66;
/// Columns of `pose_body`: 21 joints.
const POSE_BODY_COLUMNS: usize = 63;

/// A joint on the way from the pelvis to a wrist.
struct Link {
    /// Index of the joint in `poses`.
    joint: usize,
    /// Offset from the joint before it at rest, neutral body, metres (x left, y up, z forward).
    offset: [f64; 3],
}

/// Pelvis to upper spine; the last one is the torso.
const SPINE: [Link; 3] = [
    Link {
        joint: 3,
        offset: [-0.0025, 0.1090, -0.0267],
    },
    Link {
        joint: 6,
        offset: [0.0055, 0.1352, 0.0011],
    },
    Link {
        joint: 9,
        offset: [0.0015, 0.0529, 0.0254],
    },
];

/// Collar, shoulder, elbow, wrist of each side.
const ARMS: [[Link; 4]; 2] = [
    [
        Link {
            joint: 13,
            offset: [0.0788, 0.1217, -0.0341],
        },
        Link {
            joint: 16,
            offset: [0.0910, 0.0305, -0.0089],
        },
        Link {
            joint: 18,
            offset: [0.2596, -0.0128, -0.0275],
        },
        Link {
            joint: 20,
            offset: [0.2492, 0.0090, -0.0012],
        },
    ],
    [
        Link {
            joint: 14,
            offset: [-0.0818, 0.1188, -0.0386],
        },
        Link {
            joint: 17,
            offset: [-0.0960, 0.0326, -0.0091],
        },
        Link {
            joint: 19,
            offset: [-0.2537, -0.0133, -0.0214],
        },
        Link {
            joint: 21,
            offset: [-0.2553, 0.0078, -0.0056],
        },
    ],
];

/// Reads an AMASS file.
///
/// # Errors
/// [`MotionError`] naming the array that is missing or wrong, or the frame.
pub fn read(path: &Path) -> Result<Clip, MotionError> {
    from_bytes(path, &source::read_file(path)?)
}

/// Reads an AMASS file's content; `path` names the clip and the errors.
///
/// # Errors
/// As [`read`].
pub fn from_bytes(path: &Path, bytes: &[u8]) -> Result<Clip, MotionError> {
    from_npz(path, &mut Npz::open(path, bytes)?)
}

/// Whether an archive has the arrays of an AMASS file.
pub(crate) fn recognises(npz: &Npz) -> bool {
    npz.has("poses") || npz.has("root_orient")
}

pub(crate) fn from_npz(path: &Path, npz: &mut Npz) -> Result<Clip, MotionError> {
    let rate = if npz.has("mocap_framerate") {
        "mocap_framerate"
    } else {
        "mocap_frame_rate"
    };
    let fps = npz.scalar(rate)?;
    let poses = body_poses(npz)?;
    source::check_size(path, fps, poses.len())?;
    let frames: Vec<WorldFrame> = poses.iter().map(posed).collect();
    source::into_clip(path, fps, &frames, Heading::Steady)
}

/// Axis-angle vectors of the root and the 21 body joints, frame by frame.
fn body_poses(npz: &mut Npz) -> Result<Vec<[f64; BODY_COLUMNS]>, MotionError> {
    if !npz.has("pose_body") {
        let poses = npz.array("poses")?;
        let width = columns(npz, "poses", &poses, |width| width >= BODY_COLUMNS)?;
        return Ok(poses
            .values
            .chunks_exact(width)
            .map(|row| std::array::from_fn(|i| row[i]))
            .collect());
    }
    let root = npz.array("root_orient")?;
    columns(npz, "root_orient", &root, |width| width == 3)?;
    let body = npz.array("pose_body")?;
    columns(npz, "pose_body", &body, |width| width == POSE_BODY_COLUMNS)?;
    if root.shape[0] != body.shape[0] {
        let reason = format!(
            "{} frames, but root_orient has {}",
            body.shape[0], root.shape[0]
        );
        return Err(npz.error("pose_body", &reason));
    }
    let rows = root
        .values
        .chunks_exact(3)
        .zip(body.values.chunks_exact(POSE_BODY_COLUMNS));
    Ok(rows
        .map(|(root, body)| std::array::from_fn(|i| if i < 3 { root[i] } else { body[i - 3] }))
        .collect())
}

/// The number of columns of a two-dimensional array.
fn columns(
    npz: &Npz,
    name: &str,
    array: &Array,
    accepted: impl Fn(usize) -> bool,
) -> Result<usize, MotionError> {
    match array.shape.as_slice() {
        [_, width] if accepted(*width) => Ok(*width),
        shape => Err(npz.error(
            name,
            &format!("shape {shape:?} is not frames × axis-angle columns of the body"),
        )),
    }
}

/// Forward kinematics of one frame, pelvis at the origin.
fn posed(pose: &[f64; BODY_COLUMNS]) -> WorldFrame {
    let turn = |joint: usize| {
        Rotation3::from_scaled_axis(Vector3::from_row_slice(&pose[3 * joint..3 * joint + 3]))
    };
    let step = |(position, rotation): (Vector3<f64>, Rotation3<f64>), link: &Link| {
        (
            position + rotation * Vector3::from(link.offset),
            rotation * turn(link.joint),
        )
    };
    let root = turn(0);
    let torso = SPINE.iter().fold((Vector3::zeros(), root), step);
    let mut positions = [Vector3::zeros(); KEY_NODES];
    positions[KeyNode::Torso as usize] = torso.0;
    let mut wrists = [None; 2];
    for side in Side::BOTH {
        let [collar, links @ ..] = &ARMS[side as usize];
        let mut joint = step(torso, collar);
        for (node, link) in side.arm().into_iter().zip(links) {
            joint = step(joint, link);
            positions[node as usize] = joint.0;
        }
        wrists[side as usize] = Some(joint.1 * hand_at_rest(side));
    }
    WorldFrame {
        positions,
        left: root * Vector3::x(),
        wrists,
    }
}

/// The hand in the wrist joint's frame: the rest pose is a T with palms down, so fingers point outward, thumbs forward.
fn hand_at_rest(side: Side) -> Rotation3<f64> {
    let outward = if side == Side::Left { 1.0 } else { -1.0 };
    Rotation3::from_matrix_unchecked(Matrix3::from_diagonal(&Vector3::new(outward, outward, 1.0)))
}
