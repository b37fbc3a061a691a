//! The six losses of the EMP (paper, section V; errata E3–E5).
//!
//! One function a loss, each for the rows of a batch; [`Objective`](super::objective::Objective) puts them together for
//! imagined steps.

use candle_core::{D, Tensor};
use serde::{Deserialize, Serialize};

/// Slope of the collision loss, 1/m.
const COLLISION_SLOPE: f64 = 2.0;

/// Distance of link centres at which a pair costs 1, m.
const COLLISION_DISTANCE: f64 = 0.08;

/// Slope of the centroid loss, 1/m.
const CENTROID_SLOPE: f64 = 7.0;

/// Distance of the centroid from its reference that costs nothing, m.
const CENTROID_DISTANCE: f64 = 0.03;

/// Bound of the centroid loss, before 1 is taken away.
const CENTROID_BOUND: f64 = 10.0;

/// Weight of the second difference beside the first in the smoothness loss.
const ACCELERATION: f64 = 0.2;

/// Under every square root, m²: a distance of zero has a gradient of zero.
const EPSILON: f64 = 1e-12;

/// Where a length stops being round at zero, rad.
const ROUNDING: f64 = 0.05;

/// The weights λ; the default is the paper's.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LossWeights {
    /// Of the distance to the goal that was asked for.
    pub reconstruction: f64,
    /// Of the tilt of the base.
    pub orientation: f64,
    /// Of links near one another.
    pub collision: f64,
    /// Of the centre of mass away from its reference.
    pub centroid: f64,
    /// Of jumps.
    pub smoothness: f64,
    /// Of the latent's size.
    pub regularization: f64,
}

impl Default for LossWeights {
    fn default() -> Self {
        Self {
            reconstruction: 20.0,
            orientation: 10.0,
            collision: 1.0,
            centroid: 10.0,
            smoothness: 100.0,
            regularization: 1.0,
        }
    }
}

/// How far one goal is from another.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Distance {
    /// ‖x‖², as printed. Between two wishes the best answer is their weighted mean.
    #[default]
    Square,
    /// ‖x‖, rounded off below 0.05 rad. Between two wishes the best answer is the weightier one.
    Length,
}

impl Distance {
    /// Of each row (N) of differences (N × joints, rad).
    ///
    /// # Errors
    /// When the tensor library fails.
    pub fn of(self, differences: &Tensor) -> candle_core::Result<Tensor> {
        let squares = row_squares(differences)?;
        match self {
            Self::Square => Ok(squares),
            Self::Length => (squares + ROUNDING * ROUNDING)?.sqrt()? - ROUNDING,
        }
    }
}

/// What has to be smooth.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SmoothOn {
    /// The executable goal ĝ, as printed.
    #[default]
    Target,
    /// The correction ĝ − g: a quick goal costs nothing, only a quick change of it.
    Correction,
}

/// The posture whose centre of mass and link distances are judged.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CenOn {
    /// What the world model predicts: all joints, roll and pitch.
    #[default]
    Predicted,
    /// The goal joints at ĝ, the legs as measured in the newest real frame, the base upright.
    QuasiStatic,
}

/// Where the centre of mass should be.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CenRef {
    /// Over the centre of the feet's support, as printed.
    #[default]
    Center,
    /// Where the policy keeps it on motion that it stands: [`Objective::operating_point`](super::objective::Objective::operating_point).
    Measured,
}

/// What the losses look at, and their weights; the default is the paper's.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LossSettings {
    /// Weights of the terms.
    pub weights: LossWeights,
    /// How far ĝ is from the goal that was asked for, and from what hindsight would have asked for.
    pub distance: Distance,
    /// What has to be smooth.
    pub smooth_on: SmoothOn,
    /// The posture that the centroid and collision losses judge.
    pub cen_on: CenOn,
    /// Where the centre of mass should be.
    pub cen_ref: CenRef,
}

/// `L_rec = ‖g − ĝ‖²` (N), or another distance, of goals as asked for and as executed (N × goal joints, rad).
///
/// # Errors
/// When shapes do not fit.
pub fn reconstruction(
    goals: &Tensor,
    executed: &Tensor,
    distance: Distance,
) -> candle_core::Result<Tensor> {
    distance.of(&(goals - executed)?)
}

/// `L_ori = 1 − exp(−‖pg_xy‖²)` (N; erratum E3) of roll, pitch and yaw (N × 3, rad), from which the projected gravity
/// follows.
///
/// # Errors
/// When shapes do not fit.
pub fn orientation(orientation: &Tensor) -> candle_core::Result<Tensor> {
    let [roll, pitch] = tilt(orientation)?;
    let x = pitch.sin()?;
    let y = (roll.sin()? * pitch.cos()?)?;
    let horizontal = (x.sqr()? + y.sqr()?)?.squeeze(1)?;
    1.0 - horizontal.neg()?.exp()?
}

/// `L_col = Σ exp[2 (0.08 − d)]` (N; erratum E4) over `pairs` of links, where d is the distance (m) of their centres
/// (N × 3 links, m).
///
/// # Errors
/// When a pair names a link that is not there.
pub fn collision(link_centers: &Tensor, pairs: &[[usize; 2]]) -> candle_core::Result<Tensor> {
    let (rows, width) = link_centers.dims2()?;
    let links = link_centers.reshape((rows, width / 3, 3))?;
    let side = |side: usize| {
        let indices = pairs.iter().map(|pair| pair[side] as u32);
        links.index_select(&Tensor::from_iter(indices, links.device())?, 1)
    };
    let distances = norms(&(side(0)? - side(1)?)?)?;
    let exponents = ((COLLISION_DISTANCE - distances)? * COLLISION_SLOPE)?;
    exponents.exp()?.sum(D::Minus1)
}

/// `L_cen = min{exp(−7 (0.03 − d)), 10} − 1` (N; erratum E5), where d (m) is the distance on the ground of the centre of
/// mass from the centre of the feet's support (both N × 2, m, in the heading frame) moved by `reference` (m, forward and
/// left).
///
/// # Errors
/// When shapes do not fit.
pub fn centroid(
    center_of_mass: &Tensor,
    foot_support: &Tensor,
    reference: [f64; 2],
) -> candle_core::Result<Tensor> {
    let offset = (center_of_mass - foot_support)?;
    let reference = Tensor::new(&[reference], offset.device())?.to_dtype(offset.dtype())?;
    let distance = norms(&offset.broadcast_sub(&reference)?)?;
    let exponents = ((distance - CENTROID_DISTANCE)? * CENTROID_SLOPE)?;
    exponents.exp()?.minimum(CENTROID_BOUND)? - 1.0
}

/// `L_cen` of one distance, m.
pub fn centroid_of(distance: f64) -> f64 {
    let exponent = CENTROID_SLOPE * (distance - CENTROID_DISTANCE);
    exponent.exp().min(CENTROID_BOUND) - 1.0
}

/// `L_smo = ‖x_t − x_{t−1}‖² + 0.2 ‖x_t + x_{t−2} − 2 x_{t−1}‖²` (N) of three successive rows (N × goal joints, rad).
///
/// # Errors
/// When shapes do not fit.
pub fn smoothness(
    now: &Tensor,
    before: &Tensor,
    before_that: &Tensor,
) -> candle_core::Result<Tensor> {
    let velocity = (now - before)?;
    let acceleration = (&velocity - (before - before_that)?)?;
    row_squares(&velocity)? + (row_squares(&acceleration)? * ACCELERATION)?
}

/// `L_reg = ‖z‖²` (N) of latents (N × latent).
///
/// # Errors
/// When the tensor library fails.
pub fn regularization(latent: &Tensor) -> candle_core::Result<Tensor> {
    row_squares(latent)
}

/// The components on the ground (N × 2, m, forward and left in the heading frame) of vectors in the base's frame (N × 3,
/// m), where the base stands at roll, pitch and yaw (N × 3, rad).
///
/// # Errors
/// When shapes do not fit.
pub fn horizontal(vectors: &Tensor, orientation: &Tensor) -> candle_core::Result<Tensor> {
    let [roll, pitch] = tilt(orientation)?;
    let [x, y, z] = [0, 1, 2].map(|axis| vectors.narrow(1, axis, 1));
    let (x, y, z) = (x?, y?, z?);
    let (sine, cosine) = (roll.sin()?, roll.cos()?);
    let up = ((&y * &sine)? + (&z * &cosine)?)?;
    let forward = ((x * pitch.cos()?)? + (up * pitch.sin()?)?)?;
    let left = ((y * cosine)? - (z * sine)?)?;
    Tensor::cat(&[forward, left], 1)
}

/// Roll and pitch, N × 1 each.
fn tilt(orientation: &Tensor) -> candle_core::Result<[Tensor; 2]> {
    Ok([orientation.narrow(1, 0, 1)?, orientation.narrow(1, 1, 1)?])
}

fn row_squares(rows: &Tensor) -> candle_core::Result<Tensor> {
    rows.sqr()?.sum(D::Minus1)
}

/// Lengths along the last dimension.
fn norms(vectors: &Tensor) -> candle_core::Result<Tensor> {
    (row_squares(vectors)? + EPSILON)?.sqrt()
}

#[cfg(test)]
mod tests {
    use candle_core::{Device, Var};
    use emp_models::observation::projected_gravity;
    use nalgebra::{UnitQuaternion, Vector3};

    use super::*;

    fn rows<const N: usize>(rows: &[[f64; N]]) -> Tensor {
        Tensor::from_slice(rows.as_flattened(), (rows.len(), N), &Device::Cpu).unwrap()
    }

    fn assert_near(losses: candle_core::Result<Tensor>, expected: &[f64]) {
        let losses = losses.unwrap().to_vec1::<f64>().unwrap();
        assert_eq!(losses.len(), expected.len());
        for (loss, expected) in losses.iter().zip(expected) {
            assert!((loss - expected).abs() < 1e-9, "{loss} {expected}");
        }
    }

    /// Compares the gradient of Σ i · `loss` over rows i = 1, … with finite differences at every number of `at`.
    fn assert_gradient(at: &Tensor, loss: impl Fn(&Tensor) -> candle_core::Result<Tensor>) {
        const STEP: f64 = 1e-6;
        let total = |x: &Tensor| {
            let loss = loss(x).unwrap();
            let weights = Tensor::arange(1.0, loss.dim(0).unwrap() as f64 + 1.0, &Device::Cpu);
            (loss * weights.unwrap()).unwrap().sum_all().unwrap()
        };
        let var = Var::from_tensor(at).unwrap();
        let gradients = total(&var).backward().unwrap();
        let gradient = gradients.get(&var).unwrap().flatten_all().unwrap();
        let gradient = gradient.to_vec1::<f64>().unwrap();
        assert!(gradient.iter().any(|slope| slope.abs() > 1e-3));
        let values = at.flatten_all().unwrap().to_vec1::<f64>().unwrap();
        for (i, slope) in gradient.iter().enumerate() {
            let moved = |step: f64| {
                let mut values = values.clone();
                values[i] += step;
                let x = Tensor::from_vec(values, at.shape(), &Device::Cpu).unwrap();
                total(&x).to_scalar::<f64>().unwrap()
            };
            let expected = (moved(STEP) - moved(-STEP)) / (2.0 * STEP);
            let tolerance = 1e-7 * expected.abs().max(1.0);
            assert!(
                (slope - expected).abs() < tolerance,
                "{i}: {slope} {expected}"
            );
        }
    }

    #[test]
    fn reconstruction_is_the_squared_distance_or_the_distance() {
        let (goals, executed) = (
            rows(&[[0.0, 1.0], [0.2, -0.1], [0.0, 0.0]]),
            rows(&[[3.0, 5.0], [0.2, -0.1], [0.01, 0.0]]),
        );
        for (distance, expected) in [
            (Distance::Square, [25.0, 0.0, 0.0001]),
            (
                Distance::Length,
                [25.0025_f64.sqrt() - 0.05, 0.0, 0.0026_f64.sqrt() - 0.05],
            ),
        ] {
            let loss = |executed: &Tensor| reconstruction(&goals, executed, distance);
            assert_near(loss(&executed), &expected);
            assert_gradient(&executed, loss);
        }
    }

    #[test]
    fn orientation_grows_with_the_tilt_of_the_base() {
        let angles = [
            [0.0, 0.0, 2.0],
            [0.0, 0.3, 0.0],
            [-0.4, 0.2, 1.0],
            [0.6, -0.5, 0.1],
        ];
        let expected = angles.map(|[roll, pitch, yaw]: [f64; 3]| {
            let base = UnitQuaternion::from_euler_angles(roll, pitch, yaw);
            let [x, y, _] = projected_gravity(&base);
            1.0 - (-(x * x + y * y)).exp()
        });
        assert!(expected[0] == 0.0 && expected.is_sorted());
        assert_near(orientation(&rows(&angles)), &expected);
        assert_gradient(&rows(&angles), orientation);
    }

    #[test]
    fn collision_falls_with_the_distance_of_links_that_may_touch() {
        // The second link is 8 cm, then 5 cm from the first; the third 1 m from the second; 1 and 3 may not touch.
        let centers = rows(&[
            [0.0, 0.0, 0.0, 0.08, 0.0, 0.0, 0.08, 1.0, 0.0],
            [0.0, 0.0, 0.1, 0.03, 0.04, 0.1, 0.03, 0.04, 1.1],
        ]);
        let pairs = [[0, 1], [2, 1]];
        let far = (-1.84_f64).exp();
        assert_near(
            collision(&centers, &pairs),
            &[1.0 + far, 0.06_f64.exp() + far],
        );
        assert_gradient(&centers, |centers| collision(centers, &pairs));
    }

    #[test]
    fn links_at_one_place_have_a_gradient_of_zero() {
        let centers = Var::from_tensor(&rows(&[[0.1; 6]])).unwrap();
        let loss = collision(&centers, &[[0, 1]]).unwrap();
        let gradients = loss.backward().unwrap();
        assert_eq!(
            gradients.get(&centers).unwrap().to_vec2::<f64>().unwrap(),
            [[0.0; 6]]
        );
    }

    #[test]
    fn the_centroid_costs_its_distance_up_to_a_bound() {
        // On the reference's left, 3 cm and 5 cm away from it, and far away.
        let center_of_mass = rows(&[[0.035, 0.03], [0.035, -0.05], [1.0, 0.0]]);
        let foot_support = rows(&[[0.0, 0.0], [0.0, 0.0], [0.0, 0.2]]);
        let at = |reference| centroid(&center_of_mass, &foot_support, reference);
        assert_near(at([0.035, 0.0]), &[0.0, 0.14_f64.exp() - 1.0, 9.0]);
        for distance in [0.03, 0.05, 1.02] {
            assert_near(
                centroid(&rows(&[[distance, 0.0]]), &rows(&[[0.0; 2]]), [0.0; 2]),
                &[centroid_of(distance)],
            );
        }
        // E5 as printed, about the centre.
        let distance = 0.035_f64.hypot(0.03);
        let expected = (-7.0 * (0.03 - distance)).exp() - 1.0;
        assert_near(
            at([0.0; 2]).and_then(|losses| losses.narrow(0, 0, 1)),
            &[expected],
        );
        assert_gradient(&center_of_mass, |com| {
            centroid(com, &foot_support, [0.03, 0.01])
        });
    }

    #[test]
    fn smoothness_is_speed_and_a_fifth_of_acceleration() {
        let (now, before) = (
            rows(&[[0.3, 1.0], [0.3, 1.0]]),
            rows(&[[0.1, 1.0], [0.1, 1.0]]),
        );
        let before_that = rows(&[[-0.1, 1.0], [0.2, 1.0]]);
        assert_near(
            smoothness(&now, &before, &before_that),
            &[0.04, 0.04 + 0.2 * 0.09],
        );
        assert_gradient(&now, |now| smoothness(now, &before, &before_that));
        assert_gradient(&before, |before| smoothness(&now, before, &before_that));
        assert_gradient(&before_that, |before_that| {
            smoothness(&now, &before, before_that)
        });
    }

    #[test]
    fn regularization_is_the_latents_square() {
        let latent = rows(&[[1.0, -2.0, 0.5], [0.0; 3]]);
        assert_near(regularization(&latent), &[5.25, 0.0]);
        assert_gradient(&latent, regularization);
    }

    #[test]
    fn horizontal_is_the_rotation_without_yaw() {
        let (vectors, angles) = (
            [[0.1, -0.2, 0.9], [0.0, 0.0, 1.0], [0.3, 0.2, -0.8]],
            [[0.3, -0.2, 1.0], [0.0, 0.1, -2.0], [-0.7, 0.4, 0.0]],
        );
        let expected: Vec<[f64; 2]> = vectors
            .iter()
            .zip(&angles)
            .map(|(vector, [roll, pitch, _])| {
                let base = UnitQuaternion::from_euler_angles(*roll, *pitch, 0.0);
                let vector = base * Vector3::from(*vector);
                [vector.x, vector.y]
            })
            .collect();
        let error =
            (horizontal(&rows(&vectors), &rows(&angles)).unwrap() - rows(&expected)).unwrap();
        let error = error.abs().unwrap().max_all().unwrap();
        assert!(error.to_scalar::<f64>().unwrap() < 1e-12);
        let forward = |vectors: &Tensor, angles: &Tensor| {
            let ground = horizontal(vectors, angles)?;
            ground.narrow(1, 0, 1)? * 2.0 + ground.narrow(1, 1, 1)?
        };
        let squeeze = |rows: candle_core::Result<Tensor>| rows.and_then(|rows| rows.squeeze(1));
        assert_gradient(&rows(&angles), |angles| {
            squeeze(forward(&rows(&vectors), angles))
        });
        assert_gradient(&rows(&vectors), |vectors| {
            squeeze(forward(vectors, &rows(&angles)))
        });
    }

    #[test]
    fn the_papers_settings_are_the_default() {
        let settings: LossSettings = serde_json::from_value(serde_json::json!({
            "weights": {
                "reconstruction": 20.0, "orientation": 10.0, "collision": 1.0,
                "centroid": 10.0, "smoothness": 100.0, "regularization": 1.0,
            },
            "distance": "square", "smooth_on": "target", "cen_on": "predicted", "cen_ref": "center",
        }))
        .unwrap();
        assert_eq!(settings, LossSettings::default());
    }
}
