//! The fields of a model that differ between bodies.

use mujoco_rs::mujoco_c::mjNBIAS;
use mujoco_rs::prelude::*;
use mujoco_rs::wrappers::mj_auxiliary::MjStatistic;
use mujoco_rs::wrappers::mj_model::MjtSameFrame;

/// Number of the stiffness in a servo's gains.
pub(super) const GAIN: usize = 0;

/// Declares the fields that are copied between a model and [`ModelFields`] as they are.
macro_rules! model_fields {
    ($($(#[$doc:meta])* $name:ident / $name_mut:ident: $type:ty,)*) => {
        /// A model's fields that [`BodyParameters`](super::BodyParameters) change, and those that MuJoCo derives from them (`mj_setConst`).
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
