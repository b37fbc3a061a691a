//! The robot's forward kinematics as a differentiable candle op.

use std::sync::Arc;

use candle_core::{CpuStorage, CustomOp1, CustomOp2, Layout, Shape, Tensor, bail};
use emp_robot::Robot;

/// Maps joint angles, batch × dof (goal joints, then leg joints, radians), to rows of
/// [`Kinematics::output_width`](emp_robot::Kinematics::output_width) numbers in the pelvis frame (metres, rotation matrices).
///
/// The backward pass is the kinematics' own vector–Jacobian product, so a row costs about two forward passes.
#[derive(Clone)]
pub struct ForwardKinematics {
    robot: Arc<Robot>,
}

impl ForwardKinematics {
    /// The kinematics of `robot`.
    pub fn new(robot: Arc<Robot>) -> Self {
        Self { robot }
    }

    /// Applies the kinematics to `q`, batch × dof, f32 or f64.
    ///
    /// # Errors
    /// When `q` has another width or type.
    pub fn forward(&self, q: &Tensor) -> candle_core::Result<Tensor> {
        q.contiguous()?.apply_op1(self.clone())
    }

    /// As [`Self::forward`] for the goal joints only (batch × goal joints); the legs stand in their default pose.
    ///
    /// # Errors
    /// When `goal` has another width or type.
    pub fn forward_goal(&self, goal: &Tensor) -> candle_core::Result<Tensor> {
        let legs = self.robot.leg_joints().iter().map(|joint| joint.default);
        let legs = Tensor::from_iter(legs, goal.device())?.to_dtype(goal.dtype())?;
        let legs = legs.unsqueeze(0)?.expand((goal.dim(0)?, legs.dim(0)?))?;
        self.forward(&Tensor::cat(&[goal, &legs], 1)?)
    }

    fn rows(&self, layout: &Layout, width: usize) -> candle_core::Result<(usize, usize, usize)> {
        let (rows, cols) = layout.shape().dims2()?;
        match layout.contiguous_offsets() {
            Some((start, end)) if cols == width => Ok((rows, start, end)),
            _ => bail!(
                "kinematics of {}: expected a contiguous batch × {width}, got {layout:?}",
                self.robot.name()
            ),
        }
    }
}

impl CustomOp1 for ForwardKinematics {
    fn name(&self) -> &'static str {
        "forward_kinematics"
    }

    fn cpu_fwd(&self, q: &CpuStorage, layout: &Layout) -> candle_core::Result<(CpuStorage, Shape)> {
        let kinematics = self.robot.kinematics();
        let (rows, start, end) = self.rows(layout, kinematics.dof())?;
        let width = kinematics.output_width();
        let out = match q {
            CpuStorage::F32(q) => {
                let mut out = vec![0.0; rows * width];
                kinematics.forward(&q[start..end], &mut out);
                CpuStorage::F32(out)
            }
            CpuStorage::F64(q) => {
                let mut out = vec![0.0; rows * width];
                kinematics.forward(&q[start..end], &mut out);
                CpuStorage::F64(out)
            }
            _ => bail!("forward_kinematics: joint angles must be f32 or f64"),
        };
        Ok((out, Shape::from((rows, width))))
    }

    fn bwd(&self, q: &Tensor, _out: &Tensor, grad: &Tensor) -> candle_core::Result<Option<Tensor>> {
        let op = Backward {
            forward: self.clone(),
        };
        Ok(Some(
            q.contiguous()?.apply_op2_no_bwd(&grad.contiguous()?, &op)?,
        ))
    }
}

struct Backward {
    forward: ForwardKinematics,
}

impl CustomOp2 for Backward {
    fn name(&self) -> &'static str {
        "forward_kinematics_backward"
    }

    fn cpu_fwd(
        &self,
        q: &CpuStorage,
        q_layout: &Layout,
        grad: &CpuStorage,
        grad_layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let kinematics = self.forward.robot.kinematics();
        let (rows, q0, q1) = self.forward.rows(q_layout, kinematics.dof())?;
        let (_, g0, g1) = self.forward.rows(grad_layout, kinematics.output_width())?;
        let out = match (q, grad) {
            (CpuStorage::F32(q), CpuStorage::F32(grad)) => {
                let mut out = vec![0.0; q1 - q0];
                kinematics.backward(&q[q0..q1], &grad[g0..g1], &mut out);
                CpuStorage::F32(out)
            }
            (CpuStorage::F64(q), CpuStorage::F64(grad)) => {
                let mut out = vec![0.0; q1 - q0];
                kinematics.backward(&q[q0..q1], &grad[g0..g1], &mut out);
                CpuStorage::F64(out)
            }
            _ => bail!(
                "forward_kinematics: joint angles and gradient must both be f32 or both be f64"
            ),
        };
        Ok((out, Shape::from((rows, kinematics.dof()))))
    }
}
