//! Measures a retargeter on sets of human motion: how close it points, how it moves in between, how fast it is.
//!
//! The module `measures` says how each figure is computed.

mod measures;

use std::{
    path::{Path, PathBuf},
    time::Instant,
};

use anyhow::{Context as _, Result, ensure};
use emp_models::retarget::{
    AT_LIMIT, Effort, Memory, Mode, RetargetInput, Retargeter, Smoother, Solver, Target,
};
use emp_motion::Clip;
use emp_robot::Robot;
use emp_sim::SelfCollision;
use serde::Serialize;

use self::measures::{Lag, Played, Spread};
use super::trainer::perplexity;

/// Clips that a table lists as the worst.
const WORST: usize = 5;

/// How deep folders of motion may be nested.
const DEEPEST: usize = 32;

/// A named set of clips at the robot's control rate.
pub struct Set {
    /// What it is called in the report.
    pub name: String,
    /// Its clips.
    pub clips: Vec<Clip>,
    /// Files that were skipped, with the reason.
    pub skipped: Vec<String>,
}

/// A report on one robot.
#[derive(Debug, Serialize)]
pub struct Report {
    /// The robot's name.
    pub robot: String,
    /// The retargeter's version.
    pub model: String,
    /// One report a set.
    pub sets: Vec<SetReport>,
}

/// What was measured on a set of clips.
#[derive(Debug, Serialize)]
pub struct SetReport {
    /// The set's name.
    pub name: String,
    /// Files that were skipped, with the reason.
    pub skipped: Vec<String>,
    /// Number of clips.
    pub clips: usize,
    /// Number of frames at the control rate.
    pub frames: usize,
    /// Share of frames with at least one wrist orientation.
    pub wrist_share: f64,
    /// Perplexity of the network's codes over all frames and joints; absent without a network.
    pub codebook_perplexity: Option<f64>,
    /// One row a method, the reference first.
    pub rows: Vec<Row>,
    /// Every clip as the refined and smoothed stream answers it, the largest mean error first.
    pub by_clip: Vec<ClipRow>,
}

/// What was measured of one way to retarget.
#[derive(Debug, Serialize)]
pub struct Row {
    /// Which way.
    pub method: &'static str,
    /// Direction error of all arm bones, degrees.
    pub direction_deg: Spread,
    /// Wrist rotation error where the source has wrists, degrees; absent where no source has.
    pub wrist_deg: Option<Spread>,
    /// Share of frames with any goal joint within 0.01 rad of a limit.
    pub limit_share: f64,
    /// Share of frames in which an arm joint spins.
    pub spin_share: f64,
    /// Times that an arm takes another branch.
    pub flips: usize,
    /// How far the robot's arms are behind the person's, milliseconds; absent where nothing moves.
    pub lag_ms: Option<f64>,
    /// Jerk of the robot's arm bones over the person's; absent where nothing moves.
    pub jerk_ratio: Option<f64>,
    /// Largest change of a joint from one frame to the next, radians.
    pub largest_step_rad: f64,
    /// Share of frames in which collision pairs touch.
    pub self_collision_share: f64,
    /// Frames a second on one core, one frame at a time.
    pub frames_per_second: f64,
}

/// One clip, refined and smoothed.
#[derive(Debug, Serialize)]
pub struct ClipRow {
    /// The clip's name.
    pub name: String,
    /// Number of frames.
    pub frames: usize,
    /// Direction error of all arm bones, degrees.
    pub direction_deg: Spread,
    /// Share of frames in which an arm joint stands at a limit.
    pub arm_limit_share: f64,
    /// Frames in which an arm joint spins.
    pub spins: usize,
}

/// Joint angles of one clip, a row a frame.
type Track = Vec<Vec<f64>>;

/// One way to retarget a clip.
struct Method {
    name: &'static str,
    needs_network: bool,
    run: fn(&Retargeter, &Clip) -> Result<Track>,
}

const METHODS: [Method; 4] = [
    Method {
        name: "converged IK",
        needs_network: false,
        run: converged,
    },
    Method {
        name: "network",
        needs_network: true,
        run: |retargeter, clip| answers(retargeter, clip, false, false),
    },
    Method {
        name: "refined stream",
        needs_network: false,
        run: |retargeter, clip| answers(retargeter, clip, true, false),
    },
    Method {
        name: "refined, smoothed stream",
        needs_network: false,
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

/// The retargeter as a stream is served: one frame at a time.
fn answers(retargeter: &Retargeter, clip: &Clip, refine: bool, smooth: bool) -> Result<Track> {
    let mut smoother = Smoother::new();
    let mut memory: Option<Box<Memory>> = None;
    let seconds = 1.0 / retargeter.robot().control_rate_hz();
    let mut track = Track::with_capacity(clip.frames.len());
    for frame in &clip.frames {
        let input = RetargetInput {
            frame: frame.clone(),
            mode: match memory.take() {
                _ if !refine => Mode::Network,
                None => Mode::Begin,
                Some(memory) => Mode::Follow { memory, seconds },
            },
        };
        let output = retargeter
            .retarget(std::slice::from_ref(&input))?
            .swap_remove(0);
        let mut angles = output.angles;
        memory = output.memory;
        if smooth {
            smoother.step(&mut angles);
        }
        track.push(angles.into_iter().map(f64::from).collect());
    }
    Ok(track)
}

/// Reads each folder that directly holds motion, however deep under `folders`, as a set of its own.
///
/// A file that cannot be read is skipped and named.
///
/// # Errors
/// When a folder cannot be listed, or none holds motion that can be read.
pub fn load_sets(folders: &[PathBuf], rate: f64) -> Result<Vec<Set>> {
    let mut sets: Vec<Set> = Vec::new();
    for root in folders {
        let mut paths: Vec<PathBuf> = Vec::new();
        collect(root, DEEPEST, &mut paths)?;
        paths.sort();
        for path in paths {
            let folder = path.parent().unwrap_or(root);
            let base = root.parent().unwrap_or(root);
            let name = folder.strip_prefix(base).unwrap_or(folder);
            let name = name.to_string_lossy().into_owned();
            if sets.last().is_none_or(|set| set.name != name) {
                let (clips, skipped) = (Vec::new(), Vec::new());
                sets.push(Set {
                    name,
                    clips,
                    skipped,
                });
            }
            let Some(set) = sets.last_mut() else { continue };
            match emp_motion::load(&path).map(|clip| clip.resampled(rate)) {
                Ok(Ok(clip)) => set.clips.push(clip),
                Ok(Err(error)) => set.skipped.push(format!("{}: {error}", path.display())),
                Err(error) => set.skipped.push(error.to_string()),
            }
        }
    }
    sets.retain(|set| !set.clips.is_empty() || !set.skipped.is_empty());
    ensure!(
        sets.iter().any(|set| !set.clips.is_empty()),
        "expected motion files under the folders, found none that can be read"
    );
    Ok(sets)
}

/// Adds the motion files under `path`.
fn collect(path: &Path, depth: usize, files: &mut Vec<PathBuf>) -> Result<()> {
    const MOTION: [&str; 4] = ["bvh", "npz", "mvnx", "c3d"];
    if !path.is_dir() {
        let extension = path.extension().unwrap_or_default().to_ascii_lowercase();
        if MOTION.iter().any(|motion| extension == *motion) {
            files.push(path.to_owned());
        }
        return Ok(());
    }
    ensure!(depth > 0, "{}: nested too deep", path.display());
    let listed = path
        .read_dir()
        .with_context(|| path.display().to_string())?;
    for entry in listed {
        collect(&entry?.path(), depth - 1, files)?;
    }
    Ok(())
}

/// Procedural clips that no trainer's default seed draws.
///
/// # Errors
/// When the retargeter's weights say that they were trained with these very clips.
pub fn held_out(retargeter: &Retargeter) -> Result<Set> {
    const SEED: u64 = 0x4E1D_0117;
    const CLIPS: usize = 60;
    let trained = &retargeter.metadata().training["settings"]["seed"];
    ensure!(
        trained.as_u64() != Some(SEED),
        "the weights were trained with the procedural clips of seed {SEED}; name motions of your own"
    );
    let rate = retargeter.robot().control_rate_hz();
    let library = emp_motion::skills::library(SEED, CLIPS);
    Ok(Set {
        name: format!("procedural, seed {SEED}"),
        clips: library
            .iter()
            .map(|clip| clip.resampled(rate))
            .collect::<Result<_, _>>()?,
        skipped: Vec::new(),
    })
}

/// Runs every method over every set.
///
/// # Errors
/// When there is no frame, a frame cannot be retargeted, or the simulator cannot be set up.
pub fn report(
    retargeter: &Retargeter,
    sets: Vec<Set>,
    mut progress: impl FnMut(&str),
) -> Result<Report> {
    let sets = sets.into_iter().filter(|set| {
        for skipped in &set.skipped {
            eprintln!("skipped: {skipped}");
        }
        !set.clips.is_empty()
    });
    Ok(Report {
        robot: retargeter.robot().name().to_owned(),
        model: retargeter.metadata().version().to_owned(),
        sets: sets
            .map(|set| report_set(retargeter, set, &mut progress))
            .collect::<Result<_>>()?,
    })
}

fn report_set(
    retargeter: &Retargeter,
    set: Set,
    progress: &mut impl FnMut(&str),
) -> Result<SetReport> {
    let targets: Vec<Vec<Target>> = set
        .clips
        .iter()
        .map(|clip| clip.frames.iter().map(Target::new).collect())
        .collect();
    let frames: usize = targets.iter().map(Vec::len).sum();
    ensure!(frames > 0, "{}: expected at least one frame", set.name);
    let with_wrists = targets.iter().flatten();
    let with_wrists = with_wrists.filter(|target| target.wrists.iter().any(Option::is_some));

    let (mut rows, mut by_clip) = (Vec::new(), Vec::new());
    for method in METHODS {
        if method.needs_network && !retargeter.has_network() {
            continue;
        }
        progress(&format!("{}: {}", set.name, method.name));
        let start = Instant::now();
        let tracks = set
            .clips
            .iter()
            .map(|clip| (method.run)(retargeter, clip))
            .collect::<Result<Vec<_>>>()?;
        let seconds = start.elapsed().as_secs_f64();
        let (mut row, clips) = measure(&method, retargeter.robot(), &set, &targets, &tracks)?;
        row.frames_per_second = frames as f64 / seconds;
        rows.push(row);
        by_clip = clips;
    }
    by_clip.sort_by(|a, b| b.direction_deg.mean.total_cmp(&a.direction_deg.mean));
    Ok(SetReport {
        name: set.name,
        skipped: set.skipped,
        clips: set.clips.len(),
        frames,
        wrist_share: with_wrists.count() as f64 / frames as f64,
        codebook_perplexity: codebook(retargeter, &targets)?,
        rows,
        by_clip,
    })
}

/// Perplexity of the network's codes.
fn codebook(retargeter: &Retargeter, targets: &[Vec<Target>]) -> Result<Option<f64>> {
    const BATCH: usize = 1024;
    if !retargeter.has_network() {
        return Ok(None);
    }
    let mut indices = Vec::new();
    for batch in targets.iter().flat_map(|clip| clip.chunks(BATCH)) {
        indices.extend(retargeter.predict(batch)?.1);
    }
    Ok(Some(perplexity(&indices, retargeter.codes())))
}

fn measure(
    method: &Method,
    robot: &Robot,
    set: &Set,
    targets: &[Vec<Target>],
    tracks: &[Track],
) -> Result<(Row, Vec<ClipRow>)> {
    let mut solver = Solver::new(robot);
    let mut collision = SelfCollision::new(robot)?;
    let (mut directions, mut wrists) = (Vec::new(), Vec::new());
    let (mut at_limit, mut collisions, mut spins, mut flips) = (0, 0, 0, 0);
    let (mut jerk, mut person_jerk, mut largest_step) = (0.0, 0.0, 0.0);
    let mut lag = Lag::default();
    let mut clips = Vec::new();
    for ((clip, targets), track) in set.clips.iter().zip(targets).zip(tracks) {
        let played = Played::new(&mut solver, targets, track, robot.control_rate_hz());
        let mut of_clip = Vec::with_capacity(4 * track.len());
        let mut arms_at_limit = 0usize;
        for (angles, target) in track.iter().zip(targets) {
            of_clip.extend(solver.bone_errors(target, angles).map(f64::to_degrees));
            let errors = solver.wrist_errors(target, angles);
            wrists.extend(errors.into_iter().flatten().map(f64::to_degrees));
            let stands = |joint: &usize| {
                let [lower, upper] = robot.goal_joints()[*joint].range;
                angles[*joint] <= lower + AT_LIMIT || angles[*joint] >= upper - AT_LIMIT
            };
            at_limit += usize::from((0..angles.len()).any(|joint| stands(&joint)));
            arms_at_limit += usize::from(solver.arms().iter().flatten().any(stands));
            let single: Vec<f32> = angles.iter().map(|angle| *angle as f32).collect();
            collisions += usize::from(collision.touches(&single)?);
        }
        let spinning = played.spins();
        clips.push(ClipRow {
            name: clip.name.clone(),
            frames: track.len(),
            direction_deg: Spread::of(of_clip.clone()).ok_or_else(nothing)?,
            arm_limit_share: arms_at_limit as f64 / track.len() as f64,
            spins: spinning,
        });
        directions.extend(of_clip);
        spins += spinning;
        flips += played.flips();
        largest_step = f64::max(largest_step, played.largest_step());
        jerk += measures::jerk(&played.robot);
        person_jerk += measures::jerk(&played.person);
        lag.add(&played);
    }
    let frames: f64 = targets.iter().map(|clip| clip.len() as f64).sum();
    let row = Row {
        method: method.name,
        direction_deg: Spread::of(directions).ok_or_else(nothing)?,
        wrist_deg: Spread::of(wrists),
        limit_share: at_limit as f64 / frames,
        spin_share: spins as f64 / frames,
        flips,
        lag_ms: lag.milliseconds(robot.control_rate_hz()),
        jerk_ratio: (person_jerk > 0.0).then(|| jerk / person_jerk),
        largest_step_rad: largest_step,
        self_collision_share: collisions as f64 / frames,
        frames_per_second: 0.0,
    };
    Ok((row, clips))
}

fn nothing() -> anyhow::Error {
    anyhow::anyhow!("no frame was measured")
}

impl std::fmt::Display for Report {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        writeln!(f, "{} · model {}", self.robot, self.model)?;
        self.sets.iter().try_for_each(|set| write!(f, "\n{set}"))
    }
}

impl std::fmt::Display for SetReport {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{}: {} clips, {} frames, wrists in {:.0} %",
            self.name,
            self.clips,
            self.frames,
            100.0 * self.wrist_share
        )?;
        if !self.skipped.is_empty() {
            write!(f, ", {} files skipped", self.skipped.len())?;
        }
        if let Some(perplexity) = self.codebook_perplexity {
            write!(f, ", codebook perplexity {perplexity:.0}")?;
        }
        writeln!(f, "\n")?;
        writeln!(
            f,
            "| method | direction ° mean / p95 / max | wrist ° mean / p95 | spin | flips | lag ms | jerk / person's | largest step rad | at a limit | self-collision | frames/s |"
        )?;
        writeln!(f, "|---|---|---|---|---|---|---|---|---|---|---|")?;
        let number = |value: Option<f64>, digits| {
            value.map_or("–".to_owned(), |value| format!("{value:.digits$}"))
        };
        for row in &self.rows {
            let direction = &row.direction_deg;
            let wrist = |s: &Spread| format!("{:.2} / {:.2}", s.mean, s.p95);
            writeln!(
                f,
                "| {} | {:.2} / {:.2} / {:.1} | {} | {:.2} % | {} | {} | {} | {:.3} | {:.1} % | {:.2} % | {:.0} |",
                row.method,
                direction.mean,
                direction.p95,
                direction.max,
                row.wrist_deg.as_ref().map_or("–".to_owned(), wrist),
                100.0 * row.spin_share,
                row.flips,
                number(row.lag_ms, 0),
                number(row.jerk_ratio, 2),
                row.largest_step_rad,
                100.0 * row.limit_share,
                100.0 * row.self_collision_share,
                row.frames_per_second
            )?;
        }
        writeln!(f)?;
        for clip in self.by_clip.iter().take(WORST) {
            writeln!(
                f,
                "worst: {} ({} frames): direction {:.2} / {:.2} / {:.1}°, arm joints at limits in {:.0} %, {} spins",
                clip.name,
                clip.frames,
                clip.direction_deg.mean,
                clip.direction_deg.p95,
                clip.direction_deg.max,
                100.0 * clip.arm_limit_share,
                clip.spins
            )?;
        }
        Ok(())
    }
}
