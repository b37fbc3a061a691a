//! Health as `grpc.health.v1` tells it: of the server, its services, each robot and each model.

use std::{collections::BTreeSet, sync::Arc};

use tokio_stream::{StreamExt as _, StreamMap, wrappers::WatchStream};
use tokio_util::sync::CancellationToken;
use tonic_health::{ServingStatus, server::HealthReporter};

use crate::{catalog::Catalog, inference::batcher::ModelState};

/// Names of the services; the empty one is the whole server.
const SERVICES: [&str; 5] = [
    "",
    "emp.v1.ModelService",
    "emp.v1.MotionService",
    "emp.v1.RolloutService",
    "emp.v1.TeleoperationService",
];
/// Those that serve as long as one robot has all its models.
const OF_MODELS: [&str; 2] = ["emp.v1.MotionService", "emp.v1.TeleoperationService"];

/// The name under which a model's or a robot's health is asked for.
fn part(name: &str) -> String {
    format!("emp.v1.MotionService/{name}")
}

/// What was reported last.
#[derive(Default)]
pub(crate) struct Reported {
    failed: BTreeSet<String>,
    known: BTreeSet<String>,
}

/// Reports health for the first time, before anybody can ask.
pub(crate) async fn begin(catalog: &Catalog, reporter: &HealthReporter) -> Reported {
    for service in SERVICES {
        reporter
            .set_service_status(service, ServingStatus::Serving)
            .await;
    }
    let states = catalog.states().into_iter();
    let models: Vec<_> = states.map(|served| (served.model, served.robot)).collect();
    let mut reported = Reported::default();
    reported
        .tell(catalog, reporter, &models, &BTreeSet::new())
        .await;
    reported
}

/// Reports what changes until the server shuts down.
pub(crate) async fn report(
    mut reported: Reported,
    catalog: Arc<Catalog>,
    reporter: HealthReporter,
    shutdown: CancellationToken,
) {
    let mut changes = catalog.changes();
    loop {
        let states = catalog.states();
        let robots: Vec<(String, String)> = states
            .iter()
            .map(|served| (served.model.clone(), served.robot.clone()))
            .collect();
        let mut models: StreamMap<String, _> = states
            .into_iter()
            .map(|served| (served.model, WatchStream::new(served.state)))
            .collect();
        let mut rebuilding = BTreeSet::new();
        loop {
            reported
                .tell(&catalog, &reporter, &robots, &rebuilding)
                .await;
            tokio::select! {
                biased;
                () = shutdown.cancelled() => return,
                changed = changes.changed() => match changed {
                    Ok(()) => break,
                    Err(_) => return,
                },
                Some((model, state)) = models.next() => match state {
                    ModelState::Serving => rebuilding.remove(&model),
                    ModelState::Rebuilding => rebuilding.insert(model),
                },
            };
        }
    }
}

impl Reported {
    /// Tells those who watch what has changed.
    async fn tell(
        &mut self,
        catalog: &Catalog,
        reporter: &HealthReporter,
        models: &[(String, String)],
        rebuilding: &BTreeSet<String>,
    ) {
        let mut failed: BTreeSet<String> = rebuilding.iter().map(|model| part(model)).collect();
        let mut known: BTreeSet<String> = models.iter().map(|(model, _)| part(model)).collect();
        let mut healthy = false;
        for robot in catalog.robots() {
            let of_robot = models.iter().filter(|(_, of)| *of == robot.name);
            let all_serve = of_robot
                .clone()
                .all(|(model, _)| !rebuilding.contains(model));
            if robot.serving && all_serve {
                healthy = true;
            } else {
                failed.insert(part(&robot.name));
            }
            known.insert(part(&robot.name));
        }
        for service in OF_MODELS {
            known.insert(service.to_owned());
            if !healthy {
                failed.insert(service.to_owned());
            }
        }
        // Those who watch are told of every report, changed or not.
        for service in &known {
            let has_failed = failed.contains(service);
            if self.known.contains(service) && self.failed.contains(service) == has_failed {
                continue;
            }
            let status = if has_failed {
                ServingStatus::NotServing
            } else {
                ServingStatus::Serving
            };
            reporter.set_service_status(service, status).await;
        }
        (self.known, self.failed) = (known, failed);
    }
}

/// Tells those who watch that the server goes, and ends their watches, which would hold it up otherwise.
pub(crate) async fn close(catalog: &Catalog, mut reporter: HealthReporter) {
    let models = catalog
        .states()
        .into_iter()
        .map(|served| part(&served.model));
    let robots = catalog.robots().into_iter().map(|robot| part(&robot.name));
    let services = SERVICES.map(str::to_owned).into_iter();
    for service in services.chain(models).chain(robots) {
        reporter
            .set_service_status(&service, ServingStatus::NotServing)
            .await;
        reporter.clear_service_status(&service).await;
    }
}
