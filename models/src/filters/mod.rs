//! Goal filters by name: those that need no learning, which every learned filter has to beat, and the EMP.
//!
//! A filter is called by a specification: its name, and `:key=value,…` where a parameter is not to have its default, as in
//! `soft-knee:shoulder_pitch=-1.5,slope=0.6`. [`LIST`] has them all. Those that need no learning combine: `a>b` gives b what a
//! answers. A filter that treats each joint by itself can be told which ones, by words in their names:
//! `velocity-limit:limit=1.5,joints=waist+shoulder`. Whatever a filter does, its goals stay inside the joints' ranges.

mod emp;
mod error;
mod goal_filter;
mod low_pass;
mod names;
mod one_euro;
mod parameters;
mod pose;
mod rule;
mod static_clamp;
#[cfg(test)]
mod tests;
mod velocity_limit;

use std::sync::Arc;

use emp_robot::Robot;

pub use emp::EmpFilter;
pub use error::FilterError;
pub use goal_filter::{FilterItem, GoalFilter, Risk};
pub use names::{DECOUPLED, EMP, EMP_WHEN_DANGER, FilterDescription, LIST};

use crate::emp::{DangerGate, Emp};
use low_pass::LowPass;
use names::{AMPLITUDE_CUT, LOW_PASS, ONE_EURO, SOFT_KNEE, STATIC_CLAMP, VELOCITY_LIMIT};
use one_euro::OneEuro;
use parameters::Parameters;
use pose::{AmplitudeCut, SoftKnee};
use rule::{Rule, RuleFilter, SomeJoints};
use static_clamp::StaticClamp;
use velocity_limit::VelocityLimit;

/// The filter that `specification` asks for, for `robot` with its EMP, if it has one; none for [`DECOUPLED`].
///
/// # Errors
/// If there is no such filter, it is the EMP and the robot has none, or a parameter is unknown, malformed or out of its range.
pub fn by_name(
    specification: &str,
    robot: &Arc<Robot>,
    emp: Option<&Arc<Emp>>,
) -> Result<Option<Arc<dyn GoalFilter>>, FilterError> {
    let mut parts = specification.split('>').map(Parameters::parse);
    if let (Some(only), None) = (parts.next(), parts.next()) {
        let mut parameters = only?;
        match parameters.filter() {
            DECOUPLED => {
                parameters.finish("none")?;
                return Ok(None);
            }
            EMP | EMP_WHEN_DANGER => {
                let emp = emp.ok_or_else(|| FilterError::NoEmp {
                    filter: parameters.filter().to_owned(),
                    robot: robot.name().to_owned(),
                })?;
                return Ok(Some(Arc::new(emp_filter(&mut parameters, emp)?)));
            }
            _ => {}
        }
    }
    let parts = specification.split('>').map(Parameters::parse);
    let rules = parts.map(|part| rule(&mut part?, robot));
    let rules = rules.collect::<Result<_, _>>()?;
    Ok(Some(Arc::new(RuleFilter::new(specification, rules, robot))))
}

fn rule(parameters: &mut Parameters<'_>, robot: &Arc<Robot>) -> Result<Box<dyn Rule>, FilterError> {
    let name = parameters.filter();
    let by_joint = [VELOCITY_LIMIT, ONE_EURO, AMPLITUDE_CUT, LOW_PASS];
    let others = match by_joint.contains(&name) {
        true => parameters.other_joints(robot)?,
        false => Vec::new(),
    };
    let rule: Box<dyn Rule> = match name {
        VELOCITY_LIMIT => Box::new(VelocityLimit::new(parameters, robot)?),
        ONE_EURO => Box::new(OneEuro::new(parameters, robot)?),
        AMPLITUDE_CUT => Box::new(AmplitudeCut::new(parameters, robot)?),
        LOW_PASS => Box::new(LowPass::new(parameters, robot)?),
        SOFT_KNEE => Box::new(SoftKnee::new(parameters, robot)?),
        STATIC_CLAMP => Box::new(StaticClamp::new(parameters, robot)?),
        DECOUPLED | EMP | EMP_WHEN_DANGER => {
            let filter = name.to_owned();
            return Err(FilterError::Combined { filter });
        }
        _ => {
            let name = name.to_owned();
            return Err(FilterError::Unknown { name });
        }
    };
    if others.is_empty() {
        return Ok(rule);
    }
    Ok(Box::new(SomeJoints::new(rule, others)))
}

fn emp_filter(parameters: &mut Parameters<'_>, emp: &Arc<Emp>) -> Result<EmpFilter, FilterError> {
    if parameters.filter() == EMP {
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
