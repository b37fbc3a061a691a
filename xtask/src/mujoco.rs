//! MuJoCo's shared library, from its own PyPI wheel.

use std::{
    fs, io,
    path::{Path, PathBuf},
};

use anyhow::{Context, Result, bail, ensure};

use crate::{
    fetch::Wheel,
    workspace::{LINK_DIR, Workspace},
};

/// The version that mujoco-rs binds.
pub(crate) const VERSION: &str = "3.17.0";

const REQUIREMENT: &str = "mujoco==3.17.0";

/// The library's name to the linker.
const LINK_NAME: &str = if cfg!(target_os = "macos") {
    "libmujoco.dylib"
} else {
    "libmujoco.so"
};

/// The library's own name in the wheel.
const LIBRARY: &str = if cfg!(target_os = "macos") {
    "libmujoco.3.17.0.dylib"
} else {
    "libmujoco.so.3.17.0"
};

const LINUX_X86_64: Wheel = Wheel {
    requirement: REQUIREMENT,
    selection: &[
        "--platform=manylinux_2_28_x86_64",
        "--python-version=3.11",
        "--implementation=cp",
        "--abi=cp311",
    ],
    sha256: "d66928d86a2d1b601bbaa4dc11db50214d17d5301bb8afd84721313b67ff0874",
};

const LINUX_AARCH64: Wheel = Wheel {
    requirement: REQUIREMENT,
    selection: &[
        "--platform=manylinux_2_28_aarch64",
        "--python-version=3.11",
        "--implementation=cp",
        "--abi=cp311",
    ],
    sha256: "91a70ed9979c383ff1f5c03f25cc2e1280a8254c1a8e558d5dd7f4184f01efc9",
};

const MACOS_ARM64: Wheel = Wheel {
    requirement: REQUIREMENT,
    selection: &[
        "--platform=macosx_11_0_arm64",
        "--python-version=3.11",
        "--implementation=cp",
        "--abi=cp311",
    ],
    sha256: "6c324addca24a24a7b0beff2ec49300e9d4481fd8ccd611514ba7ea8e4a5e870",
};

/// Makes sure that builds and binaries find MuJoCo; returns the folder that holds its library.
pub(crate) fn ensure(workspace: &Workspace) -> Result<PathBuf> {
    let library = match workspace.own_mujoco() {
        Some(dir) => check_own(dir)?,
        None => fetch(workspace, std::env::consts::OS, std::env::consts::ARCH)?,
    };
    link(&library, &workspace.target().join(".mujoco"))?;
    Ok(library)
}

fn check_own(dir: PathBuf) -> Result<PathBuf> {
    ensure!(
        dir.is_absolute(),
        "{LINK_DIR}={} must be an absolute path",
        dir.display()
    );
    ensure!(
        dir.join(LINK_NAME).is_file(),
        "{LINK_DIR}={} holds no {LINK_NAME}. Point it at the lib folder of MuJoCo {VERSION}, or unset it to have MuJoCo \
         fetched into .mujoco/",
        dir.display()
    );
    Ok(dir)
}

fn fetch(workspace: &Workspace, os: &str, arch: &str) -> Result<PathBuf> {
    let folder = workspace.root().join(".mujoco");
    wheel(os, arch)?.ensure(&folder, place, |fresh| {
        symlink(Path::new(LIBRARY), &fresh.join("lib").join(LINK_NAME))
            .context("cannot link MuJoCo's library")
    })?;
    Ok(folder.join("lib"))
}

fn wheel(os: &str, arch: &str) -> Result<Wheel> {
    match (os, arch) {
        ("linux", "x86_64") => Ok(LINUX_X86_64),
        ("linux", "aarch64") => Ok(LINUX_AARCH64),
        ("macos", "aarch64") => Ok(MACOS_ARM64),
        _ => bail!(
            "no MuJoCo {VERSION} is pinned for {os} on {arch}. Install it yourself and set {LINK_DIR} to the folder with \
             its {LINK_NAME}"
        ),
    }
}

/// The library into `lib/`, its licences into `licenses/`.
fn place(name: &str) -> Option<PathBuf> {
    if name.strip_prefix("mujoco/") == Some(LIBRARY) {
        return Some(Path::new("lib").join(LIBRARY));
    }
    let (_, license) = name.split_once(".dist-info/licenses/")?;
    (!license.is_empty()).then(|| Path::new("licenses").join(license))
}

/// Makes `<target>/.mujoco/lib` point at the library in use: the first place where binaries look for it.
fn link(library: &Path, folder: &Path) -> Result<()> {
    let link = folder.join("lib");
    if fs::read_link(&link).is_ok_and(|target| target == library) {
        return Ok(());
    }
    fs::create_dir_all(folder).with_context(|| format!("cannot make {}", folder.display()))?;
    let fresh = folder.join(format!("lib-{}", std::process::id()));
    symlink(library, &fresh)
        .with_context(|| format!("cannot make the link {}", fresh.display()))?;
    fs::rename(&fresh, &link).with_context(|| format!("cannot make the link {}", link.display()))
}

#[cfg(unix)]
fn symlink(target: &Path, link: &Path) -> io::Result<()> {
    std::os::unix::fs::symlink(target, link)
}

#[cfg(not(unix))]
fn symlink(_target: &Path, _link: &Path) -> io::Result<()> {
    Err(io::Error::new(
        io::ErrorKind::Unsupported,
        "only Linux and macOS are supported",
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn takes_the_library_and_its_licences_only() {
        let library = format!("mujoco/{LIBRARY}");
        assert_eq!(place(&library), Some(Path::new("lib").join(LIBRARY)));
        let license = "mujoco-3.17.0.dist-info/licenses/LICENSE";
        assert_eq!(place(license), Some(PathBuf::from("licenses/LICENSE")));
        for other in [
            "mujoco/__init__.py",
            "mujoco/plugin/libsensor.so",
            "mujoco-3.17.0.dist-info/licenses/",
        ] {
            assert_eq!(place(other), None, "{other}");
        }
    }

    #[test]
    fn an_unsupported_platform_is_told_what_to_do() {
        let error = wheel("haiku", "riscv64").err().unwrap().to_string();
        assert!(
            error.contains("haiku on riscv64") && error.contains(LINK_DIR),
            "{error}"
        );
    }

    #[test]
    fn a_users_own_folder_must_hold_the_library() {
        let dir = tempfile::tempdir().unwrap();
        let error = check_own(dir.path().to_path_buf()).unwrap_err().to_string();
        assert!(error.contains(LINK_NAME), "{error}");
        fs::write(dir.path().join(LINK_NAME), "").unwrap();
        assert_eq!(check_own(dir.path().to_path_buf()).unwrap(), dir.path());
        assert!(check_own(PathBuf::from("lib")).is_err());
    }

    #[test]
    fn the_link_follows_the_library_in_use() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join(".mujoco");
        for library in ["one", "two"] {
            let library = dir.path().join(library);
            link(&library, &folder).unwrap();
            assert_eq!(fs::read_link(folder.join("lib")).unwrap(), library);
        }
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 1);
    }
}
