//! What an evaluation came to, as messages.

use emp_proto::v1;
use emp_robot::Robot;
use emp_sim::{
    environment::EndReason,
    evaluation::{EpisodeResult, Evaluation, Scores},
    goals::{self, Source},
    metrics::Interval,
};

use crate::encode;

pub(super) fn result(evaluation: &Evaluation) -> v1::EvaluationResult {
    v1::EvaluationResult {
        all: Some(metrics(&evaluation.all)),
        recorded: evaluation.recorded.as_ref().map(metrics),
        procedural: evaluation.procedural.as_ref().map(metrics),
    }
}

pub(super) fn episode(result: &EpisodeResult, robot: &Robot) -> v1::EpisodeResult {
    let end = match result.failure {
        None | Some(EndReason::TimedOut) => v1::EpisodeEnd::Completed,
        Some(EndReason::Tilted | EndReason::Sank) => v1::EpisodeEnd::Fell,
        Some(EndReason::Diverged(_)) => v1::EpisodeEnd::Diverged,
    };
    let source = match result.source {
        Source::Recorded => v1::ClipSource::Recorded,
        Source::Procedural => v1::ClipSource::Procedural,
    };
    let failed_after = |_| result.frames as f64 / robot.control_rate_hz();
    let means = result.sums.means();
    v1::EpisodeResult {
        episode: encode::count(result.episode),
        clip: result.clip.clone(),
        source: source.into(),
        frames: encode::count(result.frames),
        end: end.into(),
        failure_time: result.failure.map(failed_after),
        reason: result
            .failure
            .map_or_else(String::new, |reason| reason.to_string()),
        metrics: Some(v1::EpisodeMetrics {
            mjp: means.mjp,
            msc: means.msc,
            self_collision_share: means.self_collision_share,
            mbv: means.mbv,
            mba: means.mba,
            mbo: means.mbo,
            mus: means.mus,
            change: means.change,
            relative_change: means.relative_change,
            amplitude_loss: means.amplitude_loss,
            changed_share: means.changed_share,
        }),
    }
}

fn metrics(scores: &Scores) -> v1::EvaluationMetrics {
    let metric = |Interval { mean, low, high }| Some(v1::Metric { mean, low, high });
    let metrics = scores.metrics;
    v1::EvaluationMetrics {
        episodes: encode::count(scores.episodes),
        suc: metric(metrics.suc),
        mjp: metric(metrics.mjp),
        msc: metric(metrics.msc),
        self_collision_share: metric(metrics.self_collision_share),
        mbv: metric(metrics.mbv),
        mba: metric(metrics.mba),
        mbo: metric(metrics.mbo),
        mus: metric(metrics.mus),
        change: metric(metrics.change),
        relative_change: metric(metrics.relative_change),
        amplitude_loss: metric(metrics.amplitude_loss),
        changed_share: metric(metrics.changed_share),
        goals: scores.goals.as_ref().map(goal_statistics),
    }
}

fn goal_statistics(statistics: &goals::GoalStatistics) -> v1::GoalStatistics {
    let spread = |goals::Spread { mean, p95 }| Some(v1::Spread { mean, p95 });
    v1::GoalStatistics {
        frames: statistics.frames as u64,
        joint_speed: spread(statistics.joint_speed),
        hand_speed: spread(statistics.hand_speed),
        amplitude: spread(statistics.amplitude),
    }
}
