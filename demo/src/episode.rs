//! One run in numbers: how the robot stood, what was made of its goals, how long it waited.

use std::time::Duration;

use emp_client::{EmpMode, Percentiles};
use emp_robot::Robot;
use emp_sim::Reading;
use emp_sim::metrics::{EpisodeSums, Frame, Metrics};
use nalgebra::Vector3;
use serde::Serialize;

use crate::control::Run;
use crate::safety::{self, Action};

/// Share of its torque limit from which a motor counts as saturated.
const SATURATED: f32 = 0.999;
/// Actions of the guards that are told one by one; the summary file has them all.
const SHOWN_ACTIONS: usize = 4;

/// What is said of a run.
#[derive(Debug, Serialize)]
pub(crate) struct Episode {
    /// When the EMP changed goals: `off`, `on`, `when_danger`.
    emp_mode: String,
    /// Frames that the robot went through: all, or those up to its fall.
    pub(crate) frames: usize,
    /// The same in seconds.
    #[serde(skip)]
    seconds: f64,
    /// Whether the robot stood to the motion's end.
    stood: bool,
    /// When and why it fell, if it did.
    fall: Option<Fall>,
    /// Largest angle between the base's axis and the vertical, degrees.
    pub(crate) largest_tilt_deg: f64,
    /// Least distance of the centre of mass from the edge of the feet's support polygon, cm, negative outside; as answered, none without an answer.
    smallest_margin_cm: Option<f32>,
    /// The paper's metrics of this one episode, and what the EMP took for them; the goal that is asked for is that after the
    /// guards' ramps.
    pub(crate) metrics: Metrics<f64>,
    /// Share of motors and frames at the torque limit, 0 to 1.
    saturated_share: f64,
    /// Pushes.
    pub(crate) pushes: usize,
    /// Simulated seconds a second.
    real_time_factor: f64,
    /// From the robot's state to its new targets, milliseconds; an unanswered period counts as long as the robot waited.
    pub(crate) round_trip_ms: Percentiles,
    /// In the retargeter, milliseconds.
    retargeter_ms: Percentiles,
    /// In EMP and policy, milliseconds.
    policy_ms: Percentiles,
    /// Control periods without an answer in time, in which the robot kept the targets that it had.
    missed_periods: usize,
    /// What the guards around the stream did, and when.
    guards: Vec<Action>,
}

/// When and why the robot fell.
#[derive(Debug, Serialize)]
pub(crate) struct Fall {
    /// Since the motion began, seconds.
    pub(crate) time: f64,
    /// In words.
    pub(crate) reason: String,
}

impl Episode {
    pub(crate) fn new(robot: &Robot, run: &Run) -> Self {
        let rate = robot.control_rate_hz();
        let seconds = run.periods.len() as f64 / rate;
        let periods = || run.periods.iter();
        let times = || periods().filter_map(|period| period.answer.times);
        let margins = periods().filter_map(|period| period.answer.margin);
        let tilts = periods().map(|period| tilt(&period.reading));
        Self {
            emp_mode: run
                .periods
                .last()
                .map_or_else(String::new, |period| mode_name(period.answer.emp_mode)),
            frames: run.periods.len(),
            seconds,
            stood: run.fall.is_none(),
            fall: run.fall.map(|reason| Fall {
                time: seconds,
                reason: reason.to_string(),
            }),
            largest_tilt_deg: tilts.fold(0.0, f64::max).to_degrees(),
            smallest_margin_cm: margins.reduce(f32::min).map(|margin| 100.0 * margin),
            metrics: metrics(robot, run),
            saturated_share: saturated_share(robot, run),
            pushes: periods().filter(|period| period.pushed).count(),
            real_time_factor: seconds / run.wall_time.as_secs_f64(),
            round_trip_ms: percentiles(periods().map(|period| period.round_trip)),
            retargeter_ms: percentiles(times().map(|[retargeter, _]| retargeter)),
            policy_ms: percentiles(times().map(|[_, policy]| policy)),
            missed_periods: periods().filter(|period| !period.answered).count(),
            guards: safety::actions(
                periods().map(|period| period.answer.guards.as_slice()),
                rate,
            ),
        }
    }

    /// When and why the robot fell, if it did.
    pub(crate) fn fall(&self) -> Option<&Fall> {
        self.fall.as_ref()
    }

    /// How the robot stood, in a line.
    pub(crate) fn balance(&self) -> String {
        match &self.fall {
            None => {
                let tilt = self.largest_tilt_deg;
                let mut text = format!(
                    "stood for {:.1} s, base tilted by {tilt:.1}° at most",
                    self.seconds
                );
                if let Some(margin) = self.smallest_margin_cm {
                    text += &format!(", smallest margin of the centre of mass {margin:.1} cm");
                }
                text
            }
            Some(Fall { time, reason }) => format!("FELL after {time:.2} s: {reason}"),
        }
    }

    /// How long the robot waited, in a line.
    pub(crate) fn waiting(&self) -> String {
        let trip = &self.round_trip_ms;
        format!(
            "{:.3} × real time; round trip {:.2} ms (p50), {:.2} ms (p99); {} of {} periods missed",
            self.real_time_factor, trip.p50, trip.p99, self.missed_periods, self.frames
        )
    }

    /// What the EMP did, in a line.
    pub(crate) fn filtering(&self) -> String {
        let Metrics {
            change,
            relative_change,
            changed_share,
            ..
        } = self.metrics;
        format!(
            "{}: goals changed by {change:.3} rad on average ({} of the motion's size), in {} of frames",
            self.emp_mode,
            percent(relative_change),
            percent(changed_share)
        )
    }

    /// What the guards did, in a line.
    pub(crate) fn guarding(&self) -> String {
        if self.guards.is_empty() {
            return "did nothing".to_owned();
        }
        let action = |action: &Action| {
            let Action { from, to, what } = action;
            format!("{what} {from:.2}–{to:.2} s")
        };
        let shown = self.guards.iter().take(SHOWN_ACTIONS).map(action);
        let mut text = shown.collect::<Vec<_>>().join(", ");
        if let Some(more) = self
            .guards
            .len()
            .checked_sub(SHOWN_ACTIONS)
            .filter(|more| *more > 0)
        {
            text += &format!(", and {more} more");
        }
        text
    }

    /// The paper's metrics, in a line.
    pub(crate) fn paper(&self) -> String {
        let Metrics {
            suc,
            mjp,
            msc,
            mbv,
            mba,
            mbo,
            mus,
            ..
        } = self.metrics;
        format!(
            "SUC {suc:.0}, MJP {mjp:.3}, MSC {msc:.2} N, MBV {mbv:.3}, MBA {mba:.3}, MBO {mbo:.3}, MUS {mus:.3} (rad/s)²"
        )
    }

    /// Forces and torques, in a line.
    pub(crate) fn body(&self) -> String {
        format!(
            "touches itself in {} of frames, with {:.2} N on average; {} of torques at their limit",
            percent(self.metrics.self_collision_share),
            self.metrics.msc,
            percent(self.saturated_share)
        )
    }
}

/// Angle between the base's axis and the vertical, radians.
pub(crate) fn tilt(reading: &Reading) -> f64 {
    (reading.orientation * Vector3::z()).angle(&Vector3::z())
}

/// A mode as the summary writes it.
fn mode_name(mode: EmpMode) -> String {
    let name = mode.as_str_name();
    let name = name.strip_prefix("EMP_MODE_").unwrap_or(name);
    name.to_lowercase()
}

/// The paper's metrics, as the evaluation computes them.
fn metrics(robot: &Robot, run: &Run) -> Metrics<f64> {
    let mut sums = EpisodeSums::default();
    let default: Vec<f32> = robot.default_goal();
    let readings = run.periods.iter().map(|period| &period.reading);
    let before = std::iter::once(&run.start).chain(readings);
    for (period, before) in run.periods.iter().zip(before) {
        if period.reading.divergence.is_none() {
            sums.add(&Frame {
                reading: &period.reading,
                goal: &period.answer.goal,
                executed: &period.answer.targets.goal,
                default: &default,
                speeds_before: &before.joint_velocities[..default.len()],
            });
        }
    }
    sums.sums.suc = f64::from(u8::from(run.fall.is_none()));
    sums.means()
}

/// Share of motors and frames at the torque limit.
fn saturated_share(robot: &Robot, run: &Run) -> f64 {
    let saturated = |torques: &[f32]| {
        let motors = torques.iter().zip(robot.joints());
        motors
            .filter(|(torque, joint)| torque.abs() >= SATURATED * joint.torque_limit as f32)
            .count()
    };
    let torques = run.periods.iter().map(|period| &period.reading.torques);
    let all = run.periods.len() * robot.joints().count();
    torques.map(|torques| saturated(torques)).sum::<usize>() as f64 / all.max(1) as f64
}

fn percentiles(times: impl Iterator<Item = Duration>) -> Percentiles {
    let mut sorted: Vec<f64> = times.map(|time| 1e3 * time.as_secs_f64()).collect();
    sorted.sort_by(f64::total_cmp);
    Percentiles {
        p50: percentile(&sorted, 0.5),
        p90: percentile(&sorted, 0.9),
        p99: percentile(&sorted, 0.99),
        max: percentile(&sorted, 1.0),
    }
}

/// The smallest of sorted values that a share of them does not exceed; 0 of none.
pub(crate) fn percentile<T: Copy + Default>(sorted: &[T], share: f64) -> T {
    let rank = (share * sorted.len() as f64).ceil() as usize;
    let value = sorted.get(rank.saturating_sub(1));
    value.copied().unwrap_or_default()
}

/// A share, 0 to 1, for people.
pub(crate) fn percent(share: f64) -> String {
    format!("{:.1} %", 100.0 * share)
}
