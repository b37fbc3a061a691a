//! From a comparison to its picture.

use anyhow::{Context, Result};
use emp_robot::Robot;
use nalgebra::{Isometry3, Translation3};

use crate::comparison::{Comparison, ComparisonSummary, JointChange};
use crate::control::{Period, Run};
use crate::episode::tilt;
use crate::picture::{Curve, EmpSheet, JointCurves, OFF, ON, Standing, Strip};
use crate::posture::{Posture, postures};

/// How many moments are shown, and the time between two of them before a fall, seconds.
const MOMENTS: usize = 6;
const SPACING: f64 = 0.4;
/// How many joints are shown.
const JOINTS: usize = 3;

/// The EMP sheet as a PNG file.
pub(crate) fn sheet(
    robot: &Robot,
    comparison: &Comparison,
    summary: &ComparisonSummary,
) -> Result<Vec<u8>> {
    let Comparison {
        motion, off, on, ..
    } = comparison;
    let rate = robot.control_rate_hz();
    let frames = motion.clip.frames.len();
    let moments = moments(frames, off, rate);
    let outcomes = summary.outcomes();
    let runs = std::iter::once(("EMP off", OFF, off)).chain(on.iter().map(|on| ("EMP on", ON, on)));
    let strips = runs
        .zip(outcomes)
        .map(|((name, color, run), outcome)| {
            let postures = postures(robot, run)?;
            Ok(Strip {
                name,
                outcome,
                color,
                figures: moments
                    .iter()
                    .map(|&frame| standing(run, &postures, frame, rate))
                    .collect(),
                tilt: curve(run, rate, |period| {
                    tilt(&period.reading).to_degrees() as f32
                }),
                margin: curve(run, rate, |period| 100.0 * period.answer.margin),
                fall: run.fall.map(|_| run.periods.len() as f64 / rate),
            })
        })
        .collect::<Result<Vec<_>>>()?;
    let joints: Vec<JointCurves> = match on {
        Some(on) => {
            let most = summary.joints().iter().take(JOINTS);
            most.map(|joint| joint_curves(on, joint, rate)).collect()
        }
        None => Vec::new(),
    };
    let longest = on.as_ref().unwrap_or(off);
    let pushed = longest.periods.iter().enumerate();
    let pushes: Vec<f64> = pushed
        .filter(|(_, period)| period.pushed)
        .map(|(frame, _)| motion.time(frame))
        .collect();
    let times: Vec<f64> = moments.iter().map(|&frame| motion.time(frame)).collect();
    let person: Vec<_> = moments
        .iter()
        .map(|&frame| motion.clip.frames[frame].clone())
        .collect();
    let picture = EmpSheet {
        title: &summary.title(),
        subtitles: &[summary.choice(), summary.conditions()],
        times: &times,
        person: &person,
        strips: &strips,
        joints: &joints,
        seconds: motion.time(frames),
        pushes: &pushes,
    };
    picture
        .png()
        .with_context(|| format!("cannot draw {}", robot.name()))
}

/// Frames to show: the last ones before the fall without the EMP, or else some over the whole motion.
fn moments(frames: usize, off: &Run, rate: f64) -> Vec<usize> {
    let last = off.periods.len().min(frames).saturating_sub(1);
    let before = |number: usize| (MOMENTS - 1 - number) as f64;
    let frame = |number: usize| match off.fall {
        Some(_) => last.saturating_sub((before(number) * SPACING * rate).round() as usize),
        None => (last as f64 * (number as f64 + 0.5) / MOMENTS as f64) as usize,
    };
    let mut moments: Vec<usize> = (0..MOMENTS).map(frame).collect();
    moments.dedup();
    moments
}

/// The robot in a frame; in its last one where it had fallen by then.
fn standing(run: &Run, postures: &[Posture], frame: usize, rate: f64) -> Standing {
    let last = run.periods.len() - 1;
    let shown = frame.min(last);
    let reading = &run.periods[shown].reading;
    let Posture { pose, legs, .. } = &postures[shown];
    let height = Translation3::new(0.0, 0.0, reading.position.z);
    Standing {
        pose: pose.clone(),
        legs: legs.clone(),
        base: Isometry3::from_parts(height, reading.orientation).cast(),
        tilt: tilt(reading).to_degrees() as f32,
        fallen: run
            .fall
            .filter(|_| frame >= last)
            .map(|_| (last + 1) as f64 / rate),
    }
}

fn joint_curves(run: &Run, joint: &JointChange, rate: f64) -> JointCurves {
    JointCurves {
        name: joint.joint.replace('_', " "),
        asked: curve(run, rate, |period| {
            period.answer.goal[joint.index].to_degrees()
        }),
        executed: curve(run, rate, |period| {
            period.answer.targets.goal[joint.index].to_degrees()
        }),
    }
}

/// A value over time, of each control period at its end.
fn curve(run: &Run, rate: f64, value: impl Fn(&Period) -> f32) -> Curve {
    let periods = run.periods.iter().enumerate();
    periods
        .map(|(frame, period)| (((frame + 1) as f64 / rate) as f32, value(period)))
        .collect()
}
