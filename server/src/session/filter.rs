//! `StreamFilterGoal`: robot states and goals in, executable goals out. The robot's past lives here and goes with every
//! frame.

use std::sync::Arc;

use emp_models::controller::ControllerState;
use emp_proto::v1::{
    DroppedFrame, FilterFrame, FilteredFrame, FrameHeader, StreamFilterGoalConfig,
    StreamFilterGoalRequest, StreamFilterGoalResponse, StreamFilterStarted,
    stream_filter_goal_request::Message as Request,
    stream_filter_goal_response::Message as Response,
};

use super::{Incoming, Kind};
use crate::{
    catalog::{Catalog, FilterModel},
    control::{ControlInput, EmpMode, FilterOutput, Filters},
    error::{FieldError, ServiceError},
    identity::Role,
    queue::Answer,
    robot_state::{self, ControlPeriod},
    wire,
};

/// What a stream of goals remembers.
pub(crate) struct FilterStream {
    model: Arc<FilterModel>,
    mode: EmpMode,
    /// The past as far as it was answered.
    past: ControllerState,
    /// A frame that was to start an episode has arrived; the next good one does.
    must_reset: bool,
}

/// A control period, the action that led to it, and whether it starts an episode.
pub(crate) struct Frame {
    period: ControlPeriod,
    last_action: Vec<f32>,
    reset: bool,
}

fn response(message: Response) -> StreamFilterGoalResponse {
    StreamFilterGoalResponse {
        message: Some(message),
    }
}

impl Kind for FilterStream {
    const ROLE: Role = Role::Robot;
    type Request = StreamFilterGoalRequest;
    type Response = StreamFilterGoalResponse;
    type Config = StreamFilterGoalConfig;
    type WireFrame = FilterFrame;
    type Frame = Frame;
    type Input = ControlInput;
    type Output = FilterOutput;
    type Model = Filters;

    fn sort(request: StreamFilterGoalRequest) -> Option<Incoming<Self>> {
        Some(match request.message? {
            Request::Config(config) => Incoming::Config(config),
            Request::Frame(frame) => Incoming::Frame(frame),
        })
    }

    fn dropped(notice: DroppedFrame) -> StreamFilterGoalResponse {
        response(Response::Dropped(notice))
    }

    fn delivery(config: &StreamFilterGoalConfig) -> i32 {
        config.delivery
    }

    fn model<'a>(
        catalog: &'a Catalog,
        config: &StreamFilterGoalConfig,
    ) -> Result<&'a Arc<FilterModel>, ServiceError> {
        catalog.filter_for(&config.robot, &config.model, &config.model_version)
    }

    fn open(config: &StreamFilterGoalConfig, model: &Arc<FilterModel>) -> Result<Self, FieldError> {
        let mode = robot_state::read_mode("config.emp_mode", config.emp_mode, EmpMode::On, true)?;
        Ok(Self {
            model: Arc::clone(model),
            mode,
            past: model.model.state(),
            must_reset: false,
        })
    }

    fn started(&self) -> StreamFilterGoalResponse {
        let FilterModel { card, robot, .. } = &*self.model;
        response(Response::Started(StreamFilterStarted {
            robot: card.robot.clone(),
            model: card.name.clone(),
            model_version: card.version.clone(),
            goal_joint_names: wire::joint_names(robot.goal_joints()),
            leg_joint_names: wire::joint_names(robot.leg_joints()),
            history: wire::count(self.model.model.layout().history()),
        }))
    }

    fn header(frame: &FilterFrame) -> Option<FrameHeader> {
        frame.header
    }

    fn arrived(&mut self, frame: &FilterFrame) {
        self.must_reset |= frame.reset;
    }

    fn read(&mut self, frame: FilterFrame) -> Result<Frame, FieldError> {
        let robot = &self.model.robot;
        let period = ControlPeriod::read("", frame.state.as_ref(), &frame.goal, robot)?;
        let last_action = robot_state::read_last_action("last_action", &frame.last_action, robot)?;
        let reset = std::mem::take(&mut self.must_reset);
        Ok(Frame {
            period,
            last_action,
            reset,
        })
    }

    fn supersede(old: &Frame, new: &mut Frame) {
        new.reset |= old.reset;
    }

    fn input(&mut self, frame: &Frame) -> ControlInput {
        if frame.reset {
            self.past.reset();
        }
        let mut past = self.past.clone();
        past.history_mut().set_last_action(&frame.last_action);
        frame.period.clone().after(past, self.mode)
    }

    fn answer(
        &mut self,
        header: Option<FrameHeader>,
        answer: Answer<FilterOutput>,
    ) -> StreamFilterGoalResponse {
        let timing = wire::timing(&answer);
        let FilterOutput {
            state,
            filtered,
            assessment,
        } = answer.output;
        self.past = state;
        let robot = &self.model.robot;
        let result = wire::filter_result(robot, filtered.goal, filtered.risk, assessment);
        response(Response::Result(FilteredFrame {
            header,
            result: Some(result),
            timing: Some(timing),
        }))
    }
}
