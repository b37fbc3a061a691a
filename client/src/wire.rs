//! Poses as messages, and messages as this crate's values.

use std::time::{Duration, SystemTime};

use emp_motion::{KeyNode, KeyNodeFrame};
use emp_proto::v1;
use nalgebra::{Rotation3, UnitQuaternion};

use crate::stream::{
    Answer, AnswerTimes, DropCause, Dropped, FilterAnswer, GoalFrame, PolicyAnswer, RobotFrame,
};

pub(crate) fn pose(frame: &KeyNodeFrame) -> v1::HumanPose {
    let position = |node: KeyNode| {
        let p = frame.positions[node as usize];
        Some(v1::Position {
            x: p.x,
            y: p.y,
            z: p.z,
        })
    };
    let [left, right] = &frame.wrist_rotations;
    v1::HumanPose {
        waist: position(KeyNode::Waist),
        torso: position(KeyNode::Torso),
        left_shoulder: position(KeyNode::LeftShoulder),
        right_shoulder: position(KeyNode::RightShoulder),
        left_elbow: position(KeyNode::LeftElbow),
        right_elbow: position(KeyNode::RightElbow),
        left_wrist: position(KeyNode::LeftWrist),
        right_wrist: position(KeyNode::RightWrist),
        left_wrist_orientation: left.as_ref().map(hand),
        right_wrist_orientation: right.as_ref().map(hand),
        ..v1::HumanPose::default()
    }
}

fn hand(rotation: &Rotation3<f32>) -> v1::Quaternion {
    quaternion(&UnitQuaternion::from_rotation_matrix(rotation))
}

fn quaternion(q: &UnitQuaternion<f32>) -> v1::Quaternion {
    v1::Quaternion {
        w: q.w,
        x: q.i,
        y: q.j,
        z: q.k,
    }
}

pub(crate) fn header(sequence_number: u64, time_budget: Option<Duration>) -> v1::FrameHeader {
    v1::FrameHeader {
        sequence_number,
        capture_time: Some(SystemTime::now().into()),
        // A budget that does not fit a message is no limit.
        time_budget: time_budget.and_then(|budget| budget.try_into().ok()),
    }
}

pub(crate) fn robot_frame(header: v1::FrameHeader, frame: &RobotFrame) -> v1::PolicyFrame {
    v1::PolicyFrame {
        header: Some(header),
        state: Some(state(&frame.joint_positions, &frame.orientation, None)),
        goal: frame.goal.clone(),
        reset: frame.reset,
    }
}

pub(crate) fn goal_frame(header: v1::FrameHeader, frame: &GoalFrame) -> v1::FilterGoalFrame {
    v1::FilterGoalFrame {
        header: Some(header),
        state: Some(state(&frame.joint_positions, &frame.orientation, None)),
        goal: frame.goal.clone(),
        last_action: frame.last_action.clone(),
        reset: frame.reset,
    }
}

pub(crate) fn observation(frame: &GoalFrame) -> v1::PolicyObservation {
    v1::PolicyObservation {
        state: Some(state(&frame.joint_positions, &frame.orientation, None)),
        goal: frame.goal.clone(),
        last_action: frame.last_action.clone(),
    }
}

pub(crate) fn state(
    joint_positions: &[f32],
    orientation: &UnitQuaternion<f64>,
    measured: Option<Duration>,
) -> v1::RobotState {
    v1::RobotState {
        joint_positions: joint_positions.to_vec(),
        base_orientation: Some(quaternion(&orientation.cast())),
        // A time that does not fit a message is none.
        measurement_time: measured.and_then(|time| time.try_into().ok()),
        ..v1::RobotState::default()
    }
}

pub(crate) fn answer(
    sequence_number: u64,
    result: v1::RetargetResult,
    times: AnswerTimes,
) -> Answer {
    Answer {
        sequence_number,
        joint_angles: result.joint_angles,
        direction_error: result.direction_error,
        joints_at_limit: result.joints_at_limit,
        times,
    }
}

pub(crate) fn policy_answer(
    sequence_number: u64,
    result: v1::PolicyResult,
    times: AnswerTimes,
) -> PolicyAnswer {
    PolicyAnswer {
        sequence_number,
        executable_goal: result.executable_goal,
        action: result.action,
        leg_targets: result.leg_targets,
        filter: result.filter,
        times,
    }
}

pub(crate) fn filter_answer(
    sequence_number: u64,
    result: v1::FilterResult,
    times: AnswerTimes,
) -> FilterAnswer {
    FilterAnswer {
        sequence_number,
        result,
        times,
    }
}

pub(crate) fn times(timing: Option<v1::Timing>, latency: Duration) -> AnswerTimes {
    let timing = timing.unwrap_or_default();
    AnswerTimes {
        queue_time: duration(timing.queue_time),
        inference_time: duration(timing.inference_time),
        batch_size: timing.batch_size,
        latency,
    }
}

pub(crate) fn dropped(message: v1::DroppedFrame) -> Dropped {
    let reason = message.reason();
    Dropped {
        sequence_number: message.header.unwrap_or_default().sequence_number,
        cause: DropCause::Server(reason),
        field: message.field,
        description: message.description,
    }
}

pub(crate) fn duration(duration: Option<prost_types::Duration>) -> Duration {
    duration
        .and_then(|duration| duration.try_into().ok())
        .unwrap_or_default()
}
