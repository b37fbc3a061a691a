//! A picture of a robot without a graphics card: a ray a pixel through MuJoCo's model, from two sides.

use std::path::Path;

use anyhow::Result;
use emp_robot::{KEY_NODE_NAMES, Robot};
use mujoco_rs::prelude::*;
use nalgebra::Vector3;

/// Pixels of one of the two views.
const WIDTH: usize = 450;
const HEIGHT: usize = 550;
/// Camera's distance from the robot, as a multiple of the robot's height, and half its angle of view.
const DISTANCE: f64 = 2.4;
const HALF_ANGLE: f64 = 0.26;
/// Turns of the camera about the robot, radians: from the left in front, and from straight ahead.
const VIEWS: [f64; 2] = [0.6, 0.0];
/// Where light comes from.
const LIGHT: [f64; 3] = [0.5, 0.4, 1.0];
/// Radius of a key node's mark, pixels.
const MARK: f64 = 5.0;
/// Left nodes, right nodes, and those in the middle.
const MARKS: [[u8; 3]; 3] = [[230, 120, 20], [20, 110, 230], [40, 170, 60]];

/// Pixels, row by row, three bytes each.
pub(crate) struct Image {
    width: usize,
    pixels: Vec<u8>,
}

impl Image {
    /// Writes a PNG under a temporary name and renames it.
    pub(crate) fn write(&self, path: &Path) -> Result<()> {
        let height = self.pixels.len() / (3 * self.width);
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(
            &mut bytes,
            u32::try_from(self.width)?,
            u32::try_from(height)?,
        );
        encoder.set_color(png::ColorType::Rgb);
        encoder.write_header()?.write_image_data(&self.pixels)?;
        let partial = path.with_extension("partial");
        std::fs::write(&partial, bytes)?;
        std::fs::rename(&partial, path)?;
        Ok(())
    }

    fn set(&mut self, x: usize, y: usize, color: [u8; 3]) {
        let at = 3 * (y * self.width + x);
        self.pixels[at..at + 3].copy_from_slice(&color);
    }
}

/// The robot in its default pose, with marks at its key nodes.
pub(crate) fn draw(robot: &Robot) -> Result<Image> {
    let model = robot.visual_model()?;
    let mut data = model.make_data();
    let qpos = data.qpos_mut();
    qpos.fill(0.0);
    qpos[2] = robot.standing_height();
    qpos[3] = 1.0;
    for joint in robot.joints() {
        qpos[joint.qpos_address] = joint.default;
    }
    data.forward();
    let mut image = Image {
        width: WIDTH * VIEWS.len(),
        pixels: vec![0; 3 * WIDTH * VIEWS.len() * HEIGHT],
    };
    let nodes = key_nodes(robot);
    let top = height(&data);
    for (index, turn) in VIEWS.into_iter().enumerate() {
        let camera = Camera::new(turn, top);
        for y in 0..HEIGHT {
            for x in 0..WIDTH {
                image.set(
                    index * WIDTH + x,
                    y,
                    shade(&model, &mut data, &camera, x, y),
                );
            }
        }
        for (node, color) in &nodes {
            for (x, y) in camera.disc(node) {
                image.set(index * WIDTH + x, y, *color);
            }
        }
    }
    Ok(image)
}

/// Where the key nodes are in the world, and their colours.
fn key_nodes(robot: &Robot) -> Vec<(Vector3<f64>, [u8; 3])> {
    let q: Vec<f64> = robot.joints().map(|joint| joint.default).collect();
    let mut row = vec![0.0; robot.kinematics().output_width()];
    robot.kinematics().forward(&q, &mut row);
    let positions = &row[robot.kinematics().layout().key_nodes.clone()];
    let base = Vector3::new(0.0, 0.0, robot.standing_height());
    let color = |name: &str| {
        let side = usize::from(name.starts_with("right")) + 2 * usize::from(!name.contains('_'));
        MARKS[side]
    };
    let nodes = positions.as_chunks::<3>().0.iter().zip(KEY_NODE_NAMES);
    nodes
        .map(|(p, name)| (Vector3::from(*p) + base, color(name)))
        .collect()
}

/// The highest middle of a geom: about the robot's height.
fn height(data: &MjData<&MjModel>) -> f64 {
    data.geom_xpos().iter().map(|p| p[2]).fold(0.3, f64::max)
}

/// A camera that looks at the robot's middle.
struct Camera {
    eye: Vector3<f64>,
    forward: Vector3<f64>,
    right: Vector3<f64>,
    up: Vector3<f64>,
}

impl Camera {
    fn new(turn: f64, height: f64) -> Self {
        let target = Vector3::new(0.0, 0.0, 0.52 * height);
        let eye = target + Vector3::new(turn.cos(), turn.sin(), 0.12) * (DISTANCE * height);
        let forward = (target - eye).normalize();
        let right = forward.cross(&Vector3::z()).normalize();
        Self {
            eye,
            forward,
            right,
            up: right.cross(&forward),
        }
    }

    /// Tangents of half the angle across a pixel's distance from the middle.
    fn scale() -> f64 {
        HALF_ANGLE.tan() / (HEIGHT as f64 / 2.0)
    }

    fn ray(&self, x: usize, y: usize) -> Vector3<f64> {
        let across = (x as f64 + 0.5 - WIDTH as f64 / 2.0) * Self::scale();
        let down = (y as f64 + 0.5 - HEIGHT as f64 / 2.0) * Self::scale();
        (self.forward + self.right * across - self.up * down).normalize()
    }

    /// Pixels within a mark's radius of a point.
    fn disc(&self, point: &Vector3<f64>) -> impl Iterator<Item = (usize, usize)> + use<> {
        let seen = point - self.eye;
        let depth = seen.dot(&self.forward);
        let x = seen.dot(&self.right) / depth / Self::scale() + WIDTH as f64 / 2.0;
        let y = HEIGHT as f64 / 2.0 - seen.dot(&self.up) / depth / Self::scale();
        let inside =
            move |px: usize, py: usize| (px as f64 + 0.5 - x).hypot(py as f64 + 0.5 - y) < MARK;
        (0..HEIGHT)
            .flat_map(move |py| (0..WIDTH).map(move |px| (px, py)))
            .filter(move |(px, py)| inside(*px, *py))
    }
}

/// The colour that a pixel's ray meets.
fn shade(
    model: &MjModel,
    data: &mut MjData<&MjModel>,
    camera: &Camera,
    x: usize,
    y: usize,
) -> [u8; 3] {
    let ray = camera.ray(x, y);
    let mut normal = [0.0; 3];
    // Groups above 2 hold collision shapes, the feet's contact spheres among them.
    let groups = [1, 1, 1, 0, 0, 0];
    let (geom, _) = data.ray(
        &camera.eye.into(),
        &ray.into(),
        Some(&groups),
        true,
        None,
        Some(&mut normal),
    );
    let Some(geom) = geom else {
        return [24, 26, 30];
    };
    let material = usize::try_from(model.geom_matid()[geom]).ok();
    let [r, g, b, _] = material.map_or(model.geom_rgba()[geom], |material| {
        model.mat_rgba()[material]
    });
    let light = Vector3::from(LIGHT).normalize();
    let normal = Vector3::from(normal);
    let facing = if normal.dot(&ray) > 0.0 {
        -normal
    } else {
        normal
    };
    let lit = 0.35 + 0.65 * facing.dot(&light).max(0.0);
    [r, g, b].map(|c| (f64::from(c) * lit * 255.0).clamp(0.0, 255.0) as u8)
}
