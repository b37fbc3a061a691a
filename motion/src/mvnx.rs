//! Xsens MVN's `.mvnx`: XML with every body segment's position and orientation in the world, frame by frame.
//!
//! Segments' axes are those of a T pose facing x with z up, metres; a segment begins at its near joint. A file of several
//! people gives the first.

use std::path::Path;

use nalgebra::{Matrix3, Quaternion, Rotation3, UnitQuaternion, Vector3};
use quick_xml::events::{BytesStart, Event};
use quick_xml::{Reader, XmlVersion};

use crate::hands::HandAxes;
use crate::orientation::{Leg, Probe, bounds};
use crate::source::{self, Heading, MAX_FRAMES, Rate, Take, node_joint, unknown_mapped};
use crate::understanding::Reading;
use crate::world_frame::WorldFrame;
use crate::{BodyJoint, KEY_NODES, KeyNode, MotionError, ReadOptions, Side, UpAxis, text};

/// No body has more segments.
const MAX_SEGMENTS: usize = 128;
/// The segment of each key node.
const SEGMENTS: [&str; KEY_NODES] = [
    "Pelvis",
    "T8",
    "LeftUpperArm",
    "RightUpperArm",
    "LeftForeArm",
    "RightForeArm",
    "LeftHand",
    "RightHand",
];
/// Thigh, shin, foot and toes of each side.
const LEGS: [[&str; 4]; 2] = [
    ["LeftUpperLeg", "LeftLowerLeg", "LeftFoot", "LeftToe"],
    ["RightUpperLeg", "RightLowerLeg", "RightFoot", "RightToe"],
];

/// Reads an MVNX file.
///
/// # Errors
/// [`MotionError`] with what is wrong with the XML, the segment that is missing, or the frame.
pub fn read(path: &Path, options: &ReadOptions) -> Result<Reading, MotionError> {
    from_bytes(path, &source::read_file(path)?, options)
}

/// Reads an MVNX file's content; `path` names the clip and the errors.
///
/// # Errors
/// As [`read`].
pub fn from_bytes(
    path: &Path,
    bytes: &[u8],
    options: &ReadOptions,
) -> Result<Reading, MotionError> {
    let document = Document::parse(path, &text::decode(bytes))?;
    let mut warnings = document.warnings.clone();
    let rate = match (options.fps, document.fps) {
        (Some(fps), _) => Rate::given(fps),
        (None, Some(fps)) => Rate::found(fps),
        (None, None) => Err("the subject has no frameRate; --fps gives it".to_owned()),
    };
    let rate = rate.map_err(|reason| MotionError::format(path, reason))?;
    warnings.extend(rate.warning);
    let body = Body::find(path, &document.segments, options)?;
    let frames = document.frames.len();
    source::check_size(path, rate.fps, frames)?;
    let joints = KeyNode::ALL
        .into_iter()
        .map(|node| node_joint(node, document.segments[body.nodes[node as usize]].as_str()))
        .collect();
    let take = Take {
        format: "MVNX",
        naming: "Xsens".to_owned(),
        fps: rate.fps,
        frames: document
            .frames
            .iter()
            .map(|frame| body.frame(frame))
            .collect(),
        probes: source::probed(frames)
            .map(|i| body.probe(&document.frames[i]))
            .collect(),
        rest: None,
        heading: Heading::Steady,
        joints,
        unit: Some(1.0),
        up: Some(UpAxis::Z),
        hands: Side::BOTH.map(|side| HandAxes::Fixed(hand_at_rest(side))),
        thumbs: None,
        warnings,
    };
    source::finish(path, take, options)
}

/// The hand in its segment's axes: the T pose's fingers point outward, its thumbs forward, its palms down.
fn hand_at_rest(side: Side) -> Rotation3<f64> {
    let out = if side == Side::Left { 1.0 } else { -1.0 };
    Rotation3::from_matrix_unchecked(Matrix3::new(
        0.0, 0.0, 1.0, //
        out, 0.0, 0.0, //
        0.0, out, 0.0,
    ))
}

/// Positions (3 a segment) and orientations (4 a segment, real part first) of one frame.
#[derive(Default)]
struct Frame {
    positions: Vec<f64>,
    orientations: Vec<f64>,
}

impl Frame {
    fn position(&self, segment: usize) -> Vector3<f64> {
        Vector3::from_row_slice(&self.positions[3 * segment..3 * segment + 3])
    }

    fn orientation(&self, segment: usize) -> Option<Rotation3<f64>> {
        let q = &self.orientations[4 * segment..4 * segment + 4];
        let quaternion = Quaternion::new(q[0], q[1], q[2], q[3]);
        UnitQuaternion::try_new(quaternion, 0.1).map(UnitQuaternion::to_rotation_matrix)
    }
}

/// What a file says of its first person.
struct Document {
    fps: Option<f64>,
    segments: Vec<String>,
    frames: Vec<Frame>,
    warnings: Vec<String>,
}

/// Whose text is being read.
#[derive(Clone, Copy, PartialEq)]
enum Numbers {
    Positions,
    Orientations,
}

impl Document {
    fn parse(path: &Path, text: &str) -> Result<Self, MotionError> {
        let mut reader = Reader::from_str(text);
        reader.config_mut().check_end_names = false;
        let line = |reader: &Reader<&[u8]>| {
            let at = usize::try_from(reader.buffer_position()).unwrap_or(usize::MAX);
            1 + text.bytes().take(at).filter(|byte| *byte == b'\n').count()
        };
        let mut document = Self {
            fps: None,
            segments: Vec::new(),
            frames: Vec::new(),
            warnings: Vec::new(),
        };
        let mut people = 0;
        let mut frame: Option<Frame> = None;
        let mut numbers: Option<Numbers> = None;
        loop {
            let event = reader.read_event();
            let event = event
                .map_err(|e| MotionError::line(path, line(&reader), format!("no XML: {e}")))?;
            match event {
                Event::Eof => break,
                Event::Start(tag) | Event::Empty(tag) if tag.local_name().as_ref() == "subject" => {
                    people += 1;
                    if people == 1 {
                        document.fps =
                            attribute(&tag, "frameRate").and_then(|rate| rate.parse().ok());
                    }
                }
                _ if people != 1 => {}
                Event::Start(tag) | Event::Empty(tag) => match tag.local_name().as_ref() {
                    "segment" => {
                        if document.segments.len() == MAX_SEGMENTS {
                            return Err(MotionError::line(
                                path,
                                line(&reader),
                                format!("more than {MAX_SEGMENTS} segments"),
                            ));
                        }
                        document
                            .segments
                            .push(attribute(&tag, "label").unwrap_or_default());
                    }
                    "frame" => {
                        let kind = attribute(&tag, "type").unwrap_or_else(|| "normal".to_owned());
                        frame = (kind == "normal").then(Frame::default);
                    }
                    "position" => numbers = Some(Numbers::Positions),
                    "orientation" => numbers = Some(Numbers::Orientations),
                    _ => {}
                },
                Event::Text(content) => {
                    if let (Some(frame), Some(numbers)) = (&mut frame, numbers) {
                        let found = parse_numbers(&content).map_err(|word| {
                            let index = document.frames.len();
                            let reason =
                                format!("frame {index}: expected a finite number, found {word:?}");
                            MotionError::line(path, line(&reader), reason)
                        })?;
                        match numbers {
                            Numbers::Positions => frame.positions = found,
                            Numbers::Orientations => frame.orientations = found,
                        }
                    }
                }
                Event::End(tag) => match tag.local_name().as_ref() {
                    "position" | "orientation" => numbers = None,
                    "frame" => {
                        if let Some(frame) = frame.take() {
                            document
                                .push(frame)
                                .map_err(|reason| MotionError::line(path, line(&reader), reason))?;
                        }
                    }
                    _ => {}
                },
                _ => {}
            }
        }
        if people == 0 {
            return Err(MotionError::format(
                path,
                "expected an MVNX file's <subject>, found none",
            ));
        }
        if people > 1 {
            document
                .warnings
                .push(format!("{people} people: the first is read"));
        }
        if frame.is_some() {
            document
                .warnings
                .push("the last frame is cut off and left out".to_owned());
        }
        Ok(document)
    }

    fn push(&mut self, frame: Frame) -> Result<(), String> {
        let count = self.segments.len();
        let index = self.frames.len();
        for (what, found, each) in [
            ("position", frame.positions.len(), 3),
            ("orientation", frame.orientations.len(), 4),
        ] {
            if found != each * count {
                return Err(format!(
                    "frame {index}: expected {} numbers in <{what}>, {each} a segment, found {found}",
                    each * count
                ));
            }
        }
        if index == MAX_FRAMES {
            return Err(format!("more than {MAX_FRAMES} frames"));
        }
        self.frames.push(frame);
        Ok(())
    }
}

fn attribute(tag: &BytesStart, name: &str) -> Option<String> {
    let attribute = tag.try_get_attribute(name).ok()??;
    let value = attribute.normalized_value(XmlVersion::Implicit1_0).ok()?;
    Some(value.into_owned())
}

/// The numbers of a text, or the first word that is none.
fn parse_numbers(text: &str) -> Result<Vec<f64>, String> {
    let number = |word: &str| {
        let value = word.parse().ok().filter(|value: &f64| value.is_finite());
        value.ok_or_else(|| word.chars().take(24).collect())
    };
    text.split_ascii_whitespace().map(number).collect()
}

/// Which segments carry the body.
struct Body {
    nodes: [usize; KEY_NODES],
    hips: [usize; 2],
    legs: Option<[[usize; 4]; 2]>,
    head: Option<usize>,
}

impl Body {
    fn find(path: &Path, segments: &[String], options: &ReadOptions) -> Result<Self, MotionError> {
        let named = |name: &str| segments.iter().position(|s| s.eq_ignore_ascii_case(name));
        let names = || segments.iter().map(String::as_str);
        let find = |joint: BodyJoint, usual: &str| match options.mapped(joint) {
            Some(name) => named(name).ok_or_else(|| unknown_mapped(path, joint, name, names())),
            None => named(usual).ok_or_else(|| {
                let found: Vec<&str> = names().take(60).collect();
                let reason = format!(
                    "no segment {usual} for {}; there are {}",
                    joint.name(),
                    found.join(", ")
                );
                MotionError::format(path, reason)
            }),
        };
        let mut nodes = [0; KEY_NODES];
        for (node, usual) in KeyNode::ALL.into_iter().zip(SEGMENTS) {
            nodes[node as usize] = find(BodyJoint::Node(node), usual)?;
        }
        let [left, right] =
            Side::BOTH.map(|side| find(BodyJoint::Hip(side), LEGS[side as usize][0]));
        let legs = LEGS.map(|leg| {
            let [hip, knee, ankle, toe] = leg.map(named);
            Some([hip?, knee?, ankle?, toe?])
        });
        let [left_leg, right_leg] = legs;
        Ok(Self {
            nodes,
            hips: [left?, right?],
            legs: left_leg.zip(right_leg).map(|(l, r)| [l, r]),
            head: named("Head"),
        })
    }

    fn frame(&self, frame: &Frame) -> WorldFrame {
        let [left, right] = self.hips.map(|hip| frame.position(hip));
        WorldFrame {
            positions: self.nodes.map(|segment| frame.position(segment)),
            left: left - right,
            wrists: Side::BOTH.map(|side| frame.orientation(self.nodes[side.arm()[2] as usize])),
        }
    }

    fn probe(&self, frame: &Frame) -> Probe {
        let world = self.frame(frame);
        let legs = self
            .legs
            .map(|legs| legs.map(|leg| leg.map(|joint| frame.position(joint))));
        let leg = |[hip, knee, ankle, toe]: [Vector3<f64>; 4]| Leg {
            hip,
            knee,
            ankle,
            toe: Some(toe),
        };
        let feet = || legs.iter().flatten().flatten().copied();
        let head = self.head.map(|head| frame.position(head));
        Probe {
            bounds: bounds(feet().chain(head).chain(world.positions)).unwrap_or_default(),
            height_bounds: head.and_then(|head| bounds(feet().chain([head]))),
            legs: legs.map(|legs| legs.map(leg)),
            positions: world.positions,
            left: world.left,
        }
    }
}
