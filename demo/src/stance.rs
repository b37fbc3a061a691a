//! How the robot stands: tilt, and its centre of mass against its feet.

use emp_sim::{Reading, SkeletonPose};
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector2, Vector3};

/// How the robot stands at one moment, in the frame of its feet: origin on the floor midway between them, x where they
/// point, y to their left, z up.
#[derive(Clone, Debug)]
pub(crate) struct Stance {
    /// From the frame of the base into that of the feet.
    pub(crate) base: Isometry3<f32>,
    /// Roll of the base, radians.
    pub(crate) roll: f64,
    /// Pitch of the base, radians, positive forward.
    pub(crate) pitch: f64,
    /// Centre of mass, metres.
    pub(crate) center_of_mass: Vector3<f64>,
    /// Where the left and the right foot touch the floor, or would.
    pub(crate) feet: [Footprint; 2],
}

/// What one foot spans, metres.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Footprint {
    /// Its rear end.
    pub(crate) heel: f64,
    /// Its front end.
    pub(crate) toe: f64,
    /// Its right edge.
    pub(crate) right: f64,
    /// Its left edge.
    pub(crate) left: f64,
}

impl Stance {
    /// Of what was measured, and where the limbs then are.
    pub(crate) fn new(reading: &Reading, pose: &SkeletonPose) -> Self {
        let base = Isometry3::from_parts(Translation3::from(reading.position), reading.orientation);
        let soles = pose.soles.clone().map(|points| {
            let world = points.iter().map(|point| base * Point3::from(*point));
            world.map(|point| point.coords).collect::<Vec<_>>()
        });
        let middle = (center(&soles[0]) + center(&soles[1])) / 2.0;
        let points = |leg: &Vec<Vector3<f64>>| match leg.as_slice() {
            [.., heel, toes] => (reading.orientation * (toes - heel)).xy(),
            _ => Vector2::zeros(),
        };
        let forward = (points(&pose.legs[0]) + points(&pose.legs[1]))
            .try_normalize(1e-6)
            .unwrap_or(Vector2::x());
        let heading =
            UnitQuaternion::from_axis_angle(&Vector3::z_axis(), forward.y.atan2(forward.x));
        let feet = Isometry3::from_parts(Translation3::new(middle.x, middle.y, 0.0), heading);
        let into = |point: &Vector3<f64>| (feet.inverse() * Point3::from(*point)).coords;
        let (roll, pitch, _) = reading.orientation.euler_angles();
        Self {
            base: (feet.inverse() * base).cast(),
            roll,
            pitch,
            center_of_mass: into(&reading.center_of_mass),
            feet: soles.map(|points| {
                let points: Vec<_> = points.iter().map(into).collect();
                Footprint::new(&points)
            }),
        }
    }

    /// Angle between the base's z axis and the vertical, radians.
    pub(crate) fn tilt(&self) -> f32 {
        (self.base.rotation * Vector3::z()).angle(&Vector3::z())
    }

    /// The rearmost and the foremost point of both feet, metres.
    pub(crate) fn heel_and_toe(&self) -> [f64; 2] {
        let [left, right] = &self.feet;
        [left.heel.min(right.heel), left.toe.max(right.toe)]
    }
}

impl Footprint {
    fn new(points: &[Vector3<f64>]) -> Self {
        let span = |axis: usize| {
            let values = points.iter().map(|point| point[axis]);
            values.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], value| {
                [low.min(value), high.max(value)]
            })
        };
        let [[heel, toe], [right, left]] = [span(0), span(1)];
        Self {
            heel,
            toe,
            right,
            left,
        }
    }
}

fn center(points: &[Vector3<f64>]) -> Vector3<f64> {
    points.iter().sum::<Vector3<f64>>() / points.len().max(1) as f64
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use emp_robot::Robot;
    use emp_sim::{BodyParameters, Skeleton, Stage, Start};

    use super::*;

    #[test]
    fn a_turned_and_tilted_robot_is_seen_from_its_feet() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/emp27");
        let robot = Robot::load(&folder).unwrap();
        let angles: Vec<f64> = robot.joints().map(|joint| joint.default).collect();
        let mut reading = Stage::new(&robot)
            .unwrap()
            .place(&Start {
                joint_positions: &angles,
                lift: 0.0,
                parameters: BodyParameters::default(),
            })
            .reading()
            .clone();
        let pose = Skeleton::new(&robot)
            .unwrap()
            .pose(&reading.joint_positions);
        let upright = Stance::new(&reading, &pose);
        assert!(upright.tilt() < 1e-3);
        let [heel, toe] = upright.heel_and_toe();
        // Foot spheres are 21 cm apart.
        assert!((toe - heel - 0.21).abs() < 1e-3 && (toe + heel).abs() < 1e-3);
        assert!((heel..toe).contains(&upright.center_of_mass.x));
        assert!(upright.feet[0].right > 0.0 && upright.feet[1].left < 0.0);

        // Turned and moved over the floor, nothing changes.
        let turn = UnitQuaternion::from_euler_angles(0.0, 0.0, 2.0);
        let shift = Vector3::new(3.0, -1.0, 0.0);
        reading.position = turn * reading.position + shift;
        reading.center_of_mass = turn * reading.center_of_mass + shift;
        reading.orientation = turn * reading.orientation;
        let turned = Stance::new(&reading, &pose);
        assert!((turned.center_of_mass - upright.center_of_mass).norm() < 1e-9);
        assert!((turned.feet[0].toe - upright.feet[0].toe).abs() < 1e-9);

        // Bent forward by a tenth of a radian about its own left.
        reading.orientation *= UnitQuaternion::from_euler_angles(0.0, 0.1, 0.0);
        let bent = Stance::new(&reading, &pose);
        assert!((bent.pitch - 0.1).abs() < 1e-6 && (bent.tilt() - 0.1).abs() < 1e-4);
    }
}
