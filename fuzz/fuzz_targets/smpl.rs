//! The SMPL family's reader answers any archive, and any `poses` array in an archive that is right otherwise.
#![no_main]

#[path = "../src/archive.rs"]
mod archive;

use std::path::Path;

use emp_motion::{ReadOptions, smpl};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    check(data);
    check(&archive::stored(&[
        (
            "mocap_framerate",
            &archive::npy("'<f8'", "()", &100_f64.to_le_bytes()),
        ),
        ("poses", data),
    ]));
});

fn check(archive: &[u8]) {
    let read = smpl::from_bytes(Path::new("fuzz.npz"), archive, &ReadOptions::default());
    if let Ok(reading) = read {
        assert_eq!(reading.clip.validate(), Ok(()));
    }
}
