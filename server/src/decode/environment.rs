//! Settings of training environments off the wire.

use std::f64::consts::PI;

use emp_proto::v1::{
    AddedMass, EnvironmentRandomization, EnvironmentSettings, Range, added_mass::Choice,
};
use emp_robot::Robot;
use emp_sim::{
    SimError,
    environment::{EnvironmentConfig, Hang, MassRange, REWARD_NAMES, Randomization},
    pushes::Push,
};

use super::fields;
use crate::error::FieldError;

/// Where the settings stand in their message.
const FIELD: &str = "config.environment";
/// Longest episode, control periods.
const LONGEST_EPISODE: u32 = 1_000_000;
/// Largest weight of a reward.
const LARGEST_WEIGHT: f64 = 1e6;
/// Largest factor, and largest mass, kg.
const LARGEST: f64 = 100.0;

/// Reads them for `robot`; what is left out has the paper's value.
pub(crate) fn read(
    settings: Option<&EnvironmentSettings>,
    robot: &Robot,
) -> Result<EnvironmentConfig, FieldError> {
    let mut config = EnvironmentConfig::default();
    let Some(settings) = settings else {
        return Ok(config);
    };
    if let Some(rows) = &settings.randomization {
        config.randomization = read_randomization(rows)?;
    }
    for (index, reward) in settings.rewards.iter().enumerate() {
        let field = format!("{FIELD}.rewards[{index}]");
        let weight = fields::within(
            &format!("{field}.weight"),
            reward.weight,
            -LARGEST_WEIGHT..=LARGEST_WEIGHT,
        )?;
        *config.rewards.of_term(&reward.term).ok_or_else(|| {
            let known = REWARD_NAMES.join(", ");
            let description = format!("{:?}; expected one of {known}", reward.term);
            FieldError::new(format!("{field}.term"), description)
        })? = weight;
    }
    if let Some(frames) = settings.episode_frames {
        let field = format!("{FIELD}.episode_frames");
        config.episode_frames = fields::within(&field, frames, 1..=LONGEST_EPISODE)? as usize;
    }
    for (name, value, setting) in [
        ("tilt_limit", settings.tilt_limit, &mut config.tilt_limit),
        (
            "height_limit",
            settings.height_limit,
            &mut config.height_limit,
        ),
    ] {
        if let Some(value) = value {
            *setting = fields::within(&format!("{FIELD}.{name}"), value, 0.0..=1.0)?;
        }
    }
    config.check(robot).map_err(|error| match error {
        SimError::Setting {
            name,
            expected,
            found,
        } => FieldError::new(
            format!("{FIELD}.{name}"),
            format!("{found}; expected {expected}"),
        ),
        error => FieldError::new(FIELD, error.to_string()),
    })?;
    Ok(config)
}

fn read_randomization(rows: &EnvironmentRandomization) -> Result<Randomization, FieldError> {
    let field = |name: &str| format!("{FIELD}.randomization.{name}");
    let range = |name: &str, range: &Option<Range>, bounds: [f64; 2]| {
        let read = |range: &Range| read_range(&field(name), range, bounds);
        range.as_ref().map(read).transpose()
    };
    let factor = |name: &str, row: &Option<Range>| range(name, row, [0.0, LARGEST]);
    let mass = |name: &str, mass: &Option<AddedMass>, least: f64| {
        let choice = mass.as_ref().and_then(|mass| mass.choice.as_ref());
        Ok(match choice {
            None => MassRange::Off,
            Some(Choice::Robot(_)) => MassRange::Robot,
            Some(Choice::Kilograms(range)) => {
                let field = field(&format!("{name}.kilograms"));
                MassRange::Kilograms(read_range(&field, range, [least, LARGEST])?)
            }
        })
    };
    let number = |name: &str, value: f64, bounds: [f64; 2]| {
        fields::within(&field(name), value, bounds[0]..=bounds[1])
    };
    let push = rows.push.as_ref().map(|push| {
        Ok(Push {
            interval: number("push.interval", push.interval, [0.0, 3600.0])?,
            linear: number("push.linear", push.linear, [0.0, LARGEST])?,
            angular: number("push.angular", push.angular, [0.0, LARGEST])?,
        })
    });
    let hang = rows.hang.as_ref().map(|hang| {
        Ok(Hang {
            height: number("hang.height", hang.height, [0.0, 10.0])?,
            ratio: number("hang.ratio", hang.ratio, [0.0, 1.0])?,
        })
    });
    Ok(Randomization {
        friction: factor("friction", &rows.friction)?,
        base_mass: mass("base_mass", &rows.base_mass, -LARGEST)?,
        hand_mass: mass("hand_mass", &rows.hand_mass, 0.0)?,
        base_com: range("base_com", &rows.base_com, [-1.0, 1.0])?,
        link_inertia: range("link_inertia", &rows.link_inertia, [0.01, LARGEST])?,
        link_mass: range("link_mass", &rows.link_mass, [0.01, LARGEST])?,
        p_gain: factor("p_gain", &rows.p_gain)?,
        d_gain: factor("d_gain", &rows.d_gain)?,
        motor_torque: factor("motor_torque", &rows.motor_torque)?,
        motor_damping: factor("motor_damping", &rows.motor_damping)?,
        motor_delay: range("motor_delay", &rows.motor_delay, [0.0, 1.0])?,
        push: push.transpose()?,
        hang: hang.transpose()?,
        initial_joints: range("initial_joints", &rows.initial_joints, [-PI, PI])?,
        action: range("action", &rows.action, [-LARGEST, LARGEST])?,
    })
}

fn read_range(field: &str, range: &Range, bounds: [f64; 2]) -> Result<[f64; 2], FieldError> {
    let [least, most] = bounds;
    let low = fields::within(&format!("{field}.least"), range.least, least..=most)?;
    let high = fields::within(&format!("{field}.most"), range.most, low..=most)?;
    Ok([low, high])
}
