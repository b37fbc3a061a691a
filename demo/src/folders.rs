//! Where robots, weights and the server are.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};

/// The project's folders, and the server's binary.
pub(crate) struct Folders {
    /// One folder a robot.
    pub(crate) robots: PathBuf,
    /// One file a model.
    pub(crate) weights: PathBuf,
    /// `emp-server`, beside this binary.
    pub(crate) server: PathBuf,
}

impl Folders {
    /// Takes the nearest folder upward from this binary, then from the working directory, that has `robots` and
    /// `models/weights`: the rule of `emp-server`. The weights may stand elsewhere.
    pub(crate) fn find(weights: Option<&Path>) -> Result<Self> {
        let exe = std::env::current_exe().context("cannot tell where emp-demo itself stands")?;
        let here = std::env::current_dir().context("there is no working directory")?;
        let root = exe
            .ancestors()
            .chain(here.ancestors())
            .find(|folder| has_models(folder))
            .context("found no folder with robots/ and models/weights/, neither above emp-demo nor above the working directory")?;
        let server = exe.with_file_name(format!("emp-server{}", std::env::consts::EXE_SUFFIX));
        Ok(Self {
            robots: root.join("robots"),
            weights: weights.map_or_else(|| root.join("models/weights"), Path::to_owned),
            server,
        })
    }

    /// A robot's folder.
    pub(crate) fn robot(&self, name: &str) -> Result<PathBuf> {
        let folders = emp_robot::robot_folders(&self.robots)?;
        let names: Vec<_> = folders
            .iter()
            .filter_map(|folder| folder.file_name())
            .collect();
        match names.iter().position(|known| *known == name) {
            Some(index) => Ok(folders[index].clone()),
            None => bail!(
                "there is no robot {name:?} in {}; there are {names:?}",
                self.robots.display()
            ),
        }
    }
}

fn has_models(folder: &Path) -> bool {
    folder.join("robots").is_dir() && folder.join("models/weights").is_dir()
}
