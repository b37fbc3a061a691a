//! The paper's metrics (section VI), and what a filter takes for them, over the executed frames of each episode: those up to
//! and including the fall, or the clip's end.

use emp_models::observation::roll_pitch_yaw;
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::Reading;

/// Resamples of a bootstrap.
const RESAMPLES: usize = 2000;
/// Ends of a 95 % interval.
const QUANTILES: [f64; 2] = [0.025, 0.975];

/// Number of metrics.
pub const METRICS: usize = 12;

/// One value for each metric.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Metrics<T> {
    /// Share of episodes in which the robot stood to the end; more is better.
    pub suc: T,
    /// exp(−‖q − g‖₂) over the goal joints, g the goal that was asked for, rad; more is better.
    pub mjp: T,
    /// Norm of the summed contact force between the robot's own links, N; less is better.
    pub msc: T,
    /// Share of frames in which such links touched; less is better.
    pub self_collision_share: T,
    /// exp(−10 ‖v‖₂²), v the base's velocity, m/s; more is better.
    pub mbv: T,
    /// `exp(−3 ‖v_t − v_{t−1}‖₂)`; more is better.
    pub mba: T,
    /// exp(−10 (|roll| + |pitch|)); more is better.
    pub mbo: T,
    /// `‖q̇_t − q̇_{t−1}‖₂²` over the goal joints, (rad/s)²; less is better.
    pub mus: T,
    /// Mean of |ĝ − g| over the goal joints, ĝ the goal that was executed, rad; less is better.
    pub change: T,
    /// `‖ĝ − g‖₂ / ‖g − g₀‖₂` over all frames at once (relL2), g₀ the default pose; less is better.
    pub relative_change: T,
    /// (g − ĝ)·(g − g₀) / ‖g − g₀‖₂² over all frames at once: the share of the motion's amplitude that is lost; less is
    /// better.
    pub amplitude_loss: T,
    /// Share of frames in which ĝ was not g.
    pub changed_share: T,
}

impl<T> Metrics<T> {
    /// Names of the metrics, in the order of the fields.
    pub const NAMES: [&'static str; METRICS] = [
        "suc",
        "mjp",
        "msc",
        "self_collision_share",
        "mbv",
        "mba",
        "mbo",
        "mus",
        "change",
        "relative_change",
        "amplitude_loss",
        "changed_share",
    ];

    /// The values in the order of the fields.
    pub fn array(self) -> [T; METRICS] {
        [
            self.suc,
            self.mjp,
            self.msc,
            self.self_collision_share,
            self.mbv,
            self.mba,
            self.mbo,
            self.mus,
            self.change,
            self.relative_change,
            self.amplitude_loss,
            self.changed_share,
        ]
    }
}

impl<T> From<[T; METRICS]> for Metrics<T> {
    fn from(values: [T; METRICS]) -> Self {
        let [
            suc,
            mjp,
            msc,
            self_collision_share,
            mbv,
            mba,
            mbo,
            mus,
            change,
            relative_change,
            amplitude_loss,
            changed_share,
        ] = values;
        Self {
            suc,
            mjp,
            msc,
            self_collision_share,
            mbv,
            mba,
            mbo,
            mus,
            change,
            relative_change,
            amplitude_loss,
            changed_share,
        }
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
        sums.msc += reading.self_contact.force.norm();
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
        means([self])
    }
}

/// Sum of squared differences over the joints that `b` has: the goal joints, which stand first in `a`.
fn square_distance(a: &[f32], b: &[f32]) -> f64 {
    let differences = a.iter().zip(b).map(|(a, b)| f64::from(a - b));
    differences.map(|difference| difference * difference).sum()
}

/// SUC over the episodes, the other metrics over all their frames; 0 of none.
fn means<'a>(episodes: impl IntoIterator<Item = &'a EpisodeSums>) -> Metrics<f64> {
    let (mut count, mut frames, mut amplitude) = (0, 0, 0.0);
    let mut sums = [0.0; METRICS];
    for episode in episodes {
        count += 1;
        frames += episode.frames;
        amplitude += episode.amplitude;
        for (sum, value) in sums.iter_mut().zip(episode.sums.array()) {
            *sum += value;
        }
    }
    let sums = Metrics::from(sums);
    let of_amplitude = |sum: f64| {
        if amplitude > 0.0 {
            sum / amplitude
        } else {
            0.0
        }
    };
    let mut means = Metrics::from(sums.array().map(|sum| sum / frames.max(1) as f64));
    means.suc = sums.suc / f64::from(count.max(1));
    means.relative_change = of_amplitude(sums.relative_change).sqrt();
    means.amplitude_loss = of_amplitude(sums.amplitude_loss);
    means
}

/// A mean and its 95 % bootstrap interval.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Interval {
    /// The mean.
    pub mean: f64,
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

/// The metrics of a set of episodes, with intervals from resampling whole episodes; zeros of none.
///
/// The same episodes and seed give the same numbers. Where every episode succeeds (or fails), so does every resample: the
/// interval of `suc` is then a point.
pub fn summary(episodes: &[EpisodeSums], seed: u64) -> Metrics<Interval> {
    let statistic = |sample: &[usize]| means(sample.iter().map(|&i| &episodes[i])).array();
    intervals(episodes.len(), seed, statistic).into()
}

/// The difference `ours − theirs` of the metrics on the same episodes, pair by pair: intervals from resampling the pairs.
///
/// # Panics
/// If there are not as many of the one as of the other.
pub fn paired_difference(
    ours: &[EpisodeSums],
    theirs: &[EpisodeSums],
    seed: u64,
) -> Metrics<Interval> {
    assert_eq!(ours.len(), theirs.len(), "episodes come in pairs");
    let difference = |sample: &[usize]| {
        let ours = means(sample.iter().map(|&i| &ours[i])).array();
        let theirs = means(sample.iter().map(|&i| &theirs[i])).array();
        std::array::from_fn(|metric| ours[metric] - theirs[metric])
    };
    intervals(ours.len(), seed, difference).into()
}

/// The share of `theirs` failures that `ours` does without, on the same episodes: 1 − ours/theirs, with its interval from
/// resampling the pairs; below 0 if there are more. None where they fail in no episode.
///
/// # Panics
/// If there are not as many of the one as of the other.
pub fn failures_cut(ours: &[EpisodeSums], theirs: &[EpisodeSums], seed: u64) -> Option<Interval> {
    assert_eq!(ours.len(), theirs.len(), "episodes come in pairs");
    let failures = |episodes: &[EpisodeSums], sample: &[usize]| {
        let stood: f64 = sample.iter().map(|&i| episodes[i].sums.suc).sum();
        sample.len() as f64 - stood
    };
    let cut = |sample: &[usize]| {
        let theirs = failures(theirs, sample);
        // A resample without failures has none to cut.
        let left = if theirs > 0.0 {
            failures(ours, sample) / theirs
        } else {
            1.0
        };
        [1.0 - left]
    };
    let all: Vec<usize> = (0..theirs.len()).collect();
    let [interval] = intervals(ours.len(), seed, cut);
    (failures(theirs, &all) > 0.0).then_some(interval)
}

/// Statistics of `count` episodes, with intervals from resampling the episodes.
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
        let [low, high] = QUANTILES.map(|share| quantile(values, share));
        Interval {
            mean: whole[index],
            low,
            high,
        }
    })
}

/// The value below which a share of sorted values lies, interpolated between neighbours.
fn quantile(sorted: &[f64], share: f64) -> f64 {
    let at = share * (sorted.len() - 1) as f64;
    let (below, above) = (sorted[at.floor() as usize], sorted[at.ceil() as usize]);
    below + at.fract() * (above - below)
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
                force: Vector3::new(3.0, -4.0, 12.0),
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
        for ((name, a), b) in Metrics::<f64>::NAMES.iter().zip(a.array()).zip(b) {
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
            13.0,            // |(3, −4, 12)|
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
        close(means([&fell, &stood]), expected);
        let summary = summary(&[fell, stood], 1);
        close(
            Metrics::from(summary.array().map(|interval| interval.mean)),
            expected,
        );
        // Resamples of two: both, or either one twice.
        assert_eq!((summary.suc.low, summary.suc.high), (0.0, 1.0));
        assert_eq!((summary.msc.low, summary.msc.high), (0.0, 13.0));
    }

    fn coins(count: usize, heads: usize) -> Vec<EpisodeSums> {
        let episode = |i: usize| EpisodeSums {
            frames: 100,
            sums: Metrics {
                suc: f64::from(u8::from(i < heads)),
                mjp: 80.0 + (i % 5) as f64,
                ..Metrics::default()
            },
            amplitude: 1.0,
        };
        (0..count).map(episode).collect()
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
    fn the_interval_of_a_share_is_the_binomials() {
        let summary = summary(&coins(400, 360), 7);
        // 0.9 ± 1.96 · √(0.9 · 0.1 / 400)
        assert!((summary.suc.low - 0.8706).abs() < 0.004, "{summary:?}");
        assert!((summary.suc.high - 0.9294).abs() < 0.004, "{summary:?}");
        assert_eq!(summary, super::summary(&coins(400, 360), 7));
        assert_ne!(summary, super::summary(&coins(400, 360), 8));
        let all = super::summary(&coins(50, 50), 7).suc;
        assert_eq!((all.low, all.mean, all.high), (1.0, 1.0, 1.0));
        assert_eq!(super::summary(&[], 7).suc, Interval::default());
    }

    #[test]
    fn pairs_tell_a_difference_that_intervals_of_each_do_not() {
        let theirs = coins(200, 150);
        let mut ours = theirs.clone();
        for episode in &mut ours {
            episode.sums.mjp += 0.2;
        }
        let difference = paired_difference(&ours, &theirs, 3);
        assert!((difference.mjp.low - 0.002).abs() < 1e-12);
        assert!((difference.mjp.high - 0.002).abs() < 1e-12);
        assert_eq!(difference.suc, Interval::default());
        let apart = [summary(&ours, 3).mjp, summary(&theirs, 3).mjp];
        assert!(apart[0].low < apart[1].high, "they overlap");
    }
}
