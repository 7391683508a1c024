//! Lines, circles and text that become a picture or an SVG: the same drawing for the screen and for print.

use std::fmt::Write;

use image::RgbImage;

use super::ReportError;
use super::canvas::{Align, Canvas, Colour, WHITE};

/// Pixels; coordinates as on a [`Canvas`].
#[derive(Clone, Debug, PartialEq)]
pub enum Mark {
    Line { from: [f64; 2], to: [f64; 2], colour: Colour, width_px: i32 },
    Disc { centre: [f64; 2], radius_px: f64, colour: Colour },
    Circle { centre: [f64; 2], radius_px: f64, colour: Colour, width_px: i32 },
    Text { at: [f64; 2], text: String, capital_px: f64, colour: Colour, align: Align },
}

impl Mark {
    pub fn draw(&self, canvas: &mut Canvas) -> Result<(), ReportError> {
        match self {
            Mark::Line { from, to, colour, width_px } => canvas.line(*from, *to, *colour, *width_px),
            Mark::Disc { centre, radius_px, colour } => canvas.disc(*centre, *radius_px, *colour),
            Mark::Circle { centre, radius_px, colour, width_px } => canvas.circle(*centre, *radius_px, *colour, *width_px),
            Mark::Text { at, text, capital_px, colour, align } => canvas.text(*at, text, *capital_px, *colour, *align),
        }
    }

    fn svg(&self) -> String {
        match self {
            Mark::Line { from: [x1, y1], to: [x2, y2], colour, width_px } => format!(
                "<line x1=\"{x1:.2}\" y1=\"{y1:.2}\" x2=\"{x2:.2}\" y2=\"{y2:.2}\" stroke=\"{}\" stroke-width=\"{width_px}\"/>",
                hex(colour)
            ),
            Mark::Disc { centre: [x, y], radius_px, colour } => {
                format!("<circle cx=\"{x:.2}\" cy=\"{y:.2}\" r=\"{radius_px:.2}\" fill=\"{}\"/>", hex(colour))
            }
            Mark::Circle { centre: [x, y], radius_px, colour, width_px } => format!(
                "<circle cx=\"{x:.2}\" cy=\"{y:.2}\" r=\"{radius_px:.2}\" fill=\"none\" stroke=\"{}\" stroke-width=\"{width_px}\"/>",
                hex(colour)
            ),
            Mark::Text { at: [x, y], text, capital_px, colour, align } => {
                let anchor = match align {
                    Align::Left => "start",
                    Align::Centre => "middle",
                    Align::Right => "end",
                };
                // Capitals are some 0.72 of the size of a sans-serif type.
                format!(
                    "<text x=\"{x:.2}\" y=\"{y:.2}\" font-family=\"sans-serif\" font-size=\"{:.1}\" text-anchor=\"{anchor}\" fill=\"{}\">{}</text>",
                    capital_px / 0.72,
                    hex(colour),
                    escaped(text)
                )
            }
        }
    }
}

fn hex([r, g, b]: &Colour) -> String {
    format!("#{r:02x}{g:02x}{b:02x}")
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

/// A drawing of a size; later marks lie above earlier ones.
#[derive(Clone, Debug, PartialEq)]
pub struct Drawing {
    pub size_px: [u32; 2],
    pub marks: Vec<Mark>,
}

impl Drawing {
    pub fn picture(&self) -> Result<RgbImage, ReportError> {
        let mut canvas = Canvas::new(self.size_px[0], self.size_px[1], WHITE);
        self.marks.iter().try_for_each(|mark| mark.draw(&mut canvas))?;
        Ok(canvas.picture)
    }

    pub fn svg(&self) -> String {
        let [width, height] = self.size_px;
        let mut text = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" viewBox=\"0 0 {width} {height}\">\n\
             <rect width=\"{width}\" height=\"{height}\" fill=\"white\"/>\n<g stroke-linecap=\"round\">\n"
        );
        for mark in &self.marks {
            // Writing to a String cannot fail.
            let _ = writeln!(text, "{}", mark.svg());
        }
        text + "</g>\n</svg>\n"
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::canvas::{INK, LEFT, RIGHT};

    #[test]
    fn picture_and_svg_show_the_same() {
        let marks = vec![
            Mark::Line { from: [10.0, 20.0], to: [50.0, 20.0], colour: LEFT, width_px: 3 },
            Mark::Disc { centre: [70.0, 20.0], radius_px: 6.0, colour: RIGHT },
            Mark::Circle { centre: [90.0, 20.0], radius_px: 6.0, colour: INK, width_px: 2 },
            Mark::Text { at: [10.0, 38.0], text: "a < b & c".into(), capital_px: 8.0, colour: INK, align: Align::Left },
        ];
        let drawing = Drawing { size_px: [110, 44], marks };
        let picture = drawing.picture().unwrap();
        assert_eq!((picture.get_pixel(30, 20).0, picture.get_pixel(70, 20).0, picture.get_pixel(90, 20).0), (LEFT, RIGHT, WHITE));
        let svg = drawing.svg();
        for part in [
            "viewBox=\"0 0 110 44\"",
            "<line x1=\"10.00\" y1=\"20.00\" x2=\"50.00\" y2=\"20.00\" stroke=\"#0072b2\" stroke-width=\"3\"/>",
            "<circle cx=\"70.00\" cy=\"20.00\" r=\"6.00\" fill=\"#d55e00\"/>",
            ">a &lt; b &amp; c</text>",
        ] {
            assert!(svg.contains(part), "{svg}");
        }
    }
}
