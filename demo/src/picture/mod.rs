//! The pictures: what the person did above what the robot did, how the robot stood meanwhile, and what the EMP does about it.

mod canvas;
mod chart;
mod emp_sheet;
mod figure;
mod sheet;
mod stance_sheet;
mod stills;
#[cfg(test)]
mod testing;
mod view;

use emp_motion::KeyNodeFrame;

use crate::stance::Stance;
use figure::{Figure, Leg};

pub(crate) use emp_sheet::{Curve, EmpSheet, JointCurves, OFF, ON, Standing, Strip};
pub(crate) use sheet::Sheet;
pub(crate) use stance_sheet::StanceSheet;
pub(crate) use stills::differing;

/// One frame of the motion, as the pictures show it.
pub(crate) struct Still {
    /// Since the motion began, seconds.
    pub(crate) time: f64,
    /// What is going on, if that has a name.
    pub(crate) name: String,
    /// Mean angle between the person's and the robot's arm bones, degrees.
    pub(crate) direction_error_deg: f32,
    /// The person.
    pub(crate) human: KeyNodeFrame,
    /// The robot's key nodes, as the physics left them, in the frame of its base.
    pub(crate) robot: KeyNodeFrame,
    /// The robot's left and right leg in the same frame.
    pub(crate) legs: [Leg; 2],
    /// How it stands.
    pub(crate) stance: Stance,
}

impl Still {
    /// The robot in the frame of its base.
    fn robot_figure(&self) -> Figure {
        Figure::robot(&self.robot, &self.legs)
    }
}
