//! Robots that are other people's: fetched from a package, never committed.

use std::path::PathBuf;

use anyhow::Result;
use clap::ValueEnum;

use crate::{fetch::Wheel, workspace::Workspace};

/// A robot whose model comes from a package.
#[derive(Clone, Copy, PartialEq, Eq, Debug, ValueEnum)]
pub(crate) enum FetchedRobot {
    /// Unitree G1, as mjlab ships it.
    G1,
}

const MJLAB: Wheel = Wheel {
    requirement: "mjlab==1.6.0",
    // A wheel for any platform; the version named only makes pip of an older Python take it too.
    selection: &["--platform=any", "--python-version=3.12"],
    sha256: "03d003854e2f44c48330c6dcf4c2253ff7641bb569747846825a21b9efa8540b",
};

impl FetchedRobot {
    /// Its name in `robots/` and on the command line.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::G1 => "g1",
        }
    }

    /// The fetched robot of this name, if it is one.
    pub(crate) fn by_name(name: &str) -> Option<Self> {
        Self::value_variants()
            .iter()
            .copied()
            .find(|robot| robot.name() == name)
    }
}

/// Makes sure that the robot's model is in `.robots/`; returns its folder.
pub(crate) fn ensure(workspace: &Workspace, robot: FetchedRobot) -> Result<PathBuf> {
    let folder = workspace.root().join(".robots").join(robot.name());
    match robot {
        FetchedRobot::G1 => MJLAB.ensure(&folder, place_g1, |_| Ok(()))?,
    }
    Ok(folder)
}

/// The model and its meshes as they stand in mjlab, and mjlab's licence.
fn place_g1(name: &str) -> Option<PathBuf> {
    let file = name
        .strip_prefix("mjlab/asset_zoo/robots/unitree_g1/xmls/")
        .or_else(|| {
            name.split_once(".dist-info/licenses/")
                .map(|(_, license)| license)
        })?;
    (!file.is_empty()).then(|| PathBuf::from(file))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn takes_the_model_its_meshes_and_the_licence_only() {
        let model = "mjlab/asset_zoo/robots/unitree_g1/xmls";
        assert_eq!(
            place_g1(&format!("{model}/g1.xml")),
            Some(PathBuf::from("g1.xml"))
        );
        assert_eq!(
            place_g1(&format!("{model}/assets/pelvis.STL")),
            Some(PathBuf::from("assets/pelvis.STL"))
        );
        assert_eq!(
            place_g1("mjlab-1.6.0.dist-info/licenses/LICENSE"),
            Some(PathBuf::from("LICENSE"))
        );
        for other in [
            "mjlab/asset_zoo/robots/unitree_g1/__init__.py",
            "mjlab/viewer/native.py",
        ] {
            assert_eq!(place_g1(other), None, "{other}");
        }
    }

    #[test]
    fn names_are_those_of_the_command_line() {
        for &robot in FetchedRobot::value_variants() {
            assert_eq!(FetchedRobot::by_name(robot.name()), Some(robot));
            assert_eq!(FetchedRobot::from_str(robot.name(), false), Ok(robot));
        }
        assert_eq!(FetchedRobot::by_name("emp27"), None);
    }
}
