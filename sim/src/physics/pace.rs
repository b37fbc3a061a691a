//! How long physics steps are, and how hard the solver tries.

use mujoco_rs::prelude::*;

use super::parameters::Physics;

/// Physics steps of [`Physics::Fast`] for four exact ones.
const FAST_STEPS: usize = 3;
/// Its limits of the solver: Newton steps, steps of each line search, improvement at which it stops.
const FAST_ITERATIONS: i32 = 4;
const FAST_SEARCH: i32 = 8;
const FAST_TOLERANCE: f64 = 1e-5;

/// The options of a model that decide how exactly it is simulated.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pace {
    /// Physics steps in one control period.
    pub(super) substeps: usize,
    /// Length of one, seconds.
    timestep: f64,
    iterations: i32,
    search: i32,
    tolerance: f64,
}

impl Pace {
    /// That of the robot's files, and that of fast physics.
    pub(super) fn both(model: &MjModel, substeps: usize) -> [Self; 2] {
        let option = model.opt();
        let exact = Self {
            substeps,
            timestep: option.timestep,
            iterations: option.iterations,
            search: option.ls_iterations,
            tolerance: option.tolerance,
        };
        let fewer = (substeps * FAST_STEPS).div_ceil(4).max(1);
        let fast = Self {
            substeps: fewer,
            timestep: substeps as f64 * option.timestep / fewer as f64,
            iterations: FAST_ITERATIONS,
            search: FAST_SEARCH,
            tolerance: FAST_TOLERANCE,
        };
        [exact, fast]
    }

    /// The one for `physics`, of those that [`both`](Self::both) gives.
    pub(super) fn of(physics: Physics, both: &[Self; 2]) -> Self {
        match physics {
            Physics::Exact => both[0],
            Physics::Fast => both[1],
        }
    }

    pub(super) fn write(&self, model: &mut MjModel) {
        let option = model.opt_mut();
        option.timestep = self.timestep;
        option.iterations = self.iterations;
        option.ls_iterations = self.search;
        option.tolerance = self.tolerance;
    }
}
