//! The retargeting objective for one frame, and the Gauss–Newton steps that lower it in joint space.
//!
//! It is what the network is trained on (paper, Table "Training Loss": `L_ee`, `L_elb`, `L_ori`, each with weight 100), plus two
//! terms that the table leaves to chance: the trunk's yaw, which only the arms would show, and a weak pull to the
//! default pose for joints that nothing else decides. Sources without wrist orientations have no `L_ori`.

use emp_motion::KeyNode;
use emp_robot::{FrameKinematics, Robot};
use nalgebra::{DMatrix, DVector, Vector3};

use super::{
    angles::{angle_between, turn_between},
    features::{BONES, Target},
};

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
    arms: [Vec<usize>; 2],
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

/// Where a minimum is looked for, all in goal order, radians.
pub struct Search<'a> {
    /// Lower bound of each joint.
    pub lower: &'a [f64],
    /// Upper bound of each joint.
    pub upper: &'a [f64],
    /// A pose that travel is measured from, and the weight of the squared distance to it.
    pub travel: Option<(&'a [f64], f64)>,
}

/// Which part of the body a term of the objective belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Part {
    Arm(usize),
    Trunk,
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

    /// Adds a residual that a single joint changes.
    fn add_single(&mut self, joint: usize, residual: f64, derivative: f64) {
        self.gradient[joint] += derivative * residual;
        self.matrix[(joint, joint)] += derivative * derivative;
    }

    /// The step in which the joints that `held` names move by what it says, and the others by what is best then; nothing
    /// where the damped matrix is not positive definite.
    fn solve(&self, damping: f64, held: &[Option<f64>]) -> Option<DVector<f64>> {
        let mut matrix = self.matrix.clone();
        let mut step = -&self.gradient;
        for (i, move_by) in held.iter().enumerate() {
            matrix[(i, i)] += damping;
            let Some(move_by) = move_by else { continue };
            for j in 0..step.len() {
                let coupling = self.matrix[(i.max(j), i.min(j))];
                step[j] -= coupling * move_by;
            }
        }
        for (i, move_by) in held.iter().enumerate() {
            let Some(move_by) = move_by else { continue };
            matrix.row_mut(i).fill(0.0);
            matrix.column_mut(i).fill(0.0);
            matrix[(i, i)] = 1.0;
            step[i] = *move_by;
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
        let chains = [KeyNode::LeftWrist, KeyNode::RightWrist]
            .map(|node| frame.joints_moving(node as usize).to_vec());
        let arm = |side: usize| {
            let other = &chains[1 - side];
            let own = chains[side].iter().copied();
            own.filter(|joint| !other.contains(joint)).collect()
        };
        Self {
            robot,
            bones: BONES.map(|bone| Bone::new(bone, &frame)),
            shoulder_line: Bone::new((KeyNode::RightShoulder, KeyNode::LeftShoulder), &frame),
            arms: [arm(0), arm(1)],
            frame,
            normal: Normal::new(joints),
            trial: vec![0.0; joints],
            derivatives: Vec::with_capacity(joints),
        }
    }

    /// The robot that is solved for.
    pub fn robot(&self) -> &'a Robot {
        self.robot
    }

    /// The goal joints of the left and the right arm, shoulder first; the others are the trunk's.
    pub fn arms(&self) -> &[Vec<usize>; 2] {
        &self.arms
    }

    fn terms(&self) -> Terms<'_> {
        Terms {
            robot: self.robot,
            frame: &self.frame,
            bones: &self.bones,
            shoulder_line: &self.shoulder_line,
            arms: &self.arms,
        }
    }

    /// The objective at `angles` (goal order, radians).
    pub fn objective(&mut self, target: &Target, angles: &[f64]) -> f64 {
        self.frame.update(angles);
        let mut sum = 0.0;
        self.terms().visit(target, angles, |_, residual, _, _| {
            sum += residual.norm_squared();
        });
        sum
    }

    /// The parts of the objective that the left and the right arm have, at `angles` (goal order, radians).
    pub fn arm_objectives(&mut self, target: &Target, angles: &[f64]) -> [f64; 2] {
        self.frame.update(angles);
        let mut sums = [0.0; 2];
        self.terms().visit(target, angles, |part, residual, _, _| {
            if let Part::Arm(side) = part {
                sums[side] += residual.norm_squared();
            }
        });
        sums
    }

    /// Angle between the human's and the robot's bone, radians, for each of [`BONES`].
    pub fn bone_errors(&mut self, target: &Target, angles: &[f64]) -> [f64; 4] {
        let directions = self.bone_directions(angles);
        std::array::from_fn(|i| angle_between(&directions[i], &target.bones[i]))
    }

    /// The robot's unit bone directions at `angles`, in the order of [`BONES`].
    pub fn bone_directions(&mut self, angles: &[f64]) -> [Vector3<f64>; 4] {
        self.frame.update(angles);
        std::array::from_fn(|i| {
            let (direction, _) = self.bones[i].direction(&self.frame, &Vector3::repeat(1.0));
            direction
        })
    }

    /// The pose that the robot shows at `angles`, as if it were a person's.
    pub fn shown(&mut self, angles: &[f64]) -> Target {
        let bones = self.bone_directions(angles);
        let level = Vector3::new(1.0, 1.0, 0.0);
        let (line, _) = self.shoulder_line.direction(&self.frame, &level);
        Target {
            bones,
            shoulder_line: line.xy(),
            wrists: self.frame.wrist_rotations().map(Some),
        }
    }

    /// Angle between the human's and the robot's left and right wrist, radians, where the human's is known.
    pub fn wrist_errors(&mut self, target: &Target, angles: &[f64]) -> [Option<f64>; 2] {
        self.frame.update(angles);
        std::array::from_fn(|side| {
            let wanted = target.wrists[side]?;
            Some(turn_between(&wanted, &self.frame.wrist_rotations()[side]))
        })
    }

    /// Lowers the objective from `angles` by damped Gauss–Newton steps inside the joints' limits; returns its value there.
    ///
    /// A joint that stands at a limit and would leave it is held for the step. The answer is never worse than the start.
    pub fn minimise(&mut self, target: &Target, angles: &mut [f64], effort: Effort) -> f64 {
        let limit = |side: usize| -> Vec<f64> {
            let joints = self.robot.goal_joints().iter();
            joints.map(|joint| joint.range[side]).collect()
        };
        let (lower, upper) = (limit(0), limit(1));
        let search = Search {
            lower: &lower,
            upper: &upper,
            travel: None,
        };
        self.minimise_within(target, angles, &search, effort)
    }

    /// As [`Self::minimise`], inside the search's bounds and with its travel added to the objective.
    ///
    /// Joints that a step would carry beyond their bounds stop there and the others make up for them as well as they can.
    pub fn minimise_within(
        &mut self,
        target: &Target,
        angles: &mut [f64],
        search: &Search<'_>,
        effort: Effort,
    ) -> f64 {
        const LEAST_DAMPING: f64 = 1e-6;
        const MOST_DAMPING: f64 = 1e6;
        for (i, angle) in angles.iter_mut().enumerate() {
            *angle = angle.clamp(search.lower[i], search.upper[i]);
        }
        let mut damping = 1e-2;
        let mut value = self.linearise(target, angles, search);
        for step in 0..effort.steps {
            let mut improved = None;
            while improved.is_none() && damping < MOST_DAMPING {
                self.step(angles, damping, search);
                let trial = std::mem::take(&mut self.trial);
                let trial_value = self.objective(target, &trial) + travelled(&trial, search);
                self.trial = trial;
                if trial_value < value {
                    improved = Some(trial_value);
                    damping = (damping * 0.1).max(LEAST_DAMPING);
                } else if value - trial_value > -effort.tolerance {
                    // As good as it gets.
                    return value;
                } else {
                    damping *= 10.0;
                }
            }
            let Some(lower) = improved else { break };
            angles.copy_from_slice(&self.trial);
            let gain = value - lower;
            value = lower;
            if gain < effort.tolerance || step + 1 == effort.steps {
                break;
            }
            value = self.linearise(target, angles, search);
        }
        value
    }

    /// Writes the pose after one damped step from `angles` to `trial`.
    fn step(&mut self, angles: &[f64], damping: f64, search: &Search<'_>) {
        let Search { lower, upper, .. } = search;
        let gradient = &self.normal.gradient;
        let mut held: Vec<Option<f64>> = (0..angles.len())
            .map(|i| {
                let outward = angles[i] <= lower[i] && gradient[i] > 0.0
                    || angles[i] >= upper[i] && gradient[i] < 0.0;
                outward.then_some(0.0)
            })
            .collect();
        self.trial.copy_from_slice(angles);
        // Each round holds one more joint at least.
        for _ in 0..=angles.len() {
            let Some(step) = self.normal.solve(damping, &held) else {
                return;
            };
            let mut is_inside = true;
            for i in 0..angles.len() {
                let moved = angles[i] + step[i];
                self.trial[i] = moved.clamp(lower[i], upper[i]);
                if held[i].is_none() && self.trial[i] != moved {
                    held[i] = Some(self.trial[i] - angles[i]);
                    is_inside = false;
                }
            }
            if is_inside {
                return;
            }
        }
    }

    /// Sets up the normal equations at `angles`; returns the objective there.
    fn linearise(&mut self, target: &Target, angles: &[f64], search: &Search<'_>) -> f64 {
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
            arms,
            ..
        } = self;
        let terms = Terms {
            robot,
            frame,
            bones,
            shoulder_line,
            arms,
        };
        terms.visit(target, angles, |_, residual, joints, derivative| {
            sum += residual.norm_squared();
            derivatives.clear();
            derivatives.extend(joints.iter().map(|j| (*j, derivative(*j))));
            normal.add(&residual, &derivatives);
        });
        if let Some((from, weight)) = search.travel {
            for (i, (angle, from)) in angles.iter().zip(from).enumerate() {
                normal.add_single(i, weight.sqrt() * (angle - from), weight.sqrt());
            }
            sum += travelled(angles, search);
        }
        self.derivatives = derivatives;
        sum
    }
}

/// The travel's part of the objective.
fn travelled(angles: &[f64], search: &Search<'_>) -> f64 {
    search.travel.map_or(0.0, |(from, weight)| {
        let squares = angles.iter().zip(from).map(|(a, b)| (a - b).powi(2));
        weight * squares.sum::<f64>()
    })
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
    arms: &'a [Vec<usize>; 2],
}

impl Terms<'_> {
    /// Calls `visit` with every weighted residual: whose it is, the joints that change it, and its derivative by a joint.
    fn visit(
        &self,
        target: &Target,
        angles: &[f64],
        mut visit: impl FnMut(Part, Vector3<f64>, &[usize], &dyn Fn(usize) -> Vector3<f64>),
    ) {
        let scale = weights::DIRECTION.sqrt();
        let all_axes = Vector3::repeat(1.0);
        for (i, (bone, wanted)) in self.bones.iter().zip(&target.bones).enumerate() {
            let (direction, length) = bone.direction(self.frame, &all_axes);
            let residual = (direction - wanted) * scale;
            visit(Part::Arm(i / 2), residual, &bone.joints, &|j| {
                turn_of(&direction, &bone.derivative(self.frame, j)) * (scale / length)
            });
        }

        let scale = weights::SHOULDER_LINE.sqrt();
        let level = Vector3::new(1.0, 1.0, 0.0);
        let wanted = target.shoulder_line.push(0.0);
        let (direction, length) = self.shoulder_line.direction(self.frame, &level);
        visit(
            Part::Trunk,
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
                    Part::Arm(side),
                    (axis - wanted.column(column)) * scale,
                    self.frame.joints_moving(node as usize),
                    &|j| self.frame.direction_derivative(&axis, j) * scale,
                );
            }
        }

        let scale = weights::REST.sqrt();
        for (i, (angle, joint)) in angles.iter().zip(self.robot.goal_joints()).enumerate() {
            let residual = Vector3::x() * (scale * (angle - joint.default));
            let side = self.arms.iter().position(|arm| arm.contains(&i));
            let part = side.map_or(Part::Trunk, Part::Arm);
            visit(part, residual, &[i], &|_| Vector3::x() * scale);
        }
    }
}

/// The part of `change` that turns the unit vector `direction`.
fn turn_of(direction: &Vector3<f64>, change: &Vector3<f64>) -> Vector3<f64> {
    change - direction * direction.dot(change)
}
