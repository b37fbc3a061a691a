//! What the demo leaves behind.

use std::fs::Permissions;
use std::io::Write;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use anyhow::{Context, Result};
use emp_motion::joint_csv::JointCsvWriter;
use emp_motion::{KEY_NODES, KeyNodeFrame};
use emp_robot::Robot;
use emp_sim::Replay;
use nalgebra::{Matrix3, Rotation3, Vector3};

use crate::measure::Summary;
use crate::motion::Motion;
use crate::picture::{Moment, Sheet, differing};
use crate::stream::Answers;

/// The files, in the order in which they are written.
pub(crate) const FILES: [&str; 3] = ["joints.csv", "summary.json", "contact-sheet.png"];

/// How many moments the contact sheet shows.
const MOMENTS: usize = 8;

/// A robot's key nodes as a pose; `positions` in its pelvis frame, metres.
pub(crate) fn robot_pose(
    positions: &[Vector3<f64>; KEY_NODES],
    wrists: &[Matrix3<f64>; 2],
) -> KeyNodeFrame {
    KeyNodeFrame {
        positions: positions.map(Vector3::cast),
        wrist_rotations: wrists.map(|wrist| Some(Rotation3::from_matrix_unchecked(wrist.cast()))),
    }
}

/// The contact sheet as a PNG file; `errors` are the frames' direction errors in degrees.
pub(crate) fn contact_sheet(
    robot: &Robot,
    motion: &Motion,
    replay: &Replay,
    errors: &[f32],
    summary: &Summary,
) -> Result<Vec<u8>> {
    let moment = |index: usize| {
        let frame = &replay.frames[index];
        let time = motion.time(index);
        Moment {
            time,
            name: motion.part(time).to_owned(),
            direction_error_deg: errors[index],
            human: motion.clip.frames[index].clone(),
            robot: robot_pose(&frame.key_nodes, &frame.wrist_rotations),
            legs: frame
                .legs
                .clone()
                .map(|leg| leg.into_iter().map(Vector3::cast).collect()),
        }
    };
    let moments: Vec<Moment> = differing(&motion.clip.frames, MOMENTS)
        .into_iter()
        .map(moment)
        .collect();
    let [title, subtitle] = summary.titles();
    let sheet = Sheet {
        title: &title,
        subtitle: &subtitle,
        moments: &moments,
    };
    sheet
        .png()
        .with_context(|| format!("cannot draw {}", robot.name()))
}

/// Writes every file under a temporary name and renames it when it is whole.
pub(crate) fn write(
    out: &Path,
    robot: &Robot,
    answers: &Answers,
    summary: &Summary,
    sheet: &[u8],
) -> Result<()> {
    let [joints, json, picture] = FILES.map(|name| out.join(name));
    write_joints(&joints, robot, &answers.targets)?;
    write_whole(&json, summary.json()?.as_bytes())?;
    write_whole(&picture, sheet)
}

fn write_joints(path: &Path, robot: &Robot, targets: &[Vec<f32>]) -> Result<()> {
    let names: Vec<&str> = robot
        .goal_joints()
        .iter()
        .map(|joint| joint.name.as_str())
        .collect();
    let mut csv = JointCsvWriter::create(path, &names)?;
    for (frame, angles) in targets.iter().enumerate() {
        csv.write_row(frame as f64 / robot.control_rate_hz(), angles)?;
    }
    Ok(csv.finish()?)
}

fn write_whole(path: &Path, bytes: &[u8]) -> Result<()> {
    let context = || format!("cannot write {}", path.display());
    let folder = path.parent().with_context(context)?;
    // As any new file: readable for others where the user's mask allows it.
    let everyone = Permissions::from_mode(0o666);
    let mut file = tempfile::Builder::new()
        .permissions(everyone)
        .tempfile_in(folder)
        .with_context(context)?;
    file.write_all(bytes).with_context(context)?;
    file.persist(path).with_context(context)?;
    Ok(())
}
