//! Models under a test's control: they answer at once or when told, and panic when asked to.

use std::sync::{
    Arc, Condvar, Mutex, PoisonError,
    atomic::{AtomicUsize, Ordering},
};

use emp_models::retarget::{RetargetInput, RetargetOutput};
use emp_motion::{KeyNode, KeyNodeFrame};
use emp_proto::v1;
use emp_robot::Robot;
use emp_server::{Backend, BackendError, Catalog, RetargetBackend, Settings};
use nalgebra::Vector3;

use crate::{TestServer, emp27};

/// Height of the torso over the waist that makes the fake model panic, metres. No test uses it otherwise.
const PANIC_HEIGHT: f32 = 1.25;

/// A gate that a model passes before each batch, and again before it is rebuilt.
#[derive(Clone, Default)]
pub struct Gate {
    inner: Arc<GateInner>,
}

#[derive(Default)]
struct GateInner {
    closed: Mutex<Closed>,
    opened: Condvar,
    entered: AtomicUsize,
    built: AtomicUsize,
}

#[derive(Default)]
struct Closed {
    batches: bool,
    builds: bool,
}

impl Gate {
    /// A gate that stands open.
    pub fn open() -> Self {
        Self::default()
    }

    /// A gate at which the first batch waits.
    pub fn closed() -> Self {
        let gate = Self::default();
        gate.change(|closed| closed.batches = true);
        gate
    }

    /// Lets batches pass.
    pub fn let_batches_pass(&self) {
        self.change(|closed| closed.batches = false);
    }

    /// Holds rebuilding up.
    pub fn hold_builds(&self) {
        self.change(|closed| closed.builds = true);
    }

    /// Lets rebuilding go on.
    pub fn let_builds_pass(&self) {
        self.change(|closed| closed.builds = false);
    }

    /// How many batches have come to the gate.
    pub fn entered(&self) -> usize {
        self.inner.entered.load(Ordering::SeqCst)
    }

    /// How many models were built.
    pub fn built(&self) -> usize {
        self.inner.built.load(Ordering::SeqCst)
    }

    /// Waits until the model has taken this many batches.
    pub async fn has_entered(&self, batches: usize) {
        while self.entered() < batches {
            tokio::time::sleep(std::time::Duration::from_millis(1)).await;
        }
    }

    fn change(&self, change: impl FnOnce(&mut Closed)) {
        change(
            &mut self
                .inner
                .closed
                .lock()
                .unwrap_or_else(PoisonError::into_inner),
        );
        self.inner.opened.notify_all();
    }

    fn pass(&self, is_closed: impl Fn(&Closed) -> bool) {
        let closed = self
            .inner
            .closed
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        let open = self
            .inner
            .opened
            .wait_while(closed, |closed| is_closed(closed));
        drop(open.unwrap_or_else(PoisonError::into_inner));
    }
}

/// Answers every pose with a fixed function of it: see [`expected`].
struct FakeModel {
    gate: Gate,
    joints: usize,
}

impl Backend for FakeModel {
    type Input = RetargetInput;
    type Output = RetargetOutput;

    fn run(&mut self, batch: &[RetargetInput]) -> Result<Vec<RetargetOutput>, BackendError> {
        self.gate.inner.entered.fetch_add(1, Ordering::SeqCst);
        self.gate.pass(|closed| closed.batches);
        let panics = |input: &RetargetInput| {
            input.frame.positions[KeyNode::Torso as usize].z == PANIC_HEIGHT
        };
        assert!(
            !batch.iter().any(panics),
            "a pose that makes the model panic"
        );
        Ok(batch
            .iter()
            .map(|input| RetargetOutput {
                angles: vec![expected(&input.frame); self.joints],
                direction_error: 0.0,
                at_limit: Vec::new(),
                memory: None,
            })
            .collect())
    }
}

/// What the fake model answers for every joint: the forward position of the left wrist, as an angle.
pub fn expected(pose: &KeyNodeFrame) -> f32 {
    pose.positions[KeyNode::LeftWrist as usize].x
}

/// A pose with hanging arms that the fake model answers with this angle, −0.5 to 0.5.
pub fn pose(angle: f32) -> KeyNodeFrame {
    let side = |sign: f32| {
        [
            Vector3::new(0.0, 0.2 * sign, 0.45),
            Vector3::new(0.0, 0.25 * sign, 0.15),
            Vector3::new(angle, 0.25 * sign, -0.1),
        ]
    };
    let [left, right] = [side(1.0), side(-1.0)];
    let torso = Vector3::new(0.0, 0.0, 0.5);
    KeyNodeFrame {
        positions: [
            Vector3::zeros(),
            torso,
            left[0],
            right[0],
            left[1],
            right[1],
            left[2],
            right[2],
        ],
        wrist_rotations: [None, None],
    }
}

/// A pose at which the fake model panics.
pub fn panic_pose() -> KeyNodeFrame {
    let mut pose = pose(0.0);
    pose.positions[KeyNode::Torso as usize].z = PANIC_HEIGHT;
    pose
}

/// A server of the fake model behind `gate`.
///
/// # Errors
/// When it cannot be started.
pub fn server(settings: Settings, gate: &Gate) -> anyhow::Result<TestServer> {
    let catalog = catalog(&settings, &emp27()?, gate)?;
    TestServer::start(settings, catalog)
}

/// A catalog with the fake model behind `gate`, for `robot`.
///
/// # Errors
/// When the model's thread cannot be started.
pub fn catalog(settings: &Settings, robot: &Arc<Robot>, gate: &Gate) -> anyhow::Result<Catalog> {
    let mut catalog = Catalog::default();
    add(&mut catalog, settings, robot, gate)?;
    Ok(catalog)
}

/// Adds the fake model behind `gate`, for `robot`.
///
/// # Errors
/// When the model's thread cannot be started.
pub fn add(
    catalog: &mut Catalog,
    settings: &Settings,
    robot: &Arc<Robot>,
    gate: &Gate,
) -> anyhow::Result<()> {
    let joints = robot.goal_joints();
    let card = v1::Model {
        name: "fake".to_owned(),
        version: "1".to_owned(),
        kind: v1::ModelKind::Retargeter.into(),
        robot: robot.name().to_owned(),
        joint_names: joints.iter().map(|joint| joint.name.clone()).collect(),
        ..v1::Model::default()
    };
    let (gate, joints) = (gate.clone(), joints.len());
    let build = move || {
        gate.pass(|closed| closed.builds);
        gate.inner.built.fetch_add(1, Ordering::SeqCst);
        Ok(Box::new(FakeModel {
            gate: gate.clone(),
            joints,
        }) as RetargetBackend)
    };
    catalog.add_retargeter(card, robot, &settings.batching, Box::new(build))?;
    Ok(())
}
