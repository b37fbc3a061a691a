//! The MVNX reader answers any bytes with a valid clip or an error.
#![no_main]

use std::path::Path;

use emp_motion::{ReadOptions, mvnx};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let read = mvnx::from_bytes(Path::new("fuzz.mvnx"), data, &ReadOptions::default());
    if let Ok(reading) = read {
        assert_eq!(reading.clip.validate(), Ok(()));
    }
});
