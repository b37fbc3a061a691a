//! The key-node reader answers any archive, and any `nodes` and `pos` arrays in an archive that is right otherwise.
#![no_main]

#[path = "../src/archive.rs"]
mod archive;

use std::path::Path;

use emp_motion::{ReadOptions, key_nodes};
use libfuzzer_sys::fuzz_target;

const NODES: [&str; 8] = [
    "sternum",
    "clav_mid",
    "L_shoulder",
    "L_elbow",
    "L_wrist",
    "R_shoulder",
    "R_elbow",
    "R_wrist",
];

fuzz_target!(|data: &[u8]| {
    check(data);
    let fps = archive::npy("'<f8'", "()", &100_f64.to_le_bytes());
    let names: Vec<u8> = NODES
        .iter()
        .flat_map(|n| format!("{n:\0<10}").into_bytes())
        .collect();
    let nodes = archive::npy("'|S10'", "(8,)", &names);
    check(&archive::stored(&[
        ("fps", &fps),
        ("nodes", &nodes),
        ("pos", data),
    ]));
    check(&archive::stored(&[
        ("fps", &fps),
        ("nodes", data),
        ("pos", &archive::npy("'<f4'", "(1, 8, 3)", &[0; 96])),
    ]));
});

fn check(archive: &[u8]) {
    let read = key_nodes::from_bytes(Path::new("fuzz.npz"), archive, &ReadOptions::default());
    if let Ok(reading) = read {
        assert_eq!(reading.clip.validate(), Ok(()));
    }
}
