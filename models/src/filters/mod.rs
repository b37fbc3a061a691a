//! Goal filters by name: those that need no learning, which every learned filter has to beat, and the EMP.
//!
//! A filter is called by a specification: its name, and `:key=value,…` where a parameter is not to have its default, as in
//! `soft-knee:shoulder_pitch=-1.5,slope=0.6`. [`LIST`] has them all. Whatever a filter does, its goals stay
//! inside the joints' ranges.

mod low_pass;
mod one_euro;
mod parameters;
mod pose;
mod static_clamp;
#[cfg(test)]
mod tests;
mod velocity_limit;

use std::sync::Arc;

use emp_robot::Robot;

use crate::{
    ModelError,
    controller::{Controller, FilterItem, GoalFilter},
    emp::{DangerGate, Emp, EmpFilter},
};
use low_pass::LowPass;
use one_euro::OneEuro;
use parameters::Parameters;
use pose::{AmplitudeCut, SoftKnee};
use static_clamp::StaticClamp;
use velocity_limit::VelocityLimit;

/// A filter that can be called by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FilterDescription {
    /// Its name.
    pub name: &'static str,
    /// Its parameters with their defaults, as in a specification; empty if it has none.
    pub parameters: &'static str,
    /// What it does, in a line.
    pub summary: &'static str,
}

/// All of them.
pub const LIST: [FilterDescription; 9] = [
    FilterDescription {
        name: Controller::DECOUPLED,
        parameters: "",
        summary: "no filter: the goal goes to the robot as it is",
    },
    FilterDescription {
        name: EmpFilter::ALWAYS,
        parameters: "",
        summary: "the robot's Executable Motion Prior",
    },
    FilterDescription {
        name: EmpFilter::WHEN_DANGER,
        parameters: "regloss=<the checkpoint's gate>,tilt=<none>",
        summary: "the EMP while regloss, or the base's tilt (rad), is above its limit; one limit at most",
    },
    FilterDescription {
        name: VelocityLimit::NAME,
        parameters: "limit=<each joint's own>",
        summary: "no joint's goal moves faster than limit (rad/s)",
    },
    FilterDescription {
        name: OneEuro::NAME,
        parameters: "cutoff=2,beta=0.5,derivative=1",
        summary: "low-pass at cutoff (Hz) that opens by beta (Hz per rad/s) as a joint speeds up; derivative (Hz) smooths that speed",
    },
    FilterDescription {
        name: AmplitudeCut::NAME,
        parameters: "factor=0.9",
        summary: "every goal's distance from the default pose times factor (0 to 1)",
    },
    FilterDescription {
        name: LowPass::NAME,
        parameters: "cutoff=2,order=1",
        summary: "low-pass at cutoff (Hz, half power), order equal first-order sections in a row, no overshoot",
    },
    FilterDescription {
        name: SoftKnee::NAME,
        parameters: "shoulder_pitch=-1.5,slope=0.6",
        summary: "joints whose name holds the word (any number of word=angle) go on at slope (0 to 1) beyond the angle (rad)",
    },
    FilterDescription {
        name: StaticClamp::NAME,
        parameters: "margin=<0.7 of the default pose's>,legs=default",
        summary: "goals are pulled to the default pose until the centre of mass is margin (m) inside the feet's support; legs default or measured",
    },
];

/// Why a specification is none.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FilterError {
    /// There is no such filter.
    #[error("no filter {name:?}; expected one of {}", LIST.map(|filter| filter.name).join(", "))]
    Unknown {
        /// What was asked for.
        name: String,
    },
    /// Something is not of the form `key=value`, or a key comes twice.
    #[error(
        "filter {filter}: expected parameters as key=value,key=value with each key once, found {found:?}"
    )]
    Syntax {
        /// Name of the filter.
        filter: String,
        /// The part that is not.
        found: String,
    },
    /// The filter has no such parameter.
    #[error("filter {filter}: no parameter {key:?}; expected {expected}")]
    Parameter {
        /// Name of the filter.
        filter: String,
        /// The parameter's key.
        key: String,
        /// What could stand there.
        expected: String,
    },
    /// The robot has no EMP.
    #[error("filter {filter}: robot {robot} has no EMP weights")]
    NoEmp {
        /// Name of the filter.
        filter: String,
        /// Name of the robot.
        robot: String,
    },
    /// A parameter has a value that it cannot have.
    #[error("filter {filter}: {key}: expected {expected}, found {found}")]
    Value {
        /// Name of the filter.
        filter: String,
        /// The parameter's key.
        key: String,
        /// What was expected.
        expected: String,
        /// What was found.
        found: String,
    },
}

/// The filter that `specification` asks for, for `robot` with its EMP, if it has one; none for [`Controller::DECOUPLED`].
///
/// # Errors
/// If there is no such filter, it is the EMP and the robot has none, or a parameter is unknown, malformed or out of its range.
pub fn by_name(
    specification: &str,
    robot: &Arc<Robot>,
    emp: Option<&Arc<Emp>>,
) -> Result<Option<Arc<dyn GoalFilter>>, FilterError> {
    let mut parameters = Parameters::parse(specification)?;
    let rule: Box<dyn Rule> = match parameters.filter() {
        Controller::DECOUPLED => {
            parameters.finish("none")?;
            return Ok(None);
        }
        EmpFilter::ALWAYS | EmpFilter::WHEN_DANGER => {
            let emp = emp.ok_or_else(|| FilterError::NoEmp {
                filter: parameters.filter().to_owned(),
                robot: robot.name().to_owned(),
            })?;
            return Ok(Some(Arc::new(emp_filter(&mut parameters, emp)?)));
        }
        VelocityLimit::NAME => Box::new(VelocityLimit::new(&mut parameters, robot)?),
        OneEuro::NAME => Box::new(OneEuro::new(&mut parameters, robot)?),
        AmplitudeCut::NAME => Box::new(AmplitudeCut::new(&mut parameters, robot)?),
        LowPass::NAME => Box::new(LowPass::new(&mut parameters, robot)?),
        SoftKnee::NAME => Box::new(SoftKnee::new(&mut parameters, robot)?),
        StaticClamp::NAME => Box::new(StaticClamp::new(&mut parameters, robot)?),
        name => {
            let name = name.to_owned();
            return Err(FilterError::Unknown { name });
        }
    };
    let ranges = robot.goal_joints().iter();
    Ok(Some(Arc::new(Baseline {
        specification: specification.trim().to_owned(),
        rule,
        ranges: ranges
            .map(|joint| joint.range.map(|limit| limit as f32))
            .collect(),
    })))
}

fn emp_filter(parameters: &mut Parameters<'_>, emp: &Arc<Emp>) -> Result<EmpFilter, FilterError> {
    if parameters.filter() == EmpFilter::ALWAYS {
        parameters.finish("none")?;
        return Ok(EmpFilter::always(Arc::clone(emp)));
    }
    let tilt = parameters.number("tilt", 0.0..=std::f64::consts::PI, " rad")?;
    let gate = match tilt {
        Some(tilt) => Some(DangerGate::Tilt(tilt as f32)),
        None => parameters
            .number("regloss", 0.0..=1e6, "")?
            .map(|limit| DangerGate::Regloss(limit as f32)),
    };
    parameters.finish("regloss or tilt, not both")?;
    let gate = gate.unwrap_or(emp.config().gate);
    Ok(EmpFilter::when_danger(Arc::clone(emp), gate))
}

/// Changes one robot's goal by a fixed rule.
trait Rule: Send + Sync {
    fn apply(&self, item: &mut FilterItem<'_>);
}

/// A rule as a filter.
struct Baseline {
    specification: String,
    rule: Box<dyn Rule>,
    ranges: Vec<[f32; 2]>,
}

impl GoalFilter for Baseline {
    fn name(&self) -> &str {
        &self.specification
    }

    fn filter(&self, batch: &mut [FilterItem<'_>]) -> Result<(), ModelError> {
        for item in batch {
            self.rule.apply(item);
            for (angle, range) in item.goal.iter_mut().zip(&self.ranges) {
                *angle = angle.clamp(range[0], range[1]);
            }
        }
        Ok(())
    }
}

/// What a rule remembers of a robot: `width` numbers, or none yet.
fn remembered(memory: &mut [f32], width: usize) -> Option<&mut [f32]> {
    (memory.len() == width).then_some(memory)
}
