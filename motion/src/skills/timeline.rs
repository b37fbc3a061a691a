//! Poses over time: minimum-jerk moves and enveloped cycles, joined with zero velocity and acceleration.

use nalgebra::Vector3;

use super::body::{ArmPose, Body, Pose};
use crate::{MINIMUM_JERK_PEAK, minimum_jerk};

/// Frames a second of procedural clips.
pub(super) const FPS: f64 = 50.0;
/// No move is shorter, and no strike, seconds.
const SHORTEST_MOVE: f64 = 0.2;
const SHORTEST_STRIKE: f64 = 0.14;
/// Longest rise and fall of a cycle, seconds.
const RAMP: f64 = 0.5;

/// A growing sequence of poses, one every 1/[`FPS`] seconds.
pub(super) struct Timeline {
    pub(super) poses: Vec<Pose>,
    arm_length: f64,
}

impl Timeline {
    pub(super) fn new(body: &Body) -> Self {
        Self {
            poses: vec![Pose::rest()],
            arm_length: body.arm_length(),
        }
    }

    /// The pose that the next segment starts from.
    pub(super) fn current(&self) -> Pose {
        self.poses.last().copied().unwrap_or_else(Pose::rest)
    }

    pub(super) fn hold(&mut self, seconds: f64) {
        let current = self.current();
        self.poses
            .extend(std::iter::repeat_n(current, frames(seconds)));
    }

    /// Moves to a pose so that the faster hand peaks at about `peak_speed`, m/s.
    pub(super) fn move_to(&mut self, to: Pose, peak_speed: f64) {
        self.go(to, peak_speed, SHORTEST_MOVE);
    }

    /// As [`move_to`](Self::move_to), for blows: a short way may be over sooner.
    pub(super) fn strike(&mut self, to: Pose, peak_speed: f64) {
        self.go(to, peak_speed, SHORTEST_STRIKE);
    }

    fn go(&mut self, to: Pose, peak_speed: f64, shortest: f64) {
        let from = self.current();
        let path = |i: usize| path_length(&from.arms[i].hand, &to.arms[i].hand);
        let trunk = (to.yaw - from.yaw).abs().max((to.lean - from.lean).abs());
        let metres = (path(0).max(path(1)) + trunk) * self.arm_length;
        let count = frames((MINIMUM_JERK_PEAK * metres / peak_speed).max(shortest));
        self.poses.extend(
            (1..=count).map(|i| between(&from, &to, minimum_jerk(i as f64 / count as f64))),
        );
    }

    /// Plays a motion about the current pose: `change(seconds, strength, pose)` changes the pose; the strength rises from
    /// 0 to 1 and falls back to 0, and the change must vanish with it.
    pub(super) fn cycle(&mut self, seconds: f64, mut change: impl FnMut(f64, f64, &mut Pose)) {
        let base = self.current();
        let count = frames(seconds);
        let length = count as f64 / FPS;
        let ramp = RAMP.min(length / 2.0);
        self.poses.extend((1..=count).map(|i| {
            let t = i as f64 / FPS;
            let mut pose = base;
            change(
                t,
                minimum_jerk((t / ramp).min(1.0))
                    * minimum_jerk(((length - t) / ramp).clamp(0.0, 1.0)),
                &mut pose,
            );
            pose
        }));
    }
}

fn frames(seconds: f64) -> usize {
    (seconds * FPS).round().max(1.0) as usize
}

/// Length of the path that [`hand_between`] takes, about, in arm lengths.
fn path_length(from: &Vector3<f64>, to: &Vector3<f64>) -> f64 {
    let turn = from.angle(to) * (from.norm() + to.norm()) / 2.0;
    turn.hypot(to.norm() - from.norm())
}

fn between(from: &Pose, to: &Pose, s: f64) -> Pose {
    let mix = |a: f64, b: f64| a + (b - a) * s;
    let arm = |a: &ArmPose, b: &ArmPose| ArmPose {
        hand: hand_between(&a.hand, &b.hand, s),
        swivel: mix(a.swivel, b.swivel),
        pronation: mix(a.pronation, b.pronation),
        flexion: mix(a.flexion, b.flexion),
        deviation: mix(a.deviation, b.deviation),
    };
    Pose {
        yaw: mix(from.yaw, to.yaw),
        lean: mix(from.lean, to.lean),
        arms: std::array::from_fn(|i| arm(&from.arms[i], &to.arms[i])),
    }
}

/// A hand swings about its shoulder; a wide swing goes round by the front.
fn hand_between(from: &Vector3<f64>, to: &Vector3<f64>, s: f64) -> Vector3<f64> {
    let (a, b) = (from.normalize(), to.normalize());
    let opposed = (1.0 - a.dot(&b)) / 2.0;
    let front = Vector3::new(0.8, 0.5, 0.0) * (4.0 * s * (1.0 - s) * 0.8 * opposed * opposed);
    let direction = a * (1.0 - s) + b * s + front;
    direction.normalize() * (from.norm() * (1.0 - s) + to.norm() * s)
}
