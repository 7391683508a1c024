//! Line plots.

use image::RgbImage;

use super::ReportError;
use super::canvas::{Align, Canvas, GRID, INK, PALETTE, WHITE, faded, text_width_px, tick_label, ticks};

/// One line of a plot.
#[derive(Clone, Debug)]
pub struct Curve {
    pub label: String,
    /// (x, y); values that are not finite leave a gap.
    pub points: Vec<[f64; 2]>,
    /// For references and truths.
    pub dashed: bool,
    /// Place in the palette: a truth and its estimate share a colour.
    pub colour: usize,
    /// Half the height of the band around each point, or empty.
    pub band: Vec<f64>,
}

const LEFT: f64 = 84.0;
const RIGHT: f64 = 24.0;
const TOP: f64 = 112.0;
const BOTTOM: f64 = 64.0;

/// A plot of 1000 by 620 pixels. Labels name quantity and unit, such as `"time (s)"`; the y label stands above its axis.
pub fn curves(title: &str, x_label: &str, y_label: &str, series: &[Curve]) -> Result<RgbImage, ReportError> {
    let mut canvas = Canvas::new(1000, 620, WHITE);
    let frame = Frame::around(series, 1000.0, 620.0);
    canvas.text([LEFT, 32.0], title, 14.0, INK, Align::Left)?;
    legend(&mut canvas, series)?;
    canvas.text([LEFT - 60.0, TOP - 16.0], y_label, 11.0, INK, Align::Left)?;
    canvas.text([(LEFT + 1000.0 - RIGHT) / 2.0, 620.0 - 14.0], x_label, 11.0, INK, Align::Centre)?;
    for curve in series {
        frame.band(&mut canvas, curve)?;
    }
    frame.axes(&mut canvas)?;
    for curve in series {
        let pixels: Vec<_> = curve.points.iter().map(|p| frame.pixel(*p)).collect();
        canvas.polyline(&pixels, PALETTE[curve.colour % PALETTE.len()], 3, curve.dashed)?;
    }
    Ok(canvas.picture)
}

fn legend(canvas: &mut Canvas, series: &[Curve]) -> Result<(), ReportError> {
    let mut x = LEFT;
    for curve in series {
        canvas.polyline(&[[x, 60.0], [x + 36.0, 60.0]], PALETTE[curve.colour % PALETTE.len()], 3, curve.dashed)?;
        canvas.text([x + 44.0, 65.0], &curve.label, 10.0, INK, Align::Left)?;
        x += 44.0 + text_width_px(&curve.label, 10.0)? + 28.0;
    }
    Ok(())
}

/// Data coordinates on the picture.
pub(super) struct Frame {
    x: (f64, f64),
    y: (f64, f64),
    width: f64,
    height: f64,
}

impl Frame {
    pub fn around(series: &[Curve], width: f64, height: f64) -> Frame {
        let range = |k: usize| {
            let reach = |s: &Curve, i: usize| if k == 1 { s.band.get(i).copied().unwrap_or(0.0) } else { 0.0 };
            let ends = |s: &Curve, i: usize| [s.points[i][k] - reach(s, i), s.points[i][k] + reach(s, i)];
            let values = series.iter().flat_map(|s| (0..s.points.len()).flat_map(move |i| ends(s, i))).filter(|v| v.is_finite());
            let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
            match low.partial_cmp(&high) {
                Some(std::cmp::Ordering::Less) => (low, high),
                Some(std::cmp::Ordering::Equal) => (low - 0.5, high + 0.5),
                _ => (0.0, 1.0),
            }
        };
        let (low, high) = range(1);
        let margin = 0.06 * (high - low);
        Frame { x: range(0), y: (low - margin, high + margin), width, height }
    }

    pub fn pixel(&self, p: [f64; 2]) -> [f64; 2] {
        let across = (p[0] - self.x.0) / (self.x.1 - self.x.0);
        let upward = (p[1] - self.y.0) / (self.y.1 - self.y.0);
        [LEFT + across * (self.width - LEFT - RIGHT), self.height - BOTTOM - upward * (self.height - TOP - BOTTOM)]
    }

    /// One line per column of pixels.
    fn band(&self, canvas: &mut Canvas, curve: &Curve) -> Result<(), ReportError> {
        let colour = faded(PALETTE[curve.colour % PALETTE.len()], 0.75);
        for (pair, widths) in curve.points.windows(2).zip(curve.band.windows(2)) {
            let (from, to) = (self.pixel(pair[0])[0], self.pixel(pair[1])[0]);
            let mut x = from.ceil();
            while x <= to && pair.iter().flatten().chain(widths).all(|v| v.is_finite()) {
                let t = (x - from) / (to - from).max(1e-9);
                let (y, w) = (pair[0][1] + t * (pair[1][1] - pair[0][1]), widths[0] + t * (widths[1] - widths[0]));
                let at = |value: f64| [x, self.pixel([pair[0][0], value])[1]];
                canvas.line(at(y - w), at(y + w), colour, 1)?;
                x += 1.0;
            }
        }
        Ok(())
    }

    pub fn axes(&self, canvas: &mut Canvas) -> Result<(), ReportError> {
        let bottom = self.height - BOTTOM;
        self.heights(canvas)?;
        let marks = ticks(self.x.0, self.x.1, 8);
        for mark in &marks {
            let x = self.pixel([*mark, self.y.0])[0];
            canvas.line([x, bottom], [x, bottom + 6.0], INK, 1)?;
            canvas.text([x, bottom + 24.0], &tick_label(*mark, &marks), 10.0, INK, Align::Centre)?;
        }
        Ok(())
    }

    /// The axis of y alone, with the line below it.
    pub fn heights(&self, canvas: &mut Canvas) -> Result<(), ReportError> {
        let (right, bottom) = (self.width - RIGHT, self.height - BOTTOM);
        let marks = ticks(self.y.0, self.y.1, 6);
        for mark in &marks {
            let y = self.pixel([self.x.0, *mark])[1];
            canvas.line([LEFT, y], [right, y], GRID, 1)?;
            canvas.text([LEFT - 10.0, y + 5.0], &tick_label(*mark, &marks), 10.0, INK, Align::Right)?;
        }
        canvas.line([LEFT, bottom], [right, bottom], INK, 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn curves_pass_through_their_points_and_break_at_gaps() {
        let points = |f: fn(f64) -> f64| (0..=100).map(|i| [i as f64, f(i as f64)]).collect::<Vec<_>>();
        let mut gap = points(|x| 20.0 - 0.1 * x);
        gap[50..60].iter_mut().for_each(|p| p[1] = f64::NAN);
        let series = [
            Curve { label: "rising".into(), points: points(|x| 0.2 * x), dashed: false, colour: 0, band: vec![2.0; 101] },
            Curve { label: "gap".into(), points: gap, dashed: false, colour: 1, band: Vec::new() },
        ];
        let picture = curves("t", "x (1)", "y (1)", &series).unwrap();
        let frame = Frame::around(&series, 1000.0, 620.0);
        let at = |p: [f64; 2]| {
            let [x, y] = frame.pixel(p);
            picture.get_pixel(x.round() as u32, y.round() as u32).0
        };
        assert_eq!((at([25.0, 5.0]), at([80.0, 16.0]), at([25.0, 17.5])), (PALETTE[0], PALETTE[0], PALETTE[1]));
        assert_eq!(at([55.0, 14.5]), WHITE);
        // Lines are blended at their ends.
        assert!((0..3).all(|k| at([25.0, 6.5])[k].abs_diff(faded(PALETTE[0], 0.75)[k]) < 3));
        assert!(curves("t", "x", "y", &[]).is_ok());
    }
}
