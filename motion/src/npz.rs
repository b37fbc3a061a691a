//! The part of numpy's `.npz` that motion files use: real-valued arrays and arrays of strings, in C order.
//!
//! Sizes are checked against the array's header before anything of that size is allocated, so that a small hostile
//! archive cannot ask for a large amount of memory. Arrays of Python objects are refused: reading them means running
//! code from the file.

use std::io::{Cursor, Read, Write};
use std::path::Path;

use half::f16;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

use crate::MotionError;

/// No array of a motion is larger than this, bytes.
const MAX_ARRAY: u64 = 256 << 20;
/// No archive has more entries than this.
const MAX_ENTRIES: usize = 256;
/// No header of an array is longer than this, bytes.
const MAX_HEADER: usize = 8192;
const MAGIC: &[u8] = b"\x93NUMPY";

/// An opened archive.
pub(crate) struct Npz<'a> {
    path: &'a Path,
    archive: ZipArchive<Cursor<&'a [u8]>>,
}

/// A real-valued array in C order.
#[derive(Debug)]
pub(crate) struct Array {
    pub(crate) shape: Vec<usize>,
    pub(crate) values: Vec<f64>,
}

impl<'a> Npz<'a> {
    pub(crate) fn open(path: &'a Path, bytes: &'a [u8]) -> Result<Self, MotionError> {
        let archive = ZipArchive::new(Cursor::new(bytes))
            .map_err(|e| MotionError::format(path, format!("not an npz archive: {e}")))?;
        if archive.len() > MAX_ENTRIES {
            let reason = format!(
                "{} entries; expected at most {MAX_ENTRIES} arrays",
                archive.len()
            );
            return Err(MotionError::format(path, reason));
        }
        Ok(Self { path, archive })
    }

    pub(crate) fn has(&self, name: &str) -> bool {
        self.archive
            .index_for_name(&format!("{name}.npy"))
            .is_some()
    }

    /// The first of these arrays that is there.
    pub(crate) fn first(&self, names: &[&'static str]) -> Option<&'static str> {
        names.iter().copied().find(|name| self.has(name))
    }

    /// The names of the arrays, for messages.
    pub(crate) fn names(&self) -> String {
        let readable = self.archive.file_names().filter_map(Result::ok);
        let names: Vec<String> = readable
            .take(20)
            .map(|n| n.trim_end_matches(".npy").to_owned())
            .collect();
        names.join(", ")
    }

    /// A real-valued array of any width and byte order.
    pub(crate) fn array(&mut self, name: &str) -> Result<Array, MotionError> {
        let (header, data) = self.entry(name)?;
        let values = header
            .values(&data)
            .map_err(|reason| self.error(name, &reason))?;
        Ok(Array {
            shape: header.shape,
            values,
        })
    }

    /// A single number.
    pub(crate) fn scalar(&mut self, name: &str) -> Result<f64, MotionError> {
        let array = self.array(name)?;
        match array.values.as_slice() {
            [value] => Ok(*value),
            _ => Err(self.error(
                name,
                &format!("expected one number, found shape {:?}", array.shape),
            )),
        }
    }

    /// An array of strings (`<U…` or `|S…`), flattened.
    pub(crate) fn strings(&mut self, name: &str) -> Result<Vec<String>, MotionError> {
        let (header, data) = self.entry(name)?;
        header
            .strings(&data)
            .map_err(|reason| self.error(name, &reason))
    }

    pub(crate) fn error(&self, array: &str, reason: &str) -> MotionError {
        MotionError::format(self.path, format!("array {array}: {reason}"))
    }

    fn entry(&mut self, name: &str) -> Result<(Header, Vec<u8>), MotionError> {
        let path = self.path;
        let error = |reason: String| MotionError::format(path, format!("array {name}: {reason}"));
        let mut file = self
            .archive
            .by_name(&format!("{name}.npy"))
            .map_err(|e| error(e.to_string()))?;
        let header = Header::read(&mut file).map_err(error)?;
        let size = header.data_size().map_err(error)?;
        let mut data = Vec::new();
        file.take(size + 1)
            .read_to_end(&mut data)
            .map_err(|e| error(format!("unreadable: {e}")))?;
        if data.len() as u64 != size {
            let found = if data.len() as u64 > size {
                "more".to_owned()
            } else {
                data.len().to_string()
            };
            return Err(error(format!(
                "shape {:?} needs {size} bytes, found {found}",
                header.shape
            )));
        }
        Ok((header, data))
    }
}

/// An array's header.
#[derive(Debug)]
struct Header {
    /// Type letter as numpy writes it: f, i, u, b, U, S …
    kind: u8,
    /// Bytes (for `U`: code points) an element.
    width: usize,
    big_endian: bool,
    shape: Vec<usize>,
}

impl Header {
    fn read(file: &mut impl Read) -> Result<Self, String> {
        let mut start = [0; 8];
        file.read_exact(&mut start)
            .map_err(|_| "too short for an npy header")?;
        if &start[..6] != MAGIC {
            return Err("does not begin as an npy array does".to_owned());
        }
        let length = match start[6] {
            1 => {
                let mut length = [0; 2];
                file.read_exact(&mut length)
                    .map_err(|_| "header is cut off")?;
                usize::from(u16::from_le_bytes(length))
            }
            2 | 3 => {
                let mut length = [0; 4];
                file.read_exact(&mut length)
                    .map_err(|_| "header is cut off")?;
                u32::from_le_bytes(length) as usize
            }
            version => return Err(format!("npy version {version} is unknown")),
        };
        if length > MAX_HEADER {
            return Err(format!(
                "header of {length} bytes is longer than {MAX_HEADER}"
            ));
        }
        let mut text = vec![0; length];
        file.read_exact(&mut text)
            .map_err(|_| "header is cut off")?;
        let text = String::from_utf8(text).map_err(|_| "header is not text")?;
        Self::parse(&text).ok_or_else(|| {
            format!(
                "expected a header of descr, fortran_order: False and shape, found {:?}",
                text.trim_end()
            )
        })
    }

    /// Parses `{'descr': '<f4', 'fortran_order': False, 'shape': (3, 8), }`. Structured types and Fortran order are refused.
    fn parse(text: &str) -> Option<Self> {
        let value = |key: &str| {
            Some(
                text.split_once(key)?
                    .1
                    .trim_start()
                    .strip_prefix(':')?
                    .trim_start(),
            )
        };
        let descr = value("'descr'")?.strip_prefix('\'')?.split('\'').next()?;
        let shape = value("'shape'")?.strip_prefix('(')?.split(')').next()?;
        let shape: Option<Vec<usize>> = shape
            .split(',')
            .map(str::trim)
            .filter(|n| !n.is_empty())
            .map(|n| n.parse().ok())
            .collect();
        let shape = shape?;
        // With at most one dimension the orders are the same.
        if shape.len() > 1 && !value("'fortran_order'")?.starts_with("False") {
            return None;
        }
        let [order, kind, ..] = *descr.as_bytes() else {
            return None;
        };
        let width = descr.get(2..)?.parse().ok()?;
        matches!(order, b'<' | b'>' | b'|' | b'=').then_some(Self {
            kind,
            width,
            big_endian: order == b'>',
            shape,
        })
    }

    fn element_size(&self) -> Option<usize> {
        if self.kind == b'U' {
            self.width.checked_mul(4)
        } else {
            Some(self.width)
        }
    }

    fn data_size(&self) -> Result<u64, String> {
        self.shape
            .iter()
            .try_fold(self.element_size().unwrap_or(usize::MAX), |size, n| {
                size.checked_mul(*n)
            })
            .map(|size| size as u64)
            .filter(|size| *size <= MAX_ARRAY)
            .ok_or_else(|| {
                format!(
                    "shape {:?} is larger than the {MAX_ARRAY} bytes a motion may have",
                    self.shape
                )
            })
    }

    fn values(&self, data: &[u8]) -> Result<Vec<f64>, String> {
        /// Decodes elements of one type, least significant byte first.
        macro_rules! decode {
            ($type:ty) => {
                self.elements(data)
                    .map(|bytes| <$type>::from_le_bytes(bytes))
                    .map(|v| v as f64)
                    .collect()
            };
        }
        Ok(match (self.kind, self.width) {
            (b'f', 8) => decode!(f64),
            (b'f', 4) => decode!(f32),
            (b'f', 2) => self
                .elements(data)
                .map(|bytes| f16::from_le_bytes(bytes).to_f64())
                .collect(),
            (b'i', 8) => decode!(i64),
            (b'i', 4) => decode!(i32),
            (b'i', 2) => decode!(i16),
            (b'i', 1) => decode!(i8),
            (b'u', 8) => decode!(u64),
            (b'u', 4) => decode!(u32),
            (b'u', 2) => decode!(u16),
            (b'u' | b'b', 1) => decode!(u8),
            (kind, width) => {
                return Err(format!(
                    "expected real numbers, found type {}{width}",
                    char::from(kind)
                ));
            }
        })
    }

    fn elements<'d, const N: usize>(&self, data: &'d [u8]) -> impl Iterator<Item = [u8; N]> + 'd {
        let big_endian = self.big_endian;
        data.as_chunks::<N>().0.iter().map(move |chunk| {
            let mut bytes = *chunk;
            if big_endian {
                bytes.reverse();
            }
            bytes
        })
    }

    fn strings(&self, data: &[u8]) -> Result<Vec<String>, String> {
        let size = self
            .element_size()
            .filter(|size| *size > 0)
            .ok_or("strings without width")?;
        let text = |element: &[u8]| -> Option<String> {
            match self.kind {
                b'S' => Some(
                    String::from_utf8_lossy(element)
                        .trim_end_matches('\0')
                        .to_owned(),
                ),
                b'U' => {
                    let points: Option<String> = self
                        .elements::<4>(element)
                        .map(|b| char::from_u32(u32::from_le_bytes(b)))
                        .collect();
                    Some(points?.trim_end_matches('\0').to_owned())
                }
                _ => None,
            }
        };
        data.chunks_exact(size)
            .map(text)
            .collect::<Option<Vec<String>>>()
            .ok_or_else(|| {
                format!(
                    "expected strings, found type {}{}",
                    char::from(self.kind),
                    self.width
                )
            })
    }
}

/// Writes arrays as numpy's `savez_compressed` does.
pub(crate) struct NpzWriter<W: Write + std::io::Seek> {
    zip: ZipWriter<W>,
}

impl<W: Write + std::io::Seek> NpzWriter<W> {
    pub(crate) fn new(file: W) -> Self {
        Self {
            zip: ZipWriter::new(file),
        }
    }

    pub(crate) fn array_f32(
        &mut self,
        name: &str,
        shape: &[usize],
        values: &[f32],
    ) -> std::io::Result<()> {
        let data: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.entry(name, "<f4", shape, &data)
    }

    pub(crate) fn scalar_f64(&mut self, name: &str, value: f64) -> std::io::Result<()> {
        self.entry(name, "<f8", &[], &value.to_le_bytes())
    }

    pub(crate) fn strings(&mut self, name: &str, values: &[&str]) -> std::io::Result<()> {
        let width = values
            .iter()
            .map(|v| v.chars().count())
            .max()
            .unwrap_or(0)
            .max(1);
        let padded = values
            .iter()
            .flat_map(|v| v.chars().chain(std::iter::repeat('\0')).take(width));
        let data: Vec<u8> = padded.flat_map(|c| u32::from(c).to_le_bytes()).collect();
        self.entry(name, &format!("<U{width}"), &[values.len()], &data)
    }

    pub(crate) fn finish(self) -> std::io::Result<W> {
        Ok(self.zip.finish()?)
    }

    fn entry(
        &mut self,
        name: &str,
        descr: &str,
        shape: &[usize],
        data: &[u8],
    ) -> std::io::Result<()> {
        let options = SimpleFileOptions::default().compression_method(CompressionMethod::Deflated);
        self.zip.start_file(format!("{name}.npy"), options)?;
        let shape: String = shape.iter().map(|n| format!("{n}, ")).collect();
        let mut header = format!(
            "{{'descr': '{descr}', 'fortran_order': False, 'shape': ({}), }}",
            shape.trim_end()
        );
        // The data begins at a multiple of 64 bytes; the header ends in a line break.
        let length = (MAGIC.len() + 4 + header.len() + 1).next_multiple_of(64) - MAGIC.len() - 4;
        header.extend(std::iter::repeat_n(' ', length - header.len() - 1));
        header.push('\n');
        self.zip.write_all(MAGIC)?;
        self.zip.write_all(&[1, 0])?;
        // Headers of the arrays above stay below 128 bytes.
        self.zip
            .write_all(&u16::try_from(length).unwrap_or(u16::MAX).to_le_bytes())?;
        self.zip.write_all(header.as_bytes())?;
        self.zip.write_all(data)
    }
}
