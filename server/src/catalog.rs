//! What the server serves: robots, and for each its models behind their queues.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    sync::Arc,
};

use emp_models::{
    emp::Emp,
    policy::Policy,
    retarget::{RetargetInput, RetargetOutput, Retargeter},
};
use emp_proto::v1::{self, ModelKind};
use emp_robot::{Robot, RobotError, robot_folders};

use crate::{
    backend::{BackendError, Build, first_then, retargeter_from},
    batcher::{Batcher, Limits, ModelState},
    control::{ControlInput, Controllers, FilterOutput, Filters, PolicyOutput},
    error::ServiceError,
    settings::{BatchingSettings, Settings},
    wire,
};
use tokio::sync::watch;

/// A model behind its queue.
pub(crate) struct Served<I, O, M> {
    pub(crate) card: v1::Model,
    pub(crate) robot: Arc<Robot>,
    pub(crate) batcher: Batcher<I, O>,
    /// The model itself, for jobs, which compute on threads of their own.
    pub(crate) model: M,
}

impl<I: Send + 'static, O: Send + 'static, M> Served<I, O, M> {
    /// The model's name, and the state of its thread.
    fn state(&self) -> (String, watch::Receiver<ModelState>) {
        (self.card.name.clone(), self.batcher.state())
    }
}

/// A retargeting model; the retargeter itself where it is not a test's.
pub(crate) type RetargetModel = Served<RetargetInput, RetargetOutput, Option<Arc<Retargeter>>>;

/// A policy, alone and behind the robot's EMP, where it has one.
pub(crate) type PolicyModel = Served<ControlInput, PolicyOutput, Controllers>;

/// An EMP.
pub(crate) type FilterModel = Served<ControlInput, FilterOutput, Filters>;

/// Everything that is served, by name.
#[derive(Default)]
pub struct Catalog {
    robots: BTreeMap<String, Arc<Robot>>,
    retargeters: BTreeMap<String, Arc<RetargetModel>>,
    policies: BTreeMap<String, Arc<PolicyModel>>,
    filters: BTreeMap<String, Arc<FilterModel>>,
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

impl Catalog {
    /// Loads every robot with each model whose weights are there, and a retargeter without weights where there are none; logs
    /// what it skips and why.
    ///
    /// # Errors
    /// When the folders cannot be found or read, or nothing is left to serve.
    pub fn load(settings: &Settings) -> Result<Self, CatalogError> {
        let (robots, weights) = folders(settings)?;
        let mut catalog = Self::default();
        for folder in robot_folders(&robots)? {
            let robot = match Robot::load(&folder) {
                Ok(robot) => Arc::new(robot),
                Err(error) => {
                    tracing::warn!(folder = %folder.display(), %error, "robot skipped");
                    continue;
                }
            };
            catalog.load_models(&weights, &robot, &settings.batching);
        }
        if catalog.robots.is_empty() {
            return Err(CatalogError::Empty { robots, weights });
        }
        Ok(catalog)
    }

    /// Loads a robot's models, each on its own: one whose weights are not there is not served.
    fn load_models(&mut self, weights: &Path, robot: &Arc<Robot>, batching: &BatchingSettings) {
        let file = |model: &str| weights.join(format!("{}-{model}.safetensors", robot.name()));
        let emp = self.load_emp(file("emp"), robot, batching);
        let with_emp = emp.as_ref().ok().map(|emp| (Arc::clone(emp), file("emp")));
        let loaded = [
            (
                "retargeter",
                self.load_retargeter(file("retargeter"), robot, batching),
            ),
            (
                "policy",
                self.load_policy(file("policy"), with_emp, robot, batching),
            ),
            ("emp", emp.map(drop)),
        ];
        for (model, loaded) in loaded {
            let weights = file(model);
            match loaded {
                Ok(()) if model == "retargeter" && matches!(weights.try_exists(), Ok(false)) => {
                    tracing::info!(robot = robot.name(), weights = %weights.display(), "no trained retargeter: inverse kinematics alone is served");
                }
                Ok(()) => {
                    tracing::info!(robot = robot.name(), weights = %weights.display(), "model served");
                }
                // Many a robot has none. A damaged one is another matter.
                Err(_) if model == "emp" && matches!(weights.try_exists(), Ok(false)) => {
                    tracing::info!(robot = robot.name(), weights = %weights.display(), "no EMP");
                }
                Err(error) => tracing::warn!(robot = robot.name(), %error, "not served"),
            }
        }
    }

    /// Without weights, inverse kinematics alone answers; damaged weights are an error.
    fn load_retargeter(
        &mut self,
        weights: PathBuf,
        robot: &Arc<Robot>,
        batching: &BatchingSettings,
    ) -> Result<(), CatalogError> {
        let is_trained = !matches!(weights.try_exists(), Ok(false));
        let suffix = if is_trained { "retargeter" } else { "ik" };
        let name = format!("{}-{suffix}", robot.name());
        let again = retargeter_from(is_trained.then_some(weights), Arc::clone(robot));
        let model = again().map_err(failed(&name))?;
        let mut card = wire::model_card(
            name,
            ModelKind::Retargeter,
            robot.goal_joints(),
            model.metadata(),
        );
        if !is_trained {
            card.weights_sha256.clear();
        }
        let build = first_then(Arc::clone(&model), again);
        let served = serve(card, robot, batching, build, Some(model))?;
        insert(&mut self.robots, &mut self.retargeters, served);
        Ok(())
    }

    /// `emp` is the robot's EMP and the file of its weights.
    fn load_policy(
        &mut self,
        weights: PathBuf,
        emp: Option<(Arc<Emp>, PathBuf)>,
        robot: &Arc<Robot>,
        batching: &BatchingSettings,
    ) -> Result<(), CatalogError> {
        let name = format!("{}-policy", robot.name());
        let policy = Policy::load(&weights, Arc::clone(robot)).map_err(failed(&name))?;
        let card = wire::model_card(
            name,
            ModelKind::Policy,
            robot.leg_joints(),
            policy.metadata(),
        );
        let (emp, emp_weights) = emp.unzip();
        let controllers = Controllers::new(Arc::new(policy), emp);
        let again = Controllers::load(weights, emp_weights, Arc::clone(robot));
        let build = first_then(controllers.clone(), again);
        let served = serve(card, robot, batching, build, controllers)?;
        insert(&mut self.robots, &mut self.policies, served);
        Ok(())
    }

    fn load_emp(
        &mut self,
        weights: PathBuf,
        robot: &Arc<Robot>,
        batching: &BatchingSettings,
    ) -> Result<Arc<Emp>, CatalogError> {
        let name = format!("{}-emp", robot.name());
        let emp = Emp::load(&weights, Arc::clone(robot))
            .map(Arc::new)
            .map_err(failed(&name))?;
        let card = wire::model_card(name, ModelKind::Emp, robot.goal_joints(), emp.metadata());
        let filters = Filters::new(Arc::clone(&emp));
        let again = Filters::load(weights, Arc::clone(robot));
        let build = first_then(filters.clone(), again);
        let served = serve(card, robot, batching, build, filters)?;
        insert(&mut self.robots, &mut self.filters, served);
        Ok(emp)
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
        insert(&mut self.robots, &mut self.retargeters, served);
        Ok(())
    }

    /// The cards of every model, by name.
    pub(crate) fn cards(&self) -> Vec<&v1::Model> {
        let retargeters = self.retargeters.values().map(|model| &model.card);
        let policies = self.policies.values().map(|model| &model.card);
        let filters = self.filters.values().map(|model| &model.card);
        let mut cards: Vec<_> = retargeters.chain(policies).chain(filters).collect();
        cards.sort_by(|a, b| a.name.cmp(&b.name));
        cards
    }

    /// The state of every model's thread, with the model's name.
    pub(crate) fn states(&self) -> Vec<(String, watch::Receiver<ModelState>)> {
        let retargeters = self.retargeters.values().map(|model| model.state());
        let policies = self.policies.values().map(|model| model.state());
        let filters = self.filters.values().map(|model| model.state());
        retargeters.chain(policies).chain(filters).collect()
    }

    /// The retargeter that a request or a stream's config asks for. Empty `model` and `version` take what there is.
    pub(crate) fn retargeter_for(
        &self,
        robot: &str,
        model: &str,
        version: &str,
    ) -> Result<&Arc<RetargetModel>, ServiceError> {
        let what = "robot with a retargeter";
        self.choose(&self.retargeters, what, robot, model, version)
    }

    /// The policy that a request or a stream's config asks for. Empty `model` and `version` take what there is.
    pub(crate) fn policy_for(
        &self,
        robot: &str,
        model: &str,
        version: &str,
    ) -> Result<&Arc<PolicyModel>, ServiceError> {
        let what = "robot with a policy";
        self.choose(&self.policies, what, robot, model, version)
    }

    /// The EMP that a request or a stream's config asks for. Empty `model` and `version` take what there is.
    pub(crate) fn filter_for(
        &self,
        robot: &str,
        model: &str,
        version: &str,
    ) -> Result<&Arc<FilterModel>, ServiceError> {
        let what = "robot with an EMP";
        self.choose(&self.filters, what, robot, model, version)
    }

    /// The model of one kind that a request asks for; `what` is a robot that has one.
    fn choose<'a, I, O, M>(
        &self,
        models: &'a BTreeMap<String, Arc<Served<I, O, M>>>,
        what: &'static str,
        robot: &str,
        model: &str,
        version: &str,
    ) -> Result<&'a Arc<Served<I, O, M>>, ServiceError> {
        self.robot_for(robot)?;
        let of_robot = || {
            models
                .values()
                .filter(|candidate| candidate.card.robot == robot)
        };
        if of_robot().next().is_none() {
            let served = names(models.values().map(|candidate| &candidate.card.robot));
            return Err(not_served("robot", what, robot, served));
        }
        let chosen = of_robot()
            .find(|candidate| model.is_empty() || candidate.card.name == model)
            .ok_or_else(|| {
                let served = names(of_robot().map(|candidate| &candidate.card.name));
                not_served("model", "model of this robot", model, served)
            })?;
        if !version.is_empty() && chosen.card.version != version {
            let (what, served) = ("version of this model", chosen.card.version.clone());
            return Err(not_served("model_version", what, version, served));
        }
        Ok(chosen)
    }

    /// The robot that a request asks for.
    pub(crate) fn robot_for(&self, robot: &str) -> Result<&Arc<Robot>, ServiceError> {
        self.robots.get(robot).ok_or_else(|| {
            let served = names(self.robots.keys());
            not_served("robot", "robot", robot, served)
        })
    }

    pub(crate) fn model(&self, name: &str) -> Result<&v1::Model, ServiceError> {
        let cards = self.cards();
        let found = cards.iter().find(|card| card.name == name);
        found.copied().ok_or_else(|| ServiceError::NotFound {
            what: "model",
            name: name.to_owned(),
            served: names(cards.iter().map(|card| &card.name)),
        })
    }

    pub(crate) fn robot(&self, name: &str) -> Result<&Arc<Robot>, ServiceError> {
        self.robots.get(name).ok_or_else(|| ServiceError::NotFound {
            what: "robot",
            name: name.to_owned(),
            served: names(self.robots.keys()),
        })
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

/// Adds a model and its robot.
fn insert<I, O, M>(
    robots: &mut BTreeMap<String, Arc<Robot>>,
    models: &mut BTreeMap<String, Arc<Served<I, O, M>>>,
    served: Served<I, O, M>,
) {
    robots.insert(served.robot.name().to_owned(), Arc::clone(&served.robot));
    models.insert(served.card.name.clone(), Arc::new(served));
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
        name: name.to_owned(),
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
