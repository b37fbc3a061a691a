//! Human motion: recordings and procedural skills as sequences of eight upper-body key nodes.
//!
//! Reads BVH, AMASS `.npz` and key-node `.npz` files, generates skills from a seed, writes key-node `.npz` and robot joint
//! CSV. Every pose that leaves this crate is finite, in metres, gravity-aligned, without heading, at the waist.
//!
//! This crate knows no robot, no network and no wire format, and it links neither MuJoCo nor candle. A broken or hostile
//! file is an error that names the file and the place; it never panics, never hangs and never takes memory that the
//! file's own size does not justify.

#![forbid(unsafe_code)]

pub mod amass;
pub mod atomic;
pub mod bvh;
mod clip;
mod error;
mod frame;
pub mod joint_csv;
pub mod key_nodes;
mod minimum_jerk;
mod npz;
mod resample;
pub mod skills;
mod source;

use std::path::{Path, PathBuf};

pub use bvh::{BvhOptions, UpAxis};
pub use clip::Clip;
pub use error::{FrameError, MotionError};
pub use frame::{BoneLengths, KEY_NODES, KeyNode, KeyNodeFrame, Side};
pub use minimum_jerk::{MINIMUM_JERK_PEAK, minimum_jerk};

/// How deep a folder of motions may be nested.
const MAX_FOLDER_DEPTH: usize = 32;

/// Reads a motion file: `.bvh` with everything detected, `.npz` by the arrays it holds.
///
/// # Errors
/// [`MotionError`] naming the file, the place and the reason.
pub fn load(path: &Path) -> Result<Clip, MotionError> {
    match extension(path).as_deref() {
        Some("bvh") => bvh::read(path, &BvhOptions::default()),
        Some("npz") => load_npz(path, &source::read_file(path)?),
        _ => Err(MotionError::format(path, "expected a .bvh or .npz file")),
    }
}

/// Reads every `.bvh` and `.npz` file in a folder and the folders in it, sorted by path.
///
/// # Errors
/// The first file's that cannot be read; a folder without motions is one too.
pub fn load_dir(dir: &Path) -> Result<Vec<Clip>, MotionError> {
    let mut paths = Vec::new();
    collect(dir, MAX_FOLDER_DEPTH, &mut paths)?;
    if paths.is_empty() {
        return Err(MotionError::format(
            dir,
            "no .bvh or .npz file in this folder",
        ));
    }
    paths.sort();
    paths.iter().map(|path| load(path)).collect()
}

fn load_npz(path: &Path, bytes: &[u8]) -> Result<Clip, MotionError> {
    let mut npz = npz::Npz::open(path, bytes)?;
    if key_nodes::recognises(&npz) {
        key_nodes::from_npz(path, &mut npz)
    } else if amass::recognises(&npz) {
        amass::from_npz(path, &mut npz)
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
        } else if matches!(extension(&path).as_deref(), Some("bvh" | "npz")) {
            paths.push(path);
        }
    }
    Ok(())
}

fn extension(path: &Path) -> Option<String> {
    path.extension()
        .map(|e| e.to_string_lossy().to_ascii_lowercase())
}
