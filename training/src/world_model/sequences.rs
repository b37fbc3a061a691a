//! What a world model learns from: moments of robots, and the control periods that followed.

use emp_models::observation::ObservationLayout;

use crate::rows::gather;

/// N moments and the control periods that followed them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Sequences {
    /// Stacks `S_t` with the executed goal in the newest frame, N × [`ObservationLayout::width`].
    pub stacks: Vec<f32>,
    /// The control periods t, t + 1, …, at least one.
    pub periods: Vec<Period>,
}

/// One control period of N robots.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Period {
    /// Actions, N × leg joints, policy units.
    pub actions: Vec<f32>,
    /// `[q | roll, pitch, yaw]` at its end, N × (joints + 3), rad.
    pub next: Vec<f32>,
    /// Goals that are executed in the period after it, N × goal joints, rad. Those of the last period are not read.
    pub goals: Vec<f32>,
}

/// Trajectories as a rollout keeps them: row t·N + n is control period t of environment n.
#[derive(Clone, Copy, Debug)]
pub struct Trajectories<'a> {
    /// N.
    pub environments: usize,
    /// Stacks `S_t`, whatever their newest goals.
    pub stacks: &'a [f32],
    /// Executed goals, rad.
    pub executed: &'a [f32],
    /// Actions, policy units.
    pub actions: &'a [f32],
    /// `[q | roll, pitch, yaw]` of the next frame, before any reset, rad.
    pub next: &'a [f32],
}

impl Sequences {
    /// The sequences of `steps` control periods that start at `rows`. The caller sees to it that no episode ends within one,
    /// nor the rollout.
    pub fn gather(
        trajectories: &Trajectories<'_>,
        layout: &ObservationLayout,
        rows: &[usize],
        steps: usize,
    ) -> Self {
        let goals = layout.goal().len();
        let mut stacks = gather(trajectories.stacks, layout.width(), rows);
        for (stack, &row) in stacks.chunks_exact_mut(layout.width()).zip(rows) {
            let executed = &trajectories.executed[row * goals..(row + 1) * goals];
            stack[layout.newest_goal()].copy_from_slice(executed);
        }
        let next = layout.joint_positions().len() + layout.orientation().len();
        let later = |periods: usize| -> Vec<usize> {
            let ahead = periods * trajectories.environments;
            rows.iter().map(|row| row + ahead).collect()
        };
        let periods = (0..steps).map(|period| {
            let rows = later(period);
            let following = later((period + 1).min(steps - 1));
            Period {
                actions: gather(trajectories.actions, layout.last_action().len(), &rows),
                next: gather(trajectories.next, next, &rows),
                goals: gather(trajectories.executed, goals, &following),
            }
        });
        Self {
            stacks,
            periods: periods.collect(),
        }
    }

    /// Number of moments.
    pub fn len(&self, layout: &ObservationLayout) -> usize {
        self.stacks.len() / layout.width()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world_model::testing::robot;

    #[test]
    fn rows_of_a_rollout_follow_their_environment() {
        let layout = ObservationLayout::new(&robot(), 15);
        // Two environments, four periods; each number tells its row.
        let rows = |width: usize, plus: f32| -> Vec<f32> {
            (0..8 * width).map(|i| (i / width) as f32 + plus).collect()
        };
        let [stacks, executed, actions, next] =
            [(855, 0.0), (15, 0.25), (12, 0.5), (30, 0.75)].map(|(width, plus)| rows(width, plus));
        let trajectories = Trajectories {
            environments: 2,
            stacks: &stacks,
            executed: &executed,
            actions: &actions,
            next: &next,
        };
        let sequences = Sequences::gather(&trajectories, &layout, &[3, 0], 2);
        assert_eq!(sequences.len(&layout), 2);
        let (first, second) = sequences.stacks.split_at(855);
        assert_eq!((first[0], second[0]), (3.0, 0.0));
        assert_eq!(first[layout.newest_goal()], [3.25; 15]);
        let [now, then] = &sequences.periods[..] else {
            panic!("two periods")
        };
        assert_eq!([now.actions[0], now.actions[12]], [3.5, 0.5]);
        assert_eq!([now.next[0], now.next[30]], [3.75, 0.75]);
        assert_eq!([now.goals[0], now.goals[15]], [5.25, 2.25]);
        assert_eq!([then.actions[0], then.actions[12]], [5.5, 2.5]);
        assert_eq!([then.next[0], then.next[30]], [5.75, 2.75]);
        assert_eq!(then.goals.len(), 30);
    }
}
