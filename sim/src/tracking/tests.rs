use std::sync::Arc;

use emp_models::policy::Policy;

use super::*;
use crate::environment::EndReason;
use crate::goals::GoalClip;
use crate::testing::{emp27, goal_library, policy};
use crate::{End, Pool, Priority, SimError};

const JOINTS: usize = 15;

fn clips() -> Arc<[GoalClip]> {
    goal_library(&emp27()).clips().cloned().collect()
}

fn try_new(
    settings: TrackingSettings,
    clips: Arc<[GoalClip]>,
    count: u64,
    threads: usize,
) -> Result<TrackingEnvironments, SimError> {
    let robot = emp27();
    let pool = Arc::new(Pool::new(&robot, threads, Priority::Normal).unwrap());
    let policy: Arc<Policy> = Arc::new(policy(&robot));
    TrackingEnvironments::new(robot, pool, policy, settings, clips, 0..count, 5)
}

fn environments(settings: TrackingSettings, count: u64, threads: usize) -> TrackingEnvironments {
    try_new(settings, clips(), count, threads).unwrap()
}

/// Short episodes under all conditions.
fn short() -> TrackingSettings {
    TrackingSettings {
        episode_frames: 20,
        ..TrackingSettings::default()
    }
}

/// The test conditions: no load, no push, the clips as they are.
fn plain() -> TrackingSettings {
    TrackingSettings {
        amplitude: [1.0, 1.0],
        speed: [1.0, 1.0],
        hand_load: [0.0, 0.0],
        pushed: 0.0,
        randomized: 0.0,
        mirrored: false,
        ..TrackingSettings::default()
    }
}

/// The goals that are asked for, a little changed.
fn executed(environments: &TrackingEnvironments, t: usize) -> Vec<f32> {
    let change = |i: usize| 0.1 * ((i * 5 + t) as f32).sin();
    let goals = environments.goals().iter().enumerate();
    goals.map(|(i, goal)| goal + change(i)).collect()
}

/// Everything that some control periods tell a learner.
fn run(environments: &mut TrackingEnvironments, periods: usize) -> (Vec<f32>, Vec<EndedEpisode>) {
    let (mut numbers, mut episodes) = (Vec::new(), Vec::new());
    for t in 0..periods {
        let goals = executed(environments, t);
        let step = environments.step(&goals).unwrap();
        for part in [step.actions, step.next, step.com, step.contact] {
            numbers.extend_from_slice(part);
        }
        episodes.extend_from_slice(step.episodes);
        numbers.extend_from_slice(environments.observations());
        numbers.extend(environments.starts().iter().map(|&start| f32::from(start)));
    }
    (numbers, episodes)
}

#[test]
fn the_seed_decides_at_any_number_of_threads() {
    let expected = run(&mut environments(short(), 37, 1), 45);
    assert!(expected.1.len() > 37);
    for threads in [2, 3] {
        assert!(run(&mut environments(short(), 37, threads), 45) == expected);
    }
}

#[test]
fn restored_environments_go_on_bit_for_bit() {
    let mut original = environments(short(), 5, 2);
    run(&mut original, 13);
    let snapshot = original.snapshot().unwrap();
    let observations = original.observations().to_vec();
    let goals = original.goals().to_vec();
    let expected = run(&mut original, 30);
    let mut restored = environments(short(), 5, 1);
    restored.restore(&snapshot).unwrap();
    assert_eq!(restored.observations(), observations);
    assert_eq!(restored.goals(), goals);
    assert!(run(&mut restored, 30) == expected);
    let error = environments(short(), 4, 1)
        .restore(&snapshot)
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("expected 4 environments, found 5"),
        "{error}"
    );
    let fewer = try_new(short(), clips()[..1].into(), 5, 1);
    assert!(fewer.unwrap().restore(&snapshot).is_err());
}

#[test]
fn a_fork_goes_on_as_its_origin_does() {
    const ROWS: [usize; 5] = [4, 0, 1, 1, 2];
    let mut origin = environments(short(), ROWS.len() as u64, 2);
    run(&mut origin, 12);
    let states = origin.states();
    let mut fork = origin.fork(ROWS.iter().map(|&row| &states[row]));
    let width = origin.layout().width();
    for t in 0..10 {
        let goals = executed(&origin, t);
        let rows: Vec<&[f32]> = goals.chunks_exact(JOINTS).collect();
        let forked = ROWS.map(|row| rows[row]).concat();
        let ends = origin.step(&goals).unwrap().ends.to_vec();
        let step = fork.step(&forked).unwrap();
        assert_eq!(step.ends, ROWS.map(|row| ends[row]));
        assert!(
            step.episodes
                .iter()
                .all(|episode| episode.environment < ROWS.len())
        );
        let stacks: Vec<&[f32]> = origin.observations().chunks_exact(width).collect();
        assert_eq!(fork.observations(), ROWS.map(|row| stacks[row]).concat());
    }
}

#[test]
fn what_comes_next_is_told_before_any_reset() {
    let mut environments = environments(short(), 6, 2);
    let layout = *environments.layout();
    let mut ended = 0;
    for t in 0..60 {
        let goals = executed(&environments, t);
        let step = environments.step(&goals).unwrap();
        let (next, ends) = (step.next.to_vec(), step.ends.to_vec());
        let actions = step.actions.to_vec();
        let stacks = environments.observations().chunks_exact(layout.width());
        for (row, (stack, end)) in stacks.zip(ends).enumerate() {
            let newest = &stack[layout.newest()];
            let now = [
                &newest[layout.joint_positions()],
                &newest[layout.orientation()],
            ]
            .concat();
            let next = &next[row * 30..][..30];
            assert_eq!(environments.starts()[row], end != End::None);
            if end == End::None {
                assert_eq!(now, next);
                let before = layout.newest().start - layout.goal().len();
                let executed = &goals[row * JOINTS..][..JOINTS];
                assert_eq!(&stack[before..layout.newest().start], executed);
                let action = &actions[row * 12..][..12];
                assert_eq!(&newest[layout.last_action()], action);
                let asked = &environments.goals()[row * JOINTS..][..JOINTS];
                assert_eq!(&newest[layout.goal()], asked);
            } else {
                ended += 1;
                assert_ne!(now, next);
                assert!(stack.chunks(layout.frame_width()).all(|f| f == newest));
                assert_eq!(newest[layout.last_action()], [0.0; 12]);
            }
        }
    }
    assert!(ended >= 12, "{ended}");
}

#[test]
fn episodes_are_the_clips_and_start_at_their_first_goal() {
    let robot = emp27();
    let clips: Arc<[GoalClip]> = clips().iter().map(|c| c.windows(60).remove(1)).collect();
    let settings = TrackingSettings {
        episode_frames: 60,
        ..plain()
    };
    let mut environments = try_new(settings, Arc::clone(&clips), 3, 2).unwrap();
    let joints = environments.layout().joint_positions();
    let mut asked = vec![Vec::new(); 3];
    let mut whole = 0;
    for _ in 0..150 {
        let (width, goals) = (environments.layout().width(), environments.goals().to_vec());
        for (row, goal) in goals.chunks(JOINTS).enumerate() {
            asked[row].push(goal.to_vec());
            if environments.starts()[row] {
                let stack = &environments.observations()[row * width..][..width];
                let newest = &stack[environments.layout().newest()];
                for ((q, goal), joint) in
                    newest[joints.clone()].iter().zip(goal).zip(robot.joints())
                {
                    assert!((q - goal).abs() < 1e-6, "{}", joint.name);
                }
            }
        }
        let step = environments.step(&goals).unwrap();
        for episode in step.episodes {
            let asked = std::mem::take(&mut asked[episode.environment]);
            assert_eq!(asked.len(), episode.length as usize);
            let clip = &clips[episode.clip];
            assert!(!episode.mirrored);
            for (asked, goal) in asked.iter().zip(clip.frames()) {
                for (asked, goal) in asked.iter().zip(goal) {
                    assert!((asked - goal).abs() < 1e-5);
                }
            }
            if episode.end == EndReason::TimedOut && asked.len() == 60 {
                whole += 1;
            }
        }
    }
    assert!(whole >= 3, "{whole}");
}

#[test]
fn a_fall_ends_an_episode() {
    let settings = TrackingSettings {
        pushed: 1.0,
        push_speed: [4.0, 5.0],
        push_interval: 0.5,
        ..plain()
    };
    let mut environments = environments(settings, 8, 2);
    let mut falls = 0;
    for _ in 0..150 {
        let goals = environments.goals().to_vec();
        let step = environments.step(&goals).unwrap();
        for episode in step.episodes {
            let row = episode.environment;
            if matches!(episode.end, EndReason::Tilted) {
                assert_eq!(step.ends[row], End::Terminated);
                let [roll, pitch] = [27, 28].map(|i| step.next[row * 30 + i]);
                assert!(roll.abs().max(pitch.abs()) > 0.7, "{roll} {pitch}");
                assert!(episode.length < 150);
                falls += 1;
            }
        }
    }
    assert!(falls >= 8, "{falls}");
}

#[test]
fn the_measured_center_of_mass_is_over_the_feet_of_a_robot_that_stands() {
    let mut environments = environments(plain(), 3, 1);
    for t in 0..10 {
        let goals = executed(&environments, t);
        let step = environments.step(&goals).unwrap();
        for (com, end) in step.com.chunks(2).zip(step.ends) {
            assert!(
                *end != End::None || com.iter().all(|com| com.abs() < 0.1),
                "{com:?}"
            );
            assert!(com.iter().any(|com| *com != 0.0));
        }
    }
}

#[test]
fn conditions_are_drawn_from_their_ranges() {
    let mut environments = environments(short(), 16, 2);
    let (_, episodes) = run(&mut environments, 200);
    let spread = |of: &dyn Fn(&EndedEpisode) -> f32| {
        let values = episodes.iter().map(of);
        let (low, high) = (
            values.clone().fold(f32::INFINITY, f32::min),
            values.fold(0.0, f32::max),
        );
        [low, high]
    };
    let [low, high] = spread(&|episode| episode.amplitude);
    assert!((0.8..0.9).contains(&low) && (1.9..=2.0).contains(&high));
    let [low, high] = spread(&|episode| episode.speed);
    assert!((0.8..0.85).contains(&low) && (1.45..=1.5).contains(&high));
    let mirrored = episodes.iter().filter(|episode| episode.mirrored).count();
    let share = mirrored as f64 / episodes.len() as f64;
    assert!((0.3..0.7).contains(&share), "{share} of {}", episodes.len());
    let mut used: Vec<usize> = episodes.iter().map(|episode| episode.clip).collect();
    used.sort_unstable();
    used.dedup();
    assert_eq!(used, [0, 1, 2]);
}

#[test]
fn what_does_not_fit_is_refused_by_name() {
    let refused = |settings: TrackingSettings| {
        let error = try_new(settings, clips(), 1, 1).unwrap_err();
        error.to_string()
    };
    let error = refused(TrackingSettings {
        speed: [1.0, 0.5],
        ..TrackingSettings::default()
    });
    assert!(error.starts_with("speed"), "{error}");
    let error = refused(TrackingSettings {
        pushed: 1.5,
        ..TrackingSettings::default()
    });
    assert!(error.starts_with("pushed"), "{error}");
    let none = try_new(plain(), Arc::from([]), 1, 1);
    assert!(none.unwrap_err().to_string().contains("at least one clip"));
    let mut environments = environments(plain(), 2, 1);
    let before = environments.observations().to_vec();
    let error = environments.step(&[0.0; 3]).unwrap_err().to_string();
    assert!(error.contains("2 × 15 angles, found 3"), "{error}");
    assert_eq!(environments.observations(), before);
}
