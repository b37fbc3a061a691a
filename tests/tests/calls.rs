//! Single calls: what they answer, what they refuse, and how.

use std::time::Duration;

use emp_client::{Client, ClientError};
use emp_models::retarget::{Mode, RetargetInput, Retargeter};
use emp_motion::KeyNodeFrame;
use emp_proto::v1::{self, FrameHeader, HumanPose, Position, RetargetRequest};
use emp_server::Settings;
use emp_tests::{
    TestServer, emp27,
    fake::{self, Gate},
    poses,
    raw::{self, wrong_field},
    weights, within,
};
use tonic::{Code, Request, metadata::MetadataValue};
use tonic_types::StatusExt as _;

/// Largest difference between a pose that was computed alone and in a batch, radians: a batch adds in another order.
const BATCH_TOLERANCE: f32 = 1e-3;
/// Of 64 unrefined poses, how many may differ by more: where two codes of the codebook are equally near, the last bits
/// decide between them. Refinement leads both to the same answer.
const CODE_TIES: usize = 3;
/// Either code points the arms the same way, radians.
const DIRECTION_TOLERANCE: f32 = 0.02;

fn request(pose: Option<HumanPose>) -> RetargetRequest {
    RetargetRequest {
        robot: "emp27".to_owned(),
        pose,
        ..RetargetRequest::default()
    }
}

fn good_pose() -> HumanPose {
    raw::pose(&fake::pose(0.1))
}

#[tokio::test]
async fn real_weights_answer_as_in_process_and_batches_as_single() -> anyhow::Result<()> {
    let weights = weights()?.join("emp27-retargeter.safetensors");
    let model = Retargeter::load(&weights, emp27()?)?;
    let server = TestServer::start_real()?;
    let client = Client::connect(&server.url()).await?;
    let poses = poses(7, 64);
    for refine in [false, true] {
        let calls: Vec<_> = poses
            .iter()
            .cloned()
            .map(|pose| {
                let client = client.clone();
                tokio::spawn(async move { client.retarget("emp27", &pose, refine).await })
            })
            .collect();
        let (mut largest_batch, mut differing) = (0, 0);
        for (pose, call) in poses.iter().zip(calls) {
            let answer = within("an answer", call).await???;
            let input = RetargetInput {
                frame: pose.clone(),
                mode: if refine { Mode::Begin } else { Mode::Network },
            };
            let alone = model.retarget(&[input])?.remove(0);
            assert_eq!(answer.joint_angles.len(), alone.angles.len());
            let pairs = answer.joint_angles.iter().zip(&alone.angles);
            let difference = pairs
                .map(|(served, alone)| (served - alone).abs())
                .fold(0.0, f32::max);
            differing += usize::from(difference > BATCH_TOLERANCE);
            assert!((answer.direction_error - alone.direction_error).abs() <= DIRECTION_TOLERANCE);
            largest_batch = largest_batch.max(answer.times.batch_size);
        }
        let allowed = if refine { 0 } else { CODE_TIES };
        assert!(
            differing <= allowed,
            "{differing} of 64 answers differ, refine {refine}"
        );
        assert!(largest_batch > 1, "64 calls at once never met in a batch");
    }
    Ok(())
}

#[tokio::test]
async fn the_model_service_says_what_is_served() -> anyhow::Result<()> {
    let server = TestServer::start_real()?;
    let client = Client::connect(&server.url()).await?;
    let robot = emp27()?;
    let models = client.models().await?;
    let model = models
        .iter()
        .find(|model| model.name == "emp27-retargeter")
        .expect("emp27's retargeter");
    assert_eq!(*model, client.model(&model.name).await?);
    assert_eq!(model.weights_sha256.len(), 64);
    let served = client.robot("emp27").await?;
    assert_eq!(served.control_rate, robot.control_rate_hz());
    let names: Vec<_> = served.goal_joints.iter().map(|joint| &joint.name).collect();
    assert!(names.iter().copied().eq(&model.joint_names));
    for (served, joint) in served
        .goal_joints
        .iter()
        .chain(&served.leg_joints)
        .zip(robot.goal_joints().iter().chain(robot.leg_joints()))
    {
        assert_eq!(served.name, joint.name);
        assert_eq!([served.lower_limit, served.upper_limit], joint.range);
        assert_eq!([served.kp, served.kd], [joint.kp, joint.kd]);
    }
    assert_eq!(served.key_nodes.len(), emp_motion::KEY_NODES);
    for error in [
        client.robot("nobody").await.err(),
        client.model("nothing").await.err(),
    ] {
        let error: ClientError = error.expect("refused");
        assert_eq!(
            (error.code(), error.reason().as_deref()),
            (Some(Code::NotFound), Some("NOT_FOUND"))
        );
        assert!(
            error.to_string().contains("emp27"),
            "it says what there is: {error}"
        );
    }
    Ok(())
}

#[tokio::test]
async fn wrong_fields_are_refused_by_name() -> anyhow::Result<()> {
    let server = fake::server(Settings::default(), &Gate::open())?;
    let mut client = server.raw_client().await?;
    let far = Some(Position {
        x: 1e6,
        y: 0.0,
        z: 0.0,
    });
    let nan = Some(Position {
        x: 0.0,
        y: f32::NAN,
        z: 0.0,
    });
    let cases = [
        (
            "robot",
            RetargetRequest {
                robot: "emp99".to_owned(),
                ..request(Some(good_pose()))
            },
        ),
        (
            "model",
            RetargetRequest {
                model: "other".to_owned(),
                ..request(Some(good_pose()))
            },
        ),
        (
            "model_version",
            RetargetRequest {
                model_version: "0".to_owned(),
                ..request(Some(good_pose()))
            },
        ),
        ("pose", request(None)),
        (
            "previous_joint_angles",
            RetargetRequest {
                refine: true,
                previous_joint_angles: vec![0.0; 3],
                ..request(Some(good_pose()))
            },
        ),
        (
            "previous_joint_angles",
            RetargetRequest {
                previous_joint_angles: vec![0.0; 15],
                ..request(Some(good_pose()))
            },
        ),
        (
            "previous_joint_angles[14]",
            RetargetRequest {
                refine: true,
                previous_joint_angles: [vec![0.0; 14], vec![f32::NAN]].concat(),
                ..request(Some(good_pose()))
            },
        ),
        (
            "pose.left_wrist",
            request(Some(HumanPose {
                left_wrist: None,
                ..good_pose()
            })),
        ),
        (
            "pose.left_wrist.y",
            request(Some(HumanPose {
                left_wrist: nan,
                ..good_pose()
            })),
        ),
        (
            "pose.right_elbow",
            request(Some(HumanPose {
                right_elbow: far,
                ..good_pose()
            })),
        ),
        (
            "pose.torso",
            request(Some(HumanPose {
                torso: good_pose().waist,
                ..good_pose()
            })),
        ),
        (
            "pose.left_wrist_orientation",
            request(Some(HumanPose {
                left_wrist_orientation: Some(Default::default()),
                ..good_pose()
            })),
        ),
    ];
    for (field, request) in cases {
        let status = client.retarget(request).await.expect_err("refused");
        assert_eq!(wrong_field(&status), field);
    }
    let answer = client
        .retarget(request(Some(good_pose())))
        .await?
        .into_inner();
    assert_eq!(
        answer.result.expect("a result").joint_angles,
        [fake::expected(&fake::pose(0.1)); 15]
    );
    Ok(())
}

#[tokio::test]
async fn a_robot_without_weights_is_served_by_inverse_kinematics() -> anyhow::Result<()> {
    let weights = tempfile::tempdir()?;
    let server = TestServer::start_with(weights.path(), |_| {})?;
    let client = Client::connect(&server.url()).await?;
    let model = client.model("emp27-ik").await?;
    assert_eq!(model.kind(), v1::ModelKind::Retargeter);
    assert_eq!(model.version.len(), 12);
    assert!(model.weights_sha256.is_empty(), "{model:?}");
    for refine in [false, true] {
        let answer = client.retarget("emp27", &fake::pose(0.1), refine).await?;
        assert!(answer.direction_error < 0.01, "{answer:?}");
    }
    Ok(())
}

#[tokio::test]
async fn a_call_follows_from_the_previous_answer() -> anyhow::Result<()> {
    let server = TestServer::start_real()?;
    let mut client = server.raw_client().await?;
    let ask = |pose: KeyNodeFrame, previous: &[f32]| RetargetRequest {
        refine: true,
        previous_joint_angles: previous.to_vec(),
        ..request(Some(raw::pose(&pose)))
    };
    let angles = |response: tonic::Response<v1::RetargetResponse>| {
        response
            .into_inner()
            .result
            .unwrap_or_default()
            .joint_angles
    };
    let first = angles(client.retarget(ask(fake::pose(0.0), &[])).await?);
    let robot = emp27()?;
    // The person stands still: the robot comes from far away at a bounded speed, and stays.
    let joints = first.iter().zip(robot.goal_joints());
    let mut previous: Vec<f32> = joints
        .map(|(angle, joint)| (angle + 0.3).min(joint.range[1] as f32))
        .collect();
    for _ in 0..100 {
        let next = angles(client.retarget(ask(fake::pose(0.0), &previous)).await?);
        for ((before, after), joint) in previous.iter().zip(&next).zip(robot.goal_joints()) {
            let step = f64::from((after - before).abs());
            assert!(
                step <= joint.velocity_limit / robot.control_rate_hz() + 1e-6,
                "{}",
                joint.name
            );
        }
        previous = next;
    }
    for (there, first) in previous.iter().zip(&first) {
        assert!((there - first).abs() < 0.02, "{there} {first}");
    }
    Ok(())
}

#[tokio::test]
async fn an_oversize_message_is_refused() -> anyhow::Result<()> {
    let server = fake::server(Settings::default(), &Gate::open())?;
    let mut client = server.raw_client().await?;
    let huge = RetargetRequest {
        robot: "x".repeat(300 << 10),
        ..request(Some(good_pose()))
    };
    let status = client.retarget(huge).await.expect_err("refused");
    assert_eq!(status.code(), Code::OutOfRange, "{status:?}");
    client.retarget(request(Some(good_pose()))).await?;
    Ok(())
}

#[tokio::test]
async fn deadlines_end_calls_with_deadline_exceeded() -> anyhow::Result<()> {
    let gate = Gate::closed();
    let server = fake::server(Settings::default(), &gate)?;
    let mut client = server.raw_client().await?;

    let mut call = Request::new(request(Some(good_pose())));
    call.metadata_mut()
        .insert("grpc-timeout", MetadataValue::from_static("3S"));
    let status = within("the timeout", client.retarget(call))
        .await?
        .expect_err("late");
    assert_eq!(status.code(), Code::DeadlineExceeded, "{status:?}");
    assert!(
        status.get_error_details().error_info().is_some(),
        "the server's own answer: {status:?}"
    );

    let budget = |seconds, nanos| FrameHeader {
        time_budget: Some(prost_types::Duration { seconds, nanos }),
        ..FrameHeader::default()
    };
    for header in [budget(0, 50_000_000), budget(0, 0)] {
        let call = RetargetRequest {
            header: Some(header),
            ..request(Some(good_pose()))
        };
        let status = within("the budget's end", client.retarget(call))
            .await?
            .expect_err("late");
        assert_eq!(status.code(), Code::DeadlineExceeded, "{status:?}");
    }
    let call = RetargetRequest {
        header: Some(budget(-1, 0)),
        ..request(Some(good_pose()))
    };
    assert_eq!(
        wrong_field(&client.retarget(call).await.expect_err("refused")),
        "header.time_budget"
    );

    let mut call = Request::new(request(Some(good_pose())));
    call.metadata_mut()
        .insert("grpc-timeout", MetadataValue::from_static("soon"));
    assert_eq!(
        wrong_field(&client.retarget(call).await.expect_err("refused")),
        "grpc-timeout"
    );
    Ok(())
}

#[tokio::test]
async fn a_full_queue_refuses_calls_and_says_when_to_come_back() -> anyhow::Result<()> {
    let gate = Gate::closed();
    let mut settings = Settings::default();
    settings.batching.queue = 1.try_into()?;
    let server = fake::server(settings, &gate)?;
    let client = server.raw_client().await?;
    let call = || {
        let mut client = client.clone();
        tokio::spawn(async move { client.retarget(request(Some(good_pose()))).await })
    };
    let in_model = call();
    within("the model to be busy", gate.has_entered(1)).await?;
    // One of these waits in the queue, the other finds it full; which is which is up to the network.
    let (one, other) = (call(), call());
    let mut one_is_refused = None;
    within("a refusal", async {
        while one_is_refused.is_none() {
            tokio::time::sleep(Duration::from_millis(1)).await;
            one_is_refused = one
                .is_finished()
                .then_some(true)
                .or(other.is_finished().then_some(false));
        }
    })
    .await?;
    let (refused, waiting) = if one_is_refused == Some(true) {
        (one, other)
    } else {
        (other, one)
    };
    let status = refused.await?.expect_err("no room");
    assert_eq!(status.code(), Code::ResourceExhausted, "{status:?}");
    let details = status.get_error_details();
    assert!(
        details
            .retry_info()
            .and_then(|info| info.retry_delay)
            .is_some_and(|delay| !delay.is_zero())
    );
    assert_eq!(
        details.error_info().expect("ErrorInfo").reason,
        "OVERLOADED"
    );
    gate.let_batches_pass();
    for call in [in_model, waiting] {
        within("an answer", call).await???;
    }
    Ok(())
}
