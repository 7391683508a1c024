//! A person's weights among the database's (style paper, Figure 2) and against the motion parameter (Figure 4).

use maud::{Markup, html};
use nalgebra::DVector;

use super::chart::{Chart, Dots, INK};
use super::clusters::{ring, scale, units};
use super::curves::Curve;
use super::page::{gallery, table};
use super::track::KNOWN;
use super::walk::BAND;
use crate::motion_model::Model;
use crate::style::curves::{SAME_PARAMETER, knots};
use crate::style::{Population, Style};

/// Weights that are drawn against the parameter.
const DRAWN: usize = 4;
/// Nearest subjects that are listed.
const LISTED: usize = 6;

/// Standard deviation of a weight, in its own units.
fn sigma(style: &Style, i: usize) -> f64 {
    style.covariance.as_ref().and_then(|c| Some(c.get(i)?.get(i)?.max(0.0).sqrt())).unwrap_or(f64::NAN)
}

/// Clusters, weights with their intervals, weights against the parameter, nearest subjects. `uncertainty` is that of
/// [`Fit::weight_uncertainty`](crate::fit::Fit::weight_uncertainty), or empty.
pub(super) fn section(model: &Model, style: &Style, uncertainty: &[f64]) -> Markup {
    let mut figures = vec![clusters(model, style), weights(model, style, uncertainty)];
    figures.extend((0..DRAWN.min(style.weights.len())).map(|i| against_parameter(model, style, i, &[])));
    html! {
        p.soft { "Weights in standard deviations of the database; every subject of the model has one place, this person another." }
        (gallery(&figures))
        (neighbours(style))
    }
}

/// Figure 2: the first two weights of every cycle, with the person's and its 95 % ellipse; a tracked person's are the expected ones.
pub(super) fn clusters(model: &Model, style: &Style) -> Markup {
    let (mut dots, mut names) = (Vec::new(), Vec::new());
    let weights = model.leading_weights(2);
    for (k, subject) in model.subjects().into_iter().enumerate() {
        let own = model.members.iter().zip(weights.column_iter()).filter(|(m, _)| m.subject == subject);
        let points: Vec<[f64; 2]> = own.map(|(_, weights)| units(model, weights.as_slice())).collect();
        let n = points.len() as f64;
        names.push(([0, 1].map(|a| points.iter().map(|p| p[a]).sum::<f64>() / n), subject.to_string()));
        dots.push(Dots { points, colour: k % INK, radius: 2.4, ..Dots::default() });
    }
    if style.expected.is_some() {
        let tracked = vec![units(model, &style.weights)];
        dots.push(Dots { label: "the tracked motion".into(), points: tracked, colour: 6, radius: 4.0, ..Dots::default() });
    }
    let (person, covariance) = style.place();
    let meant = if style.expected.is_some() { " This person's are those that recordings would have." } else { "" };
    dots.push(Dots {
        label: "this person, 95 % ellipse".into(),
        points: vec![units(model, person)],
        colour: INK,
        radius: 5.0,
        bars: Vec::new(),
    });
    let points = ring(model, person, covariance).unwrap_or_default();
    Chart {
        title: "Among the model's subjects".into(),
        x_label: "first weight".into(),
        y_label: "second weight".into(),
        curves: vec![Curve { label: String::new(), points, dashed: false, colour: INK, band: Vec::new() }],
        dots,
        names,
        height: 300.0,
        caption: format!("First two weights of every cycle of the database, named by subject.{meant}"),
        ..Chart::default()
    }
    .figure()
}

/// All weights with their 95 % intervals; grey where the footage said little.
fn weights(model: &Model, style: &Style, uncertainty: &[f64]) -> Markup {
    let of = |known: bool| {
        let chosen = (0..style.weights.len()).filter(|i| uncertainty.get(*i).is_none_or(|u| *u < KNOWN) == known);
        let rows: Vec<([f64; 2], f64)> =
            chosen.map(|i| ([(i + 1) as f64, style.weights[i] / scale(model, i)], BAND * sigma(style, i) / scale(model, i))).collect();
        let (points, bars) = rows.into_iter().unzip();
        let label = if known { "known, with 95 % interval" } else { "hardly seen" };
        Dots { label: label.into(), points, bars, colour: if known { 0 } else { 6 }, radius: 3.2 }
    };
    let dots: Vec<Dots> = [true, false].map(of).into_iter().filter(|d| !d.points.is_empty()).collect();
    Chart {
        title: "All weights".into(),
        x_label: "component".into(),
        y_label: "standard deviations of the database".into(),
        x_range: Some([0.0, style.weights.len() as f64 + 1.0]),
        dots,
        height: 300.0,
        caption: "Hardly seen: a standard deviation wider than half the database's.".into(),
        ..Chart::default()
    }
    .figure()
}

/// Figure 4: one weight of every subject against the motion parameter, the person's with its 95 % interval, and `made`,
/// weights synthesized at other parameters.
pub(super) fn against_parameter(model: &Model, style: &Style, i: usize, made: &[(f64, &DVector<f64>)]) -> Markup {
    let population = Population::new(model, i + 1);
    let s = scale(model, i);
    let (mut faint, mut dots) = (Vec::new(), Vec::new());
    for curve in &population.curves {
        let own = knots(model.members.iter().filter(|m| m.subject == curve.subject));
        let (Some(first), Some(last)) = (own.first(), own.last()) else { continue };
        let at = |p: f64| [p, curve.at(p)[i] / s];
        let points = (0..=20).map(|k| at(first.parameter + (last.parameter - first.parameter) * f64::from(k) / 20.0)).collect();
        if last.parameter - first.parameter > SAME_PARAMETER {
            faint.push(Curve { label: String::new(), points, dashed: false, colour: 6, band: Vec::new() });
        }
        dots.push(Dots { points: own.iter().map(|k| at(k.parameter)).collect(), colour: 6, radius: 2.0, ..Dots::default() });
    }
    if let Some(first) = dots.first_mut() {
        first.label = "subjects of the model".into();
    }
    let line: Vec<[f64; 2]> = made.iter().filter_map(|(p, w)| Some([*p, w.get(i)? / s])).collect();
    if !line.is_empty() {
        dots.push(Dots { label: "generated".into(), points: line, bars: Vec::new(), colour: 1, radius: 4.0 });
    }
    let person = [style.parameter, style.weights.get(i).copied().unwrap_or(0.0) / s];
    dots.push(Dots { label: "this person".into(), points: vec![person], bars: vec![BAND * sigma(style, i) / s], colour: INK, radius: 4.5 });
    let x_label = if model.activity.is_cyclic() { "speed (m/s)" } else { "length (m)" };
    Chart {
        title: format!("Weight {} against {}", i + 1, if model.activity.is_cyclic() { "speed" } else { "length" }),
        x_label: x_label.into(),
        y_label: "standard deviations of the database".into(),
        faint,
        dots,
        ..Chart::default()
    }
    .figure()
}

fn neighbours(style: &Style) -> Markup {
    let rows: Vec<Vec<String>> = style
        .neighbours
        .iter()
        .take(LISTED)
        .map(|n| {
            let inside = if n.inside { "yes" } else { "no" };
            let odds = n.log_odds.map_or("-".into(), |odds| format!("{odds:.1}"));
            vec![n.subject.clone(), format!("{:.3}", n.distance), format!("{:.3}", n.own_spread), inside.to_string(), odds]
        })
        .collect();
    html! {
        h3 { "Nearest subjects that move at this speed or length" }
        (table(&["subject", "distance (equation 6)", "the subject's own spread", "within it", "log odds against a stranger"], &rows, 1))
        @if let Some((subject, odds)) = style.likeliest() {
            p.soft {
                @if odds > 0.0 { "By the joints that footage shows this is rather " (subject) " than somebody who is not in the database." }
                @else { "By the joints that footage shows this is rather somebody who is not in the database; of its people " (subject) " is the likeliest." }
            }
        }
    }
}
