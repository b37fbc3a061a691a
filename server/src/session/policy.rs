//! `StreamPolicy`: robot states and goals in, leg targets out. The robot's past lives here and goes with every frame.

use std::sync::Arc;

use emp_models::controller::ControllerState;
use emp_proto::v1::{
    DroppedFrame, FrameHeader, PolicyFrame, SteppedFrame, StreamPolicyConfig, StreamPolicyRequest,
    StreamPolicyResponse, StreamPolicyStarted, stream_policy_request::Message as Request,
    stream_policy_response::Message as Response,
};

use super::{Incoming, Kind};
use crate::{
    catalog::{Catalog, PolicyModel},
    control::{ControlInput, Controllers, EmpMode, PolicyOutput},
    error::{FieldError, ServiceError},
    identity::Role,
    queue::Answer,
    robot_state::{self, ControlPeriod},
    wire,
};

/// What a stream of robot states remembers.
pub(crate) struct PolicyStream {
    model: Arc<PolicyModel>,
    mode: EmpMode,
    /// The past as far as it was answered.
    past: ControllerState,
    /// A frame that was to start an episode has arrived; the next good one does.
    must_reset: bool,
}

/// A control period, and whether it starts an episode.
pub(crate) struct Frame {
    period: ControlPeriod,
    reset: bool,
}

fn response(message: Response) -> StreamPolicyResponse {
    StreamPolicyResponse {
        message: Some(message),
    }
}

impl Kind for PolicyStream {
    const ROLE: Role = Role::Robot;
    type Request = StreamPolicyRequest;
    type Response = StreamPolicyResponse;
    type Config = StreamPolicyConfig;
    type WireFrame = PolicyFrame;
    type Frame = Frame;
    type Input = ControlInput;
    type Output = PolicyOutput;
    type Model = Controllers;

    fn sort(request: StreamPolicyRequest) -> Option<Incoming<Self>> {
        Some(match request.message? {
            Request::Config(config) => Incoming::Config(config),
            Request::Frame(frame) => Incoming::Frame(frame),
        })
    }

    fn dropped(notice: DroppedFrame) -> StreamPolicyResponse {
        response(Response::Dropped(notice))
    }

    fn delivery(config: &StreamPolicyConfig) -> i32 {
        config.delivery
    }

    fn model<'a>(
        catalog: &'a Catalog,
        config: &StreamPolicyConfig,
    ) -> Result<&'a Arc<PolicyModel>, ServiceError> {
        catalog.policy_for(&config.robot, &config.model, &config.model_version)
    }

    fn open(config: &StreamPolicyConfig, model: &Arc<PolicyModel>) -> Result<Self, FieldError> {
        let has_emp = model.model.emp().is_some();
        let mode =
            robot_state::read_mode("config.emp_mode", config.emp_mode, EmpMode::Off, has_emp)?;
        Ok(Self {
            model: Arc::clone(model),
            mode,
            past: model.model.state(),
            must_reset: false,
        })
    }

    fn started(&self) -> StreamPolicyResponse {
        let PolicyModel { card, robot, .. } = &*self.model;
        let history = self.model.model.policy().layout().history();
        response(Response::Started(StreamPolicyStarted {
            robot: card.robot.clone(),
            model: card.name.clone(),
            model_version: card.version.clone(),
            goal_joint_names: wire::joint_names(robot.goal_joints()),
            leg_joint_names: wire::joint_names(robot.leg_joints()),
            history: wire::count(history),
        }))
    }

    fn header(frame: &PolicyFrame) -> Option<FrameHeader> {
        frame.header
    }

    fn arrived(&mut self, frame: &PolicyFrame) {
        self.must_reset |= frame.reset;
    }

    fn read(&mut self, frame: PolicyFrame) -> Result<Frame, FieldError> {
        let period = ControlPeriod::read("", frame.state.as_ref(), &frame.goal, &self.model.robot)?;
        let reset = std::mem::take(&mut self.must_reset);
        Ok(Frame { period, reset })
    }

    fn supersede(old: &Frame, new: &mut Frame) {
        new.reset |= old.reset;
    }

    fn input(&mut self, frame: &Frame) -> ControlInput {
        if frame.reset {
            self.past.reset();
        }
        frame.period.clone().after(self.past.clone(), self.mode)
    }

    fn answer(
        &mut self,
        header: Option<FrameHeader>,
        answer: Answer<PolicyOutput>,
    ) -> StreamPolicyResponse {
        let timing = wire::timing(&answer);
        let PolicyOutput {
            state,
            output,
            assessment,
        } = answer.output;
        self.past = state;
        let result = wire::policy_result(&self.model.robot, self.mode, output, assessment);
        response(Response::Result(SteppedFrame {
            header,
            result: Some(result),
            timing: Some(timing),
        }))
    }
}
