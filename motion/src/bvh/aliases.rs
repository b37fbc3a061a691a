//! Joint names of the skeletons that BVH files come with. A new naming scheme is a new row here.
//!
//! Names are compared in lower case without separators (`upper_arm.L` is `upperarml`), with and without the prefix that
//! all joints share (`mixamorig:`, `Bip01 `).

/// Shoulder, elbow and wrist of one arm; earlier rows win.
pub(super) struct ArmScheme {
    pub(super) shoulder: &'static str,
    pub(super) elbow: &'static str,
    /// Any of these; where none is there, the wrist is the end of the elbow's bone.
    pub(super) wrist: &'static [&'static str],
}

/// Names with `@` for the side, which is written as in [`SIDES`].
pub(super) const ARMS: &[ArmScheme] = &[
    // CMU as converted by cgspeed, MotionBuilder, Mixamo.
    ArmScheme {
        shoulder: "@arm",
        elbow: "@forearm",
        wrist: &["@hand"],
    },
    // Poser-friendly conversions, SMPL. The collar is called shoulder in the scheme above, hence the order.
    ArmScheme {
        shoulder: "@shoulder",
        elbow: "@elbow",
        wrist: &["@wrist", "@hand"],
    },
    // Blender, Unreal, 3ds Max Biped, Xsens, VRM.
    ArmScheme {
        shoulder: "@upperarm",
        elbow: "@forearm",
        wrist: &["@hand", "@wrist"],
    },
    ArmScheme {
        shoulder: "@upperarm",
        elbow: "@lowerarm",
        wrist: &["@hand", "@wrist"],
    },
    // Acclaim skeletons.
    ArmScheme {
        shoulder: "@humerus",
        elbow: "@radius",
        wrist: &["@wrist", "@hand"],
    },
    // Poser, DAZ.
    ArmScheme {
        shoulder: "@shldr",
        elbow: "@forearm",
        wrist: &["@hand"],
    },
    ArmScheme {
        shoulder: "@shldrbend",
        elbow: "@forearmbend",
        wrist: &["@hand"],
    },
    ArmScheme {
        shoulder: "@uparm",
        elbow: "@lowarm",
        wrist: &["@hand", "@wrist"],
    },
];

/// The hip joint (top of the thigh), `@` for the side.
pub(super) const HIPS: &[&str] = &[
    "@upleg",
    "@hip",
    "@thigh",
    "@upperleg",
    "@femur",
    "@thighbend",
];

/// The pelvis; where none is there, the root.
pub(super) const WAIST: &[&str] = &["hips", "pelvis", "hip", "hipcenter"];

/// How left and right are written, before or after the joint's name.
pub(super) const SIDES: [&[&str]; 2] = [&["left", "l"], &["right", "r"]];

/// Part of the name of a joint on the thumb.
pub(super) const THUMB: &str = "thumb";
