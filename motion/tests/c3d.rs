//! The C3D reader on files written here as three kinds of processors do, and on broken ones.

use std::path::Path;

use emp_motion::{MotionError, ReadOptions, Reading, Side, c3d};
use nalgebra::{Rotation3, Vector3};
use proptest::prelude::*;

#[derive(Clone, Copy, Debug, PartialEq)]
enum Processor {
    Intel,
    Dec,
    Mips,
}

impl Processor {
    fn integer(self, value: i16) -> [u8; 2] {
        if self == Self::Mips {
            value.to_be_bytes()
        } else {
            value.to_le_bytes()
        }
    }

    fn float(self, value: f32) -> [u8; 4] {
        match self {
            Self::Intel => value.to_le_bytes(),
            Self::Mips => value.to_be_bytes(),
            Self::Dec => {
                let [a, b, c, d] = (value * 4.0).to_le_bytes();
                [c, d, a, b]
            }
        }
    }
}

/// A file to write.
#[derive(Clone)]
struct File {
    processor: Processor,
    /// Metres times this are the file's numbers.
    scale: f64,
    unit: &'static str,
    floats: bool,
    rate: f32,
    labels: Vec<String>,
    /// Frame by frame, metres; `None` where a marker is not seen.
    frames: Vec<Vec<Option<Vector3<f64>>>>,
}

impl File {
    fn parameter(
        &self,
        out: &mut Vec<u8>,
        group: i8,
        name: &str,
        kind: i8,
        dimensions: &[u8],
        data: &[u8],
    ) {
        out.extend([name.len() as u8, group as u8]);
        out.extend(name.as_bytes());
        let body = [
            &[kind as u8, dimensions.len() as u8],
            dimensions,
            data,
            &[0],
        ]
        .concat();
        out.extend(self.processor.integer(2 + body.len() as i16));
        out.extend(body);
    }

    fn bytes(&self) -> Vec<u8> {
        let p = self.processor;
        let count = self.labels.len();
        let mut parameters = vec![
            1,
            0x50,
            0,
            match p {
                Processor::Intel => 84,
                Processor::Dec => 85,
                Processor::Mips => 86,
            },
        ];
        parameters.extend([5, (-1_i8) as u8]);
        parameters.extend(b"POINT");
        parameters.extend(p.integer(3));
        parameters.push(0);
        let width = 24;
        let labels: String = self.labels.iter().map(|l| format!("{l:width$}")).collect();
        self.parameter(&mut parameters, 1, "USED", 2, &[], &p.integer(count as i16));
        self.parameter(
            &mut parameters,
            1,
            "LABELS",
            -1,
            &[width as u8, count as u8],
            labels.as_bytes(),
        );
        self.parameter(
            &mut parameters,
            1,
            "UNITS",
            -1,
            &[self.unit.len() as u8],
            self.unit.as_bytes(),
        );
        self.parameter(&mut parameters, 1, "RATE", 4, &[], &p.float(self.rate));
        parameters.extend([0, 0]);
        parameters.resize(parameters.len().next_multiple_of(512), 0);
        parameters[2] = (parameters.len() / 512) as u8;
        let data_block = 2 + parameters.len() / 512;
        let integer_scale = 0.1_f32;
        let mut header = vec![2, 0x50];
        header.extend(p.integer(count as i16));
        header.extend(p.integer(0));
        header.extend(p.integer(1));
        header.extend(p.integer(self.frames.len() as i16));
        header.extend(p.integer(0));
        header.extend(p.float(if self.floats { -1.0 } else { integer_scale }));
        header.extend(p.integer(data_block as i16));
        header.extend(p.integer(0));
        header.extend(p.float(self.rate));
        header.resize(512, 0);
        let mut data = Vec::new();
        for position in self.frames.iter().flatten() {
            let values = position.unwrap_or_default() * self.scale;
            for value in values.iter() {
                if self.floats {
                    data.extend(p.float(*value as f32));
                } else {
                    data.extend(p.integer((*value as f32 / integer_scale).round() as i16));
                }
            }
            let seen = if position.is_some() { 0.0 } else { -1.0 };
            if self.floats {
                data.extend(p.float(seen));
            } else {
                data.extend(p.integer(seen as i16));
            }
        }
        [header, parameters, data].concat()
    }
}

/// Plug-in-Gait markers of a person who stands at (1, 2) facing x, arms hanging, forearms bent forward by `bend`, metres, z up.
fn person(bend: f64) -> Vec<(&'static str, Vector3<f64>)> {
    let mut markers = vec![
        ("C7", [-0.06, 0.0, 1.50]),
        ("T10", [-0.08, 0.0, 1.25]),
        ("CLAV", [0.05, 0.0, 1.42]),
        ("STRN", [0.08, 0.0, 1.28]),
    ];
    let (s, c) = bend.sin_cos();
    for (side, names) in [
        (
            1.0,
            [
                "LSHO", "LELB", "LWRA", "LWRB", "LFIN", "LASI", "LPSI", "LKNE", "LANK", "LTOE",
                "LFHD",
            ],
        ),
        (
            -1.0,
            [
                "RSHO", "RELB", "RWRA", "RWRB", "RFIN", "RASI", "RPSI", "RKNE", "RANK", "RTOE",
                "RFHD",
            ],
        ),
    ] {
        // The skin is 4 cm outside of the elbow and 5 cm above the shoulder; thumbs in front.
        let forearm = |along: f64, front: f64| {
            [
                along * s + front * c,
                side * 0.18,
                1.15 - along * c + front * s,
            ]
        };
        let places = [
            [0.0, side * 0.18, 1.48],
            [0.0, side * 0.22, 1.15],
            forearm(0.25, 0.03),
            forearm(0.25, -0.03),
            forearm(0.33, 0.0),
            [0.10, side * 0.12, 1.0],
            [-0.10, side * 0.05, 1.0],
            [0.02, side * 0.12, 0.5],
            [0.0, side * 0.12, 0.08],
            [0.18, side * 0.12, 0.03],
            [0.08, side * 0.07, 1.70],
        ];
        markers.extend(names.into_iter().zip(places));
    }
    markers
        .into_iter()
        .map(|(name, p)| (name, Vector3::from(p) + Vector3::new(1.0, 2.0, 0.0)))
        .collect()
}

fn file() -> File {
    let frames: Vec<_> = (0..20).map(|i| person(0.6 + 0.05 * f64::from(i))).collect();
    File {
        processor: Processor::Intel,
        scale: 1000.0,
        unit: "mm",
        floats: true,
        rate: 100.0,
        labels: frames[0]
            .iter()
            .map(|(name, _)| (*name).to_owned())
            .collect(),
        frames: frames
            .iter()
            .map(|f| f.iter().map(|(_, p)| Some(*p)).collect())
            .collect(),
    }
}

fn read(file: &File) -> Result<Reading, MotionError> {
    read_bytes(&file.bytes())
}

fn read_bytes(bytes: &[u8]) -> Result<Reading, MotionError> {
    c3d::from_bytes(Path::new("a.c3d"), bytes, &ReadOptions::default())
}

/// Arms as they were put, within what skin markers tell.
fn assert_person(reading: &Reading, tolerance: f32, what: &str) {
    assert_eq!(reading.clip.frames.len(), 20, "{what}");
    for (i, frame) in reading.clip.frames.iter().enumerate() {
        let bend = 0.6 + 0.05 * i as f32;
        for side in Side::BOTH {
            let upper = frame.upper_arm(side).angle(&-Vector3::z());
            let fore = frame
                .forearm(side)
                .angle(&Vector3::new(bend.sin(), 0.0, -bend.cos()));
            assert!(
                upper < tolerance && fore < tolerance,
                "{what}, frame {i}: {upper} {fore}"
            );
            let hand = frame.wrist_rotations[side as usize].expect("markers on both sides");
            let thumb = (hand * Vector3::z()).angle(&Vector3::new(bend.cos(), 0.0, bend.sin()));
            assert!(thumb < 0.15, "{what}, frame {i}: thumb {thumb}");
        }
        assert!(frame.shoulder_line().angle(&Vector3::y()) < 0.02, "{what}");
    }
}

#[test]
fn a_person_comes_out_of_every_processor_and_number() {
    for processor in [Processor::Intel, Processor::Dec, Processor::Mips] {
        for floats in [true, false] {
            let reading = read(&File {
                processor,
                floats,
                ..file()
            })
            .expect("valid");
            assert_person(&reading, 0.06, &format!("{processor:?} {floats}"));
            let understood = &reading.understanding;
            assert_eq!((understood.format, understood.fps), ("C3D", 100.0));
            assert_eq!(understood.unit.as_deref(), Some("mm"));
            assert_eq!(understood.up.as_deref(), Some("z"));
            assert_eq!(understood.handedness, Some("right-handed"));
            assert_eq!(understood.warnings, Vec::<String>::new());
            assert_eq!(understood.joints[4].joint, "LELB");
            assert!((understood.height.expect("head and feet") - 1.67).abs() < 0.01);
        }
    }
}

#[test]
fn units_axes_subjects_and_headings_do_not_matter() {
    let plain = file();
    let relabelled = |name: &dyn Fn(&String) -> String| File {
        labels: plain.labels.iter().map(name).collect(),
        ..plain.clone()
    };
    let moved = |turn: Rotation3<f64>| File {
        frames: plain
            .frames
            .iter()
            .map(|f| f.iter().map(|p| p.map(|p| turn * p)).collect())
            .collect(),
        ..plain.clone()
    };
    let half = std::f64::consts::FRAC_PI_2;
    for (what, file) in [
        (
            "metres",
            File {
                scale: 1.0,
                unit: "m",
                ..plain.clone()
            },
        ),
        (
            "a wrong unit",
            File {
                scale: 1.0,
                unit: "mm",
                ..plain.clone()
            },
        ),
        (
            "no unit",
            File {
                scale: 100.0,
                unit: "?",
                ..plain.clone()
            },
        ),
        ("a subject", relabelled(&|label| format!("Anna:{label}"))),
        ("small letters", relabelled(&|label| label.to_lowercase())),
        (
            "y up",
            moved(Rotation3::from_axis_angle(&Vector3::x_axis(), -half)),
        ),
        (
            "turned",
            moved(Rotation3::from_axis_angle(&Vector3::z_axis(), 2.2)),
        ),
    ] {
        assert_person(
            &read(&file).unwrap_or_else(|e| panic!("{what}: {e}")),
            0.06,
            what,
        );
    }
}

#[test]
fn joint_centres_and_other_names_are_read() {
    let mut file = file();
    for (from, to) in [
        ("SHO", "SJC"),
        ("ELB", "EJC"),
        ("WRA", "WJC"),
        ("ASI", "_ASIS"),
        ("PSI", "_PSIS"),
    ] {
        for label in &mut file.labels {
            if label.ends_with(from) {
                *label = label.replace(from, to);
            }
        }
    }
    let reading = read(&file).expect("valid");
    assert_eq!(reading.understanding.joints[6].joint, "LWJC");
    assert!(
        reading.understanding.hands[0].contains("not followed"),
        "{:?}",
        reading.understanding.hands
    );
    let frame = &reading.clip.frames[0];
    assert!(
        frame
            .upper_arm(Side::Left)
            .angle(&Vector3::new(0.0, 0.04, -0.33))
            < 0.01
    );
}

#[test]
fn missing_markers_are_named_and_can_be_mapped() {
    let mut file = file();
    let elbow = file
        .labels
        .iter()
        .position(|l| l == "LELB")
        .expect("an elbow");
    file.labels[elbow] = "Ellbogen".to_owned();
    let error = read(&file).expect_err("no elbow").to_string();
    assert!(
        error.contains("left elbow (LELB or LELBOW") && error.contains("Ellbogen"),
        "{error}"
    );
    let mut options = ReadOptions::default();
    options
        .map
        .push(("left_elbow".parse().expect("a node"), "Ellbogen".to_owned()));
    let mapped = c3d::from_bytes(Path::new("a.c3d"), &file.bytes(), &options).expect("mapped");
    assert_eq!(mapped.understanding.joints[4].joint, "Ellbogen");
    options.map[0].1 = "Knie".to_owned();
    let error = c3d::from_bytes(Path::new("a.c3d"), &file.bytes(), &options)
        .expect_err("none")
        .to_string();
    assert!(error.contains("no marker is called \"Knie\""), "{error}");
}

#[test]
fn gaps_are_bridged_and_ends_without_markers_left_out() {
    let mut file = file();
    let at = |name: &str| {
        file.labels
            .iter()
            .position(|l| l == name)
            .expect("a marker")
    };
    let (wrist, toe, shoulder) = (at("LWRA"), at("LTOE"), at("RSHO"));
    file.frames[8][wrist] = None;
    file.frames[9][wrist] = None;
    let reading = read(&file).expect("valid");
    assert_person(&reading, 0.06, "a short gap");
    assert_eq!(reading.understanding.warnings, Vec::<String>::new());
    for frame in &mut file.frames[..3] {
        frame[shoulder] = None;
        frame[toe] = None;
    }
    let reading = read(&file).expect("valid");
    assert_eq!(reading.clip.frames.len(), 17);
    assert!(reading.understanding.warnings[0].contains("frames 3 to 19 of 20"));
    for frame in &mut file.frames {
        frame[shoulder] = None;
    }
    assert!(
        read(&file)
            .expect_err("no shoulder")
            .to_string()
            .contains("right shoulder")
    );
}

#[test]
fn broken_files_are_refused_by_what_is_wrong() {
    let good = file().bytes();
    let cut = read_bytes(&good[..good.len() - 700]).expect("fewer frames");
    assert!(cut.clip.frames.len() < 20);
    assert!(cut.understanding.warnings[0].contains("announces 20 frames"));
    let with = |at: usize, byte: u8| {
        let mut bytes = good.clone();
        bytes[at] = byte;
        read_bytes(&bytes).expect_err("broken").to_string()
    };
    assert!(with(1, 0).contains("does not begin as a C3D file"));
    assert!(with(0, 0).contains("no parameter block"));
    assert!(with(0, 200).contains("ends in its header"));
    assert!(with(515, 1).contains("processor type 1 is unknown"));
    assert!(with(3, 0x7f).contains("points; expected at most"));
    assert!(with(16, 0xff).contains("no frames"));
    for end in 0..1024 {
        assert!(read_bytes(&good[..end]).is_err(), "cut at {end}");
    }
}

proptest! {
    #[test]
    fn arbitrary_bytes_are_answered(mut bytes in proptest::collection::vec(any::<u8>(), 0..3000), processor in 84_u8..87) {
        prop_assert!(read_bytes(&bytes).is_err());
        if bytes.len() > 600 {
            (bytes[0], bytes[1], bytes[515]) = (2, 0x50, processor);
            prop_assert!(read_bytes(&bytes).is_err());
        }
    }

    #[test]
    fn mutations_of_a_valid_file_are_an_error_or_a_valid_clip(
        edits in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..8),
        header in any::<bool>(),
    ) {
        let mut bytes = file().bytes();
        for (at, with) in edits {
            let length = if header { 1200 } else { bytes.len() };
            let at = at.index(length);
            bytes[at] = with;
        }
        if let Ok(reading) = read_bytes(&bytes) {
            prop_assert_eq!(reading.clip.validate(), Ok(()));
        }
    }
}
