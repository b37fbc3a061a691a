//! The retargeting objective for one frame, and the Gauss–Newton steps that lower it in joint space.
//!
//! It is what the network is trained on (paper, Table "Training Loss": `L_ee`, `L_elb`, `L_ori`, each with weight 100), plus two
//! terms that the table leaves to chance: the trunk's yaw, which only the arms would show, and a weak pull to the
//! default pose for joints that nothing else decides. Sources without wrist orientations have no `L_ori`.

use emp_motion::KeyNode;
use emp_robot::{FrameKinematics, Robot};
use nalgebra::{DMatrix, DVector, Vector3};

use super::features::{BONES, Target};

/// Weights of the objective's terms.
pub mod weights {
    /// `L_ee` and `L_elb`: squared difference of unit bone directions.
    pub const DIRECTION: f64 = 100.0;
    /// `L_ori`: squared Frobenius norm of the difference of wrist rotations.
    pub const WRIST: f64 = 100.0;
    /// Ours: squared difference of the unit shoulder lines seen from above.
    pub const SHOULDER_LINE: f64 = 100.0;
    /// Ours: squared distance to the default pose, rad².
    pub const REST: f64 = 0.1;
}

/// Bones shorter than this have no direction; robots have none.
const SHORTEST_BONE: f64 = 1e-6;

/// A solver for one robot; holds the scratch memory of its steps.
pub struct Solver<'a> {
    robot: &'a Robot,
    frame: FrameKinematics,
    bones: [Bone; 4],
    shoulder_line: Bone,
    normal: Normal,
    /// The pose that a step leads to.
    trial: Vec<f64>,
    /// Derivatives of one residual.
    derivatives: Vec<(usize, Vector3<f64>)>,
}

/// When [`Solver::minimise`] stops.
#[derive(Clone, Copy, Debug)]
pub struct Effort {
    /// At most this many Gauss–Newton steps.
    pub steps: usize,
    /// Stops earlier when a step lowers the objective by less than this.
    pub tolerance: f64,
}

impl Effort {
    /// What serving spends on a frame.
    pub const REFINE: Self = Self {
        steps: 8,
        tolerance: 1e-3,
    };
    /// Converged: the reference that the network and the refinement are measured against.
    pub const CONVERGE: Self = Self {
        steps: 300,
        tolerance: 1e-10,
    };
}

/// Normal equations `(JᵀJ + μ I) δ = −Jᵀ r` over the goal joints.
struct Normal {
    /// `JᵀJ`; only the lower triangle is kept.
    matrix: DMatrix<f64>,
    /// `Jᵀ r`.
    gradient: DVector<f64>,
}

impl Normal {
    fn new(joints: usize) -> Self {
        Self {
            matrix: DMatrix::zeros(joints, joints),
            gradient: DVector::zeros(joints),
        }
    }

    fn clear(&mut self) {
        self.matrix.fill(0.0);
        self.gradient.fill(0.0);
    }

    /// Adds a three-dimensional residual and its derivatives by the given joints.
    fn add(&mut self, residual: &Vector3<f64>, derivatives: &[(usize, Vector3<f64>)]) {
        for (i, a) in derivatives {
            self.gradient[*i] += a.dot(residual);
            for (j, b) in derivatives {
                if j <= i {
                    self.matrix[(*i, *j)] += a.dot(b);
                }
            }
        }
    }

    /// The step for the joints that `free` names, zero for the others; nothing where the damped matrix is not positive
    /// definite.
    fn solve(&self, damping: f64, free: impl Fn(usize) -> bool) -> Option<DVector<f64>> {
        let mut matrix = self.matrix.clone();
        let mut step = -&self.gradient;
        for i in 0..step.len() {
            matrix[(i, i)] += damping;
            if !free(i) {
                matrix.row_mut(i).fill(0.0);
                matrix.column_mut(i).fill(0.0);
                matrix[(i, i)] = 1.0;
                step[i] = 0.0;
            }
        }
        matrix.cholesky()?.solve_mut(&mut step);
        Some(step)
    }
}

impl<'a> Solver<'a> {
    /// A solver for `robot`.
    pub fn new(robot: &'a Robot) -> Self {
        let joints = robot.goal_joints().len();
        let frame = robot.kinematics().frame();
        Self {
            robot,
            bones: BONES.map(|bone| Bone::new(bone, &frame)),
            shoulder_line: Bone::new((KeyNode::RightShoulder, KeyNode::LeftShoulder), &frame),
            frame,
            normal: Normal::new(joints),
            trial: vec![0.0; joints],
            derivatives: Vec::with_capacity(joints),
        }
    }

    fn terms(&self) -> Terms<'_> {
        Terms {
            robot: self.robot,
            frame: &self.frame,
            bones: &self.bones,
            shoulder_line: &self.shoulder_line,
        }
    }

    /// The objective at `angles` (goal order, radians).
    pub fn objective(&mut self, target: &Target, angles: &[f64]) -> f64 {
        self.frame.update(angles);
        let mut sum = 0.0;
        self.terms().visit(target, angles, |residual, _, _| {
            sum += residual.norm_squared();
        });
        sum
    }

    /// Angle between the human's and the robot's bone, radians, for each of [`BONES`].
    pub fn bone_errors(&mut self, target: &Target, angles: &[f64]) -> [f64; 4] {
        self.frame.update(angles);
        std::array::from_fn(|i| {
            let (direction, _) = self.bones[i].direction(&self.frame, &Vector3::repeat(1.0));
            angle_between(&direction, &target.bones[i])
        })
    }

    /// Angle between the human's and the robot's left and right wrist, radians, where the human's is known.
    pub fn wrist_errors(&mut self, target: &Target, angles: &[f64]) -> [Option<f64>; 2] {
        self.frame.update(angles);
        std::array::from_fn(|side| {
            let wanted = target.wrists[side]?;
            let distance = (wanted - self.frame.wrist_rotations()[side]).norm();
            // ‖R − R̂‖² = 8 sin²(θ/2): exact near 0, where a trace's arc cosine is not.
            Some(2.0 * (distance / 8f64.sqrt()).min(1.0).asin())
        })
    }

    /// Lowers the objective from `angles` by damped Gauss–Newton steps inside the joints' limits; returns its value there.
    ///
    /// A joint that stands at a limit and would leave it is held for the step. The answer is never worse than the start.
    pub fn minimise(&mut self, target: &Target, angles: &mut [f64], effort: Effort) -> f64 {
        const LEAST_DAMPING: f64 = 1e-6;
        const MOST_DAMPING: f64 = 1e6;
        let robot = self.robot;
        for (angle, joint) in angles.iter_mut().zip(robot.goal_joints()) {
            *angle = angle.clamp(joint.range[0], joint.range[1]);
        }
        let mut damping = 1e-2;
        let mut value = self.linearise(target, angles);
        for _ in 0..effort.steps {
            let mut improved = None;
            while improved.is_none() && damping < MOST_DAMPING {
                self.step(angles, damping);
                let trial = std::mem::take(&mut self.trial);
                let trial_value = self.objective(target, &trial);
                self.trial = trial;
                if trial_value < value {
                    improved = Some(trial_value);
                    damping = (damping * 0.1).max(LEAST_DAMPING);
                } else {
                    damping *= 10.0;
                }
            }
            let Some(lower) = improved else { break };
            angles.copy_from_slice(&self.trial);
            let gain = value - lower;
            value = self.linearise(target, angles);
            if gain < effort.tolerance {
                break;
            }
        }
        value
    }

    /// Writes the pose after one damped step from `angles` to `trial`.
    fn step(&mut self, angles: &[f64], damping: f64) {
        let joints = self.robot.goal_joints();
        let gradient = &self.normal.gradient;
        let free = |i: usize| {
            let [lower, upper] = joints[i].range;
            !(angles[i] <= lower && gradient[i] > 0.0 || angles[i] >= upper && gradient[i] < 0.0)
        };
        self.trial.copy_from_slice(angles);
        let Some(step) = self.normal.solve(damping, free) else {
            return;
        };
        for ((trial, joint), step) in self.trial.iter_mut().zip(joints).zip(&step) {
            *trial = (*trial + step).clamp(joint.range[0], joint.range[1]);
        }
    }

    /// Sets up the normal equations at `angles`; returns the objective there.
    fn linearise(&mut self, target: &Target, angles: &[f64]) -> f64 {
        self.frame.update(angles);
        self.normal.clear();
        let mut sum = 0.0;
        let normal = &mut self.normal;
        let mut derivatives = std::mem::take(&mut self.derivatives);
        let Self {
            robot,
            frame,
            bones,
            shoulder_line,
            ..
        } = self;
        let terms = Terms {
            robot,
            frame,
            bones,
            shoulder_line,
        };
        terms.visit(target, angles, |residual, joints, derivative| {
            sum += residual.norm_squared();
            derivatives.clear();
            derivatives.extend(joints.iter().map(|j| (*j, derivative(*j))));
            normal.add(&residual, &derivatives);
        });
        self.derivatives = derivatives;
        sum
    }
}

/// A vector between two key nodes, and the goal joints that change it.
struct Bone {
    from: KeyNode,
    to: KeyNode,
    joints: Vec<usize>,
}

impl Bone {
    fn new((from, to): (KeyNode, KeyNode), frame: &FrameKinematics) -> Self {
        let mut joints = [
            frame.joints_moving(from as usize),
            frame.joints_moving(to as usize),
        ]
        .concat();
        joints.sort_unstable();
        joints.dedup();
        Self { from, to, joints }
    }

    /// Unit direction and length, after scaling each axis.
    fn direction(&self, frame: &FrameKinematics, axes: &Vector3<f64>) -> (Vector3<f64>, f64) {
        let positions = frame.positions();
        let bone =
            (positions[self.to as usize] - positions[self.from as usize]).component_mul(axes);
        let length = bone.norm().max(SHORTEST_BONE);
        (bone / length, length)
    }

    fn derivative(&self, frame: &FrameKinematics, j: usize) -> Vector3<f64> {
        let change = |node: KeyNode| {
            if frame.joints_moving(node as usize).contains(&j) {
                frame.position_derivative(node as usize, j)
            } else {
                Vector3::zeros()
            }
        };
        change(self.to) - change(self.from)
    }
}

/// The objective's terms at one pose of the robot.
struct Terms<'a> {
    robot: &'a Robot,
    frame: &'a FrameKinematics,
    bones: &'a [Bone; 4],
    shoulder_line: &'a Bone,
}

impl Terms<'_> {
    /// Calls `visit` with every weighted residual, the joints that change it, and its derivative by a joint.
    fn visit(
        &self,
        target: &Target,
        angles: &[f64],
        mut visit: impl FnMut(Vector3<f64>, &[usize], &dyn Fn(usize) -> Vector3<f64>),
    ) {
        let scale = weights::DIRECTION.sqrt();
        let all_axes = Vector3::repeat(1.0);
        for (bone, wanted) in self.bones.iter().zip(&target.bones) {
            let (direction, length) = bone.direction(self.frame, &all_axes);
            visit((direction - wanted) * scale, &bone.joints, &|j| {
                turn_of(&direction, &bone.derivative(self.frame, j)) * (scale / length)
            });
        }

        let scale = weights::SHOULDER_LINE.sqrt();
        let level = Vector3::new(1.0, 1.0, 0.0);
        let wanted = target.shoulder_line.push(0.0);
        let (direction, length) = self.shoulder_line.direction(self.frame, &level);
        visit(
            (direction - wanted) * scale,
            &self.shoulder_line.joints,
            &|j| {
                let change = self
                    .shoulder_line
                    .derivative(self.frame, j)
                    .component_mul(&level);
                turn_of(&direction, &change) * (scale / length)
            },
        );

        let scale = weights::WRIST.sqrt();
        for (side, node) in [KeyNode::LeftWrist, KeyNode::RightWrist]
            .into_iter()
            .enumerate()
        {
            let Some(wanted) = target.wrists[side] else {
                continue;
            };
            for column in 0..3 {
                let axis: Vector3<f64> = self.frame.wrist_rotations()[side].column(column).into();
                visit(
                    (axis - wanted.column(column)) * scale,
                    self.frame.joints_moving(node as usize),
                    &|j| self.frame.direction_derivative(&axis, j) * scale,
                );
            }
        }

        let scale = weights::REST.sqrt();
        for (i, (angle, joint)) in angles.iter().zip(self.robot.goal_joints()).enumerate() {
            let residual = Vector3::x() * (scale * (angle - joint.default));
            visit(residual, &[i], &|_| Vector3::x() * scale);
        }
    }
}

/// The part of `change` that turns the unit vector `direction`.
fn turn_of(direction: &Vector3<f64>, change: &Vector3<f64>) -> Vector3<f64> {
    change - direction * direction.dot(change)
}

/// Angle between two unit vectors, radians; exact near 0 and π.
fn angle_between(a: &Vector3<f64>, b: &Vector3<f64>) -> f64 {
    2.0 * (a - b).norm().atan2((a + b).norm())
}
