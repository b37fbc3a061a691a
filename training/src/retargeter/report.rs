//! Measures a trained retargeter against converged inverse kinematics on the same objective.

use std::time::Instant;

use anyhow::{Result, ensure};
use emp_models::retarget::{AT_LIMIT, Effort, RetargetInput, Retargeter, Smoother, Solver, Target};
use emp_motion::Clip;
use emp_robot::Robot;
use emp_sim::SelfCollision;
use serde::Serialize;

use super::trainer::perplexity;

/// A frame-to-frame change of a joint above this is a jump, radians.
const JUMP: f64 = 0.25;

/// What was measured of one way to retarget.
#[derive(Debug, Serialize)]
pub struct Row {
    /// Which way.
    pub method: String,
    /// Upper-arm direction error, degrees.
    pub upper_arm_deg: Spread,
    /// Forearm direction error, degrees.
    pub forearm_deg: Spread,
    /// Both together, degrees.
    pub direction_deg: Spread,
    /// Wrist rotation error where the source has wrists, degrees; absent where no source has.
    pub wrist_deg: Option<Spread>,
    /// Share of frames with any joint within 0.01 rad of a limit.
    pub limit_share: f64,
    /// Largest change of a joint from one frame to the next, radians.
    pub largest_jump_rad: f64,
    /// Frames with a change above 0.25 rad.
    pub jumps: usize,
    /// Those of them where the reference has no such change within two frames.
    pub jumps_not_in_reference: usize,
    /// Mean norm of the third difference of the joint angles, rad/s³.
    pub jerk: f64,
    /// The same over the reference's.
    pub jerk_ratio: f64,
    /// Share of frames in which collision pairs touch.
    pub self_collision_share: f64,
    /// Frames a second on one core, one frame at a time.
    pub frames_per_second: f64,
}

/// Mean and 95th percentile.
#[derive(Debug, Serialize)]
pub struct Spread {
    /// Mean.
    pub mean: f64,
    /// 95th percentile.
    pub p95: f64,
}

impl Spread {
    fn of(mut values: Vec<f64>) -> Option<Self> {
        values.sort_by(f64::total_cmp);
        let p95 = *values.get(values.len().saturating_sub(1) * 95 / 100)?;
        Some(Self {
            mean: values.iter().sum::<f64>() / values.len() as f64,
            p95,
        })
    }
}

/// A report on one robot and a set of clips.
#[derive(Debug, Serialize)]
pub struct Report {
    /// The robot's name.
    pub robot: String,
    /// The weights' version.
    pub model: String,
    /// Number of clips.
    pub clips: usize,
    /// Number of frames at 50 Hz.
    pub frames: usize,
    /// Share of frames with at least one wrist orientation.
    pub wrist_share: f64,
    /// Perplexity of the codes over all frames and joints.
    pub codebook_perplexity: f64,
    /// Codes in use, of all.
    pub codes_used: [usize; 2],
    /// One row a method, the reference first.
    pub rows: Vec<Row>,
}

/// Joint angles of one clip, a row a frame.
type Track = Vec<Vec<f64>>;

/// One way to retarget a clip.
struct Method {
    name: &'static str,
    run: fn(&Retargeter, &Clip) -> Result<Track>,
}

const METHODS: [Method; 4] = [
    Method {
        name: "converged IK",
        run: converged,
    },
    Method {
        name: "network",
        run: |retargeter, clip| answers(retargeter, clip, false, false),
    },
    Method {
        name: "network + refine",
        run: |retargeter, clip| answers(retargeter, clip, true, false),
    },
    Method {
        name: "network + refine + smoothing",
        run: |retargeter, clip| answers(retargeter, clip, true, true),
    },
];

/// Per-frame inverse kinematics, run to convergence from the previous frame's answer (the first from the default pose).
fn converged(retargeter: &Retargeter, clip: &Clip) -> Result<Track> {
    let robot = retargeter.robot();
    let mut solver = Solver::new(robot);
    let mut angles: Vec<f64> = robot
        .goal_joints()
        .iter()
        .map(|joint| joint.default)
        .collect();
    let solve = |frame| {
        solver.minimise(&Target::new(frame), &mut angles, Effort::CONVERGE);
        angles.clone()
    };
    Ok(clip.frames.iter().map(solve).collect())
}

/// The retargeter as a stream is served: one frame at a time, keeping its last answer.
fn answers(retargeter: &Retargeter, clip: &Clip, refine: bool, smooth: bool) -> Result<Track> {
    let mut smoother = Smoother::new();
    let mut previous: Option<Vec<f32>> = None;
    let mut track = Track::with_capacity(clip.frames.len());
    for frame in &clip.frames {
        let input = RetargetInput {
            frame: frame.clone(),
            refine,
            previous: previous.take(),
        };
        let output = retargeter
            .retarget(std::slice::from_ref(&input))?
            .swap_remove(0);
        let mut angles = output.angles;
        if refine {
            previous = Some(angles.clone());
        }
        if smooth {
            smoother.step(&mut angles);
        }
        track.push(angles.into_iter().map(f64::from).collect());
    }
    Ok(track)
}

/// Runs every method over the clips.
///
/// # Errors
/// When there is no clip, a frame cannot be retargeted, or the simulator cannot be set up.
pub fn report(
    retargeter: &Retargeter,
    clips: &[Clip],
    mut progress: impl FnMut(&str),
) -> Result<Report> {
    let frames: usize = clips.iter().map(|clip| clip.frames.len()).sum();
    ensure!(frames > 0, "expected at least one frame of motion");
    let targets: Vec<Target> = clips
        .iter()
        .flat_map(|clip| clip.frames.iter().map(Target::new))
        .collect();
    let indices = codes(retargeter, &targets)?;
    let mut used = indices.clone();
    used.sort_unstable();
    used.dedup();
    let codes = retargeter.codes();

    let mut rows: Vec<Row> = Vec::new();
    let mut reference: Vec<Track> = Vec::new();
    for method in METHODS {
        progress(method.name);
        let start = Instant::now();
        let tracks = clips
            .iter()
            .map(|clip| (method.run)(retargeter, clip))
            .collect::<Result<Vec<_>>>()?;
        let seconds = start.elapsed().as_secs_f64();
        if reference.is_empty() {
            reference.clone_from(&tracks);
        }
        let mut row = measure(
            method.name,
            retargeter.robot(),
            &targets,
            &tracks,
            &reference,
        )?;
        row.frames_per_second = frames as f64 / seconds;
        row.jerk_ratio = row.jerk / rows.first().map_or(row.jerk, |first| first.jerk);
        rows.push(row);
    }
    Ok(Report {
        robot: retargeter.robot().name().to_owned(),
        model: retargeter.metadata().version().to_owned(),
        clips: clips.len(),
        frames,
        wrist_share: targets
            .iter()
            .filter(|t| t.wrists.iter().any(Option::is_some))
            .count() as f64
            / frames as f64,
        codebook_perplexity: perplexity(&indices, codes),
        codes_used: [used.len(), codes],
        rows,
    })
}

fn codes(retargeter: &Retargeter, targets: &[Target]) -> Result<Vec<u32>> {
    const BATCH: usize = 1024;
    let mut indices = Vec::new();
    for batch in targets.chunks(BATCH) {
        indices.extend(retargeter.predict(batch)?.1);
    }
    Ok(indices)
}

fn measure(
    method: &str,
    robot: &Robot,
    targets: &[Target],
    tracks: &[Track],
    reference: &[Track],
) -> Result<Row> {
    let mut solver = Solver::new(robot);
    let (mut upper_arms, mut forearms, mut wrists) = (Vec::new(), Vec::new(), Vec::new());
    let mut at_limit = 0;
    for (angles, target) in tracks.iter().flatten().zip(targets) {
        let [left_upper, left_fore, right_upper, right_fore] =
            solver.bone_errors(target, angles).map(f64::to_degrees);
        upper_arms.extend([left_upper, right_upper]);
        forearms.extend([left_fore, right_fore]);
        wrists.extend(
            solver
                .wrist_errors(target, angles)
                .into_iter()
                .flatten()
                .map(f64::to_degrees),
        );
        let stands = |(angle, joint): (&f64, &emp_robot::Joint)| {
            *angle <= joint.range[0] + AT_LIMIT || *angle >= joint.range[1] - AT_LIMIT
        };
        at_limit += usize::from(angles.iter().zip(robot.goal_joints()).any(stands));
    }
    let mut collision = SelfCollision::new(robot)?;
    let mut collisions = 0;
    for angles in tracks.iter().flatten() {
        let angles: Vec<f32> = angles.iter().map(|angle| *angle as f32).collect();
        collisions += usize::from(collision.touches(&angles)?);
    }
    let frames = targets.len() as f64;
    let both = upper_arms.iter().chain(&forearms).copied().collect();
    let empty = || anyhow::anyhow!("no frame was measured");
    let (largest_jump_rad, jumps, jumps_not_in_reference) = jumps(tracks, reference);
    Ok(Row {
        method: method.to_owned(),
        upper_arm_deg: Spread::of(upper_arms).ok_or_else(empty)?,
        forearm_deg: Spread::of(forearms).ok_or_else(empty)?,
        direction_deg: Spread::of(both).ok_or_else(empty)?,
        wrist_deg: Spread::of(wrists),
        limit_share: at_limit as f64 / frames,
        largest_jump_rad,
        jumps,
        jumps_not_in_reference,
        jerk: jerk(tracks, robot.control_rate_hz()),
        jerk_ratio: 1.0,
        self_collision_share: collisions as f64 / frames,
        frames_per_second: 0.0,
    })
}

/// Largest change of a joint between two frames, and by frame whether it is a jump.
fn changes(track: &Track) -> Vec<f64> {
    let change = |pair: &[Vec<f64>]| {
        pair[0]
            .iter()
            .zip(&pair[1])
            .map(|(a, b)| (b - a).abs())
            .fold(0.0, f64::max)
    };
    track.windows(2).map(change).collect()
}

fn jumps(tracks: &[Track], reference: &[Track]) -> (f64, usize, usize) {
    /// Smoothing delays by a frame and spreads a jump over its neighbours.
    const NEAR: usize = 2;
    let (mut largest, mut count, mut own) = (0.0, 0, 0);
    for (track, reference) in tracks.iter().zip(reference) {
        let reference = changes(reference);
        for (frame, change) in changes(track).into_iter().enumerate() {
            largest = f64::max(largest, change);
            if change <= JUMP {
                continue;
            }
            count += 1;
            let near = frame.saturating_sub(NEAR)..(frame + NEAR + 1).min(reference.len());
            own += usize::from(reference[near].iter().all(|change| *change <= JUMP));
        }
    }
    (largest, count, own)
}

/// Mean norm of the third difference, rad/s³.
fn jerk(tracks: &[Track], rate: f64) -> f64 {
    let mut sum = 0.0;
    let mut count = 0;
    for window in tracks.iter().flat_map(|track| track.windows(4)) {
        let third =
            |j: usize| window[3][j] - 3.0 * window[2][j] + 3.0 * window[1][j] - window[0][j];
        sum += (0..window[0].len())
            .map(|j| third(j).powi(2))
            .sum::<f64>()
            .sqrt();
        count += 1;
    }
    sum / f64::from(count.max(1)) * rate.powi(3)
}

impl std::fmt::Display for Report {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        writeln!(
            f,
            "{} · model {} · {} clips, {} frames at 50 Hz, wrists in {:.0} %",
            self.robot,
            self.model,
            self.clips,
            self.frames,
            100.0 * self.wrist_share
        )?;
        writeln!(
            f,
            "codebook perplexity {:.0}, {} of {} codes in use\n",
            self.codebook_perplexity, self.codes_used[0], self.codes_used[1]
        )?;
        writeln!(
            f,
            "| method | direction ° mean / p95 | upper arm ° | forearm ° | wrist ° | at a limit | largest jump rad | jumps (own) | jerk / reference | self-collision | frames/s |"
        )?;
        writeln!(f, "|---|---|---|---|---|---|---|---|---|---|---|")?;
        for row in &self.rows {
            let spread = |s: &Spread| format!("{:.2} / {:.2}", s.mean, s.p95);
            writeln!(
                f,
                "| {} | {} | {} | {} | {} | {:.1} % | {:.3} | {} ({}) | {:.2} | {:.2} % | {:.0} |",
                row.method,
                spread(&row.direction_deg),
                spread(&row.upper_arm_deg),
                spread(&row.forearm_deg),
                row.wrist_deg.as_ref().map_or("–".to_owned(), spread),
                100.0 * row.limit_share,
                row.largest_jump_rad,
                row.jumps,
                row.jumps_not_in_reference,
                row.jerk_ratio,
                100.0 * row.self_collision_share,
                row.frames_per_second
            )?;
        }
        Ok(())
    }
}
