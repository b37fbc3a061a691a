//! The BVH reader on small files with a known answer, and on broken ones.

mod common;

use std::path::Path;

use common::{
    CHEST_AT, CMU, LEFT_ARM_AT, LEFT_HAND_AT, Names, ORDER, WIDTH, hierarchy, motion, t_pose,
};
use emp_motion::{Clip, KeyNode, MotionError, ReadOptions, Side, UpAxis, bvh};
use nalgebra::{Rotation3, Vector3};
use proptest::prelude::*;

fn read(text: &str) -> Result<Clip, MotionError> {
    read_bytes(text.as_bytes())
}

fn read_bytes(bytes: &[u8]) -> Result<Clip, MotionError> {
    let read = bvh::from_bytes(Path::new("clip.bvh"), bytes, &ReadOptions::default());
    read.map(|reading| reading.clip)
}

fn close(a: Vector3<f32>, b: [f32; 3]) {
    assert!((a - Vector3::from(b)).norm() < 1e-4, "{a} is not {b:?}");
}

fn t_pose_positions(clip: &Clip) {
    let frame = &clip.frames[0];
    close(frame.position(KeyNode::Waist), [0.0, 0.0, 0.0]);
    close(frame.position(KeyNode::Torso), [0.0, 0.0, 0.30]);
    close(frame.position(KeyNode::LeftShoulder), [0.0, 0.18, 0.42]);
    close(frame.position(KeyNode::RightElbow), [0.0, -0.46, 0.42]);
    close(frame.position(KeyNode::LeftWrist), [0.0, 0.71, 0.42]);
}

#[test]
fn t_pose_comes_out_facing_x_with_thumbs_forward() {
    let clip = read(&t_pose()).expect("valid");
    assert_eq!(
        (clip.name.as_str(), clip.frames.len(), clip.fps.round()),
        ("clip", 3, 50.0)
    );
    t_pose_positions(&clip);
    for side in Side::BOTH {
        let hand = clip.frames[0].wrist_rotations[side as usize].expect("the hand rotates");
        let outward = if side == Side::Left { 1.0 } else { -1.0 };
        close(hand * Vector3::x(), [0.0, outward, 0.0]);
        close(hand * Vector3::z(), [1.0, 0.0, 0.0]);
        // Palms down: y, the back of a left hand and the palm of a right one.
        close(hand * Vector3::y(), [0.0, 0.0, outward]);
    }
}

#[test]
fn known_units_are_found_and_unknown_ones_scaled_to_an_adult() {
    for units_a_metre in [1.0, 100.0, 1000.0, 0.45 / 0.0254] {
        t_pose_positions(
            &read(&(hierarchy(&CMU, units_a_metre, ORDER) + &motion(&[[0.0; WIDTH]; 3], 0.02)))
                .expect("valid"),
        );
    }
    let odd =
        read(&(hierarchy(&CMU, 7e5, ORDER) + &motion(&[[0.0; WIDTH]; 3], 0.02))).expect("valid");
    let lengths = odd.frames[0].bone_lengths();
    assert!((lengths.upper_arm[0] + lengths.forearm[0] - 0.53).abs() < 1e-3);
}

#[test]
fn options_override_unit_and_up_axis() {
    let options = ReadOptions {
        metres_per_unit: Some(0.02),
        up: Some(UpAxis::Z),
        ..ReadOptions::default()
    };
    let reading = bvh::from_bytes(Path::new("a.bvh"), t_pose().as_bytes(), &options);
    let clip = reading.expect("valid").clip;
    // y is forward now: the trunk lies along it, twice as long.
    let torso = clip.frames[0].position(KeyNode::Torso);
    assert!(
        (torso.norm() - 0.60).abs() < 1e-4 && torso.z.abs() < 1e-4,
        "{torso}"
    );
    for bad in [0.0, -1.0, f64::NAN] {
        let options = ReadOptions {
            metres_per_unit: Some(bad),
            ..ReadOptions::default()
        };
        assert!(bvh::from_bytes(Path::new("a.bvh"), t_pose().as_bytes(), &options).is_err());
    }
}

#[test]
fn z_up_is_found_from_the_motion() {
    // Local axes stay y up; the root turns y to z, as exporters for z-up worlds write it.
    let mut frame = [0.0; WIDTH];
    frame[5] = 90.0;
    let clip = read(&(hierarchy(&CMU, 100.0, ORDER) + &motion(&[frame; 3], 0.02))).expect("valid");
    t_pose_positions(&clip);
}

#[test]
fn any_euler_order_multiplies_in_file_order() {
    let angles = [20.0, -35.0, 50.0];
    for order in [
        "Xrotation Yrotation Zrotation",
        "Yrotation Zrotation Xrotation",
        "Zrotation Xrotation Yrotation",
    ] {
        let mut frame = [0.0; WIDTH];
        frame[LEFT_ARM_AT..LEFT_ARM_AT + 3].copy_from_slice(&angles);
        let clip =
            read(&(hierarchy(&CMU, 100.0, order) + &motion(&[frame; 3], 0.02))).expect("valid");
        let mut turn = Rotation3::identity();
        for (word, angle) in order.split(' ').zip(angles) {
            let axis = match &word[..1] {
                "X" => Vector3::x_axis(),
                "Y" => Vector3::y_axis(),
                _ => Vector3::z_axis(),
            };
            turn *= Rotation3::from_axis_angle(&axis, f64::to_radians(angle));
        }
        // The file's (x left, y up, z forward) are (y, z, x) here.
        let v = turn * Vector3::x();
        close(
            clip.frames[0].upper_arm(Side::Left),
            [v.z as f32, v.x as f32, v.y as f32],
        );
    }
}

#[test]
fn a_hand_turns_with_its_own_channels() {
    let mut frame = [0.0; WIDTH];
    // ZYX: 90° about x (the left forearm's axis, pointing left) takes the thumb from forward to down.
    frame[LEFT_HAND_AT + 2] = 90.0;
    let clip = read(&(hierarchy(&CMU, 100.0, ORDER) + &motion(&[frame; 3], 0.02))).expect("valid");
    let hand = clip.frames[0].wrist_rotations[0].expect("known");
    close(hand * Vector3::x(), [0.0, 1.0, 0.0]);
    close(hand * Vector3::z(), [0.0, 0.0, -1.0]);
}

#[test]
fn position_channels_replace_the_offset() {
    let text = t_pose().replacen("CHANNELS 3", "CHANNELS 6 Xposition Yposition Zposition", 1);
    let mut lines: Vec<String> = text.lines().map(str::to_owned).collect();
    let start = lines
        .iter()
        .position(|l| l.starts_with("Frame Time"))
        .expect("motion")
        + 1;
    for line in &mut lines[start..] {
        let mut values: Vec<&str> = line.split(' ').collect();
        values.splice(CHEST_AT..CHEST_AT, ["0", "40", "0"]);
        *line = values.join(" ");
    }
    let clip = read(&lines.join("\n")).expect("valid");
    close(clip.frames[0].position(KeyNode::Torso), [0.0, 0.0, 0.40]);
}

#[test]
fn a_wrist_that_is_an_end_site_has_no_orientation() {
    let text = t_pose();
    // The left hand's joint becomes the forearm's end site.
    let start = text.find("JOINT LeftHand").expect("left hand");
    let tail = &text[start..];
    let end = start + tail.match_indices('}').nth(1).expect("end of the hand").0 + 1;
    let text = text[..start].to_owned() + "End Site\n{\nOFFSET 25 0 0\n}" + &text[end..];
    let text: String = text
        .lines()
        .map(|l| if l.starts_with("0.0") { l.split(' ').skip(3).collect::<Vec<_>>().join(" ") } else { l.to_owned() } + "\n")
        .collect();
    let clip = read(&text).expect("valid");
    close(
        clip.frames[0].position(KeyNode::LeftWrist),
        [0.0, 0.71, 0.42],
    );
    assert_eq!(clip.frames[0].wrist_rotations[0], None);
    assert!(clip.frames[0].wrist_rotations[1].is_some());
}

#[test]
fn naming_schemes_are_recognised() {
    let schemes = [
        Names {
            waist: "mixamorig:Hips",
            chest: "mixamorig:Spine2",
            left: [
                "mixamorig:LeftUpLeg",
                "mixamorig:LeftShoulder",
                "mixamorig:LeftArm",
                "mixamorig:LeftForeArm",
                "mixamorig:LeftHand",
            ],
            right: [
                "mixamorig:RightUpLeg",
                "mixamorig:RightShoulder",
                "mixamorig:RightArm",
                "mixamorig:RightForeArm",
                "mixamorig:RightHand",
            ],
        },
        Names {
            waist: "Hips",
            chest: "Chest",
            left: [
                "LeftHip",
                "LeftCollar",
                "LeftShoulder",
                "LeftElbow",
                "LeftWrist",
            ],
            right: [
                "RightHip",
                "RightCollar",
                "RightShoulder",
                "RightElbow",
                "RightWrist",
            ],
        },
        Names {
            waist: "root",
            chest: "thorax",
            left: ["lfemur", "lclavicle", "lhumerus", "lradius", "lwrist"],
            right: ["rfemur", "rclavicle", "rhumerus", "rradius", "rwrist"],
        },
        Names {
            waist: "Pelvis",
            chest: "Spine_02",
            left: [
                "Thigh_L",
                "Clavicle_L",
                "UpperArm_L",
                "LowerArm_L",
                "Hand_L",
            ],
            right: [
                "Thigh_R",
                "Clavicle_R",
                "UpperArm_R",
                "LowerArm_R",
                "Hand_R",
            ],
        },
        Names {
            waist: "pelvis",
            chest: "spine.001",
            left: [
                "thigh.L",
                "shoulder.L",
                "upper_arm.L",
                "forearm.L",
                "hand.L",
            ],
            right: [
                "thigh.R",
                "shoulder.R",
                "upper_arm.R",
                "forearm.R",
                "hand.R",
            ],
        },
        Names {
            waist: "Bip01 Pelvis",
            chest: "Bip01 Spine1",
            left: [
                "Bip01 L Thigh",
                "Bip01 L Clavicle",
                "Bip01 L UpperArm",
                "Bip01 L Forearm",
                "Bip01 L Hand",
            ],
            right: [
                "Bip01 R Thigh",
                "Bip01 R Clavicle",
                "Bip01 R UpperArm",
                "Bip01 R Forearm",
                "Bip01 R Hand",
            ],
        },
        Names {
            waist: "m_avg_Pelvis",
            chest: "m_avg_Spine3",
            left: [
                "m_avg_L_Hip",
                "m_avg_L_Collar",
                "m_avg_L_Shoulder",
                "m_avg_L_Elbow",
                "m_avg_L_Wrist",
            ],
            right: [
                "m_avg_R_Hip",
                "m_avg_R_Collar",
                "m_avg_R_Shoulder",
                "m_avg_R_Elbow",
                "m_avg_R_Wrist",
            ],
        },
    ];
    for names in schemes {
        let clip = read(&(hierarchy(&names, 100.0, ORDER) + &motion(&[[0.0; WIDTH]; 3], 0.02)));
        t_pose_positions(&clip.unwrap_or_else(|e| panic!("{}: {e}", names.left[2])));
    }
}

#[test]
fn unknown_names_are_listed() {
    // Arms that are not alike are no body's.
    let odd = t_pose().replacen("OFFSET 28.000000", "OFFSET 128.000000", 1);
    let error = read(&odd.replace("LeftForeArm", "Flipper"))
        .expect_err("no elbow")
        .to_string();
    assert!(
        error.starts_with("clip.bvh: ")
            && error.contains("left shoulder and elbow")
            && error.contains("Flipper"),
        "{error}"
    );
}

#[test]
fn heading_is_the_pelvis_and_trunk_yaw_stays_visible() {
    let frames: Vec<[f64; WIDTH]> = (0..100)
        .map(|i| {
            let mut frame = [0.0; WIDTH];
            frame[4] = 2.0 * f64::from(i);
            frame[CHEST_AT + 1] = 30.0;
            frame
        })
        .collect();
    let clip = read(&(hierarchy(&CMU, 100.0, ORDER) + &motion(&frames, 0.02))).expect("valid");
    for frame in &clip.frames {
        let line = frame.shoulder_line();
        assert!(
            (f32::atan2(-line.x, line.y).to_degrees() - 30.0).abs() < 0.2,
            "{line}"
        );
    }
}

#[test]
fn an_inserted_rest_pose_is_dropped_and_a_continuous_one_kept() {
    let mut frames = [[0.0; WIDTH]; 12];
    for (i, frame) in frames.iter_mut().enumerate().skip(1) {
        frame[LEFT_ARM_AT] = -70.0 - i as f64 * 0.5;
    }
    let read = |frames: &[[f64; WIDTH]]| {
        read(&(hierarchy(&CMU, 100.0, ORDER) + &motion(frames, 0.02))).expect("valid")
    };
    assert_eq!(read(&frames).frames.len(), 11);
    frames[0][LEFT_ARM_AT] = -70.0;
    assert_eq!(read(&frames).frames.len(), 12);
}

#[test]
fn windows_line_ends_and_a_byte_order_mark_are_fine() {
    t_pose_positions(&read(&format!("\u{feff}{}", t_pose().replace('\n', "\r\n"))).expect("valid"));
}

/// The message of the error that a change of the T pose's text leads to.
fn broken(from: &str, to: &str) -> String {
    let text = t_pose();
    assert!(text.contains(from));
    read(&text.replacen(from, to, 1))
        .expect_err("broken")
        .to_string()
}

#[test]
fn broken_files_name_line_and_reason() {
    let value_line = t_pose()
        .lines()
        .position(|l| l.starts_with("0.0"))
        .expect("values")
        + 1;
    for (from, to, expected) in [
        (
            "HIERARCHY",
            "HELLO",
            "clip.bvh:1: expected HIERARCHY, found \"HELLO\"".to_owned(),
        ),
        (
            "Xposition Yposition",
            "Xposition Wposition",
            "clip.bvh:5: expected a channel".to_owned(),
        ),
        (
            "Xposition Yposition",
            "Xposition Xposition",
            "clip.bvh:5: channel Xposition appears twice".to_owned(),
        ),
        (
            "OFFSET 0 0 0",
            "OFFSET 0 nan 0",
            "clip.bvh:4: OFFSET y: expected a finite number".to_owned(),
        ),
        (
            "OFFSET 0 0 0",
            "OFFSET 0 1e999 0",
            "clip.bvh:4: OFFSET y: expected a finite number".to_owned(),
        ),
        (
            "CHANNELS 6",
            "CHANNELS 99999999999",
            "clip.bvh:5: expected 0 to 6 channels".to_owned(),
        ),
        (
            "Frames: 3",
            "Frames: 1000000000",
            "1000000000 frames is no plausible number".to_owned(),
        ),
        (
            "Frames: 3",
            "Frames: -3",
            "expected a number of frames".to_owned(),
        ),
        (
            "Frame Time: 0.02",
            "Frame Time: 0",
            "frame time of 0 s".to_owned(),
        ),
        (
            "Frame Time: 0.02\n0.000000 ",
            "Frame Time: 0.02\n",
            format!("clip.bvh:{value_line}: frame 0: expected 33 values, found 32"),
        ),
        (
            "Frame Time: 0.02\n0.000000 ",
            "Frame Time: 0.02\nNaN ",
            format!("clip.bvh:{value_line}: frame 0: expected a finite number"),
        ),
        (
            "OFFSET 25.000000 0.000000 0.000000",
            "OFFSET 0 0 0",
            "clip.bvh: frame 0: bone left_elbow to left_wrist has no length".to_owned(),
        ),
    ] {
        let message = broken(from, to);
        assert!(message.contains(&expected), "{to}: {message}");
    }
}

#[test]
fn every_truncation_before_the_second_frame_is_an_error() {
    let text = t_pose();
    let start = text.find("Frame Time").expect("motion");
    let first = text[start..].match_indices('\n').nth(1).expect("frames").0 + start;
    // The last value may lose digits and still be a number.
    for end in 0..first - "0.000000".len() {
        assert!(read(&text[..end]).is_err(), "cut at {end}");
    }
    for end in first..text.len() {
        assert!((1..=3).contains(&read(&text[..end]).expect("whole frames").frames.len()));
    }
}

#[test]
fn deep_nesting_is_an_error_not_a_stack_overflow() {
    let text = "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 0\n".to_owned()
        + &"JOINT b\n{\nOFFSET 0 1 0\nCHANNELS 0\n".repeat(100_000);
    let error = read(&text).expect_err("too deep").to_string();
    assert!(error.contains("more than 2048 joints"), "{error}");
}

proptest! {
    #[test]
    fn arbitrary_bytes_are_answered(bytes in proptest::collection::vec(any::<u8>(), 0..2000)) {
        prop_assert!(read_bytes(&bytes).is_err());
    }

    #[test]
    fn mutations_of_a_valid_file_are_an_error_or_a_valid_clip(
        edits in proptest::collection::vec((any::<prop::sample::Index>(), prop_oneof![
            any::<u8>().prop_map(|b| vec![b]),
            Just(b"1e308".to_vec()), Just(b"-".to_vec()), Just(b"}".to_vec()), Just(b"{".to_vec()),
            Just(b"\n".to_vec()), Just(b"JOINT ".to_vec()), Just(b"nan".to_vec()), Just(Vec::new()),
        ]), 1..6),
    ) {
        let mut bytes = t_pose().into_bytes();
        for (at, with) in edits {
            let at = at.index(bytes.len());
            bytes.splice(at..at + 1, with);
        }
        if let Ok(clip) = read_bytes(&bytes) {
            prop_assert_eq!(clip.validate(), Ok(()));
        }
    }
}
