//! The loss of proximal policy optimisation.

use candle_core::{D, Tensor};

use super::settings::PpoSettings;

/// What was done in a part of a rollout and what came of it, one row a sample.
pub struct Samples {
    /// Actions taken (N × actions).
    pub actions: Tensor,
    /// Log-probabilities of the actions when they were taken (N), up to the constant that [`log_probabilities`] leaves out.
    pub log_probabilities: Tensor,
    /// Advantages, normalised over the rollout (N).
    pub advantages: Tensor,
    /// What the critic should answer (N).
    pub returns: Tensor,
}

/// Losses of some samples, summed over them.
pub struct Losses {
    /// Clipped surrogate objective, negated.
    pub policy: Tensor,
    /// Squared value error.
    pub value: Tensor,
    /// Entropy of the policy, up to a constant.
    pub entropy: Tensor,
}

impl Losses {
    /// The losses of `samples`, where the networks answer `means` (N × actions) and `values` (N).
    ///
    /// # Errors
    /// When shapes do not fit.
    pub fn new(
        samples: &Samples,
        means: &Tensor,
        log_std: &Tensor,
        values: &Tensor,
        clip: f64,
    ) -> candle_core::Result<Self> {
        let log_probabilities = log_probabilities(&samples.actions, means, log_std)?;
        let ratio = (log_probabilities - &samples.log_probabilities)?.exp()?;
        let clipped = ratio.clamp(1.0 - clip, 1.0 + clip)?;
        let surrogate = (ratio * &samples.advantages)?
            .minimum(&(clipped * &samples.advantages)?)?
            .sum_all()?;
        let rows = samples.returns.dim(0)? as f64;
        Ok(Self {
            policy: surrogate.neg()?,
            value: (values - &samples.returns)?.sqr()?.sum_all()?,
            entropy: (log_std.sum_all()? * rows)?,
        })
    }

    /// The loss to descend.
    ///
    /// # Errors
    /// When the tensor library fails.
    pub fn total(&self, settings: &PpoSettings) -> candle_core::Result<Tensor> {
        let value = (&self.value * settings.value_weight)?;
        let entropy = (&self.entropy * settings.entropy_weight)?;
        (&self.policy + value)? - entropy
    }
}

/// Log-probability of each row of actions under a Gaussian, without the constant `−n/2 ln 2π`.
///
/// # Errors
/// When shapes do not fit.
pub fn log_probabilities(
    actions: &Tensor,
    means: &Tensor,
    log_std: &Tensor,
) -> candle_core::Result<Tensor> {
    let deviation = (actions - means)?.broadcast_div(&log_std.exp()?)?;
    let squares = (deviation.sqr()?.sum(D::Minus1)? * -0.5)?;
    squares.broadcast_sub(&log_std.sum_all()?)
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
    use candle_core::{Device, Var};

    const ACTIONS: [f64; 6] = [0.3, -0.2, 1.1, 0.4, -0.6, 0.1];
    const MEANS: [f64; 6] = [0.1, -0.1, 0.9, 0.5, 0.2, 0.3];
    const LOG_STD: [f64; 2] = [-0.5, -0.2];
    /// Log-ratios that are inside the clip, beyond it upwards, beyond it downwards.
    const LOG_RATIOS: [f64; 3] = [0.05, 0.4, -0.4];
    const RETURNS: [f64; 3] = [1.0, -2.0, 0.5];
    const VALUES: [f64; 3] = [0.5, -1.0, 0.7];

    fn density(row: usize) -> f64 {
        let term = |j: usize| {
            let z = (ACTIONS[2 * row + j] - MEANS[2 * row + j]) / LOG_STD[j].exp();
            -0.5 * z * z - LOG_STD[j]
        };
        term(0) + term(1)
    }

    struct Case {
        samples: Samples,
        means: Var,
        log_std: Var,
        values: Var,
    }

    fn case(advantages: [f64; 3]) -> Case {
        let tensor = |values: &[f64]| Tensor::new(values, &Device::Cpu).unwrap();
        let rows = |values: &[f64]| tensor(values).reshape((3, 2)).unwrap();
        let old: Vec<f64> = (0..3).map(|row| density(row) - LOG_RATIOS[row]).collect();
        Case {
            samples: Samples {
                actions: rows(&ACTIONS),
                log_probabilities: tensor(&old),
                advantages: tensor(&advantages),
                returns: tensor(&RETURNS),
            },
            means: Var::from_tensor(&rows(&MEANS)).unwrap(),
            log_std: Var::from_tensor(&tensor(&LOG_STD)).unwrap(),
            values: Var::from_tensor(&tensor(&VALUES)).unwrap(),
        }
    }

    fn losses(case: &Case) -> Losses {
        Losses::new(&case.samples, &case.means, &case.log_std, &case.values, 0.2).unwrap()
    }

    fn scalar(tensor: &Tensor) -> f64 {
        tensor.to_scalar().unwrap()
    }

    #[test]
    fn the_surrogate_is_clipped_where_clipping_costs() {
        let ratios = LOG_RATIOS.map(f64::exp);
        for (advantages, expected) in [
            ([2.0, 2.0, 2.0], 2.0 * (ratios[0] + 1.2 + ratios[2])),
            ([-1.0, -1.0, -1.0], -(ratios[0] + ratios[1] + 0.8)),
        ] {
            let losses = losses(&case(advantages));
            assert!((scalar(&losses.policy) + expected).abs() < 1e-9);
            assert!((scalar(&losses.value) - (0.25 + 1.0 + 0.04)).abs() < 1e-9);
            assert!((scalar(&losses.entropy) - 3.0 * -0.7).abs() < 1e-9);
        }
    }

    #[test]
    fn gradients_equal_finite_differences() {
        let settings = PpoSettings {
            entropy_weight: 0.3,
            ..PpoSettings::default()
        };
        let case = case([1.5, -0.7, 0.4]);
        let total = || losses(&case).total(&settings).unwrap();
        let grads = total().backward().unwrap();
        for var in [&case.means, &case.log_std, &case.values] {
            let gradient = grads.get(var).unwrap().flatten_all().unwrap();
            let gradient = gradient.to_vec1::<f64>().unwrap();
            let start = var.flatten_all().unwrap().to_vec1::<f64>().unwrap();
            for (i, gradient) in gradient.into_iter().enumerate() {
                let at = |step: f64| {
                    let mut values = start.clone();
                    values[i] += step;
                    var.set(&Tensor::from_vec(values, var.shape(), &Device::Cpu).unwrap())
                        .unwrap();
                    scalar(&total())
                };
                let slope = (at(1e-6) - at(-1e-6)) / 2e-6;
                at(0.0);
                assert!((slope - gradient).abs() < 1e-6, "{slope} {gradient}");
            }
        }
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
