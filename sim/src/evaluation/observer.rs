//! Looking into an evaluation, control period by control period.

use emp_models::controller::ControllerOutput;

use crate::Reading;

/// Watches the control periods of an evaluation, and may come between controller and arms.
pub trait Observer {
    /// May change the goal that the arms are sent (`sent`, rad) where the clip asks for `asked`. The controller has answered
    /// by then: its history and its policy know nothing of the change.
    fn send(&mut self, asked: &[f32], sent: &mut [f32]) {
        let _ = (asked, sent);
    }

    /// A control period was executed. Those of a group of episodes come frame by frame, in the order of the episodes.
    fn executed(&mut self, frame: &ExecutedFrame<'_>);
}

/// Nobody looks.
impl Observer for () {
    fn executed(&mut self, _: &ExecutedFrame<'_>) {}
}

/// One executed control period of one episode.
#[derive(Clone, Copy, Debug)]
pub struct ExecutedFrame<'a> {
    /// Number of the episode.
    pub episode: usize,
    /// Number of the control period within it.
    pub frame: usize,
    /// The goal that was asked for, rad.
    pub asked: &'a [f32],
    /// What the controller answered; its goal as it was sent to the arms.
    pub output: &'a ControllerOutput,
    /// What was measured at the end of the control period.
    pub reading: &'a Reading,
}
