//! Where a goal has the hands.

use emp_robot::{FrameKinematics, Robot};
use serde::Serialize;

/// A hand reaches somewhere when it is this share of the arm's length away from its shoulder in that direction.
const FAR: f64 = 0.5;
/// Arms reach less far behind the back.
const FAR_BEHIND: f64 = 0.25;

/// Key nodes of shoulder, elbow and wrist (of [`emp_robot::KEY_NODE_NAMES`]) of the left and the right arm, and which way along
/// y is outward.
const ARMS: [([usize; 3], f64); 2] = [([2, 4, 6], 1.0), ([3, 5, 7], -1.0)];

/// Whether a hand, either one, is far from its shoulder in a direction of the pelvis frame. One pose can be several.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Reaches<T> {
    /// A hand is above its shoulder by half the arm's length.
    pub overhead: T,
    /// Both are.
    pub both_overhead: T,
    /// A hand is ahead of its shoulder by half the arm's length.
    pub forward: T,
    /// A hand is outward of its shoulder by half the arm's length.
    pub sideways: T,
    /// A hand is behind its shoulder by a quarter of the arm's length.
    pub behind: T,
    /// None of these.
    pub low: T,
}

/// Of one pose.
pub(super) type Reach = Reaches<bool>;

impl<T> Reaches<T> {
    /// Names, in the order of the fields.
    pub(super) const NAMES: [&'static str; 6] = [
        "a hand overhead",
        "both hands overhead",
        "a hand forward",
        "a hand sideways",
        "a hand behind",
        "none of these",
    ];

    /// The values in the order of the fields.
    pub(super) fn array(self) -> [T; 6] {
        [
            self.overhead,
            self.both_overhead,
            self.forward,
            self.sideways,
            self.behind,
            self.low,
        ]
    }
}

impl Reaches<f64> {
    /// Shares of poses; zeros of none.
    pub(super) fn shares(poses: impl Iterator<Item = Reach>) -> Self {
        let mut counts = [0_usize; 6];
        let mut total = 0_usize;
        for pose in poses {
            total += 1;
            for (count, is_so) in counts.iter_mut().zip(pose.array()) {
                *count += usize::from(is_so);
            }
        }
        let [overhead, both_overhead, forward, sideways, behind, low] =
            counts.map(|count| count as f64 / total.max(1) as f64);
        Self {
            overhead,
            both_overhead,
            forward,
            sideways,
            behind,
            low,
        }
    }
}

/// Judges goals.
pub(super) struct ReachMeter {
    kinematics: FrameKinematics,
}

impl ReachMeter {
    pub(super) fn new(robot: &Robot) -> Self {
        Self {
            kinematics: robot.kinematics().frame(),
        }
    }

    /// Where `goal` (rad) has the hands.
    pub(super) fn measure(&mut self, goal: &[f32]) -> Reach {
        let angles: Vec<f64> = goal.iter().map(|&angle| f64::from(angle)).collect();
        self.kinematics.update(&angles);
        let nodes = self.kinematics.positions();
        let hands = ARMS.map(|(arm, outward)| {
            let [shoulder, elbow, wrist] = arm.map(|node| nodes[node]);
            let length = (elbow - shoulder).norm() + (wrist - elbow).norm();
            let way = (wrist - shoulder) / length;
            [way.z, way.x, outward * way.y, -way.x]
        });
        let is_any = |direction: usize, far: f64| hands.iter().any(|hand| hand[direction] > far);
        let mut reach = Reach {
            overhead: is_any(0, FAR),
            both_overhead: hands.iter().all(|hand| hand[0] > FAR),
            forward: is_any(1, FAR),
            sideways: is_any(2, FAR),
            behind: is_any(3, FAR_BEHIND),
            low: false,
        };
        reach.low = !(reach.overhead || reach.forward || reach.sideways || reach.behind);
        reach
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    #[test]
    fn poses_are_where_they_look() {
        let robots = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots");
        let robot = Robot::load(&robots.join("emp27")).unwrap();
        let mut meter = ReachMeter::new(&robot);
        let mut reach = |angles: &[(&str, f32)]| {
            let goal: Vec<f32> = robot
                .goal_joints()
                .iter()
                .map(|joint| {
                    let named = angles.iter().find(|(name, _)| joint.name.ends_with(name));
                    named.map_or(0.0, |(_, angle)| *angle)
                })
                .collect();
            meter.measure(&goal)
        };
        assert!(reach(&[]).low);
        let up = reach(&[("shoulder_pitch", -3.0)]);
        assert!(up.overhead && up.both_overhead && !up.low, "{up:?}");
        let one = reach(&[("left_shoulder_pitch", -3.0)]);
        assert!(one.overhead && !one.both_overhead, "{one:?}");
        let forward = reach(&[("shoulder_pitch", -1.57)]);
        assert!(
            forward.forward && !forward.overhead && !forward.behind,
            "{forward:?}"
        );
        let side = reach(&[("left_shoulder_roll", 1.5), ("right_shoulder_roll", -1.5)]);
        assert!(side.sideways && !side.forward, "{side:?}");
        let behind = reach(&[("shoulder_pitch", 0.8)]);
        assert!(behind.behind && !behind.low, "{behind:?}");
        let shares = Reaches::shares([up, one, forward, side].into_iter());
        assert_eq!(
            (shares.overhead, shares.both_overhead, shares.low),
            (0.5, 0.25, 0.0)
        );
    }
}
