//! Running mean and variance of features.

use anyhow::{Context as _, Result, ensure};
use candle_core::{Device, Tensor};
use emp_models::{Mirror, checkpoint::Tensors, mlp::Normalizer};

/// Added to each deviation, so that a constant feature has a finite scale.
const EPSILON: f64 = 1e-4;

/// Mean and variance of each feature over all rows seen.
#[derive(Clone, Debug, PartialEq)]
pub struct RunningMoments {
    rows: f64,
    mean: Vec<f64>,
    variance: Vec<f64>,
}

impl RunningMoments {
    /// No rows yet: mean 0, variance 1.
    pub fn new(width: usize) -> Self {
        Self {
            rows: 0.0,
            mean: vec![0.0; width],
            variance: vec![1.0; width],
        }
    }

    /// Features in a row.
    pub fn width(&self) -> usize {
        self.mean.len()
    }

    /// Takes in rows of features (N × width), by Chan's update.
    pub fn update(&mut self, rows: &[f32]) {
        let width = self.width();
        let count = (rows.len() / width) as f64;
        if count == 0.0 {
            return;
        }
        let mut mean = vec![0.0; width];
        for row in rows.chunks_exact(width) {
            for (mean, &value) in mean.iter_mut().zip(row) {
                *mean += f64::from(value);
            }
        }
        mean.iter_mut().for_each(|mean| *mean /= count);
        let mut square = vec![0.0; width];
        for row in rows.chunks_exact(width) {
            for ((square, &value), mean) in square.iter_mut().zip(row).zip(&mean) {
                *square += (f64::from(value) - mean).powi(2);
            }
        }
        let total = self.rows + count;
        for (i, (mean, square)) in mean.into_iter().zip(square).enumerate() {
            let shift = mean - self.mean[i];
            let between = shift * shift * self.rows * count / total;
            self.variance[i] = (self.variance[i] * self.rows + square + between) / total;
            self.mean[i] += shift * count / total;
        }
        self.rows = total;
    }

    /// The moments of the rows and their mirror images together.
    #[must_use]
    pub fn symmetrized(&self, mirror: &Mirror) -> Self {
        let mut both = self.clone();
        for (i, (partner, sign)) in mirror.places().enumerate() {
            let (mean, image) = (self.mean[i], f64::from(sign) * self.mean[partner]);
            both.mean[i] = 0.5 * (mean + image);
            both.variance[i] =
                0.5 * (self.variance[i] + self.variance[partner]) + 0.25 * (mean - image).powi(2);
        }
        both
    }

    /// What brings features to zero mean and unit deviation.
    pub fn normalizer(&self) -> Normalizer {
        let scale = |variance: &f64| (1.0 / (variance.sqrt() + EPSILON)) as f32;
        Normalizer {
            mean: self.mean.iter().map(|&mean| mean as f32).collect(),
            scale: self.variance.iter().map(scale).collect(),
        }
    }

    /// Puts the moments into a checkpoint under `name`.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn save(&self, name: &str, tensors: &mut Tensors) -> Result<()> {
        let parts = [
            ("rows", &[self.rows][..]),
            ("mean", &self.mean),
            ("variance", &self.variance),
        ];
        for (part, values) in parts {
            tensors.insert(format!("{name}.{part}"), Tensor::new(values, &Device::Cpu)?);
        }
        Ok(())
    }

    /// Reads what [`save`](Self::save) wrote.
    ///
    /// # Errors
    /// When a tensor is missing or has another width.
    pub fn restore(&mut self, name: &str, tensors: &Tensors) -> Result<()> {
        let read = |part: &str, width: usize| {
            let name = format!("{name}.{part}");
            let tensor = tensors
                .get(&name)
                .with_context(|| format!("no tensor `{name}`"))?;
            let values = tensor
                .to_vec1::<f64>()
                .with_context(|| format!("tensor `{name}`"))?;
            ensure!(
                values.len() == width,
                "tensor `{name}`: {} numbers, expected {width}",
                values.len()
            );
            Ok(values)
        };
        let width = self.width();
        self.rows = read("rows", 1)?[0];
        self.mean = read("mean", width)?;
        self.variance = read("variance", width)?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rows() -> Vec<f32> {
        (0..40 * 3)
            .map(|i| (i as f32 * 0.7).sin() * (i % 3 + 1) as f32 + 5.0)
            .collect()
    }

    #[test]
    fn pieces_give_the_moments_of_the_whole() {
        let rows = rows();
        let mut moments = RunningMoments::new(3);
        for piece in [&rows[..9], &rows[9..60], &[], &rows[60..]] {
            moments.update(piece);
        }
        for column in 0..3 {
            let values: Vec<f64> = rows
                .iter()
                .skip(column)
                .step_by(3)
                .map(|x| f64::from(*x))
                .collect();
            let mean = values.iter().sum::<f64>() / 40.0;
            let variance = values.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / 40.0;
            assert!((moments.mean[column] - mean).abs() < 1e-12);
            assert!((moments.variance[column] - variance).abs() < 1e-12);
            let normalizer = moments.normalizer();
            assert!(
                (f64::from(normalizer.scale[column]) - 1.0 / (variance.sqrt() + 1e-4)).abs() < 1e-6
            );
        }
    }

    #[test]
    fn symmetrized_moments_are_those_of_the_rows_and_their_images() {
        let mirror = Mirror::chain([Mirror::sides(), Mirror::signs(&[-1.0])]);
        let mut moments = RunningMoments::new(3);
        moments.update(&rows());
        let symmetric = moments.symmetrized(&mirror);
        moments.update(&mirror.rows(&rows()));
        for i in 0..3 {
            assert!((symmetric.mean[i] - moments.mean[i]).abs() < 1e-9);
            assert!((symmetric.variance[i] - moments.variance[i]).abs() < 1e-9);
        }
        let normalizer = symmetric.normalizer();
        assert_eq!(mirror.rows(&normalizer.mean), normalizer.mean);
        assert_eq!(mirror.unsigned().rows(&normalizer.scale), normalizer.scale);
    }

    #[test]
    fn a_checkpoint_keeps_every_bit() {
        let mut moments = RunningMoments::new(3);
        moments.update(&rows());
        let mut tensors = Tensors::new();
        moments.save("features", &mut tensors).unwrap();
        let mut restored = RunningMoments::new(3);
        restored.restore("features", &tensors).unwrap();
        assert_eq!(restored, moments);
        assert!(
            RunningMoments::new(4)
                .restore("features", &tensors)
                .is_err()
        );
        assert!(restored.restore("privileged", &tensors).is_err());
    }
}
