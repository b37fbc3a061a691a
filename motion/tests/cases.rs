//! Small files that real tools write and that a reader may take for something else, one kind each: `tests/cases` was made by
//! hand on one motion, of which `00_good.bvh` is the plain form. Further files of each kind are generated here.

mod common;

use std::path::{Path, PathBuf};

use emp_motion::{BodyJoint, Clip, KeyNode, MotionError, ReadOptions, Reading, Side, UpAxis, bvh};
use nalgebra::{Rotation3, Vector3};

fn file(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("tests/cases")
        .join(name)
}

fn read(name: &str) -> Reading {
    read_with(name, &ReadOptions::default()).unwrap_or_else(|e| panic!("{e}"))
}

fn read_with(name: &str, options: &ReadOptions) -> Result<Reading, MotionError> {
    emp_motion::read(&file(name), options)
}

fn text(name: &str) -> String {
    std::fs::read_to_string(file(name)).expect("a fixture")
}

fn parse(text: &str) -> Result<Reading, MotionError> {
    bvh::from_bytes(
        Path::new("variant.bvh"),
        text.as_bytes(),
        &ReadOptions::default(),
    )
}

fn good() -> Clip {
    read("00_good.bvh").clip
}

/// The same arms, shoulder line and hands in every frame; trunks may differ in length.
fn assert_same(found: &Clip, expected: &Clip, what: &str) {
    assert_eq!(found.frames.len(), expected.frames.len(), "{what}");
    for (i, (a, b)) in found.frames.iter().zip(&expected.frames).enumerate() {
        let mut apart = a.shoulder_line().angle(&b.shoulder_line());
        for side in Side::BOTH {
            apart = apart.max(a.upper_arm(side).angle(&b.upper_arm(side)));
            apart = apart.max(a.forearm(side).angle(&b.forearm(side)));
            match (
                a.wrist_rotations[side as usize],
                b.wrist_rotations[side as usize],
            ) {
                (Some(a), Some(b)) => apart = apart.max(a.angle_to(&b)),
                (None, None) => {}
                (a, b) => panic!("{what}, frame {i}: hands {a:?} and {b:?}"),
            }
        }
        assert!(
            apart < 0.02,
            "{what}, frame {i}: {:.1}° off",
            apart.to_degrees()
        );
    }
}

fn warned(reading: &Reading, part: &str) {
    let warnings = &reading.understanding.warnings;
    assert!(
        warnings.iter().any(|w| w.contains(part)),
        "{part:?} in {warnings:?}"
    );
}

#[test]
fn the_plain_form_is_understood_without_a_warning() {
    let reading = read("00_good.bvh");
    let understood = &reading.understanding;
    assert_eq!(understood.warnings, Vec::<String>::new());
    assert_eq!(
        (understood.format, understood.naming.as_str()),
        ("BVH", "MotionBuilder")
    );
    assert_eq!((understood.frames, understood.fps.round()), (4, 10.0));
    assert_eq!(understood.unit.as_deref(), Some("cm"));
    assert_eq!(understood.up.as_deref(), Some("y"));
    assert_eq!(understood.handedness, Some("right-handed"));
    let joints: Vec<&str> = understood.joints.iter().map(|j| j.joint.as_str()).collect();
    assert_eq!(
        joints,
        [
            "Hips",
            "Spine1",
            "LeftArm",
            "RightArm",
            "LeftForeArm",
            "RightForeArm",
            "LeftHand",
            "RightHand"
        ]
    );
    assert!((1.4..1.8).contains(&understood.height.expect("legs and a head")));
    assert_eq!(
        understood.hands,
        ["followed by the T pose", "followed by the T pose"]
    );
    assert!(
        understood.summary().lines().count() == 2,
        "{}",
        understood.summary()
    );
}

#[test]
fn files_that_come_out_as_the_plain_form() {
    for (name, word) in [
        ("01_up_minus_y.bvh", None),
        ("03_static_root_silent.bvh", None),
        ("04_mirrored.bvh", Some("mirror image")),
        ("05_names_shoulder_forearm.bvh", None),
        ("05_names_uarm_farm.bvh", None),
        ("05_names_upperarm01.bvh", None),
        ("05_prefix_not_shared_by_root.bvh", None),
        ("05_suffix.bvh", None),
        ("06_positions_are_deltas.bvh", None),
        ("07_comment.bvh", None),
        ("07_cr_only.bvh", None),
        ("07_end_site_named.bvh", None),
        ("07_no_space_after_colon.bvh", None),
        (
            "07_one_frame_fewer.bvh",
            Some("announces 5 frames and has 4"),
        ),
        (
            "07_one_frame_more_than_announced.bvh",
            Some("announces 3 frames and has 4"),
        ),
        ("07_root_without_channels.bvh", None),
        ("07_space_before_colon.bvh", None),
        ("07_trailing_ctrl_z.bvh", None),
        ("07_two_roots.bvh", Some("2 roots: Hips is read")),
        ("07_utf16.bvh", None),
        ("08_torso_at_waist.bvh", None),
        ("10_smpl_y_up.npz", None),
        ("11_global_orient.npz", None),
        ("11_pose_body_21x3.npz", None),
        ("11_rate_called_fps.npz", None),
    ] {
        let reading = read(name);
        let expected = if name.ends_with(".npz") {
            read("11_rate_called_fps.npz").clip
        } else {
            good()
        };
        assert_same(&reading.clip, &expected, name);
        let warnings = &reading.understanding.warnings;
        match word {
            Some(word) => warned(&reading, word),
            None => assert_eq!(warnings, &Vec::<String>::new(), "{name}"),
        }
        assert!((reading.clip.fps - expected.fps).abs() < 1e-6, "{name}");
    }
}

#[test]
fn smpl_files_are_the_plain_form_within_their_bodys_rest_offsets() {
    // SMPL's arms are not quite straight at rest.
    let (smpl, good) = (read("11_rate_called_fps.npz").clip, good());
    for (a, b) in smpl.frames.iter().zip(&good.frames) {
        for side in Side::BOTH {
            assert!(a.upper_arm(side).angle(&b.upper_arm(side)) < 0.2);
            assert!(a.forearm(side).angle(&b.forearm(side)) < 0.2);
        }
    }
}

#[test]
fn a_bent_trunk_keeps_its_up_axis() {
    let reading = read("02_trunk_bent_60.bvh");
    assert_eq!(reading.understanding.up.as_deref(), Some("y"));
    assert_eq!(reading.understanding.warnings, Vec::<String>::new());
    let bend = Rotation3::from_axis_angle(&Vector3::y_axis(), 60_f32.to_radians());
    for (bent, straight) in reading.clip.frames.iter().zip(&good().frames) {
        for side in Side::BOTH {
            assert!((bent.upper_arm(side) - bend * straight.upper_arm(side)).norm() < 0.02);
        }
    }
}

#[test]
fn crawling_and_push_ups_keep_their_up_axis() {
    // The whole body lies along z, face down, at some height over a floor at zero.
    for (height, lean) in [
        (37.0, 80.0),
        (30.0, 80.0),
        (45.0, 90.0),
        (95.0, 90.0),
        (50.0, 70.0),
        (30.0, 100.0),
    ] {
        let lying = replaced_root(&text("00_good.bvh"), [0.0, height, 50.0], [0.0, 0.0, lean]);
        let reading = parse(&lying).expect("valid");
        assert_eq!(
            reading.understanding.up.as_deref(),
            Some("y"),
            "{height} {lean}"
        );
        let bend = Rotation3::from_axis_angle(&Vector3::y_axis(), (lean as f32).to_radians());
        for (bent, straight) in reading.clip.frames.iter().zip(&good().frames) {
            assert!(
                (bent.upper_arm(Side::Left) - bend * straight.upper_arm(Side::Left)).norm() < 0.02
            );
        }
    }
}

#[test]
fn every_axis_may_point_up() {
    // The root's rotation turns the body's y to the axis; a standing person, feet on a floor at zero.
    for (up, place, zyx) in [
        ("y", [30.0, 95.0, 40.0], [0.0, 0.0, 0.0]),
        ("z", [30.0, 40.0, 95.0], [0.0, 0.0, 90.0]),
        ("x", [95.0, 30.0, 40.0], [-90.0, 0.0, 0.0]),
        ("-y", [30.0, -95.0, 40.0], [180.0, 0.0, 0.0]),
        ("-z", [30.0, 40.0, -95.0], [0.0, 0.0, -90.0]),
        ("-x", [-95.0, 30.0, 40.0], [90.0, 0.0, 0.0]),
    ] {
        let reading = parse(&replaced_root(&text("00_good.bvh"), place, zyx)).expect("valid");
        assert_eq!(reading.understanding.up.as_deref(), Some(up));
        assert_same(&reading.clip, &good(), up);
    }
}

/// Every frame's root at this place with these angles (Z, Y, X).
fn replaced_root(text: &str, place: [f64; 3], zyx: [f64; 3]) -> String {
    let (head, frames) = text.split_at(text.find("Frame Time").expect("motion"));
    let (time, frames) = frames.split_once('\n').expect("lines");
    let numbers = place
        .iter()
        .chain(&zyx)
        .map(f64::to_string)
        .collect::<Vec<_>>()
        .join(" ");
    let frames = frames.lines().map(|line| {
        let rest: Vec<&str> = line.split_ascii_whitespace().skip(6).collect();
        format!("{numbers} {}\n", rest.join(" "))
    });
    format!("{head}{time}\n{}", frames.collect::<String>())
}

#[test]
fn a_mirror_image_can_be_left_or_forced() {
    let forced = |mirror| ReadOptions {
        mirror: Some(mirror),
        ..ReadOptions::default()
    };
    let left = read_with("04_mirrored.bvh", &forced(false)).expect("valid");
    let frames = left.clip.frames.iter().zip(good().frames);
    let off = frames.map(|(a, b)| a.forearm(Side::Right).angle(&b.forearm(Side::Right)));
    let off = off.fold(0.0, f32::max);
    assert!(off > 0.5, "{off}");
    let mended = read_with("04_mirrored.bvh", &forced(true)).expect("valid");
    assert_same(&mended.clip, &good(), "forced");
    assert_eq!(mended.understanding.handedness, Some("mirrored"));
}

#[test]
fn naming_schemes_come_out_as_the_plain_form() {
    let plain = [
        "Hips",
        "Spine1",
        "Spine",
        "Neck",
        "Head",
        "LeftShoulder",
        "LeftArm",
        "LeftForeArm",
        "LeftHand",
        "LeftUpLeg",
        "LeftLeg",
        "LeftFoot",
        "LeftToeBase",
    ];
    let schemes: &[(&str, [&str; 13])] = &[
        (
            "3ds Max Biped",
            [
                "Bip001 Pelvis",
                "Bip001 Spine1",
                "Bip001 Spine",
                "Bip001 Neck",
                "Bip001 Head",
                "Bip001 L Clavicle",
                "Bip001 L UpperArm",
                "Bip001 L Forearm",
                "Bip001 L Hand",
                "Bip001 L Thigh",
                "Bip001 L Calf",
                "Bip001 L Foot",
                "Bip001 L Toe0",
            ],
        ),
        (
            "VRM",
            [
                "J_Bip_C_Hips",
                "J_Bip_C_Chest",
                "J_Bip_C_Spine",
                "J_Bip_C_Neck",
                "J_Bip_C_Head",
                "J_Bip_L_Shoulder",
                "J_Bip_L_UpperArm",
                "J_Bip_L_LowerArm",
                "J_Bip_L_Hand",
                "J_Bip_L_UpperLeg",
                "J_Bip_L_LowerLeg",
                "J_Bip_L_Foot",
                "J_Bip_L_ToeBase",
            ],
        ),
        (
            "Character Creator",
            [
                "CC_Base_Hip",
                "CC_Base_Spine02",
                "CC_Base_Waist",
                "CC_Base_NeckTwist01",
                "CC_Base_Head",
                "CC_Base_L_Clavicle",
                "CC_Base_L_Upperarm",
                "CC_Base_L_Forearm",
                "CC_Base_L_Hand",
                "CC_Base_L_Thigh",
                "CC_Base_L_Calf",
                "CC_Base_L_Foot",
                "CC_Base_L_ToeBase",
            ],
        ),
        (
            "Rigify",
            [
                "DEF-spine",
                "DEF-spine.003",
                "DEF-spine.001",
                "DEF-spine.004",
                "DEF-spine.006",
                "DEF-shoulder.L",
                "DEF-upper_arm.L",
                "DEF-forearm.L",
                "DEF-hand.L",
                "DEF-thigh.L",
                "DEF-shin.L",
                "DEF-foot.L",
                "DEF-toe.L",
            ],
        ),
        (
            "Unreal mannequin",
            [
                "pelvis",
                "spine_02",
                "spine_01",
                "neck_01",
                "head",
                "clavicle_l",
                "upperarm_l",
                "lowerarm_l",
                "hand_l",
                "thigh_l",
                "calf_l",
                "foot_l",
                "ball_l",
            ],
        ),
        (
            "DAZ",
            [
                "hip",
                "chestUpper",
                "abdomenLower",
                "neckLower",
                "head",
                "lCollar",
                "lShldrBend",
                "lForearmBend",
                "lHand",
                "lThighBend",
                "lShin",
                "lFoot",
                "lToe",
            ],
        ),
        (
            "Poser",
            [
                "hip", "chest", "abdomen", "neck", "head", "lCollar", "lShldr", "lForeArm",
                "lHand", "lThigh", "lShin", "lFoot", "lToe",
            ],
        ),
        (
            "Acclaim",
            [
                "root",
                "upperback",
                "lowerback",
                "lowerneck",
                "head",
                "lclavicle",
                "lhumerus",
                "lradius",
                "lwrist",
                "lfemur",
                "ltibia",
                "lfoot",
                "ltoes",
            ],
        ),
        (
            "SMPL",
            [
                "Pelvis",
                "Spine3",
                "Spine1",
                "Neck",
                "Head",
                "L_Collar",
                "L_Shoulder",
                "L_Elbow",
                "L_Wrist",
                "L_Hip",
                "L_Knee",
                "L_Ankle",
                "L_Foot",
            ],
        ),
        (
            "Xsens",
            [
                "Hips",
                "Chest4",
                "Chest",
                "Neck",
                "Head",
                "LeftCollar",
                "LeftUpperArm",
                "LeftForeArm",
                "LeftHand",
                "LeftHip",
                "LeftKnee",
                "LeftAnkle",
                "LeftToe",
            ],
        ),
        (
            "Rokoko",
            [
                "Hips",
                "Spine4",
                "Spine",
                "Neck",
                "Head",
                "LeftShoulder",
                "LeftArm",
                "LeftForeArm",
                "LeftHand",
                "LeftThigh",
                "LeftShin",
                "LeftFoot",
                "LeftToe",
            ],
        ),
        (
            "Kinect",
            [
                "SpineBase",
                "SpineShoulder",
                "SpineMid",
                "Neck",
                "Head",
                "ClavicleLeft",
                "ShoulderLeft",
                "ElbowLeft",
                "WristLeft",
                "HipLeft",
                "KneeLeft",
                "AnkleLeft",
                "FootLeft",
            ],
        ),
        (
            "Second Life",
            [
                "mPelvis",
                "mChest",
                "mTorso",
                "mNeck",
                "mHead",
                "mCollarLeft",
                "mShoulderLeft",
                "mElbowLeft",
                "mWristLeft",
                "mHipLeft",
                "mKneeLeft",
                "mAnkleLeft",
                "mFootLeft",
            ],
        ),
        (
            "Source engine",
            [
                "ValveBiped.Bip01_Pelvis",
                "ValveBiped.Bip01_Spine4",
                "ValveBiped.Bip01_Spine",
                "ValveBiped.Bip01_Neck1",
                "ValveBiped.Bip01_Head1",
                "ValveBiped.Bip01_L_Clavicle",
                "ValveBiped.Bip01_L_UpperArm",
                "ValveBiped.Bip01_L_Forearm",
                "ValveBiped.Bip01_L_Hand",
                "ValveBiped.Bip01_L_Thigh",
                "ValveBiped.Bip01_L_Calf",
                "ValveBiped.Bip01_L_Foot",
                "ValveBiped.Bip01_L_Toe0",
            ],
        ),
        (
            "MikuMikuDance",
            [
                "センター",
                "上半身2",
                "上半身",
                "首",
                "頭",
                "左肩",
                "左腕",
                "左ひじ",
                "左手首",
                "左足",
                "左ひざ",
                "左足首",
                "左つま先",
            ],
        ),
        (
            "unknown",
            [
                "Becken",
                "Brust",
                "Bauch",
                "Hals",
                "Kopf",
                "Schluesselbein_L",
                "Oberarm_L",
                "Unterarm_L",
                "Pfote_L",
                "Schenkel_L",
                "Wade_L",
                "Huf_L",
                "Zeh_L",
            ],
        ),
        (
            "unknown",
            [
                "n0", "n1", "n2", "n3", "n4", "n5_left", "n6_left", "n7_left", "n8_left",
                "n9_left", "n10_left", "n11_left", "n12_left",
            ],
        ),
    ];
    for (scheme, names) in schemes {
        let mut text = text("00_good.bvh");
        for (from, to) in plain.iter().zip(names) {
            for (from, to) in [
                ((*from).to_owned(), (*to).to_owned()),
                (other_side(from), other_side(to)),
            ] {
                for keyword in ["JOINT", "ROOT"] {
                    text =
                        text.replace(&format!("{keyword} {from}\n"), &format!("{keyword} {to}\n"));
                }
            }
        }
        let reading = parse(&text).unwrap_or_else(|e| panic!("{scheme}: {e}"));
        assert_same(&reading.clip, &good(), &format!("{scheme}, {}", names[6]));
        assert_eq!(reading.understanding.naming, *scheme, "{}", names[6]);
        assert_eq!(reading.understanding.joints[0].joint, names[0], "{scheme}");
    }
}

fn other_side(name: &str) -> String {
    let mut name = name
        .replace("Left", "Right")
        .replace("left", "right")
        .replace('左', "右");
    for (l, r) in [
        ("_L_", "_R_"),
        (" L ", " R "),
        ("_l", "_r"),
        (".L", ".R"),
        ("_L", "_R"),
    ] {
        name = name.replace(l, r);
    }
    let lowered = [
        "lCollar", "lShldr", "lFore", "lHand", "lThigh", "lShin", "lFoot", "lToe", "lclav", "lhum",
        "lrad", "lwri", "lfem", "ltib", "lfoot", "ltoes", "L_",
    ];
    if lowered.iter().any(|start| name.starts_with(start)) {
        let swapped = if name.starts_with('l') { "r" } else { "R" };
        name.replace_range(0..1, swapped);
    }
    name
}

#[test]
fn prefixes_and_suffixes_do_not_matter() {
    for (prefix, suffix) in [
        ("mixamorig:", ""),
        ("mixamorig_", ""),
        ("mixamorig1:", ""),
        ("Armature|", ""),
        ("Character1_", ""),
        ("rp_nathan:", ""),
        ("", "_JNT"),
        ("", "_bind"),
        ("", ".001"),
        ("", "_jt"),
        ("skel_", "_bone"),
        ("b_", ""),
        ("Actor1:", "_Joint"),
    ] {
        let mut text = text("00_good.bvh");
        for keyword in ["JOINT ", "ROOT "] {
            text = text
                .lines()
                .map(|line| match line.split_once(keyword) {
                    Some((indent, name)) => format!("{indent}{keyword}{prefix}{name}{suffix}\n"),
                    None => format!("{line}\n"),
                })
                .collect();
        }
        let reading = parse(&text).unwrap_or_else(|e| panic!("{prefix}…{suffix}: {e}"));
        assert_same(&reading.clip, &good(), &format!("{prefix}…{suffix}"));
        assert!(!reading.understanding.joints[2].joint.contains("Shoulder"));
    }
}

#[test]
fn names_that_tell_nothing_are_answered_by_the_trees_structure() {
    let mut number = 0;
    let text: String = text("00_good.bvh")
        .lines()
        .map(|line| match line.split_once("JOINT ") {
            Some((indent, _)) => {
                number += 1;
                format!("{indent}JOINT q{number}\n")
            }
            None => format!("{line}\n"),
        })
        .collect();
    let reading = parse(&text.replace("ROOT Hips", "ROOT q0")).expect("valid");
    assert_same(&reading.clip, &good(), "numbers");
    warned(&reading, "structure");
}

#[test]
fn a_map_stands_above_names_and_structure() {
    let text = text("00_good.bvh")
        .replace("LeftForeArm", "Flipper")
        .replace("LeftArm", "Fin");
    let map = |entries: &[(&str, &str)]| ReadOptions {
        map: entries
            .iter()
            .map(|(joint, name)| {
                (
                    joint.parse::<BodyJoint>().expect("a joint"),
                    (*name).to_owned(),
                )
            })
            .collect(),
        ..ReadOptions::default()
    };
    let options = map(&[("left_shoulder", "Fin"), ("left_elbow", "Flipper")]);
    let mapped = bvh::from_bytes(Path::new("a.bvh"), text.as_bytes(), &options).expect("valid");
    assert_same(&mapped.clip, &good(), "mapped");
    assert_eq!(mapped.understanding.joints[4].joint, "Flipper");
    let error = bvh::from_bytes(
        Path::new("a.bvh"),
        text.as_bytes(),
        &map(&[("left_elbow", "Wing")]),
    )
    .expect_err("no such joint")
    .to_string();
    assert!(
        error.contains("Wing") && error.contains("left_elbow") && error.contains("Flipper"),
        "{error}"
    );
    assert!(
        "left_knee"
            .parse::<BodyJoint>()
            .expect_err("no key node")
            .contains("left_hip")
    );
}

#[test]
fn positions_that_add_and_positions_that_replace_may_wander() {
    // A root's child that travels in place of its offset is no delta.
    let text = text("03_static_root_silent.bvh");
    let (head, frames) = text.split_at(text.find("Frame Time").expect("motion"));
    let (time, frames) = frames.split_once('\n').expect("lines");
    let walked: String = frames
        .lines()
        .enumerate()
        .map(|(i, line)| {
            let mut values: Vec<String> =
                line.split_ascii_whitespace().map(str::to_owned).collect();
            let at = values
                .iter()
                .position(|v| v.starts_with("95"))
                .expect("the pelvis's height");
            values[at + 1] = format!("{}", 100 * i);
            values.join(" ") + "\n"
        })
        .collect();
    let reading = parse(&format!("{head}{time}\n{walked}")).expect("valid");
    assert_same(&reading.clip, &good(), "walking");
}

#[test]
fn merged_numbers_are_refused_by_line() {
    let error = read_with("07_merged_numbers.bvh", &ReadOptions::default())
        .expect_err("merged")
        .to_string();
    assert!(
        error.contains("07_merged_numbers.bvh:130: frame 0: expected a finite number"),
        "{error}"
    );
}

#[test]
fn a_rate_can_be_given_and_a_strange_one_is_said() {
    let fps = |fps| ReadOptions {
        fps: Some(fps),
        ..ReadOptions::default()
    };
    assert!((read("09_wrong_frame_time.bvh").clip.fps - 2.0).abs() < 1e-9);
    assert_eq!(
        read_with("09_wrong_frame_time.bvh", &fps(10.0))
            .expect("valid")
            .clip,
        {
            let mut clip = good();
            clip.name = "09_wrong_frame_time".to_owned();
            clip.fps = 10.0;
            clip
        }
    );
    for wrong in [0.0, -1.0, 0.5, 1e9, f64::NAN] {
        let error = read_with("09_wrong_frame_time.bvh", &fps(wrong))
            .expect_err("no rate")
            .to_string();
        assert!(error.contains("not between 1 and 1000"), "{error}");
    }
    let with = |time: &str| {
        text("00_good.bvh").replace("Frame Time: 0.100000", &format!("Frame Time: {time}"))
    };
    for (time, expected, word) in [
        ("33.3333", 30.0, "milliseconds"),
        ("8.333", 120.0, "milliseconds"),
        ("2.0", 1.0, "below 1 Hz"),
        ("5000", 1.0, "below 1 Hz"),
    ] {
        let reading = parse(&with(time)).expect("valid");
        assert!(
            (reading.clip.fps - expected).abs() < 0.01,
            "{time}: {}",
            reading.clip.fps
        );
        warned(&reading, word);
        assert!(reading.clip.resampled(50.0).expect("bounded").frames.len() < 200);
    }
    for time in ["0", "-0.1", "0.0000001", "nan", "x"] {
        let error = parse(&with(time)).expect_err("no rate").to_string();
        assert!(
            error.contains("frame time") || error.contains("Frame Time"),
            "{time}: {error}"
        );
    }
}

#[test]
fn a_missing_rate_is_named_and_can_be_given() {
    let error = read_with("11_rate_missing.npz", &ReadOptions::default())
        .expect_err("no rate")
        .to_string();
    assert!(
        error.contains("no frame rate") && error.contains("--fps"),
        "{error}"
    );
    let options = ReadOptions {
        fps: Some(10.0),
        ..ReadOptions::default()
    };
    let reading = read_with("11_rate_missing.npz", &options).expect("valid");
    assert_same(&reading.clip, &read("11_rate_called_fps.npz").clip, "given");
}

#[test]
fn an_up_axis_can_be_given() {
    let options = ReadOptions {
        up: Some(UpAxis::MinusY),
        ..ReadOptions::default()
    };
    let upside_down = bvh::read(&file("00_good.bvh"), &options).expect("valid");
    assert!(upside_down.clip.frames[0].position(KeyNode::LeftShoulder).z < -0.3);
}

#[test]
fn a_recording_that_was_cut_off_is_read_to_its_end() {
    let text = text("00_good.bvh");
    let frames = text.rfind("\n0.0").expect("frames");
    let cut = parse(&text[..frames + 40]).expect("valid");
    assert_eq!(cut.clip.frames.len(), 3);
    warned(&cut, "cut off");
    warned(&cut, "announces 4 frames and has 3");
    let garbage = parse(&(text.clone() + "\n# a comment\n-- end of take --\n")).expect("valid");
    assert_same(&garbage.clip, &good(), "garbage behind the frames");
    warned(&garbage, "left out");
}

#[test]
fn a_second_person_is_left_out_whatever_its_names() {
    let text = text("00_good.bvh");
    let tree = &text[text.find("ROOT").expect("tree")..text.find("MOTION").expect("motion")];
    let width = text
        .lines()
        .last()
        .expect("values")
        .split_ascii_whitespace()
        .count();
    let doubled: String = text
        .replace("MOTION\n", &format!("{tree}MOTION\n"))
        .lines()
        .map(|line| {
            if line.split_ascii_whitespace().count() == width {
                format!("{line} {line}\n")
            } else {
                format!("{line}\n")
            }
        })
        .collect();
    let reading = parse(&doubled).expect("valid");
    assert_same(&reading.clip, &good(), "two people");
    warned(&reading, "2 roots");
    // A prop that comes first has values first.
    let prop = "ROOT Prop\n{\nOFFSET 0 0 0\nCHANNELS 3 Zrotation Yrotation Xrotation\n}\n";
    let first: String = text
        .replace("ROOT Hips", &format!("{prop}ROOT Hips"))
        .lines()
        .map(|line| {
            if line.split_ascii_whitespace().count() == width {
                format!("1 2 3 {line}\n")
            } else {
                format!("{line}\n")
            }
        })
        .collect();
    assert_same(&parse(&first).expect("valid").clip, &good(), "a prop first");
}

/// The plain skeleton with hanging arms at rest and hands that end at the wrist, as in many games; `set` fills a frame's values.
fn game_skeleton(frames: usize, set: impl Fn(usize, &mut [f64])) -> String {
    let text = text("00_good.bvh");
    let head = &text[..text.find("Frames:").expect("motion")];
    let head = ["28.0000", "25.0000"]
        .iter()
        .fold(head.to_owned(), |head, length| {
            [length.to_string(), format!("-{length}")]
                .iter()
                .fold(head, |head, along| {
                    head.replace(
                        &format!("OFFSET {along} 0.0000 0.0000"),
                        &format!("OFFSET 0.0000 -{length} 0.0000"),
                    )
                })
        });
    let head = head
        .replace("OFFSET 9.0000 0.0000 0.0000", "OFFSET 0 0 0")
        .replace("OFFSET -9.0000 0.0000 0.0000", "OFFSET 0 0 0");
    let width = text
        .lines()
        .last()
        .expect("values")
        .split_ascii_whitespace()
        .count();
    let lines = (0..frames).map(|frame| {
        let mut values = vec![0.0; width];
        values[1] = 95.0;
        set(frame, &mut values);
        values
            .iter()
            .map(f64::to_string)
            .collect::<Vec<_>>()
            .join(" ")
            + "\n"
    });
    format!(
        "{head}Frames: {frames}\nFrame Time: 0.05\n{}",
        lines.collect::<String>()
    )
}

const LEFT_ARM_Z: usize = 21;
const LEFT_FOREARM_X: usize = 26;
const LEFT_HAND_Y: usize = 28;

#[test]
fn hands_of_a_skeleton_without_fingers_are_told_by_the_calmest_frames() {
    // The arm hangs for a while, then the forearm is raised and the hand turned about it.
    let text = game_skeleton(60, |frame, values| {
        let raised = (frame as f64 - 30.0).max(0.0) * 2.0;
        values[LEFT_FOREARM_X] = -raised;
        values[LEFT_HAND_Y] = raised;
    });
    let reading = parse(&text).expect("valid");
    assert!(
        reading.understanding.hands[0].contains("calmest"),
        "{:?}",
        reading.understanding.hands
    );
    let close = |a: Vector3<f32>, b: Vector3<f32>| assert!((a - b).norm() < 0.02, "{a} is not {b}");
    let hand = |frame: usize| reading.clip.frames[frame].wrist_rotations[0].expect("followed");
    close(hand(0) * Vector3::x(), -Vector3::z());
    close(hand(0) * Vector3::z(), Vector3::x());
    // 58° up, and 58° about the forearm, which points forward and down: the thumb turns outward from up and forward.
    let last = reading.clip.frames.last().expect("frames");
    close(hand(59) * Vector3::x(), last.forearm(Side::Left));
    let turned = (hand(59) * Vector3::z()).y.asin();
    assert!(
        (turned.abs() - 58_f32.to_radians()).abs() < 0.05,
        "{turned}"
    );
}

#[test]
fn hands_that_nothing_tells_are_said_not_to_be_followed() {
    // Arms straight up throughout.
    let text = game_skeleton(20, |frame, values| {
        values[LEFT_ARM_Z] = 175.0 + frame as f64 * 0.1;
        values[LEFT_ARM_Z + 12] = -175.0;
    });
    let reading = parse(&text).expect("valid");
    for side in 0..2 {
        assert!(
            reading.understanding.hands[side].starts_with("not followed: "),
            "{:?}",
            reading.understanding.hands
        );
        assert!(
            reading
                .clip
                .frames
                .iter()
                .all(|f| f.wrist_rotations[side].is_none())
        );
    }
    assert!(reading.understanding.summary().contains("not followed"));
}
