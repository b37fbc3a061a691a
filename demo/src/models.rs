//! What the server answers with.

use anyhow::Result;
use emp_client::{Client, Model, ModelKind};
use serde::Serialize;

/// The models of one robot.
#[derive(Clone, Debug, Serialize)]
#[serde(transparent)]
pub(crate) struct Models(Vec<Served>);

#[derive(Clone, Debug, Serialize)]
struct Served {
    name: String,
    version: String,
    #[serde(skip)]
    kind: ModelKind,
}

impl Models {
    /// Asks the server for those of a robot.
    pub(crate) async fn of(robot: &str, client: &Client) -> Result<Self> {
        let models = client.models().await?.into_iter();
        let served = |model: Model| Served {
            kind: model.kind(),
            name: model.name,
            version: model.version,
        };
        Ok(Self(
            models
                .filter(|model| model.robot == robot)
                .map(served)
                .collect(),
        ))
    }

    /// Whether the robot has an EMP.
    pub(crate) fn have_emp(&self) -> bool {
        self.0.iter().any(|model| model.kind == ModelKind::Emp)
    }
}
