//! emp27 with every joint at zero: arms and legs straight down. Its feet's spheres reach from 7.5 cm behind the ankles to
//! 13.5 cm before them and to 4.5 cm beside them; the ankles are 9 cm beside the middle, the spheres 88.5 cm below the base.

use super::*;

const BACK: f64 = -0.075;
const FRONT: f64 = 0.135;
const HIP: f64 = -0.06;
const SOLE: f64 = -0.885;

struct Straight {
    robot: Robot,
    joint_positions: Vec<f32>,
    orientation: UnitQuaternion<f64>,
}

impl Straight {
    fn new() -> Self {
        Self {
            robot: Robot::load("../robots/emp27".as_ref()).unwrap(),
            joint_positions: vec![0.0; 27],
            orientation: UnitQuaternion::identity(),
        }
    }

    fn goal(&self, joints: &[(&str, f32)]) -> Vec<f32> {
        let angle = |name: &str| joints.iter().find(|(joint, _)| *joint == name);
        let goals = self.robot.goal_joints().iter();
        goals
            .map(|joint| angle(&joint.name).map_or(0.0, |(_, angle)| *angle))
            .collect()
    }

    fn assess(&self, asked: &[f32], filtered: &[f32], executable: &[f32]) -> Assessment {
        let state = RobotState {
            joint_positions: &self.joint_positions,
            orientation: self.orientation,
        };
        let goal = GoalPath {
            asked,
            filtered,
            executable,
        };
        assess(&self.robot, &state, &goal).unwrap()
    }

    fn margin(&self) -> f64 {
        let goal = self.goal(&[]);
        f64::from(self.assess(&goal, &goal, &goal).center_of_mass_margin)
    }

    fn center_of_mass(&self) -> Vector3<f64> {
        let q: Vec<f64> = self.joint_positions.iter().map(|&x| f64::from(x)).collect();
        let kinematics = self.robot.kinematics();
        let mut row = vec![0.0; kinematics.output_width()];
        kinematics.forward(&q, &mut row);
        Vector3::from_column_slice(&row[kinematics.layout().center_of_mass.clone()])
    }

    fn nearest(&self, goal: &[f32]) -> ([&str; 2], f32) {
        let nearest = self.assess(goal, goal, goal).nearest_links.unwrap();
        let name = |link: usize| self.robot.link_spheres()[link].name.as_str();
        (nearest.links.map(name), nearest.distance)
    }
}

fn assert_near(found: f64, expected: f64) {
    assert!((found - expected).abs() < 1e-6, "{found} {expected}");
}

#[test]
fn the_margin_is_the_way_to_the_nearest_side_of_the_feet() {
    let mut straight = Straight::new();
    let center = straight.center_of_mass();
    let upright = (FRONT - center.x).min(center.x - BACK);
    assert_near(straight.margin(), upright);
    straight.orientation = UnitQuaternion::from_euler_angles(0.0, 0.0, 1.3);
    assert_near(straight.margin(), upright);
}

#[test]
fn a_base_that_leans_takes_the_centre_of_mass_over_the_toes() {
    let mut straight = Straight::new();
    let pitch = 0.2_f64;
    straight.orientation = UnitQuaternion::from_euler_angles(0.0, pitch, 0.0);
    let center = straight.center_of_mass();
    let projected = |x: f64, z: f64| x * pitch.cos() + z * pitch.sin();
    let margin = projected(FRONT, SOLE) - projected(center.x, center.z);
    assert!(margin < 0.0);
    assert_near(straight.margin(), margin);
}

#[test]
fn the_feet_are_where_the_measured_legs_have_them() {
    let mut straight = Straight::new();
    let hip_angle = 0.5_f64;
    let mut joints = straight.robot.joints();
    let hip = joints.position(|joint| joint.name == "left_hip_pitch");
    drop(joints);
    straight.joint_positions[hip.unwrap()] = hip_angle as f32;
    let center = straight.center_of_mass();
    // The left foot swings back; the front side runs from the right foot's inner corner to the left foot's outer one.
    let right = [FRONT, -0.045];
    let left = [
        FRONT * hip_angle.cos() + (SOLE - HIP) * hip_angle.sin(),
        0.135,
    ];
    let side = [left[0] - right[0], left[1] - right[1]];
    let way = [center.x - right[0], center.y - right[1]];
    let margin = (side[0] * way[1] - side[1] * way[0]) / side[0].hypot(side[1]);
    assert_near(straight.margin(), margin);
}

#[test]
fn the_hands_hang_beside_the_pelvis() {
    let straight = Straight::new();
    let (links, distance) = straight.nearest(&straight.goal(&[]));
    assert_eq!(links, ["left_hand", "pelvis"]);
    // 20 cm beside it and 9.5 cm below it; the radii are 6 and 12 cm. The thighs are nearer to each other, but no goal moves them.
    assert_near(f64::from(distance), 0.2_f64.hypot(0.095) - 0.18);
}

#[test]
fn an_arm_inside_the_pelvis_overlaps_with_it() {
    let straight = Straight::new();
    let roll = -0.2_f64;
    let goal = straight.goal(&[("left_shoulder_roll", roll as f32)]);
    let (links, distance) = straight.nearest(&goal);
    assert_eq!(links, ["left_hand", "pelvis"]);
    // The shoulder is 20 cm beside the base's middle and 48 cm above it, the arm 57.5 cm long.
    let [y, z] = [0.2 + 0.575 * roll.sin(), 0.48 - 0.575 * roll.cos()];
    assert!(distance < 0.0);
    assert_near(f64::from(distance), y.hypot(z) - 0.18);
}

#[test]
fn an_unchanged_goal_has_no_reasons() {
    let straight = Straight::new();
    let asked = straight.goal(&[("left_elbow", 0.005)]);
    let executable = straight.goal(&[("left_shoulder_yaw", 0.009)]);
    let assessment = straight.assess(&asked, &executable, &executable);
    assert!(assessment.reasons.is_empty());
    let expected = executable.iter().zip(&asked).map(|(a, b)| a - b);
    assert_eq!(assessment.change, expected.collect::<Vec<f32>>());
}

#[test]
fn every_change_has_its_reason() {
    let straight = Straight::new();
    let goal = |joints: &[(&str, f32)]| straight.goal(joints);
    let overhead = goal(&[("left_shoulder_pitch", -1.5)]);
    let lower = goal(&[("left_shoulder_pitch", -1.2)]);
    let inside_the_pelvis = goal(&[("left_shoulder_roll", -0.2)]);
    let beside_it = goal(&[("left_shoulder_roll", 0.1)]);
    let overstretched = goal(&[("left_elbow", 0.2)]);
    let stretched = goal(&[("left_elbow", 0.0)]);
    let overstretched_overhead = goal(&[("left_elbow", 0.2), ("left_shoulder_pitch", -1.5)]);
    for (asked, filtered, executable, expected) in [
        (&overhead, &lower, &lower, vec![Reason::Balance]),
        (
            &inside_the_pelvis,
            &beside_it,
            &beside_it,
            vec![Reason::SelfCollision],
        ),
        // Farther in than out: the links are no reason.
        (
            &beside_it,
            &inside_the_pelvis,
            &inside_the_pelvis,
            vec![Reason::Balance],
        ),
        (
            &overstretched,
            &stretched,
            &stretched,
            vec![Reason::JointLimit],
        ),
        (&overhead, &overhead, &lower, vec![Reason::Speed]),
        (
            &overstretched_overhead,
            &lower,
            &stretched,
            vec![Reason::Balance, Reason::JointLimit, Reason::Speed],
        ),
    ] {
        let assessment = straight.assess(asked, filtered, executable);
        assert_eq!(assessment.reasons, expected, "{asked:?} {executable:?}");
    }
}

#[test]
fn another_number_of_joints_is_refused_by_name() {
    let straight = Straight::new();
    let state = RobotState {
        joint_positions: &straight.joint_positions,
        orientation: straight.orientation,
    };
    let goal = straight.goal(&[]);
    let path = GoalPath {
        asked: &goal,
        filtered: &goal[1..],
        executable: &goal,
    };
    let error = assess(&straight.robot, &state, &path).unwrap_err();
    assert!(
        error.to_string().contains("14 filtered goal angles"),
        "{error}"
    );
}
