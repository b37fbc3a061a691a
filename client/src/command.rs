//! What the commands share.

use std::{path::Path, time::Duration};

use emp_client::{Backoff, Client};
use emp_motion::{Clip, ReadOptions, Understanding};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// The exit code after Ctrl-C.
pub(crate) const INTERRUPTED: u8 = 130;

/// Pauses of a live source: it is back within half a second of its server.
pub(crate) const LIVE: Backoff = Backoff {
    first: Duration::from_millis(50),
    longest: Duration::from_millis(400),
    give_up: Duration::from_secs(60),
};

/// A recorded motion at a robot's control rate, and that rate, Hz. What the file was taken for is said on standard error.
pub(crate) async fn recording(
    client: &Client,
    file: &Path,
    options: ReadOptions,
    robot: &str,
) -> anyhow::Result<(Clip, f64)> {
    let path = file.to_owned();
    // Large recordings take seconds to parse.
    let read = tokio::task::spawn_blocking(move || emp_motion::read(&path, &options));
    let reading = read.await??;
    say_understood(file, &reading.understanding);
    let rate = client.robot(robot).await?.control_rate;
    Ok((reading.clip.resampled(rate)?, rate))
}

/// Says in two lines, and one a warning, what a file was taken for.
pub(crate) fn say_understood(file: &Path, understood: &Understanding) {
    let name = file
        .file_name()
        .unwrap_or(file.as_os_str())
        .to_string_lossy();
    eprintln!("{name}: {}", understood.summary());
    for warning in &understood.warnings {
        eprintln!("  warning: {warning}");
    }
}

/// A bar on standard error, if that is a terminal.
pub(crate) fn progress_bar(length: Option<u64>, template: &str) -> ProgressBar {
    let bar = ProgressBar::with_draw_target(length, ProgressDrawTarget::stderr());
    match ProgressStyle::with_template(template) {
        Ok(style) => bar.with_style(style),
        Err(_) => bar,
    }
}

/// Says that the connection was lost, and when the next attempt to restore it comes.
pub(crate) fn say_lost(reason: &str, attempt: u32, retry_in: Duration) {
    eprintln!(
        "emp: connection lost ({reason}); attempt {attempt} in {} ms",
        retry_in.as_millis()
    );
}
