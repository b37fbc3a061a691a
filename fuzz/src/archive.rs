//! Builds `.npz` archives around fuzzed arrays, so that mutations reach the array reader past the archive's checksums.

use std::io::{Cursor, Write};

use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

/// An archive of uncompressed entries.
pub(crate) fn stored(entries: &[(&str, &[u8])]) -> Vec<u8> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    for (name, bytes) in entries {
        let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
        zip.start_file(format!("{name}.npy"), options)
            .expect("a new entry can be started in memory");
        zip.write_all(bytes).expect("memory can be written");
    }
    zip.finish()
        .expect("an archive can be finished in memory")
        .into_inner()
}

/// A version 1 array with this header.
pub(crate) fn npy(descr: &str, shape: &str, data: &[u8]) -> Vec<u8> {
    let header = format!("{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n");
    let length = u16::try_from(header.len())
        .expect("the header is short")
        .to_le_bytes();
    [
        b"\x93NUMPY\x01\x00",
        length.as_slice(),
        header.as_bytes(),
        data,
    ]
    .concat()
}
