//! Compiles the `.proto` files without protoc: messages, client and server code, and the descriptors that reflection
//! serves (with source info, so that the comments reach grpcurl).

use std::{env, error::Error, fs, path::PathBuf};

use prost::Message as _;

const FILES: [&str; 8] = [
    "emp/v1/filter.proto",
    "emp/v1/frame.proto",
    "emp/v1/model_service.proto",
    "emp/v1/motion_service.proto",
    "emp/v1/pose.proto",
    "emp/v1/robot_state.proto",
    "emp/v1/rollout_service.proto",
    "emp/v1/teleoperation_service.proto",
];

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo::rerun-if-changed=proto");
    let descriptors = protox::compile(FILES, ["proto"])?;
    let out = PathBuf::from(env::var("OUT_DIR")?).join("descriptors.bin");
    fs::write(out, descriptors.encode_to_vec())?;
    tonic_prost_build::configure()
        .emit_rerun_if_changed(false)
        .compile_fds(descriptors)?;
    Ok(())
}
