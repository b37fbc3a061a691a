//! Controllers as people write them: `NAME` or `NAME:key=value,…`.

use emp_proto::v1::{
    Controller, DecoupledController, EmpController, EmpMode, FilterController, FilterParameter,
    controller::Kind, emp_controller::Gate, filter_parameter::Value,
};

/// A text that is no controller.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("controller {text:?}: expected NAME or NAME:key=value,key=value, {expected}")]
pub struct ControllerError {
    text: String,
    expected: &'static str,
}

/// The controller that a text means: `decoupled`, `emp`, `emp-when-danger` with a gate (`:regloss=…` or `:tilt=…`) or without, or
/// another filter with its parameters. Whether there is such a filter, the server says.
///
/// # Errors
/// When the text has another form.
pub fn controller(text: &str) -> Result<Controller, ControllerError> {
    let wrong = |expected| ControllerError {
        text: text.to_owned(),
        expected,
    };
    let (name, rest) = text.split_once(':').unwrap_or((text, ""));
    let parts = rest.split(',').filter(|_| !rest.trim().is_empty());
    let parameters = parts.map(|part| {
        let (key, value) = part
            .split_once('=')
            .ok_or_else(|| wrong("with key=value"))?;
        Ok((key.trim(), value.trim()))
    });
    let parameters: Vec<(&str, &str)> = parameters.collect::<Result<_, _>>()?;
    let kind = match name.trim() {
        "" | "decoupled" if parameters.is_empty() => Kind::Decoupled(DecoupledController {}),
        "emp" if parameters.is_empty() => Kind::Emp(EmpController {
            mode: EmpMode::On.into(),
            gate: None,
        }),
        "emp-when-danger" => Kind::Emp(EmpController {
            mode: EmpMode::WhenDanger.into(),
            gate: gate(&parameters).ok_or_else(|| wrong("with one of regloss and tilt"))?,
        }),
        "" | "decoupled" | "emp" => return Err(wrong("without parameters")),
        name => Kind::Filter(FilterController {
            name: name.to_owned(),
            parameters: parameters.into_iter().map(parameter).collect(),
        }),
    };
    Ok(Controller { kind: Some(kind) })
}

/// The gate that the parameters say, none for the checkpoint's own; or none where they say something else.
fn gate(parameters: &[(&str, &str)]) -> Option<Option<Gate>> {
    match parameters {
        [] => Some(None),
        [("regloss", limit)] => Some(Some(Gate::Regloss(limit.parse().ok()?))),
        [("tilt", limit)] => Some(Some(Gate::Tilt(limit.parse().ok()?))),
        _ => None,
    }
}

fn parameter((name, value): (&str, &str)) -> FilterParameter {
    FilterParameter {
        name: name.to_owned(),
        value: Some(match value.parse() {
            Ok(number) => Value::Number(number),
            Err(_) => Value::Word(value.to_owned()),
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn kind(text: &str) -> Kind {
        controller(text).expect(text).kind.expect("a kind")
    }

    #[test]
    fn texts_become_controllers() {
        assert_eq!(kind("decoupled"), Kind::Decoupled(DecoupledController {}));
        let Kind::Emp(emp) = kind("emp-when-danger:tilt=0.2") else {
            panic!("an EMP")
        };
        assert_eq!(emp.mode(), EmpMode::WhenDanger);
        assert_eq!(emp.gate, Some(Gate::Tilt(0.2)));
        let Kind::Filter(filter) = kind("static-clamp:margin=0.02, legs=measured") else {
            panic!("a filter")
        };
        let values: Vec<_> = filter.parameters.into_iter().map(|p| p.value).collect();
        let word = Value::Word("measured".to_owned());
        assert_eq!(values, [Some(Value::Number(0.02)), Some(word)]);
        for bad in ["emp:tilt=1", "decoupled:a=1", "emp-when-danger:a=1", "x:y"] {
            assert!(controller(bad).is_err(), "{bad}");
        }
    }
}
