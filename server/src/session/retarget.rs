//! `StreamRetarget`: poses in, goal joint angles out.

use std::sync::Arc;

use emp_models::retarget::{
    Memory as Previous, Mode, RetargetInput, RetargetOutput, Retargeter, Smoother,
};
use emp_motion::KeyNodeFrame;
use emp_proto::v1::{
    DroppedFrame, FrameHeader, GoingAway, RetargetFrame, RetargetedFrame, StreamRetargetConfig,
    StreamRetargetRequest, StreamRetargetResponse, StreamRetargetStarted,
    stream_retarget_request::Message as Request, stream_retarget_response::Message as Response,
};

use super::{Codec, Incoming, Memory};
use emp_robot::Robot;

use crate::{
    catalog::{Catalog, RetargetModel},
    decode::pose,
    encode,
    error::{FieldError, ServiceError},
    inference::queue::Answer,
};

/// What a stream of poses remembers.
pub(crate) struct RetargetStream {
    model: Arc<RetargetModel>,
    refine: bool,
    smoother: Option<Smoother>,
    /// What the next refined answer starts from.
    previous: Option<Box<Previous>>,
}

fn response(message: Response) -> StreamRetargetResponse {
    StreamRetargetResponse {
        message: Some(message),
    }
}

impl Codec for RetargetStream {
    type Request = StreamRetargetRequest;
    type Response = StreamRetargetResponse;
    type Config = StreamRetargetConfig;
    type WireFrame = RetargetFrame;
    type Frame = KeyNodeFrame;
    type Input = RetargetInput;
    type Output = RetargetOutput;
    type Model = Option<Arc<Retargeter>>;

    const ENDS_AT_ONCE: bool = true;

    fn sort(request: StreamRetargetRequest) -> Option<Incoming<Self>> {
        Some(match request.message? {
            Request::Config(config) => Incoming::Config(config),
            Request::Frame(frame) => Incoming::Frame(frame),
        })
    }

    fn dropped(notice: DroppedFrame) -> StreamRetargetResponse {
        response(Response::Dropped(notice))
    }

    fn going_away(notice: GoingAway) -> StreamRetargetResponse {
        response(Response::GoingAway(notice))
    }

    fn delivery(config: &StreamRetargetConfig) -> i32 {
        config.delivery
    }

    fn model(
        catalog: &Catalog,
        config: &StreamRetargetConfig,
    ) -> Result<Arc<RetargetModel>, ServiceError> {
        catalog.retargeter_for(&config.robot, &config.model, &config.model_version)
    }

    fn header(frame: &RetargetFrame) -> Option<FrameHeader> {
        frame.header
    }

    fn read(_: &Robot, frame: RetargetFrame) -> Result<KeyNodeFrame, FieldError> {
        pose::read(frame.pose.as_ref())
    }
}

impl Memory for RetargetStream {
    fn open(config: &StreamRetargetConfig, model: &Arc<RetargetModel>) -> Result<Self, FieldError> {
        Ok(Self {
            model: Arc::clone(model),
            refine: config.refine,
            smoother: config.smoothing.then(Smoother::new),
            previous: None,
        })
    }

    fn started(&self) -> StreamRetargetResponse {
        let card = &self.model.card;
        response(Response::Started(StreamRetargetStarted {
            robot: card.robot.clone(),
            model: card.name.clone(),
            model_version: card.version.clone(),
            joint_names: card.joint_names.clone(),
        }))
    }

    fn input(&self, frame: KeyNodeFrame) -> RetargetInput {
        RetargetInput {
            frame,
            mode: match &self.previous {
                _ if !self.refine => Mode::Network,
                None => Mode::Begin,
                Some(memory) => Mode::Follow {
                    memory: memory.clone(),
                    seconds: 1.0 / self.model.robot.control_rate_hz(),
                },
            },
        }
    }

    fn answer(
        &mut self,
        header: Option<FrameHeader>,
        answer: Answer<RetargetOutput>,
    ) -> StreamRetargetResponse {
        let timing = encode::timing(&answer);
        let mut angles = answer.output.angles;
        self.previous = answer.output.memory;
        if let Some(smoother) = &mut self.smoother {
            smoother.step(&mut angles);
        }
        let result =
            encode::retarget_result(&self.model.robot, angles, answer.output.direction_error);
        response(Response::Result(RetargetedFrame {
            header,
            result: Some(result),
            timing: Some(timing),
        }))
    }
}
