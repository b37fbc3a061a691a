//! Checkpoints: `.safetensors` files whose metadata says for which robot they were trained, and how.

use std::{
    collections::{BTreeMap, HashMap},
    path::Path,
};

use candle_core::{DType, Device, Tensor};
use emp_motion::atomic;
use emp_robot::{Joint, Robot};
use safetensors::SafeTensors;
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

use crate::ModelError;

/// Version of the metadata's layout.
const FORMAT: u32 = 1;

/// The key under which [`CheckpointMetadata`] stands in the file's header, as JSON.
const METADATA_KEY: &str = "emp";

/// A checkpoint is refused above this size; the largest that we train is under 100 MB.
const MAX_BYTES: u64 = 1 << 30;

/// What a checkpoint says of itself.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CheckpointMetadata {
    /// Version of this layout.
    pub format: u32,
    /// What the tensors are, for example `retargeter`.
    pub kind: String,
    /// The robot's name.
    pub robot: String,
    /// Names of the joints that the model answers or reads, in order.
    pub joints: Vec<String>,
    /// Lower and upper limit of each joint, radians.
    pub limits: Vec<[f64; 2]>,
    /// Proportional and derivative gain of each joint, N·m/rad and N·m·s/rad.
    pub gains: Vec<[f64; 2]>,
    /// Radians that a policy action of 1 stands for.
    pub action_scale: f64,
    /// Frames of robot state that the model reads; 0 for a model that reads none.
    pub history_length: usize,
    /// The network's sizes.
    pub config: serde_json::Value,
    /// How it was trained: command, seed, steps, data, figures.
    pub training: serde_json::Value,
    /// Git revision of the trainer.
    pub git_revision: String,
    /// SHA-256 of the tensors' names, shapes and bytes in the order of their names; filled in on writing.
    #[serde(default)]
    pub sha256: String,
}

impl CheckpointMetadata {
    /// Metadata of a model of `kind` that answers `robot`'s goal joints.
    pub fn for_goal_joints(kind: &str, robot: &Robot) -> Self {
        Self::for_joints(kind, robot, robot.goal_joints())
    }

    /// Metadata of a model of `kind` that answers `robot`'s goal joints and has no weights: its version stands for the
    /// joints and their limits.
    pub fn without_weights(kind: &str, robot: &Robot) -> Self {
        let mut metadata = Self::for_goal_joints(kind, robot);
        let described = format!(
            "{} {:?} {:?}",
            metadata.robot, metadata.joints, metadata.limits
        );
        metadata.sha256 = hex(&Sha256::digest(described.as_bytes()));
        metadata
    }

    /// Metadata of a model of `kind` that reads or answers these joints of `robot`.
    pub fn for_joints<'a>(
        kind: &str,
        robot: &Robot,
        joints: impl IntoIterator<Item = &'a Joint>,
    ) -> Self {
        let joints: Vec<&Joint> = joints.into_iter().collect();
        Self {
            format: FORMAT,
            kind: kind.to_owned(),
            robot: robot.name().to_owned(),
            joints: joints.iter().map(|joint| joint.name.clone()).collect(),
            limits: joints.iter().map(|joint| joint.range).collect(),
            gains: joints.iter().map(|joint| [joint.kp, joint.kd]).collect(),
            action_scale: robot.action_scale(),
            history_length: 0,
            config: serde_json::Value::Null,
            training: serde_json::Value::Null,
            git_revision: String::new(),
            sha256: String::new(),
        }
    }

    /// The first twelve digits of the hash: what a client names to pin a model's version.
    pub fn version(&self) -> &str {
        self.sha256.get(..12).unwrap_or(&self.sha256)
    }

    /// Checks that the model was trained for the robot of `expected`: kind, name, joints, limits, gains, action scale.
    ///
    /// # Errors
    /// [`ModelError::Mismatch`] with the first field that differs.
    pub fn check(&self, path: &Path, expected: &Self) -> Result<(), ModelError> {
        let robot = &expected.robot;
        let fields = [
            ("kind", self.kind.clone(), expected.kind.clone()),
            ("robot", self.robot.clone(), expected.robot.clone()),
            (
                "joints",
                format!("{:?}", self.joints),
                format!("{:?}", expected.joints),
            ),
            (
                "limits",
                format!("{:?}", self.limits),
                format!("{:?}", expected.limits),
            ),
            (
                "gains",
                format!("{:?}", self.gains),
                format!("{:?}", expected.gains),
            ),
            (
                "action_scale",
                self.action_scale.to_string(),
                expected.action_scale.to_string(),
            ),
        ];
        for (field, found, expected) in fields {
            if found != expected {
                let (path, robot) = (path.to_owned(), robot.clone());
                return Err(ModelError::Mismatch {
                    path,
                    field,
                    robot,
                    found,
                    expected,
                });
            }
        }
        Ok(())
    }
}

/// Tensors by name.
pub type Tensors = BTreeMap<String, Tensor>;

/// Reads a checkpoint; f16 tensors come back as f32.
///
/// # Errors
/// When the file cannot be read, is no safetensors file, has no metadata of ours, or its tensors do not match its hash.
pub fn load(path: &Path) -> Result<(CheckpointMetadata, Tensors), ModelError> {
    decode(&read(path)?, path)
}

/// Reads a checkpoint from the bytes of its file; f16 tensors come back as f32. Errors call the file `origin`.
///
/// # Errors
/// When the bytes are no safetensors file, have no metadata of ours, or the tensors do not match its hash.
pub fn decode(bytes: &[u8], origin: &Path) -> Result<(CheckpointMetadata, Tensors), ModelError> {
    let damaged = |reason: String| ModelError::Checkpoint {
        path: origin.to_owned(),
        reason,
    };
    let file = SafeTensors::deserialize(bytes)
        .map_err(|e| damaged(format!("expected a safetensors file: {e}")))?;
    let (_, header) = SafeTensors::read_metadata(bytes)
        .map_err(|e| damaged(format!("expected a safetensors header: {e}")))?;
    let json = header
        .metadata()
        .as_ref()
        .and_then(|map| map.get(METADATA_KEY));
    let json =
        json.ok_or_else(|| damaged(format!("the header has no metadata entry `{METADATA_KEY}`")))?;
    let metadata: CheckpointMetadata = serde_json::from_str(json)
        .map_err(|e| damaged(format!("metadata entry `{METADATA_KEY}`: {e}")))?;
    if metadata.format != FORMAT {
        return Err(damaged(format!(
            "format {} is not supported, expected {FORMAT}",
            metadata.format
        )));
    }
    let found = hash(&file);
    if found != metadata.sha256 {
        return Err(damaged(format!(
            "the tensors' hash is {found}, the metadata says {}",
            metadata.sha256
        )));
    }
    let mut tensors = Tensors::new();
    for (name, tensor) in candle_core::safetensors::load_buffer(bytes, &Device::Cpu)? {
        let tensor = if tensor.dtype() == DType::F16 {
            tensor.to_dtype(DType::F32)?
        } else {
            tensor
        };
        tensors.insert(name, tensor);
    }
    Ok((metadata, tensors))
}

fn read(path: &Path) -> Result<Vec<u8>, ModelError> {
    let io = |reason| ModelError::Io {
        path: path.to_owned(),
        reason,
    };
    let size = std::fs::metadata(path).map_err(io)?.len();
    if size > MAX_BYTES {
        let reason = format!("{size} bytes; a checkpoint has at most {MAX_BYTES}");
        return Err(ModelError::Checkpoint {
            path: path.to_owned(),
            reason,
        });
    }
    std::fs::read(path).map_err(io)
}

/// Writes a checkpoint under a temporary name, then renames it; returns the metadata with the hash filled in.
///
/// # Errors
/// When the file cannot be written.
pub fn save(
    path: &Path,
    metadata: CheckpointMetadata,
    tensors: &Tensors,
) -> Result<CheckpointMetadata, ModelError> {
    let (metadata, bytes) = encode(metadata, tensors)?;
    atomic::write(path, &bytes).map_err(|reason| ModelError::Io {
        path: path.to_owned(),
        reason,
    })?;
    Ok(metadata)
}

/// The bytes of a checkpoint's file, and its metadata with the hash filled in.
///
/// # Errors
/// When the tensors cannot be written.
pub fn encode(
    mut metadata: CheckpointMetadata,
    tensors: &Tensors,
) -> Result<(CheckpointMetadata, Vec<u8>), ModelError> {
    let unnamed = safetensors::serialize(tensors, None).map_err(candle_core::Error::from)?;
    let file = SafeTensors::deserialize(&unnamed).map_err(candle_core::Error::from)?;
    metadata.sha256 = hash(&file);
    let json = serde_json::to_string(&metadata).map_err(candle_core::Error::wrap)?;
    let header = HashMap::from([(METADATA_KEY.to_owned(), json)]);
    let bytes = safetensors::serialize(tensors, Some(header)).map_err(candle_core::Error::from)?;
    Ok((metadata, bytes))
}

fn hash(file: &SafeTensors<'_>) -> String {
    let mut tensors = file.tensors();
    tensors.sort_by(|a, b| a.0.cmp(&b.0));
    let mut hasher = Sha256::new();
    for (name, tensor) in tensors {
        hasher.update(format!(
            "{name} {:?} {:?}\n",
            tensor.dtype(),
            tensor.shape()
        ));
        hasher.update(tensor.data());
    }
    hex(&hasher.finalize())
}

fn hex(digest: &[u8]) -> String {
    digest.iter().map(|byte| format!("{byte:02x}")).collect()
}
