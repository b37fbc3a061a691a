//! The paper's metrics (section VI), and what a filter takes for them, over the executed frames of each episode: those up to
//! and including the fall, or the clip's end.
//!
//! Clips of one recording, and one clip under several conditions, are not independent. The interval of SUC is Clopper and
//! Pearson's over episodes; every other interval, and every paired difference, comes from resampling whole *motions*
//! (recordings and procedural motions), each with all its clips and conditions.

use std::collections::HashMap;

use emp_models::observation::roll_pitch_yaw;
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::Reading;
use crate::quantile::quantile;

/// Resamples of a bootstrap.
const RESAMPLES: usize = 2000;
/// Ends of a 95 % interval.
const QUANTILES: [f64; 2] = [0.025, 0.975];
/// Halvings by which an end of SUC's interval is found, to a billionth.
const HALVINGS: usize = 30;

/// Which way a metric should go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Better {
    /// Up.
    More,
    /// Down.
    Less,
}

/// What a metric is called.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Metric {
    /// As in JSON and CSV.
    pub name: &'static str,
    /// As a table's column says.
    pub label: &'static str,
    /// Its unit; empty if it has none.
    pub unit: &'static str,
    /// Which way it should go.
    pub better: Better,
}

/// Declares the metrics once: the struct, its order and [`LIST`].
macro_rules! metrics {
    ($($(#[$doc:meta])* $name:ident: $label:literal, $unit:literal, $better:ident;)+) => {
        /// One value for each metric.
        #[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
        pub struct Metrics<T> {
            $($(#[$doc])* pub $name: T,)+
        }

        /// Number of metrics.
        pub const METRICS: usize = [$(stringify!($name)),+].len();

        /// The metrics in the order of the fields of [`Metrics`].
        pub const LIST: [Metric; METRICS] = [$(Metric {
            name: stringify!($name),
            label: $label,
            unit: $unit,
            better: Better::$better,
        }),+];

        impl<T> Metrics<T> {
            /// The values in the order of [`LIST`].
            pub fn array(self) -> [T; METRICS] {
                [$(self.$name),+]
            }
        }

        impl<T> From<[T; METRICS]> for Metrics<T> {
            fn from([$($name),+]: [T; METRICS]) -> Self {
                Self { $($name),+ }
            }
        }
    };
}

metrics! {
    /// Share of episodes in which the robot stood to the end.
    suc: "SUC", "", More;
    /// exp(−‖q − g‖₂) over the goal joints, g the goal that was asked for, rad.
    mjp: "MJP", "", More;
    /// Sum over touching pairs of the robot's own links of the norm of their contact force, N (erratum E6).
    msc: "MSC", "N", Less;
    /// Share of frames in which such links touched.
    self_collision_share: "self-collision", "", Less;
    /// exp(−10 ‖v‖₂²), v the base's velocity, m/s.
    mbv: "MBV", "", More;
    /// `exp(−3 ‖v_t − v_{t−1}‖₂)`.
    mba: "MBA", "", More;
    /// exp(−10 (|roll| + |pitch|)).
    mbo: "MBO", "", More;
    /// `‖q̇_t − q̇_{t−1}‖₂²` over the goal joints, (rad/s)².
    mus: "MUS", "(rad/s)²", Less;
    /// Mean of |ĝ − g| over the goal joints, ĝ the goal that was executed, rad.
    change: "mean change", "rad", Less;
    /// `‖ĝ − g‖₂ / ‖g − g₀‖₂` over all frames at once (relL2), g₀ the default pose.
    relative_change: "relL2", "", Less;
    /// (g − ĝ)·(g − g₀) / ‖g − g₀‖₂² over all frames at once: the share of the motion's amplitude that is lost.
    amplitude_loss: "amplitude lost", "", Less;
    /// Share of frames in which ĝ was not g.
    changed_share: "frames changed", "", Less;
}

impl Metric {
    /// The head of a table's column: label, unit and direction.
    pub fn heading(&self) -> String {
        let arrow = match self.better {
            Better::More => "↑",
            Better::Less => "↓",
        };
        let parts = [self.label, self.unit, arrow];
        let parts = parts.into_iter().filter(|part| !part.is_empty());
        parts.collect::<Vec<_>>().join(" ")
    }
}

/// The paper's metrics: the first of [`LIST`], which a table of results shows.
const PAPER: usize = 8;

/// Heads of a results table's columns: those of the paper's metrics, SUC's with its interval.
pub fn headings() -> [String; PAPER] {
    let mut headings = std::array::from_fn(|metric| LIST[metric].heading());
    headings[0] += " (95 %)";
    headings
}

impl Metrics<Interval> {
    /// The cells below [`headings`].
    pub fn cells(&self) -> [String; PAPER] {
        let values = self.array();
        std::array::from_fn(|metric| match (metric, values[metric]) {
            (0, Interval { mean, low, high }) => format!("{mean:.3} ({low:.3}–{high:.3})"),
            (_, Interval { mean, .. }) => format!("{mean:.3}"),
        })
    }
}

/// What the frames of one episode add up to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct EpisodeSums {
    /// Frames that were measured.
    pub frames: usize,
    /// `suc` is 1 if the robot stood to the end, else 0; the others are sums over the frames: of ‖ĝ − g‖² for
    /// `relative_change`, of (g − ĝ)·(g − g₀) for `amplitude_loss`.
    pub sums: Metrics<f64>,
    /// Sum of ‖g − g₀‖², rad².
    pub amplitude: f64,
}

/// One executed frame.
#[derive(Clone, Copy, Debug)]
pub struct Frame<'a> {
    /// What was measured at its end.
    pub reading: &'a Reading,
    /// The goal g that was asked for, before any filter, rad.
    pub goal: &'a [f32],
    /// The goal ĝ that was executed, rad.
    pub executed: &'a [f32],
    /// The default pose g₀ of the goal joints, rad.
    pub default: &'a [f32],
    /// Speeds of the goal joints at the end of the frame before, rad/s.
    pub speeds_before: &'a [f32],
}

impl EpisodeSums {
    /// Adds a frame.
    pub fn add(&mut self, frame: &Frame<'_>) {
        let Frame {
            reading,
            goal,
            executed,
            default,
            speeds_before,
        } = frame;
        let sums = &mut self.sums;
        self.frames += 1;
        sums.mjp += (-square_distance(&reading.joint_positions, goal).sqrt()).exp();
        sums.msc += reading.self_contact.force;
        sums.self_collision_share += f64::from(u8::from(reading.self_contact.touched));
        sums.mbv += (-10.0 * reading.linear_velocity.norm_squared()).exp();
        sums.mba += (-3.0 * reading.velocity_change.norm()).exp();
        let [roll, pitch, _] = roll_pitch_yaw(&reading.orientation);
        sums.mbo += (-10.0 * (roll.abs() + pitch.abs())).exp();
        sums.mus += square_distance(&reading.joint_velocities, speeds_before);

        let differences = executed.iter().zip(*goal).map(|(a, b)| f64::from(a - b));
        let sizes = differences.clone().map(f64::abs);
        sums.change += sizes.sum::<f64>() / goal.len().max(1) as f64;
        sums.relative_change += square_distance(executed, goal);
        let offsets = goal.iter().zip(*default).map(|(a, b)| f64::from(a - b));
        let along = differences
            .zip(offsets)
            .map(|(change, offset)| -change * offset);
        sums.amplitude_loss += along.sum::<f64>();
        sums.changed_share += f64::from(u8::from(executed != goal));
        self.amplitude += square_distance(goal, default);
    }

    /// The episode's own metrics: means over its frames.
    pub fn means(&self) -> Metrics<f64> {
        let mut total = Total::default();
        total.add(self);
        total.means()
    }
}

/// Sum of squared differences over the joints that `b` has: the goal joints, which stand first in `a`.
fn square_distance(a: &[f32], b: &[f32]) -> f64 {
    let differences = a.iter().zip(b).map(|(a, b)| f64::from(a - b));
    differences.map(|difference| difference * difference).sum()
}

/// What several episodes add up to.
#[derive(Clone, Copy, Debug, Default)]
struct Total {
    episodes: f64,
    frames: f64,
    amplitude: f64,
    sums: [f64; METRICS],
}

impl Total {
    fn add(&mut self, episode: &EpisodeSums) {
        self.episodes += 1.0;
        self.frames += episode.frames as f64;
        self.amplitude += episode.amplitude;
        for (sum, value) in self.sums.iter_mut().zip(episode.sums.array()) {
            *sum += value;
        }
    }

    /// All of them together.
    fn of<'a>(totals: impl IntoIterator<Item = &'a Self>) -> Self {
        let mut all = Self::default();
        for total in totals {
            all.episodes += total.episodes;
            all.frames += total.frames;
            all.amplitude += total.amplitude;
            for (sum, value) in all.sums.iter_mut().zip(total.sums) {
                *sum += value;
            }
        }
        all
    }

    fn failures(&self) -> f64 {
        self.episodes - Metrics::from(self.sums).suc
    }

    /// SUC over the episodes, the other metrics over all their frames; 0 of none.
    fn means(&self) -> Metrics<f64> {
        let share = |sum: f64, of: f64| if of > 0.0 { sum / of } else { 0.0 };
        let sums = Metrics::from(self.sums);
        let mut means = Metrics::from(self.sums.map(|sum| share(sum, self.frames)));
        means.suc = share(sums.suc, self.episodes);
        means.relative_change = share(sums.relative_change, self.amplitude).sqrt();
        means.amplitude_loss = share(sums.amplitude_loss, self.amplitude);
        means
    }
}

/// One episode: which motion it played, and what its frames add up to.
#[derive(Clone, Debug, PartialEq)]
pub struct Sample {
    /// The recording or procedural motion; episodes of one are not independent.
    pub motion: String,
    /// What the frames add up to.
    pub sums: EpisodeSums,
}

/// The totals of each motion, in the order in which motions first appear.
fn by_motion(samples: &[Sample]) -> Vec<Total> {
    let mut places: HashMap<&str, usize> = HashMap::new();
    let mut totals = Vec::new();
    for Sample { motion, sums } in samples {
        let place = *places.entry(motion).or_insert(totals.len());
        if place == totals.len() {
            totals.push(Total::default());
        }
        totals[place].add(sums);
    }
    totals
}

/// Number of motions among the episodes: of what an interval rests on.
pub fn motions(samples: &[Sample]) -> usize {
    by_motion(samples).len()
}

/// Number of episodes in which the robot did not stand to the end.
pub fn failures(samples: &[Sample]) -> usize {
    let failed = |sample: &&Sample| sample.sums.sums.suc == 0.0;
    samples.iter().filter(failed).count()
}

/// The totals of each motion, ours and theirs.
fn pairs(ours: &[Sample], theirs: &[Sample]) -> Vec<[Total; 2]> {
    let motions = |samples: &[Sample]| -> Vec<String> {
        samples.iter().map(|sample| sample.motion.clone()).collect()
    };
    assert_eq!(motions(ours), motions(theirs), "episodes come in pairs");
    let pairs = by_motion(ours).into_iter().zip(by_motion(theirs));
    pairs.map(|(ours, theirs)| [ours, theirs]).collect()
}

/// A mean and its 95 % interval.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Interval {
    /// The mean.
    pub mean: f64,
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

/// The metrics of a set of episodes: SUC with Clopper and Pearson's interval over episodes, the others with intervals from
/// resampling motions; zeros of none. The same episodes and seed give the same numbers.
pub fn summary(samples: &[Sample], seed: u64) -> Metrics<Interval> {
    let totals = by_motion(samples);
    let statistic = |sample: &[usize]| {
        let chosen = sample.iter().map(|&motion| &totals[motion]);
        Total::of(chosen).means().array()
    };
    let mut summary = Metrics::from(intervals(totals.len(), seed, statistic));
    let all = Total::of(&totals);
    summary.suc = clopper_pearson(all.episodes - all.failures(), all.episodes);
    summary
}

/// The difference `ours − theirs` of the metrics on the same episodes, pair by pair: intervals from resampling motions.
///
/// # Panics
/// If the two are not on the same motions in the same order.
pub fn paired_difference(ours: &[Sample], theirs: &[Sample], seed: u64) -> Metrics<Interval> {
    let pairs = pairs(ours, theirs);
    let difference = |sample: &[usize]| {
        let [ours, theirs] = [0, 1].map(|side| {
            let chosen = sample.iter().map(|&motion| &pairs[motion][side]);
            Total::of(chosen).means().array()
        });
        std::array::from_fn(|metric| ours[metric] - theirs[metric])
    };
    intervals(pairs.len(), seed, difference).into()
}

/// The share of `theirs` failures that `ours` does without, on the same episodes: 1 − ours/theirs, with its interval from
/// resampling motions; below 0 if there are more. None where they fail in no episode.
///
/// # Panics
/// If the two are not on the same motions in the same order.
pub fn failures_cut(ours: &[Sample], theirs: &[Sample], seed: u64) -> Option<Interval> {
    let pairs = pairs(ours, theirs);
    let cut = |sample: &[usize]| {
        let [ours, theirs] = [0, 1].map(|side| -> f64 {
            let chosen = sample.iter().map(|&motion| pairs[motion][side].failures());
            chosen.sum()
        });
        // A resample without failures has none to cut.
        [if theirs > 0.0 {
            1.0 - ours / theirs
        } else {
            0.0
        }]
    };
    let failures: f64 = pairs.iter().map(|[_, theirs]| theirs.failures()).sum();
    let [interval] = intervals(pairs.len(), seed, cut);
    (failures > 0.0).then_some(interval)
}

/// The exact interval of a share: the chances of success for which so many or more, and so many or fewer, are not rarer than
/// 2.5 %.
fn clopper_pearson(successes: f64, episodes: f64) -> Interval {
    let (k, n) = (successes as usize, episodes as usize);
    if n == 0 {
        return Interval::default();
    }
    let [tail, _] = QUANTILES;
    Interval {
        mean: successes / episodes,
        low: match k {
            0 => 0.0,
            _ => crossing(|chance| at_least(k, n, chance) < tail),
        },
        // So many or fewer successes are so many or more failures.
        high: match n - k {
            0 => 1.0,
            failures => crossing(|chance| at_least(failures, n, 1.0 - chance) > tail),
        },
    }
}

/// The chance of at least `k` successes in `n` trials.
fn at_least(k: usize, n: usize, chance: f64) -> f64 {
    let (yes, no) = (chance.ln(), (1.0 - chance).ln());
    let mut ways = 0.0; // Logarithm of the binomial coefficient.
    let mut sum = 0.0;
    for i in 0..=n {
        if i > 0 {
            ways += ((n - i + 1) as f64 / i as f64).ln();
        }
        if i >= k {
            sum += (ways + i as f64 * yes + (n - i) as f64 * no).exp();
        }
    }
    sum
}

/// The number between 0 and 1 below which `is_below` holds.
fn crossing(is_below: impl Fn(f64) -> bool) -> f64 {
    let (mut low, mut high) = (0.0, 1.0);
    for _ in 0..HALVINGS {
        let middle = 0.5 * (low + high);
        if is_below(middle) {
            low = middle;
        } else {
            high = middle;
        }
    }
    low
}

/// A statistic of `count` motions, with intervals from resampling them.
fn intervals<const N: usize>(
    count: usize,
    seed: u64,
    statistic: impl Fn(&[usize]) -> [f64; N],
) -> [Interval; N] {
    let mut sample: Vec<usize> = (0..count).collect();
    let whole = statistic(&sample);
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut resampled: [Vec<f64>; N] = std::array::from_fn(|_| Vec::new());
    for _ in 0..RESAMPLES {
        for index in &mut sample {
            *index = rng.random_range(0..count);
        }
        for (values, value) in resampled.iter_mut().zip(statistic(&sample)) {
            values.push(value);
        }
    }
    std::array::from_fn(|index| {
        let values = &mut resampled[index];
        values.sort_by(f64::total_cmp);
        let [low, high] = QUANTILES.map(|share| quantile(values, share).unwrap_or_default());
        Interval {
            mean: whole[index],
            low,
            high,
        }
    })
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};

    use super::*;

    fn reading() -> Reading {
        Reading {
            joint_positions: vec![0.3, -0.4, 9.0],
            joint_velocities: vec![1.0, 2.0, 7.0],
            orientation: UnitQuaternion::from_euler_angles(0.02, -0.03, 1.0),
            linear_velocity: Vector3::new(0.1, 0.0, -0.2),
            velocity_change: Vector3::new(0.0, 0.3, 0.4),
            self_contact: crate::SelfContact {
                force: 13.0,
                touched: true,
            },
            ..Reading::default()
        }
    }

    fn still() -> Reading {
        Reading {
            joint_positions: vec![0.0; 3],
            joint_velocities: vec![0.0; 3],
            ..Reading::default()
        }
    }

    fn close(a: Metrics<f64>, b: [f64; METRICS]) {
        for ((Metric { name, .. }, a), b) in LIST.iter().zip(a.array()).zip(b) {
            // Angles and speeds are single precision.
            assert!((a - b).abs() < 1e-6, "{name}: {a}, expected {b}");
        }
    }

    #[test]
    fn one_frame_by_hand() {
        let mut sums = EpisodeSums::default();
        sums.add(&Frame {
            reading: &reading(),
            goal: &[0.0, 0.0],
            executed: &[0.1, -0.3],
            default: &[-0.5, 1.0],
            speeds_before: &[0.5, 1.0],
        });
        let expected = [
            0.0,
            0.606_530_659_7, // exp(−0.5)
            13.0,            //
            1.0,             //
            0.606_530_659_7, // exp(−10 · 0.05)
            0.223_130_160_1, // exp(−3 · 0.5)
            0.606_530_659_7, // exp(−10 · 0.05)
            1.25,            // 0.5² + 1²
            0.2,             // (0.1 + 0.3) / 2
            0.282_842_712_5, // √(0.1² + 0.3²) / √(0.5² + 1²)
            -0.28,           // (−0.1 · 0.5 + 0.3 · −1) / 1.25
            1.0,
        ];
        close(sums.means(), expected);
    }

    #[test]
    fn means_are_over_frames_and_success_is_over_episodes() {
        let mut fell = EpisodeSums::default();
        fn frame(reading: &Reading) -> Frame<'_> {
            Frame {
                reading,
                goal: &[0.0, 0.0],
                executed: &[0.0, 0.0],
                default: &[0.0, 0.0],
                speeds_before: &[0.0, 0.0],
            }
        }
        fell.add(&frame(&reading()));
        let mut stood = EpisodeSums::default();
        for _ in 0..3 {
            stood.add(&frame(&still()));
        }
        stood.sums.suc = 1.0;
        let expected = [
            0.5,
            (0.606_530_659_7 + 3.0) / 4.0,
            13.0 / 4.0,
            0.25,
            (0.606_530_659_7 + 3.0) / 4.0,
            (0.223_130_160_1 + 3.0) / 4.0,
            (0.606_530_659_7 + 3.0) / 4.0,
            5.0 / 4.0,
            0.0,
            0.0,
            0.0,
            0.0,
        ];
        let samples = [("a", fell), ("b", stood)].map(|(motion, sums)| Sample {
            motion: motion.to_owned(),
            sums,
        });
        let summary = summary(&samples, 1);
        close(
            Metrics::from(summary.array().map(|interval| interval.mean)),
            expected,
        );
        // Resamples of two motions: both, or either one twice.
        assert_eq!((summary.msc.low, summary.msc.high), (0.0, 13.0));
    }

    /// Episodes of a motion each.
    fn coins(count: usize, heads: usize) -> Vec<Sample> {
        let sums = |i: usize| EpisodeSums {
            frames: 100,
            sums: Metrics {
                suc: f64::from(u8::from(i < heads)),
                mjp: 80.0 + (i % 5) as f64,
                ..Metrics::default()
            },
            amplitude: 1.0,
        };
        let sample = |i: usize| Sample {
            motion: i.to_string(),
            sums: sums(i),
        };
        (0..count).map(sample).collect()
    }

    #[test]
    fn a_cut_loses_its_share_of_the_amplitude_and_nothing_across() {
        let mut sums = EpisodeSums::default();
        let default = [0.1, -0.2];
        for t in 0..20 {
            let goal = [0.1 + 0.05 * t as f32, -0.2 - 0.02 * t as f32];
            let executed = [0, 1].map(|j| default[j] + 0.9 * (goal[j] - default[j]));
            sums.add(&Frame {
                reading: &still(),
                goal: &goal,
                executed: &executed,
                default: &default,
                speeds_before: &[0.0, 0.0],
            });
        }
        let means = sums.means();
        assert!((means.relative_change - 0.1).abs() < 1e-6, "{means:?}");
        assert!((means.amplitude_loss - 0.1).abs() < 1e-6, "{means:?}");
        // The mean of 0.1 · 0.035 · t over t.
        assert!((means.change - 0.1 * 0.035 * 9.5).abs() < 1e-6, "{means:?}");
        // The first goal is the default pose, which a cut leaves.
        assert!((means.changed_share - 0.95).abs() < 1e-12);
    }

    #[test]
    fn failures_are_cut_by_the_share_that_is_gone() {
        let (few, many) = (coins(400, 390), coins(400, 360));
        let cut = failures_cut(&few, &many, 5).unwrap();
        assert!((cut.mean - 0.75).abs() < 1e-12, "{cut:?}");
        assert!(cut.low > 0.55 && cut.low < 0.7 && cut.high < 0.9, "{cut:?}");
        let more = failures_cut(&many, &few, 5).unwrap();
        assert!(
            (more.mean + 3.0).abs() < 1e-12 && more.high < 0.0,
            "{more:?}"
        );
        assert_eq!(failures_cut(&many, &coins(400, 400), 5), None);
        assert_eq!(failures_cut(&[], &[], 5), None);
    }

    #[test]
    fn the_interval_of_a_share_is_clopper_and_pearsons() {
        for (heads, count, low, high) in [
            (360, 400, 0.866_322, 0.927_594),
            (155, 155, 0.976_482, 1.0),
            (0, 10, 0.0, 0.308_497),
            (1, 2, 0.012_579, 0.987_421),
        ] {
            let suc = summary(&coins(count, heads), 7).suc;
            assert!((suc.low - low).abs() < 2e-6, "{heads} of {count}: {suc:?}");
            assert!(
                (suc.high - high).abs() < 2e-6,
                "{heads} of {count}: {suc:?}"
            );
        }
        assert_eq!(summary(&[], 7).suc, Interval::default());
    }

    #[test]
    fn a_motion_played_ten_times_is_one_unit() {
        let once = coins(20, 15);
        let often: Vec<Sample> = (0..10).flat_map(|_| once.clone()).collect();
        assert_eq!((motions(&once), motions(&often)), (20, 20));
        let theirs = coins(20, 10);
        let often_theirs: Vec<Sample> = (0..10).flat_map(|_| theirs.clone()).collect();
        let near = |a: Interval, b: Interval| {
            let pairs = [(a.mean, b.mean), (a.low, b.low), (a.high, b.high)];
            assert!(
                pairs.iter().all(|(a, b)| (a - b).abs() < 1e-12),
                "{a:?} {b:?}"
            );
        };
        near(summary(&once, 7).mjp, summary(&often, 7).mjp);
        near(
            failures_cut(&once, &theirs, 7).unwrap(),
            failures_cut(&often, &often_theirs, 7).unwrap(),
        );
        near(
            paired_difference(&once, &theirs, 7).suc,
            paired_difference(&often, &often_theirs, 7).suc,
        );
        // Ten times as many motions would have told more.
        let many = coins(200, 150);
        let width = |interval: Interval| interval.high - interval.low;
        assert!(width(summary(&many, 7).mjp) < 0.5 * width(summary(&often, 7).mjp));
        assert_eq!(summary(&once, 7), summary(&once, 7));
        assert_ne!(summary(&once, 7).mjp, summary(&once, 8).mjp);
    }

    #[test]
    fn pairs_tell_a_difference_that_intervals_of_each_do_not() {
        let theirs = coins(200, 150);
        let mut ours = theirs.clone();
        for episode in &mut ours {
            episode.sums.sums.mjp += 0.2;
        }
        let difference = paired_difference(&ours, &theirs, 3);
        assert!((difference.mjp.low - 0.002).abs() < 1e-12);
        assert!((difference.mjp.high - 0.002).abs() < 1e-12);
        assert_eq!(difference.suc, Interval::default());
        let apart = [summary(&ours, 3).mjp, summary(&theirs, 3).mjp];
        assert!(apart[0].low < apart[1].high, "they overlap");
    }

    #[test]
    fn headings_say_unit_and_direction() {
        assert_eq!(
            headings().join(" | "),
            "SUC ↑ (95 %) | MJP ↑ | MSC N ↓ | self-collision ↓ | MBV ↑ | MBA ↑ | MBO ↑ | MUS (rad/s)² ↓"
        );
        let cells = summary(&coins(400, 360), 7).cells();
        assert_eq!(cells[..2], ["0.900 (0.866–0.928)", "0.820"]);
    }
}
