//! The fields of a model that differ between bodies.

use mujoco_rs::mujoco_c::mjNBIAS;
use mujoco_rs::prelude::*;
use mujoco_rs::wrappers::mj_auxiliary::MjStatistic;
use mujoco_rs::wrappers::mj_model::MjtSameFrame;

use super::parameters::{BodyParameters, factor};
use super::rig::Rig;

/// No body gets lighter than this share of its own mass: the base of a light robot with the range of a heavy one.
const LEAST_MASS: f64 = 0.1;

/// Numbers of the first stiffness term of a servo, and of its terms in angle and speed.
const GAIN: usize = 0;
const BIAS: [usize; 2] = [1, 2];

/// Declares the fields that are copied between a model and [`ModelFields`] as they are.
macro_rules! model_fields {
    ($($(#[$doc:meta])* $name:ident / $name_mut:ident: $type:ty,)*) => {
        /// A model's fields that [`BodyParameters`] change, and those that MuJoCo derives from them (`mj_setConst`).
        #[derive(Debug)]
        pub(crate) struct ModelFields {
            $($(#[$doc])* $name: Box<[$type]>,)*
            /// Stiffness, by actuator.
            gain: Box<[f64]>,
            statistic: MjStatistic,
        }

        impl ModelFields {
            /// The fields of `model`.
            pub(crate) fn read(model: &MjModel) -> Self {
                Self {
                    $($name: model.$name().into(),)*
                    gain: model.actuator_gainprm().iter().map(|gain| gain[GAIN]).collect(),
                    statistic: model.stat().clone(),
                }
            }

            /// Puts the fields into `model`, which has to be of the robot they were read from.
            pub(crate) fn write(&self, model: &mut MjModel) {
                $(model.$name_mut().copy_from_slice(&self.$name);)*
                // SAFETY: an affine servo reads its first gain as a number, no matter which: it is no index or size.
                let gains = unsafe { model.actuator_gainprm_mut() };
                for (gain, &value) in gains.iter_mut().zip(&self.gain) {
                    gain[GAIN] = value;
                }
                *model.stat_mut() = self.statistic.clone();
            }
        }
    };
}

model_fields! {
    body_mass / body_mass_mut: f64,
    body_inertia / body_inertia_mut: [f64; 3],
    body_ipos / body_ipos_mut: [f64; 3],
    geom_friction / geom_friction_mut: [f64; 3],
    dof_damping / dof_damping_mut: f64,
    actuator_biasprm / actuator_biasprm_mut: [f64; mjNBIAS as usize],
    actuator_forcerange / actuator_forcerange_mut: [f64; 2],
    /// From here on derived.
    body_subtreemass / body_subtreemass_mut: f64,
    body_invweight0 / body_invweight0_mut: [f64; 2],
    dof_invweight0 / dof_invweight0_mut: f64,
    dof_m0 / dof_m0_mut: f64,
    dof_length / dof_length_mut: f64,
    actuator_acc0 / actuator_acc0_mut: f64,
    body_sameframe / body_sameframe_mut: MjtSameFrame,
    geom_sameframe / geom_sameframe_mut: MjtSameFrame,
    site_sameframe / site_sameframe_mut: MjtSameFrame,
}

/// Changes `model`, which has to have its nominal fields, to what `parameters` say. The derived fields are left to
/// `mj_setConst`.
pub(crate) fn apply(parameters: &BodyParameters, rig: &Rig, model: &mut MjModel) {
    for foot in rig.feet.iter().flat_map(|foot| &foot.geoms) {
        model.geom_friction_mut()[*foot][0] *= parameters.friction;
    }
    for body in 0..model.body_mass().len() {
        apply_mass(parameters, rig, model, body);
    }
    for (position, offset) in model.body_ipos_mut()[rig.base]
        .iter_mut()
        .zip(parameters.base_com)
    {
        *position += offset;
    }
    for (joint, &dof) in rig.velocities.iter().enumerate() {
        model.dof_damping_mut()[dof] *= factor(&parameters.motor_damping, joint);
        apply_servo(parameters, model, joint);
    }
}

/// Mass and inertia of one body: added mass is spread as the body's own.
fn apply_mass(parameters: &BodyParameters, rig: &Rig, model: &mut MjModel, body: usize) {
    let nominal = model.body_mass()[body];
    let mut mass = nominal * factor(&parameters.link_mass, body);
    if body == rig.base {
        mass += parameters.base_mass;
    }
    for (hand, added) in rig.hands.iter().zip(parameters.hand_mass) {
        if body == *hand {
            mass += added;
        }
    }
    let mass = mass.max(LEAST_MASS * nominal);
    model.body_mass_mut()[body] = mass;
    if nominal > 0.0 {
        let scale = mass / nominal * factor(&parameters.link_inertia, body);
        for inertia in &mut model.body_inertia_mut()[body] {
            *inertia *= scale;
        }
    }
}

/// Gains and torque limit of one joint's servo.
fn apply_servo(parameters: &BodyParameters, model: &mut MjModel, joint: usize) {
    let stiffness = factor(&parameters.p_gain, joint);
    // SAFETY: an affine servo reads its first gain as a number, no matter which: it is no index or size.
    let gains = unsafe { model.actuator_gainprm_mut() };
    gains[joint][GAIN] *= stiffness;
    let bias = &mut model.actuator_biasprm_mut()[joint];
    bias[BIAS[0]] *= stiffness;
    bias[BIAS[1]] *= factor(&parameters.d_gain, joint);
    for limit in &mut model.actuator_forcerange_mut()[joint] {
        *limit *= factor(&parameters.motor_torque, joint);
    }
}
