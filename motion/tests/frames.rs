//! Poses and clips: checks, mirror, bone lengths, resampling, time warp, and the joint table.

use emp_motion::joint_csv::JointCsvWriter;
use emp_motion::skills::{Skill, generate};
use emp_motion::{
    BoneLengths, Clip, FrameError, KEY_NODES, KeyNode, KeyNodeFrame, ResampleError, Side,
};
use nalgebra::{Rotation3, Vector3};

/// Arms forward, elbows straight, thumbs up.
fn pose() -> KeyNodeFrame {
    let p = |x, y, z| Vector3::new(x, y, z);
    KeyNodeFrame {
        positions: [
            p(0.0, 0.0, 0.0),
            p(0.0, 0.0, 0.3),
            p(0.0, 0.2, 0.45),
            p(0.0, -0.2, 0.45),
            p(0.3, 0.2, 0.45),
            p(0.3, -0.2, 0.45),
            p(0.55, 0.2, 0.45),
            p(0.55, -0.2, 0.45),
        ],
        wrist_rotations: [Some(Rotation3::identity()); 2],
    }
}

/// The left forearm and hand turn about the vertical through the elbow, `turn` radians a second; no right wrist.
fn turning(fps: f64, seconds: f64, turn: f64) -> Clip {
    let frames = (0..=(seconds * fps).round() as usize)
        .map(|i| {
            let mut frame = pose();
            let rotation =
                Rotation3::from_axis_angle(&Vector3::z_axis(), (turn * i as f64 / fps) as f32);
            frame.positions[KeyNode::LeftWrist as usize] =
                frame.position(KeyNode::LeftElbow) + rotation * Vector3::new(0.25, 0.0, 0.0);
            frame.wrist_rotations = [Some(rotation), None];
            frame
        })
        .collect();
    Clip {
        name: "turning".to_owned(),
        fps,
        frames,
    }
}

fn angle(v: Vector3<f32>) -> f64 {
    f64::from(v.y).atan2(f64::from(v.x))
}

#[test]
fn nodes_name_parents_and_sides() {
    for (index, node) in KeyNode::ALL.into_iter().enumerate() {
        assert_eq!(node as usize, index);
        assert_eq!(node.mirrored().mirrored(), node);
        assert!(node.parent().is_none_or(|parent| (parent as usize) < index));
    }
    assert_eq!(KeyNode::LeftWrist.name(), "left_wrist");
    assert_eq!((Side::Left as usize, Side::Right as usize), (0, 1));
}

#[test]
fn poses_that_are_no_body_are_refused_by_node() {
    assert_eq!(pose().validate(), Ok(()));
    let with = |node: KeyNode, position: Vector3<f32>| {
        let mut frame = pose();
        frame.positions[node as usize] = position;
        frame.validate()
    };
    let nan = with(KeyNode::RightElbow, Vector3::new(0.0, f32::NAN, 0.0));
    assert_eq!(
        nan,
        Err(FrameError::NotFinite {
            node: "right_elbow"
        })
    );
    assert!(matches!(
        with(KeyNode::LeftWrist, Vector3::repeat(9.0)),
        Err(FrameError::TooFar {
            node: "left_wrist",
            ..
        })
    ));
    assert!(matches!(
        with(KeyNode::LeftWrist, Vector3::repeat(3e38)),
        Err(FrameError::TooFar { .. })
    ));
    let empty = with(KeyNode::LeftElbow, pose().position(KeyNode::LeftShoulder));
    assert_eq!(
        empty,
        Err(FrameError::EmptyBone {
            parent: "left_shoulder",
            node: "left_elbow"
        })
    );
    let mut frame = pose();
    frame.wrist_rotations[1] = Some(Rotation3::from_matrix_unchecked(
        -Rotation3::<f32>::identity().into_inner(),
    ));
    assert_eq!(
        frame.validate(),
        Err(FrameError::NotARotation { side: "right" })
    );
}

#[test]
fn mirror_exchanges_sides_and_keeps_hands_right_handed() {
    let mut frame = pose();
    // The left hand points up and out, its thumb to the right.
    frame.positions[KeyNode::LeftWrist as usize] = Vector3::new(0.3, 0.3, 0.6);
    let (x, z) = (Vector3::new(0.0, 0.6, 0.8), Vector3::new(0.0, -0.8, 0.6));
    let hand = Rotation3::from_basis_unchecked(&[x, z.cross(&x), z]);
    frame.wrist_rotations = [Some(hand), None];
    let mirrored = frame.mirrored();
    assert_eq!(
        mirrored.position(KeyNode::RightWrist),
        Vector3::new(0.3, -0.3, 0.6)
    );
    assert_eq!(mirrored.wrist_rotations[0], None);
    let other = mirrored.wrist_rotations[1].expect("right hand");
    assert!((other * Vector3::x() - Vector3::new(0.0, -0.6, 0.8)).norm() < 1e-6);
    assert!((other * Vector3::z() - Vector3::new(0.0, 0.8, 0.6)).norm() < 1e-6);
    assert!((other.matrix().determinant() - 1.0).abs() < 1e-6);
    assert_eq!(mirrored.mirrored(), frame);
}

#[test]
fn other_bone_lengths_keep_directions() {
    let lengths = BoneLengths {
        trunk: 0.2,
        collar: [0.15, 0.16],
        upper_arm: [0.27, 0.26],
        forearm: [0.22, 0.21],
    };
    let clip = generate(Skill::DirectTraffic, 3);
    for frame in &clip.frames {
        let scaled = frame.with_bone_lengths(&lengths);
        let measured = scaled.bone_lengths();
        for node in KeyNode::ALL {
            assert!((measured.of(node) - lengths.of(node)).abs() < 1e-5);
        }
        for side in Side::BOTH {
            assert!((scaled.upper_arm(side) - frame.upper_arm(side)).norm() < 1e-4);
            assert!((scaled.forearm(side) - frame.forearm(side)).norm() < 1e-4);
        }
        assert_eq!(scaled.wrist_rotations, frame.wrist_rotations);
    }
}

#[test]
fn resampling_turns_evenly_and_keeps_bones() {
    for fps in [24.0, 30.0, 100.0, 119.875, 120.0] {
        let clip = turning(fps, 2.0, 3.0)
            .resampled(50.0)
            .expect("an ordinary rate");
        assert!(
            (clip.duration() - 2.0).abs() <= 0.02 + 1.0 / fps,
            "{fps}: {}",
            clip.duration()
        );
        for (i, frame) in clip.frames.iter().enumerate() {
            let expected = 3.0 * i as f64 / 50.0;
            let near = |v: Vector3<f32>| {
                let miss = angle(v) - expected;
                miss.sin().atan2(miss.cos()).abs() < 2e-3
            };
            assert!(
                near(frame.forearm(Side::Left)),
                "{fps} fps, frame {i}: {} not {expected}",
                angle(frame.forearm(Side::Left))
            );
            let hand = frame.wrist_rotations[0].expect("known throughout");
            assert!(near(hand * Vector3::x()), "{fps} fps, frame {i}");
            assert_eq!(frame.wrist_rotations[1], None);
            assert!((frame.bone_lengths().forearm[0] - 0.25).abs() < 1e-5);
        }
    }
}

#[test]
fn going_down_to_50_hz_does_not_alias() {
    // A tremor of 45 Hz at 120 frames a second would come out as one of 5 Hz.
    let mut clip = turning(120.0, 2.0, 0.0);
    for (i, frame) in clip.frames.iter_mut().enumerate() {
        let angle = 0.05 * (std::f64::consts::TAU * 45.0 * i as f64 / 120.0).sin();
        let rotation = Rotation3::from_axis_angle(&Vector3::z_axis(), angle as f32);
        frame.positions[KeyNode::LeftWrist as usize] =
            frame.position(KeyNode::LeftElbow) + rotation * Vector3::new(0.25, 0.0, 0.0);
        frame.wrist_rotations[0] = Some(rotation);
    }
    let slow = clip.resampled(50.0).expect("an ordinary rate");
    for frame in &slow.frames[5..slow.frames.len() - 5] {
        assert!(angle(frame.forearm(Side::Left)).abs() < 0.002);
        assert!(angle(frame.wrist_rotations[0].expect("known") * Vector3::x()).abs() < 0.002);
    }
}

#[test]
fn going_up_does_not_inflate_jerk() {
    let jerk = |clip: &Clip| {
        let step = 1.0 / clip.fps as f32;
        let wrist: Vec<Vector3<f32>> = clip
            .frames
            .iter()
            .map(|f| f.position(KeyNode::RightWrist))
            .collect();
        let third = wrist
            .windows(4)
            .map(|w| ((w[3] - w[0]) - (w[2] - w[1]) * 3.0).norm() / step.powi(3));
        (third.map(|j| j * j).sum::<f32>() / wrist.len() as f32).sqrt()
    };
    let original = generate(Skill::WipeWindow, 1);
    let there_and_back = original
        .resampled(24.0)
        .expect("an ordinary rate")
        .resampled(50.0)
        .expect("an ordinary rate");
    assert!(
        jerk(&there_and_back) < 1.6 * jerk(&original),
        "{} of {}",
        jerk(&there_and_back),
        jerk(&original)
    );
}

#[test]
fn a_wrist_known_for_a_while_stays_known_for_that_while() {
    let mut clip = turning(100.0, 1.0, 1.0);
    for frame in &mut clip.frames[..50] {
        frame.wrist_rotations[0] = None;
    }
    let known: Vec<bool> = clip
        .resampled(50.0)
        .expect("an ordinary rate")
        .frames
        .iter()
        .map(|f| f.wrist_rotations[0].is_some())
        .collect();
    assert_eq!(
        known.iter().filter(|k| **k).count() + known.iter().filter(|k| !**k).count(),
        51
    );
    assert!(
        known[..25].iter().all(|k| !k) && known[40..].iter().all(|k| *k),
        "{known:?}"
    );
}

#[test]
fn time_warp_changes_speed_not_rate() {
    let clip = turning(50.0, 2.0, 1.0);
    let fast = clip.time_warped(2.0).expect("an ordinary rate");
    assert_eq!(fast.fps, 50.0);
    assert!((fast.duration() - 1.0).abs() < 0.021);
    let last = fast.frames.last().expect("frames").forearm(Side::Left);
    assert!((angle(last) - 2.0).abs() < 0.05);
    assert!((clip.time_warped(0.5).expect("an ordinary rate").duration() - 4.0).abs() < 0.021);
}

#[test]
fn short_clips_survive() {
    let one = Clip {
        name: "one".to_owned(),
        fps: 120.0,
        frames: vec![pose()],
    };
    assert_eq!(
        one.resampled(50.0).expect("an ordinary rate").frames,
        vec![pose()]
    );
    assert_eq!(one.duration(), 0.0);
    let none = Clip {
        name: "none".to_owned(),
        fps: 120.0,
        frames: Vec::new(),
    };
    assert!(
        none.resampled(50.0)
            .expect("an ordinary rate")
            .frames
            .is_empty()
    );
    let two = turning(120.0, 1.0 / 120.0, 1.0);
    assert_eq!(
        two.resampled(50.0).expect("an ordinary rate").frames.len(),
        1
    );
    assert_eq!(two.frames[0].positions.len(), KEY_NODES);
}

#[test]
fn a_slow_clip_cannot_fill_the_memory() {
    let mut clip = turning(120.0, 1.0 / 120.0, 1.0);
    assert_eq!(clip.frames.len(), 2);
    for fps in [1e-9, 1e-6, 2e-308, f64::MIN_POSITIVE] {
        clip.fps = fps;
        let error = clip.resampled(50.0).expect_err("too many frames");
        assert!(
            matches!(error, ResampleError::TooManyFrames { limit: 1_000_000, frames } if frames > 1_000_000),
            "{fps}: {error}"
        );
        assert_eq!(clip.resampled(fps).expect("as it is").frames.len(), 2);
    }
    clip.fps = 100.0;
    assert!(matches!(
        clip.time_warped(1e-9),
        Err(ResampleError::TooManyFrames { .. })
    ));
    for rate in [0.0, -50.0, f64::NAN, f64::INFINITY] {
        assert!(matches!(
            clip.resampled(rate),
            Err(ResampleError::Rate { .. })
        ));
        let odd = Clip {
            fps: rate,
            ..clip.clone()
        };
        assert!(matches!(
            odd.resampled(50.0),
            Err(ResampleError::Rate { .. })
        ));
    }
    clip.fps = 0.5;
    assert_eq!(clip.resampled_len(50.0), 101);
    assert_eq!(clip.resampled(50.0).expect("bounded").frames.len(), 101);
}

#[test]
fn joint_tables_appear_whole_or_not_at_all() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let path = folder.path().join("joints.csv");
    let mut table = JointCsvWriter::create(&path, &["waist_yaw", "left, odd"]).expect("created");
    table.write_row(0.0, &[0.5, -1.25]).expect("row");
    let error = table
        .write_row(0.02, &[0.5])
        .expect_err("too few")
        .to_string();
    assert!(
        error.contains("expected 2 joint angles at 0.02 s, found 1"),
        "{error}"
    );
    assert!(!path.exists());
    table.write_row(0.02, &[1.0, 2.0]).expect("row");
    table.finish().expect("finished");
    let text = std::fs::read_to_string(&path).expect("read");
    assert_eq!(
        text,
        "time_s,waist_yaw,\"left, odd\"\n0.0000,0.500000,-1.250000\n0.0200,1.000000,2.000000\n"
    );
    assert_eq!(std::fs::read_dir(folder.path()).expect("folder").count(), 1);
    assert!(JointCsvWriter::create(&folder.path().join("no/such.csv"), &["a"]).is_err());
}
