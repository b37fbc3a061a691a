//! The loss of proximal policy optimisation, and its gradient by hand.

use super::settings::PpoSettings;

/// What was done in a part of a rollout and what came of it, one row a sample.
pub struct Samples {
    /// Actions taken (N × actions).
    pub actions: Vec<f32>,
    /// Log-probabilities of the actions when they were taken (N), up to the constant that [`log_probabilities`] leaves out.
    pub log_probabilities: Vec<f32>,
    /// Advantages, normalised over the rollout (N).
    pub advantages: Vec<f32>,
    /// What the critic should answer (N).
    pub returns: Vec<f32>,
}

/// Losses of some samples, summed over them, and the gradient of the loss to descend.
pub struct Losses {
    /// Clipped surrogate objective, negated.
    pub policy: f64,
    /// Squared value error.
    pub value: f64,
    /// The loss to descend: policy and weighted value, less the weighted entropy.
    pub total: f64,
    /// Its gradient with respect to the mean actions (N × actions).
    pub by_means: Vec<f32>,
    /// Its gradient with respect to the values (N).
    pub by_values: Vec<f32>,
    /// Its gradient with respect to the logarithms of the deviations.
    pub by_log_std: Vec<f32>,
}

impl Losses {
    /// The losses of `samples`, where the networks answer `means` (N × actions) and `values` (N).
    pub fn new(
        samples: &Samples,
        means: &[f32],
        log_std: &[f32],
        values: &[f32],
        settings: &PpoSettings,
    ) -> Self {
        let (actions, rows) = (log_std.len(), values.len());
        let entropy: f64 = log_std.iter().map(|&log| f64::from(log)).sum();
        let mut losses = Self {
            policy: 0.0,
            value: 0.0,
            total: 0.0,
            by_means: Vec::with_capacity(means.len()),
            by_values: Vec::with_capacity(rows),
            by_log_std: Vec::with_capacity(actions),
        };
        let mut by_log_std = vec![-settings.entropy_weight * rows as f64; actions];
        let now = log_probabilities(&samples.actions, means, log_std);
        let taken = samples.actions.chunks_exact(actions);
        for (row, (taken, means)) in taken.zip(means.chunks_exact(actions)).enumerate() {
            let advantage = f64::from(samples.advantages[row]);
            let ratio = f64::from(now[row] - samples.log_probabilities[row]).exp();
            let clipped = ratio.clamp(1.0 - settings.clip, 1.0 + settings.clip);
            losses.policy -= (ratio * advantage).min(clipped * advantage);
            // Where the clipped one is smaller, nothing moves it.
            let by_log = match ratio * advantage <= clipped * advantage {
                true => -ratio * advantage,
                false => 0.0,
            };
            for (joint, (action, mean)) in taken.iter().zip(means).enumerate() {
                let deviation = f64::from(log_std[joint]).exp();
                let z = f64::from(action - mean) / deviation;
                losses.by_means.push((by_log * z / deviation) as f32);
                by_log_std[joint] += by_log * (z * z - 1.0);
            }
            let error = f64::from(values[row]) - f64::from(samples.returns[row]);
            losses.value += error * error;
            let by_value = 2.0 * settings.value_weight * error;
            losses.by_values.push(by_value as f32);
        }
        losses.total = losses.policy + settings.value_weight * losses.value
            - settings.entropy_weight * entropy * rows as f64;
        let by_log_std = by_log_std.into_iter().map(|sum| sum as f32);
        losses.by_log_std.extend(by_log_std);
        losses
    }
}

/// Log-probability of each row of actions under a Gaussian, without the constant `−n/2 ln 2π`.
pub fn log_probabilities(actions: &[f32], means: &[f32], log_std: &[f32]) -> Vec<f32> {
    let width = log_std.len();
    let scales: Vec<f32> = log_std.iter().map(|log| (-log).exp()).collect();
    let constant: f32 = log_std.iter().sum();
    let rows = actions.chunks_exact(width).zip(means.chunks_exact(width));
    let row = |(actions, means): (&[f32], &[f32])| {
        let deviations = actions.iter().zip(means).zip(&scales);
        let squares = deviations.map(|((action, mean), scale)| ((action - mean) * scale).powi(2));
        -0.5 * squares.sum::<f32>() - constant
    };
    rows.map(row).collect()
}

/// Sum over rows of the Kullback–Leibler divergence of the Gaussian (`means`, `log_std`) from (`old_means`, `old_log_std`).
pub fn divergence(old_means: &[f32], means: &[f32], old_log_std: &[f32], log_std: &[f32]) -> f64 {
    let actions = log_std.len();
    let rows = means
        .chunks_exact(actions)
        .zip(old_means.chunks_exact(actions));
    let deviations = || {
        old_log_std
            .iter()
            .zip(log_std)
            .map(|(old, new)| (f64::from(*old), f64::from(*new)))
    };
    let row = |(means, old_means): (&[f32], &[f32])| {
        let shifts = means
            .iter()
            .zip(old_means)
            .map(|(new, old)| f64::from(new - old));
        let terms = shifts.zip(deviations()).map(|(shift, (old, new))| {
            new - old + ((2.0 * old).exp() + shift * shift) / (2.0 * (2.0 * new).exp()) - 0.5
        });
        terms.sum::<f64>()
    };
    rows.map(row).sum()
}

/// The step size after a mini-batch whose divergence was `divergence`, between `lowest` and `highest`: it follows `target`.
pub fn adapted_learning_rate(
    learning_rate: f64,
    divergence: f64,
    target: f64,
    [lowest, highest]: [f64; 2],
) -> f64 {
    const FACTOR: f64 = 1.5;
    if divergence > 2.0 * target {
        (learning_rate / FACTOR).max(lowest)
    } else if divergence < 0.5 * target {
        (learning_rate * FACTOR).min(highest)
    } else {
        learning_rate
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ACTIONS: [f32; 6] = [0.3, -0.2, 1.1, 0.4, -0.6, 0.1];
    const MEANS: [f32; 6] = [0.1, -0.1, 0.9, 0.5, 0.2, 0.3];
    const LOG_STD: [f32; 2] = [-0.5, -0.2];
    /// Log-ratios that are inside the clip, beyond it upwards, beyond it downwards.
    const LOG_RATIOS: [f32; 3] = [0.05, 0.4, -0.4];
    const RETURNS: [f32; 3] = [1.0, -2.0, 0.5];
    const VALUES: [f32; 3] = [0.5, -1.0, 0.7];

    fn samples(advantages: [f32; 3]) -> Samples {
        let now = log_probabilities(&ACTIONS, &MEANS, &LOG_STD);
        let old = now.iter().zip(LOG_RATIOS).map(|(now, ratio)| now - ratio);
        Samples {
            actions: ACTIONS.to_vec(),
            log_probabilities: old.collect(),
            advantages: advantages.to_vec(),
            returns: RETURNS.to_vec(),
        }
    }

    #[test]
    fn a_density_is_the_gaussians() {
        for (row, density) in log_probabilities(&ACTIONS, &MEANS, &LOG_STD)
            .iter()
            .enumerate()
        {
            let term = |j: usize| {
                let z = (ACTIONS[2 * row + j] - MEANS[2 * row + j]) / LOG_STD[j].exp();
                -0.5 * z * z - LOG_STD[j]
            };
            assert!((density - term(0) - term(1)).abs() < 1e-6);
        }
    }

    #[test]
    fn the_surrogate_is_clipped_where_clipping_costs() {
        let ratios = LOG_RATIOS.map(|log| f64::from(log).exp());
        for (advantages, expected) in [
            ([2.0, 2.0, 2.0], 2.0 * (ratios[0] + 1.2 + ratios[2])),
            ([-1.0, -1.0, -1.0], -(ratios[0] + ratios[1] + 0.8)),
        ] {
            let settings = PpoSettings {
                entropy_weight: 0.5,
                ..PpoSettings::default()
            };
            let samples = samples(advantages);
            let losses = Losses::new(&samples, &MEANS, &LOG_STD, &VALUES, &settings);
            assert!((losses.policy + expected).abs() < 1e-5);
            assert!((losses.value - (0.25 + 1.0 + 0.04)).abs() < 1e-5);
            let total = losses.policy + losses.value - 0.5 * 3.0 * -0.7;
            assert!((losses.total - total).abs() < 1e-5);
        }
    }

    #[test]
    fn gradients_equal_finite_differences() {
        const STEP: f32 = 1e-2;
        let settings = PpoSettings {
            entropy_weight: 0.3,
            value_weight: 0.7,
            ..PpoSettings::default()
        };
        let samples = samples([1.5, -0.7, 0.4]);
        let losses = |means: &[f32], log_std: &[f32], values: &[f32]| {
            Losses::new(&samples, means, log_std, values, &settings)
        };
        let here = losses(&MEANS, &LOG_STD, &VALUES);
        let check = |start: &[f32], gradient: &[f32], total: &dyn Fn(&[f32]) -> f64| {
            assert_eq!(start.len(), gradient.len());
            for (i, gradient) in gradient.iter().enumerate() {
                let at = |step: f32| {
                    let mut values = start.to_vec();
                    values[i] += step;
                    total(&values)
                };
                let slope = (at(STEP) - at(-STEP)) / f64::from(2.0 * STEP);
                let error = (slope - f64::from(*gradient)).abs();
                assert!(error < 2e-3 * (1.0 + slope.abs()), "{slope} {gradient}");
            }
        };
        check(&MEANS, &here.by_means, &|means| {
            losses(means, &LOG_STD, &VALUES).total
        });
        check(&LOG_STD, &here.by_log_std, &|log| {
            losses(&MEANS, log, &VALUES).total
        });
        check(&VALUES, &here.by_values, &|values| {
            losses(&MEANS, &LOG_STD, values).total
        });
    }

    #[test]
    fn divergence_of_equal_gaussians_is_zero_and_grows_with_shift_and_width() {
        assert_eq!(
            divergence(&[0.3, 0.4], &[0.3, 0.4], &[-1.0, 0.2], &[-1.0, 0.2]),
            0.0
        );
        // A shift of 0.5 at deviation 0.5: ½ (0.5 / 0.5)².
        let half = 0.5f32.ln();
        assert!((divergence(&[0.0], &[0.5], &[half], &[half]) - 0.5).abs() < 1e-6);
        // From deviation 0.5 to 1: ln 2 + ⅛ − ½.
        let expected = 2f64.ln() + 0.125 - 0.5;
        assert!(
            (divergence(&[0.0, 1.0], &[0.0, 1.0], &[half], &[0.0]) - 2.0 * expected).abs() < 1e-6
        );
    }

    #[test]
    fn the_step_follows_the_divergence_within_its_bounds() {
        let next = |rate, divergence| adapted_learning_rate(rate, divergence, 0.01, [5e-5, 1e-3]);
        assert!((next(3e-4, 0.03) - 2e-4).abs() < 1e-12);
        assert!((next(3e-4, 0.001) - 4.5e-4).abs() < 1e-12);
        assert_eq!(next(3e-4, 0.01), 3e-4);
        assert_eq!((next(6e-5, 1.0), next(9e-4, 0.0)), (5e-5, 1e-3));
    }
}
