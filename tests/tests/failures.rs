//! When models, servers and connections fail.

use std::{sync::Arc, time::Duration};

use emp_client::{
    Backoff, Client, ClientError, Delivery, DropCause, DropReason, Event, StreamConfig,
    StreamEvents,
};
use emp_server::{Drain, Settings};
use emp_tests::{
    TestServer, emp27,
    fake::{self, Gate},
    within,
};
use tonic::{Code, transport::Channel};
use tonic_health::pb::{
    HealthCheckRequest, health_check_response::ServingStatus, health_client::HealthClient,
};

const BACKOFF: Backoff = Backoff {
    first: Duration::from_millis(20),
    longest: Duration::from_millis(200),
    give_up: Duration::from_secs(30),
};

fn fake_server(gate: &Gate) -> anyhow::Result<TestServer> {
    fake::server(Settings::default(), gate)
}

async fn next(events: &mut StreamEvents) -> anyhow::Result<Option<Event>> {
    Ok(within("an event", events.next()).await??)
}

async fn health(server: &TestServer) -> anyhow::Result<HealthClient<Channel>> {
    let channel = Channel::from_shared(server.url())?.connect().await?;
    Ok(HealthClient::new(channel))
}

fn motion() -> HealthCheckRequest {
    HealthCheckRequest {
        service: "emp.v1.MotionService".to_owned(),
    }
}

#[tokio::test]
async fn a_panic_in_a_model_fails_its_batch_and_the_model_comes_back() -> anyhow::Result<()> {
    let gate = Gate::open();
    let server = fake_server(&gate)?;
    let client = Client::connect(&server.url()).await?;
    let (mut sender, mut events) = client.stream(StreamConfig::for_robot("emp27")).await?;
    let mut health = health(&server).await?;
    let mut watch = health.watch(motion()).await?.into_inner();
    let mut status = async || {
        anyhow::Ok(
            within("a health status", watch.message())
                .await??
                .expect("a status")
                .status(),
        )
    };
    assert_eq!(status().await?, ServingStatus::Serving);

    gate.hold_builds();
    sender.send(&fake::panic_pose(), None).await?;
    let Some(Event::Dropped(dropped)) = next(&mut events).await? else {
        panic!("not dropped")
    };
    assert_eq!(dropped.cause, DropCause::Server(DropReason::ModelFailed));
    assert_eq!(status().await?, ServingStatus::NotServing);
    let error = client
        .retarget("emp27", &fake::pose(0.1), false)
        .await
        .expect_err("no model");
    assert_eq!(
        (error.code(), error.reason().as_deref()),
        (Some(Code::Unavailable), Some("MODEL_UNAVAILABLE"))
    );
    sender.send(&fake::pose(0.1), None).await?;
    let Some(Event::Dropped(dropped)) = next(&mut events).await? else {
        panic!("not dropped")
    };
    assert_eq!(
        dropped.cause,
        DropCause::Server(DropReason::ModelUnavailable)
    );

    gate.let_builds_pass();
    assert_eq!(status().await?, ServingStatus::Serving);
    assert_eq!(gate.built(), 2);
    sender.send(&fake::pose(0.2), None).await?;
    assert!(
        matches!(next(&mut events).await?, Some(Event::Answer(answer)) if answer.joint_angles[0] == 0.2)
    );

    let error = client
        .retarget("emp27", &fake::panic_pose(), false)
        .await
        .expect_err("a panic");
    assert_eq!(
        (error.code(), error.reason().as_deref()),
        (Some(Code::Internal), Some("MODEL_FAILED"))
    );
    Ok(())
}

#[tokio::test]
async fn draining_answers_what_waits_and_ends_streams_as_unavailable() -> anyhow::Result<()> {
    let gate = Gate::closed();
    let server = fake_server(&gate)?;
    // A client that does not come back.
    let give_up = Backoff {
        give_up: Duration::ZERO,
        ..BACKOFF
    };
    let client = Client::connect(&server.url()).await?.with_backoff(give_up);
    let mut watch = health(&server).await?.watch(motion()).await?.into_inner();
    assert_eq!(
        watch.message().await?.expect("a status").status(),
        ServingStatus::Serving
    );
    let (mut sender, mut events) = client.stream(StreamConfig::for_robot("emp27")).await?;
    sender.send(&fake::pose(0.3), None).await?;
    within("the model to be busy", gate.has_entered(1)).await?;

    server.begin_shutdown();
    assert_eq!(
        watch.message().await?.expect("a status").status(),
        ServingStatus::NotServing
    );
    assert!(
        within("the watch's end", watch.message())
            .await?
            .map_or(true, |status| status.is_none())
    );
    assert!(matches!(
        next(&mut events).await?,
        Some(Event::GoingAway { .. })
    ));
    gate.let_batches_pass();
    assert!(
        matches!(next(&mut events).await?, Some(Event::Answer(answer)) if answer.joint_angles[0] == 0.3)
    );
    let end = within("the end", events.next())
        .await?
        .expect_err("the server is gone");
    assert!(
        matches!(&end, ClientError::Lost { last, .. } if last.contains("shutting down")),
        "{end}"
    );
    assert_eq!(server.ended().await?, Drain::Complete);
    Ok(())
}

#[tokio::test]
async fn draining_cuts_off_what_does_not_end_in_time() -> anyhow::Result<()> {
    let gate = Gate::closed();
    let mut settings = Settings::default();
    settings.shutdown.grace_seconds = 0.3;
    let server = fake::server(settings, &gate)?;
    let client = Client::connect(&server.url()).await?;
    let call = tokio::spawn(async move { client.retarget("emp27", &fake::pose(0.0), false).await });
    within("the model to be busy", gate.has_entered(1)).await?;
    server.begin_shutdown();
    assert_eq!(server.ended().await?, Drain::CutOff);
    assert!(within("the call's end", call).await??.is_err());
    gate.let_batches_pass();
    Ok(())
}

/// Streams frames to a server that is killed and comes back on the same port.
struct Crash {
    events: StreamEvents,
    sent: tokio::task::JoinHandle<anyhow::Result<()>>,
    server: TestServer,
    kept: Vec<Event>,
}

async fn crash(delivery: Delivery, frames: u64) -> anyhow::Result<Crash> {
    let robot = emp27()?;
    let gate = Gate::open();
    let server = fake_server(&gate)?;
    let port = server.port();
    let client = Client::connect(&server.url()).await?.with_backoff(BACKOFF);
    let config = StreamConfig {
        delivery,
        ..StreamConfig::for_robot("emp27")
    };
    let (mut sender, mut events) = client.stream(config).await?;
    let sent = tokio::spawn(async move {
        for number in 0..frames {
            sender
                .send(&fake::pose(number as f32 / 1000.0), None)
                .await?;
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
        Ok(())
    });
    let mut kept = Vec::new();
    while kept.len() < 20 {
        kept.push(next(&mut events).await?.expect("an event"));
    }
    server.kill();
    loop {
        let event = next(&mut events).await?.expect("an event");
        let lost = matches!(event, Event::ConnectionLost { .. });
        kept.push(event);
        if lost {
            break;
        }
    }
    let settings = Settings::default();
    let catalog = fake::catalog(&settings, &Arc::clone(&robot), &gate)?;
    let server = TestServer::start_on(port, settings, catalog)?;
    Ok(Crash {
        events,
        sent,
        server,
        kept,
    })
}

#[tokio::test]
async fn a_stream_survives_a_killed_server_and_all_loses_nothing() -> anyhow::Result<()> {
    let Crash {
        mut events,
        sent,
        server: _server,
        mut kept,
    } = crash(Delivery::All, 200).await?;
    while let Some(event) = next(&mut events).await? {
        kept.push(event);
    }
    sent.await??;
    let answers = kept.iter().filter_map(|event| match event {
        Event::Answer(answer) => Some((answer.sequence_number, answer.joint_angles[0])),
        _ => None,
    });
    let expected: Vec<_> = (0..200_u16)
        .map(|number| (u64::from(number), f32::from(number) / 1000.0))
        .collect();
    assert_eq!(answers.collect::<Vec<_>>(), expected);
    let count = |is: fn(&Event) -> bool| kept.iter().filter(|event| is(event)).count();
    assert_eq!(count(|event| matches!(event, Event::Reconnected { .. })), 1);
    assert_eq!(count(|event| matches!(event, Event::Dropped(_))), 0);
    Ok(())
}

#[tokio::test]
async fn a_stream_survives_a_killed_server_and_latest_drops_what_is_stale() -> anyhow::Result<()> {
    let Crash {
        mut events,
        sent,
        server: _server,
        mut kept,
    } = crash(Delivery::Latest, 1_000).await?;
    while let Some(event) = next(&mut events).await? {
        kept.push(event);
    }
    sent.await??;
    let (mut numbers, mut after_reconnect) = (Vec::new(), None);
    for event in &kept {
        match event {
            Event::Answer(answer) => {
                numbers.push(answer.sequence_number);
                after_reconnect = after_reconnect.map(|count| count + 1);
            }
            Event::Dropped(dropped) => numbers.push(dropped.sequence_number),
            Event::Reconnected { resent } => {
                assert_eq!(*resent, 0);
                after_reconnect = Some(0);
            }
            Event::ConnectionLost { .. } | Event::GoingAway { .. } => {}
        }
    }
    numbers.sort_unstable();
    assert!(
        numbers.into_iter().eq(0..1_000),
        "every frame is answered or dropped once"
    );
    assert!(
        after_reconnect.expect("it came back") > 0,
        "answers go on after the connection came back"
    );
    Ok(())
}

#[tokio::test]
async fn a_server_that_stays_away_is_an_error() -> anyhow::Result<()> {
    let server = fake_server(&Gate::open())?;
    let backoff = Backoff {
        give_up: Duration::from_millis(300),
        ..BACKOFF
    };
    let client = Client::connect(&server.url()).await?.with_backoff(backoff);
    let (_sender, mut events) = client.stream(StreamConfig::for_robot("emp27")).await?;
    let url = server.url();
    server.kill();
    let error = within("the end", async {
        loop {
            match events.next().await {
                Ok(Some(Event::ConnectionLost { .. })) => {}
                Ok(other) => panic!("{other:?}"),
                Err(error) => return error,
            }
        }
    })
    .await?;
    assert!(matches!(error, ClientError::Lost { .. }), "{error}");
    let error = Client::connect(&url).await.expect_err("nobody there");
    assert!(error.to_string().contains(&url), "{error}");
    Ok(())
}
