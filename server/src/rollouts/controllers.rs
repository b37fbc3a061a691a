//! The controllers that can be evaluated, on the wire and as `emp-models` calls them.

use std::fmt::Write as _;

use emp_models::{
    controller::Controller,
    emp::Emp,
    filters::{self, DECOUPLED, EMP, EMP_WHEN_DANGER},
    policy::Policy,
};
use emp_proto::v1::{
    self, ControllerDescription, EmpController, FilterController, ParameterDescription,
    controller::Kind, emp_controller::Gate, filter_parameter::Value,
};
use std::sync::Arc;

use crate::{
    catalog::Catalog,
    decode::fields,
    error::{FieldError, ServiceError},
};

/// Longest name of a filter or a parameter, bytes, and most parameters.
const LONGEST_NAME: usize = 64;
const MOST_PARAMETERS: usize = 64;

/// Every controller, or those that a robot can have.
pub(crate) fn list(
    catalog: &Catalog,
    robot: &str,
) -> Result<Vec<ControllerDescription>, ServiceError> {
    let has_emp = match robot {
        "" => true,
        robot => catalog.policy_for(robot, "", "")?.model.emp().is_some(),
    };
    let needs_emp = |name| matches!(name, EMP | EMP_WHEN_DANGER);
    let filters = filters::LIST.iter();
    let described = filters.filter(|filter| has_emp || !needs_emp(filter.name));
    let parameter = |text: &str| {
        let (name, default_value) = text.split_once('=').unwrap_or((text, ""));
        ParameterDescription {
            name: name.to_owned(),
            default_value: default_value.to_owned(),
        }
    };
    Ok(described
        .map(|filter| ControllerDescription {
            name: filter.name.to_owned(),
            summary: filter.summary.to_owned(),
            parameters: filter
                .parameters
                .split(',')
                .filter(|text| !text.is_empty())
                .map(parameter)
                .collect(),
        })
        .collect())
}

/// The controller that a config asks for.
pub(super) fn read(
    controller: Option<&v1::Controller>,
    policy: &Arc<Policy>,
    emp: Option<&Arc<Emp>>,
) -> Result<Controller, FieldError> {
    let kind = controller.and_then(|controller| controller.kind.as_ref());
    let specification = match kind {
        None | Some(Kind::Decoupled(_)) => DECOUPLED.to_owned(),
        Some(Kind::Emp(emp)) => emp_specification(emp)?,
        Some(Kind::Filter(filter)) => filter_specification(filter)?,
    };
    Controller::by_name(&specification, policy, emp)
        .map_err(|error| FieldError::new("config.controller", error.to_string()))
}

fn emp_specification(emp: &EmpController) -> Result<String, FieldError> {
    let field = "config.controller.emp.mode";
    let name = match v1::EmpMode::try_from(emp.mode) {
        Ok(v1::EmpMode::Unspecified | v1::EmpMode::On) => EMP,
        Ok(v1::EmpMode::WhenDanger) => EMP_WHEN_DANGER,
        Ok(v1::EmpMode::Off) => {
            let description = "EMP_MODE_OFF; expected `decoupled` for that";
            return Err(FieldError::new(field, description));
        }
        Err(_) => return Err(FieldError::not_in("EmpMode", field, emp.mode)),
    };
    let gate = match emp.gate {
        None => String::new(),
        Some(Gate::Regloss(limit)) => format!(":regloss={limit}"),
        Some(Gate::Tilt(limit)) => format!(":tilt={limit}"),
    };
    Ok(format!("{name}{gate}"))
}

fn filter_specification(filter: &FilterController) -> Result<String, FieldError> {
    let field = "config.controller.filter";
    let name = |field: &str, name: &str| {
        let name = fields::name(field, name.to_owned(), LONGEST_NAME)?;
        match name.contains([':', ',', '=', '\n']) {
            true => Err(FieldError::new(
                field,
                format!("{name:?}; expected a plain name"),
            )),
            false => Ok(name),
        }
    };
    let mut specification = name(&format!("{field}.name"), &filter.name)?;
    let count = filter.parameters.len();
    fields::within(&format!("{field}.parameters"), count, 0..=MOST_PARAMETERS)?;
    for (index, parameter) in filter.parameters.iter().enumerate() {
        let path = format!("{field}.parameters[{index}]");
        let key = name(&format!("{path}.name"), &parameter.name)?;
        let value = match &parameter.value {
            Some(Value::Number(number)) => number.to_string(),
            Some(Value::Word(word)) => name(&format!("{path}.word"), word)?,
            None => return Err(FieldError::new(format!("{path}.value"), "it is missing")),
        };
        let separator = if index == 0 { ':' } else { ',' };
        // Writing to a text does not fail.
        let _ = write!(specification, "{separator}{key}={value}");
    }
    Ok(specification)
}
