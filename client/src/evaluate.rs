//! `emp evaluate`: a controller on a set of motions, with progress, a table and the failures.

use std::{path::Path, process::ExitCode};

use anyhow::Context as _;
use csv::Writer;
use emp_client::{
    Client, ClientError, ClipSource, EpisodeEnd, EpisodeMetrics, EpisodeResult, Evaluation,
    EvaluationConfig, EvaluationEvent, EvaluationMetrics, EvaluationResult, EvaluationStarted,
    GoalStatistics, MassRange, Metric, ProceduralClips, Push, Randomization, Spread,
};
use emp_motion::atomic::AtomicFile;
use indicatif::ProgressBar;
use serde_json::{Map, Value, json};

use crate::{
    cli::{self, Evaluate},
    command::{INTERRUPTED, progress_bar},
    recordings::{LeftOut, Recordings},
};

/// How an evaluation ended.
enum End {
    Complete,
    Interrupted,
    Failed(ClientError),
}

/// What came of an evaluation, as far as it got.
#[derive(Default)]
struct Outcome {
    /// Motion files that were read.
    read: usize,
    left_out: Vec<LeftOut>,
    started: Option<EvaluationStarted>,
    episodes: Vec<EpisodeResult>,
    result: Option<EvaluationResult>,
}

pub(crate) async fn run(
    client: &Client,
    command: &Evaluate,
    as_json: bool,
) -> anyhow::Result<ExitCode> {
    let (paths, options) = (command.motions.clone(), command.reading.options());
    // Large recordings take seconds to parse.
    let recordings = tokio::task::spawn_blocking(move || Recordings::read(&paths, &options));
    let recordings = recordings.await??;
    anyhow::ensure!(
        !recordings.clips.is_empty() || command.procedural > 0,
        "none of {} motion files is readable",
        recordings.left_out.len()
    );
    let mut outcome = Outcome {
        read: recordings.clips.len(),
        left_out: recordings.left_out,
        ..Outcome::default()
    };
    let mut evaluation = client.evaluate(config(command)?, recordings.clips).await?;
    let end = follow(&mut evaluation, &mut outcome).await;
    if !matches!(end, End::Complete) {
        // A job that goes on for nobody would keep others out; a server that is gone has none.
        let _ = client.cancel_job(evaluation.job()).await;
    }
    outcome.episodes.sort_by_key(|episode| episode.episode);
    // Of an evaluation that never began there is nothing to report.
    if let Some(started) = &outcome.started {
        report(command, started, &outcome, as_json)?;
    }
    Ok(match end {
        End::Failed(error) => return Err(error.into()),
        End::Interrupted => ExitCode::from(INTERRUPTED),
        End::Complete => ExitCode::SUCCESS,
    })
}

fn report(
    command: &Evaluate,
    started: &EvaluationStarted,
    outcome: &Outcome,
    as_json: bool,
) -> anyhow::Result<()> {
    if let Some(path) = &command.csv {
        write_csv(path, &outcome.episodes).with_context(|| path.display().to_string())?;
    }
    if as_json {
        println!("{}", outcome.json(command, started));
    } else {
        outcome.print(command, started);
    }
    Ok(())
}

fn config(command: &Evaluate) -> anyhow::Result<EvaluationConfig> {
    let randomization = match command.randomization {
        cli::Randomization::Nominal => Randomization::Nominal,
        cli::Randomization::Full => Randomization::Full,
    };
    Ok(EvaluationConfig {
        robot: command.robot.clone(),
        controller: Some(emp_client::controller(&command.controller)?),
        episodes: command.episodes.unwrap_or_default(),
        seed: command.seed,
        hand_load: command
            .load
            .map(|cli::Range { least, most }| MassRange { least, most }),
        push: command.push.map(|speed| Push {
            speed,
            interval: command.push_interval.unwrap_or_default(),
        }),
        speed: command.speed,
        amplitude: command.amplitude,
        randomization: randomization.into(),
        procedural: Some(ProceduralClips {
            count: command.procedural,
            seed: command.seed,
        }),
        clip_frames: command.frames.unwrap_or_default(),
        ..EvaluationConfig::default()
    })
}

async fn follow(evaluation: &mut Evaluation, outcome: &mut Outcome) -> End {
    let bar = progress_bar(None, "{bar:40} {pos}/{len} {msg}  {eta} left");
    let interrupt = tokio::signal::ctrl_c();
    tokio::pin!(interrupt);
    let end = loop {
        let event = tokio::select! {
            event = evaluation.next() => event,
            _ = &mut interrupt => break End::Interrupted,
        };
        match event {
            Ok(Some(event)) => outcome.take(event, &bar),
            Ok(None) if outcome.result.is_some() => break End::Complete,
            Ok(None) => {
                break End::Failed(ClientError::Silence(
                    "the server ended the evaluation early",
                ));
            }
            Err(error) => break End::Failed(error),
        }
    };
    bar.finish_and_clear();
    end
}

impl Outcome {
    fn take(&mut self, event: EvaluationEvent, bar: &ProgressBar) {
        match event {
            EvaluationEvent::Preparing(preparing) => {
                bar.set_length(u64::from(preparing.motions));
                bar.set_position(u64::from(preparing.done));
                bar.set_message("motions retargeted");
            }
            EvaluationEvent::Started(started) => {
                bar.set_length(u64::from(started.episodes));
                bar.set_position(0);
                bar.set_message("episodes");
                self.started = Some(started);
            }
            EvaluationEvent::Episode(episode) => {
                bar.set_position(u64::from(episode.finished));
                bar.set_message(format!("episodes  SUC {:.1} %", 100.0 * episode.success));
                self.episodes.extend(episode.result);
            }
            EvaluationEvent::Result(result) => self.result = Some(result),
        }
    }

    fn failures(&self) -> impl Iterator<Item = &EpisodeResult> {
        self.episodes
            .iter()
            .filter(|episode| episode.end() != EpisodeEnd::Completed)
    }

    /// The sets that metrics are given for, by name. Without a result, means of what finished.
    fn sets(&self) -> Vec<(&'static str, EvaluationMetrics)> {
        let Some(result) = &self.result else {
            let finished = partial(&self.episodes);
            return finished.map(|all| ("all", all)).into_iter().collect();
        };
        let sets = [
            ("all", &result.all),
            ("recorded", &result.recorded),
            ("procedural", &result.procedural),
        ];
        sets.into_iter()
            .filter_map(|(name, set)| set.map(|set| (name, set)))
            .collect()
    }

    fn json(&self, command: &Evaluate, started: &EvaluationStarted) -> Value {
        let mut object = Map::new();
        object.insert("robot".to_owned(), json!(command.robot));
        object.insert("controller".to_owned(), json!(command.controller));
        object.insert("model".to_owned(), json!(started.policy));
        object.insert("model_version".to_owned(), json!(started.policy_version));
        object.insert("seed".to_owned(), json!(command.seed));
        object.insert("complete".to_owned(), json!(self.result.is_some()));
        object.insert("motions_read".to_owned(), json!(self.read));
        object.insert("motions_left_out".to_owned(), json!(self.left_out));
        for (name, set) in self.sets() {
            let values = set_json(&set);
            if name == "all" {
                object.extend(values);
            } else {
                object.insert(name.to_owned(), Value::Object(values));
            }
        }
        let failures = self.failures().map(|episode| {
            json!({
                "episode": episode.episode,
                "clip": episode.clip,
                "source": source(episode),
                "time": episode.failure_time,
                "reason": episode.reason,
            })
        });
        object.insert("failures".to_owned(), Value::from_iter(failures));
        Value::Object(object)
    }

    fn print(&self, command: &Evaluate, started: &EvaluationStarted) {
        let EvaluationStarted {
            robot,
            policy: model,
            policy_version: model_version,
            episodes,
            ..
        } = started;
        println!(
            "{robot}, controller {}, policy {model} {model_version}, seed {}: {} of {episodes} episodes",
            command.controller,
            command.seed,
            self.episodes.len(),
        );
        if !self.left_out.is_empty() {
            let (out, all) = (self.left_out.len(), self.left_out.len() + self.read);
            println!("  left out: {out} of {all} motion files, which cannot be read");
        }
        let sets = self.sets();
        print!("  {:<34}", "");
        for (name, set) in &sets {
            print!(" {:>26}", format!("{name} ({})", set.episodes));
        }
        println!();
        for (_, label, metric) in METRICS {
            print_row(label, sets.iter().map(|(_, set)| interval(metric(set))));
        }
        for (_, label, spread) in GOALS {
            let columns = sets.iter().map(|(_, set)| {
                let spread = set.goals.as_ref().and_then(spread);
                spread.map_or_else(
                    || "-".to_owned(),
                    |spread| format!("{:.2}, p95 {:.2}", spread.mean, spread.p95),
                )
            });
            print_row(label, columns);
        }
        for episode in self.failures() {
            println!(
                "  failed: {} after {:.2} s ({}): {}",
                episode.clip,
                episode.failure_time(),
                source(episode),
                episode.reason
            );
        }
    }
}

fn print_row(label: &str, columns: impl Iterator<Item = String>) {
    print!("  {label:<34}");
    for column in columns {
        print!(" {column:>26}");
    }
    println!();
}

fn interval(metric: Option<&Metric>) -> String {
    match metric {
        Some(Metric { mean, low, high }) if low.is_finite() => {
            format!("{mean:.4} [{low:.4}, {high:.4}]")
        }
        Some(Metric { mean, .. }) => format!("{mean:.4}"),
        None => "-".to_owned(),
    }
}

type Of<T, V> = fn(&T) -> Option<&V>;

/// Name, label and place of each metric.
const METRICS: [(&str, &str, Of<EvaluationMetrics, Metric>); 12] = [
    ("suc", "SUC  stood to the end", |set| set.suc.as_ref()),
    ("mjp", "MJP  joint tracking", |set| set.mjp.as_ref()),
    ("msc", "MSC  self-collision (N)", |set| set.msc.as_ref()),
    (
        "self_collision_share",
        "     frames with self-collision",
        |set| set.self_collision_share.as_ref(),
    ),
    ("mbv", "MBV  base velocity", |set| set.mbv.as_ref()),
    ("mba", "MBA  base acceleration", |set| set.mba.as_ref()),
    ("mbo", "MBO  base orientation", |set| set.mbo.as_ref()),
    ("mus", "MUS  unsmoothness ((rad/s)²)", |set| {
        set.mus.as_ref()
    }),
    ("change", "goals changed by (rad)", |set| {
        set.change.as_ref()
    }),
    ("relative_change", "     as a share of their reach", |set| {
        set.relative_change.as_ref()
    }),
    ("amplitude_loss", "     amplitude lost", |set| {
        set.amplitude_loss.as_ref()
    }),
    ("changed_share", "     frames with a changed goal", |set| {
        set.changed_share.as_ref()
    }),
];

/// Name, label and place of what says how hard the goals were.
const GOALS: [(&str, &str, Of<GoalStatistics, Spread>); 3] = [
    ("joint_speed", "goals: fastest joint (rad/s)", |goals| {
        goals.joint_speed.as_ref()
    }),
    ("hand_speed", "goals: faster hand (m/s)", |goals| {
        goals.hand_speed.as_ref()
    }),
    ("amplitude", "goals: farthest joint (rad)", |goals| {
        goals.amplitude.as_ref()
    }),
];

fn set_json(set: &EvaluationMetrics) -> Map<String, Value> {
    let mut object = Map::new();
    object.insert("episodes".to_owned(), json!(set.episodes));
    for (name, _, metric) in METRICS {
        if let Some(Metric { mean, low, high }) = metric(set) {
            // JSON has no NaN: an interval that is not known is null.
            let value = json!({ "mean": mean, "low": low, "high": high });
            object.insert(name.to_owned(), value);
        }
    }
    if let Some(goals) = &set.goals {
        let mut values = Map::new();
        values.insert("frames".to_owned(), json!(goals.frames));
        for (name, _, spread) in GOALS {
            if let Some(Spread { mean, p95 }) = spread(goals) {
                values.insert(name.to_owned(), json!({ "mean": mean, "p95": p95 }));
            }
        }
        object.insert("goals".to_owned(), Value::Object(values));
    }
    object
}

/// Means of the episodes that finished, without intervals; none of none.
fn partial(episodes: &[EpisodeResult]) -> Option<EvaluationMetrics> {
    let frames: f64 = episodes.iter().map(|e| f64::from(e.frames)).sum();
    let metric = |mean: f64| {
        Some(Metric {
            mean,
            low: f64::NAN,
            high: f64::NAN,
        })
    };
    let over_frames = |value: fn(&EpisodeMetrics) -> f64| {
        let sum: f64 = episodes
            .iter()
            .filter_map(|e| Some(f64::from(e.frames) * value(e.metrics.as_ref()?)))
            .sum();
        metric(sum / frames)
    };
    let stood = episodes
        .iter()
        .filter(|e| e.end() == EpisodeEnd::Completed)
        .count();
    (!episodes.is_empty()).then(|| EvaluationMetrics {
        episodes: u32::try_from(episodes.len()).unwrap_or(u32::MAX),
        suc: metric(stood as f64 / episodes.len() as f64),
        mjp: over_frames(|metrics| metrics.mjp),
        msc: over_frames(|metrics| metrics.msc),
        self_collision_share: over_frames(|metrics| metrics.self_collision_share),
        mbv: over_frames(|metrics| metrics.mbv),
        mba: over_frames(|metrics| metrics.mba),
        mbo: over_frames(|metrics| metrics.mbo),
        mus: over_frames(|metrics| metrics.mus),
        change: over_frames(|metrics| metrics.change),
        relative_change: over_frames(|metrics| metrics.relative_change),
        amplitude_loss: over_frames(|metrics| metrics.amplitude_loss),
        changed_share: over_frames(|metrics| metrics.changed_share),
        goals: None,
    })
}

fn source(episode: &EpisodeResult) -> &'static str {
    match episode.source() {
        ClipSource::Procedural => "procedural",
        ClipSource::Recorded | ClipSource::Unspecified => "recorded",
    }
}

fn end(episode: &EpisodeResult) -> &'static str {
    match episode.end() {
        EpisodeEnd::Completed | EpisodeEnd::Unspecified => "completed",
        EpisodeEnd::Fell => "fell",
        EpisodeEnd::Diverged => "diverged",
    }
}

/// Writes one row an episode to a temporary name beside `path`, which then appears whole.
fn write_csv(path: &Path, episodes: &[EpisodeResult]) -> anyhow::Result<()> {
    let file = AtomicFile::create(path)?;
    let mut csv = Writer::from_writer(file.handle()?);
    csv.write_record([
        "episode",
        "clip",
        "source",
        "frames",
        "end",
        "failure_time_s",
        "reason",
        "mjp",
        "msc",
        "self_collision_share",
        "mbv",
        "mba",
        "mbo",
        "mus",
        "change",
        "relative_change",
        "amplitude_loss",
        "changed_share",
    ])?;
    for episode in episodes {
        let metrics = episode.metrics.unwrap_or_default();
        let mut row = vec![
            episode.episode.to_string(),
            episode.clip.clone(),
            source(episode).to_owned(),
            episode.frames.to_string(),
            end(episode).to_owned(),
            episode
                .failure_time
                .map_or_else(String::new, |time| format!("{time:.2}")),
            episode.reason.clone(),
        ];
        let values = [
            metrics.mjp,
            metrics.msc,
            metrics.self_collision_share,
            metrics.mbv,
            metrics.mba,
            metrics.mbo,
            metrics.mus,
            metrics.change,
            metrics.relative_change,
            metrics.amplitude_loss,
            metrics.changed_share,
        ];
        row.extend(values.map(|value| format!("{value:.6}")));
        csv.write_record(row)?;
    }
    csv.flush()?;
    Ok(file.finish()?)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn episode(number: u32, frames: u32, end: EpisodeEnd) -> EpisodeResult {
        EpisodeResult {
            episode: number,
            clip: format!("clip {number}"),
            source: ClipSource::Recorded.into(),
            frames,
            end: end.into(),
            failure_time: Some(1.5),
            reason: "the base tilted too far".to_owned(),
            metrics: Some(EpisodeMetrics {
                mjp: f64::from(number),
                ..EpisodeMetrics::default()
            }),
        }
    }

    #[test]
    fn what_finished_is_weighed_by_its_frames() {
        let episodes = [
            episode(0, 100, EpisodeEnd::Completed),
            episode(1, 300, EpisodeEnd::Fell),
        ];
        let partial = partial(&episodes).expect("two episodes");
        assert_eq!(partial.suc.expect("SUC").mean, 0.5);
        assert_eq!(partial.mjp.expect("MJP").mean, 0.75);
        assert!(super::partial(&[]).is_none());
        let json = Value::Object(set_json(&partial));
        assert_eq!(json["mjp"]["mean"], 0.75);
        assert_eq!(json["mjp"]["low"], Value::Null);
    }

    #[test]
    fn the_table_of_episodes_appears_whole() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("episodes.csv");
        write_csv(&path, &[episode(3, 75, EpisodeEnd::Fell)]).expect("written");
        let text = std::fs::read_to_string(&path).expect("text");
        let lines: Vec<_> = text.lines().collect();
        assert_eq!(lines.len(), 2);
        assert!(
            lines[1].starts_with("3,clip 3,recorded,75,fell,1.50,the base tilted too far,3.000000"),
            "{}",
            lines[1]
        );
    }
}
