//! Parts of Python wheels: downloaded by pip, checked against a pinned hash, unpacked in one step.

use std::{
    fs, io,
    path::{Component, Path, PathBuf},
    process::Command,
};

use anyhow::{Context, Result, bail};
use sha2::{Digest, Sha256};
use zip::ZipArchive;

/// Name of the file that records which wheel a folder was unpacked from.
const STAMP: &str = "wheel.sha256";

/// One file on PyPI.
#[derive(Clone, Copy)]
pub(crate) struct Wheel {
    /// pip's requirement, with its version.
    pub(crate) requirement: &'static str,
    /// pip's options that select this very file, whatever Python runs pip.
    pub(crate) selection: &'static [&'static str],
    /// SHA-256 of the file, in lower-case hex.
    pub(crate) sha256: &'static str,
}

/// Where a wheel's file goes: the path below the folder that is filled, or `None` to leave it out.
pub(crate) type Place = fn(name: &str) -> Option<PathBuf>;

impl Wheel {
    /// Makes `folder` hold the files of this wheel that `place` selects, and what `finish` adds to them.
    ///
    /// At once if it already does. Otherwise everything happens in a temporary folder beside it, which takes its name
    /// at the end, so that an interrupted run leaves nothing half done.
    pub(crate) fn ensure(
        &self,
        folder: &Path,
        place: Place,
        finish: impl Fn(&Path) -> Result<()>,
    ) -> Result<()> {
        if self.is_in(folder) {
            return Ok(());
        }
        eprintln!("fetching {} from PyPI", self.requirement);
        let parent = folder
            .parent()
            .context("a folder to unpack into needs a parent")?;
        fs::create_dir_all(parent).with_context(|| format!("cannot make {}", parent.display()))?;
        let work = tempfile::Builder::new()
            .prefix(".fetch-")
            .tempdir_in(parent)
            .with_context(|| format!("cannot make a temporary folder in {}", parent.display()))?;
        let wheel = self.download(&work.path().join("download"))?;
        let fresh = work.path().join("fresh");
        unpack(&wheel, &fresh, place)
            .with_context(|| format!("cannot unpack {}", self.requirement))?;
        finish(&fresh)?;
        fs::write(fresh.join(STAMP), self.sha256).context("cannot write the stamp")?;
        self.put_in_place(&fresh, folder, &work.path().join("old"))
    }

    /// Whether `folder` was filled from this very wheel.
    fn is_in(&self, folder: &Path) -> bool {
        fs::read_to_string(folder.join(STAMP)).is_ok_and(|stamp| stamp == self.sha256)
    }

    fn put_in_place(&self, fresh: &Path, folder: &Path, old: &Path) -> Result<()> {
        if folder.exists() {
            fs::rename(folder, old)
                .with_context(|| format!("cannot replace {}", folder.display()))?;
        }
        match fs::rename(fresh, folder) {
            // Another xtask was faster.
            Err(_) if self.is_in(folder) => Ok(()),
            result => {
                result.with_context(|| format!("cannot move the files to {}", folder.display()))
            }
        }
    }

    /// Downloads the wheel into `folder` and checks its hash.
    fn download(&self, folder: &Path) -> Result<PathBuf> {
        check_pip()?;
        let mut pip = python();
        pip.args([
            "-m",
            "pip",
            "download",
            "--quiet",
            "--disable-pip-version-check",
        ])
        .args(["--no-deps", "--only-binary=:all:"])
        .args(self.selection)
        .arg("--dest")
        .arg(folder)
        .arg(self.requirement);
        let status = pip.status().context("cannot start python3")?;
        if !status.success() {
            bail!(
                "pip could not download {} ({status}); its own message stands above. Is PyPI, or the index that pip is \
                 configured for, within reach?",
                self.requirement
            );
        }
        let wheel = only_file(folder)?;
        self.check(&wheel)?;
        Ok(wheel)
    }

    fn check(&self, wheel: &Path) -> Result<()> {
        let bytes = fs::read(wheel).with_context(|| format!("cannot read {}", wheel.display()))?;
        let found: String = Sha256::digest(&bytes)
            .iter()
            .map(|byte| format!("{byte:02x}"))
            .collect();
        if found != self.sha256 {
            bail!(
                "{} has the wrong SHA-256: expected {}, found {found}. The file is not the one that this workspace was \
                 tested with; nothing was unpacked. Check which package index pip uses (python3 -m pip config list)",
                wheel.file_name().unwrap_or_default().display(),
                self.sha256
            );
        }
        Ok(())
    }
}

/// `python3`, not yet told what to run.
pub(crate) fn python() -> Command {
    Command::new("python3")
}

/// Says what to install where Python or pip is missing.
fn check_pip() -> Result<()> {
    let output = match python().args(["-m", "pip", "--version"]).output() {
        Err(error) if error.kind() == io::ErrorKind::NotFound => {
            bail!(
                "python3 is not installed. Install Python 3 with pip (Debian, Ubuntu: apt install python3-pip)"
            )
        }
        other => other.context("cannot start python3")?,
    };
    if !output.status.success() {
        bail!(
            "python3 has no pip: {}\nInstall it (Debian, Ubuntu: apt install python3-pip; elsewhere: python3 -m ensurepip)",
            String::from_utf8_lossy(&output.stderr).trim()
        );
    }
    Ok(())
}

fn only_file(folder: &Path) -> Result<PathBuf> {
    let mut files =
        fs::read_dir(folder).with_context(|| format!("pip left no folder {}", folder.display()))?;
    match (files.next(), files.next()) {
        (Some(file), None) => Ok(file?.path()),
        _ => bail!("pip should have left one file in {}", folder.display()),
    }
}

/// Unpacks the files that `place` selects; an error if there is none.
fn unpack(wheel: &Path, folder: &Path, place: Place) -> Result<()> {
    let mut archive = ZipArchive::new(fs::File::open(wheel)?)?;
    let mut unpacked = 0;
    for index in 0..archive.len() {
        let mut file = archive.by_index(index)?;
        let name = file
            .name()
            .context("a file's name is unreadable")?
            .into_owned();
        let Some(path) = place(&name).filter(|_| file.is_file()) else {
            continue;
        };
        if !path
            .components()
            .all(|part| matches!(part, Component::Normal(_)))
        {
            bail!("the wheel's file {name} would leave its folder");
        }
        let path = folder.join(path);
        fs::create_dir_all(path.parent().context("a file without a folder")?)?;
        let mut out =
            fs::File::create(&path).with_context(|| format!("cannot write {}", path.display()))?;
        io::copy(&mut file, &mut out).with_context(|| format!("cannot unpack {name}"))?;
        unpacked += 1;
    }
    if unpacked == 0 {
        bail!("it holds none of the files that were expected in it");
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use zip::write::{SimpleFileOptions, ZipWriter};

    use super::*;

    const WHEEL: Wheel = Wheel {
        requirement: "thing==1",
        selection: &[],
        sha256: "00",
    };

    fn wheel(folder: &Path, names: &[&str]) -> PathBuf {
        let path = folder.join("thing.whl");
        let mut zip = ZipWriter::new(fs::File::create(&path).unwrap());
        for name in names {
            zip.start_file(*name, SimpleFileOptions::default()).unwrap();
            zip.write_all(name.as_bytes()).unwrap();
        }
        zip.finish().unwrap();
        path
    }

    fn below_lib(name: &str) -> Option<PathBuf> {
        name.strip_prefix("lib/").map(PathBuf::from)
    }

    #[test]
    fn unpacks_only_what_is_selected() {
        let dir = tempfile::tempdir().unwrap();
        let wheel = wheel(dir.path(), &["lib/a/b.txt", "other.txt"]);
        let out = dir.path().join("out");
        unpack(&wheel, &out, below_lib).unwrap();
        assert_eq!(
            fs::read_to_string(out.join("a/b.txt")).unwrap(),
            "lib/a/b.txt"
        );
        assert_eq!(fs::read_dir(&out).unwrap().count(), 1);
    }

    #[test]
    fn refuses_a_path_that_leaves_the_folder() {
        let dir = tempfile::tempdir().unwrap();
        let wheel = wheel(dir.path(), &["lib/../../evil.txt"]);
        let error = unpack(&wheel, &dir.path().join("out"), below_lib).unwrap_err();
        assert!(
            error.to_string().contains("would leave its folder"),
            "{error}"
        );
        assert!(!dir.path().join("evil.txt").exists());
    }

    #[test]
    fn refuses_a_wheel_without_the_expected_files() {
        let dir = tempfile::tempdir().unwrap();
        let wheel = wheel(dir.path(), &["other.txt"]);
        assert!(unpack(&wheel, &dir.path().join("out"), below_lib).is_err());
    }

    #[test]
    fn a_wrong_hash_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let wheel = wheel(dir.path(), &["lib/a.txt"]);
        let error = WHEEL.check(&wheel).unwrap_err().to_string();
        assert!(
            error.contains("expected 00, found ") && error.contains("thing.whl"),
            "{error}"
        );
    }

    #[test]
    fn a_filled_folder_is_left_alone_and_a_stale_one_replaced() {
        let dir = tempfile::tempdir().unwrap();
        let (folder, fresh, old) = (
            dir.path().join("folder"),
            dir.path().join("fresh"),
            dir.path().join("old"),
        );
        fs::create_dir(&folder).unwrap();
        fs::write(folder.join(STAMP), "stale").unwrap();
        assert!(!WHEEL.is_in(&folder));
        fs::create_dir(&fresh).unwrap();
        fs::write(fresh.join(STAMP), WHEEL.sha256).unwrap();
        WHEEL.put_in_place(&fresh, &folder, &old).unwrap();
        assert!(WHEEL.is_in(&folder));
        // Nothing can be downloaded for this wheel, so that this returns shows that nothing was tried.
        WHEEL.ensure(&folder, below_lib, |_| Ok(())).unwrap();
    }
}
