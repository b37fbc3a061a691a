//! What a stream's events add up to.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use hdrhistogram::Histogram;
use serde::Serialize;

use crate::{Answer, AnswerTimes, Event, FilterAnswer, PolicyAnswer};

/// Three significant digits, values clamped to a minute, in microseconds.
const DIGITS: u8 = 3;
const LONGEST_US: u64 = 60_000_000;
/// Direction errors are counted in hundredths of a degree, up to half a turn.
const LARGEST_ERROR: u64 = 18_000;

/// Counts a stream's events. Memory does not grow with the stream.
#[derive(Debug, Clone)]
pub struct Statistics {
    start: Instant,
    answered: u64,
    at_limit: u64,
    dropped: BTreeMap<String, u64>,
    reconnects: u64,
    latency: Histogram<u64>,
    queue: Histogram<u64>,
    inference: Histogram<u64>,
    direction_error: Histogram<u64>,
    batch: Histogram<u64>,
}

/// What a stream was like; serialises to the JSON of `emp retarget --json`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// Frames that were answered or dropped.
    pub frames: u64,
    /// Frames that were answered.
    pub answered: u64,
    /// Frames that were dropped, by reason.
    pub dropped: BTreeMap<String, u64>,
    /// How often the connection was restored.
    pub reconnects: u64,
    /// From the start to now, seconds.
    pub seconds: f64,
    /// Answered frames a second.
    pub fps: f64,
    /// From sending a frame to its answer, milliseconds.
    pub latency_ms: Percentiles,
    /// Waiting for the model, milliseconds.
    pub queue_ms: Percentiles,
    /// In the model, milliseconds.
    pub inference_ms: Percentiles,
    /// Frames a batch.
    pub batch: BatchStatistics,
    /// How well poses were met; none where the stream answered no pose.
    #[serde(flatten)]
    pub retargeting: Option<RetargetingSummary>,
}

/// How well the answers of a stream met its poses.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct RetargetingSummary {
    /// Between the person's and the robot's arm bones, degrees.
    pub direction_error_deg: DirectionError,
    /// Share of answers with at least one joint at a limit, 0 to 1.
    pub limit_share: f64,
}

/// A distribution of durations.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Percentiles {
    /// The median.
    pub p50: f64,
    /// Nine of ten are at most this.
    pub p90: f64,
    /// 99 of 100 are at most this.
    pub p99: f64,
    /// The largest.
    pub max: f64,
}

/// Batch sizes, each answer counting its batch once.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct BatchStatistics {
    /// The mean.
    pub mean: f64,
    /// The largest.
    pub max: u64,
}

/// A distribution of angles.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct DirectionError {
    /// The mean.
    pub mean: f64,
    /// 95 of 100 are at most this.
    pub p95: f64,
}

/// An answer that [`Statistics`] can count.
pub trait Counted {
    /// Where its time went.
    fn times(&self) -> AnswerTimes;

    /// The pose's answer, if it is one.
    fn as_retargeted(&self) -> Option<&Answer> {
        None
    }
}

impl Counted for Answer {
    fn times(&self) -> AnswerTimes {
        self.times
    }

    fn as_retargeted(&self) -> Option<&Answer> {
        Some(self)
    }
}

impl Counted for PolicyAnswer {
    fn times(&self) -> AnswerTimes {
        self.times
    }
}

impl Counted for FilterAnswer {
    fn times(&self) -> AnswerTimes {
        self.times
    }
}

impl Statistics {
    /// Starts to count, and the clock.
    pub fn new() -> Self {
        Self {
            start: Instant::now(),
            answered: 0,
            at_limit: 0,
            dropped: BTreeMap::new(),
            reconnects: 0,
            latency: histogram(LONGEST_US),
            queue: histogram(LONGEST_US),
            inference: histogram(LONGEST_US),
            direction_error: histogram(LARGEST_ERROR),
            batch: histogram(u64::from(u32::MAX)),
        }
    }

    /// Counts an event.
    pub fn record<A: Counted>(&mut self, event: &Event<A>) {
        match event {
            Event::Answer(answer) => {
                self.record_times(&answer.times());
                if let Some(answer) = answer.as_retargeted() {
                    self.record_retargeted(answer);
                }
            }
            Event::Dropped(dropped) => *self.dropped.entry(dropped.cause.name()).or_default() += 1,
            Event::Reconnected { .. } => self.reconnects += 1,
            Event::ConnectionLost { .. } | Event::GoingAway { .. } => {}
        }
    }

    fn record_times(&mut self, times: &AnswerTimes) {
        self.answered += 1;
        self.latency.saturating_record(micros(times.latency));
        self.queue.saturating_record(micros(times.queue_time));
        self.inference
            .saturating_record(micros(times.inference_time));
        self.batch.saturating_record(u64::from(times.batch_size));
    }

    fn record_retargeted(&mut self, answer: &Answer) {
        self.at_limit += u64::from(!answer.joints_at_limit.is_empty());
        let hundredths = (answer.direction_error.to_degrees() * 100.0).round();
        self.direction_error.saturating_record(hundredths as u64);
    }

    /// What was counted so far.
    pub fn summary(&self) -> Summary {
        let seconds = self.start.elapsed().as_secs_f64();
        Summary {
            frames: self.answered + self.dropped.values().sum::<u64>(),
            answered: self.answered,
            dropped: self.dropped.clone(),
            reconnects: self.reconnects,
            seconds,
            fps: self.answered as f64 / seconds,
            latency_ms: percentiles(&self.latency),
            queue_ms: percentiles(&self.queue),
            inference_ms: percentiles(&self.inference),
            batch: BatchStatistics {
                mean: self.batch.mean(),
                max: self.batch.max(),
            },
            retargeting: self.retargeting(),
        }
    }

    fn retargeting(&self) -> Option<RetargetingSummary> {
        let poses = self.direction_error.len();
        (poses > 0).then(|| RetargetingSummary {
            direction_error_deg: DirectionError {
                mean: self.direction_error.mean() / 100.0,
                p95: self.direction_error.value_at_quantile(0.95) as f64 / 100.0,
            },
            limit_share: self.at_limit as f64 / poses as f64,
        })
    }
}

impl Default for Statistics {
    fn default() -> Self {
        Self::new()
    }
}

fn histogram(largest: u64) -> Histogram<u64> {
    Histogram::new_with_max(largest, DIGITS)
        .unwrap_or_else(|error| unreachable!("fixed bounds: {error}"))
}

fn micros(duration: Duration) -> u64 {
    u64::try_from(duration.as_micros()).unwrap_or(u64::MAX)
}

fn percentiles(histogram: &Histogram<u64>) -> Percentiles {
    let at = |quantile| histogram.value_at_quantile(quantile) as f64 / 1e3;
    Percentiles {
        p50: at(0.5),
        p90: at(0.9),
        p99: at(0.99),
        max: histogram.max() as f64 / 1e3,
    }
}

#[cfg(test)]
mod tests {
    use emp_proto::v1::DropReason;

    use super::*;
    use crate::{DropCause, Dropped};

    #[test]
    fn events_add_up() {
        let mut statistics = Statistics::new();
        for number in 0..100 {
            statistics.record(&Event::Answer(Answer {
                sequence_number: number,
                joint_angles: Vec::new(),
                direction_error: 0.1,
                joints_at_limit: if number < 25 { vec![0] } else { Vec::new() },
                times: AnswerTimes {
                    queue_time: Duration::from_micros(10),
                    inference_time: Duration::from_micros(200),
                    batch_size: 1 + u32::from(number % 2 == 0),
                    latency: Duration::from_millis(1 + number),
                },
            }));
        }
        statistics.record::<Answer>(&Event::Dropped(Dropped {
            sequence_number: 100,
            cause: DropCause::Server(DropReason::Superseded),
            field: String::new(),
            description: String::new(),
        }));
        let summary = statistics.summary();
        assert_eq!((summary.frames, summary.answered), (101, 100));
        assert_eq!(
            summary.dropped,
            BTreeMap::from([("superseded".to_owned(), 1)])
        );
        assert!((summary.latency_ms.p50 - 50.0).abs() < 0.1);
        assert!((summary.latency_ms.max - 100.0).abs() < 0.1);
        assert!((summary.batch.mean - 1.5).abs() < 1e-9 && summary.batch.max == 2);
        let retargeting = summary.retargeting.expect("poses were answered");
        assert!((retargeting.direction_error_deg.mean - 5.73).abs() < 0.01);
        assert!((retargeting.limit_share - 0.25).abs() < 1e-9);
    }
}
