//! `MotionService`: what each call does, on top of the catalog and the sessions.

use std::{sync::Arc, time::Instant};

use emp_models::retarget::{Memory as Previous, Mode, RetargetInput};
use emp_proto::v1::{
    FilterGoalRequest, FilterGoalResponse, FrameHeader, RetargetRequest, RetargetResponse,
    StepPolicyRequest, StepPolicyResponse, StreamFilterGoalRequest, StreamFilterGoalResponse,
    StreamPolicyRequest, StreamPolicyResponse, StreamRetargetRequest, StreamRetargetResponse,
    motion_service_server::MotionService,
};
use emp_robot::Robot;
use tonic::{Request, Response, Status, Streaming, metadata::MetadataMap};

use crate::decode::deadline;
use crate::inference::due;
use crate::{
    catalog::Catalog,
    decode::{
        fields, pose,
        robot_state::{self, Past},
    },
    encode,
    error::{FieldError, ServiceError},
    inference::{
        batcher::Batcher,
        controllers::{FilterOutput, PolicyOutput},
        queue::{Answer, Priority},
    },
    session::{self, FilterStream, Memory, PolicyStream, ResponseStream, RetargetStream},
    streams::{Place, Streams},
};

/// Retargeting, goal filters and leg targets, one frame or a stream of them.
pub(crate) struct Motion {
    catalog: Arc<Catalog>,
    streams: Arc<Streams>,
}

impl Motion {
    pub(crate) fn new(catalog: Arc<Catalog>, streams: Arc<Streams>) -> Self {
        Self { catalog, streams }
    }

    async fn retarget_one(
        &self,
        request: Request<RetargetRequest>,
    ) -> Result<RetargetResponse, ServiceError> {
        let due = CallDeadline::of(request.metadata())?;
        let RetargetRequest {
            header,
            robot,
            model,
            model_version,
            refine,
            pose,
            previous_joint_angles,
        } = request.into_inner();
        let model = self
            .catalog
            .retargeter_for(&robot, &model, &model_version)?;
        let frame = pose::read(pose.as_ref())?;
        let input = RetargetInput {
            frame,
            mode: retarget_mode(&model.robot, refine, &previous_joint_angles)?,
        };
        let answer = due.compute(&model.batcher, input, header.as_ref()).await?;
        let timing = encode::timing(&answer);
        let result = encode::retarget_result(
            &model.robot,
            answer.output.angles,
            answer.output.direction_error,
        );
        Ok(RetargetResponse {
            header,
            result: Some(result),
            timing: Some(timing),
        })
    }

    async fn step_one(
        &self,
        request: Request<StepPolicyRequest>,
    ) -> Result<StepPolicyResponse, ServiceError> {
        let due = CallDeadline::of(request.metadata())?;
        let StepPolicyRequest {
            header,
            robot,
            model,
            model_version,
            history,
            start_heading,
            emp_mode,
            last_applied,
        } = request.into_inner();
        let model = self.catalog.policy_for(&robot, &model, &model_version)?;
        let has_emp = model.model.emp().is_some();
        let mode = robot_state::read_mode("emp_mode", emp_mode, has_emp)?;
        let past = Past {
            history: &history,
            start_heading,
            last_applied,
        };
        let input = past.read(&model.robot, model.model.policy().layout(), mode)?;
        let answer = due.compute(&model.batcher, input, header.as_ref()).await?;
        let timing = encode::timing(&answer);
        let PolicyOutput {
            output, assessment, ..
        } = answer.output;
        Ok(StepPolicyResponse {
            header,
            result: Some(encode::policy_result(mode, output, assessment)),
            timing: Some(timing),
        })
    }

    async fn filter_one(
        &self,
        request: Request<FilterGoalRequest>,
    ) -> Result<FilterGoalResponse, ServiceError> {
        let due = CallDeadline::of(request.metadata())?;
        let FilterGoalRequest {
            header,
            robot,
            model,
            model_version,
            history,
            start_heading,
            emp_mode,
            last_applied,
        } = request.into_inner();
        let model = self.catalog.filter_for(&robot, &model, &model_version)?;
        let mode = robot_state::read_mode("emp_mode", emp_mode, true)?;
        let past = Past {
            history: &history,
            start_heading,
            last_applied,
        };
        let input = past.read(&model.robot, model.model.layout(), mode)?;
        let answer = due.compute(&model.batcher, input, header.as_ref()).await?;
        let timing = encode::timing(&answer);
        let FilterOutput {
            filtered,
            assessment,
            ..
        } = answer.output;
        let result = encode::filter_result(filtered.goal, filtered.risk, assessment);
        Ok(FilterGoalResponse {
            header,
            result: Some(result),
            timing: Some(timing),
        })
    }

    fn open<M: Memory>(
        &self,
        place: Place,
        request: Request<Streaming<M::Request>>,
    ) -> Result<Response<ResponseStream<M::Response>>, ServiceError> {
        let place = self.streams.enter(place)?;
        Ok(Response::new(self.streams.open(
            request,
            Some(place),
            session::run::<M>,
        )?))
    }
}

/// How a pose that stands alone is answered, or one after the previous answer.
fn retarget_mode(robot: &Robot, refine: bool, previous: &[f32]) -> Result<Mode, FieldError> {
    if previous.is_empty() {
        return Ok(if refine { Mode::Begin } else { Mode::Network });
    }
    let field = "previous_joint_angles";
    if !refine {
        let description =
            "expected none without `refine`: only a refined answer follows from the one before";
        return Err(FieldError::new(field, description));
    }
    fields::angles(field, previous, robot.goal_joints().iter())?;
    Ok(Mode::Follow {
        memory: Box::new(Previous::after(robot, previous)),
        seconds: 1.0 / robot.control_rate_hz(),
    })
}

/// When a unary call's answer is due.
struct CallDeadline {
    received: Instant,
    call: Option<Instant>,
}

impl CallDeadline {
    fn of(metadata: &MetadataMap) -> Result<Self, FieldError> {
        let received = Instant::now();
        let call = deadline::of_call(metadata, received)?;
        Ok(Self { received, call })
    }

    /// Brings the call's input to its model, until the call's deadline or the end of the frame's time budget, whichever is
    /// sooner.
    async fn compute<I: Send + 'static, O: Send + 'static>(
        &self,
        batcher: &Batcher<I, O>,
        input: I,
        header: Option<&FrameHeader>,
    ) -> Result<Answer<O>, ServiceError> {
        let frame = deadline::of_frame(header, self.received)?;
        let deadline = due::sooner(self.call, frame);
        Ok(batcher.compute(Priority::Unary, input, deadline).await?)
    }
}

#[tonic::async_trait]
impl MotionService for Motion {
    async fn retarget(
        &self,
        request: Request<RetargetRequest>,
    ) -> Result<Response<RetargetResponse>, Status> {
        Ok(Response::new(self.retarget_one(request).await?))
    }

    type StreamRetargetStream = ResponseStream<StreamRetargetResponse>;

    async fn stream_retarget(
        &self,
        request: Request<Streaming<StreamRetargetRequest>>,
    ) -> Result<Response<ResponseStream<StreamRetargetResponse>>, Status> {
        Ok(self.open::<RetargetStream>(Place::Other, request)?)
    }

    async fn filter_goal(
        &self,
        request: Request<FilterGoalRequest>,
    ) -> Result<Response<FilterGoalResponse>, Status> {
        Ok(Response::new(self.filter_one(request).await?))
    }

    type StreamFilterGoalStream = ResponseStream<StreamFilterGoalResponse>;

    async fn stream_filter_goal(
        &self,
        request: Request<Streaming<StreamFilterGoalRequest>>,
    ) -> Result<Response<ResponseStream<StreamFilterGoalResponse>>, Status> {
        Ok(self.open::<FilterStream>(Place::Robot, request)?)
    }

    async fn step_policy(
        &self,
        request: Request<StepPolicyRequest>,
    ) -> Result<Response<StepPolicyResponse>, Status> {
        Ok(Response::new(self.step_one(request).await?))
    }

    type StreamPolicyStream = ResponseStream<StreamPolicyResponse>;

    async fn stream_policy(
        &self,
        request: Request<Streaming<StreamPolicyRequest>>,
    ) -> Result<Response<ResponseStream<StreamPolicyResponse>>, Status> {
        Ok(self.open::<PolicyStream>(Place::Robot, request)?)
    }
}
