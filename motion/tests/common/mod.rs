//! Fixtures that several tests build their files from.
#![allow(dead_code, reason = "each test binary uses its own part")]

use std::io::{Cursor, Write};

use nalgebra::{Rotation3, Vector3};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

/// Joint names of one naming scheme, left side: hip, collar, shoulder, elbow, wrist.
pub(crate) struct Names {
    pub(crate) waist: &'static str,
    pub(crate) chest: &'static str,
    pub(crate) left: [&'static str; 5],
    pub(crate) right: [&'static str; 5],
}

pub(crate) const CMU: Names = Names {
    waist: "Hips",
    chest: "Spine1",
    left: [
        "LeftUpLeg",
        "LeftShoulder",
        "LeftArm",
        "LeftForeArm",
        "LeftHand",
    ],
    right: [
        "RightUpLeg",
        "RightShoulder",
        "RightArm",
        "RightForeArm",
        "RightHand",
    ],
};

/// Channels of the fixture: root 6, then chest and four joints an arm with `rotations`; the hips have none.
pub(crate) const ORDER: &str = "Zrotation Yrotation Xrotation";

/// Offsets of a T pose in metres, y up, facing z: chest, hip, collar, arm, forearm, hand.
const CHEST: [f64; 3] = [0.0, 0.30, 0.0];
const HIP: [f64; 3] = [0.1, -0.1, 0.0];
const COLLAR: [f64; 3] = [0.0, 0.12, 0.0];
const ARM: [f64; 3] = [0.18, 0.0, 0.0];
const FOREARM: [f64; 3] = [0.28, 0.0, 0.0];
const HAND: [f64; 3] = [0.25, 0.0, 0.0];
const FINGERS: [f64; 3] = [0.08, 0.0, 0.0];

fn offset(indent: &str, v: [f64; 3], side: f64, scale: f64) -> String {
    format!(
        "{indent}OFFSET {:.6} {:.6} {:.6}\n",
        v[0] * side * scale,
        v[1] * scale,
        v[2] * scale
    )
}

fn arm(names: &[&str; 5], side: f64, scale: f64, order: &str) -> String {
    let mut text = String::new();
    for (name, v) in names[1..].iter().zip([COLLAR, ARM, FOREARM, HAND]) {
        text += &format!(
            "JOINT {name}\n{{\n{}CHANNELS 3 {order}\n",
            offset("", v, side, scale)
        );
    }
    text + &format!(
        "End Site\n{{\n{}}}\n}}\n}}\n}}\n}}\n",
        offset("", FINGERS, side, scale)
    )
}

fn hip(name: &str, side: f64, scale: f64) -> String {
    format!(
        "JOINT {name}\n{{\n{}CHANNELS 0\nEnd Site\n{{\nOFFSET 0 -1 0\n}}\n}}\n",
        offset("", HIP, side, scale)
    )
}

/// A T-pose skeleton, `scale` units a metre.
pub(crate) fn hierarchy(names: &Names, scale: f64, order: &str) -> String {
    format!(
        "HIERARCHY\nROOT {}\n{{\nOFFSET 0 0 0\nCHANNELS 6 Xposition Yposition Zposition {order}\n{}{}JOINT {}\n{{\n{}CHANNELS 3 {order}\n{}{}}}\n}}\n",
        names.waist,
        hip(names.left[0], 1.0, scale),
        hip(names.right[0], -1.0, scale),
        names.chest,
        offset("", CHEST, 1.0, scale),
        arm(&names.left, 1.0, scale, order),
        arm(&names.right, -1.0, scale, order),
    )
}

/// Values a frame of [`hierarchy`]: root 6, chest 3, left collar, arm, forearm, hand, right the same.
pub(crate) const WIDTH: usize = 33;
/// Where the values of the chest, the left arm and the left hand begin.
pub(crate) const CHEST_AT: usize = 6;
pub(crate) const LEFT_ARM_AT: usize = 12;
pub(crate) const LEFT_HAND_AT: usize = 18;

pub(crate) fn motion(frames: &[[f64; WIDTH]], seconds: f64) -> String {
    let mut text = format!("MOTION\nFrames: {}\nFrame Time: {seconds}\n", frames.len());
    for frame in frames {
        text += &frame
            .iter()
            .map(|v| format!("{v:.6}"))
            .collect::<Vec<_>>()
            .join(" ");
        text.push('\n');
    }
    text
}

/// Three frames of the T pose in centimetres with CMU's names.
pub(crate) fn t_pose() -> String {
    hierarchy(&CMU, 100.0, ORDER) + &motion(&[[0.0; WIDTH]; 3], 0.02)
}

/// An array of version 1, data as given.
pub(crate) fn npy(descr: &str, shape: &str, data: &[u8]) -> Vec<u8> {
    let header = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n");
    let length = u16::try_from(header.len())
        .expect("short header")
        .to_le_bytes();
    [
        b"\x93NUMPY\x01\x00",
        length.as_slice(),
        header.as_bytes(),
        data,
    ]
    .concat()
}

pub(crate) fn f4(shape: &str, values: impl IntoIterator<Item = f64>) -> Vec<u8> {
    npy(
        "<f4",
        shape,
        &values
            .into_iter()
            .flat_map(|v| (v as f32).to_le_bytes())
            .collect::<Vec<_>>(),
    )
}

pub(crate) fn f8(shape: &str, values: impl IntoIterator<Item = f64>) -> Vec<u8> {
    npy(
        "<f8",
        shape,
        &values
            .into_iter()
            .flat_map(f64::to_le_bytes)
            .collect::<Vec<_>>(),
    )
}

/// Strings as numpy stores them, four bytes a character.
pub(crate) fn unicode(values: &[&str]) -> Vec<u8> {
    let padded = values
        .iter()
        .flat_map(|v| v.chars().chain(std::iter::repeat('\0')).take(16));
    npy(
        "<U16",
        &format!("({},)", values.len()),
        &padded
            .flat_map(|c| u32::from(c).to_le_bytes())
            .collect::<Vec<_>>(),
    )
}

pub(crate) fn npz(entries: &[(&str, Vec<u8>)]) -> Vec<u8> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default().compression_method(CompressionMethod::Deflated);
    for (name, bytes) in entries {
        zip.start_file(format!("{name}.npy"), options)
            .expect("in memory");
        zip.write_all(bytes).expect("in memory");
    }
    zip.finish().expect("in memory").into_inner()
}

/// Marker nodes of a seated person with the arms hanging forward, x forward, y left, z up, metres.
pub(crate) const MARKERS: [(&str, [f64; 3]); 8] = [
    ("sternum", [0.03, 0.0, 0.02]),
    ("clav_mid", [-0.03, 0.0, 0.04]),
    ("L_shoulder", [0.0, 0.2, 0.0]),
    ("L_elbow", [0.0, 0.22, -0.28]),
    ("L_wrist", [0.25, 0.22, -0.28]),
    ("R_shoulder", [0.0, -0.2, 0.0]),
    ("R_elbow", [0.0, -0.22, -0.28]),
    ("R_wrist", [0.25, -0.22, -0.28]),
];

/// A marker file of `frames` frames turned about the vertical by `yaw(frame)`, hands along the world's axes.
pub(crate) fn markers(frames: usize, yaw: impl Fn(usize) -> f64) -> Vec<(&'static str, Vec<u8>)> {
    let turned = |frame: usize, p: [f64; 3]| {
        Rotation3::from_axis_angle(&Vector3::z_axis(), yaw(frame)) * Vector3::from(p)
    };
    let positions = (0..frames)
        .flat_map(|f| MARKERS.map(|(_, p)| turned(f, p)))
        .flat_map(|p| [p.x, p.y, p.z]);
    let hands =
        std::iter::repeat_n([1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], 2 * frames).flatten();
    vec![
        ("fps", f8("()", [100.0])),
        ("nodes", unicode(&MARKERS.map(|(name, _)| name))),
        ("pos", f4(&format!("({frames}, 8, 3)"), positions)),
        ("wrist_R", f4(&format!("({frames}, 2, 3, 3)"), hands)),
    ]
}
