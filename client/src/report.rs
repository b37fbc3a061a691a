//! What the server has, as tables or JSON.

use std::process::ExitCode;

use emp_client::{Client, Joint, Model, Robot};
use serde_json::{Value, json};

pub(crate) async fn models(client: &Client, as_json: bool) -> anyhow::Result<ExitCode> {
    let models = client.models().await?;
    if as_json {
        println!("{}", Value::from_iter(models.iter().map(model_json)));
    } else {
        println!("{:<24} {:<14} {:<10} joints", "model", "version", "robot");
        for model in &models {
            let joints = model.joint_names.len();
            println!(
                "{:<24} {:<14} {:<10} {joints}",
                model.name, model.version, model.robot
            );
        }
    }
    Ok(ExitCode::SUCCESS)
}

pub(crate) async fn robots(client: &Client, as_json: bool) -> anyhow::Result<ExitCode> {
    let mut robots = Vec::new();
    for summary in client.robots().await? {
        if summary.serving {
            robots.push(client.robot(&summary.name).await?);
        } else {
            eprintln!("emp: {} is not served: {}", summary.name, summary.reason);
        }
    }
    if as_json {
        println!("{}", Value::from_iter(robots.iter().map(robot_json)));
    } else {
        robots.iter().for_each(print_robot);
    }
    Ok(ExitCode::SUCCESS)
}

fn print_robot(robot: &Robot) {
    let (goal, legs) = (robot.goal_joints.len(), robot.leg_joints.len());
    println!(
        "{}: {goal} goal joints, {legs} leg joints, {} Hz",
        robot.name, robot.control_rate
    );
    println!(
        "  {:<28} {:>8} {:>8} {:>8}",
        "goal joint (rad)", "lower", "upper", "default"
    );
    for joint in &robot.goal_joints {
        let Joint {
            name,
            lower_limit,
            upper_limit,
            default_angle,
            ..
        } = joint;
        println!("  {name:<28} {lower_limit:>8.3} {upper_limit:>8.3} {default_angle:>8.3}");
    }
}

fn model_json(model: &Model) -> Value {
    let training = model.training.as_ref().map(struct_json);
    json!({
        "name": model.name,
        "version": model.version,
        "kind": model.kind().as_str_name().trim_start_matches("MODEL_KIND_").to_lowercase(),
        "robot": model.robot,
        "joint_names": model.joint_names,
        "weights_sha256": model.weights_sha256,
        "git_revision": model.git_revision,
        "training": training,
    })
}

fn struct_json(object: &prost_types::Struct) -> Value {
    let fields = object.fields.iter();
    Value::from_iter(fields.map(|(key, value)| (key.clone(), value_json(value))))
}

fn value_json(value: &prost_types::Value) -> Value {
    use prost_types::value::Kind;
    match &value.kind {
        None | Some(Kind::NullValue(_)) => Value::Null,
        Some(Kind::NumberValue(number)) => json!(number),
        Some(Kind::StringValue(text)) => json!(text),
        Some(Kind::BoolValue(value)) => json!(value),
        Some(Kind::ListValue(list)) => Value::from_iter(list.values.iter().map(value_json)),
        Some(Kind::StructValue(object)) => struct_json(object),
    }
}

fn robot_json(robot: &Robot) -> Value {
    let key_nodes = robot.key_nodes.iter().map(|node| {
        json!({ "name": node.name, "body": node.body, "offset": [node.offset_x, node.offset_y, node.offset_z] })
    });
    json!({
        "name": robot.name,
        "control_rate": robot.control_rate,
        "goal_joints": joints_json(&robot.goal_joints),
        "leg_joints": joints_json(&robot.leg_joints),
        "key_nodes": Value::from_iter(key_nodes),
    })
}

fn joints_json(joints: &[Joint]) -> Value {
    Value::from_iter(joints.iter().map(|joint| {
        json!({
            "name": joint.name,
            "lower_limit": joint.lower_limit,
            "upper_limit": joint.upper_limit,
            "default_angle": joint.default_angle,
            "kp": joint.kp,
            "kd": joint.kd,
            "torque_limit": joint.torque_limit,
            "velocity_limit": joint.velocity_limit,
        })
    }))
}
