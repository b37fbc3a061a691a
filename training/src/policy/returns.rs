//! Generalised advantage estimation.

/// What happened in N environments over T periods, row-major T × N.
pub struct Trajectories<'a> {
    /// Number N of environments.
    pub environments: usize,
    /// Reward of each period.
    pub rewards: &'a [f32],
    /// Value of the state before each period.
    pub values: &'a [f32],
    /// Value of the state after the last period (N).
    pub last_values: &'a [f32],
    /// Whether the episode ended with the period: nothing after it counts.
    pub ended: &'a [bool],
}

/// Advantages `A_t = Σ_k (γλ)ᵏ δ_{t+k}` up to the episode's end, with `δ_t = r_t + γ V_{t+1} − V_t`; T × N.
pub fn advantages(trajectories: &Trajectories<'_>, discount: f64, trace_decay: f64) -> Vec<f32> {
    let n = trajectories.environments;
    let mut advantages = vec![0.0; trajectories.rewards.len()];
    for environment in 0..n {
        let mut next_value = f64::from(trajectories.last_values[environment]);
        let mut next_advantage = 0.0;
        for i in (environment..advantages.len()).step_by(n).rev() {
            if trajectories.ended[i] {
                (next_value, next_advantage) = (0.0, 0.0);
            }
            let value = f64::from(trajectories.values[i]);
            let delta = f64::from(trajectories.rewards[i]) + discount * next_value - value;
            next_advantage = delta + discount * trace_decay * next_advantage;
            next_value = value;
            advantages[i] = next_advantage as f32;
        }
    }
    advantages
}

/// Mean 0 and deviation 1.
pub fn standardized(values: &[f32]) -> Vec<f32> {
    let (mean, variance) = mean_and_variance(values);
    let scale = 1.0 / (variance.sqrt() + 1e-8);
    values
        .iter()
        .map(|x| ((f64::from(*x) - mean) * scale) as f32)
        .collect()
}

/// Share of the variance of `returns` that is not in `errors`.
pub fn explained_variance(returns: &[f32], errors: &[f32]) -> f64 {
    1.0 - mean_and_variance(errors).1 / mean_and_variance(returns).1.max(1e-12)
}

fn mean_and_variance(values: &[f32]) -> (f64, f64) {
    let count = values.len().max(1) as f64;
    let mean = values.iter().map(|x| f64::from(*x)).sum::<f64>() / count;
    let squares = values.iter().map(|x| (f64::from(*x) - mean).powi(2));
    (mean, squares.sum::<f64>() / count)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equals_a_case_by_hand() {
        // Two environments, three periods; the second environment's episode ends with its second period.
        let trajectories = Trajectories {
            environments: 2,
            rewards: &[1.0, 2.0, 0.0, 1.0, -1.0, 3.0],
            values: &[0.5, 1.0, 1.5, 2.0, 0.0, 4.0],
            last_values: &[2.0, 1.0],
            ended: &[false, false, false, true, false, false],
        };
        let (discount, decay) = (0.5, 0.8);
        // First: δ = (1 + .75 − .5, 0 + 0 − 1.5, −1 + 1 − 0) = (1.25, −1.5, 0); γλ = 0.4.
        // Second: δ = (2 + 1 − 1, 1 − 2, 3 + .5 − 4) = (2, −1, −.5), cut after the second.
        let expected = [1.25 - 0.6, 2.0 - 0.4, -1.5, -1.0, 0.0, -0.5];
        for (a, b) in advantages(&trajectories, discount, decay)
            .iter()
            .zip(expected)
        {
            assert!((a - b).abs() < 1e-6, "{a} {b}");
        }
    }
}
