//! What a robot's files say, and what of it is hardly meant so.

use std::fmt;

use emp_robot::{KEY_NODE_NAMES, Robot};
use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector2, Vector3};

/// How long the default pose is held, seconds.
const HOLD: f64 = 2.0;
/// Largest angle between the base and upright after that, radians.
const UPRIGHT: f64 = 0.3;
/// Largest distance of a joint from its default then, radians.
const HELD: f64 = 0.2;
/// Least cosine between a hand's fingers and its forearm in the default pose.
const ALONG_FOREARM: f64 = 0.3;
/// Where nodes stand in [`KEY_NODE_NAMES`], left before right.
const WAIST: usize = 0;
const TORSO: usize = 1;
const SHOULDERS: usize = 2;
const ELBOWS: usize = 4;
const WRISTS: usize = 6;

/// What was found.
pub(crate) struct Report {
    lines: Vec<String>,
    pub(crate) warnings: Vec<String>,
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for line in &self.lines {
            writeln!(f, "{line}")?;
        }
        for warning in &self.warnings {
            writeln!(f, "warning: {warning}")?;
        }
        Ok(())
    }
}

/// Checks a robot that loads.
pub(crate) fn report(robot: &Robot) -> Report {
    let mut report = Report {
        lines: Vec::new(),
        warnings: Vec::new(),
    };
    report.robot(robot);
    report.joints(robot);
    report.key_nodes(robot);
    report.links(robot);
    report.mirror(robot);
    report.stance(robot);
    report.hold(robot);
    report
}

impl Report {
    fn line(&mut self, what: &str, text: impl fmt::Display) {
        self.lines.push(format!("{what:<16} {text}"));
    }

    fn warn(&mut self, text: impl Into<String>) {
        self.warnings.push(text.into());
    }

    fn robot(&mut self, robot: &Robot) {
        self.line("robot", robot.name());
        self.line("mass", format!("{:.1} kg", robot.mass()));
        self.line(
            "base",
            format!(
                "{:?}, {:.3} m above the floor",
                robot.base_body(),
                robot.standing_height()
            ),
        );
        self.line(
            "control",
            format!(
                "{} Hz, physics every {} s, {} steps between",
                robot.control_rate_hz(),
                robot.timestep(),
                robot.substeps()
            ),
        );
        let (goal, leg) = (robot.goal_joints().len(), robot.leg_joints().len());
        self.line("joints", format!("{goal} goal joints, {leg} leg joints"));
    }

    fn joints(&mut self, robot: &Robot) {
        self.lines.push(format!(
            "  {:<28} {:>16} {:>8} {:>7} {:>6} {:>7} {:>6}",
            "joint", "range (rad)", "default", "kp", "kd", "N·m", "rad/s"
        ));
        for joint in robot.joints() {
            let [lower, upper] = joint.range;
            self.lines.push(format!(
                "  {:<28} {:>16} {:>8.3} {:>7.1} {:>6.2} {:>7.1} {:>6.1}",
                joint.name,
                format!("{lower:.2} … {upper:.2}"),
                joint.default,
                joint.kp,
                joint.kd,
                joint.torque_limit,
                joint.velocity_limit
            ));
            let margin = 0.02 * (upper - lower);
            if joint.default - lower < margin || upper - joint.default < margin {
                self.warn(format!(
                    "joint {:?} stands at its limit in the default pose",
                    joint.name
                ));
            }
        }
    }

    fn key_nodes(&mut self, robot: &Robot) {
        let row = default_row(robot);
        let layout = robot.kinematics().layout();
        let at = |node: usize| {
            Vector3::from_row_slice(&row[layout.key_nodes.clone()][3 * node..3 * node + 3])
        };
        for (i, name) in KEY_NODE_NAMES.iter().enumerate() {
            let (p, body) = (at(i), &robot.key_nodes()[i].body);
            self.line(
                name,
                format!("[{:.3}, {:.3}, {:.3}] m on {body:?}", p.x, p.y, p.z),
            );
        }
        if at(TORSO).z <= at(WAIST).z {
            self.warn("the torso is not above the waist in the default pose");
        }
        for (side, name, sign) in [(0, "left", 1.0), (1, "right", -1.0)] {
            let [shoulder, elbow, wrist] = [SHOULDERS, ELBOWS, WRISTS].map(|node| at(node + side));
            let line = at(SHOULDERS).y - at(SHOULDERS + 1).y;
            if sign * (shoulder.y - at(TORSO).y) <= 0.0 || line <= 0.0 {
                self.warn(format!(
                    "the {name} shoulder is not on the {name} (y points to the left)"
                ));
            }
            for (what, bone) in [("upper arm", elbow - shoulder), ("forearm", wrist - elbow)] {
                if bone.norm() < 0.05 {
                    self.warn(format!("the {name} {what} is {:.3} m long", bone.norm()));
                }
            }
            let rotation = &row[layout.wrist_rotations.clone()][9 * side..9 * side + 9];
            let hand = Matrix3::from_row_slice(rotation);
            let along = hand.column(0).dot(&(wrist - elbow).normalize());
            self.line(
                &format!("{name}_hand"),
                format!(
                    "fingers [{:.2}, {:.2}, {:.2}], thumb [{:.2}, {:.2}, {:.2}]",
                    hand[(0, 0)],
                    hand[(1, 0)],
                    hand[(2, 0)],
                    hand[(0, 2)],
                    hand[(1, 2)],
                    hand[(2, 2)]
                ),
            );
            if along < ALONG_FOREARM {
                self.warn(format!("the {name} hand's fingers do not continue the forearm in the default pose (cosine {along:.2})"));
            }
        }
    }

    fn links(&mut self, robot: &Robot) {
        let row = default_row(robot);
        let centers = &row[robot.kinematics().layout().link_centers.clone()];
        let center = |i: usize| Vector3::from_row_slice(&centers[3 * i..3 * i + 3]);
        let spheres = robot.link_spheres();
        let gap = |[a, b]: [usize; 2]| {
            (center(a) - center(b)).norm() - spheres[a].radius - spheres[b].radius
        };
        let nearest = robot.link_pairs().iter().map(|pair| (gap(*pair), pair));
        let nearest = nearest.min_by(|a, b| a.0.total_cmp(&b.0));
        let text = nearest.map_or_else(
            || "no pairs".to_owned(),
            |(gap, [a, b])| {
                format!(
                    "{} pairs, nearest {:?} and {:?}, {gap:.3} m apart",
                    robot.link_pairs().len(),
                    spheres[*a].name,
                    spheres[*b].name
                )
            },
        );
        self.line("links", format!("{} spheres, {text}", spheres.len()));
        self.line(
            "contacts",
            format!(
                "{} pairs of geoms, {} + {} foot spheres",
                robot.contact_pairs().len(),
                robot.feet()[0].centers.len(),
                robot.feet()[1].centers.len()
            ),
        );
        if robot.contact_pairs().is_empty() {
            self.warn("no geoms may touch one another: self-collision is not simulated");
        }
    }

    fn mirror(&mut self, robot: &Robot) {
        match robot.mirror() {
            Ok(_) => self.line("mirror", "every joint has its image"),
            Err(error) => self.warn(format!(
                "no mirror image, which training can do without: {error}"
            )),
        }
    }

    fn stance(&mut self, robot: &Robot) {
        let row = default_row(robot);
        let layout = robot.kinematics().layout();
        let point = |start: usize| Vector2::new(row[start], row[start + 1]);
        let offset = point(layout.center_of_mass.start) - point(layout.foot_support.start);
        let margin = robot.support_polygon().margin(&offset);
        self.line(
            "stance",
            format!("center of mass {margin:.3} m inside the feet's support in the default pose"),
        );
        if margin < 0.0 {
            self.warn(
                "the centre of mass is outside of the feet in the default pose: the robot falls",
            );
        }
    }

    /// Lets the servos hold the default pose for a while.
    fn hold(&mut self, robot: &Robot) {
        let model = robot.model();
        let mut data = model.make_data();
        let qpos = data.qpos_mut();
        qpos.fill(0.0);
        qpos[2] = robot.standing_height();
        qpos[3] = 1.0;
        for joint in robot.joints() {
            qpos[joint.qpos_address] = joint.default;
        }
        for (control, joint) in data.ctrl_mut().iter_mut().zip(robot.joints()) {
            *control = joint.default;
        }
        for _ in 0..(HOLD / robot.timestep()) as usize {
            data.step();
        }
        let qpos = data.qpos();
        let quaternion =
            UnitQuaternion::from_quaternion(Quaternion::new(qpos[3], qpos[4], qpos[5], qpos[6]));
        let tilt = (quaternion * Vector3::z()).angle(&Vector3::z());
        let farthest = robot.joints().map(|joint| {
            (
                (qpos[joint.qpos_address] - joint.default).abs(),
                &joint.name,
            )
        });
        let farthest = farthest.max_by(|a, b| a.0.total_cmp(&b.0));
        let Some((distance, name)) = farthest else {
            return;
        };
        self.line("hold", format!("after {HOLD} s base tilted by {tilt:.3} rad, {name:?} {distance:.3} rad from its default"));
        if tilt.is_nan() || tilt >= UPRIGHT {
            self.warn(format!(
                "held at its default pose, the robot falls within {HOLD} s"
            ));
        } else if distance.is_nan() || distance >= HELD {
            self.warn(format!("held at its default pose, {name:?} gives way by {distance:.2} rad: kp or torque_limit is low"));
        }
    }
}

/// Kinematics of the default pose.
fn default_row(robot: &Robot) -> Vec<f64> {
    let q: Vec<f64> = robot.joints().map(|joint| joint.default).collect();
    let mut row = vec![0.0; robot.kinematics().output_width()];
    robot.kinematics().forward(&q, &mut row);
    row
}
