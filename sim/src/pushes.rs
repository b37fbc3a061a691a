//! Pushes of a robot's base in the course of an episode.

use std::f64::consts::TAU;

use emp_robot::Robot;
use nalgebra::Vector3;
use rand::{Rng, RngExt as _};
use serde::{Deserialize, Serialize};

use crate::Body;
use crate::ranges::within;

/// Pushes of the base: jumps of its velocity.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Push {
    /// Share of episodes that have pushes.
    #[serde(default = "always")]
    pub ratio: f64,
    /// Time between two pushes, seconds; the time of an episode's first is drawn.
    pub interval: f64,
    /// Largest change of the horizontal velocity on each axis, m/s.
    pub linear: f64,
    /// Largest change of the angular velocity about each axis, rad/s.
    pub angular: f64,
}

fn always() -> f64 {
    1.0
}

impl Push {
    /// Draws the jumps of one push: of the linear velocity (world frame, m/s) and of the angular one (base frame, rad/s).
    fn draw(&self, rng: &mut impl Rng) -> [Vector3<f64>; 2] {
        let mut draw = |limit: f64| within(Some([-limit, limit]), 0.0, rng);
        let linear = Vector3::new(draw(self.linear), draw(self.linear), 0.0);
        [linear, Vector3::from_fn(|_, _| draw(self.angular))]
    }
}

/// Pushes of known speed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Kick {
    /// Speed that a push adds to the base, in a random horizontal direction, m/s.
    pub speed: f64,
    /// Time between two pushes, seconds; the time of an episode's first is drawn.
    pub interval: f64,
}

/// What pushes an episode has.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) enum Pushes {
    /// As in training.
    Random(Push),
    /// Of known speed.
    Kick(Kick),
}

impl Pushes {
    /// Control periods between two pushes, at least 1.
    fn interval(&self, robot: &Robot) -> usize {
        let seconds = match self {
            Self::Random(push) => push.interval,
            Self::Kick(kick) => kick.interval,
        };
        ((seconds * robot.control_rate_hz()).round() as usize).max(1)
    }

    /// Draws the jumps of the linear (world frame, m/s) and the angular velocity (base frame, rad/s) of one push.
    fn draw(&self, rng: &mut impl Rng) -> [Vector3<f64>; 2] {
        match self {
            Self::Random(push) => push.draw(rng),
            Self::Kick(kick) => {
                let (sine, cosine) = rng.random_range(0.0..TAU).sin_cos();
                let linear = kick.speed * Vector3::new(cosine, sine, 0.0);
                [linear, Vector3::zeros()]
            }
        }
    }
}

/// Pushes one robot whenever it is time.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(crate) struct PushClock {
    pushes: Option<Pushes>,
    /// Control periods until the next push.
    left: usize,
}

impl PushClock {
    /// A clock whose first push comes at a time drawn from the first interval.
    pub(crate) fn new(pushes: Option<Pushes>, robot: &Robot, rng: &mut impl Rng) -> Self {
        let interval = pushes.map_or(1, |pushes| pushes.interval(robot));
        Self {
            pushes,
            left: rng.random_range(0..interval),
        }
    }

    /// Lets one control period begin.
    pub(crate) fn tick(&mut self, robot: &Robot, body: &mut Body, rng: &mut impl Rng) {
        let Some(pushes) = self.pushes else {
            return;
        };
        if self.left > 0 {
            self.left -= 1;
            return;
        }
        self.left = pushes.interval(robot) - 1;
        let [linear, angular] = pushes.draw(rng);
        body.push(linear, angular);
    }
}
