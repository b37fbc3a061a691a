//! What the demo leaves behind.

use std::path::Path;

use anyhow::{Context, Result};
use emp_motion::atomic;
use emp_motion::joint_csv::JointCsvWriter;
use emp_robot::Robot;

use crate::control::Run;
use crate::measure::Summary;
use crate::motion::Motion;
use crate::picture::{Sheet, StanceSheet, Still, differing};
use crate::posture::Posture;

/// The output folder, and what was written there.
pub(crate) struct Files<'a> {
    folder: &'a Path,
    /// Names of the files, in the order in which they were written.
    pub(crate) written: Vec<&'static str>,
}

/// How many stills the sheets show.
const STILLS: usize = 8;

/// The contact sheet and the stance sheet as PNG files; `errors` are the frames' direction errors in degrees.
pub(crate) fn sheets(
    robot: &Robot,
    motion: &Motion,
    run: &Run,
    postures: &[Posture],
    errors: &[f32],
    summary: &Summary,
) -> Result<[Vec<u8>; 2]> {
    let executed = &motion.clip.frames[..run.periods.len()];
    let fixed: Vec<usize> = most_tilted(postures)
        .into_iter()
        .chain(last_of_fall(run))
        .collect();
    let still = |index: usize| {
        let posture = &postures[index];
        let time = motion.time(index);
        Still {
            time,
            name: motion.part(time).to_owned(),
            direction_error_deg: errors[index],
            human: executed[index].clone(),
            robot: posture.pose.clone(),
            legs: posture.legs.clone(),
            stance: posture.stance.clone(),
        }
    };
    let stills: Vec<Still> = differing(executed, &fixed, STILLS)
        .into_iter()
        .map(still)
        .collect();
    let stances: Vec<_> = postures
        .iter()
        .map(|posture| posture.stance.clone())
        .collect();
    let pushed = run
        .periods
        .iter()
        .enumerate()
        .filter(|(_, period)| period.pushed);
    let pushes: Vec<f64> = pushed.map(|(frame, _)| motion.time(frame)).collect();
    let title = summary.title();
    let contact = Sheet {
        title: &title,
        subtitle: &summary.contact_subtitle(),
        stills: &stills,
    };
    let stance = StanceSheet {
        title: &title,
        subtitle: &summary.stance_subtitle(),
        stills: &stills,
        stances: &stances,
        rate: robot.control_rate_hz(),
        fall: summary.fall_time(),
        pushes: &pushes,
    };
    let context = || format!("cannot draw {}", robot.name());
    Ok([
        contact.png().with_context(context)?,
        stance.png().with_context(context)?,
    ])
}

/// The frame in which the base was tilted most.
fn most_tilted(postures: &[Posture]) -> Option<usize> {
    let tilt = |index: &usize| postures[*index].stance.tilt();
    (0..postures.len()).max_by(|a, b| tilt(a).total_cmp(&tilt(b)))
}

/// The last frame, if the robot fell in it.
fn last_of_fall(run: &Run) -> Option<usize> {
    run.fall.and_then(|_| run.periods.len().checked_sub(1))
}

impl<'a> Files<'a> {
    /// Nothing was written yet.
    pub(crate) fn new(folder: &'a Path) -> Self {
        Self {
            folder,
            written: Vec::new(),
        }
    }

    /// Writes a run as a table: a row a frame with the person's goals, what all motors followed, and what was then measured.
    pub(crate) fn write_joints(
        &mut self,
        name: &'static str,
        robot: &Robot,
        run: &Run,
    ) -> Result<()> {
        let named =
            |what: &'static str| move |joint: &emp_robot::Joint| format!("{what}:{}", joint.name);
        let goals = robot.goal_joints().iter().map(named("goal"));
        let executed = robot.joints().map(named("executed"));
        let measured = robot.joints().map(named("measured"));
        let names: Vec<String> = goals.chain(executed).chain(measured).collect();
        let mut csv = JointCsvWriter::create(&self.folder.join(name), &names)?;
        for (frame, period) in run.periods.iter().enumerate() {
            let row = [
                period.answer.person.as_slice(),
                &period.answer.targets.goal,
                &period.answer.targets.legs,
                &period.reading.joint_positions,
            ];
            csv.write_row(frame as f64 / robot.control_rate_hz(), &row.concat())?;
        }
        csv.finish()?;
        self.written.push(name);
        Ok(())
    }

    /// Writes a file under a temporary name and renames it when it is whole.
    pub(crate) fn write(&mut self, name: &'static str, bytes: &[u8]) -> Result<()> {
        let path = self.folder.join(name);
        let context = || format!("cannot write {}", path.display());
        atomic::write(&path, bytes).with_context(context)?;
        self.written.push(name);
        Ok(())
    }
}
