//! The BVH text format: one or more joint trees and one line of channel values a frame.

use std::path::Path;

use nalgebra::Vector3;

use crate::MotionError;
use crate::source::{MAX_FRAMES, Rate};

/// No skeleton has more joints, end sites included.
const MAX_JOINTS: usize = 2048;

/// One number of a frame's line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Channel {
    /// Coordinate along an axis (0 x, 1 y, 2 z).
    Position(usize),
    /// Rotation about an axis, degrees.
    Rotation(usize),
}

/// A joint or an end site.
#[derive(Debug)]
pub(super) struct Joint {
    /// Empty for an end site.
    pub(super) name: String,
    /// Index of the parent, always smaller than the joint's own; `None` for a root.
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

    /// Whether the joint moves against its parent.
    pub(super) fn moves(&self) -> bool {
        self.channels
            .iter()
            .any(|channel| matches!(channel, Channel::Position(_)))
    }

    /// The joint's position channels, with 0 for an axis without one.
    pub(super) fn position(&self, values: &[f64]) -> Vector3<f64> {
        let mut position = Vector3::zeros();
        for (channel, value) in self.channels.iter().zip(&values[self.first_value..]) {
            if let Channel::Position(axis) = channel {
                position[*axis] = *value;
            }
        }
        position
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

/// Parses a whole file; `fps` replaces its own rate.
pub(super) fn parse(
    path: &Path,
    text: &str,
    fps: Option<f64>,
    warnings: &mut Vec<String>,
) -> Result<Document, MotionError> {
    let mut reader = Reader::new(path, text);
    let joints = hierarchy(&mut reader)?;
    let (announced, rate) = motion_header(&mut reader, fps)?;
    warnings.extend(rate.warning);
    let width = joints.iter().map(|joint| joint.channels.len()).sum();
    let (values, frames) = frame_values(&mut reader, announced, width, warnings)?;
    Ok(Document {
        joints,
        fps: rate.fps,
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

    /// Goes to the next line with something on it besides a comment; `None` at the end of the file.
    fn next_line(&mut self) -> Option<&'a str> {
        for (index, line) in self.lines.by_ref() {
            let line = line.trim();
            if !(line.is_empty() || line.starts_with('#') || line.starts_with("//")) {
                self.line = index + 1;
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

    /// Whether the next word is this one; it is taken then.
    fn takes(&mut self, keyword: &str) -> bool {
        let before = (self.rest, self.line, self.lines.clone());
        if self
            .word()
            .is_some_and(|word| word.eq_ignore_ascii_case(keyword))
        {
            return true;
        }
        (self.rest, self.line, self.lines) = before;
        false
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
            Err(self.error(format!("expected {keyword}, found {:?}", shortened(word))))
        }
    }

    fn number(&mut self, what: &str) -> Result<f64, MotionError> {
        let word = self.expected_word(what)?;
        finite(word).ok_or_else(|| {
            let word = shortened(word);
            self.error(format!("{what}: expected a finite number, found {word:?}"))
        })
    }

    /// The rest of the line up to a brace: a joint's name, which may hold spaces.
    fn name(&mut self) -> Result<String, MotionError> {
        let name = self.until_brace();
        if name.is_empty() {
            Err(self.error("expected a joint's name"))
        } else {
            Ok(name.to_owned())
        }
    }

    fn until_brace(&mut self) -> &'a str {
        let end = self.rest.find(['{', '}']).unwrap_or(self.rest.len());
        let (text, rest) = self.rest.split_at(end);
        self.rest = rest;
        text.trim()
    }

    /// What stands behind `key:` on its line; spaces around the colon do not matter.
    fn setting(&mut self, key: &str) -> Result<&'a str, MotionError> {
        let line = if self.rest.is_empty() {
            self.next_line().unwrap_or_default()
        } else {
            self.rest
        };
        self.rest = "";
        let setting = line.split_once(':');
        match setting {
            Some((found, value)) if same_words(found, key) => Ok(value.trim()),
            _ if line.is_empty() => {
                Err(self.error(format!("the file ends where {key}: was expected")))
            }
            _ => Err(self.error(format!("expected {key}:, found {:?}", shortened(line)))),
        }
    }
}

fn same_words(a: &str, b: &str) -> bool {
    let mut words = a.split_whitespace().zip(b.split_whitespace());
    a.split_whitespace().count() == b.split_whitespace().count()
        && words.all(|(a, b)| a.eq_ignore_ascii_case(b))
}

fn finite(word: &str) -> Option<f64> {
    word.parse().ok().filter(|value: &f64| value.is_finite())
}

/// Reads `HIERARCHY` and every tree that follows.
fn hierarchy(reader: &mut Reader) -> Result<Vec<Joint>, MotionError> {
    reader.keyword("HIERARCHY")?;
    reader.keyword("ROOT")?;
    let mut joints = Vec::new();
    tree(reader, &mut joints)?;
    while reader.takes("ROOT") {
        tree(reader, &mut joints)?;
    }
    Ok(joints)
}

fn tree(reader: &mut Reader, joints: &mut Vec<Joint>) -> Result<(), MotionError> {
    let root = reader.name()?;
    let mut open = vec![joints.len()];
    open_joint(reader, joints, root, None)?;
    while let Some(&parent) = open.last() {
        let word = reader.expected_word("JOINT, End Site or }")?;
        match word.to_ascii_lowercase().as_str() {
            "}" => {
                open.pop();
            }
            "joint" => {
                let name = reader.name()?;
                open.push(joints.len());
                open_joint(reader, joints, name, Some(parent))?;
            }
            "end" => {
                reader.keyword("Site")?;
                // Some writers name their end sites.
                reader.until_brace();
                open_joint(reader, joints, String::new(), Some(parent))?;
                reader.keyword("}")?;
            }
            _ => {
                let word = shortened(word);
                return Err(reader.error(format!("expected JOINT, End Site or }}, found {word:?}")));
            }
        }
    }
    Ok(())
}

/// Reads `{ OFFSET x y z` and, for a joint that has them, `CHANNELS n …`.
fn open_joint(
    reader: &mut Reader,
    joints: &mut Vec<Joint>,
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
    let channels = if !name.is_empty() && reader.takes("CHANNELS") {
        channels(reader)?
    } else {
        Vec::new()
    };
    let first_value = joints
        .last()
        .map_or(0, |last: &Joint| last.first_value + last.channels.len());
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
    let word = reader.expected_word("a number of channels")?;
    let count: usize = word
        .parse()
        .ok()
        .filter(|count| *count <= 6)
        .ok_or_else(|| {
            reader.error(format!(
                "expected 0 to 6 channels, found {:?}",
                shortened(word)
            ))
        })?;
    let mut channels = Vec::with_capacity(count);
    for _ in 0..count {
        let word = reader.expected_word("a channel's name")?;
        let channel = channel(word).ok_or_else(|| {
            reader.error(format!(
                "expected a channel such as Xposition or Zrotation, found {:?}",
                shortened(word)
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
fn motion_header(reader: &mut Reader, fps: Option<f64>) -> Result<(usize, Rate), MotionError> {
    reader.keyword("MOTION")?;
    let word = reader.setting("Frames")?;
    let frames: usize = word.parse().map_err(|_| {
        reader.error(format!(
            "expected a number of frames, found {:?}",
            shortened(word)
        ))
    })?;
    if frames > MAX_FRAMES {
        return Err(reader.error(format!("{frames} frames is no plausible number")));
    }
    let word = reader.setting("Frame Time")?;
    let rate = match (fps, finite(word)) {
        (Some(fps), _) => Rate::given(fps),
        (None, Some(seconds)) => Rate::from_frame_time(seconds),
        (None, None) => Err(format!(
            "Frame Time: expected a finite number, found {:?}",
            shortened(word)
        )),
    };
    rate.map(|rate| (frames, rate))
        .map_err(|reason| reader.error(reason))
}

/// Reads lines of `width` numbers to the end of the file; the vector grows as lines prove to be there.
fn frame_values(
    reader: &mut Reader,
    announced: usize,
    width: usize,
    warnings: &mut Vec<String>,
) -> Result<(Vec<f64>, usize), MotionError> {
    let mut values = Vec::new();
    let mut frames = 0;
    let mut line = reader.next_line();
    while let Some(text) = line {
        if frames == MAX_FRAMES {
            return Err(reader.error(format!("more than {MAX_FRAMES} frames")));
        }
        let start = values.len();
        let number = reader.line;
        let problem = read_frame(text, width, &mut values).err();
        line = reader.next_line();
        let Some(problem) = problem else {
            frames += 1;
            continue;
        };
        values.truncate(start);
        let cut_off = line.is_none() && values_missing(text, width) && frames > 0;
        if cut_off {
            warnings.push(format!("line {number} is cut off and left out"));
        } else if frames >= announced && frames > 0 {
            warnings.push(format!(
                "what follows the frames from line {number} on is left out"
            ));
            break;
        } else {
            return Err(MotionError::line(
                reader.path,
                number,
                format!("frame {frames}: {problem}"),
            ));
        }
    }
    if frames == 0 {
        return Err(reader.error("the file has no frames"));
    }
    if frames != announced {
        warnings.push(format!(
            "the file announces {announced} frames and has {frames}; all of them are read"
        ));
    }
    Ok((values, frames))
}

/// Whether a line's numbers are right as far as they go; the last one may have been cut in two.
fn values_missing(text: &str, width: usize) -> bool {
    let words: Vec<&str> = text.split_ascii_whitespace().collect();
    let whole = &words[..words.len().saturating_sub(1)];
    words.len() <= width && whole.iter().all(|word| finite(word).is_some())
}

fn read_frame(text: &str, width: usize, values: &mut Vec<f64>) -> Result<(), String> {
    let start = values.len();
    for word in text.split_ascii_whitespace() {
        let value = finite(word)
            .ok_or_else(|| format!("expected a finite number, found {:?}", shortened(word)))?;
        values.push(value);
    }
    match values.len() - start {
        found if found == width => Ok(()),
        found => Err(format!("expected {width} values, found {found}")),
    }
}

/// The beginning of a word, so that a message stays readable.
fn shortened(word: &str) -> String {
    word.chars().take(24).collect()
}
