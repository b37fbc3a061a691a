//! The robot: MuJoCo on a thread of its own.

use std::sync::Arc;
use std::thread;

use anyhow::{Context, Result};
use emp_robot::Robot;
use emp_sim::{Body, BodyParameters, Reading, Stage, Start, Targets};
use nalgebra::Vector3;
use tokio::sync::mpsc;

/// Joint targets of one control period, radians.
#[derive(Clone, Debug)]
pub(crate) struct JointTargets {
    /// Of the goal joints.
    pub(crate) goal: Vec<f32>,
    /// Of the leg joints.
    pub(crate) legs: Vec<f32>,
}

/// What the robot is told at the beginning of a control period.
struct Command {
    targets: JointTargets,
    /// Change of the base's velocity, m/s.
    push: Option<Vector3<f64>>,
}

/// A simulated robot; its thread ends when this is dropped.
pub(crate) struct Simulator {
    commands: mpsc::Sender<Command>,
    readings: mpsc::Receiver<Result<Reading>>,
}

impl Simulator {
    /// Stands the robot on the floor: goal joints at `goal`, legs in their default pose, `hand_load` kg in its hands. Gives what
    /// it measures then.
    pub(crate) async fn start(
        robot: &Arc<Robot>,
        hand_load: [f64; 2],
        goal: &[f32],
    ) -> Result<(Self, Reading)> {
        let (commands, inbox) = mpsc::channel(1);
        let (outbox, readings) = mpsc::channel(1);
        let legs = robot.leg_joints().iter().map(|joint| joint.default);
        let angles: Vec<f64> = goal
            .iter()
            .map(|&angle| f64::from(angle))
            .chain(legs)
            .collect();
        let robot = Arc::clone(robot);
        thread::Builder::new()
            .name("physics".to_owned())
            .spawn(move || {
                let parameters = BodyParameters {
                    hand_mass: hand_load,
                    ..BodyParameters::default()
                };
                match place(&robot, &angles, parameters) {
                    Ok((stage, body)) => simulate(stage, body, inbox, &outbox),
                    // Nobody listens any more, or the error has arrived: either way this thread is done.
                    Err(error) => drop(outbox.blocking_send(Err(error))),
                }
            })
            .context("cannot start the physics thread")?;
        let mut simulator = Self { commands, readings };
        let reading = simulator.reading().await?;
        Ok((simulator, reading))
    }

    /// One control period.
    pub(crate) async fn step(
        &mut self,
        targets: JointTargets,
        push: Option<Vector3<f64>>,
    ) -> Result<Reading> {
        let command = Command { targets, push };
        self.commands
            .send(command)
            .await
            .context("the physics thread is gone")?;
        self.reading().await
    }

    async fn reading(&mut self) -> Result<Reading> {
        let reading = self.readings.recv().await;
        reading.context("the physics thread is gone")?
    }
}

fn place(robot: &Robot, angles: &[f64], parameters: BodyParameters) -> Result<(Stage, Body)> {
    let mut stage = Stage::new(robot)?;
    let body = stage.place(&Start {
        joint_positions: angles,
        lift: 0.0,
        parameters,
    });
    Ok((stage, body))
}

/// Executes commands until the other side is gone.
fn simulate(
    mut stage: Stage,
    mut body: Body,
    mut inbox: mpsc::Receiver<Command>,
    outbox: &mpsc::Sender<Result<Reading>>,
) {
    let mut reading = body.reading().clone();
    while outbox.blocking_send(Ok(reading)).is_ok() {
        let Some(Command { targets, push }) = inbox.blocking_recv() else {
            return;
        };
        if let Some(push) = push {
            body.push(push, Vector3::zeros());
        }
        let targets = Targets {
            goal: &targets.goal,
            legs: &targets.legs,
        };
        reading = stage.step(&mut body, &targets).clone();
    }
}
