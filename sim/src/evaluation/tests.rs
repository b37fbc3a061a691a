use std::cell::Cell;
use std::path::Path;
use std::sync::Arc;

use emp_models::controller::Controller;
use emp_models::policy::Policy;
use emp_robot::Robot;

use super::*;
use crate::Priority;
use crate::pushes::Kick;
use crate::testing::{emp27, goal_library, policy, pose};

fn pool(robot: &Robot, threads: usize) -> Pool {
    Pool::new(robot, threads, Priority::Normal).unwrap()
}

/// A controller whose policy has small random weights: the robot stands for a while.
fn controller(robot: &Arc<Robot>, filter: &str) -> Controller {
    Controller::by_name(filter, &Arc::new(policy(robot)), None).unwrap()
}

/// Pieces of swinging arms, the first half as if recorded.
fn clips(robot: &Robot, count: usize, frames: usize) -> Vec<GoalClip> {
    let library = goal_library(robot);
    let clip = |i: usize| {
        let mut clip = library.sample(i as u64, 1.0, frames);
        if i < count / 2 {
            clip.source = Source::Recorded;
        }
        clip
    };
    (0..count).map(clip).collect()
}

fn run(robot: &Arc<Robot>, threads: usize, settings: &EvaluationSettings) -> Evaluation {
    let clips = clips(robot, 5, 40);
    let controller = controller(robot, "decoupled");
    evaluate(
        &pool(robot, threads),
        &controller,
        &clips,
        settings,
        &mut (),
    )
    .unwrap()
}

/// Falls soon: heavy hands, kicked hard and often.
fn hard() -> EvaluationSettings {
    EvaluationSettings {
        seed: 11,
        episodes: Some(70),
        push: Some(Kick {
            speed: 2.0,
            interval: 0.4,
        }),
        hand_load: Some([2.0, 3.0]),
        ..EvaluationSettings::default()
    }
}

#[test]
fn the_same_request_gives_the_same_bits_on_any_number_of_threads() {
    let robot = emp27();
    for settings in [
        hard(),
        EvaluationSettings {
            conditions: RandomizationLevel::Full,
            episodes: Some(70),
            ..EvaluationSettings::default()
        },
    ] {
        let [one, two, three] = [1, 2, 3].map(|threads| run(&robot, threads, &settings));
        assert_eq!(one, two);
        assert_eq!(one, three);
        assert_eq!((one.results.len(), one.complete), (70, true));
        let other = EvaluationSettings {
            seed: settings.seed + 1,
            ..settings
        };
        assert_ne!(one.results, run(&robot, 2, &other).results);
    }
}

#[test]
fn an_episode_depends_on_its_own_number_alone() {
    let robot = emp27();
    let all = run(&robot, 2, &hard());
    let few = run(
        &robot,
        2,
        &EvaluationSettings {
            episodes: Some(3),
            ..hard()
        },
    );
    for (few, all) in few.results.iter().zip(&all.results) {
        // The batch's size decides the last bits of the policy's answer.
        assert_eq!((few.episode, &few.clip), (all.episode, &all.clip));
        assert!((few.sums.means().mbo - all.sums.means().mbo).abs() < 0.05);
    }
}

#[test]
fn falls_end_episodes_and_are_named() {
    let robot = emp27();
    let evaluation = run(&robot, 2, &hard());
    assert!(evaluation.failures.len() > 10, "{:?}", evaluation.all);
    let failed = evaluation
        .results
        .iter()
        .filter(|result| result.failure.is_some());
    for (failure, result) in evaluation.failures.iter().zip(failed) {
        assert_eq!(
            (failure.episode, &failure.clip),
            (result.episode, &result.clip)
        );
        assert_eq!(failure.time, result.frames as f64 / 50.0);
        assert!(
            failure.reason.contains("base") && result.frames <= 40,
            "{failure:?}"
        );
        assert_eq!(
            (result.sums.frames, result.sums.sums.suc),
            (result.frames, 0.0)
        );
    }
    let stood = evaluation
        .results
        .iter()
        .filter(|result| result.failure.is_none());
    assert!(
        stood
            .clone()
            .all(|result| result.frames == 40 && result.sums.sums.suc == 1.0)
    );
    let share = stood.count() as f64 / 70.0;
    assert!((evaluation.all.metrics.suc.mean - share).abs() < 1e-12);
    let parts = [&evaluation.recorded, &evaluation.procedural];
    let parts = parts.map(|part| part.as_ref().unwrap().episodes);
    assert_eq!(parts, [28, 42]);
}

#[test]
fn conditions_make_it_harder() {
    let robot = emp27();
    let easy = run(&robot, 2, &EvaluationSettings::default());
    assert_eq!(easy.all.episodes, 5);
    assert_eq!(easy.all.metrics.suc.mean, 1.0, "{:?}", easy.failures);
    let hard = run(&robot, 2, &hard());
    assert!(
        hard.all.metrics.suc.mean < 0.9 && hard.all.metrics.mbv.mean < easy.all.metrics.mbv.mean
    );

    let goals = |settings: &EvaluationSettings| run(&robot, 2, settings).all.goals.unwrap();
    let plain = goals(&EvaluationSettings::default());
    let fast = goals(&EvaluationSettings {
        speed: 1.5,
        ..Default::default()
    });
    let wide = goals(&EvaluationSettings {
        amplitude: 1.5,
        ..Default::default()
    });
    assert!((fast.joint_speed.mean / plain.joint_speed.mean - 1.5).abs() < 0.1);
    assert!(
        fast.frames < plain.frames && (fast.amplitude.mean - plain.amplitude.mean).abs() < 0.02
    );
    assert!((wide.amplitude.mean / plain.amplitude.mean - 1.5).abs() < 0.05);
}

#[test]
fn tracking_is_judged_by_the_goal_that_was_asked_for() {
    let robot = emp27();
    let clips = clips(&robot, 4, 60);
    let score = |filter: &str| {
        let controller = controller(&robot, filter);
        let settings = EvaluationSettings::default();
        evaluate(&pool(&robot, 2), &controller, &clips, &settings, &mut ()).unwrap()
    };
    let (raw, cut) = (score("decoupled"), score("amplitude-cut:factor=0"));
    assert_eq!(
        (raw.controller.as_str(), cut.controller.as_str()),
        ("decoupled", "amplitude-cut:factor=0")
    );
    let difference = cut.difference(&raw).unwrap();
    assert!(difference.mjp.high < 0.0, "{difference:?}");
    let means = cut.all.metrics.mjp.mean - raw.all.metrics.mjp.mean;
    assert!((difference.mjp.mean - means).abs() < 1e-12);
    let other = EvaluationSettings {
        seed: 1,
        ..Default::default()
    };
    assert_eq!(cut.difference(&run(&robot, 2, &other)), None);
}

/// The policy that ships.
fn shipped(robot: &Arc<Robot>, filter: &str) -> Controller {
    let weights = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../models/weights/emp27-policy.safetensors"
    );
    let policy = Policy::load(Path::new(weights), Arc::clone(robot)).unwrap();
    Controller::by_name(filter, &Arc::new(policy), None).unwrap()
}

#[test]
fn a_robot_starts_where_its_filter_has_it() {
    let robot = emp27();
    // Arms far from the default pose from the first frame on.
    let swing = |number: usize| {
        let goal = |t: usize| {
            let swing = 0.4 * (0.06 * (t * (number + 1)) as f32).sin();
            pose(&robot, &[("shoulder_pitch", swing - 1.2), ("elbow", 0.8)])
        };
        let rows: Vec<Vec<f32>> = (0..100).map(goal).collect();
        GoalClip::new(&robot, format!("swing {number}"), Source::Procedural, &rows).unwrap()
    };
    let clips: Vec<GoalClip> = (0..4).map(swing).collect();
    let mus = |filter: &str| {
        let controller = shipped(&robot, filter);
        let settings = EvaluationSettings::default();
        let pool = pool(&robot, 2);
        let evaluation = evaluate(&pool, &controller, &clips, &settings, &mut ()).unwrap();
        assert_eq!(evaluation.all.metrics.suc.mean, 1.0);
        evaluation.all.metrics.mus.mean
    };
    // 0.7 of the motion is 0.7² of its squared acceleration: no jump at the start adds to it.
    let share = mus("amplitude-cut:factor=0.7") / mus("decoupled");
    assert!((share - 0.49).abs() < 0.05, "{share}");
}

#[test]
fn clips_of_one_recording_are_one_unit() {
    let robot = emp27();
    let library = goal_library(&robot);
    let pieces = (0..3).flat_map(|seed| library.sample(seed, 1.0, 120).windows(40));
    let clips: Vec<GoalClip> = pieces.collect();
    let controller = controller(&robot, "decoupled");
    let settings = EvaluationSettings::default();
    let all = evaluate(&pool(&robot, 2), &controller, &clips, &settings, &mut ()).unwrap();
    assert_eq!((all.all.episodes, all.all.motions), (9, 3));
    assert_eq!(all.results[4].motion, all.results[3].motion);
    assert_ne!(all.results[4].clip, all.results[3].clip);
}

/// Cancels once it was told of some episodes.
struct Patience {
    left: Cell<usize>,
}

impl Progress for Patience {
    fn finished(&mut self, _: &EpisodeResult) {
        self.left.set(self.left.get().saturating_sub(1));
    }

    fn is_cancelled(&self) -> bool {
        self.left.get() == 0
    }
}

#[test]
fn a_cancelled_evaluation_leaves_what_it_finished() {
    let robot = emp27();
    let complete = run(&robot, 2, &hard());
    let clips = clips(&robot, 5, 40);
    let controller = controller(&robot, "decoupled");
    let run = |episodes: usize| {
        let mut patience = Patience {
            left: Cell::new(episodes),
        };
        evaluate(
            &pool(&robot, 2),
            &controller,
            &clips,
            &hard(),
            &mut patience,
        )
        .unwrap()
    };
    let none = run(0);
    assert!(none.results.is_empty() && !none.complete);
    assert_eq!((none.all.episodes, none.recorded), (0, None));
    let some = run(5);
    assert!(!some.complete && (5..70).contains(&some.results.len()));
    for result in &some.results {
        assert_eq!(result, &complete.results[result.episode]);
    }
    assert_eq!(some.all.episodes, some.results.len());
}

#[test]
fn json_is_one_object_with_the_metrics_by_name() {
    let evaluation = run(&emp27(), 2, &hard());
    let json = serde_json::to_value(&evaluation).unwrap();
    for metrics::Metric { name, .. } in metrics::LIST {
        for part in ["mean", "low", "high"] {
            assert!(json[name][part].is_f64(), "{name}: {}", json[name]);
            assert!(json["procedural"][name][part].is_f64());
        }
    }
    assert_eq!(json["robot"], "emp27");
    assert_eq!(json["controller"], "decoupled");
    assert_eq!(
        (json["episodes"].as_u64(), json["seed"].as_u64()),
        (Some(70), Some(11))
    );
    assert!(json["failures"][0]["reason"].is_string());
    assert!(json["goals"]["hand_speed"]["p95"].is_f64());
}

#[test]
fn what_cannot_be_run_is_refused_by_name() {
    let robot = emp27();
    let controller = controller(&robot, "decoupled");
    let pool = pool(&robot, 1);
    let good = clips(&robot, 1, 10);
    let refused = |clips: &[GoalClip], settings: EvaluationSettings| {
        let result = evaluate(&pool, &controller, clips, &settings, &mut ());
        result.unwrap_err().to_string()
    };
    let usual = EvaluationSettings::default();
    assert!(refused(&[], usual).contains("clip"));
    for (settings, name) in [
        (
            EvaluationSettings {
                speed: 0.0,
                ..usual
            },
            "speed",
        ),
        (
            EvaluationSettings {
                amplitude: f64::NAN,
                ..usual
            },
            "amplitude",
        ),
        (
            EvaluationSettings {
                hand_load: Some([2.0, 1.0]),
                ..usual
            },
            "hand_mass",
        ),
        (
            EvaluationSettings {
                push: Some(Kick {
                    speed: 9.0,
                    interval: 1.0,
                }),
                ..usual
            },
            "push.speed",
        ),
        (
            EvaluationSettings {
                push: Some(Kick {
                    speed: 1.0,
                    interval: 0.0,
                }),
                ..usual
            },
            "push.interval",
        ),
    ] {
        assert!(refused(&good, settings).contains(name), "{name}");
    }
}

/// Counts frames and keeps what was sent; may stop the arms.
#[derive(Default)]
struct Watcher {
    /// Factor on the goals that are sent; none: they are left alone.
    factor: Option<f32>,
    frames: Vec<(usize, usize)>,
    asked: Vec<f32>,
    sent: Vec<f32>,
    readings: Vec<f32>,
}

impl Observer for Watcher {
    fn send(&mut self, asked: &[f32], sent: &mut [f32]) {
        for (sent, asked) in sent.iter_mut().zip(asked) {
            *sent = self.factor.map_or(*sent, |factor| factor * asked);
        }
    }

    fn executed(&mut self, frame: &ExecutedFrame<'_>) {
        self.frames.push((frame.episode, frame.frame));
        self.asked.push(frame.asked[0]);
        self.sent.push(frame.output.goal[0]);
        self.readings.push(frame.reading.joint_positions[0]);
    }
}

#[test]
fn who_watches_changes_nothing_and_sees_every_frame() {
    let robot = emp27();
    let clips = clips(&robot, 5, 40);
    let controller = controller(&robot, "amplitude-cut:factor=0.5");
    let settings = hard();
    let run = |watcher: &mut Watcher| {
        let pool = pool(&robot, 2);
        evaluate_observed(&pool, &controller, &clips, &settings, &mut (), watcher).unwrap()
    };
    let mut watcher = Watcher::default();
    let watched = run(&mut watcher);
    let plain = evaluate(&pool(&robot, 2), &controller, &clips, &settings, &mut ()).unwrap();
    assert_eq!(watched, plain);
    let mut seen = watcher.frames.clone();
    seen.sort_unstable();
    let expected = plain.results.iter();
    let expected: Vec<_> = expected
        .flat_map(|result| (0..result.frames).map(|frame| (result.episode, frame)))
        .collect();
    assert_eq!(seen, expected);
    let halves = watcher.asked.iter().zip(&watcher.sent);
    assert!(
        halves
            .clone()
            .all(|(asked, sent)| (sent - 0.5 * asked).abs() < 1e-6)
    );
    assert!(watcher.asked.iter().any(|angle| angle.abs() > 0.05));

    let mut meddler = Watcher {
        factor: Some(0.0),
        ..Watcher::default()
    };
    let held = run(&mut meddler);
    assert!(meddler.sent.iter().all(|&angle| angle == 0.0));
    let farthest = |readings: &[f32]| readings.iter().fold(0.0_f32, |most, q| most.max(q.abs()));
    assert_ne!(held.results, plain.results);
    assert!(farthest(&meddler.readings) < farthest(&watcher.readings));
}
