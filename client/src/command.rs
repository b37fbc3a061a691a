//! What the commands share.

use std::{path::Path, time::Duration};

use emp_client::Client;
use emp_motion::Clip;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// The exit code after Ctrl-C.
pub(crate) const INTERRUPTED: u8 = 130;

/// A recorded motion at a robot's control rate, and that rate, Hz.
pub(crate) async fn motion(
    client: &Client,
    file: &Path,
    robot: &str,
) -> anyhow::Result<(Clip, f64)> {
    let file = file.to_owned();
    // Large recordings take seconds to parse.
    let clip = tokio::task::spawn_blocking(move || emp_motion::load(&file)).await??;
    let rate = client.robot(robot).await?.control_rate;
    Ok((clip.resampled(rate), rate))
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
