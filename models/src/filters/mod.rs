//! Goal filters by name: those that need no learning, which every learned filter has to beat, and the EMP.
//!
//! A filter is called by a specification: its name, and `:key=value,…` where a parameter is not to have its default, as in
//! `soft-knee:shoulder_pitch=-1.5,slope=0.6`. [`LIST`] has them all. Whatever a filter does, its goals stay
//! inside the joints' ranges.

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
use rule::{Rule, RuleFilter};
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
    let mut parameters = Parameters::parse(specification)?;
    let rule: Box<dyn Rule> = match parameters.filter() {
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
        VELOCITY_LIMIT => Box::new(VelocityLimit::new(&mut parameters, robot)?),
        ONE_EURO => Box::new(OneEuro::new(&mut parameters, robot)?),
        AMPLITUDE_CUT => Box::new(AmplitudeCut::new(&mut parameters, robot)?),
        LOW_PASS => Box::new(LowPass::new(&mut parameters, robot)?),
        SOFT_KNEE => Box::new(SoftKnee::new(&mut parameters, robot)?),
        STATIC_CLAMP => Box::new(StaticClamp::new(&mut parameters, robot)?),
        name => {
            let name = name.to_owned();
            return Err(FilterError::Unknown { name });
        }
    };
    Ok(Some(Arc::new(RuleFilter::new(specification, rule, robot))))
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
