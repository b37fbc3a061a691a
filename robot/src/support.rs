//! The area on which a robot stands.

use nalgebra::Vector2;

use crate::Robot;

/// A convex polygon on the floor.
#[derive(Clone, Debug, PartialEq)]
pub struct SupportPolygon {
    /// Counter-clockwise, metres.
    vertices: Vec<Vector2<f64>>,
}

impl SupportPolygon {
    /// The convex hull of points, metres.
    pub fn hull(mut points: Vec<Vector2<f64>>) -> Self {
        points.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
        let mut vertices = half_hull(points.iter());
        vertices.extend(half_hull(points.iter().rev()));
        Self { vertices }
    }

    /// Its corners, counter-clockwise, in the frame of the points that it is the hull of, metres.
    pub fn vertices(&self) -> &[Vector2<f64>] {
        &self.vertices
    }

    /// Distance of a point (in the frame of [`vertices`](Self::vertices)) from the nearest edge's line, metres: above 0
    /// inside, below 0 outside.
    pub fn margin(&self, point: &Vector2<f64>) -> f64 {
        let next = self.vertices.iter().cycle().skip(1);
        let edges = self.vertices.iter().zip(next);
        let distance = |(from, to): (&Vector2<f64>, &Vector2<f64>)| {
            let edge = to - from;
            edge.perp(&(point - from)) / edge.norm()
        };
        edges.map(distance).fold(f64::INFINITY, f64::min)
    }
}

impl Robot {
    /// The convex hull of the points where both feet touch the floor in the default pose; x forward, y left, origin midway
    /// between the centres of the two soles (where [`OutputLayout::foot_support`](crate::OutputLayout::foot_support) is).
    pub fn support_polygon(&self) -> SupportPolygon {
        let q: Vec<f64> = self.joints().map(|joint| joint.default).collect();
        let center = self.default_support();
        let contacts = self.kinematics().foot_contacts(&q);
        SupportPolygon::hull(contacts.iter().map(|point| point.xy() - center).collect())
    }

    /// Midway between the centres of the soles in the default pose, in the base's frame.
    fn default_support(&self) -> Vector2<f64> {
        let kinematics = self.kinematics();
        let q: Vec<f64> = self.joints().map(|joint| joint.default).collect();
        let mut row = vec![0.0; kinematics.output_width()];
        kinematics.forward(&q, &mut row);
        let start = kinematics.layout().foot_support.start;
        Vector2::new(row[start], row[start + 1])
    }
}

/// One half of the hull of sorted points, without its last vertex: every turn is to the left.
fn half_hull<'a>(points: impl Iterator<Item = &'a Vector2<f64>>) -> Vec<Vector2<f64>> {
    let mut hull: Vec<Vector2<f64>> = Vec::new();
    for point in points {
        while let [.., before, last] = hull.as_slice()
            && (last - before).perp(&(point - last)) <= 0.0
        {
            hull.pop();
        }
        hull.push(*point);
    }
    hull.pop();
    hull
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_margin_of_a_square_is_the_distance_to_its_nearest_side() {
        let corners = [
            (1.0, 1.0),
            (-1.0, -1.0),
            (1.0, -1.0),
            (0.2, 0.3),
            (-1.0, 1.0),
            (0.0, 1.0),
        ];
        let square =
            SupportPolygon::hull(corners.iter().map(|&(x, y)| Vector2::new(x, y)).collect());
        assert_eq!(square.vertices().len(), 4);
        for ((x, y), margin) in [
            ((0.0, 0.0), 1.0),
            ((0.7, 0.1), 0.3),
            ((0.0, -0.9), 0.1),
            ((1.5, 0.0), -0.5),
        ] {
            assert!((square.margin(&Vector2::new(x, y)) - margin).abs() < 1e-12);
        }
    }

    #[test]
    fn our_robot_stands_on_both_feet() {
        let robot = Robot::load("../robots/emp27".as_ref()).unwrap();
        let polygon = robot.support_polygon();
        // Foot spheres from 7.5 cm behind the ankle to 13.5 cm before it, soles' middle between them.
        let reach = |axis: usize| {
            let values = polygon.vertices().iter().map(|vertex| vertex[axis]);
            values.fold(0.0_f64, |far, value| far.max(value.abs()))
        };
        assert!((reach(0) - 0.105).abs() < 1e-3, "{polygon:?}");
        assert!(reach(1) > 0.1 && polygon.margin(&Vector2::zeros()) > 0.09);
    }
}
