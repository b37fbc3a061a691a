//! The training loss of the retargeting network (paper, Table "Training Loss").

use candle_core::{D, Device, Tensor};
use emp_models::{
    kinematics::ForwardKinematics,
    retarget::{BONES, Target, network::Decoded, objective::weights},
};
use emp_motion::KeyNode;
use emp_robot::Robot;

/// `L_emb` and `L_com`: squared distance between latent features and codes, mean over features and nodes.
const EMBEDDING: f64 = 10_000.0;
/// The share of [`EMBEDDING`] by which `L_com` pulls the encoder to the codes.
const COMMITMENT: f64 = 0.25;

/// Targets of a batch as tensors.
pub struct TargetBatch {
    /// batch × 4 × 3.
    bones: Tensor,
    /// batch × 2.
    shoulder_line: Tensor,
    /// batch × 18: left and right wrist rotation, row-major.
    wrists: Tensor,
    /// batch × 18: 1 where the wrist is known.
    wrist_mask: Tensor,
}

impl TargetBatch {
    /// Gathers the targets.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn new(targets: &[Target]) -> candle_core::Result<Self> {
        let rows = targets.len();
        let bones = targets
            .iter()
            .flat_map(|t| t.bones.iter().flat_map(|bone| [bone.x, bone.y, bone.z]));
        let lines = targets
            .iter()
            .flat_map(|t| [t.shoulder_line.x, t.shoulder_line.y]);
        let wrists = targets
            .iter()
            .flat_map(|t| t.wrists.iter())
            .flat_map(|wrist| {
                std::array::from_fn::<f64, 9, _>(|i| {
                    wrist.map_or(0.0, |wrist| wrist[(i / 3, i % 3)])
                })
            });
        let known = targets
            .iter()
            .flat_map(|t| t.wrists.iter())
            .flat_map(|wrist| [f32::from(u8::from(wrist.is_some())); 9]);
        let device = &Device::Cpu;
        Ok(Self {
            bones: Tensor::from_iter(bones.map(|x| x as f32), device)?.reshape((
                rows,
                BONES.len(),
                3,
            ))?,
            shoulder_line: Tensor::from_iter(lines.map(|x| x as f32), device)?
                .reshape((rows, 2))?,
            wrists: Tensor::from_iter(wrists.map(|x| x as f32), device)?.reshape((rows, 18))?,
            wrist_mask: Tensor::from_iter(known, device)?.reshape((rows, 18))?,
        })
    }
}

/// The terms of the loss, unweighted but for the names' sake, each a scalar.
pub struct Terms {
    /// `L_ee`: forearm directions.
    pub end_effector: Tensor,
    /// `L_elb`: upper-arm directions.
    pub elbow: Tensor,
    /// `L_ori`: wrist rotations.
    pub orientation: Tensor,
    /// `L_emb`: codes to latent features.
    pub embedding: Tensor,
    /// `L_com`: latent features to codes, without its factor.
    pub commitment: Tensor,
    /// Ours: the trunk's yaw.
    pub shoulder_line: Tensor,
    /// Ours: distance to the default pose.
    pub rest: Tensor,
}

impl Terms {
    /// The weighted sum.
    ///
    /// # Errors
    /// When the tensor library fails.
    pub fn total(&self) -> candle_core::Result<Tensor> {
        let terms = [
            (&self.end_effector, weights::DIRECTION),
            (&self.elbow, weights::DIRECTION),
            (&self.orientation, weights::WRIST),
            (&self.embedding, EMBEDDING),
            (&self.commitment, EMBEDDING * COMMITMENT),
            (&self.shoulder_line, weights::SHOULDER_LINE),
            (&self.rest, weights::REST),
        ];
        terms.iter().try_fold(
            Tensor::zeros((), candle_core::DType::F32, &Device::Cpu)?,
            |sum, (term, weight)| sum + (*term * *weight)?,
        )
    }

    /// The terms' values in the order of [`Self::NAMES`].
    ///
    /// # Errors
    /// When the tensor library fails.
    pub fn values(&self) -> candle_core::Result<[f64; 7]> {
        let value =
            |term: &Tensor| Ok::<_, candle_core::Error>(f64::from(term.to_scalar::<f32>()?));
        Ok([
            value(&self.end_effector)?,
            value(&self.elbow)?,
            value(&self.orientation)?,
            value(&self.embedding)?,
            value(&self.commitment)?,
            value(&self.shoulder_line)?,
            value(&self.rest)?,
        ])
    }

    /// Names of the terms for a log.
    pub const NAMES: [&'static str; 7] = [
        "end_effector",
        "elbow",
        "orientation",
        "embedding",
        "commitment",
        "shoulder_line",
        "rest",
    ];
}

/// Computes the loss through the robot's kinematics.
pub struct Loss {
    kinematics: ForwardKinematics,
    positions: usize,
    wrists: usize,
    defaults: Tensor,
}

impl Loss {
    /// The loss for `robot`.
    ///
    /// # Errors
    /// When a tensor cannot be made.
    pub fn new(robot: &std::sync::Arc<Robot>) -> candle_core::Result<Self> {
        let layout = robot.kinematics().layout();
        Ok(Self {
            kinematics: ForwardKinematics::new(robot.clone()),
            positions: layout.key_nodes.start,
            wrists: layout.wrist_rotations.start,
            defaults: Tensor::new(robot.default_goal(), &Device::Cpu)?.unsqueeze(0)?,
        })
    }

    /// The loss terms of a batch: sums over bones and matrix entries, means over the batch.
    ///
    /// # Errors
    /// When the tensor library fails.
    pub fn terms(&self, decoded: &Decoded, targets: &TargetBatch) -> candle_core::Result<Terms> {
        let rows = self.kinematics.forward_goal(&decoded.angles)?;
        let upper_arms = self.bone_error(&rows, targets, &[0, 2])?;
        let forearms = self.bone_error(&rows, targets, &[1, 3])?;
        let rotations = rows.narrow(1, self.wrists, 18)?;
        let orientation = ((rotations - &targets.wrists)? * &targets.wrist_mask)?;
        let line = self
            .bone(&rows, KeyNode::RightShoulder, KeyNode::LeftShoulder)?
            .narrow(1, 0, 2)?;
        let latent_to_codes = |z: &Tensor, e: &Tensor| (z - e)?.sqr()?.mean_all();
        Ok(Terms {
            end_effector: forearms,
            elbow: upper_arms,
            orientation: mean_of_row_sums(&orientation)?,
            embedding: latent_to_codes(&decoded.latent.detach(), &decoded.codes)?,
            commitment: latent_to_codes(&decoded.latent, &decoded.codes.detach())?,
            shoulder_line: mean_of_row_sums(&(unit(&line)? - &targets.shoulder_line)?)?,
            rest: mean_of_row_sums(&decoded.angles.broadcast_sub(&self.defaults)?)?,
        })
    }

    fn bone_error(
        &self,
        rows: &Tensor,
        targets: &TargetBatch,
        bones: &[usize],
    ) -> candle_core::Result<Tensor> {
        let mut errors = Vec::with_capacity(bones.len());
        for &bone in bones {
            let (from, to) = BONES[bone];
            let wanted = targets.bones.narrow(1, bone, 1)?.squeeze(1)?;
            errors.push((unit(&self.bone(rows, from, to)?)? - wanted)?);
        }
        mean_of_row_sums(&Tensor::cat(&errors, 1)?)
    }

    fn bone(&self, rows: &Tensor, from: KeyNode, to: KeyNode) -> candle_core::Result<Tensor> {
        let node = |node: KeyNode| rows.narrow(1, self.positions + 3 * node as usize, 3);
        node(to)? - node(from)?
    }
}

fn unit(vectors: &Tensor) -> candle_core::Result<Tensor> {
    vectors.broadcast_div(&(vectors.sqr()?.sum_keepdim(D::Minus1)? + 1e-12)?.sqrt()?)
}

fn mean_of_row_sums(residuals: &Tensor) -> candle_core::Result<Tensor> {
    residuals.sqr()?.sum(1)?.mean_all()
}

#[cfg(test)]
mod tests {
    use std::{path::Path, sync::Arc};

    use candle_core::{DType, Var};
    use nalgebra::{Matrix3, Rotation3, Vector2, Vector3};

    use super::*;

    fn robot() -> Arc<Robot> {
        Arc::new(
            Robot::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/emp27")).unwrap(),
        )
    }

    fn decoded(angles: &Tensor) -> Decoded {
        let latent = Tensor::new(&[[0.5f32, 0.0], [0.0, 0.0]], &Device::Cpu).unwrap();
        let codes = Tensor::new(&[[0.5f32, 0.2], [0.4, 0.0]], &Device::Cpu).unwrap();
        Decoded {
            angles: angles.clone(),
            latent,
            codes,
            indices: vec![0, 1],
        }
    }

    fn angles(values: Vec<f32>) -> Tensor {
        let width = values.len();
        Tensor::from_vec(values, (1, width), &Device::Cpu).unwrap()
    }

    /// What emp27 does with all goal joints at zero: arms hang, fingers down, thumbs forward.
    fn hanging() -> Target {
        let hand = Matrix3::from_columns(&[-Vector3::z(), Vector3::y(), Vector3::x()]);
        Target {
            bones: [-Vector3::z(); 4],
            shoulder_line: Vector2::y(),
            wrists: [Some(hand); 2],
        }
    }

    fn values(q: Vec<f32>, target: &Target) -> [f64; 7] {
        let loss = Loss::new(&robot()).unwrap();
        let batch = TargetBatch::new(std::slice::from_ref(target)).unwrap();
        loss.terms(&decoded(&angles(q)), &batch)
            .unwrap()
            .values()
            .unwrap()
    }

    #[test]
    fn a_pose_that_is_the_humans_costs_nothing_but_rest_and_codes() {
        let [
            end_effector,
            elbow,
            orientation,
            embedding,
            commitment,
            line,
            rest,
        ] = values(vec![0.0; 15], &hanging());
        for term in [end_effector, elbow, orientation, line] {
            assert!(term < 1e-9, "{term}");
        }
        // (0.2² + 0.4²) over four features.
        assert!((embedding - 0.05).abs() < 1e-6 && (commitment - 0.05).abs() < 1e-6);
        let expected: f64 = robot()
            .goal_joints()
            .iter()
            .map(|joint| joint.default.powi(2))
            .sum();
        assert!((rest - expected).abs() < 1e-5);
    }

    #[test]
    fn terms_equal_hand_computed_cases() {
        // The human's left arm points forward: both its bones are 90° off, ‖u − û‖² = 2.
        let mut target = hanging();
        target.bones[0] = Vector3::x();
        target.bones[1] = Vector3::x();
        // The left hand is turned by 90°: ‖R − R̂‖² = 4 (1 − cos 90°) = 4. The right one is not known.
        let turn = Rotation3::from_axis_angle(&Vector3::x_axis(), std::f64::consts::FRAC_PI_2);
        target.wrists = [target.wrists[0].map(|hand| turn.matrix() * hand), None];
        // The trunk is turned by 60°: ‖u − û‖² = 2 (1 − cos 60°) = 1.
        let yaw = Rotation3::from_axis_angle(&Vector3::z_axis(), std::f64::consts::FRAC_PI_3);
        target.shoulder_line = (yaw * Vector3::y()).xy();
        let [end_effector, elbow, orientation, _, _, line, _] = values(vec![0.0; 15], &target);
        for (term, expected) in [
            (end_effector, 2.0),
            (elbow, 2.0),
            (orientation, 4.0),
            (line, 1.0),
        ] {
            assert!((term - expected).abs() < 1e-5, "{term} {expected}");
        }
    }

    #[test]
    fn the_gradient_equals_finite_differences() {
        const STEP: f32 = 1e-2;
        let robot = robot();
        let loss = Loss::new(&robot).unwrap();
        let mut target = hanging();
        target.bones = [
            Vector3::new(0.6, 0.0, -0.8),
            Vector3::x(),
            Vector3::new(0.0, -0.6, -0.8),
            Vector3::x(),
        ];
        let batch = TargetBatch::new(&[target]).unwrap();
        let q: Vec<f32> = robot
            .goal_joints()
            .iter()
            .map(|joint| joint.default as f32 + 0.1)
            .collect();
        let total = |q: &Tensor| loss.terms(&decoded(q), &batch).unwrap().total().unwrap();
        let var = Var::from_tensor(&angles(q.clone())).unwrap();
        let grads = total(&var).backward().unwrap();
        let grad = grads
            .get(&var)
            .unwrap()
            .to_dtype(DType::F64)
            .unwrap()
            .flatten_all()
            .unwrap()
            .to_vec1::<f64>()
            .unwrap();
        for j in 0..q.len() {
            let at = |sign: f32| {
                let mut q = q.clone();
                q[j] += sign * STEP;
                f64::from(total(&angles(q)).to_scalar::<f32>().unwrap())
            };
            let expected = (at(1.0) - at(-1.0)) / (2.0 * f64::from(STEP));
            assert!(
                (grad[j] - expected).abs() < 0.01 * expected.abs().max(30.0),
                "joint {j}: {} {expected}",
                grad[j]
            );
        }
    }
}
