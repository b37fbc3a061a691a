//! What became of a goal on its way to the robot, and how the robot stands with it: why the goal was changed, how far
//! the centre of mass is inside the feet's support, how near the robot's links are to each other.
//!
//! Statics of one moment, with the robot's own masses (what the hands carry is unknown) and links as spheres. Nothing here
//! changes a goal: the numbers are for people to read.

use emp_robot::{Robot, SupportPolygon};
use nalgebra::{UnitQuaternion, Vector3};

use crate::{ModelError, observation::RobotState};

/// A joint whose goal changed by no more than this counts as unchanged, rad.
pub const CHANGE: f32 = 0.01;

/// Links whose surfaces are nearer than this come too close, metres.
pub const CLEARANCE: f32 = 0.02;

/// A goal on its way to the robot: angles of the goal joints, rad.
#[derive(Clone, Copy, Debug)]
pub struct GoalPath<'a> {
    /// As it was asked for.
    pub asked: &'a [f32],
    /// As the goal filter left it.
    pub filtered: &'a [f32],
    /// As it is executed, after the velocity guard; `filtered` where there is no guard.
    pub executable: &'a [f32],
}

/// Why a goal was changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Reason {
    /// For balance: a filter's change that neither limits nor links explain.
    Balance,
    /// The goal that was asked for brought links together; what is executed keeps them farther apart.
    SelfCollision,
    /// The goal that was asked for was outside a joint's range.
    JointLimit,
    /// The velocity guard held a joint back.
    Speed,
}

/// The two links that are nearest to each other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NearestLinks {
    /// Indices into [`Robot::link_spheres`].
    pub links: [usize; 2],
    /// From surface to surface, metres; negative where they overlap.
    pub distance: f32,
}

/// What became of a goal, and how the robot stands with it.
#[derive(Clone, Debug, PartialEq)]
pub struct Assessment {
    /// The executable goal minus the one that was asked for, rad.
    pub change: Vec<f32>,
    /// How far the centre of mass, projected along gravity, is inside the convex hull of both feet's contact points, metres;
    /// negative outside.
    pub center_of_mass_margin: f32,
    /// Of the pairs that may touch and of which a goal joint moves at least one; none for a robot without such pairs.
    pub nearest_links: Option<NearestLinks>,
    /// Why the goal was changed, in order; empty where no joint changed by more than [`CHANGE`].
    pub reasons: Vec<Reason>,
}

/// Judges a goal of `robot` in a measured state: legs and orientation of the base as measured, the goal joints at the goal.
///
/// # Errors
/// [`ModelError::Frame`] if the state or a goal has another number of joints than the robot.
pub fn assess(
    robot: &Robot,
    state: &RobotState<'_>,
    goal: &GoalPath<'_>,
) -> Result<Assessment, ModelError> {
    check(robot, state, goal)?;
    let change = differences(goal.executable, goal.asked);
    let asked = Posture::new(robot, state, goal.asked);
    let executable = Posture::new(robot, state, goal.executable);
    let reasons = if change.iter().any(is_change) {
        reasons(robot, goal, asked.nearest_links, executable.nearest_links)
    } else {
        Vec::new()
    };
    Ok(Assessment {
        change,
        center_of_mass_margin: executable.center_of_mass_margin(robot, &state.orientation),
        nearest_links: executable.nearest_links,
        reasons,
    })
}

fn check(robot: &Robot, state: &RobotState<'_>, goal: &GoalPath<'_>) -> Result<(), ModelError> {
    let (joints, goals) = (robot.joints().count(), robot.goal_joints().len());
    let widths = [
        ("joint positions", state.joint_positions.len(), joints),
        ("asked goal angles", goal.asked.len(), goals),
        ("filtered goal angles", goal.filtered.len(), goals),
        ("executable goal angles", goal.executable.len(), goals),
    ];
    match widths
        .into_iter()
        .find(|(_, found, expected)| found != expected)
    {
        Some((what, found, expected)) => Err(ModelError::Frame {
            index: 0,
            reason: format!("{found} {what}, expected {expected}"),
        }),
        None => Ok(()),
    }
}

/// The robot with its goal joints at a goal.
struct Posture {
    /// Angles of all joints, rad.
    q: Vec<f64>,
    /// Outputs of the robot's kinematics, in the base's frame.
    row: Vec<f64>,
    nearest_links: Option<NearestLinks>,
}

impl Posture {
    fn new(robot: &Robot, state: &RobotState<'_>, goal: &[f32]) -> Self {
        let legs = &state.joint_positions[goal.len()..];
        let q: Vec<f64> = goal.iter().chain(legs).map(|&x| f64::from(x)).collect();
        let kinematics = robot.kinematics();
        let mut row = vec![0.0; kinematics.output_width()];
        kinematics.forward(&q, &mut row);
        let nearest_links = nearest_links(robot, &row[kinematics.layout().link_centers.clone()]);
        Self {
            q,
            row,
            nearest_links,
        }
    }

    fn center_of_mass_margin(&self, robot: &Robot, orientation: &UnitQuaternion<f64>) -> f32 {
        let kinematics = robot.kinematics();
        let contacts = kinematics.foot_contacts(&self.q);
        let on_floor = |point: Vector3<f64>| (orientation * point).xy();
        let polygon = SupportPolygon::hull(contacts.into_iter().map(on_floor).collect());
        let center = &self.row[kinematics.layout().center_of_mass.clone()];
        polygon.margin(&on_floor(Vector3::from_column_slice(center))) as f32
    }
}

fn nearest_links(robot: &Robot, centers: &[f64]) -> Option<NearestLinks> {
    let spheres = robot.link_spheres();
    let center = |link: usize| Vector3::from_column_slice(&centers[3 * link..3 * link + 3]);
    let moved = |&&[a, b]: &&[usize; 2]| {
        let kinematics = robot.kinematics();
        kinematics.goals_move(a) || kinematics.goals_move(b)
    };
    let pairs = robot.link_pairs().iter().filter(moved).map(|&[a, b]| {
        let radii = spheres[a].radius + spheres[b].radius;
        NearestLinks {
            links: [a, b],
            distance: ((center(a) - center(b)).norm() - radii) as f32,
        }
    });
    pairs.min_by(|a, b| a.distance.total_cmp(&b.distance))
}

fn reasons(
    robot: &Robot,
    goal: &GoalPath<'_>,
    asked: Option<NearestLinks>,
    executable: Option<NearestLinks>,
) -> Vec<Reason> {
    let mut inside = goal.asked.to_vec();
    robot.clamp_goal(&mut inside);
    let was_outside = |(asked, (inside, executable)): (&f32, (&f32, &f32))| {
        asked != inside && is_change(&(executable - asked))
    };
    let joint_limit = goal
        .asked
        .iter()
        .zip(inside.iter().zip(goal.executable))
        .any(was_outside);
    let self_collision = asked.zip(executable).is_some_and(|(asked, executable)| {
        asked.distance < CLEARANCE && executable.distance > asked.distance
    });
    let speed = goal.filtered != goal.executable;
    let by_filter = differences(goal.filtered, &inside).iter().any(is_change);
    let found = [
        (Reason::Balance, by_filter && !self_collision),
        (Reason::SelfCollision, self_collision),
        (Reason::JointLimit, joint_limit),
        (Reason::Speed, speed),
    ];
    found
        .into_iter()
        .filter_map(|(reason, is_so)| is_so.then_some(reason))
        .collect()
}

fn differences(a: &[f32], b: &[f32]) -> Vec<f32> {
    a.iter().zip(b).map(|(a, b)| a - b).collect()
}

fn is_change(difference: &f32) -> bool {
    difference.abs() > CHANGE
}

#[cfg(test)]
mod tests;
