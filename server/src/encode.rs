//! The server's own values as messages.

use std::time::Duration;

use emp_models::{
    CheckpointMetadata,
    assessment::{Assessment, Reason},
    controller::ControllerOutput,
    filters::Risk,
    retarget::AT_LIMIT,
};
use emp_proto::v1;
use emp_robot::{Foot, Joint, LinkSphere, Robot};
use prost_types::{ListValue, Struct, Value, value::Kind};

use crate::inference::{controllers::EmpMode, queue::Answer};

pub(crate) fn timing<O>(answer: &Answer<O>) -> v1::Timing {
    v1::Timing {
        queue_time: Some(duration(answer.queue_time)),
        inference_time: Some(duration(answer.inference_time)),
        batch_size: count(answer.batch_size),
    }
}

/// `angles` are the final ones, in goal order; smoothing may have moved them off the model's.
pub(crate) fn retarget_result(
    robot: &Robot,
    angles: Vec<f32>,
    direction_error: f32,
) -> v1::RetargetResult {
    let joints_at_limit = robot
        .goal_joints()
        .iter()
        .zip(&angles)
        .enumerate()
        .filter(|(_, (joint, angle))| stands_at_limit(joint, f64::from(**angle)))
        .map(|(index, _)| count(index))
        .collect();
    v1::RetargetResult {
        joint_angles: angles,
        direction_error,
        joints_at_limit,
    }
}

fn stands_at_limit(joint: &Joint, angle: f64) -> bool {
    let [lower, upper] = joint.range;
    angle <= lower + AT_LIMIT || angle >= upper - AT_LIMIT
}

pub(crate) fn policy_result(
    mode: EmpMode,
    output: ControllerOutput,
    assessment: Assessment,
) -> v1::PolicyResult {
    let ControllerOutput {
        goal,
        action,
        leg_targets,
        risk,
        ..
    } = output;
    let filter = (mode != EmpMode::Off).then(|| filter_result(goal.clone(), risk, assessment));
    v1::PolicyResult {
        executable_goal: goal,
        action,
        leg_targets,
        filter,
    }
}

pub(crate) fn filter_result(
    executable_goal: Vec<f32>,
    risk: Option<Risk>,
    assessment: Assessment,
) -> v1::FilterResult {
    let nearest = assessment.nearest_links;
    let links = nearest.map(|nearest| nearest.links.map(count));
    let reasons = assessment.reasons.into_iter().map(change_reason);
    v1::FilterResult {
        executable_goal,
        change: assessment.change,
        regloss: risk.map(|risk| risk.regloss),
        danger: risk.is_some_and(|risk| risk.danger),
        applied: risk.map_or(0.0, |risk| risk.applied),
        center_of_mass_margin: assessment.center_of_mass_margin,
        smallest_link_distance: nearest.map(|nearest| nearest.distance),
        nearest_links: links.into_iter().flatten().collect(),
        reasons: reasons.map(i32::from).collect(),
    }
}

fn change_reason(reason: Reason) -> v1::ChangeReason {
    match reason {
        Reason::Balance => v1::ChangeReason::Balance,
        Reason::SelfCollision => v1::ChangeReason::SelfCollision,
        Reason::JointLimit => v1::ChangeReason::JointLimit,
        Reason::Speed => v1::ChangeReason::Speed,
    }
}

pub(crate) fn model_card(
    name: String,
    kind: v1::ModelKind,
    joints: &[Joint],
    metadata: &CheckpointMetadata,
) -> v1::Model {
    v1::Model {
        name,
        version: metadata.version().to_owned(),
        kind: kind.into(),
        robot: metadata.robot.clone(),
        joint_names: joint_names(joints),
        weights_sha256: metadata.sha256.clone(),
        git_revision: metadata.git_revision.clone(),
        training: Some(json_object(&metadata.training)),
    }
}

/// A JSON object as a message; what is none is put into one.
fn json_object(value: &serde_json::Value) -> Struct {
    match json(value).kind {
        Some(Kind::StructValue(object)) => object,
        kind => Struct {
            fields: [("value".to_owned(), Value { kind })].into(),
        },
    }
}

fn json(value: &serde_json::Value) -> Value {
    use serde_json::Value as Json;
    let kind = match value {
        Json::Null => Kind::NullValue(0),
        Json::Bool(value) => Kind::BoolValue(*value),
        Json::Number(number) => Kind::NumberValue(number.as_f64().unwrap_or(f64::NAN)),
        Json::String(text) => Kind::StringValue(text.clone()),
        Json::Array(values) => Kind::ListValue(ListValue {
            values: values.iter().map(json).collect(),
        }),
        Json::Object(fields) => Kind::StructValue(Struct {
            fields: fields
                .iter()
                .map(|(key, value)| (key.clone(), json(value)))
                .collect(),
        }),
    };
    Value { kind: Some(kind) }
}

pub(crate) fn joint_names(joints: &[Joint]) -> Vec<String> {
    joints.iter().map(|joint| joint.name.clone()).collect()
}

pub(crate) fn robot(robot: &Robot) -> v1::Robot {
    let key_nodes = robot.key_nodes().iter().map(|site| {
        let [offset_x, offset_y, offset_z] = site.offset;
        v1::KeyNode {
            name: site.name.to_owned(),
            body: site.body.clone(),
            offset_x,
            offset_y,
            offset_z,
        }
    });
    v1::Robot {
        name: robot.name().to_owned(),
        goal_joints: robot.goal_joints().iter().map(joint).collect(),
        leg_joints: robot.leg_joints().iter().map(joint).collect(),
        control_rate: robot.control_rate_hz(),
        key_nodes: key_nodes.collect(),
        action_scale: robot.action_scale(),
        links: robot.link_spheres().iter().map(link).collect(),
        feet: robot.feet().iter().map(foot).collect(),
    }
}

fn link(link: &LinkSphere) -> v1::Link {
    let [center_x, center_y, center_z] = link.center;
    v1::Link {
        name: link.name.clone(),
        body: link.body.clone(),
        center_x,
        center_y,
        center_z,
        radius: link.radius,
    }
}

fn foot(foot: &Foot) -> v1::Foot {
    let contacts = foot.centers.iter();
    v1::Foot {
        body: foot.body.clone(),
        radius: foot.radius,
        contacts: contacts
            .map(|&[x, y, z]| v1::ContactPoint { x, y, z })
            .collect(),
    }
}

fn joint(joint: &Joint) -> v1::Joint {
    v1::Joint {
        name: joint.name.clone(),
        lower_limit: joint.range[0],
        upper_limit: joint.range[1],
        default_angle: joint.default,
        kp: joint.kp,
        kd: joint.kd,
        torque_limit: joint.torque_limit,
        velocity_limit: joint.velocity_limit,
    }
}

/// A mode as messages have it; never unspecified.
pub(crate) fn emp_mode(mode: EmpMode) -> v1::EmpMode {
    match mode {
        EmpMode::Off => v1::EmpMode::Off,
        EmpMode::On => v1::EmpMode::On,
        EmpMode::WhenDanger => v1::EmpMode::WhenDanger,
    }
}

/// A count as messages have it.
pub(crate) fn count(count: usize) -> u32 {
    u32::try_from(count).unwrap_or(u32::MAX)
}

pub(crate) fn duration(duration: Duration) -> prost_types::Duration {
    // Only durations of more than 2^63 seconds do not fit.
    prost_types::Duration::try_from(duration).unwrap_or_default()
}
