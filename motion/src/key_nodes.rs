//! Key-node `.npz` files: our own, and those computed from optical markers on a seated person's trunk and arms.
//!
//! Both have `fps`, `nodes` (names), `pos[T, N, 3]` (metres, x forward, y left, z up) and `wrist_R[T, 2, 3, 3]` (left,
//! right; NaN where unknown). A file that has a `waist` is taken as it is: this is what [`write()`] leaves. A marker file
//! has `sternum` and `clav_mid` instead; its trunk is rebuilt at the body's own scale.

use std::path::Path;

use nalgebra::{Matrix3, Rotation3, Vector3};

use crate::npz::{Npz, NpzWriter};
use crate::source::{self, Heading, Rate, node_joint};
use crate::understanding::{Reading, Understanding};
use crate::world_frame::WorldFrame;
use crate::{Clip, KEY_NODES, KeyNode, KeyNodeFrame, MotionError, ReadOptions, Side};

/// Height of the shoulder line over the waist as a share of the arm's length (neutral SMPL body: 0.45 m over 0.51 m).
const TRUNK_PER_ARM: f64 = 0.88;
/// Height of the torso node over the waist as a share of the arm's length (neutral SMPL body: 0.30 m over 0.51 m).
const TORSO_PER_ARM: f64 = 0.58;
/// Largest deviation of `RᵀR` from the identity that is taken for rounding and removed.
const ROTATION_TOLERANCE: f64 = 0.02;

/// Names that files give to a node, the written one first.
const NODE_NAMES: [(KeyNode, &[&str]); KEY_NODES] = [
    (KeyNode::Waist, &["waist"]),
    (KeyNode::Torso, &["torso"]),
    (KeyNode::LeftShoulder, &["left_shoulder", "L_shoulder"]),
    (KeyNode::RightShoulder, &["right_shoulder", "R_shoulder"]),
    (KeyNode::LeftElbow, &["left_elbow", "L_elbow"]),
    (KeyNode::RightElbow, &["right_elbow", "R_elbow"]),
    (KeyNode::LeftWrist, &["left_wrist", "L_wrist"]),
    (KeyNode::RightWrist, &["right_wrist", "R_wrist"]),
];

/// Reads a key-node file.
///
/// # Errors
/// [`MotionError`] naming the array that is missing or wrong, or the frame.
pub fn read(path: &Path, options: &ReadOptions) -> Result<Reading, MotionError> {
    from_bytes(path, &source::read_file(path)?, options)
}

/// Reads a key-node file's content; `path` names the clip and the errors.
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

/// Writes a clip; the file appears whole or not at all.
///
/// # Errors
/// [`MotionError::Io`] where the folder cannot be written.
pub fn write(path: &Path, clip: &Clip) -> Result<(), MotionError> {
    let io = |error| MotionError::io(path, error);
    let file = crate::atomic::AtomicFile::create(path).map_err(io)?;
    // An archive is not written from its start to its end: a pipe gets it when it is whole.
    let mut archive = std::io::Cursor::new(Vec::new());
    write_to(&mut archive, clip).map_err(io)?;
    let mut handle = file.handle().map_err(io)?;
    std::io::Write::write_all(&mut handle, archive.get_ref()).map_err(io)?;
    file.finish().map_err(io)
}

fn write_to<W: std::io::Write + std::io::Seek>(file: W, clip: &Clip) -> std::io::Result<W> {
    let frames = clip.frames.len();
    let positions: Vec<f32> = clip
        .frames
        .iter()
        .flat_map(|f| &f.positions)
        .flat_map(|p| [p.x, p.y, p.z])
        .collect();
    let unknown = Matrix3::from_element(f32::NAN);
    let matrices = clip.frames.iter().flat_map(|f| &f.wrist_rotations);
    // Row-major: the transpose of nalgebra's column-major storage.
    let rotations: Vec<f32> = matrices
        .flat_map(|r| {
            let rows = r.as_ref().map_or(unknown, |r| r.matrix().transpose());
            <[f32; 9]>::try_from(rows.as_slice()).unwrap_or([f32::NAN; 9])
        })
        .collect();
    let mut npz = NpzWriter::new(file);
    npz.scalar_f64("fps", clip.fps)?;
    npz.strings("nodes", &KeyNode::ALL.map(KeyNode::name))?;
    npz.array_f32("pos", &[frames, KEY_NODES, 3], &positions)?;
    npz.array_f32("wrist_R", &[frames, 2, 3, 3], &rotations)?;
    npz.finish()
}

/// Whether an archive has the arrays of a key-node file.
pub(crate) fn recognises(npz: &Npz) -> bool {
    npz.has("nodes") && npz.has("pos")
}

pub(crate) fn from_npz(
    path: &Path,
    npz: &mut Npz,
    options: &ReadOptions,
) -> Result<Reading, MotionError> {
    let rate = match options.fps {
        Some(fps) => Rate::given(fps),
        None => Rate::found(npz.scalar("fps")?),
    };
    let rate = rate.map_err(|reason| MotionError::format(path, reason))?;
    let nodes = Nodes::new(npz)?;
    let wrists = wrist_rotations(npz, nodes.frames)?;
    source::check_size(path, rate.fps, nodes.frames)?;
    let mut warnings: Vec<String> = rate.warning.into_iter().collect();
    let plain = ReadOptions {
        fps: options.fps,
        ..ReadOptions::default()
    };
    if *options != plain {
        warnings.push(
            "--unit, --up, --map and --mirror have no effect: the format leaves none of it open"
                .to_owned(),
        );
    }
    let finished = nodes.columns[KeyNode::Waist as usize].is_some();
    let clip = if finished {
        as_written(path, rate.fps, &nodes, &wrists)?
    } else {
        rebuilt(path, npz, rate.fps, &nodes, wrists)?
    };
    let hand = |side: Side| {
        let known = clip
            .frames
            .iter()
            .any(|f| f.wrist_rotations[side as usize].is_some());
        let text = if known {
            "followed as the file says"
        } else {
            "not followed: the file does not know them"
        };
        text.to_owned()
    };
    let understanding = Understanding {
        format: "key nodes",
        naming: if finished { "key node" } else { "marker" }.to_owned(),
        frames: clip.frames.len(),
        fps: clip.fps,
        unit: None,
        up: None,
        handedness: None,
        height: None,
        joints: KeyNode::ALL
            .into_iter()
            .map(|node| {
                let column = nodes.columns[node as usize];
                node_joint(
                    node,
                    column.map_or("rebuilt", |column| &nodes.names[column]),
                )
            })
            .collect(),
        hands: Side::BOTH.map(hand),
        warnings,
    };
    Ok(Reading {
        clip,
        understanding,
    })
}

/// A marker file's motion on a trunk of the body's own scale.
fn rebuilt(
    path: &Path,
    npz: &Npz,
    fps: f64,
    nodes: &Nodes,
    wrists: Vec<[Option<Rotation3<f64>>; 2]>,
) -> Result<Clip, MotionError> {
    let trunk = Trunk::new(npz, nodes)?;
    let frames: Vec<WorldFrame> = wrists
        .into_iter()
        .enumerate()
        .map(|(frame, wrists)| trunk.world_frame(nodes, frame, wrists))
        .collect();
    source::into_clip(path, fps, &frames, Heading::Exact)
}

/// The `pos` array and which of its columns is which node.
struct Nodes {
    names: Vec<String>,
    values: Vec<f64>,
    frames: usize,
    columns: [Option<usize>; KEY_NODES],
}

impl Nodes {
    fn new(npz: &mut Npz) -> Result<Self, MotionError> {
        let names = npz.strings("nodes")?;
        let pos = npz.array("pos")?;
        let [frames, count, 3] = *pos.shape.as_slice() else {
            return Err(npz.error(
                "pos",
                &format!("expected shape [frames, nodes, 3], found {:?}", pos.shape),
            ));
        };
        if count != names.len() {
            return Err(npz.error(
                "pos",
                &format!("{count} nodes, but nodes names {}", names.len()),
            ));
        }
        let column = |aliases: &[&str]| {
            names
                .iter()
                .position(|name| aliases.contains(&name.as_str()))
        };
        let columns = NODE_NAMES.map(|(_, aliases)| column(aliases));
        let has_waist = columns[KeyNode::Waist as usize].is_some();
        for (node, aliases) in NODE_NAMES {
            let required = has_waist || !matches!(node, KeyNode::Waist | KeyNode::Torso);
            if required && columns[node as usize].is_none() {
                return Err(npz.error(
                    "nodes",
                    &format!(
                        "expected {}, found {}",
                        aliases.join(" or "),
                        names.join(", ")
                    ),
                ));
            }
        }
        if let Some(index) = pos.values.iter().position(|v| !v.is_finite()) {
            let (frame, node) = (index / (3 * count), index / 3 % count);
            return Err(npz.error(
                "pos",
                &format!("frame {frame}: {} is not finite", names[node]),
            ));
        }
        Ok(Self {
            names,
            values: pos.values,
            frames,
            columns,
        })
    }

    fn position(&self, frame: usize, column: usize) -> Vector3<f64> {
        let start = (frame * self.names.len() + column) * 3;
        Vector3::from_row_slice(&self.values[start..start + 3])
    }

    /// A key node's position; zero for one the file does not have.
    fn node(&self, frame: usize, node: KeyNode) -> Vector3<f64> {
        self.columns[node as usize]
            .map_or_else(Vector3::zeros, |column| self.position(frame, column))
    }

    /// Mean length of both arms over the clip, metres.
    fn arm_length(&self) -> f64 {
        let arm = |frame: usize, side: Side| {
            let [shoulder, elbow, wrist] = side.arm().map(|node| self.node(frame, node));
            (elbow - shoulder).norm() + (wrist - elbow).norm()
        };
        let total: f64 = (0..self.frames)
            .map(|f| arm(f, Side::Left) + arm(f, Side::Right))
            .sum();
        total / (2 * self.frames.max(1)) as f64
    }
}

/// Left and right orientation of every frame; `None` where the matrix is NaN throughout or the file has none.
fn wrist_rotations(
    npz: &mut Npz,
    frames: usize,
) -> Result<Vec<[Option<Rotation3<f64>>; 2]>, MotionError> {
    if !npz.has("wrist_R") {
        return Ok(vec![[None; 2]; frames]);
    }
    let array = npz.array("wrist_R")?;
    if array.shape != [frames, 2, 3, 3] {
        return Err(npz.error(
            "wrist_R",
            &format!(
                "expected shape [{frames}, 2, 3, 3], found {:?}",
                array.shape
            ),
        ));
    }
    let rotation = |index: usize| {
        rotation(&array.values[9 * index..9 * index + 9]).ok_or_else(|| {
            let (frame, side) = (index / 2, Side::BOTH[index % 2].name());
            npz.error(
                "wrist_R",
                &format!("frame {frame}: the {side} matrix is not a rotation"),
            )
        })
    };
    (0..frames)
        .map(|frame| Ok([rotation(2 * frame)?, rotation(2 * frame + 1)?]))
        .collect()
}

/// The rotation nearest to a row-major matrix. Outer `None`: no rotation is near; inner: the matrix is all NaN.
#[expect(
    clippy::option_option,
    reason = "wrong and unknown are different answers"
)]
fn rotation(rows: &[f64]) -> Option<Option<Rotation3<f64>>> {
    if rows.iter().all(|v| v.is_nan()) {
        return Some(None);
    }
    let m = Matrix3::from_row_slice(rows);
    let error = (m.transpose() * m - Matrix3::identity()).amax();
    let near = error < ROTATION_TOLERANCE && m.determinant() > 0.0;
    near.then(|| {
        let x = m.column(0).normalize();
        let z = (m.column(2) - x * x.dot(&m.column(2))).normalize();
        Some(Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[
            x,
            z.cross(&x),
            z,
        ])))
    })
}

/// Our own files hold finished frames.
fn as_written(
    path: &Path,
    fps: f64,
    nodes: &Nodes,
    wrists: &[[Option<Rotation3<f64>>; 2]],
) -> Result<Clip, MotionError> {
    let frame = |(index, wrists): (usize, &[Option<Rotation3<f64>>; 2])| {
        let waist = nodes.node(index, KeyNode::Waist);
        KeyNodeFrame {
            positions: KeyNode::ALL.map(|node| (nodes.node(index, node) - waist).cast::<f32>()),
            wrist_rotations: wrists.map(|r| r.map(Rotation3::cast::<f32>)),
        }
    };
    let frames = wrists.iter().enumerate().map(frame).collect();
    source::validated(
        path,
        Clip {
            name: source::name_of(path),
            fps,
            frames,
        },
    )
}

/// The trunk of a marker file. Its person sits: the waist rests below the chest's mean position, and the trunk leans from
/// there to where the chest is.
struct Trunk {
    sternum: usize,
    clavicles: usize,
    /// Where the waist rests.
    seat: Vector3<f64>,
    /// From the waist to the chest point (midway between sternum and clavicles), metres.
    chest_height: f64,
    /// From the waist to the torso node, metres.
    torso_height: f64,
}

impl Trunk {
    fn new(npz: &Npz, nodes: &Nodes) -> Result<Self, MotionError> {
        let column = |name: &str| {
            nodes.names.iter().position(|n| n == name).ok_or_else(|| {
                npz.error(
                    "nodes",
                    &format!(
                        "expected waist, or sternum and clav_mid; found {}",
                        nodes.names.join(", ")
                    ),
                )
            })
        };
        let (sternum, clavicles) = (column("sternum")?, column("clav_mid")?);
        let chest = |f: usize| (nodes.position(f, sternum) + nodes.position(f, clavicles)) * 0.5;
        let shoulders = |f: usize| {
            (nodes.node(f, KeyNode::LeftShoulder) + nodes.node(f, KeyNode::RightShoulder)) * 0.5
        };
        let count = nodes.frames.max(1) as f64;
        let mean_chest = (0..nodes.frames).map(chest).sum::<Vector3<f64>>() / count;
        let mean_shoulders = (0..nodes.frames).map(shoulders).sum::<Vector3<f64>>() / count;
        let arm = nodes.arm_length();
        let chest_height = TRUNK_PER_ARM * arm + mean_chest.z - mean_shoulders.z;
        let seat = mean_chest - Vector3::z() * chest_height;
        Ok(Self {
            sternum,
            clavicles,
            seat,
            chest_height,
            torso_height: TORSO_PER_ARM * arm,
        })
    }

    fn world_frame(
        &self,
        nodes: &Nodes,
        frame: usize,
        wrists: [Option<Rotation3<f64>>; 2],
    ) -> WorldFrame {
        let chest =
            (nodes.position(frame, self.sternum) + nodes.position(frame, self.clavicles)) * 0.5;
        let axis = (chest - self.seat)
            .try_normalize(1e-6)
            .unwrap_or_else(Vector3::z);
        let waist = chest - axis * self.chest_height;
        let mut positions = KeyNode::ALL.map(|node| nodes.node(frame, node));
        positions[KeyNode::Waist as usize] = waist;
        positions[KeyNode::Torso as usize] = waist + axis * self.torso_height;
        let left =
            positions[KeyNode::LeftShoulder as usize] - positions[KeyNode::RightShoulder as usize];
        WorldFrame {
            positions,
            left,
            wrists,
        }
    }
}
