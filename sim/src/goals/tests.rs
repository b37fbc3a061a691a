use emp_models::retarget::Retargeter;
use emp_robot::Robot;

use super::*;
use crate::testing::{for_each_robot, pose};

/// A swing of all joints about the default pose, rad at `hz`.
fn swing(robot: &Robot, source: Source, frames: usize, amplitude: f64, hz: f64) -> GoalClip {
    let rows: Vec<Vec<f32>> = (0..frames)
        .map(|t| {
            let phase = |j: usize| t as f64 / 50.0 * hz * std::f64::consts::TAU + j as f64;
            let rest = pose(robot, &[]);
            let angle = |(j, rest): (usize, f32)| rest + (amplitude * phase(j).sin()) as f32;
            rest.into_iter().enumerate().map(angle).collect()
        })
        .collect();
    GoalClip::new(robot, format!("swing-{hz}"), source, &rows).unwrap()
}

fn library(robot: &Robot) -> GoalLibrary {
    let clips = vec![
        swing(robot, Source::Recorded, 300, 0.4, 0.05),
        swing(robot, Source::Recorded, 200, 0.3, 0.8),
        swing(robot, Source::Procedural, 30, 0.5, 0.5),
        swing(robot, Source::Procedural, 500, 0.6, 0.7),
    ];
    GoalLibrary::new(robot, clips).unwrap()
}

fn take(library: &GoalLibrary, stream: &mut GoalStream, frames: usize) -> Vec<Vec<f32>> {
    (0..frames)
        .map(|_| {
            let mut goal = vec![0.0; library.joints()];
            stream.next(library, &mut goal);
            goal
        })
        .collect()
}

fn fastest(robot: &Robot, goals: &[Vec<f32>]) -> f32 {
    let steps = goals
        .windows(2)
        .flat_map(|pair| pair[0].iter().zip(&pair[1]));
    let step = steps.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    step * robot.control_rate_hz() as f32
}

#[test]
fn the_seed_decides_and_a_stored_stream_goes_on() {
    for_each_robot(|robot| {
        let library = library(robot);
        let [mut first, mut second, mut other] = [7, 7, 8].map(|seed| library.stream(seed, 1.0));
        let goals = take(&library, &mut first, 500);
        assert_eq!(goals, take(&library, &mut second, 500));
        assert_ne!(goals, take(&library, &mut other, 500));
        let stored = postcard::to_stdvec(&first).unwrap();
        let mut restored: GoalStream = postcard::from_bytes(&stored).unwrap();
        assert_eq!(
            take(&library, &mut first, 500),
            take(&library, &mut restored, 500)
        );
    });
}

#[test]
fn what_is_seen_ahead_comes() {
    for_each_robot(|robot| {
        let library = library(robot);
        let goals = take(&library, &mut library.stream(3, 1.0), 1010);
        let mut stream = library.stream(3, 1.0);
        let mut seen = vec![0.0; library.joints()];
        stream.peek(&library, 0, &mut seen);
        assert_eq!(seen, goals[0]);
        for t in 0..1000 {
            take(&library, &mut stream, 1);
            for ahead in [0, 1, 5, 10] {
                stream.peek(&library, ahead, &mut seen);
                assert_eq!(seen, goals[t + ahead], "{ahead} ahead of {t}");
            }
        }
    });
}

#[test]
fn goals_stay_in_range_and_pieces_are_joined_at_human_speed() {
    for_each_robot(|robot| {
        let library = library(robot);
        for (seed, difficulty) in [(0, 0.3), (1, 1.0), (2, 2.0)] {
            let goals = take(&library, &mut library.stream(seed, difficulty), 5000);
            for (angle, joint) in goals
                .iter()
                .flat_map(|goal| goal.iter().zip(robot.goal_joints()))
            {
                let range = joint.range.map(|limit| limit as f32);
                assert!(
                    (range[0]..=range[1]).contains(angle),
                    "{}: {angle}",
                    joint.name
                );
            }
            // Pieces: at most 0.6 rad at 0.7 Hz × tempo. Joins: a peak of 4 rad/s, and the ends' own speeds. A live
            // stream's goals stand still, then make up for several control periods at once.
            let tempo = (1.25 * difficulty).clamp(1.0, 2.5);
            let pieces = 0.6 * 0.7 * tempo * std::f32::consts::TAU * difficulty;
            let speed = fastest(robot, &goals);
            assert!(
                speed < 4.0 + 8.0 * pieces,
                "{}: {speed} rad/s",
                robot.name()
            );
        }
    });
}

#[test]
fn velocity_is_continuous_where_no_live_stream_is_between() {
    for_each_robot(|robot| {
        let library = library(robot);
        let mut stream = library.stream(1, 1.0);
        let (mut goals, mut live): (Vec<Vec<f32>>, Vec<bool>) = (Vec::new(), Vec::new());
        for _ in 0..5000 {
            goals.extend(take(&library, &mut stream, 1));
            live.push(stream.is_live());
        }
        assert!(live.iter().any(|live| *live) && live.iter().any(|live| !*live));
        let mut checked = 0;
        for (goals, live) in goals.windows(3).zip(live.windows(3)) {
            if live.contains(&true) {
                continue;
            }
            checked += 1;
            for ((before, now), after) in goals[0].iter().zip(&goals[1]).zip(&goals[2]) {
                // A change of 2 rad/s within a frame would be 100 rad/s².
                let change = 50.0 * (after - 2.0 * now + before).abs();
                assert!(change < 2.0, "{}: {change} rad/s", robot.name());
            }
        }
        assert!(checked > 2000, "{checked}");
    });
}

#[test]
fn difficulty_is_the_largest_amplitude() {
    for_each_robot(|robot| {
        let library = library(robot);
        let rest = pose(robot, &[]);
        let farthest = |difficulty: f32| {
            let goals = take(&library, &mut library.stream(5, difficulty), 3000);
            let offsets = goals.iter().flat_map(|goal| goal.iter().zip(&rest));
            offsets.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
        };
        assert!(farthest(0.0) < 1e-6);
        let (half, full) = (farthest(0.5), farthest(1.0));
        // A piece that ends at full speed needs a few frames more to stop.
        assert!((0.25..0.5).contains(&half), "{}: {half}", robot.name());
        assert!((0.5..1.0).contains(&full), "{}: {full}", robot.name());
        let mut stream = library.stream(5, 1.0);
        stream.set_difficulty(0.0);
        take(&library, &mut stream, 1000);
        assert_eq!(take(&library, &mut stream, 1)[0], rest);
    });
}

/// Pieces that a library draws, and the share of them whose clip is one of some.
fn drawn(library: &GoalLibrary, difficulty: f32) -> Vec<Piece> {
    let mut rng = <rand_chacha::ChaCha8Rng as rand::SeedableRng>::seed_from_u64(1);
    (0..2000)
        .map(|_| library.draw(&mut rng, difficulty))
        .collect()
}

fn share(pieces: &[Piece], of: impl Fn(&Piece) -> bool) -> f64 {
    pieces.iter().filter(|piece| of(piece)).count() as f64 / pieces.len() as f64
}

#[test]
fn sources_and_classes_of_hardness_are_drawn_alike_however_long_they_are() {
    for_each_robot(|robot| {
        // Slow work, three times as long as the lively clip; of the procedural ones both are slow.
        let clips = vec![
            swing(robot, Source::Recorded, 900, 0.1, 0.1),
            swing(robot, Source::Recorded, 300, 0.6, 1.0),
            swing(robot, Source::Procedural, 100, 0.1, 0.1),
            swing(robot, Source::Procedural, 300, 0.1, 0.1),
        ];
        let library = GoalLibrary::new(robot, clips).unwrap();
        for (clip, (found, expected)) in library
            .probabilities()
            .into_iter()
            .zip([0.25, 0.25, 0.125, 0.375])
            .enumerate()
        {
            assert!((found - expected).abs() < 1e-9, "{clip}: {found}");
            let pieces = drawn(&library, 1.0);
            let drawn = share(&pieces, |piece| piece.clip == clip);
            assert!((drawn - expected).abs() < 0.04, "{clip}: {drawn}");
        }
        let weighted = library.weighted(&[1.0, 3.0]);
        let expected = [0.25, 0.75, 0.125, 0.375].map(|share| share / 1.5);
        for (found, expected) in weighted.probabilities().into_iter().zip(expected) {
            assert!((found - expected).abs() < 1e-9, "{found} {expected}");
        }
    });
}

#[test]
fn pieces_are_slowed_down_and_sped_up_with_the_difficulty_but_not_beyond_people() {
    for_each_robot(|robot| {
        // The hands of the last one move at up to 8 m/s or so.
        let clips = vec![
            swing(robot, Source::Recorded, 1000, 0.3, 0.3),
            swing(robot, Source::Recorded, 1000, 0.8, 2.5),
        ];
        let library = GoalLibrary::new(robot, clips).unwrap();
        for (difficulty, most) in [(0.8, 1.0), (1.0, 1.25), (2.0, 2.5), (3.0, 2.5)] {
            let pieces = drawn(&library, difficulty);
            for piece in &pieces {
                let most = if piece.clip == 0 { most } else { 1.3 };
                assert!((0.599..most + 1e-3).contains(&piece.tempo), "{piece:?}");
                assert!((0.5..=difficulty).contains(&piece.amplitude), "{piece:?}");
                assert!((60..=180).contains(&piece.frames), "{piece:?}");
                let end = piece.start + (piece.frames - 1) as f64 * f64::from(piece.tempo);
                assert!(end <= 999.001, "{piece:?}");
            }
            let slow = share(&pieces, |piece| piece.clip == 0 && piece.tempo > 0.9 * most);
            assert!(slow > 0.02, "{slow}");
            assert!((share(&pieces, |piece| piece.mirrored) - 0.5).abs() < 0.05);
            assert!((share(&pieces, |piece| piece.live.is_some()) - 0.3).abs() < 0.05);
        }
    });
}

#[test]
fn a_live_piece_gives_goals_that_were_there_a_moment_ago() {
    for_each_robot(|robot| {
        let clip = swing(robot, Source::Recorded, 1000, 0.3, 0.5);
        let library = GoalLibrary::new(robot, vec![clip.clone()]).unwrap();
        let pieces = drawn(&library, 1.0);
        let piece = pieces.iter().find(|piece| piece.live.is_some()).unwrap();
        let steady = piece.steady();
        let goals = |piece: &Piece, t: usize| {
            let mut goal = vec![0.0; library.joints()];
            library.goal(piece, t, &mut goal);
            goal
        };
        assert_eq!(goals(piece, 0), goals(&steady, 0));
        let differ = (0..piece.frames).filter(|&t| goals(piece, t) != goals(&steady, t));
        assert!(differ.count() > piece.frames / 2);
    });
}

#[test]
fn a_mirrored_piece_is_the_mirrored_clip() {
    for_each_robot(|robot| {
        let clip = swing(robot, Source::Recorded, 100, 0.3, 0.5);
        let image = clip.mirrored(&robot.mirror().unwrap());
        let library = GoalLibrary::new(robot, vec![clip]).unwrap();
        let piece = Piece {
            clip: 0,
            start: 10.0,
            tempo: 1.0,
            frames: 60,
            amplitude: 1.0,
            mirrored: true,
            live: None,
        };
        let mut goal = vec![0.0; library.joints()];
        for t in 0..60 {
            library.goal(&piece, t, &mut goal);
            for (a, b) in goal.iter().zip(image.frame(10 + t)) {
                assert!((a - b).abs() < 1e-3);
            }
        }
    });
}

#[test]
fn windows_drop_the_remainder_but_keep_a_short_clip_whole() {
    for_each_robot(|robot| {
        let lengths = |frames: usize| -> Vec<(String, usize)> {
            let clip = swing(robot, Source::Recorded, frames, 0.1, 1.0);
            let windows = clip.windows(200);
            windows.iter().map(|w| (w.name.clone(), w.len())).collect()
        };
        let named = |names: &[&str]| -> Vec<(String, usize)> {
            names.iter().map(|name| ((*name).to_owned(), 200)).collect()
        };
        assert_eq!(lengths(599), named(&["swing-1@0", "swing-1@200"]));
        assert_eq!(lengths(399), named(&["swing-1"]));
        assert_eq!(lengths(199), [("swing-1".to_owned(), 199)]);
        assert_eq!(lengths(60), [("swing-1".to_owned(), 60)]);
        assert!(lengths(59).is_empty());
        let clip = swing(robot, Source::Recorded, 599, 0.1, 1.0);
        assert_eq!(clip.windows(200)[1].frame(7), clip.frame(207));
    });
}

#[test]
fn speed_and_amplitude_scale_what_they_say() {
    for_each_robot(|robot| {
        let clip = swing(robot, Source::Procedural, 201, 0.2, 0.5);
        let fast = clip.at_speed(robot, 1.6);
        assert_eq!((fast.len(), clip.at_speed(robot, 0.5).len()), (126, 401));
        assert_eq!(clip.at_speed(robot, 1.0), clip);
        for (a, b) in fast.frame(5).iter().zip(clip.frame(8)) {
            assert!((a - b).abs() < 1e-6);
        }
        let of = |clip: &GoalClip| GoalStatistics::of(robot, [clip]).unwrap();
        let ratio = of(&fast).joint_speed.mean / of(&clip).joint_speed.mean;
        assert!((ratio - 1.6).abs() < 0.02, "{ratio}");

        let wide = clip.scaled_amplitude(robot, 1.5);
        let ratio = of(&wide).amplitude.mean / of(&clip).amplitude.mean;
        assert!((ratio - 1.5).abs() < 0.02, "{ratio}");
        // 0.2 rad at 0.5 Hz: the fastest joint moves at about 0.2 · π rad/s.
        let statistics = of(&clip);
        assert!(
            (statistics.joint_speed.p95 - 0.628).abs() < 0.02,
            "{statistics:?}"
        );
        assert!(
            (statistics.amplitude.p95 - 0.2).abs() < 0.01,
            "{statistics:?}"
        );
        assert_eq!(statistics.frames, 201);
        let far = clip.scaled_amplitude(robot, 100.0);
        for (angle, joint) in far.frame(30).iter().zip(robot.goal_joints()) {
            assert!((joint.range[0] as f32..=joint.range[1] as f32).contains(angle));
        }
    });
}

#[test]
fn what_is_no_goal_is_refused_by_clip_and_frame() {
    for_each_robot(|robot| {
        let new = |rows: &[Vec<f32>]| {
            GoalClip::new(robot, "wave", Source::Recorded, rows).map_err(|error| error.to_string())
        };
        assert!(new(&[]).unwrap_err().contains("wave"));
        let good = pose(robot, &[]);
        let mut bad = good.clone();
        bad[2] = f32::NAN;
        let error = new(&[good.clone(), bad]).unwrap_err();
        assert!(
            error.contains("wave") && error.contains("frame 1"),
            "{error}"
        );
        assert!(new(&[good, vec![0.0; 3]]).unwrap_err().contains("frame 1"));
        assert!(GoalLibrary::new(robot, Vec::new()).is_err());
    });
}

#[test]
fn retargeted_motion_is_goals() {
    for_each_robot(|robot| {
        let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
        let robot =
            std::sync::Arc::new(Robot::load(&root.join("robots").join(robot.name())).unwrap());
        let weights = format!("models/weights/{}-retargeter.safetensors", robot.name());
        let retargeter = Retargeter::load(&root.join(weights), robot.clone()).unwrap();
        let motion = emp_motion::skills::library(1, 3);
        let clips = GoalClip::retargeted(&retargeter, &motion, Source::Procedural, 2).unwrap();
        for (clip, motion) in clips.iter().zip(&motion) {
            assert_eq!(
                (&clip.name, clip.len()),
                (&motion.name, motion.frames.len())
            );
        }
        let statistics = GoalStatistics::of(&robot, &clips).unwrap();
        // People at work: hands at 0.1 to 1 m/s on average.
        assert!(
            (0.1..1.0).contains(&statistics.hand_speed.mean),
            "{statistics:?}"
        );
    });
}
