//! What the server serves: robots, and for each its models behind their queues.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    sync::Arc,
};

use emp_models::retarget::{RetargetInput, RetargetOutput, Retargeter};
use emp_proto::v1;
use emp_robot::{Robot, RobotError, robot_folders};

use crate::{
    backend::{BackendError, BuildRetargeter, RetargetBackend, retargeter_from},
    batcher::{Batcher, Limits},
    error::ServiceError,
    settings::{BatchingSettings, Settings},
    wire,
};

/// A retargeting model behind its queue.
pub(crate) struct RetargetModel {
    pub(crate) card: v1::Model,
    pub(crate) robot: Arc<Robot>,
    pub(crate) batcher: Batcher<RetargetInput, RetargetOutput>,
}

/// Everything that is served, by name.
#[derive(Default)]
pub struct Catalog {
    robots: BTreeMap<String, Arc<Robot>>,
    retargeters: BTreeMap<String, Arc<RetargetModel>>,
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
    /// Loads every robot whose weights are there; logs what it skips and why.
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
            let file = weights.join(format!("{}-retargeter.safetensors", robot.name()));
            match catalog.load_retargeter(&file, &robot, &settings.batching) {
                Ok(()) => {
                    tracing::info!(robot = robot.name(), weights = %file.display(), "robot served");
                }
                Err(error) => tracing::warn!(robot = robot.name(), %error, "robot skipped"),
            }
        }
        if catalog.retargeters.is_empty() {
            return Err(CatalogError::Empty { robots, weights });
        }
        Ok(catalog)
    }

    fn load_retargeter(
        &mut self,
        weights: &Path,
        robot: &Arc<Robot>,
        batching: &BatchingSettings,
    ) -> Result<(), CatalogError> {
        let name = format!("{}-retargeter", robot.name());
        let loaded =
            Retargeter::load(weights, Arc::clone(robot)).map_err(|error| CatalogError::Model {
                name: name.clone(),
                reason: BackendError::new(error.to_string()),
            })?;
        let card = wire::model_card(name, loaded.metadata());
        let mut first = Some(loaded);
        let mut again = retargeter_from(weights.to_owned(), Arc::clone(robot));
        let build = move || match first.take() {
            Some(loaded) => Ok(Box::new(loaded) as RetargetBackend),
            None => again(),
        };
        self.add_retargeter(card, Arc::clone(robot), batching, Box::new(build))
    }

    /// Adds a retargeting model for a robot and starts its thread.
    ///
    /// # Errors
    /// When the model cannot be built.
    pub fn add_retargeter(
        &mut self,
        card: v1::Model,
        robot: Arc<Robot>,
        batching: &BatchingSettings,
        build: BuildRetargeter,
    ) -> Result<(), CatalogError> {
        let limits = Limits {
            max_batch: batching.max_batch.get(),
            queue: batching.queue.get(),
        };
        let batcher =
            Batcher::start(&card.name, limits, build).map_err(|reason| CatalogError::Model {
                name: card.name.clone(),
                reason,
            })?;
        self.robots
            .insert(robot.name().to_owned(), Arc::clone(&robot));
        self.retargeters.insert(
            card.name.clone(),
            Arc::new(RetargetModel {
                card,
                robot,
                batcher,
            }),
        );
        Ok(())
    }

    pub(crate) fn retargeters(&self) -> impl Iterator<Item = &Arc<RetargetModel>> {
        self.retargeters.values()
    }

    /// The model that a request or a stream's config asks for. Empty `model` and `version` take what there is.
    pub(crate) fn retargeter_for(
        &self,
        robot: &str,
        model: &str,
        version: &str,
    ) -> Result<&Arc<RetargetModel>, ServiceError> {
        let of_robot = || {
            self.retargeters()
                .filter(|candidate| candidate.card.robot == robot)
        };
        if of_robot().next().is_none() {
            let served = names(self.robots.keys());
            return Err(not_served("robot", "robot", robot, served));
        }
        let chosen = of_robot()
            .find(|candidate| model.is_empty() || candidate.card.name == model)
            .ok_or_else(|| {
                let served = names(of_robot().map(|candidate| &candidate.card.name));
                not_served("model", "model of this robot", model, served)
            })?;
        if !version.is_empty() && chosen.card.version != version {
            let served = chosen.card.version.clone();
            return Err(not_served(
                "model_version",
                "version of this model",
                version,
                served,
            ));
        }
        Ok(chosen)
    }

    pub(crate) fn model(&self, name: &str) -> Result<&v1::Model, ServiceError> {
        self.retargeters
            .get(name)
            .map(|model| &model.card)
            .ok_or_else(|| ServiceError::NotFound {
                what: "model",
                name: name.to_owned(),
                served: names(self.retargeters.keys()),
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
