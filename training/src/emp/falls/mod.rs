//! What fells a policy: which joints, in which direction, with the arms where, and how early it shows.

mod auroc;
mod cuts;
mod reach;
mod text;
mod trace;

use std::{iter::Sum, sync::Arc};

use anyhow::{Context as _, Result, ensure};
use emp_models::{
    controller::Controller,
    emp::{DangerGate, Emp},
    filters::{EmpFilter, GoalFilter},
    policy::Policy,
};
use emp_sim::{
    Pool,
    evaluation::{
        EpisodeResult, Evaluation, EvaluationSettings, Observer, Progress, evaluate_observed,
    },
    goals::GoalClip,
    metrics::{Interval, Sample, failures, paired_difference},
    quantile::quantile_of,
    suite::Condition,
};
use nalgebra::Vector2;
use serde::Serialize;

use crate::sets::Basis;
use auroc::auroc;
use cuts::Cut;
pub use reach::Reaches;
use trace::{TracedFrame, Tracer};

/// How long before a fall something shows, frames: from the first up to the second, exclusive.
pub const LEADS: [(usize, usize); 3] = [(15, 30), (30, 65), (65, 110)];

/// Frames in which a robot settles into its stance.
const SETTLING: usize = 50;

/// A tilt is one that a robot which stands hardly ever has from this share of its frames on.
const TILTED: f64 = 0.99;

/// What fells a policy. As JSON one object; [`Display`](std::fmt::Display) writes a page in Markdown.
#[derive(Clone, Debug, Serialize)]
pub struct FallReport {
    /// Name of the robot.
    robot: String,
    /// What it rests on.
    basis: Basis,
    /// Where the centre of mass is in frames of nominal episodes that stood.
    nominal: OperatingPoint,
    /// One condition after the other.
    conditions: Vec<Falls>,
    /// All conditions together.
    all: Falls,
}

/// Falls under some conditions.
#[derive(Clone, Debug, Serialize)]
pub struct Falls {
    /// Names of the conditions.
    conditions: Vec<&'static str>,
    /// Number of episodes.
    episodes: usize,
    /// Number of those in which the robot fell.
    falls: usize,
    /// Which way it fell.
    directions: Directions,
    /// Which way it fell with every clip in the mirror.
    mirrored: Directions,
    /// Where the hands were asked to be 15 to 110 frames before a fall, shares of frames.
    reach_before: Reaches<f64>,
    /// Where they were in all frames.
    reach_ever: Reaches<f64>,
    /// Frames of episodes without a fall.
    standing: Option<OperatingPoint>,
    /// Median time from when the tilt passed `tilted` for good to the fall, seconds.
    seconds_from_tilt: Option<f64>,
    /// 99th percentile of the angle between the base's vertical axis and the world's in episodes without a fall, rad.
    tilted: Option<f64>,
    /// How well numbers tell frames before a fall from frames of episodes without one.
    signals: Vec<Signal>,
    /// Falls with one thing at a time cut by a fifth.
    cuts: Vec<CutFalls>,
}

/// Numbers of falls by the side to which the base leaned at the end.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Directions {
    forward: usize,
    backward: usize,
    left: usize,
    right: usize,
}

/// Where the centre of mass is while the robot stands, from the feet's middle, heading frame, metres.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct OperatingPoint {
    /// Mean of the simulated centre of mass, forward and left.
    measured: [f64; 2],
    /// Its standard deviation.
    measured_deviation: [f64; 2],
    /// Mean of the centre of mass of the goal's pose on straight default legs.
    quasi_static: [f64; 2],
    /// Its standard deviation.
    quasi_static_deviation: [f64; 2],
}

/// One number as a sign of coming falls.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Signal {
    /// What it is; larger means falling.
    name: &'static str,
    /// Area under the receiver operating characteristic at each of [`LEADS`]; none where no fall leads so long. Of several
    /// conditions, the mean weighted by frames before falls.
    auroc: [Option<f64>; 3],
    /// Frames before falls at each of [`LEADS`].
    frames: [usize; 3],
}

/// What a cut does.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CutFalls {
    /// What was cut by a fifth.
    name: String,
    /// Number of falls.
    falls: usize,
    /// Change of the share of falls, with its 95 % interval over motions.
    change: Interval,
}

/// What is reported on, and how.
pub struct FallRun<'a> {
    /// Simulates.
    pub pool: &'a Pool,
    /// The policy.
    pub policy: &'a Arc<Policy>,
    /// Judges danger without changing a goal; none: no regloss.
    pub emp: Option<Arc<Emp>>,
    /// Motion.
    pub clips: &'a [GoalClip],
    /// What the motion is, for the report's first line.
    pub basis: &'a Basis,
    /// Conditions to fall under.
    pub conditions: &'a [Condition],
    /// Whether to cut one thing at a time, which takes many times as long as the rest.
    pub cuts: bool,
}

/// The raw episodes of one condition, and their falls with cuts.
struct Traced {
    condition: Condition,
    raw: Evaluation,
    /// Frames of the raw episodes, by number.
    episodes: Vec<Vec<TracedFrame>>,
    /// Which way the robot falls with the clips in the mirror.
    mirrored: Directions,
    /// The same episodes with one thing cut, by its name.
    cuts: Vec<(String, Vec<Sample>)>,
}

/// Finds out what fells a policy.
///
/// # Errors
/// When there is no clip, a model fails, or `progress` cancels.
pub fn report(run: &FallRun<'_>, progress: &mut dyn Progress) -> Result<FallReport> {
    let nominal = trace(run, Condition::Nominal, progress)?;
    let mut traced = Vec::new();
    let mirror = run.policy.robot().mirror()?;
    let images: Vec<GoalClip> = run
        .clips
        .iter()
        .map(|clip| clip.mirrored(&mirror))
        .collect();
    let mirrored = FallRun {
        clips: &images,
        emp: None,
        ..*run
    };
    for &condition in run.conditions {
        let mut one = trace(run, condition, progress)?;
        let image = trace(&mirrored, condition, progress)?;
        one.mirrored = Directions::of(image.of(true));
        if run.cuts {
            one.cuts = cut(run, condition, progress)?;
        }
        traced.push(one);
    }
    let safe = OperatingPoint::of(nominal.standing());
    let nominal = safe.context("expected an episode that stands under nominal conditions")?;
    let rate = run.policy.robot().control_rate_hz();
    let falls = |traced: &[Traced]| falls(traced, &nominal, rate, run.basis.seed);
    Ok(FallReport {
        robot: run.policy.robot().name().to_owned(),
        basis: run.basis.clone(),
        conditions: traced.chunks(1).map(falls).collect(),
        all: falls(&traced),
        nominal,
    })
}

fn evaluation(
    run: &FallRun<'_>,
    condition: Condition,
    filter: Option<Arc<dyn GoalFilter>>,
    observer: &mut dyn Observer,
    progress: &mut dyn Progress,
) -> Result<Evaluation> {
    let controller = Controller::new(Arc::clone(run.policy), filter);
    let settings: EvaluationSettings = condition.settings(run.policy.robot(), run.basis.seed);
    let evaluation = evaluate_observed(
        run.pool,
        &controller,
        run.clips,
        &settings,
        progress,
        observer,
    )?;
    ensure!(
        evaluation.complete,
        "interrupted under {}",
        condition.name()
    );
    Ok(evaluation)
}

fn trace(run: &FallRun<'_>, condition: Condition, progress: &mut dyn Progress) -> Result<Traced> {
    let mut tracer = Tracer::new(run.policy.robot());
    let judge = run.emp.clone().map(|emp| -> Arc<dyn GoalFilter> {
        let never = DangerGate::Regloss(f32::INFINITY);
        Arc::new(EmpFilter::when_danger(emp, never))
    });
    let raw = evaluation(run, condition, judge, &mut tracer, progress)?;
    Ok(Traced {
        condition,
        raw,
        episodes: tracer.episodes,
        mirrored: Directions::default(),
        cuts: Vec::new(),
    })
}

fn cut(
    run: &FallRun<'_>,
    condition: Condition,
    progress: &mut dyn Progress,
) -> Result<Vec<(String, Vec<Sample>)>> {
    let mut cuts = Vec::new();
    for mut cut in Cut::all(run.policy.robot())? {
        let evaluation = evaluation(run, condition, cut.filter, &mut cut.sender, progress)?;
        cuts.push((cut.name, samples(&evaluation)));
    }
    Ok(cuts)
}

fn samples(evaluation: &Evaluation) -> Vec<Sample> {
    let results = evaluation.results.iter();
    results.map(EpisodeResult::sample).collect()
}

impl Traced {
    /// The episodes with or without a fall.
    fn of(&self, fell: bool) -> impl Iterator<Item = &[TracedFrame]> + Clone {
        let results = self.raw.results.iter();
        let chosen = results.filter(move |result| result.failure.is_some() == fell);
        chosen.map(|result| self.episodes[result.episode].as_slice())
    }

    /// Frames of episodes without a fall, once the robot has settled.
    fn standing(&self) -> impl Iterator<Item = &TracedFrame> + Clone {
        self.of(false)
            .flat_map(|frames| frames.iter().skip(SETTLING))
    }

    /// Frames whose episode ends in a fall so many frames later.
    fn before_falls(
        &self,
        (from, to): (usize, usize),
    ) -> impl Iterator<Item = &TracedFrame> + Clone {
        self.of(true).flat_map(move |frames| {
            let at = |lead: usize| frames.len().saturating_sub(lead);
            &frames[at(to)..at(from)]
        })
    }
}

fn falls(traced: &[Traced], nominal: &OperatingPoint, rate: f64, seed: u64) -> Falls {
    let raw: Vec<Sample> = traced.iter().flat_map(|one| samples(&one.raw)).collect();
    let ends = traced.iter().flat_map(|one| one.of(true));
    let widest = (LEADS[0].0, LEADS[LEADS.len() - 1].1);
    let before = traced.iter().flat_map(|one| one.before_falls(widest));
    let ever = traced.iter().flat_map(|one| one.episodes.iter().flatten());
    let standing = traced.iter().flat_map(Traced::standing);
    let tilted = quantile_of(standing.clone().map(|frame| frame.tilt).collect(), TILTED);
    Falls {
        conditions: traced.iter().map(|one| one.condition.name()).collect(),
        episodes: raw.len(),
        falls: failures(&raw),
        directions: Directions::of(ends.clone()),
        mirrored: traced.iter().map(|one| one.mirrored).sum(),
        reach_before: Reaches::shares(before.map(|frame| frame.reach)),
        reach_ever: Reaches::shares(ever.map(|frame| frame.reach)),
        standing: OperatingPoint::of(standing),
        seconds_from_tilt: tilted
            .and_then(|tilted| frames_from_tilt(ends, tilted))
            .map(|frames| frames / rate),
        tilted,
        signals: SIGNALS
            .iter()
            .filter_map(|(name, value)| signal(name, traced, |frame| value(frame, nominal)))
            .collect(),
        cuts: cut_falls(traced, &raw, seed),
    }
}

/// Median number of frames in which the tilt stays above `tilted` before the fall.
fn frames_from_tilt<'a>(ends: impl Iterator<Item = &'a [TracedFrame]>, tilted: f64) -> Option<f64> {
    let tilting = |frames: &[TracedFrame]| {
        let last = frames.iter().rev();
        last.take_while(|frame| frame.tilt > tilted).count() as f64
    };
    quantile_of(ends.map(tilting).collect(), 0.5)
}

/// The falls with each cut, over the episodes of all conditions.
fn cut_falls(traced: &[Traced], raw: &[Sample], seed: u64) -> Vec<CutFalls> {
    let names = traced.first().map_or(&[][..], |one| &one.cuts);
    let row = |(index, (name, _)): (usize, &(String, Vec<Sample>))| {
        let cut = traced.iter().flat_map(|one| &one.cuts[index].1);
        let cut: Vec<Sample> = cut.cloned().collect();
        let Interval { mean, low, high } = paired_difference(&cut, raw, seed).suc;
        CutFalls {
            name: name.clone(),
            falls: failures(&cut),
            change: Interval {
                mean: -mean,
                low: -high,
                high: -low,
            },
        }
    };
    names.iter().enumerate().map(row).collect()
}

impl Directions {
    fn of<'a>(falls: impl Iterator<Item = &'a [TracedFrame]>) -> Self {
        let mut directions = Self::default();
        for lean in falls.filter_map(|frames| Some(frames.last()?.lean)) {
            let count = match (lean.x.abs() > lean.y.abs(), lean.x > 0.0, lean.y > 0.0) {
                (true, true, _) => &mut directions.forward,
                (true, false, _) => &mut directions.backward,
                (false, _, true) => &mut directions.left,
                (false, _, false) => &mut directions.right,
            };
            *count += 1;
        }
        directions
    }
}

impl Sum for Directions {
    fn sum<I: Iterator<Item = Self>>(all: I) -> Self {
        all.fold(Self::default(), |sum, one| Self {
            forward: sum.forward + one.forward,
            backward: sum.backward + one.backward,
            left: sum.left + one.left,
            right: sum.right + one.right,
        })
    }
}

impl OperatingPoint {
    /// Of frames in which the robot stands; none of none.
    fn of<'a>(standing: impl Iterator<Item = &'a TracedFrame> + Clone) -> Option<Self> {
        let measured = spread(standing.clone().map(|frame| frame.measured_com))?;
        let quasi_static = spread(standing.map(|frame| frame.static_com))?;
        Some(Self {
            measured: measured[0],
            measured_deviation: measured[1],
            quasi_static: quasi_static[0],
            quasi_static_deviation: quasi_static[1],
        })
    }
}

/// Mean and standard deviation by axis; none of none.
fn spread(points: impl Iterator<Item = Vector2<f64>>) -> Option<[[f64; 2]; 2]> {
    let points: Vec<Vector2<f64>> = points.collect();
    if points.is_empty() {
        return None;
    }
    let count = points.len() as f64;
    let mean = points.iter().sum::<Vector2<f64>>() / count;
    let squares = points
        .iter()
        .map(|point| (point - mean).component_mul(&(point - mean)));
    let deviation = (squares.sum::<Vector2<f64>>() / count).map(f64::sqrt);
    Some([mean.into(), deviation.into()])
}

/// A number of a frame, none where it is not known.
type Value = fn(&TracedFrame, &OperatingPoint) -> Option<f64>;

/// Names of signs of falls, and their values.
const SIGNALS: [(&str, Value); 10] = [
    ("static CoM: distance from the feet's middle", |frame, _| {
        Some(frame.static_com.norm())
    }),
    (
        "static CoM: distance from its usual place",
        |frame, usual| Some((frame.static_com - Vector2::from(usual.quasi_static)).norm()),
    ),
    ("static CoM: backward", |frame, _| Some(-frame.static_com.x)),
    ("static CoM: to the right", |frame, _| {
        Some(-frame.static_com.y)
    }),
    (
        "measured CoM: distance from the feet's middle",
        |frame, _| Some(frame.measured_com.norm()),
    ),
    (
        "measured CoM: distance from its usual place",
        |frame, usual| Some((frame.measured_com - Vector2::from(usual.measured)).norm()),
    ),
    ("measured CoM: backward", |frame, _| {
        Some(-frame.measured_com.x)
    }),
    ("measured CoM: to the right", |frame, _| {
        Some(-frame.measured_com.y)
    }),
    ("tilt", |frame, _| Some(frame.tilt)),
    ("regloss", |frame, _| frame.regloss),
];

/// A sign's areas, each condition by itself and then averaged; none where the value is not known.
fn signal(
    name: &'static str,
    traced: &[Traced],
    value: impl Fn(&TracedFrame) -> Option<f64>,
) -> Option<Signal> {
    let values = |frames: &mut dyn Iterator<Item = &TracedFrame>| -> Vec<f64> {
        frames.filter_map(&value).collect()
    };
    let mut frames = [0; LEADS.len()];
    let mut sums = [0.0; LEADS.len()];
    let mut is_known = false;
    for one in traced {
        let standing = values(&mut one.standing());
        is_known |= !standing.is_empty();
        for (band, lead) in LEADS.into_iter().enumerate() {
            let before = values(&mut one.before_falls(lead));
            if let Some(area) = auroc(&before, &standing) {
                frames[band] += before.len();
                sums[band] += before.len() as f64 * area;
            }
        }
    }
    let mean = |band: usize| (frames[band] > 0).then(|| sums[band] / frames[band] as f64);
    is_known.then(|| Signal {
        name,
        auroc: std::array::from_fn(mean),
        frames,
    })
}
