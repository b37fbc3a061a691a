//! A MuJoCo model and its data, on which bodies take their turns.

use std::sync::Arc;

use emp_robot::Robot;
use mujoco_rs::prelude::*;
use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};

use super::apply::apply;
use super::body::{Body, Reading, SelfContact};
use super::fields::ModelFields;
use super::pace::Pace;
use super::parameters::{BodyParameters, Physics};
use super::rig::{FootRig, Rig};
use crate::{Divergence, SimError};

/// MuJoCo prints a warning that it gives for the first time. Diverging is part of training: warnings start counting here.
const WARNED: i32 = 1;

/// Numbers of the base's position and orientation in `qpos`, and of its velocity in `qvel`.
const BASE_POSITION: usize = 7;
const BASE_VELOCITY: usize = 6;

/// Joint targets of one control period.
#[derive(Clone, Copy, Debug)]
pub struct Targets<'a> {
    /// Angles of the goal joints, rad.
    pub goal: &'a [f32],
    /// Angles of the leg joints, rad.
    pub legs: &'a [f32],
}

/// How a body is placed: upright at the world's origin, heading along x, at rest.
#[derive(Clone, Debug)]
pub struct Start<'a> {
    /// Angles of all joints, goal joints first, rad.
    pub joint_positions: &'a [f64],
    /// Height of the lower foot above the floor, metres.
    pub lift: f64,
    /// Its physical parameters.
    pub parameters: BodyParameters,
}

/// A place where bodies are simulated, one after the other.
#[derive(Debug)]
pub struct Stage {
    pub(super) rig: Arc<Rig>,
    pub(super) data: MjData<Box<MjModel>>,
    /// What the model's fields are now.
    fields: Arc<ModelFields>,
    /// The paces of exact and of fast physics, and which of them the model has now.
    paces: [Pace; 2],
    physics: Physics,
}

impl Stage {
    /// A stage for bodies of `robot`.
    ///
    /// # Errors
    /// If MuJoCo has no memory for it.
    pub fn new(robot: &Robot) -> Result<Self, SimError> {
        let model = robot.model();
        let rig = Arc::new(Rig::new(robot, &model)?);
        Self::on_rig(rig, model)
    }

    /// A stage with a copy of the model that `rig` was made for.
    pub(crate) fn on_rig(rig: Arc<Rig>, mut model: MjModel) -> Result<Self, SimError> {
        // A diverged state is thrown away here, not replaced by MuJoCo in the middle of a control period.
        model.opt_mut().disableflags |= MjtDisableBit::mjDSBL_AUTORESET as i32;
        let mut stage = Self {
            fields: Arc::clone(&rig.nominal),
            paces: Pace::both(&model, rig.substeps),
            physics: Physics::Exact,
            data: MjData::try_new(Box::new(model))?,
            rig,
        };
        stage.clear();
        Ok(stage)
    }

    /// Places a new body.
    ///
    /// # Panics
    /// If there is not one angle for each joint.
    pub fn place(&mut self, start: &Start<'_>) -> Body {
        self.clear();
        let fields = self.derive(&start.parameters);
        self.load_fields(&fields);
        self.set_physics(start.parameters.physics);
        let rig = Arc::clone(&self.rig);
        assert_eq!(
            start.joint_positions.len(),
            rig.positions.len(),
            "joint angles"
        );
        let qpos = self.data.qpos_mut();
        qpos[..BASE_POSITION].copy_from_slice(&[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]);
        for (&address, &angle) in rig.positions.iter().zip(start.joint_positions) {
            qpos[address] = angle;
        }
        self.data.ctrl_mut().copy_from_slice(start.joint_positions);
        self.data.kinematics();
        self.data.qpos_mut()[2] = start.lift - self.lowest_sole();
        self.data.forward();
        let joints = rig.positions.len();
        let mut body = Body {
            parameters: start.parameters.clone(),
            fields: Some(fields),
            qpos: self.data.qpos().to_vec(),
            qvel: self.data.qvel().to_vec(),
            warm_start: self.data.qacc_warmstart().to_vec(),
            control: start.joint_positions.to_vec(),
            reading: Reading {
                joint_positions: vec![0.0; joints],
                joint_velocities: vec![0.0; joints],
                joint_accelerations: vec![0.0; joints],
                torques: vec![0.0; joints],
                ..Reading::default()
            },
        };
        let mut contact = SelfContact::default();
        self.add_self_contact(&mut contact);
        self.read(&mut body, contact);
        body
    }

    /// Mass of the body that stood here last, kg.
    pub(crate) fn mass(&self) -> f64 {
        self.data.model().body_subtreemass()[self.rig.base]
    }

    /// Simulates `body` for one control period with the given targets, and measures it.
    ///
    /// The motors follow the new targets after the body's delay, the previous ones until then; in the physics step in which
    /// the delay ends they follow a mixture, by its share in that step. (MuJoCo has an actuator delay of its own. It keeps a
    /// history of controls and their times in the data, as further state of every body, and answers with a sample of that
    /// history; two targets and one number do the same for a delay within a control period.)
    ///
    /// If the simulation diverges, the body stays as it was and the reading says so.
    ///
    /// # Panics
    /// If there is not one target for each joint.
    pub fn step<'b>(&mut self, body: &'b mut Body, targets: &Targets<'_>) -> &'b Reading {
        assert_eq!(
            targets.goal.len() + targets.legs.len(),
            body.control.len(),
            "joint targets"
        );
        self.load(body);
        match self.simulate(body, targets) {
            Ok(contact) => {
                let targets = targets.goal.iter().chain(targets.legs);
                for (control, &target) in body.control.iter_mut().zip(targets) {
                    *control = f64::from(target);
                }
                self.read(body, contact);
                body.qpos.copy_from_slice(self.data.qpos());
                body.qvel.copy_from_slice(self.data.qvel());
                body.warm_start.copy_from_slice(self.data.qacc_warmstart());
            }
            Err(divergence) => {
                body.reading.divergence = Some(divergence);
                self.clear();
            }
        }
        &body.reading
    }

    fn simulate(&mut self, body: &Body, targets: &Targets<'_>) -> Result<SelfContact, Divergence> {
        let substeps = self.pace().substeps;
        let delay = body.parameters.motor_delay / self.data.model_opt().timestep;
        let mut contact = SelfContact::default();
        for substep in 0..substeps {
            let old = (delay - substep as f64).clamp(0.0, 1.0);
            let targets = targets.goal.iter().chain(targets.legs);
            let controls = self.data.ctrl_mut().iter_mut();
            for ((control, &previous), &target) in controls.zip(&body.control).zip(targets) {
                *control = old * previous + (1.0 - old) * f64::from(target);
            }
            self.data.step();
            if let Some(divergence) = Divergence::warned(self.data.warning(), WARNED) {
                return Err(divergence);
            }
            self.add_self_contact(&mut contact);
        }
        contact.force /= substeps as f64;
        Divergence::of_state(&self.data).map_or(Ok(contact), Err)
    }

    /// Puts a body on the stage.
    fn load(&mut self, body: &mut Body) {
        let fields = match &body.fields {
            Some(fields) => Arc::clone(fields),
            None => {
                let fields = self.derive(&body.parameters);
                body.fields = Some(Arc::clone(&fields));
                fields
            }
        };
        self.load_fields(&fields);
        self.set_physics(body.parameters.physics);
        self.data.qpos_mut().copy_from_slice(&body.qpos);
        self.data.qvel_mut().copy_from_slice(&body.qvel);
        self.data
            .qacc_warmstart_mut()
            .copy_from_slice(&body.warm_start);
    }

    fn pace(&self) -> Pace {
        Pace::of(self.physics, &self.paces)
    }

    fn set_physics(&mut self, physics: Physics) {
        if self.physics != physics {
            self.physics = physics;
            let pace = self.pace();
            pace.write(self.model_mut());
        }
    }

    fn load_fields(&mut self, fields: &Arc<ModelFields>) {
        if !Arc::ptr_eq(&self.fields, fields) {
            fields.write(self.model_mut());
            self.fields = Arc::clone(fields);
        }
    }

    /// What `parameters` make of the model. Leaves the stage without a body.
    fn derive(&mut self, parameters: &BodyParameters) -> Arc<ModelFields> {
        let nominal = Arc::clone(&self.rig.nominal);
        if parameters.leave_the_model() {
            return nominal;
        }
        let rig = Arc::clone(&self.rig);
        self.load_fields(&nominal);
        apply(parameters, &rig, self.model_mut());
        self.data.set_const();
        self.fields = Arc::new(ModelFields::read(self.data.model()));
        Arc::clone(&self.fields)
    }

    pub(super) fn model_mut(&mut self) -> &mut MjModel {
        // SAFETY: the callers, all in this module, write fields that hold physical quantities; the model stays itself, with
        // its sizes, indices and addresses.
        unsafe { self.data.model_mut() }
    }

    /// Forgets whatever was on the stage, warnings too.
    fn clear(&mut self) {
        self.data.reset();
        for warning in self.data.warning_mut() {
            warning.number = WARNED;
        }
    }

    fn lowest_sole(&self) -> f64 {
        let bottoms = self.rig.feet.iter().flat_map(|foot| {
            let heights = foot
                .geoms
                .iter()
                .map(|&geom| self.data.geom_xpos()[geom][2]);
            heights.map(|height| height - foot.radius)
        });
        bottoms.fold(f64::INFINITY, f64::min)
    }

    /// Adds the self-contacts of the last physics step. The contact points of one pair are one force; those of two pairs never
    /// cancel.
    fn add_self_contact(&self, sum: &mut SelfContact) {
        let mut pairs: Vec<([i32; 2], Vector3<f64>)> = Vec::new();
        for (id, contact) in self.data.contact().iter().enumerate() {
            let Some(pair) = self.rig.pairs.touching(contact) else {
                continue;
            };
            let [x, y, z, ..] = self.data.contact_force(id);
            // Rows of the frame are the contact's axes; the force is what the first geom does to the second.
            let force = Matrix3::from_row_slice(&contact.frame).transpose() * Vector3::new(x, y, z);
            let on_second = if contact.geom == pair { force } else { -force };
            match pairs.iter_mut().find(|(known, _)| *known == pair) {
                Some((_, sum)) => *sum += on_second,
                None => pairs.push((pair, on_second)),
            }
        }
        sum.force += pairs.iter().map(|(_, force)| force.norm()).sum::<f64>();
        sum.touched |= !pairs.is_empty();
    }

    /// Measures the body on the stage, whose state still is that of before the control period.
    fn read(&self, body: &mut Body, self_contact: SelfContact) {
        let (qpos, qvel, rig) = (self.data.qpos(), self.data.qvel(), &*self.rig);
        let reading = &mut body.reading;
        let period = self.pace().substeps as f64 * self.data.model_opt().timestep;
        for (joint, (&position, &velocity)) in rig.positions.iter().zip(&rig.velocities).enumerate()
        {
            reading.joint_positions[joint] = qpos[position] as f32;
            reading.joint_velocities[joint] = qvel[velocity] as f32;
            let change = qvel[velocity] - body.qvel[velocity];
            reading.joint_accelerations[joint] = (change / period) as f32;
            reading.torques[joint] = self.data.actuator_force()[joint] as f32;
        }
        reading.position = Vector3::from_column_slice(&qpos[..3]);
        let [w, x, y, z] = [3, 4, 5, 6].map(|i| qpos[i]);
        reading.orientation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
        reading.linear_velocity = Vector3::from_column_slice(&qvel[..3]);
        reading.angular_velocity = Vector3::from_column_slice(&qvel[3..BASE_VELOCITY]);
        let before = Vector3::from_column_slice(&body.qvel[..3]);
        reading.velocity_change = reading.linear_velocity - before;
        reading.center_of_mass = Vector3::from(self.data.subtree_com()[rig.base]);
        for (reading, foot) in reading.feet.iter_mut().zip(&rig.feet) {
            let arm = Matrix3::from_row_slice(&self.data.xmat()[foot.body]) * foot.sole;
            let velocity = self.foot_velocity(foot, &arm);
            reading.position = Vector3::from(self.data.xpos()[foot.body]) + arm;
            reading.velocity = velocity;
            reading.force = 0.0;
        }
        for (id, contact) in self.data.contact().iter().enumerate() {
            let foot = contact.geom.iter().find_map(|&geom| rig.foot_of(geom));
            if let Some(foot) = foot {
                reading.feet[foot].force += self.data.contact_force(id)[0];
            }
        }
        reading.self_contact = self_contact;
        reading.divergence = None;
    }

    /// Velocity in the world frame of a point at `arm` from the origin of the foot's body.
    fn foot_velocity(&self, foot: &FootRig, arm: &Vector3<f64>) -> Vector3<f64> {
        let body = MjtObjBase::mjOBJ_XBODY;
        let velocity = self.data.object_velocity(body, foot.body, false);
        let [angular, linear] = [0, 3].map(|i| Vector3::from_column_slice(&velocity[i..i + 3]));
        linear + angular.cross(arm)
    }
}
