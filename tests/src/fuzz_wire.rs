//! `fuzz-wire`: sends a running server valid messages with something changed in them, by every call and in any order, and says
//! whether it stood it.

use std::time::Duration;

use clap::Parser;
use emp_tests::{TestServer, emp, emp27, fuzz};

/// Attacks a server of its own, or one that runs already.
#[derive(Parser)]
struct Arguments {
    /// How many messages to send at least
    #[arg(long, default_value_t = 100_000)]
    messages: u64,
    /// Seed of everything random: the same seed sends the same messages, though not in the same order
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Stop after this many seconds, whatever was sent
    #[arg(long)]
    seconds: Option<u64>,
    /// URL of a server that runs already [default: one of its own, in this process]
    #[arg(long)]
    server: Option<String>,
}

fn main() -> anyhow::Result<()> {
    let arguments = Arguments::parse();
    let weights = emp::weights(&emp::small(&*emp27()?, 3.0))?;
    let own = match arguments.server {
        Some(_) => None,
        None => Some(TestServer::start_with(weights.path(), |_| {})?),
    };
    let url = match (&arguments.server, &own) {
        (Some(url), _) => url.clone(),
        (None, Some(server)) => server.url(),
        (None, None) => unreachable!("one of the two is there"),
    };
    let runtime = tokio::runtime::Runtime::new()?;
    let limits = fuzz::Limits {
        messages: arguments.messages,
        time: arguments.seconds.map(Duration::from_secs),
    };
    let report = runtime.block_on(fuzz::run(&url, arguments.seed, limits, |report| {
        println!("{report}");
    }))?;
    println!("{report}");
    Ok(())
}
