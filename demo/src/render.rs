//! MuJoCo's own pictures of a run, drawn off screen.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, Result, ensure};
use emp_robot::Robot;
use emp_sim::Reading;
use mujoco_rs::prelude::*;
use mujoco_rs::renderer::MjRenderer;

use crate::control::Run;

/// Folder of the pictures, and the film made of them.
const FOLDER: &str = "frames";
const FILM: &str = "render.mp4";
/// Pictures a second.
const RATE: f64 = 25.0;
/// Size of a picture, pixels.
const SIZE: [u32; 2] = [720, 960];
/// From where the robot is seen: angles in degrees; distance in standing heights of its base, and so is the height of the
/// point that the camera looks at.
const AZIMUTH: f64 = 205.0;
const ELEVATION: f64 = -10.0;
const DISTANCE: f64 = 3.2;
const LOOK_AT: f64 = 1.0;

/// Draws the run into `frames/` in the output folder, and makes a film of it where `ffmpeg` is there. Gives what was written.
///
/// # Errors
/// If there is no EGL device to draw with, or if a picture cannot be written.
pub(crate) fn render(robot: &Robot, run: &Run, out: &Path) -> Result<Vec<&'static str>> {
    let temporary = tempfile::tempdir_in(out)
        .with_context(|| format!("cannot make a folder in {}", out.display()))?;
    draw(robot, run, temporary.path())?;
    let folder = out.join(FOLDER);
    replace(&folder, &temporary.keep())?;
    let mut written = vec![FOLDER];
    if has_ffmpeg() {
        film(&folder, &out.join(FILM))?;
        written.push(FILM);
    }
    Ok(written)
}

/// Where a picture is.
fn picture(folder: &Path, number: usize) -> PathBuf {
    folder.join(format!("{number:05}.png"))
}

fn draw(robot: &Robot, run: &Run, folder: &Path) -> Result<()> {
    let mut model = robot.visual_model()?;
    let global = &mut model.vis_mut().global;
    [global.offwidth, global.offheight] = SIZE.map(|side| side as i32);
    let mut data = MjData::try_new(Box::new(model)).context("cannot make a simulation")?;
    let mut renderer = MjRenderer::builder()
        .width(SIZE[0])
        .height(SIZE[1])
        .camera(camera(robot, data.model()))
        .png_compression(mujoco_rs::renderer::png::Compression::Fast)
        .build(data.model())
        .context("cannot draw off screen: this needs EGL (on Debian: libegl1 and, without a GPU, libgl1-mesa-dri)")?;
    let frames = (run.periods.len() as f64 / robot.control_rate_hz() * RATE).ceil() as usize;
    for number in 0..frames {
        let period = (number as f64 / RATE * robot.control_rate_hz()) as usize;
        let Some(period) = run.periods.get(period) else {
            break;
        };
        place(robot, &period.reading, &mut data);
        renderer.sync_data(&mut data)?;
        renderer.render()?;
        let file = picture(folder, number);
        renderer
            .save_rgb(&file)
            .with_context(|| format!("cannot write {}", file.display()))?;
    }
    Ok(())
}

fn camera(robot: &Robot, model: &MjModel) -> MjvCamera {
    let height = robot.standing_height();
    MjvCamera {
        lookat: [0.0, 0.0, LOOK_AT * height],
        distance: DISTANCE * height,
        azimuth: AZIMUTH,
        elevation: ELEVATION,
        ..MjvCamera::new_free(model)
    }
}

/// Puts the robot where it was measured.
fn place(robot: &Robot, reading: &Reading, data: &mut MjData<Box<MjModel>>) {
    let qpos = data.qpos_mut();
    qpos[..3].copy_from_slice(reading.position.as_slice());
    let [x, y, z, w] = reading.orientation.coords.into();
    qpos[3..7].copy_from_slice(&[w, x, y, z]);
    for (joint, &angle) in robot.joints().zip(&reading.joint_positions) {
        qpos[joint.qpos_address] = f64::from(angle);
    }
    data.forward();
}

/// Puts a finished folder in the place of one from an earlier run.
fn replace(folder: &Path, fresh: &Path) -> Result<()> {
    if folder.exists() {
        std::fs::remove_dir_all(folder)
            .with_context(|| format!("cannot remove {}", folder.display()))?;
    }
    std::fs::rename(fresh, folder).with_context(|| format!("cannot make {}", folder.display()))
}

fn has_ffmpeg() -> bool {
    let mut version = Command::new("ffmpeg");
    version
        .arg("-version")
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null());
    version.status().is_ok_and(|status| status.success())
}

fn film(folder: &Path, file: &Path) -> Result<()> {
    let unfinished = folder.join("film.mp4");
    let output = Command::new("ffmpeg")
        .args([
            "-loglevel",
            "error",
            "-y",
            "-framerate",
            &RATE.to_string(),
            "-i",
        ])
        .arg(folder.join("%05d.png"))
        .args(["-pix_fmt", "yuv420p"])
        .arg(&unfinished)
        .stdin(Stdio::null())
        .output()
        .context("cannot start ffmpeg")?;
    ensure!(
        output.status.success(),
        "ffmpeg made no film: {}",
        String::from_utf8_lossy(&output.stderr).trim_end()
    );
    std::fs::rename(&unfinished, file).with_context(|| format!("cannot write {}", file.display()))
}
