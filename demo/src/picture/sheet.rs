//! The contact sheet: the person above the robot at stills that differ.

use anyhow::{Result, ensure};
use nalgebra::{Isometry3, Translation3};

use super::Still;
use super::canvas::{Align, Canvas, Point};
use super::figure::Figure;
use super::view::{BACKGROUND, Bounds, Camera, FAINT, GROUND, INK, LEFT, PANEL, RIGHT, View};

const COLUMNS: usize = 4;
const CELL_WIDTH: f32 = 400.0;
const MARGIN: f32 = 28.0;
const HEADER: f32 = 110.0;
const CAPTION: f32 = 70.0;
const GAP: f32 = 20.0;
/// Between a cell's border and its text, pixels.
const INSET: f32 = 16.0;
/// Free space around the figures of a cell, pixels.
const PADDING: f32 = 24.0;

/// A contact sheet.
pub(crate) struct Sheet<'a> {
    /// First line of the head.
    pub(crate) title: &'a str,
    /// Second line of the head.
    pub(crate) subtitle: &'a str,
    /// What is shown, in order.
    pub(crate) stills: &'a [Still],
}

impl Sheet<'_> {
    /// Draws the sheet; the answer is a PNG file.
    pub(crate) fn png(&self) -> Result<Vec<u8>> {
        ensure!(!self.stills.is_empty(), "there is no still to draw");
        let camera = Camera::front_left();
        let pairs: Vec<[View; 2]> = self
            .stills
            .iter()
            .map(|still| still.views(&camera))
            .collect();
        let layout = Layout::new(&pairs);
        let mut canvas = Canvas::new(layout.width as u32, layout.height as u32, BACKGROUND)?;
        self.header(&mut canvas, layout.width);
        for (index, (still, views)) in self.stills.iter().zip(&pairs).enumerate() {
            layout.draw(&mut canvas, index, still, views);
        }
        canvas.png()
    }

    fn header(&self, canvas: &mut Canvas, width: f32) {
        canvas.text((MARGIN, 50.0), 38.0, Align::Left, INK, self.title);
        canvas.text((MARGIN, 88.0), 24.0, Align::Left, FAINT, self.subtitle);
        let right = width - MARGIN;
        canvas.text((right, 46.0), 24.0, Align::Right, LEFT, "left arm and leg");
        canvas.text(
            (right, 80.0),
            24.0,
            Align::Right,
            RIGHT,
            "right arm and leg",
        );
    }
}

impl Still {
    fn views(&self, camera: &Camera) -> [View; 2] {
        let human = Figure::person(&self.human);
        let tilt = Isometry3::from_parts(Translation3::identity(), self.stance.base.rotation);
        let robot = self.robot_figure().placed(&tilt);
        [human, robot].map(|figure| View::new(&figure, camera))
    }
}

/// Where the bands are, and how large a metre is: the same for all figures.
struct Layout {
    width: f32,
    height: f32,
    scale: f32,
    bands: Vec<Band>,
}

/// A row of cells, and what its figures span.
struct Band {
    top: f32,
    height: f32,
    human: Bounds,
    robot: Bounds,
}

impl Layout {
    fn new(pairs: &[[View; 2]]) -> Self {
        let half_width = pairs
            .iter()
            .flatten()
            .map(|view| view.bounds.half_width())
            .fold(0.0, f32::max);
        let scale = (CELL_WIDTH / 2.0 - PADDING) / half_width;
        let mut top = HEADER;
        let mut bands = Vec::new();
        for row in pairs.chunks(COLUMNS) {
            let band = Band::new(row, top, scale);
            top += band.height + GAP;
            bands.push(band);
        }
        let columns = pairs.len().min(COLUMNS) as f32;
        let width = 2.0 * MARGIN + columns * CELL_WIDTH + (columns - 1.0) * GAP;
        Self {
            width,
            height: top - GAP + MARGIN,
            scale,
            bands,
        }
    }

    fn draw(&self, canvas: &mut Canvas, index: usize, still: &Still, [human, robot]: &[View; 2]) {
        let Band {
            top,
            height,
            human: human_bounds,
            robot: robot_bounds,
        } = &self.bands[index / COLUMNS];
        let column = index % COLUMNS;
        let left = MARGIN + column as f32 * (CELL_WIDTH + GAP);
        let right = left + CELL_WIDTH;
        canvas.area(
            &[
                (left, *top),
                (right, *top),
                (right, top + height),
                (left, top + height),
            ],
            0.0,
            PANEL,
        );
        caption(canvas, (left, *top), still);

        let middle = left + CELL_WIDTH / 2.0;
        let human_top = top + CAPTION + PADDING;
        let human_bottom = human_top + human_bounds.height() * self.scale;
        let robot_top = human_bottom + 1.5 * PADDING;
        let robot_bottom = robot_top + robot_bounds.height() * self.scale;
        if column == 0 {
            canvas.text(
                (left + INSET, human_bottom),
                22.0,
                Align::Left,
                FAINT,
                "person",
            );
            canvas.text(
                (left + INSET, robot_bottom),
                22.0,
                Align::Left,
                FAINT,
                "robot",
            );
        }
        canvas.ellipse(
            (middle, robot_bottom - 6.0),
            (CELL_WIDTH * 0.24, 12.0),
            GROUND,
        );
        human.draw(
            canvas,
            (middle, human_top + human_bounds.top * self.scale),
            self.scale,
        );
        robot.draw(
            canvas,
            (middle, robot_top + robot_bounds.top * self.scale),
            self.scale,
        );
    }
}

impl Band {
    fn new(pairs: &[[View; 2]], top: f32, scale: f32) -> Self {
        let [human, robot] = [0, 1].map(|row| {
            pairs
                .iter()
                .fold(Bounds::NONE, |bounds, pair| bounds.union(pair[row].bounds))
        });
        let height = CAPTION + (human.height() + robot.height()) * scale + 3.5 * PADDING;
        Self {
            top,
            height,
            human,
            robot,
        }
    }
}

fn caption(canvas: &mut Canvas, (left, top): Point, still: &Still) {
    let right = left + CELL_WIDTH - INSET;
    let line = top + 36.0;
    canvas.text(
        (left + INSET, line),
        27.0,
        Align::Left,
        INK,
        &format!("{:.1} s", still.time),
    );
    canvas.text((right, line), 27.0, Align::Right, INK, &still.name);
    let error = format!("arm directions {:.1}° apart", still.direction_error_deg);
    canvas.text(
        (left + INSET, line + 28.0),
        21.0,
        Align::Left,
        FAINT,
        &error,
    );
}

#[cfg(test)]
mod tests {
    use tiny_skia::Pixmap;

    use super::super::canvas::Rgb;
    use super::super::testing::still;
    use super::*;

    fn draw(stills: &[Still]) -> Pixmap {
        let png = Sheet {
            title: "title",
            subtitle: "subtitle",
            stills,
        }
        .png()
        .unwrap();
        Pixmap::decode_png(&png).unwrap()
    }

    #[test]
    fn left_is_drawn_on_the_right_of_a_figure_that_faces_us() {
        let pixels = draw(&[still(0.0)]);
        let center = |rgb: Rgb| {
            let columns =
                (0..pixels.height()).flat_map(|y| (0..pixels.width()).map(move |x| (x, y)));
            let [red, green, blue] = rgb;
            let found: Vec<u32> = columns
                .filter(|&(_, y)| y > HEADER as u32)
                .filter(|&(x, y)| {
                    let pixel = pixels.pixel(x, y).unwrap();
                    [pixel.red(), pixel.green(), pixel.blue()] == [red, green, blue]
                })
                .map(|(x, _)| x)
                .collect();
            assert!(found.len() > 1000, "{rgb:?}: {} pixels", found.len());
            found.iter().sum::<u32>() / found.len() as u32
        };
        assert!(center(LEFT) > center(RIGHT) + 20);
    }

    #[test]
    fn the_sheet_grows_with_its_stills() {
        let stills: Vec<Still> = (0..5).map(|index| still(f64::from(index))).collect();
        let [one, four, five] = [1, 4, 5].map(|count| draw(&stills[..count]));
        assert!(one.width() < four.width() && four.width() == five.width());
        assert!(five.height() > four.height() + 400);
    }

    #[test]
    fn nothing_to_draw_is_an_error() {
        assert!(
            Sheet {
                title: "",
                subtitle: "",
                stills: &[]
            }
            .png()
            .is_err()
        );
    }
}
