//! `StreamFilterGoal`: robot states and goals in, executable goals out. The robot's past lives here and goes with every
//! frame.

use std::sync::Arc;

use emp_models::controller::ControllerState;
use emp_proto::v1::{
    DroppedFrame, FilterGoalFrame, FilteredGoalFrame, FrameHeader, GoingAway,
    StreamFilterGoalConfig, StreamFilterGoalRequest, StreamFilterGoalResponse,
    StreamFilterGoalStarted, stream_filter_goal_request::Message as Request,
    stream_filter_goal_response::Message as Response,
};

use super::{Codec, Incoming, Memory};
use emp_robot::Robot;

use crate::{
    catalog::{Catalog, FilterModel},
    decode::robot_state::{self, ControlPeriod},
    encode,
    error::{FieldError, ServiceError},
    inference::controllers::{ControlInput, EmpMode, FilterOutput, Filters},
    inference::queue::Answer,
};

/// What a stream of goals remembers.
pub(crate) struct FilterStream {
    model: Arc<FilterModel>,
    mode: EmpMode,
    /// The past as far as it was answered.
    past: ControllerState,
}

/// A control period, and the action that led to it.
pub(crate) struct Frame {
    period: ControlPeriod,
    last_action: Vec<f32>,
}

fn response(message: Response) -> StreamFilterGoalResponse {
    StreamFilterGoalResponse {
        message: Some(message),
    }
}

impl Codec for FilterStream {
    type Request = StreamFilterGoalRequest;
    type Response = StreamFilterGoalResponse;
    type Config = StreamFilterGoalConfig;
    type WireFrame = FilterGoalFrame;
    type Frame = Frame;
    type Input = ControlInput;
    type Output = FilterOutput;
    type Model = Filters;

    const ENDS_AT_ONCE: bool = false;

    fn sort(request: StreamFilterGoalRequest) -> Option<Incoming<Self>> {
        Some(match request.message? {
            Request::Config(config) => Incoming::Config(config),
            Request::Frame(frame) => Incoming::Frame(frame),
        })
    }

    fn dropped(notice: DroppedFrame) -> StreamFilterGoalResponse {
        response(Response::Dropped(notice))
    }

    fn going_away(notice: GoingAway) -> StreamFilterGoalResponse {
        response(Response::GoingAway(notice))
    }

    fn delivery(config: &StreamFilterGoalConfig) -> i32 {
        config.delivery
    }

    fn model(
        catalog: &Catalog,
        config: &StreamFilterGoalConfig,
    ) -> Result<Arc<FilterModel>, ServiceError> {
        catalog.filter_for(&config.robot, &config.model, &config.model_version)
    }

    fn header(frame: &FilterGoalFrame) -> Option<FrameHeader> {
        frame.header
    }

    fn resets(frame: &FilterGoalFrame) -> bool {
        frame.reset
    }

    fn read(robot: &Robot, frame: FilterGoalFrame) -> Result<Frame, FieldError> {
        let period = ControlPeriod::read("", frame.state.as_ref(), &frame.goal, robot)?;
        let last_action = robot_state::read_last_action("last_action", &frame.last_action, robot)?;
        Ok(Frame {
            period,
            last_action,
        })
    }
}

impl Memory for FilterStream {
    fn open(config: &StreamFilterGoalConfig, model: &Arc<FilterModel>) -> Result<Self, FieldError> {
        let mode = robot_state::read_mode("config.emp_mode", config.emp_mode, true)?;
        Ok(Self {
            model: Arc::clone(model),
            mode,
            past: model.model.state(),
        })
    }

    fn started(&self) -> StreamFilterGoalResponse {
        let FilterModel { card, robot, .. } = &*self.model;
        response(Response::Started(StreamFilterGoalStarted {
            robot: card.robot.clone(),
            model: card.name.clone(),
            model_version: card.version.clone(),
            goal_joint_names: encode::joint_names(robot.goal_joints()),
            leg_joint_names: encode::joint_names(robot.leg_joints()),
            history: encode::count(self.model.model.layout().history()),
        }))
    }

    fn reset(&mut self) {
        self.past.reset();
    }

    fn input(&self, frame: Frame) -> ControlInput {
        let mut past = self.past.clone();
        past.history_mut().set_last_action(&frame.last_action);
        frame.period.after(past, self.mode)
    }

    fn answer(
        &mut self,
        header: Option<FrameHeader>,
        answer: Answer<FilterOutput>,
    ) -> StreamFilterGoalResponse {
        let timing = encode::timing(&answer);
        let FilterOutput {
            state,
            filtered,
            assessment,
        } = answer.output;
        self.past = state;
        let result = encode::filter_result(filtered.goal, filtered.risk, assessment);
        response(Response::Result(FilteredGoalFrame {
            header,
            result: Some(result),
            timing: Some(timing),
        }))
    }
}
