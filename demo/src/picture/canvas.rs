//! A drawing surface: lines, areas and text, antialiased, with a font of its own.

use anyhow::{Context, Result};
use tiny_skia::{
    Color, FillRule, LineCap, LineJoin, Paint, Path, PathBuilder, Pixmap, Rect, Stroke, Transform,
};
use ttf_parser::{Face, GlyphId, OutlineBuilder};

/// A point on the canvas in pixels, x to the right, y down.
pub(super) type Point = (f32, f32);

/// A colour as red, green, blue, each 0..=255.
pub(super) type Rgb = [u8; 3];

/// Where a text stands relative to the point it is given.
#[derive(Clone, Copy)]
pub(super) enum Align {
    Left,
    Center,
    Right,
}

/// A picture that is being drawn.
pub(super) struct Canvas {
    pixels: Pixmap,
    font: Face<'static>,
}

impl Canvas {
    /// An empty picture of one colour; width and height in pixels.
    pub(super) fn new(width: u32, height: u32, background: Rgb) -> Result<Self> {
        let mut pixels = Pixmap::new(width, height).context("a picture of size zero")?;
        pixels.fill(color(background));
        let font = Face::parse(epaint_default_fonts::UBUNTU_LIGHT, 0)
            .context("the built-in font is unreadable")?;
        Ok(Self { pixels, font })
    }

    /// A line with round ends through all points.
    pub(super) fn line(&mut self, points: &[Point], width: f32, rgb: Rgb) {
        let Some(path) = polyline(points, false) else {
            return;
        };
        self.stroke(&path, width, rgb);
    }

    /// A straight line of dashes, `dash` pixels long and as far apart.
    pub(super) fn dashes(&mut self, [from, to]: [Point; 2], dash: f32, width: f32, rgb: Rgb) {
        let (x, y) = (to.0 - from.0, to.1 - from.1);
        let length = x.hypot(y).max(f32::MIN_POSITIVE);
        let at = |distance: f32| {
            let share = (distance / length).min(1.0);
            (from.0 + share * x, from.1 + share * y)
        };
        for start in (0..).map(|number| 2.0 * dash * number as f32) {
            if start >= length {
                break;
            }
            self.line(&[at(start), at(start + dash)], width, rgb);
        }
    }

    /// A filled area with round corners: `rounding` is what it grows by to every side.
    pub(super) fn area(&mut self, corners: &[Point], rounding: f32, rgb: Rgb) {
        let Some(path) = polyline(corners, true) else {
            return;
        };
        self.fill(&path, rgb);
        self.stroke(&path, 2.0 * rounding, rgb);
    }

    /// A filled ellipse with its axes along the canvas.
    pub(super) fn ellipse(&mut self, center: Point, half: Point, rgb: Rgb) {
        let rect = Rect::from_xywh(
            center.0 - half.0,
            center.1 - half.1,
            2.0 * half.0,
            2.0 * half.1,
        );
        if let Some(path) = rect.and_then(PathBuilder::from_oval) {
            self.fill(&path, rgb);
        }
    }

    /// A filled circle.
    pub(super) fn disc(&mut self, center: Point, radius: f32, rgb: Rgb) {
        self.ellipse(center, (radius, radius), rgb);
    }

    /// One line of text; `at` is on its base line, `size` the font's height in pixels.
    pub(super) fn text(&mut self, at: Point, size: f32, align: Align, rgb: Rgb, text: &str) {
        let scale = self.font_scale(size);
        let glyphs: Vec<(GlyphId, f32)> = text.chars().map(|letter| self.glyph(letter)).collect();
        let mut x = match align {
            Align::Left => at.0,
            Align::Center => at.0 - self.text_width(size, text) / 2.0,
            Align::Right => at.0 - self.text_width(size, text),
        };
        for (glyph, advance) in glyphs {
            let mut outline = Outline {
                path: PathBuilder::new(),
                origin: (x, at.1),
                scale,
            };
            if self.font.outline_glyph(glyph, &mut outline).is_some()
                && let Some(path) = outline.path.finish()
            {
                self.fill(&path, rgb);
            }
            x += advance * scale;
        }
    }

    /// Width in pixels of a text of this size.
    pub(super) fn text_width(&self, size: f32, text: &str) -> f32 {
        let advances = text.chars().map(|letter| self.glyph(letter).1);
        advances.sum::<f32>() * self.font_scale(size)
    }

    fn font_scale(&self, size: f32) -> f32 {
        size / f32::from(self.font.units_per_em())
    }

    /// The picture as a PNG file.
    pub(super) fn png(&self) -> Result<Vec<u8>> {
        self.pixels
            .encode_png()
            .context("the picture cannot be encoded as PNG")
    }

    /// A letter's glyph and its advance in font units; a letter that the font lacks takes its place in space.
    fn glyph(&self, letter: char) -> (GlyphId, f32) {
        let glyph = self.font.glyph_index(letter).unwrap_or(GlyphId(0));
        (
            glyph,
            f32::from(self.font.glyph_hor_advance(glyph).unwrap_or(0)),
        )
    }

    fn fill(&mut self, path: &Path, rgb: Rgb) {
        self.pixels.fill_path(
            path,
            &paint(rgb),
            FillRule::Winding,
            Transform::identity(),
            None,
        );
    }

    fn stroke(&mut self, path: &Path, width: f32, rgb: Rgb) {
        let stroke = Stroke {
            width,
            line_cap: LineCap::Round,
            line_join: LineJoin::Round,
            ..Stroke::default()
        };
        self.pixels
            .stroke_path(path, &paint(rgb), &stroke, Transform::identity(), None);
    }
}

fn polyline(points: &[Point], closed: bool) -> Option<Path> {
    let (first, rest) = points.split_first()?;
    let mut path = PathBuilder::new();
    path.move_to(first.0, first.1);
    for point in rest {
        path.line_to(point.0, point.1);
    }
    if closed {
        path.close();
    }
    path.finish()
}

fn color([red, green, blue]: Rgb) -> Color {
    Color::from_rgba8(red, green, blue, 255)
}

fn paint(rgb: Rgb) -> Paint<'static> {
    let mut paint = Paint {
        anti_alias: true,
        ..Paint::default()
    };
    paint.set_color(color(rgb));
    paint
}

/// Turns a glyph's outline (font units, y up) into a path on the canvas.
struct Outline {
    path: PathBuilder,
    origin: Point,
    scale: f32,
}

impl Outline {
    fn at(&self, x: f32, y: f32) -> Point {
        (
            self.origin.0 + x * self.scale,
            self.origin.1 - y * self.scale,
        )
    }
}

impl OutlineBuilder for Outline {
    fn move_to(&mut self, x: f32, y: f32) {
        let (x, y) = self.at(x, y);
        self.path.move_to(x, y);
    }

    fn line_to(&mut self, x: f32, y: f32) {
        let (x, y) = self.at(x, y);
        self.path.line_to(x, y);
    }

    fn quad_to(&mut self, x1: f32, y1: f32, x: f32, y: f32) {
        let ((x1, y1), (x, y)) = (self.at(x1, y1), self.at(x, y));
        self.path.quad_to(x1, y1, x, y);
    }

    fn curve_to(&mut self, x1: f32, y1: f32, x2: f32, y2: f32, x: f32, y: f32) {
        let ((x1, y1), (x2, y2), (x, y)) = (self.at(x1, y1), self.at(x2, y2), self.at(x, y));
        self.path.cubic_to(x1, y1, x2, y2, x, y);
    }

    fn close(&mut self) {
        self.path.close();
    }
}
