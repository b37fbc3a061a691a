//! The SMPL family's and key-node readers and the key-node writer on small archives with a known answer, and on broken ones.

mod common;

use std::path::Path;

use common::{f4, f8, markers, npy, npz, unicode};
use emp_motion::{
    Clip, KeyNode, KeyNodeFrame, MotionError, ReadOptions, Side, UpAxis, key_nodes, load, skills,
    smpl,
};
use nalgebra::{Rotation3, Vector3};
use proptest::prelude::*;

type Entries = Vec<(&'static str, Vec<u8>)>;

fn close(a: Vector3<f32>, b: [f32; 3], tolerance: f32) {
    assert!(
        (a - Vector3::from(b)).norm() < tolerance,
        "{a} is not {b:?}"
    );
}

fn read_smpl(entries: &[(&str, Vec<u8>)]) -> Result<Clip, MotionError> {
    smpl_bytes(&npz(entries))
}

fn smpl_bytes(bytes: &[u8]) -> Result<Clip, MotionError> {
    let read = smpl::from_bytes(Path::new("clip.npz"), bytes, &ReadOptions::default());
    read.map(|reading| reading.clip)
}

fn nodes_bytes(bytes: &[u8]) -> Result<Clip, MotionError> {
    let read = key_nodes::from_bytes(Path::new("clip.npz"), bytes, &ReadOptions::default());
    read.map(|reading| reading.clip)
}

fn read_nodes(entries: &[(&str, Vec<u8>)]) -> Result<Clip, MotionError> {
    nodes_bytes(&npz(entries))
}

/// Axis-angle values of the SMPL-H T pose in a z-up world, facing `yaw`, with one more joint turned.
fn smpl_pose(yaw: f64, joint: usize, turn: Vector3<f64>) -> Vec<f64> {
    let mut pose = vec![0.0; 156];
    let up = Rotation3::from_axis_angle(&Vector3::x_axis(), std::f64::consts::FRAC_PI_2);
    let root = (Rotation3::from_axis_angle(&Vector3::z_axis(), yaw) * up).scaled_axis();
    pose[..3].copy_from_slice(root.as_slice());
    pose[3 * joint..3 * joint + 3].copy_from_slice(turn.as_slice());
    pose
}

fn smpl_h(frames: &[Vec<f64>]) -> Entries {
    let shape = format!("({}, 156)", frames.len());
    vec![
        ("poses", f8(&shape, frames.iter().flatten().copied())),
        ("mocap_framerate", f8("()", [120.0])),
    ]
}

#[test]
fn smpl_h_t_pose_is_upright_with_palms_down_at_any_heading() {
    for yaw in [0.0, 1.0, -2.5] {
        let clip =
            read_smpl(&smpl_h(&vec![smpl_pose(yaw, 1, Vector3::zeros()); 2])).expect("valid");
        assert_eq!(clip.fps, 120.0);
        let frame = &clip.frames[0];
        close(
            frame.position(KeyNode::Torso),
            [-0.0002, 0.0045, 0.2971],
            1e-4,
        );
        close(frame.upper_arm(Side::Left), [-0.105, 0.993, -0.049], 2e-3);
        close(frame.upper_arm(Side::Right), [-0.084, -0.995, -0.052], 2e-3);
        for side in Side::BOTH {
            let outward = if side == Side::Left { 1.0 } else { -1.0 };
            let hand = frame.wrist_rotations[side as usize].expect("known");
            close(hand * Vector3::x(), [0.0, outward, 0.0], 1e-5);
            close(hand * Vector3::z(), [1.0, 0.0, 0.0], 1e-5);
        }
    }
}

#[test]
fn smpl_elbow_turns_forearm_and_hand() {
    // Left elbow −90° about the body's y (up): the left forearm from sideways to forward, the thumb to the right.
    let turn = Vector3::y() * -std::f64::consts::FRAC_PI_2;
    let clip = read_smpl(&smpl_h(&[smpl_pose(0.0, 18, turn)])).expect("valid");
    close(
        clip.frames[0].forearm(Side::Left),
        [0.999, -0.005, 0.036],
        1e-2,
    );
    let hand = clip.frames[0].wrist_rotations[0].expect("known");
    close(hand * Vector3::x(), [1.0, 0.0, 0.0], 1e-5);
    close(hand * Vector3::z(), [0.0, -1.0, 0.0], 1e-5);
}

#[test]
fn smpl_x_fields_give_the_same_motion_as_smpl_h() {
    let pose = smpl_pose(0.7, 16, Vector3::new(0.3, -0.2, 0.9));
    let other = read_smpl(&[
        ("root_orient", f4("(1, 3)", pose[..3].to_vec())),
        ("pose_body", f4("(1, 63)", pose[3..66].to_vec())),
        ("mocap_frame_rate", f8("()", [120.0])),
    ])
    .expect("valid");
    let clip = read_smpl(&smpl_h(&[pose])).expect("valid");
    for (a, b) in clip.frames[0]
        .positions
        .iter()
        .zip(&other.frames[0].positions)
    {
        assert!((a - b).norm() < 1e-5);
    }
}

#[test]
fn every_name_and_shape_of_the_family_gives_the_same_motion() {
    let poses: Vec<Vec<f64>> = (0..3)
        .map(|i| smpl_pose(0.4 * f64::from(i), 16, Vector3::new(0.3, -0.2, 0.9)))
        .collect();
    let expected = read_smpl(&smpl_h(&poses)).expect("valid");
    let rate = |name| (name, f8("()", [120.0]));
    let part = |from: usize, to: usize| poses.iter().flat_map(move |p| p[from..to].to_vec());
    let matrices = |from: usize, to: usize| {
        part(from, to)
            .collect::<Vec<f64>>()
            .as_chunks::<3>()
            .0
            .iter()
            .flat_map(|v| {
                let matrix = Rotation3::from_scaled_axis(Vector3::from(*v)).into_inner();
                matrix.transpose().as_slice().to_vec()
            })
            .collect::<Vec<f64>>()
    };
    let files = [
        vec![("poses", f8("(3, 72)", part(0, 72))), rate("fps")],
        vec![
            ("smpl_poses", f8("(3, 24, 3)", part(0, 72))),
            rate("frame_rate"),
        ],
        vec![
            ("pose", f8("(3, 52, 3)", part(0, 156))),
            rate("mocap_framerate"),
        ],
        vec![
            ("poses", f8("(3, 24, 3, 3)", matrices(0, 72))),
            rate("framerate"),
        ],
        vec![
            ("root_orient", f8("(3, 1, 3)", part(0, 3))),
            ("pose_body", f8("(3, 23, 3)", part(3, 72))),
            rate("fps"),
        ],
        vec![
            ("global_orient", f8("(3, 3, 3)", matrices(0, 3))),
            ("body_pose", f8("(3, 21, 3, 3)", matrices(3, 66))),
            rate("fps"),
        ],
        vec![
            ("global_orient", f8("(3, 1, 3, 3)", matrices(0, 3))),
            ("body_pose", f8("(3, 69)", part(3, 72))),
            rate("fps"),
        ],
    ];
    for file in files {
        let clip = read_smpl(&file).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!(clip.fps, 120.0);
        for (a, b) in clip.frames.iter().zip(&expected.frames) {
            for (a, b) in a.positions.iter().zip(&b.positions) {
                assert!((a - b).norm() < 1e-5, "{}", file[0].0);
            }
        }
    }
    let quaternions = read_smpl(&[("poses", f8("(3, 24, 4)", vec![0.5; 288])), rate("fps")]);
    assert!(
        quaternions
            .expect_err("a shape")
            .to_string()
            .contains("shape [3, 24, 4]")
    );
    let sheared = read_smpl(&[("poses", f8("(1, 22, 3, 3)", vec![0.5; 198])), rate("fps")]);
    assert!(
        sheared
            .expect_err("no rotations")
            .to_string()
            .contains("joint 0 is no rotation")
    );
}

#[test]
fn any_axis_of_a_smpl_world_may_point_up() {
    let expected = read_smpl(&smpl_h(&vec![smpl_pose(0.3, 18, Vector3::y()); 3])).expect("valid");
    // From the z-up world to others, and the pelvis 0.95 m over a floor at zero.
    let worlds = [
        ("y", Vector3::x() * -std::f64::consts::FRAC_PI_2),
        ("-y", Vector3::x() * std::f64::consts::FRAC_PI_2),
        ("-z", Vector3::x() * std::f64::consts::PI),
        ("x", Vector3::y() * std::f64::consts::FRAC_PI_2),
    ];
    for (up, turn) in worlds {
        let turn = Rotation3::from_scaled_axis(turn);
        let mut pose = smpl_pose(0.3, 18, Vector3::y());
        let root = turn * Rotation3::from_scaled_axis(Vector3::from_row_slice(&pose[..3]));
        pose[..3].copy_from_slice(root.scaled_axis().as_slice());
        let place = turn * Vector3::new(0.4, 1.0, 0.95);
        let mut file = smpl_h(&[pose.clone(), pose.clone(), pose]);
        file.push((
            "trans",
            f8("(3, 3)", [place; 3].iter().flat_map(|p| [p.x, p.y, p.z])),
        ));
        let reading = smpl::from_bytes(Path::new("a.npz"), &npz(&file), &ReadOptions::default())
            .expect("valid");
        assert_eq!(reading.understanding.up.as_deref(), Some(up));
        for (a, b) in reading.clip.frames.iter().zip(&expected.frames) {
            for (a, b) in a.positions.iter().zip(&b.positions) {
                assert!((a - b).norm() < 1e-4, "{up}");
            }
        }
        let options = ReadOptions {
            up: Some(UpAxis::Z),
            ..ReadOptions::default()
        };
        let forced = smpl::from_bytes(Path::new("a.npz"), &npz(&file), &options);
        assert!(
            forced.is_err() || forced.is_ok_and(|r| r.understanding.up.as_deref() == Some("z"))
        );
    }
}

#[test]
fn broken_smpl_files_name_the_array() {
    let good = smpl_h(&[smpl_pose(0.0, 1, Vector3::zeros())]);
    let rate = good[1].1.clone();
    let with = |poses: Vec<u8>| {
        read_smpl(&[("poses", poses), ("mocap_framerate", rate.clone())])
            .expect_err("broken")
            .to_string()
    };
    for (poses, expected) in [
        (
            f8("(1, 155)", vec![0.0; 156]),
            "array poses: shape [1, 155] needs 1240 bytes, found more",
        ),
        (
            f8("(2, 156)", vec![0.0; 156]),
            "array poses: shape [2, 156] needs 2496 bytes, found 1248",
        ),
        (
            f8("(156,)", vec![0.0; 156]),
            "array poses: shape [156] is not frames",
        ),
        (
            f8("(52, 3)", vec![0.0; 156]),
            "array poses: shape [52, 3] is not frames",
        ),
        (f8("(0, 156)", []), "0 frames; expected 1 to 500000"),
        (
            f8("(1, 156)", vec![f64::NAN; 156]),
            "no frame has a level line",
        ),
        (npy("<f8", "(1000000000000, 156)", &[]), "larger than the"),
        (
            npy("<f8", "(4294967296, 4294967296, 156)", &[]),
            "larger than the",
        ),
        (npy("|O", "(1, 156)", &[]), "expected a header of descr"),
        (
            npy("<c16", "(1, 66)", &[0; 16 * 66]),
            "expected real numbers, found type c16",
        ),
        (
            b"\x93NUMPY\x02\x00\xff\xff\xff\xff".to_vec(),
            "header of 4294967295 bytes is longer",
        ),
        (b"PK".to_vec(), "too short for an npy header"),
    ] {
        let message = with(poses);
        assert!(
            message.starts_with("clip.npz: ") && message.contains(expected),
            "{expected}: {message}"
        );
    }
    let message = read_smpl(&good[..1]).expect_err("no rate").to_string();
    assert!(message.contains("mocap_frame_rate"), "{message}");
    let message = read_smpl(&[
        good[0].clone(),
        ("mocap_framerate", f8("()", [f64::INFINITY])),
    ])
    .expect_err("rate")
    .to_string();
    assert!(message.contains("frame rate inf"), "{message}");
}

#[test]
fn element_types_of_numpy_are_read() {
    let read = |fps: Vec<u8>| {
        let mut entries = markers(1, |_| 0.0);
        entries[0].1 = fps;
        read_nodes(&entries).expect("valid").fps
    };
    assert_eq!(read(npy("<f4", "()", &100_f32.to_le_bytes())), 100.0);
    assert_eq!(read(npy(">f8", "()", &100_f64.to_be_bytes())), 100.0);
    assert_eq!(read(npy("<f2", "(1,)", &0x5640_u16.to_le_bytes())), 100.0);
    assert_eq!(read(npy("<i8", "()", &100_i64.to_le_bytes())), 100.0);
    assert_eq!(read(npy(">i4", "()", &100_i32.to_be_bytes())), 100.0);
    assert_eq!(read(npy("<u2", "()", &100_u16.to_le_bytes())), 100.0);
    assert_eq!(read(npy("|u1", "()", &[100])), 100.0);
    let mut entries = markers(1, |_| 0.0);
    let names: Vec<u8> = common::MARKERS
        .iter()
        .flat_map(|(n, _)| format!("{n:\0<12}").into_bytes())
        .collect();
    entries[1].1 = npy("|S12", "(8,)", &names);
    assert!(read_nodes(&entries).is_ok());
}

#[test]
fn a_marker_file_gets_a_trunk_at_its_own_scale() {
    let clip = read_nodes(&markers(5, |frame| 0.4 + 0.1 * frame as f64)).expect("valid");
    let arm = 0.2807 + 0.25;
    for frame in &clip.frames {
        close(frame.position(KeyNode::Waist), [0.0; 3], 1e-6);
        close(frame.position(KeyNode::Torso), [0.0, 0.0, 0.58 * arm], 2e-3);
        close(
            frame.position(KeyNode::LeftShoulder),
            [0.0, 0.2, 0.88 * arm],
            2e-3,
        );
        // Torso-relative: the shoulder line is the heading.
        close(frame.shoulder_line(), [0.0, 1.0, 0.0], 1e-5);
        close(frame.forearm(Side::Right), [1.0, 0.0, 0.0], 1e-5);
    }
    // The hands were written along the world's axes, so they turn against the heading.
    let hand = clip.frames[0].wrist_rotations[0].expect("known");
    close(
        hand * Vector3::x(),
        [0.4_f32.cos(), -(0.4_f32.sin()), 0.0],
        1e-5,
    );
}

#[test]
fn broken_key_node_files_name_array_and_frame() {
    let good = markers(2, |_| 0.0);
    let with = |index: usize, array: Vec<u8>| {
        let mut entries = good.clone();
        entries[index].1 = array;
        read_nodes(&entries).expect_err("broken").to_string()
    };
    let mut nan_position = vec![0.1; 48];
    nan_position[33] = f64::NAN;
    let mut half_known = vec![f64::NAN; 36];
    half_known[20] = 1.0;
    for (index, array, expected) in [
        (
            1,
            unicode(&["waist"; 8]),
            "array nodes: expected torso, found waist, waist",
        ),
        (
            1,
            unicode(&["a", "b", "c", "d", "e", "f", "g", "h"]),
            "array nodes: expected left_shoulder or L_shoulder, found a, b",
        ),
        (
            1,
            unicode(&["sternum"]),
            "array pos: 8 nodes, but nodes names 1",
        ),
        (1, f8("(8,)", [0.0; 8]), "array nodes: expected strings"),
        (
            2,
            f4("(2, 24)", [0.0; 48]),
            "array pos: expected shape [frames, nodes, 3], found [2, 24]",
        ),
        (
            2,
            f4("(2, 8, 3)", nan_position),
            "array pos: frame 1: L_elbow is not finite",
        ),
        (2, f4("(2, 8, 3)", [0.0; 48]), "no frame has a level line"),
        (
            3,
            f4("(1, 2, 3, 3)", [0.0; 18]),
            "array wrist_R: expected shape [2, 2, 3, 3]",
        ),
        (
            3,
            f4("(2, 2, 3, 3)", half_known),
            "array wrist_R: frame 1: the left matrix is not a rotation",
        ),
    ] {
        let message = with(index, array);
        assert!(message.contains(expected), "{expected}: {message}");
    }
    assert!(
        nodes_bytes(b"no zip")
            .expect_err("no zip")
            .to_string()
            .contains("not an npz archive")
    );
}

#[test]
fn a_small_archive_cannot_ask_for_much_memory() {
    // 300 MB of zeros compress to 300 kB; the announced shape is refused before any of it is unpacked.
    let mut entries = markers(1, |_| 0.0);
    entries[2].1 = npy("<f4", "(3200000, 8, 3)", &vec![0; 307_200_000]);
    let bytes = npz(&entries);
    assert!(bytes.len() < 1_000_000);
    let message = nodes_bytes(&bytes).expect_err("bomb").to_string();
    assert!(message.contains("larger than the"), "{message}");
}

#[test]
fn written_clips_come_back_bit_for_bit() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let path = folder.path().join("wave.npz");
    let with_wrists = (0..50)
        .map(|seed| skills::generate(skills::Skill::Wave, seed))
        .find(|c| c.frames[0].wrist_rotations[0].is_some());
    let mut clip = with_wrists.expect("most clips know the wrists");
    clip.name = "wave".to_owned();
    clip.frames[3].wrist_rotations[1] = None;
    key_nodes::write(&path, &clip).expect("written");
    let read = load(&path).expect("read");
    assert_eq!(
        (&read.name, read.fps, read.frames.len()),
        (&clip.name, clip.fps, clip.frames.len())
    );
    for (a, b) in read.frames.iter().zip(&clip.frames) {
        assert_same(a, b);
    }
    assert_eq!(
        std::fs::read_dir(folder.path()).expect("folder").count(),
        1,
        "no temporary file is left"
    );
}

/// Positions to the bit; rotations to the rounding of making them orthonormal again.
fn assert_same(a: &KeyNodeFrame, b: &KeyNodeFrame) {
    for (p, q) in a.positions.iter().zip(&b.positions) {
        assert!((p - q).norm() < 1e-6);
    }
    for (r, s) in a.wrist_rotations.iter().zip(&b.wrist_rotations) {
        match (r, s) {
            (Some(r), Some(s)) => assert!((r.matrix() - s.matrix()).amax() < 1e-6),
            (None, None) => {}
            _ => panic!("a wrist was lost or invented"),
        }
    }
}

#[test]
fn an_archive_of_something_else_is_refused_by_its_contents() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let path = folder.path().join("weights.npz");
    std::fs::write(&path, npz(&[("layer", f4("(2,)", [1.0, 2.0]))])).expect("written");
    let message = load(&path).expect_err("no motion").to_string();
    assert!(message.contains("found layer"), "{message}");
}

/// Archives with one array's bytes replaced, and whole archives with some bytes changed.
fn mutated(entries: Entries) -> impl Strategy<Value = Vec<u8>> {
    let whole = npz(&entries);
    let edits = || proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..8);
    let edit = |mut bytes: Vec<u8>, edits: Vec<(prop::sample::Index, u8)>| {
        for (at, with) in edits {
            let at = at.index(bytes.len());
            bytes[at] = with;
        }
        bytes
    };
    let count = entries.len();
    prop_oneof![
        edits().prop_map(move |edits| edit(whole.clone(), edits)),
        (0..count, edits()).prop_map(move |(index, edits)| {
            let mut entries = entries.clone();
            // Most edits in the header, where the lengths are.
            let header = entries[index].1.len().min(90);
            let tail = entries[index].1.split_off(header);
            entries[index].1 = edit(entries[index].1.clone(), edits);
            entries[index].1.extend(tail);
            npz(&entries)
        }),
        any::<prop::sample::Index>().prop_map({
            let whole = npz(&markers(2, |_| 0.0));
            move |end| whole[..end.index(whole.len())].to_vec()
        }),
    ]
}

proptest! {
    #[test]
    fn arbitrary_bytes_are_answered(bytes in proptest::collection::vec(any::<u8>(), 0..2000)) {
        prop_assert!(smpl_bytes(&bytes).is_err());
        prop_assert!(nodes_bytes(&bytes).is_err());
    }

    #[test]
    fn mutated_smpl_files_are_an_error_or_a_valid_clip(bytes in mutated(smpl_h(&vec![smpl_pose(0.3, 16, Vector3::x()); 3]))) {
        if let Ok(clip) = smpl_bytes(&bytes) {
            prop_assert_eq!(clip.validate(), Ok(()));
        }
    }

    #[test]
    fn mutated_key_node_files_are_an_error_or_a_valid_clip(bytes in mutated(markers(3, |_| 0.2))) {
        if let Ok(clip) = nodes_bytes(&bytes) {
            prop_assert_eq!(clip.validate(), Ok(()));
        }
    }
}
