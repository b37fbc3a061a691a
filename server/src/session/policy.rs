//! `StreamPolicy`: robot states and goals in, leg targets out. The robot's past lives here and goes with every frame.

use std::sync::Arc;

use emp_models::controller::ControllerState;
use emp_proto::v1::{
    DroppedFrame, FrameHeader, GoingAway, PolicyFrame, SteppedFrame, StreamPolicyConfig,
    StreamPolicyRequest, StreamPolicyResponse, StreamPolicyStarted,
    stream_policy_request::Message as Request, stream_policy_response::Message as Response,
};

use super::{Codec, Incoming, Memory};
use emp_robot::Robot;

use crate::{
    catalog::{Catalog, PolicyModel},
    decode::robot_state::{self, ControlPeriod},
    encode,
    error::{FieldError, ServiceError},
    inference::controllers::{ControlInput, Controllers, EmpMode, PolicyOutput},
    inference::queue::Answer,
};

/// What a stream of robot states remembers.
pub(crate) struct PolicyStream {
    model: Arc<PolicyModel>,
    mode: EmpMode,
    /// The past as far as it was answered.
    past: ControllerState,
}

fn response(message: Response) -> StreamPolicyResponse {
    StreamPolicyResponse {
        message: Some(message),
    }
}

impl Codec for PolicyStream {
    type Request = StreamPolicyRequest;
    type Response = StreamPolicyResponse;
    type Config = StreamPolicyConfig;
    type WireFrame = PolicyFrame;
    type Frame = ControlPeriod;
    type Input = ControlInput;
    type Output = PolicyOutput;
    type Model = Controllers;

    const ENDS_AT_ONCE: bool = false;

    fn sort(request: StreamPolicyRequest) -> Option<Incoming<Self>> {
        Some(match request.message? {
            Request::Config(config) => Incoming::Config(config),
            Request::Frame(frame) => Incoming::Frame(frame),
        })
    }

    fn dropped(notice: DroppedFrame) -> StreamPolicyResponse {
        response(Response::Dropped(notice))
    }

    fn going_away(notice: GoingAway) -> StreamPolicyResponse {
        response(Response::GoingAway(notice))
    }

    fn delivery(config: &StreamPolicyConfig) -> i32 {
        config.delivery
    }

    fn model(
        catalog: &Catalog,
        config: &StreamPolicyConfig,
    ) -> Result<Arc<PolicyModel>, ServiceError> {
        catalog.policy_for(&config.robot, &config.model, &config.model_version)
    }

    fn header(frame: &PolicyFrame) -> Option<FrameHeader> {
        frame.header
    }

    fn resets(frame: &PolicyFrame) -> bool {
        frame.reset
    }

    fn read(robot: &Robot, frame: PolicyFrame) -> Result<ControlPeriod, FieldError> {
        ControlPeriod::read("", frame.state.as_ref(), &frame.goal, robot)
    }
}

impl Memory for PolicyStream {
    fn open(config: &StreamPolicyConfig, model: &Arc<PolicyModel>) -> Result<Self, FieldError> {
        let has_emp = model.model.emp().is_some();
        let mode = robot_state::read_mode("config.emp_mode", config.emp_mode, has_emp)?;
        Ok(Self {
            model: Arc::clone(model),
            mode,
            past: model.model.state(),
        })
    }

    fn started(&self) -> StreamPolicyResponse {
        let PolicyModel { card, robot, .. } = &*self.model;
        let history = self.model.model.policy().layout().history();
        response(Response::Started(StreamPolicyStarted {
            robot: card.robot.clone(),
            model: card.name.clone(),
            model_version: card.version.clone(),
            goal_joint_names: encode::joint_names(robot.goal_joints()),
            leg_joint_names: encode::joint_names(robot.leg_joints()),
            history: encode::count(history),
        }))
    }

    fn reset(&mut self) {
        self.past.reset();
    }

    fn input(&self, period: ControlPeriod) -> ControlInput {
        period.after(self.past.clone(), self.mode)
    }

    fn answer(
        &mut self,
        header: Option<FrameHeader>,
        answer: Answer<PolicyOutput>,
    ) -> StreamPolicyResponse {
        let timing = encode::timing(&answer);
        let PolicyOutput {
            state,
            output,
            assessment,
        } = answer.output;
        self.past = state;
        let result = encode::policy_result(self.mode, output, assessment);
        response(Response::Result(SteppedFrame {
            header,
            result: Some(result),
            timing: Some(timing),
        }))
    }
}
