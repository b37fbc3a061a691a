//! The C3D reader answers any bytes with a valid clip or an error.
#![no_main]

use std::path::Path;

use emp_motion::{ReadOptions, c3d};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let read = c3d::from_bytes(Path::new("fuzz.c3d"), data, &ReadOptions::default());
    if let Ok(reading) = read {
        assert_eq!(reading.clip.validate(), Ok(()));
    }
});
