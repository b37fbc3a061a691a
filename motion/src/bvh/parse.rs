//! The BVH text format: a joint tree and one line of channel values a frame.

use std::path::Path;

use nalgebra::Vector3;

use crate::MotionError;
use crate::source::check_size;

/// No skeleton has more joints, end sites included.
const MAX_JOINTS: usize = 2048;

/// One number of a frame's line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Channel {
    /// Coordinate along an axis (0 x, 1 y, 2 z), in place of the joint's offset.
    Position(usize),
    /// Rotation about an axis, degrees.
    Rotation(usize),
}

/// A joint or an end site.
#[derive(Debug)]
pub(super) struct Joint {
    /// Empty for an end site.
    pub(super) name: String,
    /// Index of the parent, always smaller than the joint's own.
    pub(super) parent: Option<usize>,
    /// From the parent in the parent's frame, file units.
    pub(super) offset: Vector3<f64>,
    /// In the order of the file, which is the order in which rotations multiply from the left.
    pub(super) channels: Vec<Channel>,
    /// Where this joint's values begin in a frame.
    pub(super) first_value: usize,
}

impl Joint {
    /// Whether the joint turns on its own account.
    pub(super) fn rotates(&self) -> bool {
        self.channels
            .iter()
            .any(|channel| matches!(channel, Channel::Rotation(_)))
    }
}

/// A parsed file, units and axes as in the file.
#[derive(Debug)]
pub(super) struct Document {
    pub(super) joints: Vec<Joint>,
    pub(super) fps: f64,
    /// Channel values a frame, frame after frame.
    pub(super) values: Vec<f64>,
    pub(super) frames: usize,
}

impl Document {
    pub(super) fn frame(&self, index: usize) -> &[f64] {
        let width = self.values.len() / self.frames;
        &self.values[index * width..(index + 1) * width]
    }
}

/// Parses a whole file.
pub(super) fn parse(path: &Path, text: &str) -> Result<Document, MotionError> {
    let mut reader = Reader::new(path, text);
    let joints = hierarchy(&mut reader)?;
    let (frames, fps) = motion_header(&mut reader)?;
    let width = joints.iter().map(|joint| joint.channels.len()).sum();
    let values = motion(&mut reader, frames, width)?;
    Ok(Document {
        joints,
        fps,
        values,
        frames,
    })
}

/// Hands out words (braces are words of their own) and knows the line it stands on.
struct Reader<'a> {
    path: &'a Path,
    lines: std::iter::Enumerate<std::str::Lines<'a>>,
    rest: &'a str,
    line: usize,
}

impl<'a> Reader<'a> {
    fn new(path: &'a Path, text: &'a str) -> Self {
        let text = text.strip_prefix('\u{feff}').unwrap_or(text);
        Self {
            path,
            lines: text.lines().enumerate(),
            rest: "",
            line: 1,
        }
    }

    fn error(&self, reason: impl Into<String>) -> MotionError {
        MotionError::line(self.path, self.line, reason)
    }

    /// Goes to the next line with something on it; `None` at the end of the file.
    fn next_line(&mut self) -> Option<&'a str> {
        for (index, line) in self.lines.by_ref() {
            self.line = index + 1;
            let line = line.trim();
            if !line.is_empty() {
                return Some(line);
            }
        }
        None
    }

    fn word(&mut self) -> Option<&'a str> {
        if self.rest.is_empty() {
            self.rest = self.next_line()?;
        }
        let brace = self.rest.starts_with(['{', '}']);
        let end = if brace {
            1
        } else {
            self.rest
                .find(|c: char| c.is_whitespace() || c == '{' || c == '}')
                .unwrap_or(self.rest.len())
        };
        let (word, rest) = self.rest.split_at(end);
        self.rest = rest.trim_start();
        Some(word)
    }

    fn expected_word(&mut self, what: &str) -> Result<&'a str, MotionError> {
        self.word()
            .ok_or_else(|| self.error(format!("the file ends where {what} was expected")))
    }

    fn keyword(&mut self, keyword: &str) -> Result<(), MotionError> {
        let word = self.expected_word(keyword)?;
        if word.eq_ignore_ascii_case(keyword) {
            Ok(())
        } else {
            Err(self.error(format!("expected {keyword}, found {word:?}")))
        }
    }

    fn number(&mut self, what: &str) -> Result<f64, MotionError> {
        let word = self.expected_word(what)?;
        finite(word)
            .ok_or_else(|| self.error(format!("{what}: expected a finite number, found {word:?}")))
    }

    /// The rest of the line up to a brace: a joint's name, which may hold spaces.
    fn name(&mut self) -> Result<String, MotionError> {
        let end = self.rest.find(['{', '}']).unwrap_or(self.rest.len());
        let (name, rest) = self.rest.split_at(end);
        self.rest = rest;
        let name = name.trim();
        if name.is_empty() {
            Err(self.error("expected a joint's name"))
        } else {
            Ok(name.to_owned())
        }
    }
}

fn finite(word: &str) -> Option<f64> {
    word.parse().ok().filter(|value: &f64| value.is_finite())
}

fn hierarchy(reader: &mut Reader) -> Result<Vec<Joint>, MotionError> {
    reader.keyword("HIERARCHY")?;
    reader.keyword("ROOT")?;
    let mut joints = Vec::new();
    let mut width = 0;
    let root = reader.name()?;
    open_joint(reader, &mut joints, &mut width, root, None)?;
    let mut open = vec![0];
    while let Some(&parent) = open.last() {
        let word = reader.expected_word("JOINT, End Site or }")?;
        match word.to_ascii_lowercase().as_str() {
            "}" => {
                open.pop();
            }
            "joint" => {
                let name = reader.name()?;
                open.push(joints.len());
                open_joint(reader, &mut joints, &mut width, name, Some(parent))?;
            }
            "end" => {
                reader.keyword("Site")?;
                open_joint(reader, &mut joints, &mut width, String::new(), Some(parent))?;
                reader.keyword("}")?;
            }
            _ => {
                return Err(reader.error(format!("expected JOINT, End Site or }}, found {word:?}")));
            }
        }
    }
    Ok(joints)
}

/// Reads `{ OFFSET x y z` and, for a joint, `CHANNELS n …`.
fn open_joint(
    reader: &mut Reader,
    joints: &mut Vec<Joint>,
    width: &mut usize,
    name: String,
    parent: Option<usize>,
) -> Result<(), MotionError> {
    if joints.len() == MAX_JOINTS {
        return Err(reader.error(format!("more than {MAX_JOINTS} joints")));
    }
    reader.keyword("{")?;
    reader.keyword("OFFSET")?;
    let offset = Vector3::new(
        reader.number("OFFSET x")?,
        reader.number("OFFSET y")?,
        reader.number("OFFSET z")?,
    );
    let channels = if name.is_empty() {
        Vec::new()
    } else {
        channels(reader)?
    };
    let first_value = *width;
    *width += channels.len();
    joints.push(Joint {
        name,
        parent,
        offset,
        channels,
        first_value,
    });
    Ok(())
}

fn channels(reader: &mut Reader) -> Result<Vec<Channel>, MotionError> {
    reader.keyword("CHANNELS")?;
    let word = reader.expected_word("a number of channels")?;
    let count: usize = word
        .parse()
        .ok()
        .filter(|count| *count <= 6)
        .ok_or_else(|| reader.error(format!("expected 0 to 6 channels, found {word:?}")))?;
    let mut channels = Vec::with_capacity(count);
    for _ in 0..count {
        let word = reader.expected_word("a channel's name")?;
        let channel = channel(word).ok_or_else(|| {
            reader.error(format!(
                "expected a channel such as Xposition or Zrotation, found {word:?}"
            ))
        })?;
        if channels.contains(&channel) {
            return Err(reader.error(format!("channel {word} appears twice in one joint")));
        }
        channels.push(channel);
    }
    Ok(channels)
}

fn channel(word: &str) -> Option<Channel> {
    let word = word.to_ascii_lowercase();
    let axis = match word.as_bytes().first()? {
        b'x' => 0,
        b'y' => 1,
        b'z' => 2,
        _ => return None,
    };
    match &word[1..] {
        "position" => Some(Channel::Position(axis)),
        "rotation" => Some(Channel::Rotation(axis)),
        _ => None,
    }
}

/// Reads `MOTION`, `Frames: n` and `Frame Time: s`; answers the number of frames and the frame rate.
fn motion_header(reader: &mut Reader) -> Result<(usize, f64), MotionError> {
    reader.keyword("MOTION")?;
    reader.keyword("Frames:")?;
    let word = reader.expected_word("a number of frames")?;
    let frames: usize = word
        .parse()
        .map_err(|_| reader.error(format!("expected a number of frames, found {word:?}")))?;
    check_size(reader.path, 1.0, frames)
        .map_err(|_| reader.error(format!("{frames} frames is no plausible number")))?;
    reader.keyword("Frame")?;
    reader.keyword("Time:")?;
    let seconds = reader.number("Frame Time")?;
    let fps = 1.0 / seconds;
    check_size(reader.path, fps, frames).map_err(|_| {
        reader.error(format!(
            "a frame time of {seconds} s is not between 0.001 and 1"
        ))
    })?;
    if reader.rest.is_empty() {
        Ok((frames, fps))
    } else {
        Err(reader.error("expected the end of the line after Frame Time"))
    }
}

/// Reads `frames` lines of `width` numbers; the vector grows as lines prove to be there.
fn motion(reader: &mut Reader, frames: usize, width: usize) -> Result<Vec<f64>, MotionError> {
    let mut values = Vec::new();
    for index in 0..frames {
        let Some(line) = reader.next_line() else {
            return Err(reader.error(format!(
                "the file announces {frames} frames and ends after {index}"
            )));
        };
        for word in line.split_ascii_whitespace() {
            let value = finite(word).ok_or_else(|| {
                reader.error(format!(
                    "frame {index}: expected a finite number, found {:?}",
                    shortened(word)
                ))
            })?;
            values.push(value);
        }
        let found = values.len() - index * width;
        if found != width {
            return Err(reader.error(format!(
                "frame {index}: expected {width} values, found {found}"
            )));
        }
    }
    match reader.next_line() {
        None => Ok(values),
        Some(_) => Err(reader.error(format!(
            "the file announces {frames} frames and goes on after them"
        ))),
    }
}

/// The beginning of a word, so that a message stays readable.
fn shortened(word: &str) -> String {
    word.chars().take(24).collect()
}
