//! `MotionService`: what each call does, on top of the catalog and the sessions.

use std::{
    pin::Pin,
    sync::Arc,
    task::{Context, Poll},
    time::{Duration, Instant},
};

use emp_models::retarget::{Memory, Mode, RetargetInput};
use emp_proto::v1::{
    FilterGoalRequest, FilterGoalResponse, FrameHeader, RetargetRequest, RetargetResponse,
    StepPolicyRequest, StepPolicyResponse, StreamFilterGoalRequest, StreamFilterGoalResponse,
    StreamPolicyRequest, StreamPolicyResponse, StreamRetargetRequest, StreamRetargetResponse,
    TeleoperateRequest, TeleoperateResponse, motion_service_server::MotionService,
};
use emp_robot::Robot;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio_stream::Stream;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming, metadata::MetadataMap};
use tracing::Instrument as _;

use crate::{
    batcher::Batcher,
    catalog::Catalog,
    control::{EmpMode, FilterOutput, PolicyOutput},
    deadline,
    error::{FieldError, ServiceError},
    identity::{Caller, Role},
    pose,
    queue::{Answer, Priority},
    robot_state::{self, Past},
    session::{self, FilterStream, Kind, PolicyStream, RetargetStream, SessionContext},
    settings::Settings,
    teleoperation::{self, Sessions, TeleoperationContext},
    wire,
};

/// Answers that wait for a slow reader before its session stops.
const OUTBOUND: usize = 16;
/// When to ask again for a stream; streams are long.
const STREAM_RETRY: Duration = Duration::from_secs(1);

/// Retargeting, goal filters and leg targets, one frame or a stream of them.
pub(crate) struct Motion {
    catalog: Arc<Catalog>,
    drain: CancellationToken,
    places: Arc<Semaphore>,
    buffer: usize,
    teleoperation: TeleoperationContext,
}

impl Motion {
    pub(crate) fn new(
        catalog: Arc<Catalog>,
        settings: &Settings,
        drain: CancellationToken,
    ) -> Self {
        let streams = &settings.streams;
        let places = streams.max_open.get().min(Semaphore::MAX_PERMITS);
        Self {
            catalog,
            drain,
            places: Arc::new(Semaphore::new(places)),
            buffer: streams.buffer.get(),
            teleoperation: TeleoperationContext {
                sessions: Arc::new(Sessions::new(streams.buffer.get())),
                guard: settings.teleoperation.guard(),
            },
        }
    }

    async fn retarget_one(
        &self,
        request: Request<RetargetRequest>,
    ) -> Result<RetargetResponse, ServiceError> {
        let due = Due::of_call(request.metadata())?;
        let caller = Caller::of(request.extensions());
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
        // Its method needs one of two roles; this asks about the robot.
        caller.may(Role::Observer, &robot, "")?;
        let frame = pose::read(pose.as_ref())?;
        let input = RetargetInput {
            frame,
            mode: retarget_mode(&model.robot, refine, &previous_joint_angles)?,
        };
        let answer = due.compute(&model.batcher, input, header.as_ref()).await?;
        let timing = wire::timing(&answer);
        let result = wire::retarget_result(
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
        let due = Due::of_call(request.metadata())?;
        let caller = Caller::of(request.extensions());
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
        caller.may(Role::Robot, &robot, "")?;
        let has_emp = model.model.emp().is_some();
        let mode = robot_state::read_mode("emp_mode", emp_mode, EmpMode::Off, has_emp)?;
        let past = Past {
            history: &history,
            start_heading,
            last_applied,
        };
        let input = past.read(&model.robot, model.model.policy().layout(), mode)?;
        let answer = due.compute(&model.batcher, input, header.as_ref()).await?;
        let timing = wire::timing(&answer);
        let PolicyOutput {
            output, assessment, ..
        } = answer.output;
        Ok(StepPolicyResponse {
            header,
            result: Some(wire::policy_result(&model.robot, mode, output, assessment)),
            timing: Some(timing),
        })
    }

    async fn filter_one(
        &self,
        request: Request<FilterGoalRequest>,
    ) -> Result<FilterGoalResponse, ServiceError> {
        let due = Due::of_call(request.metadata())?;
        let caller = Caller::of(request.extensions());
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
        caller.may(Role::Robot, &robot, "")?;
        let mode = robot_state::read_mode("emp_mode", emp_mode, EmpMode::On, true)?;
        let past = Past {
            history: &history,
            start_heading,
            last_applied,
        };
        let input = past.read(&model.robot, model.model.layout(), mode)?;
        let answer = due.compute(&model.batcher, input, header.as_ref()).await?;
        let timing = wire::timing(&answer);
        let FilterOutput {
            filtered,
            assessment,
            ..
        } = answer.output;
        let result = wire::filter_result(&model.robot, filtered.goal, filtered.risk, assessment);
        Ok(FilterGoalResponse {
            header,
            result: Some(result),
            timing: Some(timing),
        })
    }

    fn open_session<K: Kind>(
        &self,
        request: Request<Streaming<K::Request>>,
    ) -> Result<SessionStream<K::Response>, ServiceError> {
        self.open(request, session::run::<K>)
    }

    /// Finds a place for a stream and serves it on a task of its own: the response's headers go out at once, whatever the
    /// client sends first.
    fn open<Q, R: Send + 'static, S: Future<Output = ()> + Send + 'static>(
        &self,
        request: Request<Streaming<Q>>,
        serve: impl FnOnce(SessionContext, Streaming<Q>, mpsc::Sender<Result<R, Status>>) -> S,
    ) -> Result<SessionStream<R>, ServiceError> {
        if self.drain.is_cancelled() {
            return Err(ServiceError::ShuttingDown);
        }
        let deadline = deadline::of_call(request.metadata(), Instant::now())?;
        let permit =
            Arc::clone(&self.places)
                .try_acquire_owned()
                .map_err(|_| ServiceError::Overloaded {
                    what: "there is no room for another stream",
                    retry: STREAM_RETRY,
                })?;
        let (sender, responses) = mpsc::channel(OUTBOUND);
        let context = SessionContext {
            catalog: Arc::clone(&self.catalog),
            buffer: self.buffer,
            drain: self.drain.clone(),
            deadline,
            caller: Caller::of(request.extensions()),
        };
        tokio::spawn(serve(context, request.into_inner(), sender).in_current_span());
        Ok(SessionStream {
            responses,
            _permit: permit,
        })
    }
}

/// How a pose that stands alone is answered, or one after the previous answer.
fn retarget_mode(robot: &Robot, refine: bool, previous: &[f32]) -> Result<Mode, FieldError> {
    if previous.is_empty() {
        return Ok(if refine { Mode::Begin } else { Mode::Network });
    }
    let field = "previous_joint_angles";
    if !refine {
        return Err(FieldError::new(
            field,
            "expected none without `refine`: only a refined answer follows from the one before",
        ));
    }
    let joints = robot.goal_joints();
    if previous.len() != joints.len() {
        let (found, expected) = (previous.len(), joints.len());
        return Err(FieldError::new(
            field,
            format!("expected {expected} angles, one for each goal joint, got {found}"),
        ));
    }
    if let Some(i) = previous.iter().position(|angle| !angle.is_finite()) {
        return Err(FieldError::new(
            format!("{field}[{i}]"),
            format!("expected a finite angle, got {}", previous[i]),
        ));
    }
    Ok(Mode::Follow {
        memory: Box::new(Memory::after(robot, previous)),
        seconds: 1.0 / robot.control_rate_hz(),
    })
}

/// When a unary call's answer is due.
struct Due {
    received: Instant,
    call: Option<Instant>,
}

impl Due {
    fn of_call(metadata: &MetadataMap) -> Result<Self, FieldError> {
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
        let deadline = deadline::sooner(self.call, frame);
        if deadline::has_passed(deadline) {
            return Err(ServiceError::DeadlineExceeded);
        }
        let ticket = batcher.submit(Priority::Unary, input, deadline)?;
        let answer = tokio::select! {
            outcome = ticket => outcome?,
            () = deadline::passed(deadline) => return Err(ServiceError::DeadlineExceeded),
        };
        if deadline::has_passed(deadline) {
            return Err(ServiceError::DeadlineExceeded);
        }
        Ok(answer)
    }
}

/// A session's answers. It holds the stream's place until the transport has let go of it.
pub(crate) struct SessionStream<R> {
    responses: mpsc::Receiver<Result<R, Status>>,
    _permit: OwnedSemaphorePermit,
}

impl<R> Stream for SessionStream<R> {
    type Item = Result<R, Status>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.responses.poll_recv(context)
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

    type StreamRetargetStream = SessionStream<StreamRetargetResponse>;

    async fn stream_retarget(
        &self,
        request: Request<Streaming<StreamRetargetRequest>>,
    ) -> Result<Response<SessionStream<StreamRetargetResponse>>, Status> {
        Ok(Response::new(self.open_session::<RetargetStream>(request)?))
    }

    async fn filter_goal(
        &self,
        request: Request<FilterGoalRequest>,
    ) -> Result<Response<FilterGoalResponse>, Status> {
        Ok(Response::new(self.filter_one(request).await?))
    }

    type StreamFilterGoalStream = SessionStream<StreamFilterGoalResponse>;

    async fn stream_filter_goal(
        &self,
        request: Request<Streaming<StreamFilterGoalRequest>>,
    ) -> Result<Response<SessionStream<StreamFilterGoalResponse>>, Status> {
        Ok(Response::new(self.open_session::<FilterStream>(request)?))
    }

    async fn step_policy(
        &self,
        request: Request<StepPolicyRequest>,
    ) -> Result<Response<StepPolicyResponse>, Status> {
        Ok(Response::new(self.step_one(request).await?))
    }

    type StreamPolicyStream = SessionStream<StreamPolicyResponse>;

    async fn stream_policy(
        &self,
        request: Request<Streaming<StreamPolicyRequest>>,
    ) -> Result<Response<SessionStream<StreamPolicyResponse>>, Status> {
        Ok(Response::new(self.open_session::<PolicyStream>(request)?))
    }

    type TeleoperateStream = SessionStream<TeleoperateResponse>;

    async fn teleoperate(
        &self,
        request: Request<Streaming<TeleoperateRequest>>,
    ) -> Result<Response<SessionStream<TeleoperateResponse>>, Status> {
        let teleoperation = self.teleoperation.clone();
        let serve = |context, inbound, outbound| {
            teleoperation::run(context, teleoperation, inbound, outbound)
        };
        Ok(Response::new(self.open(request, serve)?))
    }
}
