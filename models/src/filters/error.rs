//! What can be wrong with a filter's specification.

use super::names::LIST;

/// Why a specification cannot be used.
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
    /// Only filters that need no learning combine.
    #[error("filter {filter} cannot be combined with others by `>`")]
    Combined {
        /// Name of the filter.
        filter: String,
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
