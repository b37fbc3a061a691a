//! The BVH reader answers any bytes with a valid clip or an error.
#![no_main]

use std::path::Path;

use emp_motion::{BvhOptions, bvh};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    if let Ok(clip) = bvh::from_bytes(Path::new("fuzz.bvh"), data, &BvhOptions::default()) {
        assert_eq!(clip.validate(), Ok(()));
    }
});
