//! What a body's parameters change in a model.

use mujoco_rs::prelude::*;

use super::fields::GAIN;
use super::parameters::{BodyParameters, factor};
use super::rig::Rig;

/// No body gets lighter than this share of its own mass: the base of a light robot with the range of a heavy one.
const LEAST_MASS: f64 = 0.1;

/// Numbers of a servo's bias terms in angle and speed.
const BIAS: [usize; 2] = [1, 2];

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
