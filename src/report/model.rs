//! Pictures of a motion model and of its validation (style paper, Figures 4 and 8).

use image::RgbImage;

use super::ReportError;
use super::canvas::{Align, Canvas, GRID, INK, PALETTE, WHITE, text_width_px};
use super::curves::{Curve, Frame, curves};
use crate::motion_model::Model;
use crate::style::Population;
use crate::style::validate::Score;

/// Components whose share of the variance is drawn.
const EXPLAINED: usize = 40;
/// Size of a subject's name.
const NAME_PX: f64 = 8.0;
/// Points of a subject's curve.
const STEPS: u32 = 60;

/// Part of the variance over the number of components.
pub fn explained(model: &Model) -> Result<RgbImage, ReportError> {
    let all = model.explained();
    let points = all.iter().take(EXPLAINED).enumerate().map(|(i, v)| [(i + 1) as f64, 100.0 * v]);
    let from_zero: Vec<[f64; 2]> = [[0.0, 0.0]].into_iter().chain(points).collect();
    let last = from_zero.len() as f64 - 1.0;
    let level = |part: f64, colour: usize| Curve {
        label: format!("{} components hold {:.0} %", model.components(part), 100.0 * part),
        points: vec![[0.0, 100.0 * part], [last, 100.0 * part]],
        dashed: true,
        colour,
        band: Vec::new(),
    };
    let subjects = model.subjects().len();
    let label = format!("{} cycles of {subjects} subjects", model.members.len());
    let series = [Curve { label, points: from_zero, dashed: false, colour: 0, band: Vec::new() }, level(0.90, 1), level(0.95, 2)];
    curves(&format!("Variance held, {}", model.activity), "components", "variance held (%)", &series)
}

/// The first four weights of every subject over the parameter: what was recorded as dots, the curves between as lines.
pub fn coefficients(model: &Model) -> Result<RgbImage, ReportError> {
    let (width, height) = (760u32, 520u32);
    let population = Population::new(model, 4);
    let mut canvas = Canvas::new(2 * width, 2 * height, WHITE);
    for i in 0..population.components() {
        let panel = coefficient(model, &population, i, f64::from(width), f64::from(height))?;
        canvas.paste(&panel, (i as u32 % 2) * width, (i as u32 / 2) * height);
    }
    Ok(canvas.picture)
}

fn coefficient(model: &Model, population: &Population, i: usize, width: f64, height: f64) -> Result<RgbImage, ReportError> {
    let scale = model.eigenvalues[i].sqrt().max(1e-12);
    let line = |(k, subject): (usize, &crate::style::curves::Curve)| {
        let (first, last) = subject.range();
        let at = |step: u32| first + (last - first) * f64::from(step) / f64::from(STEPS);
        let points = (0..=STEPS).map(|step| [at(step), subject.at(at(step))[i] / scale]).collect();
        Curve { label: subject.subject.clone(), points, dashed: false, colour: k, band: Vec::new() }
    };
    let lines: Vec<Curve> = population.curves.iter().enumerate().map(line).collect();
    let dots = |k: usize| population.curves[k].parameters().iter().map(move |&s| [s, population.curves[k].at(s)[i] / scale]);
    let frame = Frame::around(&lines, width, height);
    let mut canvas = Canvas::new(width as u32, height as u32, WHITE);
    let unit = if model.activity.is_cyclic() { "speed (m/s)" } else { "length (m)" };
    canvas.text([84.0, 36.0], &format!("Weight {} of {}", i + 1, model.activity), 13.0, INK, Align::Left)?;
    canvas.text([24.0, 96.0], "standard deviations of the database", 10.0, INK, Align::Left)?;
    canvas.text([width / 2.0, height - 14.0], unit, 10.0, INK, Align::Centre)?;
    frame.axes(&mut canvas)?;
    for (k, curve) in lines.iter().enumerate() {
        let colour = PALETTE[k % PALETTE.len()];
        let pixels: Vec<_> = curve.points.iter().map(|p| frame.pixel(*p)).collect();
        canvas.polyline(&pixels, colour, 2, false)?;
        for dot in dots(k) {
            canvas.disc(frame.pixel(dot), 4.0, colour)?;
        }
    }
    // Curves end where their people's recordings do; names that would cover each other make way.
    let ends = lines.iter().filter_map(|c| Some((&c.label, frame.pixel(*c.points.last()?))));
    let mut names: Vec<(&String, [f64; 2])> = ends.map(|(label, [x, y])| (label, [x - 6.0, y - 8.0])).collect();
    names.sort_by(|a, b| a.1[1].total_cmp(&b.1[1]));
    let widths = names.iter().map(|(label, _)| text_width_px(label, NAME_PX)).collect::<Result<Vec<f64>, _>>()?;
    make_way(&mut names.iter_mut().map(|n| &mut n.1).collect::<Vec<_>>(), &widths, 1.6 * NAME_PX);
    for (label, at) in names {
        canvas.text(at, label, NAME_PX, INK, Align::Right)?;
    }
    Ok(canvas.picture)
}

/// Moves texts that end at `ends`, sorted by height, apart to lines of `line` pixels where they overlap across.
fn make_way(ends: &mut [&mut [f64; 2]], widths: &[f64], line: f64) {
    for _ in 0..100 {
        let mut moved = false;
        for k in 1..ends.len() {
            for i in 0..k {
                let left = |n: usize, ends: &[&mut [f64; 2]]| ends[n][0] - widths[n];
                let beside = left(k, ends) > ends[i][0] || left(i, ends) > ends[k][0];
                let short = line - (ends[k][1] - ends[i][1]);
                if !beside && short > 0.01 {
                    ends[i][1] -= 0.5 * short;
                    ends[k][1] += 0.5 * short;
                    moved = true;
                }
            }
        }
        if !moved {
            break;
        }
    }
}

/// One column per left-out subject, one mark per method (Figure 8); `metric` of the scores with its label and unit.
pub fn validation(scores: &[Score], metric: &str, label: &str) -> Result<RgbImage, ReportError> {
    let of = |s: &&Score| s.metric == metric;
    let mut methods: Vec<&str> = scores.iter().filter(of).map(|s| s.method).collect();
    methods.dedup();
    let mut subjects: Vec<&str> = Vec::new();
    scores.iter().filter(of).for_each(|s| subjects.extend((!subjects.contains(&s.left_out.as_str())).then_some(s.left_out.as_str())));
    // `all` stands last, whoever has no value of the first method.
    subjects.retain(|s| *s != "all");
    subjects.push("all");
    let value = |method: &str, subject: &str| {
        scores.iter().find(|s| s.metric == metric && s.method == method && s.left_out == subject).map_or(f64::NAN, |s| s.value)
    };
    let series: Vec<Curve> = methods
        .iter()
        .enumerate()
        .map(|(k, method)| {
            let points = subjects.iter().enumerate().map(|(i, s)| [i as f64, value(method, s)]).collect();
            Curve { label: method.to_string(), points, dashed: false, colour: k, band: Vec::new() }
        })
        .collect();
    let ends = [[-0.6, 0.0], [subjects.len() as f64 - 0.4, 0.0]];
    let corners = Curve { label: String::new(), points: ends.into(), dashed: false, colour: 0, band: Vec::new() };
    let frame = Frame::around(&series.iter().cloned().chain([corners]).collect::<Vec<_>>(), 1100.0, 620.0);
    let mut canvas = Canvas::new(1100, 620, WHITE);
    canvas.text([84.0, 32.0], "Every subject left out in turn", 14.0, INK, Align::Left)?;
    canvas.text([24.0, 96.0], label, 11.0, INK, Align::Left)?;
    frame.heights(&mut canvas)?;
    names(&mut canvas, &frame, &subjects)?;
    legend(&mut canvas, &methods)?;
    for curve in &series {
        for p in curve.points.iter().filter(|p| p[1].is_finite()) {
            mark(&mut canvas, frame.pixel(*p), curve.colour)?;
        }
    }
    Ok(canvas.picture)
}

/// Names below, a thin line between the subjects and `all`.
fn names(canvas: &mut Canvas, frame: &Frame, subjects: &[&str]) -> Result<(), ReportError> {
    let every = subjects.len().div_ceil(24);
    for (i, subject) in subjects.iter().enumerate().filter(|(i, s)| i % every == 0 || **s == "all") {
        let [x, _] = frame.pixel([i as f64, 0.0]);
        let short: String = subject.trim_start_matches("subject").chars().take(10).collect();
        canvas.text([x, 620.0 - 40.0], &short, 9.0, INK, Align::Centre)?;
    }
    let [x, _] = frame.pixel([subjects.len() as f64 - 1.5, 0.0]);
    canvas.line([x, 112.0], [x, 556.0], GRID, 2)?;
    canvas.text([590.0, 620.0 - 14.0], "subject left out", 11.0, INK, Align::Centre)
}

fn legend(canvas: &mut Canvas, methods: &[&str]) -> Result<(), ReportError> {
    let mut x = 92.0;
    for (k, method) in methods.iter().enumerate() {
        mark(canvas, [x, 61.0], k)?;
        canvas.text([x + 12.0, 65.0], method, 10.0, INK, Align::Left)?;
        x += 12.0 + text_width_px(method, 10.0)? + 28.0;
    }
    Ok(())
}

/// Seven colours, and rings after them.
fn mark(canvas: &mut Canvas, at: [f64; 2], k: usize) -> Result<(), ReportError> {
    let colour = PALETTE[k % PALETTE.len()];
    if k < PALETTE.len() { canvas.disc(at, 6.0, colour) } else { canvas.circle(at, 6.0, colour, 2) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::canvas::{LEFT, RIGHT};

    fn score(method: &'static str, left_out: &str, value: f64) -> Score {
        Score { method, metric: "rms_deg".into(), left_out: left_out.into(), value }
    }

    #[test]
    fn marks_stand_at_the_values_of_each_method() {
        let scores = [score("default", "a", 4.0), score("default", "all", 4.0), score("paper", "a", 8.0), score("paper", "all", 8.0)];
        let picture = validation(&scores, "rms_deg", "degrees").unwrap();
        let rows =
            |colour: [u8; 3]| -> Vec<u32> { (112..560).filter(|y| (100..1000).any(|x| picture.get_pixel(x, *y).0 == colour)).collect() };
        let middle = |rows: &[u32]| f64::from(rows[0] + rows[rows.len() - 1]) / 2.0;
        let (lower, upper) = (rows(LEFT), rows(RIGHT));
        // The zero line is at 0 and the scale is even: twice the value is twice as high, apart from the frame's margin.
        let frame = 620.0 - 64.0 - 0.06 / 1.12 * (620.0 - 64.0 - 112.0);
        let ratio = (frame - middle(&upper)) / (frame - middle(&lower));
        assert!((ratio - 2.0).abs() < 0.02, "{ratio}");
    }
}
