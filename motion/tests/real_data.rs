//! Every recording of the folder that `EMP_MOTIONS` names: readable, plausible, the right way round.

use std::path::PathBuf;

use emp_motion::{Clip, KeyNode, Side, load, load_dir};

fn folder() -> Option<PathBuf> {
    let folder = std::env::var_os("EMP_MOTIONS").map(PathBuf::from);
    if folder.is_none() {
        println!("skipped: EMP_MOTIONS does not name a folder of recordings");
    }
    folder
}

fn mean(clip: &Clip, value: impl Fn(&emp_motion::KeyNodeFrame) -> f32) -> f32 {
    clip.frames.iter().map(value).sum::<f32>() / clip.frames.len() as f32
}

#[test]
fn recordings_are_plausible_bodies() {
    let Some(folder) = folder() else { return };
    let clips = load_dir(&folder).expect("every file is readable");
    for clip in &clips {
        let name = &clip.name;
        assert_eq!(clip.validate(), Ok(()), "{name}");
        let lengths = clip.frames[0].bone_lengths();
        for side in 0..2 {
            assert!(
                (0.2..0.4).contains(&lengths.upper_arm[side]),
                "{name}: {lengths:?}"
            );
            assert!(
                (0.15..0.4).contains(&lengths.forearm[side]),
                "{name}: {lengths:?}"
            );
        }
        let left = mean(clip, |f| f.position(KeyNode::LeftShoulder).y);
        let right = mean(clip, |f| f.position(KeyNode::RightShoulder).y);
        assert!(
            left > 0.05 && right < -0.05,
            "{name}: left is left ({left}, {right})"
        );
        assert!(
            mean(clip, |f| f.position(KeyNode::LeftShoulder).z) > 0.15,
            "{name}: up is up"
        );
        let ahead = |side: Side| mean(clip, |f| f.forearm(side).x);
        assert!(
            ahead(Side::Left) + ahead(Side::Right) > 0.0,
            "{name}: forearms point forward on average"
        );
    }
    println!("{} recordings checked", clips.len());
}

#[test]
fn recordings_resample_without_new_jumps() {
    let Some(folder) = folder() else { return };
    for clip in load_dir(&folder).expect("every file is readable") {
        let resampled = clip.resampled(50.0).expect("an ordinary rate");
        assert_eq!(resampled.validate(), Ok(()), "{}", clip.name);
        assert!(
            (resampled.duration() - clip.duration()).abs() < 0.021,
            "{}",
            clip.name
        );
        let fastest = |clip: &Clip| {
            let step = |w: &[emp_motion::KeyNodeFrame]| {
                (w[1].position(KeyNode::LeftWrist) - w[0].position(KeyNode::LeftWrist)).norm()
            };
            clip.frames.windows(2).map(step).fold(0.0, f32::max) * clip.fps as f32
        };
        assert!(
            fastest(&resampled) < 1.25 * fastest(&clip) + 0.05,
            "{}: {} of {}",
            clip.name,
            fastest(&resampled),
            fastest(&clip)
        );
    }
}

#[test]
fn a_folder_without_motions_is_an_error() {
    let folder = tempfile::tempdir().expect("temporary folder");
    assert!(
        load_dir(folder.path())
            .expect_err("empty")
            .to_string()
            .contains("no .bvh, .c3d, .mvnx or .npz")
    );
    assert!(
        load(&folder.path().join("missing.bvh"))
            .expect_err("missing")
            .to_string()
            .contains("missing.bvh")
    );
    assert!(
        load(&folder.path().join("clip.fbx"))
            .expect_err("format")
            .to_string()
            .contains("expected a .bvh, .c3d, .mvnx or .npz")
    );
}
