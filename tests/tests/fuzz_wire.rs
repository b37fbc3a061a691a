//! A short attack on the wire. The long one: `cargo run --release -p emp-tests --bin fuzz-wire -- --messages 10000000`.

use std::time::Duration;

use emp_tests::{
    TestServer, emp, emp27,
    fuzz::{self, Limits},
};

#[tokio::test(flavor = "multi_thread")]
async fn no_message_ends_or_starves_the_server() -> anyhow::Result<()> {
    let weights = emp::weights(&emp::small(&*emp27()?, 3.0))?;
    let server = TestServer::start_with(weights.path(), |_| {})?;
    let limits = Limits {
        messages: 20_000,
        time: Some(Duration::from_secs(10)),
    };
    let report = fuzz::run(&server.url(), 7, limits, |_| {}).await?;
    println!("{report}");
    assert!(report.received > 0);
    server.begin_shutdown();
    Ok(())
}
