//! How often each clip is drawn: those in which the robot falls come more often.

use anyhow::{Context as _, Result, ensure};
use candle_core::{Device, Tensor};
use emp_models::checkpoint::Tensors;
use serde::{Deserialize, Serialize};

/// Names of the counts in a checkpoint.
const FALLS: &str = "sampler.falls";
const PLAYED: &str = "sampler.played";

/// How clips are weighted.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SamplerSettings {
    /// Weight of a clip in which the robot never falls; one in which it falls as often as on average has 1.
    pub floor: f64,
    /// Largest weight.
    pub most: f64,
    /// Control periods of the average that are added to each clip's count, so that one fall of a clip that was hardly played
    /// says little.
    pub prior: f64,
    /// Control periods, of all environments together, after which what was counted is half forgotten.
    pub half_life: f64,
}

impl Default for SamplerSettings {
    fn default() -> Self {
        Self {
            floor: 0.5,
            most: 4.0,
            prior: 1000.0,
            half_life: 3e6,
        }
    }
}

/// Falls of each clip, and for how long it was played.
#[derive(Clone, Debug, PartialEq)]
pub struct Sampler {
    settings: SamplerSettings,
    falls: Vec<f64>,
    /// Control periods, by the probability with which the clip was drawn: nobody has to count them.
    played: Vec<f64>,
}

impl Sampler {
    /// Nothing is known of `clips` clips.
    pub fn new(settings: SamplerSettings, clips: usize) -> Self {
        Self {
            settings,
            falls: vec![0.0; clips],
            played: vec![0.0; clips],
        }
    }

    /// Counts a rollout of `periods` control periods, whose clips were drawn with `probabilities` and in which the robot
    /// fell in the clips `falls`.
    pub fn update(
        &mut self,
        probabilities: &[f64],
        periods: usize,
        falls: impl IntoIterator<Item = usize>,
    ) {
        let kept = 0.5_f64.powf(periods as f64 / self.settings.half_life);
        for count in self.falls.iter_mut().chain(&mut self.played) {
            *count *= kept;
        }
        for (played, probability) in self.played.iter_mut().zip(probabilities) {
            *played += probability * periods as f64;
        }
        for clip in falls {
            if let Some(count) = self.falls.get_mut(clip) {
                *count += 1.0;
            }
        }
    }

    /// How often each clip is to be drawn, relative to its class and length.
    pub fn weights(&self) -> Vec<f32> {
        let SamplerSettings {
            floor, most, prior, ..
        } = self.settings;
        let (falls, played): (f64, f64) = (self.falls.iter().sum(), self.played.iter().sum());
        if falls == 0.0 {
            return vec![1.0; self.falls.len()];
        }
        let average = falls / played;
        let counts = self.falls.iter().zip(&self.played);
        let weight = |(falls, played): (&f64, &f64)| {
            let rate = (falls + prior * average) / (played + prior);
            (floor + (1.0 - floor) * rate / average).min(most) as f32
        };
        counts.map(weight).collect()
    }

    /// Puts the counts into a checkpoint.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn save(&self, tensors: &mut Tensors) -> Result<()> {
        for (name, counts) in [(FALLS, &self.falls), (PLAYED, &self.played)] {
            tensors.insert(
                name.to_owned(),
                Tensor::new(counts.as_slice(), &Device::Cpu)?,
            );
        }
        Ok(())
    }

    /// Reads what [`save`](Self::save) wrote.
    ///
    /// # Errors
    /// When a tensor is missing or the run had another number of clips.
    pub fn restore(&mut self, tensors: &Tensors) -> Result<()> {
        for (name, counts) in [(FALLS, &mut self.falls), (PLAYED, &mut self.played)] {
            let tensor = tensors
                .get(name)
                .with_context(|| format!("no tensor `{name}`"))?;
            let saved = tensor
                .to_vec1::<f64>()
                .with_context(|| format!("tensor `{name}`"))?;
            ensure!(
                saved.len() == counts.len(),
                "the run had {} clips of goals, there are {} now",
                saved.len(),
                counts.len()
            );
            *counts = saved;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Three clips, drawn alike; the robot falls in the second once in 500 control periods, in the third once in 2000.
    fn trained(rollouts: usize) -> Sampler {
        let mut sampler = Sampler::new(SamplerSettings::default(), 3);
        for rollout in 0..rollouts {
            let falls = [(1, 8), (2, 2)].into_iter();
            let falls = falls.flat_map(|(clip, times)| std::iter::repeat_n(clip, times));
            let fell = falls.filter(|_| rollout > 0);
            sampler.update(&[1.0 / 3.0; 3], 12_000, fell);
        }
        sampler
    }

    #[test]
    fn clips_in_which_the_robot_falls_come_more_often_and_none_is_forgotten() {
        assert_eq!(trained(1).weights(), [1.0; 3]);
        let early = trained(2).weights();
        let late = trained(100).weights();
        for weights in [&early, &late] {
            assert!(
                weights[1] > weights[2] && weights[2] > weights[0],
                "{weights:?}"
            );
        }
        assert!(
            late[1] > early[1] && late[0] < early[0],
            "{early:?} {late:?}"
        );
        // ½ + ½ · (24, 6 and 0 times 1/3 of the mean of 10).
        for (weight, expected) in late.iter().zip([0.5, 1.7, 0.8]) {
            assert!((weight - expected).abs() < 0.1, "{late:?}");
        }
    }

    #[test]
    fn what_was_counted_fades() {
        let mut sampler = trained(100);
        for _ in 0..2000 {
            sampler.update(&[1.0 / 3.0; 3], 12_000, [0]);
        }
        let weights = sampler.weights();
        assert!(weights[0] > 1.9 && weights[1] < 0.6, "{weights:?}");
    }

    #[test]
    fn a_checkpoint_keeps_every_bit_and_another_library_is_refused() {
        let sampler = trained(7);
        let mut tensors = Tensors::new();
        sampler.save(&mut tensors).unwrap();
        let mut restored = Sampler::new(SamplerSettings::default(), 3);
        restored.restore(&tensors).unwrap();
        assert_eq!(restored, sampler);
        let mut other = Sampler::new(SamplerSettings::default(), 4);
        let error = other.restore(&tensors).unwrap_err().to_string();
        assert!(error.contains("3 clips"), "{error}");
    }
}
