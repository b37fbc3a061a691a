//! From a comparison to its picture.

use anyhow::{Context, Result};
use emp_robot::Robot;
use nalgebra::{Isometry3, Translation3};

use crate::comparison::{Comparison, ComparisonSummary, JointChange};
use crate::control::{Period, Run};
use crate::episode::tilt;
use crate::picture::{Curve, EmpSheet, JointCurves, OFF, ON, Standing, Strip};
use crate::posture::{Posture, postures};

/// How many stills are shown, and the time between two of them before a fall, seconds.
const STILLS: usize = 6;
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
    let stills = stills(frames, off, rate);
    let runs = std::iter::once(("EMP off", OFF, off)).chain(on.iter().map(|on| ("EMP on", ON, on)));
    let strips = runs
        .zip(summary.outcomes())
        .map(|((name, color, run), outcome)| {
            let figures = figures(robot, run, &stills)?;
            let (tilt, margin) = stance(run, rate);
            Ok(Strip {
                name,
                outcome,
                color,
                figures,
                tilt,
                margin,
                fall: run.fall.map(|_| run.periods.len() as f64 / rate),
            })
        })
        .collect::<Result<Vec<_>>>()?;
    let most_changed = summary.joints().iter().take(JOINTS);
    let joints: Vec<JointCurves> = most_changed
        .zip(on.iter().cycle())
        .map(|(joint, on)| joint_curves(on, joint, rate))
        .collect();
    let runs = std::iter::once(off).chain(on);
    let longest = runs.max_by_key(|run| run.periods.len()).unwrap_or(off);
    let times: Vec<f64> = stills.iter().map(|&frame| motion.time(frame)).collect();
    let person: Vec<_> = stills
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
        seconds: longest.periods.len() as f64 / rate,
        pushes: &pushes(longest, rate),
    };
    picture
        .png()
        .with_context(|| format!("cannot draw {}", robot.name()))
}

/// When the robot was pushed, seconds.
fn pushes(run: &Run, rate: f64) -> Vec<f64> {
    let periods = run.periods.iter().enumerate();
    let pushed = periods.filter(|(_, period)| period.pushed);
    pushed.map(|(frame, _)| frame as f64 / rate).collect()
}

/// Frames to show: the last ones before the fall without the EMP, or else some over the whole motion.
fn stills(frames: usize, off: &Run, rate: f64) -> Vec<usize> {
    let last = off.periods.len().min(frames).saturating_sub(1);
    let before = |number: usize| (STILLS - 1 - number) as f64;
    let frame = |number: usize| match off.fall {
        Some(_) => last.saturating_sub((before(number) * SPACING * rate).round() as usize),
        None => (last as f64 * (number as f64 + 0.5) / STILLS as f64) as usize,
    };
    let mut stills: Vec<usize> = (0..STILLS).map(frame).collect();
    stills.dedup();
    stills
}

/// The robot in each of the frames; in its last one where it had fallen by then.
fn figures(robot: &Robot, run: &Run, frames: &[usize]) -> Result<Vec<Standing>> {
    let postures = postures(robot, run)?;
    let last = run.periods.len() - 1;
    let fall = run
        .fall
        .map(|_| (last + 1) as f64 / robot.control_rate_hz());
    let standing = |&frame: &usize| {
        let shown = frame.min(last);
        let reading = &run.periods[shown].reading;
        let Posture { pose, legs, .. } = &postures[shown];
        let height = Translation3::new(0.0, 0.0, reading.position.z);
        Standing {
            pose: pose.clone(),
            legs: legs.clone(),
            base: Isometry3::from_parts(height, reading.orientation).cast(),
            tilt: tilt(reading).to_degrees() as f32,
            fallen: fall.filter(|_| frame >= last),
        }
    };
    Ok(frames.iter().map(standing).collect())
}

/// Tilt in degrees and margin in cm over time.
fn stance(run: &Run, rate: f64) -> (Curve, Curve) {
    let degrees = |period: &Period| Some(tilt(&period.reading).to_degrees() as f32);
    let centimetres = |period: &Period| Some(100.0 * period.answer.margin?);
    (curve(run, rate, degrees), curve(run, rate, centimetres))
}

fn joint_curves(run: &Run, joint: &JointChange, rate: f64) -> JointCurves {
    let degrees = |goal: &[f32]| Some(goal[joint.index].to_degrees());
    JointCurves {
        name: joint.joint.replace('_', " "),
        asked: curve(run, rate, |period| degrees(&period.answer.goal)),
        executed: curve(run, rate, |period| degrees(&period.answer.targets.goal)),
    }
}

/// A value over time, of each control period that has one, at its end.
fn curve(run: &Run, rate: f64, value: impl Fn(&Period) -> Option<f32>) -> Curve {
    let time = |frame: usize| ((frame + 1) as f64 / rate) as f32;
    let periods = run.periods.iter().enumerate();
    periods
        .filter_map(|(frame, period)| Some((time(frame), value(period)?)))
        .collect()
}
