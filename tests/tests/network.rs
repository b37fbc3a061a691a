//! One port, seen from outside: browsers, probes, monitoring; connections that are silent, too many, or send too much; a log that
//! cannot be written.

use std::{
    ffi::OsStr,
    net::SocketAddr,
    process::{Command, Stdio},
    time::{Duration, Instant},
};

use emp_client::Client;
use emp_proto::v1::{GetRobotRequest, GetRobotResponse};
use emp_server::{Drain, Role, Settings};
use emp_tests::{
    TestServer,
    fake::{self, Gate},
    network::{Folder, HeldStream, call, call_with, exchange, http, until},
    process::{ServerProcess, binaries},
    within,
};
use prost::Message as _;
use tokio::{
    io::{AsyncReadExt as _, AsyncWriteExt as _},
    net::TcpStream,
};
use tonic::{
    Code,
    transport::{Channel, Endpoint},
};

const GET_ROBOT: &str = "/emp.v1.ModelService/GetRobot";
const LIST_MODELS: &str = "/emp.v1.ModelService/ListModels";
const TELEOPERATE: &str = "/emp.v1.MotionService/Teleoperate";
const GRPC_WEB: (&str, &str) = ("content-type", "application/grpc-web+proto");

fn server(change: impl FnOnce(&mut Settings)) -> anyhow::Result<TestServer> {
    let mut settings = Settings::default();
    change(&mut settings);
    fake::server(settings, &Gate::open())
}

async fn connect(server: &TestServer) -> anyhow::Result<Channel> {
    Ok(Endpoint::from_shared(server.url())?.connect().await?)
}

/// A message in gRPC's frame.
fn framed(message: &impl prost::Message) -> Vec<u8> {
    let bytes = message.encode_to_vec();
    let length = u32::try_from(bytes.len()).expect("a short message");
    [&[0], &length.to_be_bytes()[..], &bytes].concat()
}

/// The frames of an answer of gRPC-Web: the flag and the content of each.
fn frames(mut body: &[u8]) -> Vec<(u8, Vec<u8>)> {
    let mut frames = Vec::new();
    while body.len() >= 5 {
        let length = u32::from_be_bytes([body[1], body[2], body[3], body[4]]) as usize;
        frames.push((body[0], body[5..5 + length].to_vec()));
        body = &body[5 + length..];
    }
    frames
}

#[tokio::test]
async fn a_browser_calls_by_grpc_web_over_http_1() -> anyhow::Result<()> {
    let server = server(|_| {})?;
    let request = framed(&GetRobotRequest {
        name: "emp27".to_owned(),
    });
    let call = async |headers: &[(&str, &str)]| {
        http(server.address(), "POST", GET_ROBOT, headers, &request).await
    };
    let answer = call(&[GRPC_WEB, ("x-grpc-web", "1")]).await?;
    assert_eq!(answer.status, 200, "{answer:?}");
    let frames = frames(&answer.body);
    let [(0, message), (0x80, trailers)] = &*frames else {
        panic!("{frames:?}");
    };
    let robot = GetRobotResponse::decode(&**message)?
        .robot
        .expect("a robot");
    assert_eq!(robot.name, "emp27");
    assert!(String::from_utf8_lossy(trailers).contains("grpc-status:0"));
    assert!(answer.header("x-request-id").is_some());

    // Its own pages may call, those of others may not, also not by a name that was pointed here.
    let own = format!("http://{}", server.address());
    assert_eq!(call(&[GRPC_WEB, ("origin", &own)]).await?.status, 200);
    let foreign = call(&[GRPC_WEB, ("origin", "http://evil.example")]).await?;
    assert_eq!(foreign.status, 403);
    let rebound = [
        GRPC_WEB,
        ("host", "evil.example"),
        ("origin", "http://evil.example"),
    ];
    assert_eq!(call(&rebound).await?.status, 403);
    // A text form, as browsers without binary streams use it, and a refusal by name.
    let unknown = framed(&GetRobotRequest {
        name: "nobody".to_owned(),
    });
    let answer = http(server.address(), "POST", GET_ROBOT, &[GRPC_WEB], &unknown).await?;
    let status = answer.header("grpc-status").map(str::to_owned);
    let in_body = String::from_utf8_lossy(&answer.body).contains("grpc-status:5");
    assert!(status.as_deref() == Some("5") || in_body, "{answer:?}");
    Ok(())
}

#[tokio::test]
async fn pages_of_other_origins_may_call_if_they_are_allowed() -> anyhow::Result<()> {
    let origin = "https://console.example";
    let server = server(|settings| settings.http.allowed_origins.push(origin.to_owned()))?;
    let preflight = async |origin: &str| {
        let headers = [
            ("origin", origin),
            ("access-control-request-method", "POST"),
            (
                "access-control-request-headers",
                "content-type,x-grpc-web,authorization",
            ),
        ];
        http(server.address(), "OPTIONS", GET_ROBOT, &headers, &[]).await
    };
    let allowed = preflight(origin).await?;
    assert_eq!(
        allowed.header("access-control-allow-origin"),
        Some(origin),
        "{allowed:?}"
    );
    let headers = allowed
        .header("access-control-allow-headers")
        .unwrap_or_default();
    assert!(headers.contains("x-grpc-web") && headers.contains("authorization"));
    let foreign = preflight("https://evil.example").await?;
    assert_eq!(foreign.header("access-control-allow-origin"), None);
    assert_eq!(foreign.status, 403);
    let request = framed(&GetRobotRequest {
        name: "emp27".to_owned(),
    });
    let headers = [GRPC_WEB, ("origin", origin)];
    let answer = http(server.address(), "POST", GET_ROBOT, &headers, &request).await?;
    assert_eq!(answer.header("access-control-allow-origin"), Some(origin));
    assert!(
        answer
            .header("access-control-expose-headers")
            .is_some_and(|seen| seen.contains("grpc-status"))
    );
    Ok(())
}

#[tokio::test]
async fn one_port_answers_probes_and_monitoring() -> anyhow::Result<()> {
    let folder = Folder::new()?;
    let token = folder.token("prometheus", &[Role::Observer], &[])?;
    let server = server(|settings| folder.closed(settings))?;
    let get = async |path: &str, headers: &[(&str, &str)]| {
        http(server.address(), "GET", path, headers, &[]).await
    };
    assert_eq!(get("/livez", &[]).await?.status, 200);
    assert_eq!(get("/readyz", &[]).await?.status, 200);
    assert_eq!(get("/nothing", &[]).await?.status, 404);
    assert_eq!(get("/metrics", &[]).await?.status, 401);
    let channel = connect(&server).await?;
    assert_eq!(
        call(&channel, LIST_MODELS, None).await?.code(),
        Code::Unauthenticated
    );
    call(&channel, LIST_MODELS, Some(&token)).await?;
    let bearer = format!("Bearer {token}");
    let metrics = get("/metrics", &[("authorization", &bearer)]).await?;
    assert_eq!(metrics.status, 200);
    assert!(
        metrics
            .header("content-type")
            .is_some_and(|kind| kind.starts_with("application/openmetrics-text"))
    );
    let text = metrics.text();
    for line in [
        "emp_calls_total{method=\"/emp.v1.ModelService/ListModels\",code=\"OK\"} ",
        "emp_calls_refused_total{reason=\"CREDENTIALS_MISSING\"} ",
        "emp_model_serving{model=\"fake\"} 1",
        "emp_connections ",
        "emp_batch_size_bucket{",
        "process_resident_memory_bytes ",
    ] {
        assert!(
            text.lines().any(|found| found.starts_with(line)),
            "{line}\n{text}"
        );
    }
    server.begin_shutdown();
    assert_eq!(within("the end", server.ended()).await??, Drain::Complete);
    Ok(())
}

/// The metrics of the operator's handbook: name and type.
fn handbook() -> anyhow::Result<Vec<(String, String)>> {
    let text = std::fs::read_to_string(emp_tests::root().join("docs/operations.md"))?;
    let rows = text.lines().filter_map(|line| {
        let mut cells = line.strip_prefix("| `")?.split(" | ");
        let name = cells.next()?.strip_suffix('`')?.to_owned();
        Some((name, cells.next()?.to_owned()))
    });
    Ok(rows
        .filter(|(name, _)| name.starts_with("emp_") || name.starts_with("process_"))
        .collect())
}

/// Every metric stands in the operator's handbook with its type, and nothing else does.
#[tokio::test]
async fn metrics_are_those_of_the_handbook() -> anyhow::Result<()> {
    let server = server(|_| {})?;
    let text = http(server.address(), "GET", "/metrics", &[], &[])
        .await?
        .text();
    let mut handbook = handbook()?;
    for line in text.lines().filter_map(|line| line.strip_prefix("# TYPE ")) {
        let (name, kind) = line.split_once(' ').expect("a type");
        let row = (name.to_owned(), kind.to_owned());
        assert!(handbook.contains(&row), "{line}");
    }
    // Those whose labels are not known before their first event show nothing yet; the code names them all.
    let code = std::fs::read_to_string(emp_tests::root().join("server/src/metrics.rs"))?;
    let (code, _) = code.split_once("#[cfg(test)]").expect("tests");
    let mut named: Vec<_> = code
        .split('"')
        .filter(|text| text.starts_with("emp_") || text.starts_with("process_"))
        .map(str::to_owned)
        .collect();
    named.sort();
    handbook.sort();
    let written: Vec<_> = handbook.into_iter().map(|(name, _)| name).collect();
    assert_eq!(named, written);
    Ok(())
}

/// Every metric that a dashboard or an alert asks for exists.
#[test]
fn dashboards_and_alerts_ask_for_metrics_that_there_are() -> anyhow::Result<()> {
    let mut series = Vec::new();
    for (name, kind) in handbook()? {
        let suffixes: &[&str] = match kind.as_str() {
            "counter" => &["_total"],
            "histogram" => &["_bucket", "_sum", "_count"],
            "info" => &["_info"],
            _ => &[""],
        };
        series.extend(suffixes.iter().map(|suffix| format!("{name}{suffix}")));
    }
    let packaging = emp_tests::root().join("packaging/monitoring");
    let dashboard = std::fs::read_to_string(packaging.join("dashboard.json"))?;
    let parsed: serde_json::Value = serde_json::from_str(&dashboard)?;
    let panels = parsed["panels"].as_array().expect("panels");
    assert!(panels.len() >= 10);
    let mut asked = Vec::new();
    for target in panels
        .iter()
        .flat_map(|panel| panel["targets"].as_array().into_iter().flatten())
    {
        asked.push(target["expr"].as_str().expect("an expression").to_owned());
    }
    let alerts = std::fs::read_to_string(packaging.join("alerts.yaml"))?;
    let expressions: Vec<_> = alerts
        .lines()
        .filter_map(|line| line.trim().strip_prefix("expr: "))
        .map(str::to_owned)
        .collect();
    assert!(expressions.len() >= 5);
    asked.extend(expressions);
    for expression in asked {
        let words = expression.split(|c: char| !c.is_ascii_alphanumeric() && c != '_');
        let names: Vec<_> = words
            .filter(|word| word.starts_with("emp_") || word.starts_with("process_"))
            .collect();
        assert!(!names.is_empty(), "{expression}");
        for name in names {
            assert!(
                series.iter().any(|series| series == name),
                "{name} in {expression}"
            );
        }
    }
    Ok(())
}

#[tokio::test]
async fn silent_connections_are_closed_and_hold_up_no_shutdown() -> anyhow::Result<()> {
    let server = server(|settings| settings.connections.handshake_seconds = 0.3)?;
    for first in [&b""[..], b"PRI * HTTP/2.0\r\n"] {
        let start = Instant::now();
        exchange(server.address(), first).await?;
        assert!(start.elapsed() >= Duration::from_millis(250));
    }
    drop(server);
    let server = self::server(|settings| {
        settings.connections.handshake_seconds = 60.0;
        settings.shutdown.grace_seconds = 3600.0;
    })?;
    let mut silent = TcpStream::connect(server.address()).await?;
    let other = connect(&server).await?;
    call(&other, LIST_MODELS, None).await?;
    drop(other);
    server.begin_shutdown();
    assert_eq!(within("the end", server.ended()).await??, Drain::Complete);
    let mut rest = Vec::new();
    let _ = within("the silent one's end", silent.read_to_end(&mut rest)).await?;
    Ok(())
}

#[tokio::test]
async fn connections_are_limited_in_all_and_by_address() -> anyhow::Result<()> {
    for (max, per_address) in [(3, 100), (100, 3)] {
        let server = server(|settings| {
            settings.connections.max = max.try_into().expect("not zero");
            settings.connections.max_per_address = per_address.try_into().expect("not zero");
        })?;
        let mut held = Vec::new();
        for _ in 0..3 {
            let channel = connect(&server).await?;
            assert_eq!(call(&channel, LIST_MODELS, None).await?.code(), Code::Ok);
            held.push(channel);
        }
        assert!(
            exchange(server.address(), b"")
                .await
                .unwrap_or_default()
                .is_empty()
        );
        let refused = match connect(&server).await {
            Ok(channel) => call(&channel, LIST_MODELS, None).await?.code() != Code::Ok,
            Err(_) => true,
        };
        assert!(refused);
        held.pop();
        until("a free place", async || match connect(&server).await {
            Ok(channel) => {
                let status = call(&channel, LIST_MODELS, None).await;
                status.is_ok_and(|status| status.code() == Code::Ok)
            }
            Err(_) => false,
        })
        .await?;
    }
    Ok(())
}

#[tokio::test]
async fn headers_that_are_too_large_are_refused_and_the_next_call_is_served() -> anyhow::Result<()>
{
    let server = server(|_| {})?;
    let channel = connect(&server).await?;
    let huge = "x".repeat(40 << 10);
    let status = call(&channel, LIST_MODELS, Some(&huge)).await?;
    assert_ne!(status.code(), Code::Ok);
    let channel = connect(&server).await?;
    assert_eq!(call(&channel, LIST_MODELS, None).await?.code(), Code::Ok);
    Ok(())
}

#[tokio::test]
async fn one_connection_has_no_more_streams_than_it_may() -> anyhow::Result<()> {
    let server =
        server(|settings| settings.connections.max_streams = 4.try_into().expect("not zero"))?;
    let channel = connect(&server).await?;
    let mut open = Vec::new();
    for _ in 0..4 {
        open.push(HeldStream::open(&channel, TELEOPERATE, None).await??);
    }
    // The next waits, and gets its turn.
    let next = tokio::spawn({
        let channel = channel.clone();
        async move { call(&channel, LIST_MODELS, None).await }
    });
    tokio::time::sleep(Duration::from_millis(300)).await;
    assert!(!next.is_finished());
    open.pop();
    assert_eq!(within("its turn", next).await???.code(), Code::Ok);
    Ok(())
}

/// The shipped server in a shell that changes its limits or its standard streams first.
fn start_in_shell(
    before: &str,
    redirect: &str,
    arguments: &[&str],
) -> anyhow::Result<(std::process::Child, SocketAddr)> {
    use std::io::{BufRead as _, BufReader};
    let server = binaries()?.join("emp-server");
    let script = format!(
        "{before}; exec {} --listen 127.0.0.1:0 {} {redirect}",
        server.display(),
        arguments.join(" ")
    );
    let mut child = Command::new("bash")
        .args(["-c", &script])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()?;
    let mut line = String::new();
    let stdout = child.stdout.take().expect("standard output");
    BufReader::new(stdout).read_line(&mut line)?;
    let address = line.trim_end().strip_prefix("listening on ");
    let address = address.unwrap_or_else(|| panic!("{line:?}")).parse()?;
    Ok((child, address))
}

async fn is_served(address: SocketAddr) -> bool {
    match Client::connect(&format!("http://{address}")).await {
        Ok(client) => client.models().await.is_ok(),
        Err(_) => false,
    }
}

#[tokio::test]
async fn a_log_that_cannot_be_written_ends_nothing() -> anyhow::Result<()> {
    for redirect in ["2>/dev/full", "2>&-"] {
        let (mut child, address) = start_in_shell("true", redirect, &["--log-filter", "debug"])?;
        for _ in 0..20 {
            assert!(is_served(address).await, "{redirect}");
        }
        Command::new("kill")
            .args(["-TERM", &child.id().to_string()])
            .status()?;
        let status = tokio::task::spawn_blocking(move || child.wait()).await??;
        assert!(status.success(), "{redirect}: {status}");
    }
    Ok(())
}

#[tokio::test]
async fn a_server_without_file_descriptors_waits_and_comes_back() -> anyhow::Result<()> {
    // The server raises its own limit, up to the hard one.
    let (mut child, address) = start_in_shell("ulimit -n 48", "", &["--log-format", "json"])?;
    let stderr = child.stderr.take().expect("standard error");
    let log = std::thread::spawn(move || std::io::read_to_string(stderr));
    assert!(is_served(address).await);
    let mut held = Vec::new();
    for _ in 0..100 {
        held.push(TcpStream::connect(address).await?);
    }
    tokio::time::sleep(Duration::from_secs(2)).await;
    let used = cpu_seconds(child.id())?;
    tokio::time::sleep(Duration::from_secs(2)).await;
    let used = cpu_seconds(child.id())? - used;
    assert!(used < 1.0, "{used} s of 2 s");
    // The silent ones are closed after the handshake's time, though they stay open at this end.
    until("an answer", async || is_served(address).await).await?;
    Command::new("kill")
        .args(["-TERM", &child.id().to_string()])
        .status()?;
    let status = tokio::task::spawn_blocking(move || child.wait()).await??;
    assert!(status.success(), "{status}");
    let log = log.join().expect("the log")?;
    assert!(log.contains("cannot accept a connection"), "{log}");
    assert!(log.lines().count() < 300, "{} lines", log.lines().count());
    drop(held);
    Ok(())
}

fn cpu_seconds(process: u32) -> anyhow::Result<f64> {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat"))?;
    let fields: Vec<_> = stat
        .rsplit(") ")
        .next()
        .unwrap_or_default()
        .split(' ')
        .collect();
    Ok((fields[11].parse::<f64>()? + fields[12].parse::<f64>()?) / 100.0)
}

#[tokio::test]
async fn what_a_client_sends_forges_no_log_line() -> anyhow::Result<()> {
    let (mut child, address) = start_in_shell("true", "", &["--log-filter", "debug"])?;
    let stderr = child.stderr.take().expect("standard error");
    let log = std::thread::spawn(move || std::io::read_to_string(stderr));
    let channel = Endpoint::from_shared(format!("http://{address}"))?
        .connect()
        .await?;
    let robot = "x\n2026-01-01T00:00:00Z FORGED all is well\u{1b}[2J";
    let config = emp_proto::v1::CollectRolloutsConfig {
        robot: robot.to_owned() + &"y".repeat(20_000),
        ..Default::default()
    };
    let request = emp_proto::v1::CollectRolloutsRequest {
        message: Some(emp_proto::v1::collect_rollouts_request::Message::Config(
            config,
        )),
    };
    let collect = "/emp.v1.RolloutService/CollectRollouts";
    let status = call_with(&channel, collect, None, request.encode_to_vec()).await?;
    assert_eq!(status.code(), Code::InvalidArgument, "{status:?}");
    Command::new("kill")
        .args(["-TERM", &child.id().to_string()])
        .status()?;
    tokio::task::spawn_blocking(move || child.wait()).await??;
    let log = log.join().expect("the log")?;
    assert!(
        !log.lines()
            .any(|line| line.starts_with("2026-01-01T00:00:00Z FORGED")),
        "{log}"
    );
    assert!(!log.contains('\u{1b}'));
    assert!(log.lines().all(|line| line.len() <= 4096));
    let refused = log.lines().find(|line| line.contains("job refused"));
    assert!(
        refused.is_some_and(|line| line.contains("peer=127.0.0.1:")),
        "{log}"
    );
    Ok(())
}

#[tokio::test]
async fn other_machines_are_not_served_without_tls_and_identities() -> anyhow::Result<()> {
    let server = binaries()?.join("emp-server");
    let output = Command::new(&server)
        .args(["--listen", "0.0.0.0:0"])
        .output()?;
    assert!(!output.status.success());
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(message.contains("--insecure"), "{message}");
    let folder = tempfile::tempdir()?;
    let insecure = [
        OsStr::new("--listen"),
        OsStr::new("0.0.0.0:0"),
        OsStr::new("--insecure"),
    ];
    let running = ServerProcess::start_with(folder.path(), &insecure)?;
    assert!(running.url.contains("0.0.0.0"), "{}", running.url);
    Ok(())
}

/// From nothing to a server for other machines, by the commands alone.
#[tokio::test]
async fn the_commands_make_a_server_for_a_network() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let run = |arguments: &[&str]| -> anyhow::Result<String> {
        let server = binaries()?.join("emp-server");
        let output = Command::new(server)
            .args(arguments)
            .current_dir(folder.path())
            .output()?;
        let error = String::from_utf8_lossy(&output.stderr);
        anyhow::ensure!(output.status.success(), "{arguments:?}: {error}");
        Ok(String::from_utf8(output.stdout)?)
    };
    run(&["cert", "--folder", "tls"])?;
    let add = [
        "token",
        "add",
        "lab",
        "--role",
        "operator",
        "--file",
        "access.toml",
    ];
    let token = run(&add)?;
    assert!(run(&add).is_err(), "the name is taken");
    assert!(run(&["token", "list", "--file", "access.toml"])?.contains("lab  roles operator"));
    let server = ServerProcess::start_with(
        folder.path(),
        &[
            "--listen",
            "0.0.0.0:0",
            "--tls-certificate",
            "tls/server.pem",
            "--tls-key",
            "tls/server-key.pem",
            "--access",
            "access.toml",
        ]
        .map(OsStr::new),
    )?;
    let port = server.url.rsplit(':').next().expect("a port");
    let emp = |arguments: &[&str]| {
        Command::new(binaries()?.join("emp"))
            .args(["--server", &format!("https://localhost:{port}")])
            .args(arguments)
            .current_dir(folder.path())
            .output()
            .map_err(anyhow::Error::from)
    };
    let ca = ["--ca", "tls/ca.pem"];
    let listed = emp(&[&ca[..], &["--token", token.trim(), "models"]].concat())?;
    assert!(
        listed.status.success(),
        "{}",
        String::from_utf8_lossy(&listed.stderr)
    );
    let refused = emp(&[&ca[..], &["models"]].concat())?;
    let message = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(
        !refused.status.success() && message.contains("credentials"),
        "{message}"
    );
    run(&["token", "revoke", "lab", "--file", "access.toml"])?;
    until("the token's end", async || {
        emp(&[&ca[..], &["--token", token.trim(), "models"]].concat())
            .is_ok_and(|output| !output.status.success())
    })
    .await?;
    Ok(())
}

/// A client that opens a call of HTTP/1.1 and sends its headers a byte at a time is not waited for beyond hyper's limit; meanwhile
/// others are served.
#[tokio::test]
async fn a_slow_sender_holds_up_nobody() -> anyhow::Result<()> {
    let server = server(|_| {})?;
    let mut slow = TcpStream::connect(server.address()).await?;
    slow.write_all(b"GET /livez HTTP/1.1\r\nx-slow: ").await?;
    let channel = connect(&server).await?;
    for _ in 0..10 {
        slow.write_all(b"x").await?;
        assert_eq!(call(&channel, LIST_MODELS, None).await?.code(), Code::Ok);
    }
    Ok(())
}
