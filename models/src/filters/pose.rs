//! Rules that look at the goal's angles alone, one joint at a time, without memory.

use emp_robot::{Joint, Robot};

use super::{error::FilterError, goal_filter::FilterItem, parameters::Parameters, rule::Rule};

/// Multiplies each goal's distance from the default pose by `factor`.
pub(super) struct AmplitudeCut {
    factor: f32,
    default: Vec<f32>,
}

impl AmplitudeCut {
    pub(super) fn new(parameters: &mut Parameters<'_>, robot: &Robot) -> Result<Self, FilterError> {
        let factor = parameters.number("factor", 0.0..=1.0, "")?;
        parameters.finish("factor or joints")?;
        Ok(Self {
            factor: factor.unwrap_or(0.9) as f32,
            default: robot.default_goal(),
        })
    }
}

impl Rule for AmplitudeCut {
    fn apply(&self, item: &mut FilterItem<'_>) {
        for (goal, default) in item.goal.iter_mut().zip(&self.default) {
            *goal -= (1.0 - self.factor) * (*goal - default);
        }
    }
}

/// Limits single joints softly: beyond its knee (as seen from the default pose) a joint goes on at a lower slope.
///
/// Parameters: any number of `word=angle` (rad), each for the joints whose name holds the word, and `slope`. Without any
/// word: `shoulder_pitch=-1.5`, arms overhead.
pub(super) struct SoftKnee {
    slope: f32,
    /// Indices of joints, and their knees.
    knees: Vec<(usize, Knee)>,
}

/// Where a joint bends, rad.
#[derive(Clone, Copy)]
enum Knee {
    Above(f32),
    Below(f32),
}

impl SoftKnee {
    pub(super) fn new(parameters: &mut Parameters<'_>, robot: &Robot) -> Result<Self, FilterError> {
        let slope = parameters.number("slope", 0.0..=1.0, "")?;
        let mut words = parameters.rest();
        if words.is_empty() {
            words.insert("shoulder_pitch", "-1.5");
        }
        let mut knees = Vec::new();
        for (word, text) in words {
            let joints = robot.goal_joints().iter().enumerate();
            let named = joints.filter(|(_, joint)| joint.name.contains(word));
            let before = knees.len();
            for (index, joint) in named {
                let knee = Knee::new(joint, text).ok_or_else(|| {
                    let [lower, upper] = joint.range;
                    let expected =
                        format!("an angle of {} from {lower} to {upper} rad", joint.name);
                    parameters.value(word, expected, text)
                })?;
                knees.push((index, knee));
            }
            if knees.len() == before {
                return Err(parameters.unknown(word, "slope or a part of a goal joint's name"));
            }
        }
        Ok(Self {
            slope: slope.unwrap_or(0.6) as f32,
            knees,
        })
    }
}

impl Knee {
    fn new(joint: &Joint, text: &str) -> Option<Self> {
        let angle = text.parse::<f64>().ok()?;
        let is_in_range = (joint.range[0]..=joint.range[1]).contains(&angle);
        is_in_range.then_some(if angle < joint.default {
            Self::Below(angle as f32)
        } else {
            Self::Above(angle as f32)
        })
    }
}

impl Rule for SoftKnee {
    fn apply(&self, item: &mut FilterItem<'_>) {
        for (joint, knee) in &self.knees {
            let goal = &mut item.goal[*joint];
            match *knee {
                Knee::Above(knee) if *goal > knee => *goal = knee + self.slope * (*goal - knee),
                Knee::Below(knee) if *goal < knee => *goal = knee + self.slope * (*goal - knee),
                _ => {}
            }
        }
    }
}
