//! What a robot's sensors add to the truth: joint encoders, and an inertial unit whose yaw drifts.

use emp_models::observation::roll_pitch_yaw;
use nalgebra::UnitQuaternion;
use rand::{Rng, RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::ranges::check_range;
use crate::{Reading, SimError};

/// How far measurements are off. Each number is the half-width of a uniform range about zero.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SensorNoise {
    /// Of each joint angle in each control period, rad.
    pub joint: f64,
    /// Of each joint angle for a whole episode, rad: how well the encoders were calibrated.
    pub joint_offset: f64,
    /// Of roll and pitch in each control period, rad.
    pub tilt: f64,
    /// Of roll and pitch for a whole episode, rad.
    pub tilt_offset: f64,
    /// Of the speed with which yaw drifts, rad/s, the same for a whole episode.
    pub yaw_drift: f64,
    /// Of what yaw wanders in each control period, rad; it adds up.
    pub yaw_walk: f64,
}

impl Default for SensorNoise {
    /// Ordinary sensors of a humanoid.
    fn default() -> Self {
        Self {
            joint: 0.005,
            joint_offset: 0.01,
            tilt: 0.005,
            tilt_offset: 0.015,
            yaw_drift: 0.01,
            yaw_walk: 0.001,
        }
    }
}

impl SensorNoise {
    /// The same noise `scale` times as large.
    #[must_use]
    pub fn scaled(&self, scale: f64) -> Self {
        Self {
            joint: scale * self.joint,
            joint_offset: scale * self.joint_offset,
            tilt: scale * self.tilt,
            tilt_offset: scale * self.tilt_offset,
            yaw_drift: scale * self.yaw_drift,
            yaw_walk: scale * self.yaw_walk,
        }
    }

    /// Refuses noise that no sensor has.
    ///
    /// # Errors
    /// [`SimError::Setting`] names the number.
    pub fn check(&self) -> Result<(), SimError> {
        for (name, value) in [
            ("joint", self.joint),
            ("joint_offset", self.joint_offset),
            ("tilt", self.tilt),
            ("tilt_offset", self.tilt_offset),
            ("yaw_drift", self.yaw_drift),
            ("yaw_walk", self.yaw_walk),
        ] {
            check_range(&format!("sensors.{name}"), [value; 2], 0.0, 1.0)?;
        }
        Ok(())
    }
}

/// The sensors of one robot in an episode. All that is random in them follows from one seed.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Sensors {
    noise: SensorNoise,
    rng: ChaCha8Rng,
    joint_offsets: Vec<f32>,
    /// Roll and pitch, rad.
    tilt_offset: [f64; 2],
    /// Yaw that has drifted, rad, and what it drifts in a control period.
    yaw: f64,
    drift: f64,
}

impl Sensors {
    /// Sensors of a robot with so many joints, read once in `period` seconds.
    pub(crate) fn new(noise: SensorNoise, joints: usize, period: f64, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        Self {
            joint_offsets: (0..joints)
                .map(|_| about_zero(noise.joint_offset, &mut rng) as f32)
                .collect(),
            tilt_offset: [0, 1].map(|_| about_zero(noise.tilt_offset, &mut rng)),
            yaw: 0.0,
            drift: period * about_zero(noise.yaw_drift, &mut rng),
            noise,
            rng,
        }
    }

    /// What they measure in this control period: joint angles (rad) and the base's orientation.
    pub(crate) fn measure(&mut self, reading: &Reading) -> (Vec<f32>, UnitQuaternion<f64>) {
        let (noise, rng) = (self.noise, &mut self.rng);
        let joints = reading.joint_positions.iter().zip(&self.joint_offsets);
        let joints = joints
            .map(|(angle, offset)| angle + offset + about_zero(noise.joint, rng) as f32)
            .collect();
        self.yaw += self.drift + about_zero(noise.yaw_walk, rng);
        let [roll, pitch, yaw] = roll_pitch_yaw(&reading.orientation);
        let tilt = self
            .tilt_offset
            .map(|offset| offset + about_zero(noise.tilt, rng));
        let orientation =
            UnitQuaternion::from_euler_angles(roll + tilt[0], pitch + tilt[1], yaw + self.yaw);
        (joints, orientation)
    }
}

fn about_zero(limit: f64, rng: &mut impl Rng) -> f64 {
    let share: f64 = rng.random();
    limit * (2.0 * share - 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reading() -> Reading {
        Reading {
            joint_positions: vec![0.3; 27],
            orientation: UnitQuaternion::from_euler_angles(0.1, -0.1, 0.5),
            ..Reading::default()
        }
    }

    #[test]
    fn measurements_are_as_far_off_as_the_settings_say_and_follow_from_the_seed() {
        let noise = SensorNoise::default();
        let mut sensors = Sensors::new(noise, 27, 0.02, 4);
        let mut again = sensors.clone();
        let mut sums = [0.0; 2];
        for t in 1..=5000 {
            let (joints, orientation) = sensors.measure(&reading());
            assert_eq!((joints.clone(), orientation), again.measure(&reading()));
            let farthest = joints.iter().map(|q| (q - 0.3).abs()).fold(0.0, f32::max);
            assert!(f64::from(farthest) <= noise.joint + noise.joint_offset + 1e-6);
            let [roll, pitch, yaw] = roll_pitch_yaw(&orientation);
            for off in [roll - 0.1, pitch + 0.1] {
                assert!(off.abs() <= noise.tilt + noise.tilt_offset + 1e-9, "{off}");
            }
            let drifted = f64::from(t) * (0.02 * noise.yaw_drift + noise.yaw_walk);
            assert!((yaw - 0.5).abs() <= drifted + 1e-9);
            sums[0] += f64::from(joints[0]) - 0.3;
            sums[1] += roll - 0.1;
        }
        // What stays is the offset.
        assert!((sums[0] / 5000.0 - f64::from(sensors.joint_offsets[0])).abs() < 1e-3);
        assert!((sums[1] / 5000.0 - sensors.tilt_offset[0]).abs() < 1e-3);
        assert!((sensors.yaw - 5000.0 * sensors.drift).abs() < 0.2);
    }

    #[test]
    fn noise_that_is_none_changes_nothing_and_bad_noise_is_refused_by_name() {
        let mut sensors = Sensors::new(SensorNoise::default().scaled(0.0), 27, 0.02, 4);
        let (joints, orientation) = sensors.measure(&reading());
        assert_eq!(joints, reading().joint_positions);
        assert!(orientation.angle_to(&reading().orientation) < 1e-9);
        SensorNoise::default().check().unwrap();
        let bad = SensorNoise {
            tilt: f64::NAN,
            ..SensorNoise::default()
        };
        assert!(
            bad.check()
                .unwrap_err()
                .to_string()
                .contains("sensors.tilt")
        );
    }
}
