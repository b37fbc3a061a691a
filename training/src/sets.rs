//! What motion is for: to train on, to choose by (filters, gates, weights), or for the tables of results. The three never mix.
//!
//! Recordings are of the set that their folder is named after; procedural motion is of the set that its seed belongs to.
//! Everything else that is random in a report (loads, pushes, randomisation) follows from the same seed.

use std::{
    collections::HashSet,
    fmt,
    path::{Path, PathBuf},
};

use anyhow::{Context as _, Result, bail, ensure};
use emp_sim::goals::GoalClip;
use serde::Serialize;

/// Seeds of trainings are below this, those of the other sets are not.
const TRAINING_SEEDS: u64 = 1 << 32;

/// Seed of the clips by which a policy's weights are chosen in training.
pub const POLICY_JUDGE_SEED: u64 = 0x6865_6c64_5f6f_7574;

/// Seed of the clips by which an EMP's weights are chosen in training.
pub const EMP_JUDGE_SEED: u64 = 0x656d_705f_6865_6c64;

/// Folders within folders that are looked into.
const DEPTH: usize = 32;

/// What motion is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
pub enum MotionSet {
    /// To train on; folders named `train`.
    Train,
    /// To choose filters, gates, conditions and weights by; folders named `development` or `test`.
    Development,
    /// For tables of results, and nothing else; folders named `final`.
    Final,
}

impl MotionSet {
    /// The seed of a report on this set.
    pub fn seed(self) -> u64 {
        match self {
            Self::Train => 7,
            Self::Development => 0x7265_706f_7274,
            Self::Final => 0x0066_696e_616c,
        }
    }

    /// The set that a file or folder is of by the innermost folder that is named after one; none if there is none.
    pub fn of_path(path: &Path) -> Option<Self> {
        let mut names = path.iter().rev().filter_map(|name| name.to_str());
        names.find_map(|name| match name {
            "train" => Some(Self::Train),
            "development" | "test" => Some(Self::Development),
            "final" => Some(Self::Final),
            _ => None,
        })
    }

    /// Refuses folders and files of recorded motion that are, or hold, another set's. Those of no set are anybody's, but for
    /// [`Final`](Self::Final): it must be named.
    ///
    /// # Errors
    /// Names the path, and the set that it is of.
    pub fn check(self, paths: &[PathBuf]) -> Result<()> {
        for path in paths {
            let full = path.canonicalize();
            let full = full.with_context(|| format!("reading {}", path.display()))?;
            ensure!(
                self != Self::Final || Self::of_path(&full).is_some(),
                "{}: motion of the final set is expected in a folder named `final`",
                path.display()
            );
            self.check_under(&full, DEPTH)?;
        }
        Ok(())
    }

    fn check_under(self, path: &Path, depth: usize) -> Result<()> {
        if let Some(set) = Self::of_path(path).filter(|set| *set != self) {
            bail!(
                "{}: motion of the {set} set, expected the {self} set",
                path.display()
            );
        }
        if depth == 0 || !path.is_dir() {
            return Ok(());
        }
        let reading = || format!("reading {}", path.display());
        for entry in path.read_dir().with_context(reading)? {
            let entry = entry.with_context(reading)?.path();
            if entry.is_dir() {
                self.check_under(&entry, depth - 1)?;
            }
        }
        Ok(())
    }
}

impl fmt::Display for MotionSet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Train => "train",
            Self::Development => "development",
            Self::Final => "final",
        })
    }
}

/// Refuses a seed for a training's procedural motion that is another set's.
///
/// # Errors
/// Names the seed and the largest that may be.
pub fn check_training_seed(seed: u64) -> Result<()> {
    ensure!(
        seed < TRAINING_SEEDS,
        "seed {seed}: expected less than {TRAINING_SEEDS}; larger ones are of the development and final sets"
    );
    Ok(())
}

/// Clips of one kind of motion, which tables give a row of its own.
pub struct ClipGroup {
    /// The kind.
    pub name: &'static str,
    /// The clips.
    pub clips: Vec<GoalClip>,
}

impl ClipGroup {
    /// Recordings of people whose faster hand moves at less than 0.2 m/s on average.
    pub const SLOW: &'static str = "slow recordings";
    /// Other recordings.
    pub const LIVELY: &'static str = "lively recordings";
    /// Procedural motion.
    pub const PROCEDURAL: &'static str = "procedural";
}

/// What a report rests on.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Basis {
    /// The set.
    pub set: MotionSet,
    /// Seed of procedural motion, loads, pushes and randomisation.
    pub seed: u64,
    /// The kinds of motion.
    pub groups: Vec<GroupSize>,
}

/// How much there is of a kind of motion.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct GroupSize {
    /// The kind.
    pub name: &'static str,
    /// Number of clips.
    pub clips: usize,
    /// Number of recordings or procedural motions that they are pieces of: the independent units.
    pub motions: usize,
}

impl Basis {
    /// Of a report on these clips.
    pub fn new(set: MotionSet, groups: &[ClipGroup]) -> Self {
        let size = |group: &ClipGroup| {
            let motions = group.clips.iter().map(|clip| &clip.motion);
            GroupSize {
                name: group.name,
                clips: group.clips.len(),
                motions: motions.collect::<HashSet<_>>().len(),
            }
        };
        Self {
            set,
            seed: set.seed(),
            groups: groups.iter().map(size).collect(),
        }
    }
}

impl fmt::Display for Basis {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "the {} set, seed {}: ", self.set, self.seed)?;
        let size = |group: &GroupSize| {
            let GroupSize {
                name,
                clips,
                motions,
            } = group;
            format!("{clips} clips of {motions} motions ({name})")
        };
        let sizes: Vec<String> = self.groups.iter().map(size).collect();
        f.write_str(&sizes.join(", "))
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use emp_motion::skills;

    use super::*;

    const SETS: [MotionSet; 3] = [MotionSet::Train, MotionSet::Development, MotionSet::Final];

    #[test]
    fn no_seed_and_no_procedural_motion_is_in_two_sets() {
        let seeds = [
            (MotionSet::Train, 1),
            (MotionSet::Train, MotionSet::Train.seed()),
            (MotionSet::Development, MotionSet::Development.seed()),
            (MotionSet::Development, POLICY_JUDGE_SEED),
            (MotionSet::Development, EMP_JUDGE_SEED),
            (MotionSet::Final, MotionSet::Final.seed()),
        ];
        let mut owners: HashMap<String, MotionSet> = HashMap::new();
        for (set, seed) in seeds {
            let is_for_training = check_training_seed(seed).is_ok();
            assert_eq!(is_for_training, set == MotionSet::Train, "{seed}");
            for clip in skills::library(seed, 12) {
                // A procedural motion's name has its own seed.
                let owner = *owners.entry(clip.name.clone()).or_insert(set);
                assert_eq!(owner, set, "{}", clip.name);
            }
        }
    }

    #[test]
    fn folders_tell_their_set_and_others_are_refused() {
        let data = tempfile::tempdir().unwrap();
        let folder = |name: &str| {
            let path = data.path().join(name);
            std::fs::create_dir_all(&path).unwrap();
            path
        };
        let (train, test) = (folder("train/walk"), folder("test/walk"));
        let (last, own) = (folder("final/walk"), folder("own"));
        let ok = |set: MotionSet, path: &PathBuf| set.check(std::slice::from_ref(path));
        for (set, path) in SETS.into_iter().zip([&train, &test, &last]) {
            for other in SETS {
                assert_eq!(ok(other, path).is_ok(), other == set, "{other} {path:?}");
            }
            // What holds other sets is none.
            let error = ok(set, &data.path().to_owned()).unwrap_err().to_string();
            assert!(error.contains("expected"), "{error}");
        }
        assert!(ok(MotionSet::Train, &own).is_ok() && ok(MotionSet::Development, &own).is_ok());
        let error = ok(MotionSet::Final, &own).unwrap_err().to_string();
        assert!(error.contains("named `final`"), "{error}");
        let error = ok(MotionSet::Train, &data.path().join("none")).unwrap_err();
        assert!(error.to_string().contains("none"), "{error}");
    }

    /// Every file under a folder.
    fn files(folder: &Path, found: &mut Vec<PathBuf>) {
        for entry in folder.read_dir().unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                files(&path, found);
            } else {
                found.push(path);
            }
        }
    }

    #[test]
    fn no_recording_is_in_two_sets() {
        let Some(folder) = std::env::var_os("EMP_MOTIONS") else {
            println!("skipped: EMP_MOTIONS does not name a folder of recordings");
            return;
        };
        let mut found = Vec::new();
        files(Path::new(&folder), &mut found);
        let mut owners: HashMap<Vec<u8>, (MotionSet, PathBuf)> = HashMap::new();
        let mut names: HashMap<String, MotionSet> = HashMap::new();
        for path in found {
            let Some(set) = MotionSet::of_path(&path) else {
                continue;
            };
            let contents = std::fs::read(&path).unwrap();
            let (owner, other) = owners
                .entry(contents)
                .or_insert_with(|| (set, path.clone()));
            assert_eq!(*owner, set, "{path:?} is {other:?}");
            let parts: Vec<_> = path.iter().rev().take(2).collect();
            let name = format!("{parts:?}");
            assert_eq!(*names.entry(name).or_insert(set), set, "{path:?}");
        }
        println!("{} recordings", names.len());
    }
}
