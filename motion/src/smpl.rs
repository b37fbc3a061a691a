//! The SMPL family in `.npz` files: axis-angle vectors or rotation matrices of a root and 21 body joints.
//!
//! AMASS, SMPL-H, SMPL-X and their relatives call the arrays differently and shape them differently; all of that is read.
//! Joints are posed on the neutral body's rest offsets whatever the file's `betas` say: bone directions do not depend on
//! them. The wrist's orientation is that of the wrist joint. AMASS's world has z up, others y up or down: the body tells.

use std::path::Path;

use nalgebra::{Matrix3, Rotation3, Vector3};

use crate::hands::HandAxes;
use crate::npz::{Array, Npz};
use crate::orientation::{Leg, Probe, bounds};
use crate::source::{self, Heading, Rate, Take, node_joint};
use crate::understanding::{NodeJoint, Reading};
use crate::world_frame::WorldFrame;
use crate::{KEY_NODES, KeyNode, MotionError, ReadOptions, Side, UpAxis};

/// The root and 21 body joints.
const JOINTS: usize = 22;
/// Names of an array with the root and the body, and more joints behind them.
const WHOLE: &[&str] = &[
    "poses",
    "pose",
    "smpl_poses",
    "full_pose",
    "fullpose",
    "thetas",
];
/// Names of the root's array, and of the body's beside it.
const ROOT: &[&str] = &["root_orient", "global_orient", "smpl_root_orient", "orient"];
const BODY: &[&str] = &["pose_body", "body_pose", "smpl_body_pose"];
/// Names of the root's position.
const TRANSLATION: &[&str] = &["trans", "transl", "smpl_trans", "translation", "root_trans"];
/// Names of the frame rate.
const RATE: &[&str] = &[
    "mocap_framerate",
    "mocap_frame_rate",
    "fps",
    "frame_rate",
    "framerate",
    "mocap_fps",
    "frequency",
];
/// Largest deviation of `RᵀR` from the identity in a rotation matrix.
const ROTATION_TOLERANCE: f64 = 0.02;

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

/// Hip, knee, ankle and toes of each side, about.
const LEGS: [[Link; 4]; 2] = [
    [
        Link {
            joint: 1,
            offset: [0.059, -0.082, -0.018],
        },
        Link {
            joint: 4,
            offset: [0.043, -0.386, 0.008],
        },
        Link {
            joint: 7,
            offset: [-0.015, -0.427, -0.037],
        },
        Link {
            joint: 10,
            offset: [0.041, -0.060, 0.122],
        },
    ],
    [
        Link {
            joint: 2,
            offset: [-0.060, -0.091, -0.014],
        },
        Link {
            joint: 5,
            offset: [-0.043, -0.384, -0.005],
        },
        Link {
            joint: 8,
            offset: [0.019, -0.420, -0.035],
        },
        Link {
            joint: 11,
            offset: [-0.035, -0.062, 0.130],
        },
    ],
];

/// Neck and head, and the head's top, about.
const HEAD: [Link; 3] = [
    Link {
        joint: 12,
        offset: [-0.003, 0.214, -0.043],
    },
    Link {
        joint: 15,
        offset: [0.005, 0.089, 0.050],
    },
    Link {
        joint: 15,
        offset: [0.0, 0.18, 0.0],
    },
];

/// Reads a file of the SMPL family.
///
/// # Errors
/// [`MotionError`] naming the array that is missing or wrong, or the frame.
pub fn read(path: &Path, options: &ReadOptions) -> Result<Reading, MotionError> {
    from_bytes(path, &source::read_file(path)?, options)
}

/// Reads such a file's content; `path` names the clip and the errors.
///
/// # Errors
/// As [`read`].
pub fn from_bytes(
    path: &Path,
    bytes: &[u8],
    options: &ReadOptions,
) -> Result<Reading, MotionError> {
    from_npz(path, &mut Npz::open(path, bytes)?, options)
}

/// Whether an archive has the arrays of such a file.
pub(crate) fn recognises(npz: &Npz) -> bool {
    npz.first(WHOLE).is_some() || npz.first(ROOT).is_some()
}

pub(crate) fn from_npz(
    path: &Path,
    npz: &mut Npz,
    options: &ReadOptions,
) -> Result<Reading, MotionError> {
    let mut warnings = Vec::new();
    let fps = frame_rate(path, npz, options, &mut warnings)?;
    let poses = Poses::read(npz)?;
    source::check_size(path, fps, poses.frames())?;
    let places = translations(npz, poses.frames())?;
    let place = |i: usize| {
        places
            .as_ref()
            .map_or_else(Vector3::zeros, |places| places[i])
    };
    if !options.map.is_empty() {
        warnings.push("--map has no effect: the format's joints have no names".to_owned());
    }
    let posed = |i: usize| Ok(Posed::new(&poses.pose(npz, i)?, place(i)));
    let frames = (0..poses.frames()).map(|i| Ok(posed(i)?.frame()));
    let probes = source::probed(poses.frames()).map(|i| Ok(posed(i)?.probe()));
    let take = Take {
        format: "SMPL",
        naming: "SMPL".to_owned(),
        fps,
        frames: frames.collect::<Result<_, MotionError>>()?,
        probes: probes.collect::<Result<_, MotionError>>()?,
        rest: None,
        heading: Heading::Steady,
        joints: joint_names(),
        unit: Some(1.0),
        up: Some(UpAxis::Z),
        hands: Side::BOTH.map(|side| HandAxes::Fixed(hand_at_rest(side))),
        thumbs: None,
        warnings,
    };
    source::finish(path, take, options)
}

fn frame_rate(
    path: &Path,
    npz: &mut Npz,
    options: &ReadOptions,
    warnings: &mut Vec<String>,
) -> Result<f64, MotionError> {
    let rate = match (options.fps, npz.first(RATE)) {
        (Some(fps), _) => Rate::given(fps),
        (None, Some(name)) => Rate::found(npz.scalar(name)?),
        (None, None) => Err(format!(
            "no frame rate: expected one of the arrays {}; --fps gives it",
            RATE.join(", ")
        )),
    };
    let rate = rate.map_err(|reason| MotionError::format(path, reason))?;
    warnings.extend(rate.warning);
    Ok(rate.fps)
}

/// The rotations of the root and of each body joint, in one array or two.
struct Poses {
    root: Option<Rotations>,
    /// The body behind its root, or the root and the body.
    body: Rotations,
}

impl Poses {
    fn read(npz: &mut Npz) -> Result<Self, MotionError> {
        if let (Some(root), Some(body)) = (npz.first(ROOT), npz.first(BODY)) {
            let root = Rotations::read(npz, root, 1)?;
            let body = Rotations::read(npz, body, JOINTS - 1)?;
            let (frames, of_root) = (body.frames(), root.frames());
            if of_root != frames {
                let reason = format!("{frames} frames, but {} has {of_root}", root.name);
                return Err(npz.error(body.name, &reason));
            }
            return Ok(Self {
                root: Some(root),
                body,
            });
        }
        let Some(whole) = npz.first(WHOLE) else {
            let missing = npz.first(ROOT).map_or(ROOT[0], |_| BODY[0]);
            return Err(npz.error(missing, &format!("there is none, only {}", npz.names())));
        };
        let body = Rotations::read(npz, whole, JOINTS)?;
        Ok(Self { root: None, body })
    }

    fn frames(&self) -> usize {
        self.body.frames()
    }

    fn pose(&self, npz: &Npz, frame: usize) -> Result<[Rotation3<f64>; JOINTS], MotionError> {
        let mut pose = [Rotation3::identity(); JOINTS];
        for (joint, rotation) in pose.iter_mut().enumerate() {
            let (array, index) = match &self.root {
                Some(root) if joint == 0 => (root, 0),
                Some(_) => (&self.body, joint - 1),
                None => (&self.body, joint),
            };
            *rotation = array.get(frame, index).ok_or_else(|| {
                let reason = format!("frame {frame}: joint {joint} is no rotation");
                npz.error(array.name, &reason)
            })?;
        }
        Ok(pose)
    }
}

/// An array of rotations, frame by frame and joint by joint.
struct Rotations {
    name: &'static str,
    values: Vec<f64>,
    /// Numbers a frame.
    stride: usize,
    /// 3 for axis-angle vectors, 9 for matrices by rows.
    width: usize,
}

impl Rotations {
    /// Reads an array of at least `joints` joints (exactly one, where one is asked for).
    fn read(npz: &mut Npz, name: &'static str, joints: usize) -> Result<Self, MotionError> {
        let Array { shape, values } = npz.array(name)?;
        let enough = |count: usize| {
            if joints == 1 {
                count == 1
            } else {
                count >= joints
            }
        };
        let width = match *shape.as_slice() {
            [_, columns] if columns % 3 == 0 && enough(columns / 3) => 3,
            [_, 3, 3] if joints == 1 => 9,
            [_, count, 3] if enough(count) => 3,
            [_, count, 3, 3] if enough(count) => 9,
            _ => {
                return Err(npz.error(
                    name,
                    &format!(
                        "shape {shape:?} is not frames × axis-angle vectors (or matrices) of {joints} joints"
                    ),
                ));
            }
        };
        let stride = shape[1..].iter().product();
        Ok(Self {
            name,
            values,
            stride,
            width,
        })
    }

    fn frames(&self) -> usize {
        self.values.len() / self.stride
    }

    fn get(&self, frame: usize, joint: usize) -> Option<Rotation3<f64>> {
        let start = frame * self.stride + joint * self.width;
        let values = &self.values[start..start + self.width];
        if self.width == 3 {
            return Some(Rotation3::from_scaled_axis(Vector3::from_row_slice(values)));
        }
        let matrix = Matrix3::from_row_slice(values);
        let error = (matrix.transpose() * matrix - Matrix3::identity()).amax();
        (error < ROTATION_TOLERANCE && matrix.determinant() > 0.0)
            .then(|| Rotation3::from_matrix_unchecked(matrix))
    }
}

fn translations(npz: &mut Npz, frames: usize) -> Result<Option<Vec<Vector3<f64>>>, MotionError> {
    let Some(name) = npz.first(TRANSLATION) else {
        return Ok(None);
    };
    let array = npz.array(name)?;
    let finite = array.values.iter().all(|value| value.is_finite());
    if !(array.values.len() == 3 * frames && finite) {
        let reason = format!(
            "expected {frames} × 3 finite numbers, found shape {:?}",
            array.shape
        );
        return Err(npz.error(name, &reason));
    }
    Ok(Some(
        array
            .values
            .as_chunks::<3>()
            .0
            .iter()
            .map(|v| Vector3::from(*v))
            .collect(),
    ))
}

/// Forward kinematics of one frame.
struct Posed {
    root: Rotation3<f64>,
    positions: [Vector3<f64>; KEY_NODES],
    wrists: [Rotation3<f64>; 2],
    legs: [[Vector3<f64>; 4]; 2],
    head: Vector3<f64>,
}

impl Posed {
    fn new(pose: &[Rotation3<f64>; JOINTS], place: Vector3<f64>) -> Self {
        let step = |(position, rotation): (Vector3<f64>, Rotation3<f64>), link: &Link| {
            (
                position + rotation * Vector3::from(link.offset),
                rotation * pose[link.joint],
            )
        };
        let root = (place, pose[0]);
        let torso = SPINE.iter().fold(root, step);
        let mut positions = [place; KEY_NODES];
        positions[KeyNode::Torso as usize] = torso.0;
        let mut wrists = [pose[0]; 2];
        for side in Side::BOTH {
            let [collar, links @ ..] = &ARMS[side as usize];
            let mut joint = step(torso, collar);
            for (node, link) in side.arm().into_iter().zip(links) {
                joint = step(joint, link);
                positions[node as usize] = joint.0;
            }
            wrists[side as usize] = joint.1;
        }
        let leg = |links: &[Link; 4]| {
            let mut joint = root;
            links.each_ref().map(|link| {
                joint = step(joint, link);
                joint.0
            })
        };
        Self {
            root: pose[0],
            positions,
            wrists,
            legs: LEGS.each_ref().map(leg),
            head: HEAD.iter().fold(torso, step).0,
        }
    }

    fn frame(&self) -> WorldFrame {
        WorldFrame {
            positions: self.positions,
            left: self.root * Vector3::x(),
            wrists: self.wrists.map(Some),
        }
    }

    fn probe(&self) -> Probe {
        let legs = self.legs.into_iter().flatten();
        let points = || {
            legs.clone()
                .chain([self.head, self.positions[KeyNode::Waist as usize]])
        };
        Probe {
            positions: self.positions,
            left: self.root * Vector3::x(),
            legs: Some(self.legs.map(|[hip, knee, ankle, toe]| Leg {
                hip,
                knee,
                ankle,
                toe: Some(toe),
            })),
            bounds: bounds(points().chain(self.positions)).unwrap_or_default(),
            height_bounds: bounds(points()),
        }
    }
}

fn joint_names() -> Vec<NodeJoint> {
    let names = [
        "pelvis",
        "spine3",
        "left_shoulder",
        "right_shoulder",
        "left_elbow",
        "right_elbow",
        "left_wrist",
        "right_wrist",
    ];
    KeyNode::ALL
        .into_iter()
        .zip(names)
        .map(|(node, name)| node_joint(node, name))
        .collect()
}

/// The hand in the wrist joint's frame: the rest pose is a T with palms down, so fingers point outward, thumbs forward.
fn hand_at_rest(side: Side) -> Rotation3<f64> {
    let outward = if side == Side::Left { 1.0 } else { -1.0 };
    Rotation3::from_matrix_unchecked(Matrix3::from_diagonal(&Vector3::new(outward, outward, 1.0)))
}
