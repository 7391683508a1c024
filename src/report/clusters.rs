//! A person's weights among the database's (style paper, Figure 2).

use image::RgbImage;
use nalgebra::SymmetricEigen;

use super::ReportError;
use super::canvas::{Align, Canvas, INK, PALETTE, WHITE, faded};
use super::curves::{Curve, Frame};
use crate::motion_model::Model;

/// Half the axes of an ellipse that holds 95 % of a bivariate normal, in standard deviations.
const ELLIPSE: f64 = 2.448;

/// The first two weights of every cycle, a colour and a name per subject, and `weights` with its 95 % ellipse where
/// `covariance` (rows) is known; in units of the population's standard deviation.
pub fn clusters(model: &Model, weights: &[f64], covariance: Option<&Vec<Vec<f64>>>, title: &str) -> Result<RgbImage, ReportError> {
    let (series, person, ring) = (series(model), units(model, weights), ring(model, weights, covariance));
    let found =
        Curve { label: String::new(), points: ring.clone().unwrap_or_else(|| vec![person]), dashed: false, colour: 0, band: Vec::new() };
    let all: Vec<Curve> = series.iter().cloned().chain([found]).collect();
    let frame = Frame::around(&all, 1000.0, 720.0);
    let mut canvas = subjects(&frame, &series, title)?;
    if let Some(ring) = ring {
        let pixels: Vec<_> = ring.iter().map(|p| frame.pixel(*p)).collect();
        canvas.polyline(&pixels, INK, 2, false)?;
    }
    let [x, y] = frame.pixel(person);
    for (dx, dy) in [(9.0, 0.0), (0.0, 9.0)] {
        canvas.line([x - dx, y - dy], [x + dx, y + dy], INK, 4)?;
    }
    canvas.text([x + 14.0, y + 5.0], "this person", 11.0, INK, Align::Left)?;
    Ok(canvas.picture)
}

/// [`clusters`] of the database alone (Figures 1 and 2).
pub fn database_clusters(model: &Model, title: &str) -> Result<RgbImage, ReportError> {
    let series = series(model);
    Ok(subjects(&Frame::around(&series, 1000.0, 720.0), &series, title)?.picture)
}

/// Standard deviation of a weight over the database.
pub(super) fn scale(model: &Model, i: usize) -> f64 {
    model.eigenvalues.get(i).map_or(1.0, |l| l.sqrt().max(1e-12))
}

/// First two weights over their standard deviations.
pub(super) fn units(model: &Model, weights: &[f64]) -> [f64; 2] {
    [0, 1].map(|i| weights.get(i).copied().unwrap_or(0.0) / scale(model, i))
}

/// The 95 % ellipse about [`units`]; `None` where the covariance (rows) of the weights is not known.
pub(super) fn ring(model: &Model, weights: &[f64], covariance: Option<&Vec<Vec<f64>>>) -> Option<Vec<[f64; 2]>> {
    let entry = |i: usize, j: usize| Some(covariance?.get(i)?.get(j)? / scale(model, i) / scale(model, j)).filter(|v| v.is_finite());
    Some(ellipse(units(model, weights), [entry(0, 0)?, entry(0, 1)?, entry(1, 1)?]))
}

fn series(model: &Model) -> Vec<Curve> {
    let weights = model.leading_weights(2);
    let one = |(k, subject): (usize, &str)| {
        let own = model.members.iter().zip(weights.column_iter()).filter(|(m, _)| m.subject == subject);
        let points = own.map(|(_, weights)| units(model, weights.as_slice()));
        Curve { label: subject.to_string(), points: points.collect(), dashed: false, colour: k, band: Vec::new() }
    };
    model.subjects().into_iter().enumerate().map(one).collect()
}

fn subjects(frame: &Frame, series: &[Curve], title: &str) -> Result<Canvas, ReportError> {
    let mut canvas = Canvas::new(1000, 720, WHITE);
    canvas.text([84.0, 32.0], title, 14.0, INK, Align::Left)?;
    canvas.text([24.0, 96.0], "second weight (standard deviations of the database)", 11.0, INK, Align::Left)?;
    canvas.text([530.0, 706.0], "first weight (standard deviations of the database)", 11.0, INK, Align::Centre)?;
    frame.axes(&mut canvas)?;
    for curve in series {
        let colour = faded(PALETTE[curve.colour % PALETTE.len()], 0.3);
        for p in &curve.points {
            canvas.disc(frame.pixel(*p), 4.0, colour)?;
        }
    }
    for curve in series.iter().filter(|c| !c.points.is_empty()) {
        let n = curve.points.len() as f64;
        let [x, y] = frame.pixel([0, 1].map(|k| curve.points.iter().map(|p| p[k]).sum::<f64>() / n));
        canvas.text([x, y - 7.0], &curve.label, 9.0, INK, Align::Centre)?;
    }
    Ok(canvas)
}

/// The 95 % ellipse of covariance [xx, xy, yy] about a point.
fn ellipse(centre: [f64; 2], [xx, xy, yy]: [f64; 3]) -> Vec<[f64; 2]> {
    let axes = SymmetricEigen::new(nalgebra::Matrix2::new(xx, xy, xy, yy));
    let half = axes.eigenvalues.map(|v| ELLIPSE * v.max(0.0).sqrt());
    let at = |k: i32| {
        let turn = f64::from(k) * std::f64::consts::TAU / 72.0;
        let p = axes.eigenvectors * nalgebra::Vector2::new(half.x * turn.cos(), half.y * turn.sin());
        [centre[0] + p.x, centre[1] + p.y]
    };
    (0..=72).map(at).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ellipse_has_the_stated_half_axes() {
        let ring = ellipse([1.0, 2.0], [4.0, 0.0, 0.25]);
        let widest = ring.iter().map(|p| (p[0] - 1.0).abs()).fold(0.0, f64::max);
        let highest = ring.iter().map(|p| (p[1] - 2.0).abs()).fold(0.0, f64::max);
        assert!((widest - 2.0 * ELLIPSE).abs() < 1e-9 && (highest - 0.5 * ELLIPSE).abs() < 1e-9, "{widest} {highest}");
    }
}
