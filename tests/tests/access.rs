//! Who may do what, at the wire: every method for every role, tokens and certificates good and bad, TLS, stolen names.

use std::time::Duration;

use emp_client::{Client, ConnectOptions, TeleoperationConfig};
use emp_proto::FILE_DESCRIPTOR_SET;
use emp_server::{ClientCertificates, NewIdentity, Role, Settings};
use emp_tests::{
    TestServer,
    fake::{self, Gate},
    network::{Folder, HeldStream, call, call_with, until},
    weights, within,
};
use prost::Message as _;
use prost_types::FileDescriptorSet;
use tonic::{
    Code, Status,
    transport::{Channel, Endpoint},
};
use tonic_types::StatusExt as _;

const LIST_MODELS: &str = "/emp.v1.ModelService/ListModels";

const TELEOPERATE: &str = "/emp.v1.MotionService/Teleoperate";

const ROLES: [Role; 5] = [
    Role::Observer,
    Role::Operator,
    Role::Robot,
    Role::Evaluator,
    Role::Admin,
];

/// Every method of the contract and the roles that may call it, written down a second time.
fn allowed(method: &str) -> &'static [Role] {
    use Role::{Admin, Evaluator, Operator, Robot};
    match method {
        // Whoever has credentials sees.
        "GetModel" | "GetRobot" | "ListModels" | "ListRobots" | "GetServerInfo" | "Teleoperate"
        | "Observe" | "ListSessions" | "GetSession" | "ListControllers" => &ROLES,
        "Retarget" | "StreamRetarget" => &[Operator, Robot, Admin],
        "FilterGoal" | "StreamFilterGoal" | "StepPolicy" | "StreamPolicy" => &[Robot, Admin],
        "Control" => &[Operator, Admin],
        "Evaluate" | "StartEvaluation" | "WatchEvaluation" | "ListJobs" | "CancelJob"
        | "CollectRollouts" => &[Evaluator, Admin],
        "EndSession" | "Reload" => &[Admin],
        other => panic!("who may call {other}?"),
    }
}

fn methods() -> Vec<(String, String)> {
    let files = FileDescriptorSet::decode(FILE_DESCRIPTOR_SET).expect("descriptors");
    let services = files.file.into_iter().flat_map(|file| file.service);
    services
        .flat_map(|service| {
            let name = format!("/emp.v1.{}", service.name());
            let methods = service.method.into_iter();
            methods.map(move |method| {
                let path = format!("{name}/{}", method.name());
                (path, method.name().to_owned())
            })
        })
        .collect()
}

fn server(change: impl FnOnce(&mut Settings)) -> anyhow::Result<TestServer> {
    let mut settings = Settings::default();
    change(&mut settings);
    fake::server(settings, &Gate::open())
}

async fn connect(server: &TestServer) -> anyhow::Result<Channel> {
    Ok(Endpoint::from_shared(server.url())?.connect().await?)
}

fn reason(status: &Status) -> String {
    let info = status.get_details_error_info();
    info.map(|info| info.reason).unwrap_or_default()
}

#[tokio::test]
async fn every_method_is_open_to_its_roles_and_to_no_other() -> anyhow::Result<()> {
    let folder = Folder::new()?;
    let mut tokens = Vec::new();
    for role in ROLES {
        tokens.push((role, folder.token(role.name(), &[role], &[])?));
    }
    let server = server(|settings| folder.closed(settings))?;
    let channel = connect(&server).await?;
    let methods = methods();
    assert!(methods.len() >= 12, "{methods:?}");
    for (path, method) in methods {
        for (role, token) in &tokens {
            let status = call(&channel, &path, Some(token)).await?;
            let denied = status.code() == Code::PermissionDenied;
            let may = allowed(&method).contains(role);
            assert_eq!(denied, !may, "{role} {path}: {status:?}");
            assert_ne!(status.code(), Code::Unauthenticated, "{role} {path}");
        }
        let status = call(&channel, &path, None).await?;
        assert_eq!(status.code(), Code::Unauthenticated, "{path}: {status:?}");
    }
    // Probes have no token.
    let health = call(&channel, "/grpc.health.v1.Health/Check", None).await?;
    assert_eq!(health.code(), Code::Ok);
    let reflection = "/grpc.reflection.v1.ServerReflection/ServerReflectionInfo";
    let status = call(&channel, reflection, None).await?;
    assert_eq!(status.code(), Code::Unauthenticated);
    // What is in no table is nobody's.
    let (_, admin) = tokens.last().expect("an admin");
    let unknown = "/emp.v1.ModelService/DropEverything";
    let status = call(&channel, unknown, None).await?;
    assert_eq!(status.code(), Code::Unauthenticated);
    let status = call(&channel, unknown, Some(admin)).await?;
    assert_eq!(status.code(), Code::Unimplemented);
    Ok(())
}

#[tokio::test]
async fn wrong_expired_missing_and_revoked_tokens_are_refused_with_their_reason()
-> anyhow::Result<()> {
    let folder = Folder::new()?;
    let token = folder.token("good", &[Role::Observer], &[])?;
    let expired = folder.add(NewIdentity {
        name: "old".to_owned(),
        roles: vec![Role::Admin],
        days: Some(0),
        ..NewIdentity::default()
    })?;
    let server = server(|settings| folder.closed(settings))?;
    let channel = connect(&server).await?;
    let refused = async |token: Option<&str>| -> anyhow::Result<String> {
        let status = call(&channel, LIST_MODELS, token).await?;
        assert_eq!(status.code(), Code::Unauthenticated, "{status:?}");
        Ok(reason(&status))
    };
    assert_eq!(
        call(&channel, LIST_MODELS, Some(&token)).await?.code(),
        Code::Ok
    );
    assert_eq!(refused(None).await?, "CREDENTIALS_MISSING");
    assert_eq!(refused(Some("emp_00")).await?, "CREDENTIALS_UNKNOWN");
    let other_case = token.to_uppercase();
    assert_eq!(refused(Some(&other_case)).await?, "CREDENTIALS_UNKNOWN");
    assert_eq!(refused(expired.as_deref()).await?, "CREDENTIALS_EXPIRED");

    // A stream that is open ends with its token, and a new token counts, without a restart.
    let mut held = HeldStream::open(&channel, TELEOPERATE, Some(&token)).await??;
    folder.revoke("good")?;
    let end = within("the stream's end", held.answers.message()).await?;
    let status = end.expect_err("revoked");
    assert_eq!(reason(&status), "CREDENTIALS_REVOKED", "{status:?}");
    assert_eq!(refused(Some(&token)).await?, "CREDENTIALS_UNKNOWN");
    let new = folder.token("new", &[Role::Observer], &[])?;
    until("the new token", async || {
        let status = call(&channel, LIST_MODELS, Some(&new)).await;
        status.is_ok_and(|status| status.code() == Code::Ok)
    })
    .await
}

#[tokio::test]
async fn a_token_does_not_reach_sessions_and_ends_that_are_not_its_own() -> anyhow::Result<()> {
    let folder = Folder::new()?;
    let operator = folder.token("operator", &[Role::Operator], &["lab-*"])?;
    let robot = folder.token("robot", &[Role::Robot], &["lab-*"])?;
    let observer = folder.token("observer", &[Role::Observer], &["lab-1"])?;
    let server = TestServer::start_with(&weights()?, |settings| folder.closed(settings))?;
    let client = async |token: &str| {
        let options = ConnectOptions::default().with_token(token);
        Client::connect_with(&server.url(), options).await
    };
    let config = |session: &str| TeleoperationConfig::new("emp27", session);
    let (operator, robot, observer) = (
        client(&operator).await?,
        client(&robot).await?,
        client(&observer).await?,
    );
    let _held = operator.operate(config("lab-1")).await?;
    let _robot = robot.join_as_robot(config("lab-1")).await?;
    let _heard = observer.observe(config("lab-1")).await?;
    let denied = |what: &str, code: Option<Code>| {
        assert_eq!(code, Some(Code::PermissionDenied), "{what}");
    };
    // A name that was overheard opens nothing.
    let stolen = operator.operate(config("other")).await;
    denied(
        "another session",
        stolen.err().and_then(|error| error.code()),
    );
    let stolen = observer.observe(config("lab-2")).await;
    denied(
        "another session",
        stolen.err().and_then(|error| error.code()),
    );
    // Nor does a role open another's end.
    let stolen = observer.operate(config("lab-1")).await;
    denied("operate", stolen.err().and_then(|error| error.code()));
    let stolen = operator.join_as_robot(config("lab-2")).await;
    denied("be the robot", stolen.err().and_then(|error| error.code()));
    let stolen = robot.teleoperate(config("lab-2")).await;
    denied("be both", stolen.err().and_then(|error| error.code()));
    Ok(())
}

#[tokio::test]
async fn tls_keeps_out_who_speaks_in_the_clear_and_whom_the_client_does_not_trust()
-> anyhow::Result<()> {
    let (folder, other) = (Folder::new()?, Folder::new()?);
    let token = folder.token("good", &[Role::Observer], &[])?;
    let server = server(|settings| {
        folder.closed(settings);
        folder.with_tls(settings);
    })?;
    let channel = folder.endpoint(server.port(), None)?.connect().await?;
    let status = call(&channel, LIST_MODELS, Some(&token)).await?;
    assert_eq!(status.code(), Code::Ok, "{status:?}");
    // No downgrade: the port answers nothing in the clear.
    let clear = Client::connect(&server.url()).await;
    let failed = match clear {
        Ok(client) => client.models().await.is_err(),
        Err(_) => true,
    };
    assert!(failed);
    let untrusted = other.endpoint(server.port(), None)?.connect().await;
    assert!(untrusted.is_err());
    // The client library does the same, and sends no token in the clear.
    let url = format!("https://localhost:{}", server.port());
    let options = ConnectOptions::default()
        .with_ca(folder.read("ca.pem")?)
        .with_token(&token);
    let client = Client::connect_with(&url, options.clone()).await?;
    assert_eq!(client.models().await?.len(), 1);
    assert!(!format!("{client:?} {options:?}").contains(&token));
    let clear = ConnectOptions::default().with_token(&token);
    let refused = Client::connect_with("http://192.0.2.1:1", clear).await;
    assert!(
        refused
            .err()
            .is_some_and(|error| error.to_string().contains("in the clear"))
    );
    // A program that makes its own channel adds its own metadata.
    let authorization = format!("Bearer {token}");
    let client = Client::from_channel(channel).with_metadata(move |metadata| {
        metadata.insert("authorization", authorization.parse().expect("a header"));
    });
    assert_eq!(client.models().await?.len(), 1);
    Ok(())
}

#[tokio::test]
async fn a_new_certificate_counts_without_a_restart() -> anyhow::Result<()> {
    let folder = Folder::new()?;
    let server = server(|settings| folder.with_tls(settings))?;
    let before = folder.endpoint(server.port(), None)?.connect().await?;
    // A new authority: who trusts the new one alone cannot connect until the server has read it.
    for name in ["ca.pem", "ca-key.pem"] {
        std::fs::remove_file(folder.path(name))?;
    }
    folder.make_server_certificate()?;
    let endpoint = folder.endpoint(server.port(), None)?;
    until("the new certificate", async || {
        endpoint.connect().await.is_ok()
    })
    .await?;
    // Connections that stand are not cut.
    assert_eq!(call(&before, LIST_MODELS, None).await?.code(), Code::Ok);
    // A damaged file changes nothing.
    std::fs::write(folder.path("server.pem"), "damaged")?;
    tokio::time::sleep(Duration::from_secs(3)).await;
    assert!(endpoint.connect().await.is_ok());
    Ok(())
}

#[tokio::test]
async fn a_client_certificate_is_an_identity_if_its_authority_is_known() -> anyhow::Result<()> {
    let (folder, other) = (Folder::new()?, Folder::new()?);
    folder.add(NewIdentity {
        name: "robot".to_owned(),
        roles: vec![Role::Robot],
        certificates: vec!["robot.lab".to_owned()],
        ..NewIdentity::default()
    })?;
    let token = folder.token("observer", &[Role::Observer], &[])?;
    let start = |client_certificates| {
        server(|settings| {
            folder.closed(settings);
            folder.with_tls(settings);
            settings.tls.client_ca = Some(folder.path("ca.pem"));
            settings.tls.client_certificates = client_certificates;
        })
    };
    let known = folder.client_certificate("robot.lab")?;
    let unknown = folder.client_certificate("stranger.lab")?;
    let foreign = other.client_certificate("robot.lab")?;
    for client_certificates in [ClientCertificates::Optional, ClientCertificates::Required] {
        let server = start(client_certificates)?;
        let connect = |identity| folder.endpoint(server.port(), identity);
        let robot = connect(Some(known.clone()))?.connect().await?;
        assert_eq!(call(&robot, LIST_MODELS, None).await?.code(), Code::Ok);
        let evaluate = call(&robot, "/emp.v1.RolloutService/CollectRollouts", None).await?;
        assert_eq!(evaluate.code(), Code::PermissionDenied);
        let stranger = connect(Some(unknown.clone()))?.connect().await?;
        let status = call(&stranger, LIST_MODELS, None).await?;
        assert_eq!(reason(&status), "CREDENTIALS_UNKNOWN");
        // The right name, signed by another authority.
        let stolen = connect(Some(foreign.clone()))?.connect().await;
        let refused = match stolen {
            Ok(channel) => call(&channel, LIST_MODELS, None).await?.code() != Code::Ok,
            Err(_) => true,
        };
        assert!(refused);
        let without = connect(None)?.connect().await;
        let by_token = match without {
            Ok(channel) => call(&channel, LIST_MODELS, Some(&token)).await?.code(),
            Err(_) => Code::Unavailable,
        };
        let expected = client_certificates == ClientCertificates::Optional;
        assert_eq!(
            by_token == Code::Ok,
            expected,
            "{client_certificates:?} {by_token:?}"
        );
    }
    Ok(())
}

#[tokio::test]
async fn an_identity_has_no_more_than_its_quota() -> anyhow::Result<()> {
    let folder = Folder::new()?;
    let token = folder.token("small", &[Role::Observer], &[])?;
    let text = folder.read("access.toml")?;
    std::fs::write(
        folder.path("access.toml"),
        format!("{text}\n[identity.quota]\nstreams = 3\n"),
    )?;
    let server = server(|settings| folder.closed(settings))?;
    let channel = connect(&server).await?;
    let mut open = Vec::new();
    let mut refused = None;
    for _ in 0..4 {
        match HeldStream::open(&channel, TELEOPERATE, Some(&token)).await? {
            Ok(stream) => open.push(stream),
            Err(status) => refused = Some(status),
        }
    }
    assert_eq!(open.len(), 3);
    let refused = refused.expect("a refusal");
    assert_eq!(refused.code(), Code::ResourceExhausted, "{refused:?}");
    assert_eq!(reason(&refused), "OVERLOADED");
    drop(open);
    until("a free place", async || {
        let status = call(&channel, LIST_MODELS, Some(&token)).await;
        status.is_ok_and(|status| status.code() == Code::Ok)
    })
    .await
}

#[tokio::test]
async fn the_audit_log_says_who_did_what() -> anyhow::Result<()> {
    let folder = Folder::new()?;
    let token = folder.token("eve", &[Role::Observer, Role::Operator], &["lab"])?;
    let server = TestServer::start_with(&weights()?, |settings| {
        folder.closed(settings);
        settings.access.audit = Some(folder.path("audit.jsonl"));
    })?;
    let options = ConnectOptions::default().with_token(&token);
    let client = Client::connect_with(&server.url(), options).await?;
    drop(
        client
            .operate(TeleoperationConfig::new("emp27", "lab"))
            .await?,
    );
    assert!(
        client
            .operate(TeleoperationConfig::new("emp27", "other"))
            .await
            .is_err()
    );
    let channel = connect(&server).await?;
    let collect = "/emp.v1.RolloutService/CollectRollouts";
    call_with(&channel, collect, Some(&token), Vec::new()).await?;
    let events = async || -> Vec<serde_json::Value> {
        let text = folder.read("audit.jsonl").unwrap_or_default();
        let lines = text.lines();
        lines
            .map(|line| serde_json::from_str(line).expect("JSON"))
            .collect()
    };
    let has = |events: &[serde_json::Value], event: &str, key: &str, value: &str| {
        events.iter().any(|found| {
            found["event"] == event
                && found["identity"] == "eve"
                && found[key]
                    .as_str()
                    .is_some_and(|found| found.contains(value))
                && found["time"].is_string()
                && found["peer"]
                    .as_str()
                    .is_some_and(|peer| peer.starts_with("127.0.0.1:"))
        })
    };
    until("the events", async || {
        let events = events().await;
        has(&events, "session joined", "session", "lab")
            && has(&events, "call ended", "method", "Teleoperate")
            && has(&events, "refused", "session", "other")
            && has(&events, "refused", "method", "CollectRollouts")
    })
    .await?;
    assert!(!folder.read("audit.jsonl")?.contains(&token));
    Ok(())
}
