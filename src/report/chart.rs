//! Line charts as inline SVG: crisp on every screen, coloured by the page's CSS variables.

use std::fmt::Write;

use maud::{Markup, html};

use super::canvas::{tick_label, ticks};
use super::curves::Curve;

const WIDTH: f64 = 400.0;
const LEFT: f64 = 46.0;
const RIGHT: f64 = 12.0;
const TOP: f64 = 24.0;
const BOTTOM: f64 = 40.0;
/// Number of the ink's class beside the palette's.
pub const INK: usize = 7;

/// Points without lines.
#[derive(Clone, Debug, Default)]
pub struct Dots {
    pub label: String,
    pub points: Vec<[f64; 2]>,
    /// Half the length of the vertical bar at each point, or empty.
    pub bars: Vec<f64>,
    pub colour: usize,
    pub radius: f64,
}

/// One chart; what is not needed stays empty. Colours are places in the palette, [`INK`] after them.
#[derive(Clone, Debug, Default)]
pub struct Chart {
    pub title: String,
    /// Quantity and unit.
    pub x_label: String,
    pub y_label: String,
    /// Ends of the axis; of the data where missing.
    pub x_range: Option<[f64; 2]>,
    pub y_range: Option<[f64; 2]>,
    pub curves: Vec<Curve>,
    /// Thin lines behind, with no key.
    pub faint: Vec<Curve>,
    pub dots: Vec<Dots>,
    /// Words at places of the chart.
    pub names: Vec<([f64; 2], String)>,
    /// Words in place of the numbers below the axis.
    pub ticks: Vec<(f64, String)>,
    /// Dotted lines upwards, with colour.
    pub marks: Vec<(f64, usize)>,
    /// Of the drawing; 250 where zero.
    pub height: f64,
    pub caption: String,
}

/// Data coordinates in the drawing.
struct Frame {
    x: [f64; 2],
    y: [f64; 2],
    width: f64,
    height: f64,
}

impl Frame {
    fn px(&self, p: [f64; 2]) -> [f64; 2] {
        [(p[0] - self.x[0]) / (self.x[1] - self.x[0]) * self.width, (self.y[1] - p[1]) / (self.y[1] - self.y[0]) * self.height]
    }
}

impl Chart {
    /// The figure with title, keys, drawing and caption.
    pub fn figure(&self) -> Markup {
        html! {
            figure.chart {
                p.title { (self.title) }
                (self.keys())
                (self.drawing())
                @if !self.caption.is_empty() { figcaption { (self.caption) } }
            }
        }
    }

    fn keys(&self) -> Markup {
        html! {
            p.keys {
                @for curve in self.curves.iter().filter(|c| !c.label.is_empty()) {
                    span {
                        svg width="24" height="10" aria-hidden="true" {
                            @if !curve.band.is_empty() { rect class={ "band f" (colour(curve.colour)) } width="24" height="10" {} }
                            line class={ (stroke(curve)) " s" (colour(curve.colour)) } x1="1" y1="5" x2="23" y2="5" {}
                        }
                        (curve.label)
                    }
                }
                @for dots in self.dots.iter().filter(|d| !d.label.is_empty()) {
                    span {
                        svg width="10" height="10" aria-hidden="true" { circle class={ "f" (colour(dots.colour)) } cx="5" cy="5" r="4" {} }
                        (dots.label)
                    }
                }
            }
        }
    }

    fn frame(&self) -> Frame {
        let height = if self.height > 0.0 { self.height } else { 250.0 };
        let curves = || self.curves.iter().chain(&self.faint);
        let along = curves().flat_map(|c| &c.points).chain(self.dots.iter().flat_map(|d| &d.points)).map(|p| p[0]);
        let x = self.x_range.unwrap_or_else(|| range(along, if self.dots.is_empty() { 0.0 } else { 0.03 }));
        let reach = |points: &[[f64; 2]], bars: &[f64]| -> Vec<f64> {
            let bar = |i: usize| bars.get(i).copied().filter(|b| b.is_finite()).unwrap_or(0.0);
            points.iter().enumerate().flat_map(|(i, p)| [p[1] - bar(i), p[1] + bar(i)]).collect()
        };
        let up = curves().flat_map(|c| reach(&c.points, &c.band)).chain(self.dots.iter().flat_map(|d| reach(&d.points, &d.bars)));
        let y = self.y_range.unwrap_or_else(|| range(up, 0.06));
        Frame { x, y, width: WIDTH - LEFT - RIGHT, height: height - TOP - BOTTOM }
    }

    fn drawing(&self) -> Markup {
        let frame = self.frame();
        let height = frame.height + TOP + BOTTOM;
        html! {
            svg.plot viewBox={ "0 0 " (WIDTH) " " (height) } role="img" aria-label=(self.title) {
                text.axis x="4" y="12" { (self.y_label) }
                text.axis x=(LEFT + frame.width / 2.0) y=(height - 6.0) text-anchor="middle" { (self.x_label) }
                (axes(&frame, &self.ticks))
                svg x=(LEFT) y=(TOP) width=(frame.width) height=(frame.height) overflow="hidden" {
                    @for (x, c) in &self.marks {
                        @let [x, _] = rounded(frame.px([*x, frame.y[0]]));
                        line class={ "mark s" (colour(*c)) } x1=(x) y1="0" x2=(x) y2=(frame.height) {}
                    }
                    @for curve in &self.curves { (band(&frame, curve)) }
                    @for curve in &self.faint { (line(&frame, curve, "line faint")) }
                    @for curve in &self.curves { (line(&frame, curve, stroke(curve))) }
                    @for dots in &self.dots { (discs(&frame, dots)) }
                    @for (at, name) in &self.names {
                        @let [x, y] = rounded(frame.px(*at));
                        text.name x=(x.clamp(16.0, frame.width - 16.0)) y=((y - 6.0).max(11.0)) { (name) }
                    }
                }
            }
        }
    }
}

fn stroke(curve: &Curve) -> &'static str {
    if curve.dashed { "line dashed" } else { "line" }
}

fn colour(c: usize) -> usize {
    if c == INK { INK } else { c % INK }
}

fn range(values: impl Iterator<Item = f64>, margin: f64) -> [f64; 2] {
    let (low, high) = values.filter(|v| v.is_finite()).fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
    if high - low > 1e-12 {
        [low - margin * (high - low), high + margin * (high - low)]
    } else if low.is_finite() {
        [low - 0.5, high + 0.5]
    } else {
        [0.0, 1.0]
    }
}

fn rounded(p: [f64; 2]) -> [f64; 2] {
    p.map(|v| (v * 10.0).round() / 10.0)
}

fn axes(frame: &Frame, words: &[(f64, String)]) -> Markup {
    let up = ticks(frame.y[0], frame.y[1], 5);
    let numbers = ticks(frame.x[0], frame.x[1], 6);
    let numbers = numbers.iter().map(|mark| (*mark, tick_label(*mark, &numbers)));
    let across: Vec<(f64, String)> = if words.is_empty() { numbers.collect() } else { words.to_vec() };
    let bottom = TOP + frame.height;
    html! {
        @for mark in &up {
            @let y = TOP + rounded(frame.px([frame.x[0], *mark]))[1];
            line.grid x1=(LEFT) y1=(y) x2=(LEFT + frame.width) y2=(y) {}
            text.tick x=(LEFT - 7.0) y=(y + 4.0) text-anchor="end" { (tick_label(*mark, &up)) }
        }
        @for (k, (at, label)) in across.iter().enumerate() {
            @let x = LEFT + rounded(frame.px([*at, frame.y[0]]))[0];
            // Words stand in two rows.
            @let row = if k % 2 == 1 && words.iter().any(|w| w.1.len() > 3) { 14.0 } else { 0.0 };
            line.base x1=(x) y1=(bottom) x2=(x) y2=(bottom + 4.0) {}
            text.tick x=(x) y=(bottom + 17.0 + row) text-anchor="middle" { (label) }
        }
        line.base x1=(LEFT) y1=(bottom) x2=(LEFT + frame.width) y2=(bottom) {}
    }
}

/// `M` and `L` through the points; what is not finite breaks it.
fn path(frame: &Frame, points: impl Iterator<Item = [f64; 2]>) -> String {
    let (mut text, mut pen_down) = (String::new(), false);
    for p in points {
        let [x, y] = rounded(frame.px(p));
        let on_paper = x.is_finite() && y.is_finite();
        if on_paper {
            // Writing to a string cannot fail.
            let _ = write!(text, "{}{x} {y}", if pen_down { 'L' } else { 'M' });
        }
        pen_down = on_paper;
    }
    text
}

fn line(frame: &Frame, curve: &Curve, class: &str) -> Markup {
    html! { path class={ (class) " s" (colour(curve.colour)) } d=(path(frame, curve.points.iter().copied())) {} }
}

/// One outline for every run of points with a finite band.
fn band(frame: &Frame, curve: &Curve) -> Markup {
    let known = |i: usize| curve.band.get(i).is_some_and(|b| b.is_finite()) && curve.points[i][1].is_finite();
    let all: Vec<usize> = (0..curve.points.len()).collect();
    let outline = |run: &[usize]| {
        let edge = |i: usize, sign: f64| [curve.points[i][0], curve.points[i][1] + sign * curve.band[i]];
        path(frame, run.iter().map(|i| edge(*i, 1.0)).chain(run.iter().rev().map(|i| edge(*i, -1.0)))) + "Z"
    };
    let runs = all.chunk_by(|a, b| known(*a) && known(*b)).filter(|run| run.len() > 1);
    html! { @for run in runs { path class={ "band f" (colour(curve.colour)) } d=(outline(run)) {} } }
}

fn discs(frame: &Frame, dots: &Dots) -> Markup {
    html! {
        @for (i, p) in dots.points.iter().enumerate().filter(|(_, p)| p.iter().all(|v| v.is_finite())) {
            @let [x, y] = rounded(frame.px(*p));
            @if let Some(bar) = dots.bars.get(i).filter(|b| b.is_finite()) {
                @let [low, high] = [-1.0, 1.0].map(|s| rounded(frame.px([p[0], p[1] + s * bar]))[1]);
                line class={ "bar s" (colour(dots.colour)) } x1=(x) y1=(low) x2=(x) y2=(high) {}
            }
            circle class={ "f" (colour(dots.colour)) } cx=(x) cy=(y) r=(dots.radius) {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_go_through_their_points_and_break_at_gaps() {
        let points = vec![[0.0, 0.0], [1.0, 1.0], [2.0, f64::NAN], [3.0, 1.0], [4.0, 2.0]];
        let curve = Curve { label: "a & b".into(), points, dashed: false, colour: 1, band: vec![0.5; 5] };
        let chart =
            Chart { title: "<t>".into(), curves: vec![curve], x_range: Some([0.0, 4.0]), y_range: Some([0.0, 2.0]), ..Chart::default() };
        let text = chart.figure().into_string();
        // The drawing is 342 by 186.
        assert!(text.contains("d=\"M0 186L85.5 93M256.5 93L342 0\""), "{text}");
        assert_eq!(text.matches("<path class=\"band f1\"").count(), 2);
        assert!(text.contains("d=\"M0 139.5L85.5 46.5L85.5 139.5L0 232.5Z\""), "{text}");
        assert!(text.contains("a &amp; b") && text.contains("&lt;t&gt;") && !text.contains("<t>"));
    }

    #[test]
    fn dots_have_bars_and_empty_charts_axes() {
        let dots = Dots { points: vec![[1.0, 1.0], [f64::NAN, 0.0]], bars: vec![0.5, 0.1], radius: 3.0, ..Dots::default() };
        let chart = Chart { dots: vec![dots], x_range: Some([0.0, 2.0]), y_range: Some([0.0, 2.0]), ..Chart::default() };
        let text = chart.figure().into_string();
        assert!(text.contains("x1=\"171\" y1=\"139.5\" x2=\"171\" y2=\"46.5\"") && text.contains("cx=\"171\" cy=\"93\""), "{text}");
        assert_eq!(text.matches("<circle").count(), 1);
        assert!(Chart::default().figure().into_string().contains("class=\"tick\""));
    }
}
