//! Whole clips at once, for training and evaluation: the answers of a stream, faster.

use emp_motion::Clip;
use rayon::prelude::*;

use super::{Retargeter, Smoother, Solver, Target};
use crate::ModelError;

/// Frames that the network answers at once.
const BATCH: usize = 256;

/// Goal angles frame by frame: rows of one angle for each goal joint, rad, inside the joints' limits.
pub type GoalRows = Vec<Vec<f32>>;

/// Retargets clips of any frame rate to goal angles at the robot's control rate, clip by clip in order.
///
/// Each clip is answered as a live stream with refinement and smoothing is: [`Solver::begin`], [`Solver::follow`] and
/// [`Smoother`]. Clips are dealt to `threads` threads (at least one); a clip's answer depends on that clip alone.
///
/// # Errors
/// [`ModelError::Clip`] for the first clip that has a frame which is no pose; when the tensor library fails.
pub fn retarget_clips(
    retargeter: &Retargeter,
    clips: &[Clip],
    threads: usize,
) -> Result<Vec<GoalRows>, ModelError> {
    for clip in clips {
        check(clip)?;
    }
    let threads = rayon::ThreadPoolBuilder::new().num_threads(threads.max(1));
    let threads = threads.build().map_err(candle_core::Error::wrap)?;
    threads.install(|| {
        // Clips differ in length: each thread takes one at a time.
        let clips = clips.par_iter().with_max_len(1);
        clips.map(|clip| retarget_clip(retargeter, clip)).collect()
    })
}

/// The network's own answers to a clip of any frame rate, at the robot's control rate: what a live stream without refinement
/// and smoothing gives, jumps between codes included. A retargeter without a network refines always.
///
/// # Errors
/// [`ModelError::Clip`] for a frame that is no pose; when the tensor library fails.
pub fn predict_clip(retargeter: &Retargeter, clip: &Clip) -> Result<GoalRows, ModelError> {
    check(clip)?;
    if !retargeter.has_network() {
        return follow_clip(retargeter, clip);
    }
    let clip = clip.resampled(retargeter.robot().control_rate_hz())?;
    let joints = retargeter.robot().goal_joints().len();
    let mut rows = GoalRows::with_capacity(clip.frames.len());
    for frames in clip.frames.chunks(BATCH) {
        let targets: Vec<Target> = frames.iter().map(Target::new).collect();
        let (answers, _) = retargeter.predict(&targets)?;
        rows.extend(answers.chunks(joints).map(<[f32]>::to_vec));
    }
    Ok(rows)
}

fn check(clip: &Clip) -> Result<(), ModelError> {
    clip.validate().map_err(|(frame, reason)| ModelError::Clip {
        clip: clip.name.clone(),
        frame,
        reason: reason.to_string(),
    })
}

fn retarget_clip(retargeter: &Retargeter, clip: &Clip) -> Result<GoalRows, ModelError> {
    let mut rows = follow_clip(retargeter, clip)?;
    let mut smoother = Smoother::new();
    for row in &mut rows {
        smoother.step(row);
    }
    Ok(rows)
}

/// The refined stream before smoothing.
fn follow_clip(retargeter: &Retargeter, clip: &Clip) -> Result<GoalRows, ModelError> {
    let robot = retargeter.robot();
    let clip = clip.resampled(robot.control_rate_hz())?;
    let period = 1.0 / robot.control_rate_hz();
    let mut solver = Solver::new(robot);
    let mut memory = None;
    let mut rows = GoalRows::with_capacity(clip.frames.len());
    for frame in &clip.frames {
        let target = Target::new(frame);
        let next = match memory.take() {
            Some(memory) => solver.follow(&target, memory, period),
            None => solver.begin(&target, &retargeter.starts(&target)?),
        };
        rows.push(next.angles());
        memory = Some(next);
    }
    Ok(rows)
}
