//! Anti-aliased lines, discs and text on an RGB picture, by OpenCV; the skeleton as a drawing.

use image::{Rgb, RgbImage};
use opencv::boxed_ref::BoxedRefMut;
use opencv::core::{Mat, Point, Scalar, Vec3b, Vector};
use opencv::imgproc::{self, FONT_HERSHEY_SIMPLEX, LINE_AA};

use super::ReportError;
use super::marks::Mark;
use crate::body::{Joint, NODES};

pub type Colour = [u8; 3];

pub const WHITE: Colour = [255, 255, 255];
pub const INK: Colour = [40, 40, 40];
pub const GRID: Colour = [222, 222, 222];
pub const LEFT: Colour = [0, 114, 178];
pub const RIGHT: Colour = [213, 94, 0];
/// Of curves, in order: Okabe and Ito's colours that stand out on white.
pub const PALETTE: [Colour; 7] = [LEFT, RIGHT, [0, 158, 115], [204, 121, 167], [86, 180, 233], [230, 159, 0], [90, 90, 90]];

/// Coordinates are given to OpenCV in sixteenths of a pixel.
const SHIFT: i32 = 4;
/// Height of a capital letter of OpenCV's font at scale 1, pixels.
const CAPITAL_PX: f64 = 21.0;

#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Align {
    Left,
    Centre,
    Right,
}

/// A picture to draw on; pixel centres at integers, colours as RGB.
pub struct Canvas {
    pub picture: RgbImage,
}

impl Canvas {
    pub fn new(width: u32, height: u32, background: Colour) -> Canvas {
        Canvas { picture: RgbImage::from_pixel(width, height, Rgb(background)) }
    }

    fn mat(&mut self) -> opencv::Result<BoxedRefMut<'_, Mat>> {
        let (rows, columns) = (self.picture.height() as i32, self.picture.width() as i32);
        Mat::new_rows_cols_with_bytes_mut::<Vec3b>(rows, columns, &mut self.picture)
    }

    pub fn line(&mut self, from: [f64; 2], to: [f64; 2], colour: Colour, width_px: i32) -> Result<(), ReportError> {
        if on_paper(from) && on_paper(to) {
            imgproc::line(&mut self.mat()?, fixed(from), fixed(to), scalar(colour), width_px, LINE_AA, SHIFT)?;
        }
        Ok(())
    }

    /// Joined lines; points that are not finite break them.
    pub fn polyline(&mut self, points: &[[f64; 2]], colour: Colour, width_px: i32, dashed: bool) -> Result<(), ReportError> {
        let mut run = 0.0;
        for pair in points.windows(2) {
            let length = (pair[1][0] - pair[0][0]).hypot(pair[1][1] - pair[0][1]);
            if !dashed {
                self.line(pair[0], pair[1], colour, width_px)?;
            } else if length.is_finite() {
                self.dashes(pair[0], pair[1], run, colour, width_px)?;
                run += length;
            }
        }
        Ok(())
    }

    /// The dashes of one piece of a dashed line that is already `run` pixels long.
    fn dashes(&mut self, from: [f64; 2], to: [f64; 2], run: f64, colour: Colour, width_px: i32) -> Result<(), ReportError> {
        const PERIOD: f64 = 16.0;
        const DASH: f64 = 9.0;
        let length = (to[0] - from[0]).hypot(to[1] - from[1]).max(1e-9);
        let at = |s: f64| [0, 1].map(|k| from[k] + (to[k] - from[k]) * (s / length).clamp(0.0, 1.0));
        let mut start = -(run % PERIOD);
        while start < length {
            if start + DASH > 0.0 {
                self.line(at(start), at(start + DASH), colour, width_px)?;
            }
            start += PERIOD;
        }
        Ok(())
    }

    pub fn disc(&mut self, centre: [f64; 2], radius_px: f64, colour: Colour) -> Result<(), ReportError> {
        self.circle(centre, radius_px, colour, imgproc::FILLED)
    }

    pub fn circle(&mut self, centre: [f64; 2], radius_px: f64, colour: Colour, width_px: i32) -> Result<(), ReportError> {
        if on_paper(centre) {
            let radius = (radius_px * f64::from(1 << SHIFT)).round() as i32;
            imgproc::circle(&mut self.mat()?, fixed(centre), radius, scalar(colour), width_px, LINE_AA, SHIFT)?;
        }
        Ok(())
    }

    /// Filled, without anti-aliasing; edges lie between pixels.
    pub fn rectangle(&mut self, x: u32, y: u32, width: u32, height: u32, colour: Colour) {
        for row in y..(y + height).min(self.picture.height()) {
            for column in x..(x + width).min(self.picture.width()) {
                self.picture.put_pixel(column, row, Rgb(colour));
            }
        }
    }

    /// Closed outlines, such as of a mask.
    pub fn contours(&mut self, contours: &Vector<Vector<Point>>, colour: Colour, width_px: i32) -> Result<(), ReportError> {
        imgproc::polylines(&mut self.mat()?, contours, true, scalar(colour), width_px, LINE_AA, 0)?;
        Ok(())
    }

    /// ASCII text whose baseline starts, is centred or ends at `at`.
    pub fn text(&mut self, at: [f64; 2], text: &str, capital_px: f64, colour: Colour, align: Align) -> Result<(), ReportError> {
        let scale = capital_px / CAPITAL_PX;
        let width = text_width_px(text, capital_px)?;
        let x = match align {
            Align::Left => at[0],
            Align::Centre => at[0] - width / 2.0,
            Align::Right => at[0] - width,
        };
        let origin = Point::new(x.round() as i32, at[1].round() as i32);
        imgproc::put_text(
            &mut self.mat()?,
            text,
            origin,
            FONT_HERSHEY_SIMPLEX,
            scale,
            scalar(colour),
            thickness(capital_px),
            LINE_AA,
            false,
        )?;
        Ok(())
    }

    /// Copies `picture` with its upper left corner at (x, y); what sticks out is cut off.
    pub fn paste(&mut self, picture: &RgbImage, x: u32, y: u32) {
        image::imageops::replace(&mut self.picture, picture, x.into(), y.into());
    }
}

pub fn text_width_px(text: &str, capital_px: f64) -> Result<f64, ReportError> {
    let size = imgproc::get_text_size(text, FONT_HERSHEY_SIMPLEX, capital_px / CAPITAL_PX, thickness(capital_px), &mut 0)?;
    Ok(f64::from(size.width))
}

fn thickness(capital_px: f64) -> i32 {
    (capital_px / 9.0).round().max(1.0) as i32
}

fn scalar(colour: Colour) -> Scalar {
    Scalar::new(colour[0].into(), colour[1].into(), colour[2].into(), 0.0)
}

fn fixed(p: [f64; 2]) -> Point {
    let fixed = |v: f64| (v * f64::from(1 << SHIFT)).round() as i32;
    Point::new(fixed(p[0]), fixed(p[1]))
}

/// Finite and near enough for OpenCV's integers.
fn on_paper(p: [f64; 2]) -> bool {
    p.iter().all(|v| v.abs() < 1e6)
}

/// `colour` mixed with white: 0 keeps it, 1 gives white.
pub fn faded(colour: Colour, towards_white: f64) -> Colour {
    colour.map(|c| (f64::from(c) + (255.0 - f64::from(c)) * towards_white).round() as u8)
}

/// How a skeleton is drawn.
pub struct Pen {
    pub width_px: i32,
    pub middle: Colour,
    /// 0 for full colours, towards 1 for ghosts.
    pub fade: f64,
    /// A darker rim that sets the figure off from a photograph.
    pub rim: Option<Colour>,
}

impl Pen {
    fn colour(&self, joint: Joint) -> Colour {
        let colour = match joint.name().as_bytes() {
            [b'l', b'_', ..] => LEFT,
            [b'r', b'_', ..] => RIGHT,
            _ => self.middle,
        };
        faded(colour, self.fade)
    }
}

/// Draws a skeleton whose node k is at pixel `nodes[k]`; bones of nodes that are `None` are left out.
pub fn skeleton(canvas: &mut Canvas, nodes: &[Option<[f64; 2]>; NODES], pen: &Pen) -> Result<(), ReportError> {
    skeleton_marks(nodes, pen).iter().try_for_each(|mark| mark.draw(canvas))
}

/// The same as marks.
pub fn skeleton_marks(nodes: &[Option<[f64; 2]>; NODES], pen: &Pen) -> Vec<Mark> {
    let bones: Vec<_> =
        Joint::ALL.into_iter().filter_map(|joint| Some((joint, nodes[joint.parent()? as usize]?, nodes[joint as usize]?))).collect();
    let line = |from, to, colour, width_px| Mark::Line { from, to, colour, width_px };
    let mut marks = Vec::new();
    if let Some(rim) = pen.rim {
        marks.extend(bones.iter().map(|(_, from, to)| line(*from, *to, rim, pen.width_px + 4)));
    }
    marks.extend(bones.iter().map(|(joint, from, to)| line(*from, *to, pen.colour(*joint), pen.width_px)));
    let radius = 0.9 * f64::from(pen.width_px);
    for (joint, _, to) in &bones {
        if let Some(rim) = pen.rim {
            marks.push(Mark::Disc { centre: *to, radius_px: radius + 2.0, colour: rim });
        }
        marks.push(Mark::Disc { centre: *to, radius_px: radius, colour: pen.colour(*joint) });
    }
    marks.extend(head(nodes, pen));
    marks
}

/// Which colour is which side, at the top of a picture of figures, from column `x` on.
pub fn legend(canvas: &mut Canvas, x: f64) -> Result<(), ReportError> {
    for (x, name, colour) in [(x, "left", LEFT), (x + 110.0, "right", RIGHT)] {
        canvas.line([x, 22.0], [x + 28.0, 22.0], colour, 4)?;
        canvas.text([x + 36.0, 27.0], name, 10.0, INK, Align::Left)?;
    }
    Ok(())
}

/// A circle where the head is: the skull base is its lower back, a neck's length above the base of the neck.
fn head(nodes: &[Option<[f64; 2]>; NODES], pen: &Pen) -> Vec<Mark> {
    let (Some(neck), Some(skull), Some(root)) = (nodes[Joint::Vt1 as usize], nodes[Joint::Skullbase as usize], nodes[0]) else {
        return Vec::new();
    };
    let centre = [0, 1].map(|k| skull[k] + 0.55 * (skull[k] - neck[k]));
    // Root to base of the neck is 0.30 of stature, half a head's height 0.055.
    let radius_px = 0.055 / 0.30 * (neck[0] - root[0]).hypot(neck[1] - root[1]);
    let circle = |colour, width_px| Mark::Circle { centre, radius_px, colour, width_px };
    let rim = pen.rim.map(|rim| circle(rim, pen.width_px + 4));
    rim.into_iter().chain([circle(faded(pen.middle, pen.fade), pen.width_px)]).collect()
}

/// Round numbers that divide [low, high] into about `count` parts: 1, 2 or 5 times a power of ten apart.
pub fn ticks(low: f64, high: f64, count: usize) -> Vec<f64> {
    let raw = (high - low) / count.max(1) as f64;
    if !raw.is_finite() || raw <= 0.0 {
        return vec![low];
    }
    let decade = 10f64.powf(raw.log10().floor());
    let step = decade * [1.0, 2.0, 5.0, 10.0].into_iter().find(|m| m * decade >= raw * 0.999).unwrap_or(10.0);
    let (first, last) = ((low / step - 1e-9).ceil() as i64, (high / step + 1e-9).floor() as i64);
    (first..=last).map(|i| i as f64 * step).collect()
}

/// A tick's number with as many decimals as its neighbours need.
pub fn tick_label(value: f64, ticks: &[f64]) -> String {
    let step = ticks.windows(2).map(|w| w[1] - w[0]).fold(f64::INFINITY, f64::min);
    let decimals = if step.is_finite() { (-step.log10() + 1e-9).ceil().clamp(0.0, 6.0) as usize } else { 2 };
    // No "-0".
    format!("{:.decimals$}", if value == 0.0 { 0.0 } else { value })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside() {
        assert_eq!(ticks(0.0, 1.0, 5), [0.0, 0.2, 0.4, 0.6000000000000001, 0.8, 1.0]);
        assert_eq!(ticks(-37.0, 61.0, 5), [-20.0, 0.0, 20.0, 40.0, 60.0]);
        assert_eq!(ticks(3.0, 3.0, 5), [3.0]);
        let t = ticks(0.8, 2.1, 4);
        assert_eq!(t.iter().map(|v| tick_label(*v, &t)).collect::<Vec<_>>(), ["1.0", "1.5", "2.0"]);
        assert_eq!(tick_label(-0.0, &[-20.0, 0.0]), "0");
    }

    #[test]
    fn lines_discs_and_text_land_where_they_should() {
        let mut canvas = Canvas::new(120, 60, WHITE);
        canvas.line([10.0, 30.0], [50.0, 30.0], LEFT, 3).unwrap();
        canvas.disc([80.0, 30.0], 8.0, RIGHT).unwrap();
        canvas.line([f64::NAN, 0.0], [1.0, 1.0], INK, 3).unwrap();
        assert_eq!(canvas.picture.get_pixel(30, 30).0, LEFT);
        assert_eq!(canvas.picture.get_pixel(80, 36).0, RIGHT);
        assert_eq!(canvas.picture.get_pixel(30, 40).0, WHITE);
        assert_eq!(canvas.picture.get_pixel(92, 30).0, WHITE);
        canvas.text([115.0, 55.0], "right", 8.0, INK, Align::Right).unwrap();
        let dark = |x: std::ops::Range<u32>| {
            x.flat_map(|x| (44..60).map(move |y| (x, y))).filter(|(x, y)| canvas.picture.get_pixel(*x, *y)[0] < 128).count()
        };
        assert!(dark(60..116) > 20 && dark(0..60) == 0 && dark(117..120) == 0);
    }

    #[test]
    fn dashes_leave_gaps_and_go_on_across_short_pieces() {
        let mut canvas = Canvas::new(200, 20, WHITE);
        let points: Vec<_> = (0..=180).map(|x| [10.0 + x as f64, 10.0]).collect();
        canvas.polyline(&points, INK, 1, true).unwrap();
        let inked = (10..190).filter(|x| canvas.picture.get_pixel(*x, 10)[0] < 128).count();
        assert!((85..140).contains(&inked), "{inked}");
    }
}
