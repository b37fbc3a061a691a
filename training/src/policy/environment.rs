//! Settings of the environments as the servers take them.

use emp_client::{
    AddedMass, EnvironmentRandomization, EnvironmentSettings, Hang, MassChoice, Range,
    RewardWeight, RobotMass, TrainingPush,
};
use emp_sim::environment::{EnvironmentConfig, MassRange, REWARD_NAMES};

/// Everything that the settings say.
pub(super) fn message(config: &EnvironmentConfig) -> EnvironmentSettings {
    let rows = &config.randomization;
    let range = |[least, most]: [f64; 2]| Range { least, most };
    let mass = |mass: MassRange| {
        let choice = match mass {
            MassRange::Off => return None,
            MassRange::Robot => MassChoice::Robot(RobotMass {}),
            MassRange::Kilograms(kilograms) => MassChoice::Kilograms(range(kilograms)),
        };
        Some(AddedMass {
            choice: Some(choice),
        })
    };
    let mut rewards = config.rewards;
    let weights = REWARD_NAMES.iter().map(|term| RewardWeight {
        term: (*term).to_owned(),
        weight: rewards.of_term(term).copied().unwrap_or_default(),
    });
    EnvironmentSettings {
        randomization: Some(EnvironmentRandomization {
            friction: rows.friction.map(range),
            base_mass: mass(rows.base_mass),
            hand_mass: mass(rows.hand_mass),
            base_com: rows.base_com.map(range),
            link_inertia: rows.link_inertia.map(range),
            link_mass: rows.link_mass.map(range),
            p_gain: rows.p_gain.map(range),
            d_gain: rows.d_gain.map(range),
            motor_torque: rows.motor_torque.map(range),
            motor_damping: rows.motor_damping.map(range),
            motor_delay: rows.motor_delay.map(range),
            push: rows.push.map(|push| TrainingPush {
                interval: push.interval,
                linear: push.linear,
                angular: push.angular,
            }),
            hang: rows.hang.map(|hang| Hang {
                height: hang.height,
                ratio: hang.ratio,
            }),
            initial_joints: rows.initial_joints.map(range),
            action: rows.action.map(range),
        }),
        rewards: weights.collect(),
        episode_frames: u32::try_from(config.episode_frames).ok(),
        tilt_limit: Some(config.tilt_limit),
        height_limit: Some(config.height_limit),
    }
}
