//! The wire contract: the messages and services of package `emp.v1`, generated from the `.proto` files of this crate.
//!
//! It holds generated code and descriptors only. What the fields mean is said in the `.proto` files and repeated in the
//! documentation here. It never validates, converts or names another crate of the project.

#![forbid(unsafe_code)]

/// The encoded `FileDescriptorSet` of the package and its imports, comments included: what reflection serves.
pub const FILE_DESCRIPTOR_SET: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/descriptors.bin"));

/// Package `emp.v1`.
#[allow(
    unused_qualifications,
    clippy::doc_markdown,
    clippy::large_enum_variant,
    reason = "generated; the comments are written for gRPC users of any language"
)]
pub mod v1 {
    tonic::include_proto!("emp.v1");
}

#[cfg(test)]
mod tests {
    use prost::Message as _;
    use prost_types::{FileDescriptorSet, ServiceDescriptorProto};

    use super::*;

    #[test]
    fn descriptors_hold_the_services_and_their_comments() {
        let set = FileDescriptorSet::decode(FILE_DESCRIPTOR_SET).expect("a descriptor set");
        let services: Vec<_> = set
            .file
            .iter()
            .filter(|file| file.package() == "emp.v1")
            .flat_map(|file| file.service.iter().map(ServiceDescriptorProto::name))
            .collect();
        assert_eq!(
            services,
            [
                "ModelService",
                "MotionService",
                "RolloutService",
                "TeleoperationService"
            ]
        );

        let pose = set
            .file
            .iter()
            .find(|file| file.name() == "emp/v1/pose.proto")
            .expect("pose.proto");
        let comments: Vec<_> = pose
            .source_code_info
            .iter()
            .flat_map(|info| &info.location)
            .filter_map(|location| location.leading_comments.as_deref())
            .collect();
        assert!(
            comments
                .iter()
                .any(|text| text.contains("Centre of the left elbow; metres"))
        );
    }
}
