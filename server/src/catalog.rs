//! What the server serves: robots, and for each its models behind their queues. Models can be loaded anew while it serves; streams
//! that are open keep the version that they began with.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    sync::{Arc, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard, Weak},
};

use emp_models::{
    emp::Emp,
    policy::Policy,
    retarget::{RetargetInput, RetargetOutput, Retargeter},
};
use emp_proto::v1::{self, ModelKind};
use emp_robot::{Robot, RobotError, robot_folders};
use tokio::sync::watch;

use crate::{
    encode,
    error::{ServiceError, shortened},
    inference::{
        backend::{BackendError, Build, from_memory},
        batcher::{Batcher, Limits, ModelState},
        controllers::{ControlInput, Controllers, FilterOutput, Filters, PolicyOutput},
    },
    settings::{BatchingSettings, Settings},
};

/// A model behind its queue.
pub(crate) struct Served<I, O, M> {
    pub(crate) card: v1::Model,
    pub(crate) robot: Arc<Robot>,
    pub(crate) batcher: Batcher<I, O>,
    /// The model itself, for jobs, which compute on threads of their own.
    pub(crate) model: M,
}

/// A retargeting model; the retargeter itself where it is not a test's.
pub(crate) type RetargetModel = Served<RetargetInput, RetargetOutput, Option<Arc<Retargeter>>>;

/// A policy, alone and behind the robot's EMP, where it has one.
pub(crate) type PolicyModel = Served<ControlInput, PolicyOutput, Controllers>;

/// An EMP.
pub(crate) type FilterModel = Served<ControlInput, FilterOutput, Filters>;

/// The models of one kind, by name.
struct Shelf<I, O, M>(BTreeMap<String, Versions<I, O, M>>);

/// A model's versions: the one that serves everybody who comes, and those that open streams still hold.
struct Versions<I, O, M> {
    current: Arc<Served<I, O, M>>,
    older: Vec<Weak<Served<I, O, M>>>,
}

impl<I, O, M> Default for Shelf<I, O, M> {
    fn default() -> Self {
        Self(BTreeMap::new())
    }
}

impl<I: Send + 'static, O: Send + 'static, M> Shelf<I, O, M> {
    fn current(&self) -> impl Iterator<Item = &Arc<Served<I, O, M>>> {
        self.0.values().map(|versions| &versions.current)
    }

    /// Puts a model in the place of the one with its name.
    fn insert(&mut self, served: Served<I, O, M>) {
        let served = Arc::new(served);
        match self.0.get_mut(&served.card.name) {
            Some(versions) => {
                let before = std::mem::replace(&mut versions.current, served);
                versions.older.retain(|older| older.strong_count() > 0);
                versions.older.push(Arc::downgrade(&before));
            }
            None => {
                let name = served.card.name.clone();
                let (current, older) = (served, Vec::new());
                self.0.insert(name, Versions { current, older });
            }
        }
    }

    /// The model that a request asks for; `what` is a robot that has one.
    fn choose(
        &self,
        what: &'static str,
        robot: &str,
        model: &str,
        version: &str,
    ) -> Result<Arc<Served<I, O, M>>, ServiceError> {
        let of_robot = || {
            let all = self.0.values();
            all.filter(|versions| versions.current.card.robot == robot)
        };
        if of_robot().next().is_none() {
            let served = names(self.current().map(|model| &model.card.robot));
            return Err(not_served("robot", what, robot, served));
        }
        let chosen = of_robot()
            .find(|versions| model.is_empty() || versions.current.card.name == model)
            .ok_or_else(|| {
                let served = names(of_robot().map(|versions| &versions.current.card.name));
                not_served("model", "model of this robot", model, served)
            })?;
        let current = &chosen.current;
        if version.is_empty() || current.card.version == version {
            return Ok(Arc::clone(current));
        }
        let mut older = chosen.older.iter().filter_map(Weak::upgrade);
        older
            .find(|model| model.card.version == version)
            .ok_or_else(|| {
                let (what, served) = ("version of this model", current.card.version.clone());
                not_served("model_version", what, version, served)
            })
    }

    /// The hash of the weights that a robot's model has.
    fn sha256(&self, robot: &str) -> Option<&str> {
        let of_robot = |model: &&Arc<Served<I, O, M>>| model.card.robot == robot;
        let model = self.current().find(of_robot)?;
        Some(&model.card.weights_sha256)
    }

    fn states(&self) -> impl Iterator<Item = ServedState> {
        self.current().map(|model| ServedState {
            model: model.card.name.clone(),
            robot: model.card.robot.clone(),
            state: model.batcher.state(),
        })
    }
}

/// A model's state, now and as it changes.
pub(crate) struct ServedState {
    pub(crate) model: String,
    pub(crate) robot: String,
    pub(crate) state: watch::Receiver<ModelState>,
}

/// Everything that is served, by name.
pub struct Catalog {
    shelves: RwLock<Shelves>,
    /// Counts what was put on the shelves.
    changes: watch::Sender<u64>,
    /// Where the weights are, and how models are served; none for a catalog that was not loaded.
    source: Option<(PathBuf, BatchingSettings)>,
}

#[derive(Default)]
struct Shelves {
    /// Every robot whose files could be read.
    robots: BTreeMap<String, Arc<Robot>>,
    /// Robots that are not served because a file is damaged, with the reason.
    damaged: BTreeMap<String, String>,
    retargeters: Shelf<RetargetInput, RetargetOutput, Option<Arc<Retargeter>>>,
    policies: Shelf<ControlInput, PolicyOutput, Controllers>,
    filters: Shelf<ControlInput, FilterOutput, Filters>,
}

impl Default for Catalog {
    /// Serves nothing.
    fn default() -> Self {
        Self {
            shelves: RwLock::default(),
            changes: watch::Sender::new(0),
            source: None,
        }
    }
}

/// Why there is nothing to serve.
#[derive(Debug, thiserror::Error)]
pub enum CatalogError {
    /// No folder upward from the executable or the working directory has what is needed.
    #[error(
        "no folder upward from {} or {} has both `robots` and `models/weights`; \
         name them with --robots and --weights",
        executable.display(), working.display()
    )]
    NoHome {
        /// The executable's folder.
        executable: PathBuf,
        /// The working directory.
        working: PathBuf,
    },
    /// The robots' folder cannot be listed.
    #[error(transparent)]
    Robots(#[from] RobotError),
    /// Every robot was skipped; the log says why.
    #[error("no robot of {} can be served with the weights in {}; the log says why", robots.display(), weights.display())]
    Empty {
        /// The robots' folder.
        robots: PathBuf,
        /// The weights' folder.
        weights: PathBuf,
    },
    /// A model cannot be built.
    #[error("model {name}: {reason}")]
    Model {
        /// The model's name.
        name: String,
        /// The reason.
        reason: BackendError,
    },
}

/// A robot's models as their files have them; none where there is no file.
struct Loaded {
    retargeter: Arc<Retargeter>,
    /// Whether the retargeter has a network.
    is_trained: bool,
    policy: Option<Arc<Policy>>,
    emp: Option<Arc<Emp>>,
}

impl Loaded {
    /// # Errors
    /// When a file is there and damaged.
    fn read(weights: &Path, robot: &Arc<Robot>) -> Result<Self, CatalogError> {
        let file = |model: &str| weights.join(format!("{}-{model}.safetensors", robot.name()));
        let [retargeter, policy, emp] = ["retargeter", "policy", "emp"].map(|model| {
            let path = file(model);
            (format!("{}-{model}", robot.name()), path)
        });
        let robot = || Arc::clone(robot);
        let retargeter = load(&retargeter, |path| Retargeter::load(path, robot()))?;
        Ok(Self {
            // Without weights, inverse kinematics alone answers; damaged weights are an error.
            is_trained: retargeter.is_some(),
            retargeter: retargeter
                .unwrap_or_else(|| Arc::new(Retargeter::without_network(robot()))),
            policy: load(&policy, |path| Policy::load(path, robot()))?,
            emp: load(&emp, |path| Emp::load(path, robot()))?,
        })
    }
}

/// Loads a model whose name and file these are; none where there is no file.
fn load<M, E: Into<BackendError>>(
    (name, path): &(String, PathBuf),
    load: impl FnOnce(&Path) -> Result<M, E>,
) -> Result<Option<Arc<M>>, CatalogError> {
    if matches!(path.try_exists(), Ok(false)) {
        tracing::info!(model = name, weights = %path.display(), "no weights");
        return Ok(None);
    }
    let model = load(path).map_err(failed(name))?;
    Ok(Some(Arc::new(model)))
}

impl Catalog {
    /// Loads every robot with each model whose weights are there, and a retargeter without weights where there are none. A robot of
    /// which a file is damaged is known and not served; the log says why.
    ///
    /// # Errors
    /// When the folders cannot be found or read, or nothing is left to serve.
    pub fn load(settings: &Settings) -> Result<Self, CatalogError> {
        let (robots, weights) = folders(settings)?;
        let mut shelves = Shelves::default();
        for folder in robot_folders(&robots)? {
            match Robot::load(&folder) {
                Ok(robot) => shelves.place(&Arc::new(robot), &weights, &settings.batching),
                Err(error) => {
                    tracing::error!(folder = %folder.display(), %error, "robot not served");
                    let name = folder.file_name().unwrap_or_default();
                    let name = name.to_string_lossy().into_owned();
                    shelves.damaged.insert(name, error.to_string());
                }
            }
        }
        if shelves.cards().is_empty() {
            return Err(CatalogError::Empty { robots, weights });
        }
        Ok(Self {
            shelves: RwLock::new(shelves),
            source: Some((weights, settings.batching.clone())),
            ..Self::default()
        })
    }

    /// Loads the weights of a robot, or of every robot, anew. A robot of which a file is damaged stays as it is.
    pub(crate) fn reload(&self, robot: &str) -> Result<Vec<v1::ReloadedModel>, ServiceError> {
        let Some((weights, batching)) = &self.source else {
            return Ok(Vec::new());
        };
        let robots: Vec<Arc<Robot>> = match robot {
            "" => self.read().robots.values().cloned().collect(),
            name => vec![self.robot(name)?],
        };
        let mut reloaded = Vec::new();
        for robot in robots {
            let before = self.versions_of(robot.name());
            // Reading the files takes long; meanwhile everybody is served.
            let result = Loaded::read(weights, &robot)
                .and_then(|loaded| self.write().put(loaded, &robot, batching));
            let error = match result {
                Ok(()) => {
                    self.write().damaged.remove(robot.name());
                    String::new()
                }
                Err(error) => {
                    tracing::error!(robot = robot.name(), %error, "not loaded anew");
                    error.to_string()
                }
            };
            let after = self.versions_of(robot.name());
            reloaded.extend(after.into_iter().map(|(name, version)| v1::ReloadedModel {
                version_before: before.get(&name).cloned().unwrap_or_default(),
                error: error.clone(),
                name,
                version,
            }));
        }
        self.changes.send_modify(|changes| *changes += 1);
        Ok(reloaded)
    }

    fn versions_of(&self, robot: &str) -> BTreeMap<String, String> {
        let cards = self.cards().into_iter();
        cards
            .filter(|card| card.robot == robot)
            .map(|card| (card.name, card.version))
            .collect()
    }

    /// Adds a retargeting model for a robot and starts its thread.
    ///
    /// # Errors
    /// When the model cannot be built.
    pub fn add_retargeter(
        &mut self,
        card: v1::Model,
        robot: &Arc<Robot>,
        batching: &BatchingSettings,
        build: Build<RetargetInput, RetargetOutput>,
    ) -> Result<(), CatalogError> {
        let served = serve(card, robot, batching, build, None)?;
        let mut shelves = self.write();
        let name = robot.name().to_owned();
        shelves.robots.insert(name, Arc::clone(robot));
        shelves.retargeters.insert(served);
        Ok(())
    }

    /// The cards of every model, by name.
    pub(crate) fn cards(&self) -> Vec<v1::Model> {
        self.read().cards()
    }

    /// Every robot, by name, those that are not served too.
    pub(crate) fn robots(&self) -> Vec<v1::RobotSummary> {
        let shelves = self.read();
        let cards = shelves.cards();
        let names = shelves.robots.keys().chain(shelves.damaged.keys());
        let names: std::collections::BTreeSet<&String> = names.collect();
        let summary = |name: &String| v1::RobotSummary {
            name: name.clone(),
            serving: !shelves.damaged.contains_key(name),
            reason: shelves.damaged.get(name).cloned().unwrap_or_default(),
            models: cards
                .iter()
                .filter(|card| card.robot == *name)
                .map(|card| card.name.clone())
                .collect(),
        };
        names.into_iter().map(summary).collect()
    }

    /// Resolves when models were loaded anew.
    pub(crate) fn changes(&self) -> watch::Receiver<u64> {
        self.changes.subscribe()
    }

    /// The state of every model's thread.
    pub(crate) fn states(&self) -> Vec<ServedState> {
        let shelves = self.read();
        let policies = shelves.policies.states();
        let states = shelves.retargeters.states().chain(policies);
        states.chain(shelves.filters.states()).collect()
    }

    /// The retargeter that a request or a stream's config asks for. Empty `model` and `version` take what there is.
    pub(crate) fn retargeter_for(
        &self,
        robot: &str,
        model: &str,
        version: &str,
    ) -> Result<Arc<RetargetModel>, ServiceError> {
        self.robot_for(robot)?;
        let what = "robot with a retargeter";
        self.read().retargeters.choose(what, robot, model, version)
    }

    /// The policy that a request or a stream's config asks for. Empty `model` and `version` take what there is.
    pub(crate) fn policy_for(
        &self,
        robot: &str,
        model: &str,
        version: &str,
    ) -> Result<Arc<PolicyModel>, ServiceError> {
        self.robot_for(robot)?;
        let what = "robot with a policy";
        self.read().policies.choose(what, robot, model, version)
    }

    /// The EMP that a request or a stream's config asks for. Empty `model` and `version` take what there is.
    pub(crate) fn filter_for(
        &self,
        robot: &str,
        model: &str,
        version: &str,
    ) -> Result<Arc<FilterModel>, ServiceError> {
        self.robot_for(robot)?;
        let what = "robot with an EMP";
        self.read().filters.choose(what, robot, model, version)
    }

    /// The robot that a request asks for.
    pub(crate) fn robot_for(&self, robot: &str) -> Result<Arc<Robot>, ServiceError> {
        let shelves = self.read();
        if let Some(reason) = shelves.damaged.get(robot) {
            return Err(ServiceError::NotServing {
                robot: robot.to_owned(),
                reason: reason.clone(),
            });
        }
        shelves.robots.get(robot).cloned().ok_or_else(|| {
            let served = names(shelves.robots.keys());
            not_served("robot", "robot", robot, served)
        })
    }

    pub(crate) fn model(&self, name: &str) -> Result<v1::Model, ServiceError> {
        let cards = self.cards();
        let found = cards.iter().find(|card| card.name == name);
        found.cloned().ok_or_else(|| ServiceError::NotFound {
            what: "model",
            name: shortened(name.to_owned()),
            served: names(cards.iter().map(|card| &card.name)),
        })
    }

    pub(crate) fn robot(&self, name: &str) -> Result<Arc<Robot>, ServiceError> {
        let shelves = self.read();
        let found = shelves.robots.get(name).cloned();
        found.ok_or_else(|| ServiceError::NotFound {
            what: "robot",
            name: shortened(name.to_owned()),
            served: names(shelves.robots.keys()),
        })
    }

    /// No code that can panic halfway runs under the lock, so a poisoned one still holds sound data.
    fn read(&self) -> RwLockReadGuard<'_, Shelves> {
        self.shelves.read().unwrap_or_else(PoisonError::into_inner)
    }

    fn write(&self) -> RwLockWriteGuard<'_, Shelves> {
        self.shelves.write().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Shelves {
    /// Serves a robot with the weights that it has, or remembers why not.
    fn place(&mut self, robot: &Arc<Robot>, weights: &Path, batching: &BatchingSettings) {
        let loaded = match Loaded::read(weights, robot) {
            Ok(loaded) => self.put(loaded, robot, batching),
            Err(error) => Err(error),
        };
        self.robots
            .insert(robot.name().to_owned(), Arc::clone(robot));
        match loaded {
            Ok(()) => tracing::info!(robot = robot.name(), "robot served"),
            Err(error) => {
                tracing::error!(robot = robot.name(), %error, "robot not served");
                let (name, reason) = (robot.name().to_owned(), error.to_string());
                self.damaged.insert(name, reason);
            }
        }
    }

    /// Puts those of a robot's models on their shelves that have changed.
    fn put(
        &mut self,
        loaded: Loaded,
        robot: &Arc<Robot>,
        batching: &BatchingSettings,
    ) -> Result<(), CatalogError> {
        let name = |model: &str| format!("{}-{model}", robot.name());
        let of_robot = robot.name();
        for (model, is_served, is_there) in [
            (
                "policy",
                self.policies.sha256(of_robot),
                loaded.policy.is_some(),
            ),
            ("emp", self.filters.sha256(of_robot), loaded.emp.is_some()),
        ] {
            if is_served.is_some() && !is_there {
                return Err(failed(&name(model))(BackendError::new("its file is gone")));
            }
        }
        let Loaded {
            retargeter,
            is_trained,
            policy,
            emp,
        } = loaded;
        let sha256 = |emp: &Arc<Emp>| emp.metadata().sha256.clone();
        let emp_changed = emp.as_ref().map(sha256).as_deref() != self.filters.sha256(robot.name());
        let suffix = if is_trained { "retargeter" } else { "ik" };
        let weights = |model: &Retargeter| match is_trained {
            true => model.metadata().sha256.clone(),
            false => String::new(),
        };
        let retargeter = Some(retargeter)
            .filter(|new| self.retargeters.sha256(of_robot) != Some(&weights(new)))
            .map(|model| {
                let (kind, joints) = (ModelKind::Retargeter, robot.goal_joints());
                let mut card = encode::model_card(name(suffix), kind, joints, model.metadata());
                card.weights_sha256 = weights(&model);
                let build = from_memory(Arc::clone(&model));
                serve(card, robot, batching, build, Some(model))
            });
        let policy = policy
            .filter(|new| {
                emp_changed || self.policies.sha256(robot.name()) != Some(&new.metadata().sha256)
            })
            .map(|model| {
                let (kind, joints) = (ModelKind::Policy, robot.leg_joints());
                let card = encode::model_card(name("policy"), kind, joints, model.metadata());
                let controllers = Controllers::new(model, emp.clone());
                let build = from_memory(controllers.clone());
                serve(card, robot, batching, build, controllers)
            });
        let filter = emp.filter(|_| emp_changed).map(|model| {
            let (kind, joints) = (ModelKind::Emp, robot.goal_joints());
            let card = encode::model_card(name("emp"), kind, joints, model.metadata());
            let filters = Filters::new(model);
            let build = from_memory(filters.clone());
            serve(card, robot, batching, build, filters)
        });
        // Every model stands before the first is put in its place.
        let (retargeter, policy, filter) = (
            retargeter.transpose()?,
            policy.transpose()?,
            filter.transpose()?,
        );
        if let Some(served) = retargeter {
            self.retargeters.insert(served);
        }
        if let Some(served) = policy {
            self.policies.insert(served);
        }
        if let Some(served) = filter {
            self.filters.insert(served);
        }
        Ok(())
    }

    fn cards(&self) -> Vec<v1::Model> {
        let retargeters = self.retargeters.current().map(|model| &model.card);
        let policies = self.policies.current().map(|model| &model.card);
        let filters = self.filters.current().map(|model| &model.card);
        let cards = retargeters.chain(policies).chain(filters);
        let mut cards: Vec<v1::Model> = cards.cloned().collect();
        cards.sort_by(|a, b| a.name.cmp(&b.name));
        cards
    }
}

/// Starts a model's thread.
fn serve<I: Send + 'static, O: Send + 'static, M>(
    card: v1::Model,
    robot: &Arc<Robot>,
    batching: &BatchingSettings,
    build: Build<I, O>,
    model: M,
) -> Result<Served<I, O, M>, CatalogError> {
    let limits = Limits {
        max_batch: batching.max_batch.get(),
        queue: batching.queue.get(),
    };
    let batcher = Batcher::start(&card.name, limits, build).map_err(failed(&card.name))?;
    Ok(Served {
        card,
        robot: Arc::clone(robot),
        batcher,
        model,
    })
}

fn failed<E: Into<BackendError>>(name: &str) -> impl Fn(E) -> CatalogError {
    move |reason| CatalogError::Model {
        name: name.to_owned(),
        reason: reason.into(),
    }
}

fn not_served(field: &'static str, what: &'static str, name: &str, served: String) -> ServiceError {
    ServiceError::NotServed {
        field,
        what,
        name: shortened(name.to_owned()),
        served,
    }
}

fn names<'a>(names: impl Iterator<Item = &'a String>) -> String {
    names.map(String::as_str).collect::<Vec<_>>().join(", ")
}

/// The folders of robots and weights: as set, or else those of the nearest checkout.
fn folders(settings: &Settings) -> Result<(PathBuf, PathBuf), CatalogError> {
    if let (Some(robots), Some(weights)) = (&settings.robots, &settings.weights) {
        return Ok((robots.clone(), weights.clone()));
    }
    let home = home()?;
    Ok((
        settings
            .robots
            .clone()
            .unwrap_or_else(|| home.join("robots")),
        settings
            .weights
            .clone()
            .unwrap_or_else(|| home.join("models/weights")),
    ))
}

fn home() -> Result<PathBuf, CatalogError> {
    let executable = std::env::current_exe().unwrap_or_default();
    let working = std::env::current_dir().unwrap_or_default();
    let is_home =
        |folder: &&Path| folder.join("robots").is_dir() && folder.join("models/weights").is_dir();
    executable
        .ancestors()
        .skip(1)
        .chain(working.ancestors())
        .find(is_home)
        .map(Path::to_owned)
        .ok_or_else(|| CatalogError::NoHome {
            executable: executable.parent().unwrap_or(Path::new("")).to_owned(),
            working: working.clone(),
        })
}
