//! The MVNX reader on small files with a known answer, and on broken ones.

use std::path::Path;

use emp_motion::{KeyNode, MotionError, ReadOptions, Reading, Side, mvnx};
use nalgebra::{Rotation3, UnitQuaternion, Vector3};
use proptest::prelude::*;

/// Segments of a T pose facing x, metres, as the suit's software orders them.
const SEGMENTS: [(&str, [f64; 3]); 23] = [
    ("Pelvis", [0.0, 0.0, 0.95]),
    ("L5", [0.0, 0.0, 1.05]),
    ("L3", [0.0, 0.0, 1.15]),
    ("T12", [0.0, 0.0, 1.22]),
    ("T8", [0.0, 0.0, 1.30]),
    ("Neck", [0.0, 0.0, 1.45]),
    ("Head", [0.0, 0.0, 1.55]),
    ("RightShoulder", [0.0, -0.03, 1.42]),
    ("RightUpperArm", [0.0, -0.18, 1.42]),
    ("RightForeArm", [0.0, -0.46, 1.42]),
    ("RightHand", [0.0, -0.71, 1.42]),
    ("LeftShoulder", [0.0, 0.03, 1.42]),
    ("LeftUpperArm", [0.0, 0.18, 1.42]),
    ("LeftForeArm", [0.0, 0.46, 1.42]),
    ("LeftHand", [0.0, 0.71, 1.42]),
    ("RightUpperLeg", [0.0, -0.09, 0.92]),
    ("RightLowerLeg", [0.0, -0.09, 0.50]),
    ("RightFoot", [0.0, -0.09, 0.09]),
    ("RightToe", [0.15, -0.09, 0.03]),
    ("LeftUpperLeg", [0.0, 0.09, 0.92]),
    ("LeftLowerLeg", [0.0, 0.09, 0.50]),
    ("LeftFoot", [0.0, 0.09, 0.09]),
    ("LeftToe", [0.15, 0.09, 0.03]),
];

fn numbers(values: impl IntoIterator<Item = f64>) -> String {
    values
        .into_iter()
        .map(|v| format!("{v:.6}"))
        .collect::<Vec<_>>()
        .join(" ")
}

/// A frame of the T pose turned by `world`, with the left hand turned by `hand` in the world first.
fn frame(kind: &str, world: Rotation3<f64>, hand: Rotation3<f64>) -> String {
    let orientations = SEGMENTS.iter().flat_map(|(name, _)| {
        let turn = if *name == "LeftHand" {
            world * hand
        } else {
            world
        };
        let q = UnitQuaternion::from_rotation_matrix(&turn);
        [q.w, q.i, q.j, q.k]
    });
    let positions = SEGMENTS.iter().flat_map(|(_, p)| {
        let p = world * Vector3::from(*p);
        [p.x, p.y, p.z]
    });
    format!(
        "<frame time=\"0\" index=\"0\" tc=\"00:00\" type=\"{kind}\"><orientation>{}</orientation><position>{}</position></frame>\n",
        numbers(orientations),
        numbers(positions)
    )
}

fn document(frames: &str) -> String {
    let segments = SEGMENTS.iter().enumerate().map(|(i, (name, _))| {
        let id = i + 1;
        format!("<segment label=\"{name}\" id=\"{id}\"><points><point label=\"p\"><pos_b>0 0 0</pos_b></point></points></segment>\n")
    });
    format!(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<mvnx xmlns=\"http://www.xsens.com/mvn/mvnx\" version=\"4\">\n<mvn version=\"2021\"/>\n<comment/>\n\
         <subject label=\"a\" frameRate=\"60\" segmentCount=\"23\">\n<segments>\n{}</segments>\n<frames segmentCount=\"23\">\n{frames}</frames>\n</subject>\n</mvnx>\n",
        segments.collect::<String>()
    )
}

fn t_pose(world: Rotation3<f64>, hand: Rotation3<f64>) -> String {
    let first = frame("identity", Rotation3::identity(), hand)
        + &frame("tpose", Rotation3::identity(), hand);
    document(&(first + &frame("normal", world, hand).repeat(3)))
}

fn read(text: &str) -> Result<Reading, MotionError> {
    mvnx::from_bytes(
        Path::new("a.mvnx"),
        text.as_bytes(),
        &ReadOptions::default(),
    )
}

fn close(a: Vector3<f32>, b: [f32; 3]) {
    assert!((a - Vector3::from(b)).norm() < 1e-3, "{a} is not {b:?}");
}

#[test]
fn the_t_pose_comes_out_facing_x_at_any_heading_and_up_axis() {
    let half = std::f64::consts::FRAC_PI_2;
    let roll = Rotation3::from_axis_angle(&Vector3::y_axis(), 0.5);
    for (up, world) in [
        ("z", Rotation3::identity()),
        ("z", Rotation3::from_axis_angle(&Vector3::z_axis(), 2.0)),
        ("y", Rotation3::from_axis_angle(&Vector3::x_axis(), -half)),
    ] {
        let reading = read(&t_pose(world, roll)).expect("valid");
        let understood = &reading.understanding;
        assert_eq!(
            (understood.format, understood.frames, understood.fps),
            ("MVNX", 3, 60.0)
        );
        assert_eq!(understood.up.as_deref(), Some(up));
        assert_eq!(understood.handedness, Some("right-handed"));
        assert_eq!(understood.warnings, Vec::<String>::new());
        assert!((understood.height.expect("legs and head") - 1.52).abs() < 0.01);
        let frame = &reading.clip.frames[0];
        close(frame.position(KeyNode::Torso), [0.0, 0.0, 0.35]);
        close(frame.position(KeyNode::LeftElbow), [0.0, 0.46, 0.47]);
        close(frame.position(KeyNode::RightWrist), [0.0, -0.71, 0.47]);
        let [left, right] = frame.wrist_rotations.map(|hand| hand.expect("known"));
        close(left * Vector3::x(), [0.0, 1.0, 0.0]);
        // Rolled by half a radian about the forearm: the thumb from forward to down.
        close(left * Vector3::z(), [0.5_f32.cos(), 0.0, -0.5_f32.sin()]);
        close(right * Vector3::x(), [0.0, -1.0, 0.0]);
        close(right * Vector3::z(), [1.0, 0.0, 0.0]);
        for side in Side::BOTH {
            assert!(frame.upper_arm(side).z.abs() < 1e-3);
        }
    }
}

#[test]
fn what_is_missing_or_wrong_is_named() {
    let good = t_pose(Rotation3::identity(), Rotation3::identity());
    for (from, to, expected) in [
        (
            "label=\"LeftForeArm\"",
            "label=\"Flipper\"",
            "no segment LeftForeArm for left_elbow; there are Pelvis",
        ),
        ("frameRate=\"60\"", "", "no frameRate; --fps"),
        (
            "frameRate=\"60\"",
            "frameRate=\"6e9\"",
            "frame rate 6000000000 is not between",
        ),
        ("<subject", "<object", "<subject>, found none"),
        (
            "type=\"normal\"><orientation>1.0",
            "type=\"normal\"><orientation>nan",
            "frame 0: expected a finite number, found \"nan",
        ),
        (
            "type=\"normal\"><orientation>1.000000 ",
            "type=\"normal\"><orientation>",
            "expected 92 numbers in <orientation>, 4 a segment, found 91",
        ),
        ("type=\"normal\"", "type=\"npose\"", ""),
    ] {
        assert!(good.contains(from), "{from}");
        match read(&good.replacen(from, to, 1)) {
            Err(error) => assert!(
                !expected.is_empty() && error.to_string().contains(expected),
                "{to}: {error}"
            ),
            Ok(reading) => assert!(
                expected.is_empty() && reading.clip.frames.len() == 2,
                "{to}"
            ),
        }
    }
    let none = document(&frame(
        "tpose",
        Rotation3::identity(),
        Rotation3::identity(),
    ));
    assert!(
        read(&none)
            .expect_err("no frames")
            .to_string()
            .contains("0 frames")
    );
    let options = ReadOptions {
        fps: Some(30.0),
        ..ReadOptions::default()
    };
    let given = mvnx::from_bytes(
        Path::new("a.mvnx"),
        good.replace("frameRate=\"60\"", "").as_bytes(),
        &options,
    );
    assert_eq!(given.expect("a rate").clip.fps, 30.0);
}

#[test]
fn of_two_people_the_first_is_read() {
    let good = t_pose(Rotation3::identity(), Rotation3::identity());
    let start = good.find("<subject").expect("a person");
    let end = good.find("</mvnx>").expect("the end");
    let two = format!("{}{}{}", &good[..end], &good[start..end], &good[end..]);
    let reading = read(&two).expect("valid");
    assert_eq!(reading.clip.frames.len(), 3);
    assert!(reading.understanding.warnings[0].contains("2 people"));
}

proptest! {
    #[test]
    fn arbitrary_bytes_are_answered(bytes in proptest::collection::vec(any::<u8>(), 0..2000)) {
        prop_assert!(mvnx::from_bytes(Path::new("x.mvnx"), &bytes, &ReadOptions::default()).is_err());
    }

    #[test]
    fn mutations_of_a_valid_file_are_an_error_or_a_valid_clip(
        edits in proptest::collection::vec((any::<prop::sample::Index>(), prop_oneof![
            any::<u8>().prop_map(|b| vec![b]),
            Just(b"1e308".to_vec()), Just(b"<".to_vec()), Just(b"/>".to_vec()), Just(b"&#0;".to_vec()),
            Just(b"<!--".to_vec()), Just(b"<segment/>".to_vec()), Just(b"nan".to_vec()), Just(Vec::new()),
        ]), 1..6),
    ) {
        let mut bytes = t_pose(Rotation3::identity(), Rotation3::identity()).into_bytes();
        for (at, with) in edits {
            let at = at.index(bytes.len());
            bytes.splice(at..at + 1, with);
        }
        if let Ok(reading) = mvnx::from_bytes(Path::new("x.mvnx"), &bytes, &ReadOptions::default()) {
            prop_assert_eq!(reading.clip.validate(), Ok(()));
        }
    }
}
