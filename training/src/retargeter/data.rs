//! Human frames as training samples.

use std::path::PathBuf;

use anyhow::{Context as _, Result, ensure};
use emp_models::retarget::Target;
use emp_motion::{Clip, skills};
use nalgebra::{Matrix3, Rotation3, Unit, Vector3};
use rand::{Rng, RngExt as _};

use crate::sets::{MotionSet, check_training_seed};

/// The rate at which robots are driven, and motion is sampled, Hz.
pub const RATE: f64 = 50.0;

/// Reads every motion under the given folders (or files) at [`RATE`].
///
/// # Errors
/// When a folder holds no motion or a file is broken; the error names it.
pub fn load_clips(folders: &[PathBuf]) -> Result<Vec<Clip>> {
    let mut clips = Vec::new();
    for folder in folders {
        let found = if folder.is_dir() {
            emp_motion::load_dir(folder)?
        } else {
            vec![emp_motion::load(folder)?]
        };
        ensure!(
            !found.is_empty(),
            "{}: expected motion files (.bvh, .npz), found none",
            folder.display()
        );
        for clip in &found {
            clips.push(clip.resampled(RATE).with_context(|| clip.name.clone())?);
        }
    }
    Ok(clips)
}

/// Frames that a training run draws its batches from.
pub struct Dataset {
    /// Frames of recorded motion; may be empty.
    recorded: Vec<Target>,
    /// Frames of procedural skills.
    procedural: Vec<Target>,
}

impl Dataset {
    /// Recorded `clips` and `procedural` skill clips, all of them also mirrored.
    ///
    /// # Errors
    /// When no procedural clip is asked for: they are always in the mix; when the seed is another set's.
    pub fn new(clips: &[Clip], procedural: usize, seed: u64) -> Result<Self> {
        check_training_seed(seed)?;
        let skills = skills::library(seed, procedural);
        let dataset = Self {
            recorded: targets(clips),
            procedural: targets(&skills),
        };
        ensure!(
            !dataset.procedural.is_empty(),
            "expected at least one procedural clip"
        );
        Ok(dataset)
    }

    /// Number of frames, recorded and procedural.
    pub fn len(&self) -> (usize, usize) {
        (self.recorded.len(), self.procedural.len())
    }

    /// Draws one sample: recorded and procedural frames half and half, half of them varied, wrists forgotten at times.
    pub fn sample(&self, rng: &mut impl Rng) -> Target {
        /// Share of samples whose wrist orientations are hidden, so that the network serves sources without them.
        const FORGET_WRISTS: f64 = 0.25;
        let from_recorded = !self.recorded.is_empty() && rng.random_bool(0.5);
        let frames = if from_recorded {
            &self.recorded
        } else {
            &self.procedural
        };
        let mut target = frames[rng.random_range(0..frames.len())].clone();
        if rng.random_bool(0.5) {
            vary(&mut target, rng);
        }
        if rng.random_bool(FORGET_WRISTS) {
            target.wrists = [None, None];
        }
        target
    }
}

fn targets(clips: &[Clip]) -> Vec<Target> {
    let frames = clips.iter().flat_map(|clip| &clip.frames);
    frames
        .flat_map(|frame| [Target::new(frame), Target::new(&frame.mirrored())])
        .collect()
}

/// Turns trunk and arms together by some yaw, then each bone and hand by a few degrees.
fn vary(target: &mut Target, rng: &mut impl Rng) {
    const YAW: f64 = 0.5;
    const BONE: f64 = 0.15;
    let yaw = Rotation3::from_axis_angle(&Vector3::z_axis(), YAW * symmetric(rng));
    let line = yaw * Vector3::new(target.shoulder_line.x, target.shoulder_line.y, 0.0);
    target.shoulder_line = line.xy();
    for bone in &mut target.bones {
        *bone = small_rotation(BONE, rng) * (yaw * *bone);
    }
    for wrist in target.wrists.iter_mut().flatten() {
        let turned: Matrix3<f64> = yaw.matrix() * *wrist;
        *wrist = small_rotation(BONE, rng).matrix() * turned;
    }
}

/// A number in −1..1, small ones more often.
fn symmetric(rng: &mut impl Rng) -> f64 {
    rng.random_range(-1.0..1.0) * rng.random_range(0.0..1.0)
}

fn small_rotation(angle: f64, rng: &mut impl Rng) -> Rotation3<f64> {
    let axis = Vector3::from_fn(|_, _| rng.random_range(-1.0..1.0));
    match Unit::try_new(axis, 1e-6) {
        Some(axis) => Rotation3::from_axis_angle(&axis, angle * rng.random_range(0.0..1.0)),
        None => Rotation3::identity(),
    }
}

/// Reads clips to train on and names what was read, for a checkpoint's metadata.
///
/// # Errors
/// As [`load_clips`]; when a folder is of another set.
pub fn load_with_summary(folders: &[PathBuf]) -> Result<(Vec<Clip>, serde_json::Value)> {
    MotionSet::Train.check(folders)?;
    let clips = load_clips(folders).context("reading the motions")?;
    let frames: usize = clips.iter().map(|clip| clip.frames.len()).sum();
    let names: Vec<String> = folders
        .iter()
        .map(|folder| crate::run::base_name(folder))
        .collect();
    let summary = serde_json::json!({ "folders": names, "clips": clips.len(), "frames": frames });
    Ok((clips, summary))
}
