//! Human motion for jobs: procedural clips, and what the robot's retargeter makes of motion.

use std::sync::Arc;

use emp_models::retarget::Retargeter;
use emp_motion::{Clip, skills};
use emp_proto::v1::ProceduralClips;
use emp_sim::goals::{GoalClip, Source};

use super::job::failed;
use crate::{
    catalog::RetargetModel,
    decode::{fields, rollouts::Budget},
    error::{FieldError, ServiceError},
};

/// Most procedural clips of a job.
const MAX_PROCEDURAL: u32 = 10_000;
/// Clips that a thread retargets between two questions whether to stop.
const BLOCK: usize = 4;

/// Longest procedural clip, seconds.
const LONGEST_PROCEDURAL: f64 = 20.0;

/// Reads how many procedural clips are asked for, and their seed; their frames come out of the budget.
pub(super) fn read_procedural(
    procedural: Option<&ProceduralClips>,
    control_rate: f64,
    budget: &mut Budget,
) -> Result<(usize, u64), FieldError> {
    let ProceduralClips { count, seed } = procedural.copied().unwrap_or_default();
    let count = fields::within("config.procedural.count", count, 0..=MAX_PROCEDURAL)?;
    let longest = (LONGEST_PROCEDURAL * control_rate).ceil() as usize;
    budget.spend("config.procedural.count", count as usize * longest)?;
    Ok((count as usize, seed))
}

/// The network behind a served retargeter.
pub(super) fn network(model: &RetargetModel) -> Result<Arc<Retargeter>, ServiceError> {
    model
        .model
        .clone()
        .ok_or_else(|| ServiceError::JobFailed(format!("{} serves frames only", model.card.name)))
}

/// The procedural clips with this seed. `check` may stop it.
pub(super) fn procedural(
    (count, seed): (usize, u64),
    check: impl Fn() -> Result<(), ServiceError>,
) -> Result<Vec<Clip>, ServiceError> {
    let clips = skills::endless(seed).take(count);
    clips.map(|clip| check().map(|()| clip)).collect()
}

/// Retargets clips in order. `progress` is told how many are done, and may stop it.
pub(super) fn retarget(
    retargeter: &Retargeter,
    clips: &[Clip],
    source: Source,
    threads: usize,
    mut progress: impl FnMut(usize) -> Result<(), ServiceError>,
) -> Result<Vec<GoalClip>, ServiceError> {
    let mut goals = Vec::with_capacity(clips.len());
    for block in clips.chunks(BLOCK * threads) {
        progress(goals.len())?;
        let block = GoalClip::retargeted(retargeter, block, source, threads).map_err(failed)?;
        goals.extend(block);
    }
    Ok(goals)
}
