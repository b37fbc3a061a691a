//! Human motion: recordings and procedural skills as sequences of eight upper-body key nodes.
//!
//! Reads BVH, the SMPL family (`.npz`), Xsens `.mvnx`, `.c3d` and key-node `.npz` files, generates skills from a seed,
//! writes key-node `.npz` and robot joint CSV. Every pose that leaves this crate is finite, in metres, gravity-aligned,
//! without heading, at the waist; every reading says what its file was taken for ([`Understanding`]).
//!
//! This crate knows no robot, no network and no wire format, and it links neither MuJoCo nor candle. A broken or hostile
//! file is an error that names the file and the place; it never panics, never hangs and never takes memory that the
//! file's own size does not justify.

#![forbid(unsafe_code)]

pub mod arm_motion;
pub mod atomic;
pub mod bvh;
pub mod c3d;
mod clip;
mod error;
mod frame;
mod hands;
pub mod joint_csv;
pub mod key_nodes;
mod minimum_jerk;
pub mod mvnx;
mod names;
mod npz;
mod options;
mod orientation;
mod resample;
pub mod skills;
pub mod smpl;
mod source;
mod text;
mod understanding;
mod world_frame;

use std::path::{Path, PathBuf};

pub use clip::Clip;
pub use error::{FrameError, MotionError, ResampleError};
pub use frame::{BoneLengths, KEY_NODES, KeyNode, KeyNodeFrame, Side};
pub use minimum_jerk::{MINIMUM_JERK_PEAK, minimum_jerk};
pub use options::{BodyJoint, ReadOptions, UpAxis, parse_unit};
pub use understanding::{NodeJoint, Reading, Understanding};

/// How deep a folder of motions may be nested.
const MAX_FOLDER_DEPTH: usize = 32;
/// Endings of motion files.
const EXTENSIONS: [&str; 4] = ["bvh", "c3d", "mvnx", "npz"];

/// Reads a motion file with everything detected: the reading's clip alone.
///
/// # Errors
/// [`MotionError`] naming the file, the place and the reason.
pub fn load(path: &Path) -> Result<Clip, MotionError> {
    read(path, &ReadOptions::default()).map(|reading| reading.clip)
}

/// Reads a motion file: its format by the name's ending, an `.npz`'s by the arrays it holds.
///
/// # Errors
/// [`MotionError`] naming the file, the place and the reason.
pub fn read(path: &Path, options: &ReadOptions) -> Result<Reading, MotionError> {
    match extension(path).as_deref() {
        Some("bvh") => bvh::read(path, options),
        Some("c3d") => c3d::read(path, options),
        Some("mvnx") => mvnx::read(path, options),
        Some("npz") => read_npz(path, &source::read_file(path)?, options),
        _ => Err(MotionError::format(
            path,
            "expected a .bvh, .c3d, .mvnx or .npz file",
        )),
    }
}

/// Reads every motion file in a folder and the folders in it, sorted by path.
///
/// # Errors
/// The first file's that cannot be read; a folder without motions is one too.
pub fn load_dir(dir: &Path) -> Result<Vec<Clip>, MotionError> {
    files(dir)?.iter().map(|path| load(path)).collect()
}

/// The motion files in a folder and the folders in it, sorted by path.
///
/// # Errors
/// A folder that cannot be read, and one without motions.
pub fn files(dir: &Path) -> Result<Vec<PathBuf>, MotionError> {
    let mut paths = Vec::new();
    collect(dir, MAX_FOLDER_DEPTH, &mut paths)?;
    if paths.is_empty() {
        return Err(MotionError::format(
            dir,
            "no .bvh, .c3d, .mvnx or .npz file in this folder",
        ));
    }
    paths.sort();
    Ok(paths)
}

fn read_npz(path: &Path, bytes: &[u8], options: &ReadOptions) -> Result<Reading, MotionError> {
    let mut npz = npz::Npz::open(path, bytes)?;
    if key_nodes::recognises(&npz) {
        key_nodes::from_npz(path, &mut npz, options)
    } else if smpl::recognises(&npz) {
        smpl::from_npz(path, &mut npz, options)
    } else {
        let reason = format!(
            "expected the arrays nodes and pos, poses, or root_orient and pose_body; found {}",
            npz.names()
        );
        Err(MotionError::format(path, reason))
    }
}

fn collect(dir: &Path, depth: usize, paths: &mut Vec<PathBuf>) -> Result<(), MotionError> {
    if depth == 0 {
        return Err(MotionError::format(
            dir,
            format!("folders nested deeper than {MAX_FOLDER_DEPTH}"),
        ));
    }
    let io = |e| MotionError::io(dir, e);
    for entry in std::fs::read_dir(dir).map_err(io)? {
        let path = entry.map_err(io)?.path();
        if path.is_dir() {
            collect(&path, depth - 1, paths)?;
        } else if extension(&path).is_some_and(|e| EXTENSIONS.contains(&e.as_str())) {
            paths.push(path);
        }
    }
    Ok(())
}

fn extension(path: &Path) -> Option<String> {
    path.extension()
        .map(|e| e.to_string_lossy().to_ascii_lowercase())
}
