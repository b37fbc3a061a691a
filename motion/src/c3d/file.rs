//! The C3D file format: a header, named parameters, and labelled points frame by frame.
//!
//! Blocks of 512 bytes; numbers as Intel, DEC or MIPS processors write them; coordinates as floats or as scaled integers.
//! Read by hand: the crates that there are index a file's bytes unchecked, so that a broken file ends the process.

use std::path::Path;

use nalgebra::Vector3;

use crate::MotionError;
use crate::source::MAX_FRAMES;

const BLOCK: usize = 512;
/// The second byte of every C3D file.
const KEY: u8 = 0x50;
/// No file labels more points.
const MAX_POINTS: usize = 4096;
/// Arrays of labels that a file may have: LABELS, LABELS2 …
const MAX_LABEL_ARRAYS: usize = 16;

/// Labelled points of a file, in the file's unit and axes.
pub(super) struct Points {
    pub(super) labels: Vec<String>,
    /// Frames a second.
    pub(super) rate: f64,
    /// The unit that the file names.
    pub(super) unit: Option<String>,
    /// Which of the file's axes points up a screen, such as `+Z`.
    pub(super) screen_up: Option<String>,
    pub(super) frames: usize,
    /// Frames that the file announces.
    pub(super) announced: usize,
    /// Point by point, frame by frame; `None` where a point was not seen.
    positions: Vec<Option<Vector3<f32>>>,
}

impl Points {
    /// A point in a frame, where it was seen.
    pub(super) fn position(&self, frame: usize, point: usize) -> Option<Vector3<f64>> {
        let position = self.positions[frame * self.labels.len() + point];
        position.map(nalgebra::Matrix::cast::<f64>)
    }

    pub(super) fn parse(path: &Path, bytes: &[u8]) -> Result<Self, MotionError> {
        parse(bytes).map_err(|reason| MotionError::format(path, reason))
    }
}

/// How a processor writes numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Processor {
    Intel,
    Dec,
    Mips,
}

impl Processor {
    fn of(byte: u8) -> Result<Self, String> {
        match byte {
            84 => Ok(Self::Intel),
            85 => Ok(Self::Dec),
            86 => Ok(Self::Mips),
            other => Err(format!(
                "processor type {other} is unknown; expected 84, 85 or 86"
            )),
        }
    }

    fn integer(self, bytes: [u8; 2]) -> i16 {
        match self {
            Self::Intel | Self::Dec => i16::from_le_bytes(bytes),
            Self::Mips => i16::from_be_bytes(bytes),
        }
    }

    fn float(self, bytes: [u8; 4]) -> f32 {
        match self {
            Self::Intel => f32::from_le_bytes(bytes),
            Self::Mips => f32::from_be_bytes(bytes),
            // Words the other way round, and an exponent that is greater by two.
            Self::Dec => f32::from_le_bytes([bytes[2], bytes[3], bytes[0], bytes[1]]) / 4.0,
        }
    }
}

/// Bytes whose every access is checked.
#[derive(Clone, Copy)]
struct Bytes<'a> {
    bytes: &'a [u8],
    processor: Processor,
}

impl<'a> Bytes<'a> {
    fn slice(&self, start: usize, length: usize) -> Option<&'a [u8]> {
        self.bytes.get(start..start.checked_add(length)?)
    }

    fn byte(&self, at: usize) -> Option<u8> {
        self.bytes.get(at).copied()
    }

    fn integer(&self, at: usize) -> Option<i16> {
        let bytes = self.slice(at, 2)?.try_into().ok()?;
        Some(self.processor.integer(bytes))
    }

    fn count(&self, at: usize) -> Option<usize> {
        self.integer(at)
            .map(|value| usize::from(value.cast_unsigned()))
    }

    fn float(&self, at: usize) -> Option<f32> {
        let bytes = self.slice(at, 4)?.try_into().ok()?;
        Some(self.processor.float(bytes))
    }
}

fn parse(bytes: &[u8]) -> Result<Points, String> {
    const CUT: &str = "the file ends in its header";
    if bytes.get(1) != Some(&KEY) {
        return Err("does not begin as a C3D file does".to_owned());
    }
    let start = usize::from(bytes[0])
        .checked_sub(1)
        .ok_or("no parameter block")?
        * BLOCK;
    let processor = Processor::of(*bytes.get(start + 3).ok_or(CUT)?)?;
    let file = Bytes { bytes, processor };
    let parameters = Parameters::read(file, start);
    let count = file.count(2).ok_or(CUT)?;
    if count > MAX_POINTS {
        return Err(format!("{count} points; expected at most {MAX_POINTS}"));
    }
    let analog = file.count(4).ok_or(CUT)?;
    let first = file.count(6).ok_or(CUT)?;
    let last = file.count(8).ok_or(CUT)?;
    let scale = file.float(12).ok_or(CUT)?;
    let data = file.count(16).ok_or(CUT)?;
    let data = data.checked_sub(1).ok_or("no data block")? * BLOCK;
    let header_rate = f64::from(file.float(20).ok_or(CUT)?);
    let rate = parameters
        .number("POINT", "RATE")
        .filter(|rate| *rate > 0.0)
        .unwrap_or(header_rate);
    let labels = labels(&parameters, count)?;
    let number = if scale < 0.0 { 4 } else { 2 };
    let stride = (4 * count + analog) * number;
    let there = bytes
        .len()
        .saturating_sub(data)
        .checked_div(stride)
        .unwrap_or(0);
    let announced = parameters
        .frames()
        .unwrap_or((last + 1).saturating_sub(first));
    let frames = announced.min(there);
    if frames == 0 {
        return Err("the file has no frames".to_owned());
    }
    if frames > MAX_FRAMES {
        return Err(format!("{frames} frames; expected 1 to {MAX_FRAMES}"));
    }
    let mut positions = Vec::with_capacity(frames * count);
    for frame in 0..frames {
        for point in 0..count {
            let at = data + frame * stride + 4 * point * number;
            positions.push(position(file, at, scale));
        }
    }
    Ok(Points {
        labels,
        rate,
        unit: parameters.texts("POINT", "UNITS").into_iter().next(),
        screen_up: parameters.texts("POINT", "Y_SCREEN").into_iter().next(),
        frames,
        announced,
        positions,
    })
}

/// A point of four numbers: coordinates, and one that is negative where the point was not seen.
fn position(file: Bytes, at: usize, scale: f32) -> Option<Vector3<f32>> {
    let (p, residual) = if scale < 0.0 {
        let p = Vector3::new(file.float(at)?, file.float(at + 4)?, file.float(at + 8)?);
        (p, file.float(at + 12)?)
    } else {
        let number = |i: usize| file.integer(at + 2 * i).map(f32::from);
        (
            Vector3::new(number(0)?, number(1)?, number(2)?) * scale,
            number(3)?,
        )
    };
    // Writers without residuals leave points that were not seen at the origin.
    let seen = residual >= 0.0 && p.iter().all(|v| v.is_finite()) && p != Vector3::zeros();
    seen.then_some(p)
}

fn labels(parameters: &Parameters, count: usize) -> Result<Vec<String>, String> {
    let mut labels = parameters.texts("POINT", "LABELS");
    for number in 2..=MAX_LABEL_ARRAYS {
        labels.extend(parameters.texts("POINT", &format!("LABELS{number}")));
    }
    if labels.len() < count {
        return Err(format!("{count} points, but only {} labels", labels.len()));
    }
    labels.truncate(count);
    Ok(labels)
}

/// The named parameters of a file.
struct Parameters<'a> {
    file: Bytes<'a>,
    groups: Vec<(i8, String)>,
    entries: Vec<Entry<'a>>,
}

/// One parameter: its group's number, name, the type of its elements, dimensions and bytes.
struct Entry<'a> {
    group: i8,
    name: String,
    kind: i8,
    dimensions: Vec<usize>,
    data: &'a [u8],
}

impl<'a> Parameters<'a> {
    /// Reads what is readable: a file whose parameters are cut off lacks those behind the cut.
    fn read(file: Bytes<'a>, start: usize) -> Self {
        let mut parameters = Self {
            file,
            groups: Vec::new(),
            entries: Vec::new(),
        };
        let mut at = start + 4;
        while let Some(next) = parameters.entry(at) {
            at = next;
        }
        parameters
    }

    /// Reads the group or parameter at a place; answers where the next one is.
    fn entry(&mut self, at: usize) -> Option<usize> {
        let file = self.file;
        // Negative where the parameter is locked.
        let length = usize::from(file.byte(at)?.cast_signed().unsigned_abs());
        let group = file.byte(at + 1)?.cast_signed();
        if length == 0 || group == 0 {
            return None;
        }
        let name = file.slice(at + 2, length)?;
        let name = String::from_utf8_lossy(name).trim().to_ascii_uppercase();
        let offset_at = at + 2 + length;
        let offset = file.count(offset_at)?;
        let body = offset_at + 2;
        if group < 0 {
            self.groups.push((group.checked_neg()?, name));
        } else if let Some(entry) = parameter(file, group, name, body) {
            self.entries.push(entry);
        }
        // An offset of 0 marks the last one; a small one would go round in a circle.
        (offset >= 2).then_some(offset_at + offset)
    }

    fn find(&self, group: &str, name: &str) -> Option<&Entry<'a>> {
        let (number, _) = self.groups.iter().find(|(_, other)| other == group)?;
        self.entries
            .iter()
            .find(|entry| entry.group == *number && entry.name == name)
    }

    fn number(&self, group: &str, name: &str) -> Option<f64> {
        self.numbers(group, name).first().copied()
    }

    fn numbers(&self, group: &str, name: &str) -> Vec<f64> {
        let Some(entry) = self.find(group, name) else {
            return Vec::new();
        };
        let processor = self.file.processor;
        match entry.kind {
            1 => entry.data.iter().map(|b| f64::from(*b)).collect(),
            2 => {
                let words = entry.data.as_chunks::<2>().0.iter();
                words
                    .map(|b| f64::from(processor.integer(*b).cast_unsigned()))
                    .collect()
            }
            4 => {
                let words = entry.data.as_chunks::<4>().0.iter();
                words.map(|b| f64::from(processor.float(*b))).collect()
            }
            _ => Vec::new(),
        }
    }

    /// An array of texts; one text where it has one dimension.
    fn texts(&self, group: &str, name: &str) -> Vec<String> {
        let Some(entry) = self.find(group, name).filter(|entry| entry.kind == -1) else {
            return Vec::new();
        };
        let width = entry.dimensions.first().copied().unwrap_or(1);
        if width == 0 {
            return Vec::new();
        }
        let text = |bytes: &[u8]| {
            let text = String::from_utf8_lossy(bytes);
            text.trim_end_matches('\0').trim().to_owned()
        };
        entry.data.chunks(width).map(text).collect()
    }

    /// The number of frames where a parameter tells it: the header's 16 bits hold too few for long recordings.
    fn frames(&self) -> Option<usize> {
        let field = |name: &str| match *self.numbers("TRIAL", name).as_slice() {
            [low, high] => Some(low + 65536.0 * high),
            _ => None,
        };
        let trial = field("ACTUAL_END_FIELD").zip(field("ACTUAL_START_FIELD"));
        let frames = trial.map(|(end, start)| end - start + 1.0);
        let frames = frames.or_else(|| self.number("POINT", "LONG_FRAMES"));
        frames
            .filter(|n| *n >= 1.0 && *n <= 1e9)
            .map(|n| n as usize)
    }
}

fn parameter<'a>(file: Bytes<'a>, group: i8, name: String, at: usize) -> Option<Entry<'a>> {
    let kind = file.byte(at)?.cast_signed();
    let count = usize::from(file.byte(at + 1)?);
    let dimensions: Vec<usize> = file
        .slice(at + 2, count)?
        .iter()
        .map(|d| usize::from(*d))
        .collect();
    let elements = dimensions
        .iter()
        .try_fold(1_usize, |n, d| n.checked_mul(*d))?;
    let size = elements.checked_mul(usize::from(kind.unsigned_abs()))?;
    let data = file.slice(at + 2 + count, size)?;
    Some(Entry {
        group,
        name,
        kind,
        dimensions,
        data,
    })
}
