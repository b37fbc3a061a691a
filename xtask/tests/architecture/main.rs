//! The shape of the code: which crate may use which, and no circles between the modules of a crate.
//!
//! A module uses another if it names something that is defined there. Names are followed through imports and re-exports to
//! the module that defines them; a re-export itself uses nothing, and code that is only compiled for tests does not count.

#![allow(
    clippy::unwrap_used,
    reason = "a source that cannot be read must fail the test"
)]

mod graph;

use std::{
    collections::BTreeSet,
    fs,
    path::{Path, PathBuf},
};

use graph::ModuleGraph;

/// The product's crates by folder, each with those that it may depend on.
const ALLOWED: [(&str, &[&str]); 9] = [
    ("proto", &[]),
    ("robot", &[]),
    ("motion", &[]),
    ("models", &["robot", "motion"]),
    ("sim", &["models", "robot", "motion"]),
    ("client", &["motion", "proto"]),
    ("server", &["sim", "models", "robot", "motion", "proto"]),
    ("training", &["client", "sim", "models", "robot", "motion"]),
    ("demo", &["client", "sim", "models", "robot", "motion"]),
];

/// Crates that know nothing of the wire, and the libraries that they never name.
const OFFLINE: [&str; 4] = ["robot", "motion", "models", "sim"];
const WIRE: [&str; 3] = ["tonic", "prost", "tokio"];

/// Circles that are still to be broken: the crate's folder, and how the names of their modules begin.
const KNOWN: [(&str, &str); 2] = [("server", "rollouts"), ("server", "teleoperation")];

/// Where a crate's module tree can start.
const ROOTS: [&str; 2] = ["src/lib.rs", "src/main.rs"];

fn workspace() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .parent()
        .unwrap()
        .to_path_buf()
}

/// Names of all dependencies of the crate in `folder`, those of its tests excluded.
fn dependencies(folder: &str) -> BTreeSet<String> {
    let file = workspace().join(folder).join("Cargo.toml");
    let text = fs::read_to_string(&file).unwrap();
    let manifest: toml::Table = text.parse().unwrap();
    ["dependencies", "build-dependencies"]
        .iter()
        .filter_map(|section| manifest.get(*section)?.as_table())
        .flat_map(|table| table.keys().cloned())
        .collect()
}

#[test]
fn crates_use_only_what_is_below_them() {
    for (folder, allowed) in ALLOWED {
        for dependency in dependencies(folder) {
            let Some(used) = dependency.strip_prefix("emp-") else {
                continue;
            };
            assert!(
                allowed.contains(&used),
                "{folder}/Cargo.toml depends on {dependency}; allowed are {allowed:?}"
            );
        }
    }
}

#[test]
fn crates_below_the_server_know_nothing_of_the_wire() {
    for folder in OFFLINE {
        for dependency in dependencies(folder) {
            assert!(
                !WIRE.iter().any(|library| dependency.starts_with(library)),
                "{folder}/Cargo.toml depends on {dependency}"
            );
        }
    }
}

#[test]
fn modules_form_no_circles() {
    let mut circles = Vec::new();
    for (folder, _) in ALLOWED {
        for root in ROOTS {
            let root = workspace().join(folder).join(root);
            if root.is_file() {
                let is_known = |circle: &String| {
                    let mut known = KNOWN.iter();
                    known.any(|(of, module)| *of == folder && circle.starts_with(module))
                };
                let mut found = ModuleGraph::read(&root).circles();
                found.retain(|circle| !is_known(circle));
                circles.extend(
                    found
                        .into_iter()
                        .map(|circle| format!("{folder}: {circle}")),
                );
            }
        }
    }
    assert!(
        circles.is_empty(),
        "modules that use each other:\n{}",
        circles.join("\n")
    );
}

/// A crate of files in a temporary folder, and the circles of its modules.
fn circles_of(files: &[(&str, &str)]) -> Vec<String> {
    let folder = tempfile::tempdir().unwrap();
    for (name, text) in files {
        let file = folder.path().join(name);
        fs::create_dir_all(file.parent().unwrap()).unwrap();
        fs::write(file, text).unwrap();
    }
    ModuleGraph::read(&folder.path().join("lib.rs")).circles()
}

#[test]
fn a_circle_is_named() {
    let circles = circles_of(&[
        ("lib.rs", "mod a; mod b; mod c;"),
        ("a.rs", "use crate::b::B; pub struct A(B);"),
        ("b.rs", "use super::c; pub struct B(c::C);"),
        (
            "c.rs",
            "pub struct C; fn f() { let x = crate::a::A::new(); }",
        ),
    ]);
    assert_eq!(circles, ["a uses b::B, b uses c::C, c uses a::A"]);
}

#[test]
fn names_are_followed_through_re_exports_globs_and_macros() {
    let circles = circles_of(&[
        ("lib.rs", "mod a; mod b; pub use a::A;"),
        (
            "a/mod.rs",
            "mod inner; pub use inner::*; fn f() { println!(\"{}\", crate::b::B); }",
        ),
        ("a/inner.rs", "pub struct A;"),
        ("b.rs", "use crate::*; pub struct B(A);"),
    ]);
    // b's A is the one of a::inner, which uses nothing; a uses b.
    assert_eq!(circles, Vec::<String>::new());
    let circles = circles_of(&[
        ("lib.rs", "mod a; mod b; pub use a::A;"),
        (
            "a/mod.rs",
            "pub struct A; fn f() { println!(\"{}\", crate::b::B); }",
        ),
        ("b.rs", "use crate::*; pub struct B(A);"),
    ]);
    assert_eq!(circles, ["a uses b::B, b uses a::A"]);
}

#[test]
fn types_that_macros_define_have_a_home() {
    let circles = circles_of(&[
        ("lib.rs", "mod a; mod b;"),
        (
            "a.rs",
            "macro_rules! make { () => { pub struct A(crate::b::B); } } make! {}",
        ),
        ("b.rs", "use crate::a::A; pub struct B(A);"),
    ]);
    assert_eq!(circles, ["a uses b::B, b uses a::A"]);
}

#[test]
fn what_only_tests_use_does_not_count() {
    let circles = circles_of(&[
        ("lib.rs", "mod a; mod b;"),
        (
            "a.rs",
            "pub struct A; #[cfg(test)] mod tests { use crate::b::B; }",
        ),
        ("b.rs", "use crate::a::A; pub struct B(A);"),
    ]);
    assert_eq!(circles, Vec::<String>::new());
}
