//! One thing at a time made smaller: what the policy falls of is what it no longer falls of without.

use std::sync::Arc;

use emp_models::{
    ModelError,
    filters::{FilterItem, GoalFilter},
};
use emp_robot::{Robot, RobotError};
use emp_sim::evaluation::{ExecutedFrame, Observer};

/// What is left of an angle's distance from the default pose.
const LEFT: f32 = 0.8;

/// One thing made smaller.
pub(super) struct Cut {
    /// What it is.
    pub(super) name: String,
    /// What the controller is given to execute.
    pub(super) filter: Option<Arc<dyn GoalFilter>>,
    /// What the arms are sent instead of that.
    pub(super) sender: Sender,
}

/// What the arms are sent, whatever the controller thinks.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Sender {
    /// What it answered.
    Answered,
    /// What was asked for.
    Asked,
    /// What was asked for, cut about the default pose.
    Cut(Vec<f32>),
}

impl Cut {
    /// Each goal joint, left and right together; all of them; only what the policy sees; only what the arms do.
    pub(super) fn all(robot: &Robot) -> Result<Vec<Self>, RobotError> {
        let joints = robot.goal_joints();
        let mut cuts = Vec::new();
        for (index, &partner) in robot.mirror()?.permutation()[..joints.len()]
            .iter()
            .enumerate()
        {
            if partner < index {
                continue;
            }
            let filter = JointCut::new(robot, |joint| joint == index || joint == partner);
            cuts.push(Self {
                name: common_name(&joints[index].name, &joints[partner].name).to_owned(),
                filter: Some(Arc::new(filter)),
                sender: Sender::Answered,
            });
        }
        let every =
            || -> Option<Arc<dyn GoalFilter>> { Some(Arc::new(JointCut::new(robot, |_| true))) };
        let default = robot.default_goal();
        cuts.extend([
            Self {
                name: "all goal joints".to_owned(),
                filter: every(),
                sender: Sender::Answered,
            },
            Self {
                name: "only what the policy sees".to_owned(),
                filter: every(),
                sender: Sender::Asked,
            },
            Self {
                name: "only what the arms do".to_owned(),
                filter: None,
                sender: Sender::Cut(default),
            },
        ]);
        Ok(cuts)
    }
}

impl Observer for Sender {
    fn send(&mut self, asked: &[f32], sent: &mut [f32]) {
        match self {
            Self::Answered => {}
            Self::Asked => sent.copy_from_slice(asked),
            Self::Cut(default) => {
                for ((sent, &asked), default) in sent.iter_mut().zip(asked).zip(default) {
                    *sent = *default + LEFT * (asked - *default);
                }
            }
        }
    }

    fn executed(&mut self, _: &ExecutedFrame<'_>) {}
}

/// What two names end with alike, from a word's start: a joint's name without its side.
fn common_name<'a>(left: &'a str, right: &str) -> &'a str {
    let mut words = left.match_indices('_').map(|(index, _)| &left[index + 1..]);
    if left == right {
        return left;
    }
    words.find(|words| right.ends_with(words)).unwrap_or(left)
}

/// Cuts some joints about the default pose.
struct JointCut {
    /// Indices of joints, and their default angles, rad.
    joints: Vec<(usize, f32)>,
}

impl JointCut {
    fn new(robot: &Robot, is_cut: impl Fn(usize) -> bool) -> Self {
        let joints = robot.goal_joints().iter().enumerate();
        let joints = joints.filter(|(index, _)| is_cut(*index));
        Self {
            joints: joints
                .map(|(index, joint)| (index, joint.default as f32))
                .collect(),
        }
    }
}

impl GoalFilter for JointCut {
    fn name(&self) -> &str {
        "joint-cut"
    }

    fn filter(&self, batch: &mut [FilterItem<'_>]) -> Result<(), ModelError> {
        for item in batch {
            for &(joint, default) in &self.joints {
                item.goal[joint] = default + LEFT * (item.goal[joint] - default);
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    fn robot() -> Robot {
        let robots = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots");
        Robot::load(&robots.join("emp27")).unwrap()
    }

    fn answer(cut: &mut Cut, asked: &[f32]) -> (Vec<f32>, Vec<f32>) {
        let (mut goal, mut memory, mut risk) = (asked.to_vec(), Vec::new(), None);
        if let Some(filter) = &cut.filter {
            let item = FilterItem {
                observation: &[],
                goal: &mut goal,
                memory: &mut memory,
                risk: &mut risk,
            };
            filter.filter(&mut [item]).unwrap();
        }
        let mut sent = goal.clone();
        cut.sender.send(asked, &mut sent);
        (goal, sent)
    }

    #[test]
    fn each_cut_leaves_the_rest_alone() {
        let robot = robot();
        let default: Vec<f32> = robot.default_goal();
        let asked: Vec<f32> = default.iter().map(|angle| angle + 0.5).collect();
        let small: Vec<f32> = default.iter().map(|angle| angle + 0.4).collect();
        let close = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6);
        let mut cuts = Cut::all(&robot).unwrap();
        let names: Vec<String> = cuts.iter().map(|cut| cut.name.clone()).collect();
        assert_eq!(
            names,
            [
                "waist_yaw",
                "shoulder_pitch",
                "shoulder_roll",
                "shoulder_yaw",
                "elbow",
                "wrist_yaw",
                "wrist_roll",
                "wrist_pitch",
                "all goal joints",
                "only what the policy sees",
                "only what the arms do"
            ]
        );
        for cut in &mut cuts[..8] {
            let (seen, sent) = answer(cut, &asked);
            assert_eq!(seen, sent);
            for (joint, angle) in robot.goal_joints().iter().zip(&seen) {
                let offset = if joint.name.ends_with(&cut.name) {
                    0.4
                } else {
                    0.5
                };
                assert!(
                    (angle - joint.default as f32 - offset).abs() < 1e-6,
                    "{}: {}",
                    cut.name,
                    joint.name
                );
            }
        }
        let (seen, sent) = answer(&mut cuts[8], &asked);
        assert!(close(&seen, &small) && close(&sent, &small));
        let (seen, sent) = answer(&mut cuts[9], &asked);
        assert!(close(&seen, &small) && close(&sent, &asked));
        let (seen, sent) = answer(&mut cuts[10], &asked);
        assert!(close(&seen, &asked) && close(&sent, &small));
    }
}
