//! Procedural skills: proper bodies, smooth, clear of the trunk, reproducible, varied.

use emp_motion::skills::{Skill, generate, library, medley};
use emp_motion::{Clip, KeyNode, Side};
use nalgebra::{UnitQuaternion, Vector3};

const SEEDS: std::ops::Range<u64> = 0..12;

fn clips() -> impl Iterator<Item = Clip> {
    let all = Skill::ALL
        .into_iter()
        .flat_map(|skill| SEEDS.map(move |seed| generate(skill, seed)));
    all.chain((0..4).map(medley))
}

/// Largest norm of the wrists' n-th difference quotient.
fn peak(clip: &Clip, order: i32) -> f32 {
    let peak_of = |node: KeyNode| {
        let mut track: Vec<Vector3<f32>> = clip.frames.iter().map(|f| f.position(node)).collect();
        for _ in 0..order {
            track = track.windows(2).map(|w| w[1] - w[0]).collect();
        }
        track.iter().map(Vector3::norm).fold(0.0, f32::max) * (clip.fps as f32).powi(order)
    };
    peak_of(KeyNode::LeftWrist).max(peak_of(KeyNode::RightWrist))
}

#[test]
fn every_frame_is_a_body_with_constant_bones() {
    for clip in clips() {
        assert_eq!(clip.validate(), Ok(()), "{}", clip.name);
        assert_eq!(clip.fps, 50.0);
        let first = clip.frames[0].bone_lengths();
        assert!(
            (0.2..0.4).contains(&first.upper_arm[0]) && (0.17..0.4).contains(&first.forearm[0]),
            "{first:?}"
        );
        for frame in &clip.frames {
            let lengths = frame.bone_lengths();
            for node in KeyNode::ALL {
                assert!(
                    (lengths.of(node) - first.of(node)).abs() < 1e-4,
                    "{} {}",
                    clip.name,
                    node.name()
                );
            }
        }
    }
}

#[test]
fn hands_move_at_human_speed_and_smoothly() {
    for skill in Skill::ALL {
        // Blows and throws are as fast as people's, and as sudden.
        let [most_speed, most_jerk] = if Skill::LIVELY.contains(&skill) {
            [8.5, 25_000.0]
        } else {
            [5.0, 2500.0]
        };
        for seed in SEEDS {
            let clip = generate(skill, seed);
            let (speed, jerk) = (peak(&clip, 1), peak(&clip, 3));
            assert!(
                (0.1..most_speed).contains(&speed),
                "{}: {speed} m/s",
                clip.name
            );
            assert!(jerk < most_jerk, "{}: {jerk} m/s³", clip.name);
        }
    }
}

#[test]
fn hands_turn_smoothly() {
    for clip in clips() {
        for pair in clip.frames.windows(2) {
            for side in Side::BOTH {
                if let (Some(a), Some(b)) = (
                    pair[0].wrist_rotations[side as usize],
                    pair[1].wrist_rotations[side as usize],
                ) {
                    // Through quaternions: the angle of two nearly equal matrices is NaN in single precision.
                    let turn = UnitQuaternion::from(a).angle_to(&UnitQuaternion::from(b)) * 50.0;
                    assert!(turn < 45.0, "{}: {turn} rad/s", clip.name);
                }
            }
        }
    }
}

#[test]
fn arms_stay_outside_the_trunk_and_hands_follow_forearms() {
    for clip in clips() {
        for (i, frame) in clip.frames.iter().enumerate() {
            let neck = (frame.position(KeyNode::LeftShoulder)
                + frame.position(KeyNode::RightShoulder))
                * 0.5;
            for node in [
                KeyNode::LeftElbow,
                KeyNode::RightElbow,
                KeyNode::LeftWrist,
                KeyNode::RightWrist,
            ] {
                let p = frame.position(node);
                let nearest = neck * (p.dot(&neck) / neck.norm_squared()).clamp(0.0, 1.0);
                assert!(
                    (p - nearest).norm() > 0.08,
                    "{} frame {i}: {} in the trunk",
                    clip.name,
                    node.name()
                );
            }
            for side in Side::BOTH {
                if let Some(hand) = frame.wrist_rotations[side as usize] {
                    let bend = (hand * Vector3::x()).angle(&frame.forearm(side));
                    assert!(
                        bend < 1.3,
                        "{} frame {i}: wrist bent by {bend} rad",
                        clip.name
                    );
                }
            }
        }
    }
}

#[test]
fn trunk_yaw_stays_within_a_waist() {
    for clip in clips() {
        for frame in &clip.frames {
            let line = frame.shoulder_line();
            assert!(f32::atan2(-line.x, line.y).abs() < 0.85, "{}", clip.name);
        }
    }
}

#[test]
fn the_same_seed_gives_the_same_bits_and_another_another() {
    for skill in Skill::ALL {
        assert_eq!(generate(skill, 5), generate(skill, 5));
        assert_ne!(generate(skill, 5).frames, generate(skill, 6).frames);
    }
    assert_eq!(medley(1), medley(1));
    assert_eq!(library(9, 20), library(9, 20));
    assert_ne!(library(9, 20), library(10, 20));
}

#[test]
fn skills_differ_from_each_other() {
    let shown: Vec<Clip> = Skill::ALL
        .into_iter()
        .map(|skill| generate(skill, 2))
        .collect();
    for (i, a) in shown.iter().enumerate() {
        for b in &shown[..i] {
            assert_ne!(a.name, b.name);
            assert_ne!(a.frames, b.frames);
        }
    }
}

/// What makes a skill what it is, checked on every seed.
#[test]
fn skills_do_what_their_names_say() {
    let highest = |clip: &Clip| {
        let over = |f: &emp_motion::KeyNodeFrame, s: Side| {
            f.position(s.arm()[2]).z - f.position(s.arm()[0]).z
        };
        clip.frames
            .iter()
            .map(|f| over(f, Side::Left).max(over(f, Side::Right)))
            .fold(f32::MIN, f32::max)
    };
    let farthest = |clip: &Clip, axis: usize| {
        let reach = |f: &emp_motion::KeyNodeFrame, s: Side| {
            (f.position(s.arm()[2]) - f.position(s.arm()[0]))[axis].abs()
        };
        clip.frames
            .iter()
            .map(|f| reach(f, Side::Left).max(reach(f, Side::Right)))
            .fold(0.0, f32::max)
    };
    let gap = |clip: &Clip| {
        let between = |f: &emp_motion::KeyNodeFrame| {
            (f.position(KeyNode::LeftWrist) - f.position(KeyNode::RightWrist)).norm()
        };
        clip.frames.iter().map(between).fold(f32::MAX, f32::min)
    };
    for seed in SEEDS {
        let make = |skill| generate(skill, seed);
        assert!(highest(&make(Skill::ReachOverhead)) > 0.2);
        assert!(highest(&make(Skill::ScrewLightBulb)) > 0.25);
        assert!(highest(&make(Skill::CombHair)) > 0.2);
        assert!(highest(&make(Skill::Idle)) < 0.0);
        assert!(highest(&make(Skill::ReachLow)) < 0.0);
        assert!(farthest(&make(Skill::ReachSide), 1) > 0.25);
        assert!(farthest(&make(Skill::ArmCircles), 1) > 0.3);
        assert!(farthest(&make(Skill::Punch), 0) > 0.35);
        assert!(farthest(&make(Skill::ReachFront), 0) > 0.25);
        assert!(
            gap(&make(Skill::Clap)) < 0.13,
            "{}",
            gap(&make(Skill::Clap))
        );
    }
}

#[test]
fn a_medley_is_half_a_minute_and_joins_smoothly() {
    for seed in 0..8 {
        let clip = medley(seed);
        assert!(
            (27.0..42.0).contains(&clip.duration()),
            "{} s",
            clip.duration()
        );
        assert!(
            clip.frames
                .iter()
                .all(|f| f.wrist_rotations.iter().all(Option::is_some))
        );
        assert!(peak(&clip, 3) < 5000.0);
    }
}

#[test]
fn a_library_covers_the_reachable_space() {
    let clips = library(3, 200);
    assert_eq!(clips.len(), 200);
    // Octants of azimuth × thirds of elevation around the right shoulder that some hand visits.
    let mut visited = [[0_usize; 3]; 8];
    for frame in clips.iter().flat_map(|c| &c.frames) {
        let d = (frame.position(KeyNode::RightWrist) - frame.position(KeyNode::RightShoulder))
            .normalize();
        let azimuth =
            ((d.y.atan2(d.x) + std::f32::consts::PI) / std::f32::consts::FRAC_PI_4) as usize;
        let elevation = if d.z < -0.5 {
            0
        } else if d.z < 0.5 {
            1
        } else {
            2
        };
        visited[azimuth.min(7)][elevation] += 1;
    }
    // Indices 2..6 are the front from −90° to 90°; 1 is the right side's back.
    for (azimuth, row) in visited.iter().enumerate().take(6).skip(2) {
        for (elevation, count) in row.iter().enumerate() {
            assert!(
                *count > 50,
                "azimuth octant {azimuth}, elevation {elevation}: {count}; {visited:?}"
            );
        }
    }
    let without = clips
        .iter()
        .filter(|c| c.frames[0].wrist_rotations[0].is_none())
        .count();
    assert!(
        (20..60).contains(&without),
        "{without} of 200 without wrists"
    );
    let upper_arms: Vec<f32> = clips
        .iter()
        .map(|c| c.frames[0].bone_lengths().upper_arm[0])
        .collect();
    let spread = upper_arms.iter().copied().fold(f32::MIN, f32::max)
        - upper_arms.iter().copied().fold(f32::MAX, f32::min);
    assert!(spread > 0.06, "bodies differ by {spread} m");
}
