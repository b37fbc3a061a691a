//! The loss L of imagined steps: the six terms through the robot's kinematics (paper, section V).

use std::{ops::Range, sync::Arc};

use candle_core::{DType, Tensor, bail};
use emp_models::{kinematics::ForwardKinematics, observation::ObservationLayout};
use emp_robot::{OutputLayout, Robot};

use super::{
    imagination::ImaginedStep,
    losses::{self, CenOn, LossSettings, LossWeights, SmoothOn},
};

/// Past goals that the smoothness loss reads.
const PAST: usize = 2;

/// States from which is imagined, one a row.
#[derive(Clone, Debug)]
pub struct StateBatch {
    /// Stacks `S_t` (N × [`ObservationLayout::width`]): the newest frame holds the goal that was asked for, older ones what
    /// was executed.
    pub stacks: Tensor,
    /// Goals (N × goal joints, rad) that are asked for in the control periods after this one: those of the imagined steps
    /// but the first.
    pub goals_ahead: Vec<Tensor>,
    /// Goals (N × goal joints, rad) that were asked for two control periods ago, and one.
    pub goals_before: [Tensor; PAST],
}

/// The terms of the loss, unweighted: one number for each row of each imagined step, step by step. Those of the robot's balance
/// and clearance are computed only where they have a weight: they cost most.
pub struct Terms {
    /// `L_rec`.
    pub reconstruction: Tensor,
    /// `L_ori`.
    pub orientation: Option<Tensor>,
    /// `L_col`.
    pub collision: Option<Tensor>,
    /// `L_cen`.
    pub centroid: Option<Tensor>,
    /// `L_smo`.
    pub smoothness: Tensor,
    /// `L_reg`.
    pub regularization: Tensor,
}

impl Terms {
    /// Names of the terms for a log.
    pub const NAMES: [&'static str; 6] = [
        "reconstruction",
        "orientation",
        "collision",
        "centroid",
        "smoothness",
        "regularization",
    ];

    fn all(&self) -> [Option<&Tensor>; 6] {
        [
            Some(&self.reconstruction),
            self.orientation.as_ref(),
            self.collision.as_ref(),
            self.centroid.as_ref(),
            Some(&self.smoothness),
            Some(&self.regularization),
        ]
    }

    /// The weighted sum L, averaged over rows and steps: a scalar.
    ///
    /// # Errors
    /// When the tensor library fails.
    pub fn total(&self, weights: &LossWeights) -> candle_core::Result<Tensor> {
        let weights = [
            weights.reconstruction,
            weights.orientation,
            weights.collision,
            weights.centroid,
            weights.smoothness,
            weights.regularization,
        ];
        let start = self.reconstruction.zeros_like()?;
        let terms = self.all().into_iter().zip(weights);
        let mut terms = terms.filter_map(|(term, weight)| Some((term?, weight)));
        terms
            .try_fold(start, |sum, (term, weight)| sum + (term * weight)?)?
            .mean_all()
    }

    /// The mean of each term over rows and steps, in the order of [`Self::NAMES`]; not a number where it was not computed.
    ///
    /// # Errors
    /// When the tensor library fails.
    pub fn means(&self) -> candle_core::Result<[f64; 6]> {
        let mut means = [f64::NAN; 6];
        for (mean, term) in means.iter_mut().zip(self.all()) {
            if let Some(term) = term {
                *mean = term.mean_all()?.to_dtype(DType::F64)?.to_scalar()?;
            }
        }
        Ok(means)
    }
}

/// Judges imagined steps.
pub struct Objective {
    kinematics: ForwardKinematics,
    outputs: OutputLayout,
    pairs: Vec<[usize; 2]>,
    observation: ObservationLayout,
    settings: LossSettings,
    reference: [f64; 2],
}

impl Objective {
    /// The losses for `robot`, whose observations are laid out as `observation` says. The centre of mass should be over the
    /// centre of the feet's support until [`set_reference`](Self::set_reference) moves it.
    ///
    /// # Errors
    /// When a stack does not hold the past goals that the smoothness loss reads.
    pub fn new(
        robot: &Arc<Robot>,
        observation: ObservationLayout,
        settings: LossSettings,
    ) -> candle_core::Result<Self> {
        let frames = observation.history();
        if frames <= PAST {
            bail!(
                "the smoothness loss needs stacks of {} frames, got {frames}",
                PAST + 1
            );
        }
        Ok(Self {
            kinematics: ForwardKinematics::new(Arc::clone(robot)),
            outputs: robot.kinematics().layout().clone(),
            pairs: robot.link_pairs().to_vec(),
            observation,
            settings,
            reference: [0.0; 2],
        })
    }

    /// Moves the centroid's reference to this offset (m, forward and left in the heading frame) from the centre of the
    /// feet's support.
    pub fn set_reference(&mut self, reference: [f64; 2]) {
        self.reference = reference;
    }

    /// Where the centre of mass stands on average in the newest frames of `stacks` (N × [`ObservationLayout::width`]), as
    /// the centroid loss sees it: its offset (m, forward and left in the heading frame) from the centre of the feet's
    /// support.
    ///
    /// # Errors
    /// When the stacks have another width.
    pub fn operating_point(&self, stacks: &Tensor) -> candle_core::Result<[f64; 2]> {
        let newest = |part: Range<usize>| self.past(stacks, 0, part);
        let joint_positions = newest(self.observation.joint_positions())?;
        let posture = match self.settings.cen_on {
            CenOn::Predicted => joint_positions,
            CenOn::QuasiStatic => {
                Tensor::cat(&[newest(self.observation.goal())?, self.legs(stacks)?], 1)?
            }
        };
        let orientation = newest(self.observation.orientation())?;
        let [center_of_mass, foot_support] =
            self.balance(&self.kinematics.forward(&posture)?, &orientation)?;
        let mean = (center_of_mass - foot_support)?.mean(0)?;
        let mean = mean.to_dtype(DType::F64)?.to_vec1()?;
        Ok([mean[0], mean[1]])
    }

    /// The terms of what was imagined from `states`. All steps' kinematics are one call.
    ///
    /// # Errors
    /// When the number of steps is not that of the states' goals, or shapes do not fit.
    pub fn terms(&self, states: &StateBatch, steps: &[ImaginedStep]) -> candle_core::Result<Terms> {
        let horizon = 1 + states.goals_ahead.len();
        if steps.len() != horizon {
            bail!("{} imagined steps, expected {horizon}", steps.len());
        }
        let all = |part: fn(&ImaginedStep) -> &Tensor| {
            Tensor::cat(&steps.iter().map(part).collect::<Vec<_>>(), 0)
        };
        let executed = all(|step| &step.goal)?;
        let goals = self.goals(states)?;
        let [orientation, collision, centroid] = self.body(states, &all, &executed, horizon)?;
        Ok(Terms {
            reconstruction: losses::reconstruction(&goals, &executed, self.settings.distance)?,
            orientation,
            collision,
            centroid,
            smoothness: self.smoothness(states, &goals, &executed)?,
            regularization: losses::regularization(&all(|step| &step.latent)?)?,
        })
    }

    /// `L_ori`, `L_col` and `L_cen`, those that have a weight.
    fn body(
        &self,
        states: &StateBatch,
        all: &dyn Fn(fn(&ImaginedStep) -> &Tensor) -> candle_core::Result<Tensor>,
        executed: &Tensor,
        horizon: usize,
    ) -> candle_core::Result<[Option<Tensor>; 3]> {
        let weights = &self.settings.weights;
        let orientation = all(|step| &step.orientation)?;
        let is_upright = (weights.orientation != 0.0)
            .then(|| losses::orientation(&orientation))
            .transpose()?;
        if weights.collision == 0.0 && weights.centroid == 0.0 {
            return Ok([is_upright, None, None]);
        }
        let posture = match self.settings.cen_on {
            CenOn::Predicted => all(|step| &step.joint_positions)?,
            CenOn::QuasiStatic => {
                let legs = self.legs(&states.stacks)?.repeat((horizon, 1))?;
                Tensor::cat(&[executed, &legs], 1)?
            }
        };
        let outputs = self.kinematics.forward(&posture)?;
        let [center_of_mass, foot_support] = self.balance(&outputs, &orientation)?;
        let links = columns(&outputs, &self.outputs.link_centers)?;
        let is_clear = || losses::collision(&links, &self.pairs);
        let is_balanced = || losses::centroid(&center_of_mass, &foot_support, self.reference);
        Ok([
            is_upright,
            (weights.collision != 0.0).then(is_clear).transpose()?,
            (weights.centroid != 0.0).then(is_balanced).transpose()?,
        ])
    }

    /// The goals that were asked for, step by step.
    fn goals(&self, states: &StateBatch) -> candle_core::Result<Tensor> {
        let first = self.past(&states.stacks, 0, self.observation.goal())?;
        let goals: Vec<&Tensor> = [&first].into_iter().chain(&states.goals_ahead).collect();
        Tensor::cat(&goals, 0)
    }

    /// `L_smo` of all steps: the first two look back at what was executed before.
    fn smoothness(
        &self,
        states: &StateBatch,
        goals: &Tensor,
        executed: &Tensor,
    ) -> candle_core::Result<Tensor> {
        let goal = self.observation.goal();
        let before = [2, 1].map(|periods| self.past(&states.stacks, periods, goal.clone()));
        let [before_that, before] = before;
        let (before_that, before) = (before_that?, before?);
        let mut track = Tensor::cat(&[&before_that, &before, executed], 0)?;
        if self.settings.smooth_on == SmoothOn::Correction {
            let [before_that, before] = &states.goals_before;
            track = (track - Tensor::cat(&[before_that, before, goals], 0)?)?;
        }
        let (rows, all) = (before.dim(0)?, executed.dim(0)?);
        losses::smoothness(
            &track.narrow(0, 2 * rows, all)?,
            &track.narrow(0, rows, all)?,
            &track.narrow(0, 0, all)?,
        )
    }

    /// Centre of mass and centre of the feet's support on the ground (N × 2 each, m, heading frame) in rows of the
    /// kinematics' output.
    fn balance(&self, outputs: &Tensor, orientation: &Tensor) -> candle_core::Result<[Tensor; 2]> {
        let center_of_mass = columns(outputs, &self.outputs.center_of_mass)?;
        let foot_support = columns(outputs, &self.outputs.foot_support)?;
        match self.settings.cen_on {
            CenOn::Predicted => Ok([
                losses::horizontal(&center_of_mass, orientation)?,
                losses::horizontal(&foot_support, orientation)?,
            ]),
            CenOn::QuasiStatic => Ok([
                center_of_mass.narrow(1, 0, 2)?,
                foot_support.narrow(1, 0, 2)?,
            ]),
        }
    }

    /// The legs' joint positions in the newest frame.
    fn legs(&self, stacks: &Tensor) -> candle_core::Result<Tensor> {
        let joints = self.observation.joint_positions();
        let goals = self.observation.goal().len();
        self.past(stacks, 0, joints.start + goals..joints.end)
    }

    /// A part of the frame that is `periods` older than the newest.
    fn past(
        &self,
        stacks: &Tensor,
        periods: usize,
        part: Range<usize>,
    ) -> candle_core::Result<Tensor> {
        let frame = self.observation.newest().start - periods * self.observation.frame_width();
        columns(stacks, &(frame + part.start..frame + part.end))
    }
}

fn columns(rows: &Tensor, columns: &Range<usize>) -> candle_core::Result<Tensor> {
    rows.narrow(1, columns.start, columns.len())
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use candle_core::{Device, Var};
    use nalgebra::{UnitQuaternion, Vector3};

    use super::*;
    use crate::emp::losses::CenRef;

    const ROWS: usize = 2;
    const LATENT: usize = 4;

    fn robot() -> Arc<Robot> {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/emp27");
        Arc::new(Robot::load(&folder).unwrap())
    }

    fn layout() -> ObservationLayout {
        ObservationLayout::new(&robot(), 3)
    }

    fn objective(smooth_on: SmoothOn, cen_on: CenOn) -> Objective {
        let settings = LossSettings {
            smooth_on,
            cen_on,
            cen_ref: CenRef::Measured,
            ..LossSettings::default()
        };
        Objective::new(&robot(), layout(), settings).unwrap()
    }

    /// Rows whose numbers all differ, about `center`.
    fn scattered(center: &[f64], size: f64, seed: f64) -> Tensor {
        let width = center.len();
        let values =
            (0..ROWS * width).map(|i| center[i % width] + size * (7.3 * i as f64 + seed).sin());
        Tensor::from_iter(values, &Device::Cpu)
            .and_then(|values| values.reshape((ROWS, width)))
            .unwrap()
    }

    fn defaults() -> Vec<f64> {
        robot().joints().map(|joint| joint.default).collect()
    }

    /// Default goals, moved a little.
    fn goals(seed: f64) -> Tensor {
        let goals = robot().goal_joints().len();
        scattered(&defaults()[..goals], 0.1, seed)
    }

    /// Two steps from stacks of three frames near the default pose.
    fn states() -> StateBatch {
        let layout = layout();
        let mut frame = vec![0.0; layout.frame_width()];
        frame[layout.joint_positions()].copy_from_slice(&defaults());
        frame[layout.goal()].copy_from_slice(&defaults()[..layout.goal().len()]);
        StateBatch {
            stacks: scattered(&frame.repeat(layout.history()), 0.05, 1.0),
            goals_ahead: vec![goals(2.0)],
            goals_before: [goals(3.0), goals(4.0)],
        }
    }

    fn step(seed: f64) -> ImaginedStep {
        ImaginedStep {
            goal: goals(seed),
            latent: scattered(&[0.0; LATENT], 1.0, seed),
            joint_positions: scattered(&defaults(), 0.1, seed + 1.0),
            orientation: scattered(&[0.05, 0.1, 0.0], 0.1, seed + 2.0),
        }
    }

    fn parts(step: &ImaginedStep) -> [&Tensor; 4] {
        let ImaginedStep {
            goal,
            latent,
            joint_positions,
            orientation,
        } = step;
        [goal, latent, joint_positions, orientation]
    }

    fn values(tensor: &Tensor) -> Vec<f64> {
        tensor.flatten_all().unwrap().to_vec1().unwrap()
    }

    fn assert_near(found: &[f64], expected: &[f64]) {
        assert_eq!(found.len(), expected.len());
        for (found, expected) in found.iter().zip(expected) {
            assert!((found - expected).abs() < 1e-9, "{found} {expected}");
        }
    }

    /// `L_smo` of three rows of numbers.
    fn smoothness(now: &[f64], before: &[f64], before_that: &[f64]) -> f64 {
        let terms = now.iter().zip(before).zip(before_that);
        terms
            .map(|((x, y), z)| (x - y).powi(2) + 0.2 * (x + z - 2.0 * y).powi(2))
            .sum()
    }

    fn row(tensor: &Tensor, row: usize) -> Vec<f64> {
        values(&tensor.get(row).unwrap())
    }

    fn minus(a: &[f64], b: &[f64]) -> Vec<f64> {
        a.iter().zip(b).map(|(a, b)| a - b).collect()
    }

    #[test]
    fn the_gradient_equals_finite_differences_through_the_kinematics() {
        const STEP: f64 = 1e-6;
        for (smooth_on, cen_on) in [
            (SmoothOn::Target, CenOn::Predicted),
            (SmoothOn::Correction, CenOn::QuasiStatic),
        ] {
            let mut objective = objective(smooth_on, cen_on);
            objective.set_reference([0.035, -0.01]);
            let states = states();
            let total = |parts: &[Tensor]| {
                let steps: Vec<ImaginedStep> = parts
                    .chunks(4)
                    .map(|parts| ImaginedStep {
                        goal: parts[0].clone(),
                        latent: parts[1].clone(),
                        joint_positions: parts[2].clone(),
                        orientation: parts[3].clone(),
                    })
                    .collect();
                let terms = objective.terms(&states, &steps).unwrap();
                terms.total(&LossWeights::default()).unwrap()
            };
            let steps = [step(5.0), step(9.0)];
            let at: Vec<Tensor> = steps.iter().flat_map(parts).cloned().collect();
            let vars: Vec<Var> = at.iter().map(|x| Var::from_tensor(x).unwrap()).collect();
            let inputs: Vec<Tensor> = vars.iter().map(|var| var.as_tensor().clone()).collect();
            let gradients = total(&inputs).backward().unwrap();
            for (part, var) in vars.iter().enumerate() {
                let gradient = match gradients.get(var) {
                    Some(gradient) => values(gradient),
                    None => vec![0.0; var.elem_count()],
                };
                for (i, slope) in gradient.iter().enumerate() {
                    let moved = |step: f64| {
                        let mut at = at.clone();
                        let mut values = values(&at[part]);
                        values[i] += step;
                        at[part] = Tensor::from_vec(values, var.shape(), &Device::Cpu).unwrap();
                        total(&at).to_scalar::<f64>().unwrap()
                    };
                    let expected = (moved(STEP) - moved(-STEP)) / (2.0 * STEP);
                    assert!(
                        (slope - expected).abs() < 1e-6 * expected.abs().max(1.0),
                        "{cen_on:?}, part {part}, number {i}: {slope} {expected}"
                    );
                }
            }
            let predictions = gradients.get(&vars[2]).is_some();
            assert_eq!(predictions, cen_on == CenOn::Predicted);
        }
    }

    #[test]
    fn smoothness_looks_back_at_what_was_executed_before() {
        let (layout, states) = (layout(), states());
        let steps = [step(5.0), step(9.0)];
        let (mut on_target, mut on_correction) = (Vec::new(), Vec::new());
        for t in 0..steps.len() {
            for r in 0..ROWS {
                let stack = row(&states.stacks, r);
                let frames: Vec<&[f64]> = stack.chunks(layout.frame_width()).collect();
                let goal = |frame: usize| frames[frame][layout.goal()].to_vec();
                let [first, second] = [&steps[0], &steps[1]].map(|step| row(&step.goal, r));
                let executed = [goal(0), goal(1), first, second];
                let asked = [
                    row(&states.goals_before[0], r),
                    row(&states.goals_before[1], r),
                    goal(2),
                    row(&states.goals_ahead[0], r),
                ];
                let changes: Vec<Vec<f64>> =
                    (0..4).map(|i| minus(&executed[i], &asked[i])).collect();
                on_target.push(smoothness(&executed[t + 2], &executed[t + 1], &executed[t]));
                on_correction.push(smoothness(&changes[t + 2], &changes[t + 1], &changes[t]));
            }
        }
        for (smooth_on, expected) in [
            (SmoothOn::Target, on_target),
            (SmoothOn::Correction, on_correction),
        ] {
            let objective = objective(smooth_on, CenOn::Predicted);
            let terms = objective.terms(&states, &steps).unwrap();
            assert_near(&values(&terms.smoothness), &expected);
        }
    }

    #[test]
    fn collision_and_centroid_judge_the_posture_of_the_setting() {
        let (robot, layout, states) = (robot(), layout(), states());
        let steps = [step(5.0), step(9.0)];
        let goals = layout.goal().len();
        for cen_on in [CenOn::Predicted, CenOn::QuasiStatic] {
            let objective = objective(SmoothOn::Target, cen_on);
            let terms = objective.terms(&states, &steps).unwrap();
            let (mut collisions, mut centroids) = (Vec::new(), Vec::new());
            for step in &steps {
                for r in 0..ROWS {
                    let stack = row(&states.stacks, r);
                    let newest = &stack[layout.newest()][layout.joint_positions()];
                    let angles = row(&step.orientation, r);
                    let (posture, base) = match cen_on {
                        CenOn::Predicted => (
                            row(&step.joint_positions, r),
                            UnitQuaternion::from_euler_angles(angles[0], angles[1], 0.0),
                        ),
                        CenOn::QuasiStatic => (
                            [&row(&step.goal, r), &newest[goals..]].concat(),
                            UnitQuaternion::identity(),
                        ),
                    };
                    let mut out = vec![0.0; robot.kinematics().output_width()];
                    robot.kinematics().forward(&posture, &mut out);
                    let outputs = robot.kinematics().layout();
                    let point = |start: usize| Vector3::from_column_slice(&out[start..start + 3]);
                    let link = |index: usize| point(outputs.link_centers.start + 3 * index);
                    let pairs = robot.link_pairs().iter();
                    let distances = pairs.map(|&[a, b]| (link(a) - link(b)).norm());
                    collisions.push(distances.map(|d| (2.0 * (0.08 - d)).exp()).sum());
                    let offset = base
                        * (point(outputs.center_of_mass.start) - point(outputs.foot_support.start));
                    let distance = offset.x.hypot(offset.y);
                    centroids.push((-7.0 * (0.03 - distance)).exp().min(10.0) - 1.0);
                }
            }
            assert_near(&values(terms.collision.as_ref().unwrap()), &collisions);
            assert_near(&values(terms.centroid.as_ref().unwrap()), &centroids);
        }
    }

    #[test]
    fn at_the_operating_point_the_centroid_costs_least() {
        for cen_on in [CenOn::Predicted, CenOn::QuasiStatic] {
            let mut objective = objective(SmoothOn::Target, cen_on);
            let (layout, states) = (layout(), states());
            let newest = states
                .stacks
                .narrow(1, layout.newest().start, layout.frame_width());
            let newest = newest.unwrap().narrow(0, 0, 1).unwrap();
            let part = |part: Range<usize>| columns(&newest, &part).unwrap();
            let step = ImaginedStep {
                goal: part(layout.goal()),
                latent: Tensor::zeros((1, LATENT), DType::F64, &Device::Cpu).unwrap(),
                joint_positions: part(layout.joint_positions()),
                orientation: part(layout.orientation()),
            };
            let states = StateBatch {
                stacks: states.stacks.narrow(0, 0, 1).unwrap(),
                goals_ahead: Vec::new(),
                goals_before: states
                    .goals_before
                    .map(|goals| goals.narrow(0, 0, 1).unwrap()),
            };
            let cost = |objective: &Objective| {
                let terms = objective
                    .terms(&states, std::slice::from_ref(&step))
                    .unwrap();
                values(terms.centroid.as_ref().unwrap())[0]
            };
            let least = (-0.21_f64).exp() - 1.0;
            assert!(cost(&objective) > least + 0.01);
            let reference = objective.operating_point(&states.stacks).unwrap();
            objective.set_reference(reference);
            assert!((cost(&objective) - least).abs() < 1e-4);
            let mean = [states.stacks.clone(), states.stacks.clone()];
            let mean = objective
                .operating_point(&Tensor::cat(&mean, 0).unwrap())
                .unwrap();
            assert_near(&mean, &reference);
        }
    }

    #[test]
    fn the_total_is_the_weighted_sum_of_the_means() {
        let objective = objective(SmoothOn::Target, CenOn::Predicted);
        let terms = objective.terms(&states(), &[step(5.0), step(9.0)]).unwrap();
        let [rec, ori, col, cen, smo, reg] = terms.means().unwrap();
        let expected = 20.0 * rec + 10.0 * ori + col + 10.0 * cen + 100.0 * smo + reg;
        let total = terms.total(&LossWeights::default()).unwrap();
        assert_near(&values(&total), &[expected]);
        let mean = values(&terms.reconstruction).iter().sum::<f64>() / 4.0;
        assert_near(&[mean], &[rec]);
    }

    #[test]
    fn a_term_without_weight_is_not_computed() {
        let mut objective = objective(SmoothOn::Target, CenOn::Predicted);
        let steps = [step(5.0), step(9.0)];
        let all = objective.terms(&states(), &steps).unwrap();
        let weights = &mut objective.settings.weights;
        (weights.orientation, weights.collision, weights.centroid) = (0.0, 0.0, 0.0);
        let weights = *weights;
        let some = objective.terms(&states(), &steps).unwrap();
        assert!(some.orientation.is_none() && some.collision.is_none() && some.centroid.is_none());
        let means = some.means().unwrap();
        let is_computed = means.map(f64::is_finite);
        assert_eq!(is_computed, [true, false, false, false, true, true]);
        let [ours, theirs] = [some, all].map(|terms| values(&terms.total(&weights).unwrap()));
        assert_near(&ours, &theirs);
        objective.settings.weights.centroid = 1.0;
        let balanced = objective.terms(&states(), &steps).unwrap();
        assert!(balanced.centroid.is_some() && balanced.collision.is_none());
    }

    #[test]
    fn misfits_are_errors() {
        let objective = objective(SmoothOn::Target, CenOn::Predicted);
        let error = objective.terms(&states(), &[step(5.0)]).err().unwrap();
        assert!(error.to_string().contains("expected 2"), "{error}");
        let short = ObservationLayout::new(&robot(), 2);
        let error = Objective::new(&robot(), short, LossSettings::default());
        assert!(error.err().unwrap().to_string().contains("3 frames"));
    }
}
