//! A hard motion with the EMP off and on: the same person, the same robot, the same seeds.

use std::fmt;
use std::sync::Arc;

use anyhow::{Context, Result};
use emp_client::{Client, EmpMode, EpisodeEnd, EvaluationConfig, EvaluationEvent, MassRange, Push};
use emp_robot::Robot;
use emp_sim::pushes::Kick;
use serde::Serialize;

use crate::control::{self, Pace, Run};
use crate::disturbances::{Disturbances, SHORT_PUSH_INTERVAL};
use crate::episode::{Episode, tilt};
use crate::hard::HardMotions;
use crate::motion::Motion;

/// Clips of an evaluation are whole motions: more frames than any has.
const WHOLE: u32 = 100_000;

/// Hard motions, and what the robot meets besides them.
pub(crate) struct Trials {
    pub(crate) motions: HardMotions,
    /// Seed of loads and directions of pushes.
    pub(crate) seed: u64,
    /// Mass in each hand, kg; none: drawn from the robot's range for tests.
    pub(crate) load: Option<f64>,
    /// What a push every 1.5 s adds to the base's speed, m/s.
    pub(crate) push: f64,
}

/// One motion, played with the EMP off, and on where the robot has one.
pub(crate) struct Comparison {
    pub(crate) motion: Motion,
    pub(crate) disturbances: Disturbances,
    pub(crate) off: Run,
    pub(crate) on: Option<Run>,
    /// Number of the motion, from 1.
    number: usize,
    amplitude: f64,
    /// In how many of all motions the robot fell, mode by mode.
    counts: Vec<Count>,
}

/// Falls over all motions, of `RolloutService.Evaluate`.
#[derive(Clone, Debug, Serialize)]
struct Count {
    emp_mode: EvaluatedMode,
    motions: usize,
    falls: usize,
}

/// The modes that are compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
enum EvaluatedMode {
    Off,
    On,
}

impl EvaluatedMode {
    /// The controller's name in an evaluation.
    fn controller(self) -> &'static str {
        match self {
            Self::Off => "decoupled",
            Self::On => "emp",
        }
    }
}

impl Trials {
    /// Plays the first motion that the robot falls in without the EMP and stands with it (if there is none, the first that it falls in
    /// without; if it never falls, the one that tilts it most), without and with the EMP; then has the server count the falls over
    /// all motions.
    ///
    /// No clock is in it: control periods are in lock step with their answers, so that the same motion is found on every machine.
    pub(crate) async fn play(
        &self,
        client: &Client,
        robot: &Arc<Robot>,
        has_emp: bool,
    ) -> Result<Comparison> {
        let Trial {
            number,
            motion,
            off,
            on,
        } = self.telling(client, robot, has_emp).await?;
        let disturbances = self.disturbances(robot, number);
        eprintln!("counting falls over {} motions", self.motions.sources.len());
        let mut counts = Vec::new();
        for mode in [EvaluatedMode::Off, EvaluatedMode::On] {
            if has_emp || mode == EvaluatedMode::Off {
                counts.push(self.count(client, robot, mode).await?);
            }
        }
        Ok(Comparison {
            motion,
            disturbances,
            off,
            on,
            number: number + 1,
            amplitude: self.motions.amplitude,
            counts,
        })
    }

    /// The motion that tells most, in the order that [`play`](Self::play) gives.
    async fn telling(&self, client: &Client, robot: &Arc<Robot>, has_emp: bool) -> Result<Trial> {
        let mut best: Option<(f64, Trial)> = None;
        for number in 0..self.motions.sources.len() {
            let trial = self.trial(client, robot, number, has_emp).await?;
            eprintln!(
                "hard motion {} of {}, {}: {}",
                number + 1,
                self.motions.sources.len(),
                trial.motion.name,
                trial.outcome()
            );
            if trial.is_saved() || (trial.off.fall.is_some() && !has_emp) {
                return Ok(trial);
            }
            let weight = trial.weight();
            if best.as_ref().is_none_or(|(most, _)| *most < weight) {
                best = Some((weight, trial));
            }
        }
        best.map(|(_, trial)| trial)
            .context("there is no motion to compare with")
    }

    /// One motion without the EMP and, where the robot has one, with it.
    async fn trial(
        &self,
        client: &Client,
        robot: &Arc<Robot>,
        number: usize,
        has_emp: bool,
    ) -> Result<Trial> {
        let motion = self.motions.perform(number, client, robot).await?;
        let off = self
            .run(client, robot, number, &motion, EmpMode::Off)
            .await?;
        let on = match has_emp {
            true => Some(
                self.run(client, robot, number, &motion, EmpMode::On)
                    .await?,
            ),
            false => None,
        };
        Ok(Trial {
            number,
            motion,
            off,
            on,
        })
    }

    async fn run(
        &self,
        client: &Client,
        robot: &Arc<Robot>,
        number: usize,
        motion: &Motion,
        mode: EmpMode,
    ) -> Result<Run> {
        let disturbances = self.disturbances(robot, number);
        control::run(
            client,
            robot,
            &motion.clip,
            disturbances,
            mode,
            Pace::LockStep,
        )
        .await
    }

    /// Loads and pushes of a motion, which follow from the seed and its number.
    fn disturbances(&self, robot: &Robot, number: usize) -> Disturbances {
        let pushes = Kick {
            speed: self.push,
            interval: SHORT_PUSH_INTERVAL,
        };
        let seed = self.seed.wrapping_add(number as u64);
        Disturbances::new(robot, seed, self.load, pushes)
    }

    /// Falls over all motions.
    async fn count(&self, client: &Client, robot: &Robot, mode: EvaluatedMode) -> Result<Count> {
        let config = EvaluationConfig {
            robot: robot.name().to_owned(),
            controller: Some(emp_client::controller(mode.controller())?),
            seed: self.seed,
            hand_load: self.load.map(|load| MassRange {
                least: load,
                most: load,
            }),
            push: (self.push > 0.0).then_some(Push {
                speed: self.push,
                interval: SHORT_PUSH_INTERVAL,
            }),
            amplitude: Some(self.motions.amplitude),
            clip_frames: WHOLE,
            ..EvaluationConfig::default()
        };
        let motions = self.motions.sources.clone();
        let mut evaluation = client.evaluate(config, motions).await?;
        let (mut result, mut falls) = (None, 0);
        // To the stream's end: only then has the server room for the next evaluation.
        while let Some(event) = evaluation.next().await.context("the evaluation")? {
            match event {
                EvaluationEvent::Episode(episode) => {
                    let end = episode.result.map(|result| result.end());
                    falls += usize::from(end != Some(EpisodeEnd::Completed));
                }
                EvaluationEvent::Result(last) => result = Some(last),
                EvaluationEvent::Preparing(_) | EvaluationEvent::Started(_) => {}
            }
        }
        let result = result.context("the evaluation ended without a result")?;
        let all = result.all.context("an evaluation without metrics")?;
        Ok(Count {
            emp_mode: mode,
            motions: all.episodes as usize,
            falls,
        })
    }
}

/// A hard motion, played.
struct Trial {
    /// Index of the motion.
    number: usize,
    motion: Motion,
    off: Run,
    on: Option<Run>,
}

impl Trial {
    /// Whether the robot falls without the EMP and stands with it.
    fn is_saved(&self) -> bool {
        self.off.fall.is_some() && self.on.as_ref().is_some_and(|on| on.fall.is_none())
    }

    /// How much it tells: a fall without the EMP more than any tilt, rad.
    fn weight(&self) -> f64 {
        if self.off.fall.is_some() {
            return f64::INFINITY;
        }
        let tilts = self.off.periods.iter().map(|period| tilt(&period.reading));
        tilts.fold(0.0, f64::max)
    }

    fn outcome(&self) -> String {
        let verb = |run: &Run| {
            if run.fall.is_some() {
                "falls"
            } else {
                "stands"
            }
        };
        let on = self.on.as_ref().map(|on| format!(", {} with it", verb(on)));
        format!(
            "{} without the EMP{}",
            verb(&self.off),
            on.unwrap_or_default()
        )
    }
}

/// What is said of a comparison.
#[derive(Debug, Serialize)]
pub(crate) struct ComparisonSummary {
    #[serde(skip)]
    robot: String,
    /// The motion's name.
    motion: String,
    /// Its number among the hard motions, from 1.
    number: usize,
    /// Factor on the distance of its goals from the default pose.
    amplitude: f64,
    /// Its length, seconds.
    seconds: f64,
    /// Mass added to the left and the right hand, kg.
    hand_load_kg: [f64; 2],
    /// What each push added to the base's speed, m/s.
    push_m_per_s: f64,
    /// Without the EMP.
    off: Episode,
    /// With the EMP; none for a robot without one.
    on: Option<Episode>,
    /// What the EMP did to each goal joint, the most changed first.
    joints: Vec<JointChange>,
    /// Falls over all motions like it.
    all_motions: Vec<Count>,
}

/// By how much the EMP changed the goal of a joint.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct JointChange {
    /// The joint's name.
    pub(crate) joint: String,
    /// Its index among the goal joints.
    #[serde(skip)]
    pub(crate) index: usize,
    /// Mean size of the change, radians.
    pub(crate) mean_rad: f32,
    /// Largest size of the change, radians.
    pub(crate) largest_rad: f32,
}

impl Comparison {
    pub(crate) fn summary(&self, robot: &Robot) -> ComparisonSummary {
        let on = self.on.as_ref();
        ComparisonSummary {
            robot: robot.name().to_owned(),
            motion: self.motion.name.clone(),
            number: self.number,
            amplitude: self.amplitude,
            seconds: self.motion.time(self.motion.clip.frames.len()),
            hand_load_kg: self.disturbances.hand_load,
            push_m_per_s: self.disturbances.pushes.speed,
            off: Episode::new(robot, &self.off),
            on: on.map(|run| Episode::new(robot, run)),
            joints: on.map_or_else(Vec::new, |run| joint_changes(robot, run)),
            all_motions: self.counts.clone(),
        }
    }
}

/// The goal joints by how much their goals were changed, the most changed first.
fn joint_changes(robot: &Robot, run: &Run) -> Vec<JointChange> {
    let change = |(index, joint): (usize, &emp_robot::Joint)| {
        let answers = run.periods.iter().map(|period| &period.answer);
        let sizes: Vec<f32> = answers
            .map(|answer| (answer.targets.goal[index] - answer.goal[index]).abs())
            .collect();
        JointChange {
            joint: joint.name.clone(),
            index,
            mean_rad: sizes.iter().sum::<f32>() / sizes.len().max(1) as f32,
            largest_rad: sizes.into_iter().fold(0.0, f32::max),
        }
    };
    let joints = robot.goal_joints().iter().enumerate();
    let mut changes: Vec<JointChange> = joints.map(change).collect();
    changes.sort_by(|a, b| b.mean_rad.total_cmp(&a.mean_rad));
    changes
}

impl ComparisonSummary {
    /// What the EMP did to each goal joint, the most changed first; none without one.
    pub(crate) fn joints(&self) -> &[JointChange] {
        &self.joints
    }

    /// What happened, in a line.
    pub(crate) fn title(&self) -> String {
        let Self {
            robot,
            motion,
            amplitude,
            ..
        } = self;
        let verb = |episode: &Episode| match episode.fall() {
            Some(_) => "falls",
            None => "stands",
        };
        let off = verb(&self.off);
        let outcome = match self.on.as_ref().map(verb) {
            None => format!("{off}; it has no EMP"),
            Some(on) if on == off => format!("{off} without the EMP and with it"),
            Some(on) => format!("{off} without the EMP, {on} with it"),
        };
        format!("{robot} follows {motion} at {amplitude} × its amplitude: {outcome}")
    }

    /// The conditions, in a line.
    pub(crate) fn conditions(&self) -> String {
        let [left, right] = self.hand_load_kg;
        let mut text = format!("{left:.2} kg in the left hand, {right:.2} kg in the right");
        match self.push_m_per_s {
            0.0 => text += ", no pushes",
            push => text += &format!(", pushed by {push} m/s every {SHORT_PUSH_INTERVAL} s"),
        }
        if self.on.is_some() {
            text += "; the same person, robot and seeds in both runs";
        }
        text
    }

    /// How the motion was chosen, and how all of its kind went, in a line.
    pub(crate) fn choice(&self) -> String {
        let Self {
            number, off, on, ..
        } = self;
        let saved = on.as_ref().is_some_and(|on| on.fall().is_none());
        let rule = match off.fall() {
            Some(_) if saved => {
                "the first in which the robot falls without the EMP and stands with it"
            }
            Some(_) => "the first that fells the robot without the EMP",
            None => "none fells the robot without the EMP, and this one tilts it most",
        };
        let counts: Vec<String> = self.all_motions.iter().map(Count::text).collect();
        let motions = self.all_motions.first().map_or(0, |count| count.motions);
        format!(
            "motion {number} of {motions}: {rule}; evaluated on all {motions}, the robot falls in {}",
            counts.join(" and in ")
        )
    }

    /// What happened without the EMP and with it, each in a line.
    pub(crate) fn outcomes(&self) -> Vec<String> {
        let off = format!("EMP off: {}", self.outcome(&self.off));
        let on = self.on.as_ref().map(|on| {
            let changed = on.metrics.change;
            let outcome = self.outcome(on);
            format!("EMP on: {outcome}; goals changed by {changed:.3} rad on average")
        });
        std::iter::once(off).chain(on).collect()
    }

    fn outcome(&self, episode: &Episode) -> String {
        match episode.fall() {
            Some(fall) => format!("falls after {:.1} of {:.1} s", fall.time, self.seconds),
            None => format!(
                "stands for all {:.1} s, tilted by {:.1}° at most",
                self.seconds, episode.largest_tilt_deg
            ),
        }
    }
}

impl Count {
    fn text(&self) -> String {
        let with = match self.emp_mode {
            EvaluatedMode::Off => "without the EMP",
            EvaluatedMode::On => "with it",
        };
        format!("{} {with}", self.falls)
    }
}

impl fmt::Display for ComparisonSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}", self.title())?;
        writeln!(f, "  motion          {}", self.choice())?;
        writeln!(f, "  conditions      {}", self.conditions())?;
        let episodes = std::iter::once(("EMP off", &self.off))
            .chain(self.on.as_ref().map(|on| ("EMP on ", on)));
        for (name, episode) in episodes {
            writeln!(f, "  {name}         {}", episode.balance())?;
            writeln!(f, "    goals         {}", episode.filtering())?;
            writeln!(f, "    guards        {}", episode.guarding())?;
            writeln!(f, "    robot         {}", episode.body())?;
            writeln!(f, "    control loop  {}", episode.waiting())?;
        }
        let most = self.joints.iter().take(3).map(|change| {
            let JointChange {
                joint, mean_rad, ..
            } = change;
            format!("{joint} by {mean_rad:.3} rad")
        });
        match self.on {
            None => writeln!(
                f,
                "  EMP             there are no weights of an EMP for this robot"
            ),
            Some(_) => writeln!(
                f,
                "  most changed    {} on average",
                most.collect::<Vec<_>>().join(", ")
            ),
        }
    }
}
