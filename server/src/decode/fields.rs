//! Checks that several messages share: names, numbers, rotations, joint angles. Each names the field that is wrong.

use std::{fmt::Display, ops::RangeInclusive};

use emp_proto::v1::Quaternion;
use emp_robot::Joint;
use nalgebra::UnitQuaternion;

use crate::error::FieldError;

/// How far a quaternion's length may be from 1.
const QUATERNION_TOLERANCE: f64 = 0.01;
/// How far outside its limits a joint's angle may be, radians: sensors and soft stops give a little.
const ANGLE_TOLERANCE: f64 = 0.5;

/// Largest action of a policy, of whatever sign: what it has learnt to answer is a hundredth of that.
pub(crate) const LARGEST_ACTION: f32 = 100.0;

/// A name that is given, of at most so many bytes.
pub(crate) fn name(field: &str, name: String, longest: usize) -> Result<String, FieldError> {
    match name.len() {
        0 => Err(FieldError::new(field, "it is missing")),
        length if length > longest => {
            let description = format!("{length} bytes; expected at most {longest}");
            Err(FieldError::new(field, description))
        }
        _ => Ok(name),
    }
}

/// Refuses numbers that are not finite; each has its name below `path`.
pub(crate) fn finite<const N: usize>(
    path: &str,
    values: [(&str, f32); N],
) -> Result<(), FieldError> {
    match values.into_iter().find(|(_, value)| !value.is_finite()) {
        Some((name, value)) => Err(FieldError::new(
            format!("{path}.{name}"),
            format!("{value}; expected a finite number"),
        )),
        None => Ok(()),
    }
}

/// A quaternion of unit length, normalised.
pub(crate) fn rotation(
    path: &str,
    quaternion: &Quaternion,
) -> Result<UnitQuaternion<f64>, FieldError> {
    let &Quaternion { w, x, y, z } = quaternion;
    finite(path, [("w", w), ("x", x), ("y", y), ("z", z)])?;
    let quaternion = nalgebra::Quaternion::new(w, x, y, z).cast::<f64>();
    let length = quaternion.norm();
    if (length - 1.0).abs() > QUATERNION_TOLERANCE {
        return Err(FieldError::new(
            path,
            format!("a quaternion of length {length:.3}; expected length 1"),
        ));
    }
    Ok(UnitQuaternion::from_quaternion(quaternion))
}

/// As many finite numbers as expected.
pub(crate) fn numbers(
    path: &str,
    values: &[f32],
    expected: usize,
    unit: &str,
) -> Result<(), FieldError> {
    if values.len() != expected {
        return Err(FieldError::new(
            path,
            format!("{} {unit}; expected {expected}", values.len()),
        ));
    }
    match values.iter().position(|value| !value.is_finite()) {
        Some(index) => Err(FieldError::new(
            format!("{path}[{index}]"),
            format!("{}; expected a finite number", values[index]),
        )),
        None => Ok(()),
    }
}

/// A number inside its range. NaN is in none.
pub(crate) fn within<T: PartialOrd + Display + Copy>(
    field: &str,
    value: T,
    range: RangeInclusive<T>,
) -> Result<T, FieldError> {
    if range.contains(&value) {
        return Ok(value);
    }
    let (least, most) = (range.start(), range.end());
    Err(FieldError::new(
        field,
        format!("{value}; expected {least} to {most}"),
    ))
}

/// As many numbers as expected, none beyond `most`, whatever its sign.
pub(crate) fn bounded(
    path: &str,
    values: &[f32],
    expected: usize,
    most: f32,
) -> Result<(), FieldError> {
    numbers(path, values, expected, "numbers")?;
    match values.iter().position(|value| value.abs() > most) {
        Some(index) => Err(FieldError::new(
            format!("{path}[{index}]"),
            format!("{}; expected {} to {most}", values[index], -most),
        )),
        None => Ok(()),
    }
}

/// An angle for each joint, at most a little outside its limits.
pub(crate) fn angles<'a>(
    path: &str,
    angles: &[f32],
    joints: impl Iterator<Item = &'a Joint>,
) -> Result<(), FieldError> {
    let joints: Vec<_> = joints.collect();
    numbers(path, angles, joints.len(), "angles")?;
    for (index, (&angle, joint)) in angles.iter().zip(joints).enumerate() {
        let [lower, upper] = joint.range;
        let allowed = lower - ANGLE_TOLERANCE..=upper + ANGLE_TOLERANCE;
        if !allowed.contains(&f64::from(angle)) {
            return Err(FieldError::new(
                format!("{path}[{index}]"),
                format!(
                    "{angle} rad for {}, whose limits are {lower} and {upper}; expected at most {ANGLE_TOLERANCE} rad \
                     outside",
                    joint.name
                ),
            ));
        }
    }
    Ok(())
}
