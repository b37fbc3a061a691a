//! How much time passes for a robot from one frame to the next.

use std::time::Duration;

use emp_robot::Robot;

use super::{LONGEST_PERIOD, control_period};

/// Tells the time between a robot's frames, by the robot's own clock where its frames say when they were measured.
///
/// Frames that queued behind a stalled connection arrive together. Each was measured a control period after the one before, but
/// the robot gets the answers at once: so no more time passes than that between the arrivals, of which a little is saved up for
/// connections that jitter.
#[derive(Clone, Debug)]
pub struct RobotClock {
    longest: Duration,
    /// Arrival and measurement of the last frame.
    last: Option<(Duration, Option<Duration>)>,
    /// Time between arrivals that was not used.
    saved: Duration,
}

impl RobotClock {
    /// The clock of a robot that has not sent a frame yet.
    pub fn new(robot: &Robot) -> Self {
        let period = control_period(robot);
        Self {
            longest: period * LONGEST_PERIOD,
            last: None,
            saved: period,
        }
    }

    /// A frame came: the time since the one before. `arrived` is the server's clock, `measured` the robot's, each from an origin
    /// of its own.
    pub fn tick(&mut self, arrived: Duration, measured: Option<Duration>) -> Duration {
        let Some((last_arrived, last_measured)) = self.last.replace((arrived, measured)) else {
            return self.longest / LONGEST_PERIOD;
        };
        let between = arrived.saturating_sub(last_arrived);
        let Some((now, before)) = measured.zip(last_measured) else {
            return between.min(self.longest);
        };
        self.saved = (self.saved + between).min(self.longest);
        // A robot whose clock stands still or goes back is not moved.
        let elapsed = now.saturating_sub(before).min(self.saved);
        self.saved -= elapsed;
        elapsed
    }
}
