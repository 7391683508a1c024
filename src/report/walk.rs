//! Gait as a laboratory reads it: strides of the footage, the fitted person's whole cycle, their table and curves.

use maud::{Markup, html};

use super::chart::Chart;
use super::curves::Curve;
use super::page::{gallery, table};
use crate::body::Clip;
use crate::fit::Fit;
use crate::fit::whole_cycle::{LegAngles, leg_angles, steady};
use crate::io::gait_csv::{CycleAngles, SIDES};
use crate::motion_model::gait::{Gait, Line, Measure, PERCENTS, Stride, cycle_angles};
use crate::motion_model::{Activity, gait::gait};

/// Two standard deviations either way of a normal hold 95 %.
pub const BAND: f64 = 1.96;
/// Of the fitted person's steady walk.
const FPS: f64 = 100.0;
const CYCLES: f64 = 4.2;

/// What the footage shows of somebody's gait, and what the fit makes of it.
pub struct Walk {
    pub filmed: Gait,
    /// Angles of every stride seen: foot, its number, hip, knee and ankle.
    pub strides: Vec<(usize, Stride, [[f64; PERCENTS]; 3])>,
    pub cycle: Gait,
    /// Left and right.
    pub legs: [LegAngles; 2],
    /// Time of the clip's first frame in the footage, seconds.
    pub start_s: f64,
    pub walks: bool,
}

impl Walk {
    /// From a fit and its clip (y up, frames at a constant rate); `None` for jumps and for fits that stand still.
    pub fn of(fit: &Fit, clip: &Clip, activity: Activity, start_s: f64) -> Option<Walk> {
        let steady = steady(fit, FPS, CYCLES)?;
        let (filmed, cycle) = (gait(clip), gait(&steady));
        let strides = (0..2)
            .flat_map(|foot| filmed.feet[foot].strides.iter().map(move |s| (foot, *s)))
            .map(|(foot, stride)| (foot, stride, cycle_angles(clip, foot, &stride)))
            .collect();
        // The cycle's own strikes; half a cycle apart where it shows none.
        let strike = |foot: usize| cycle.feet[foot].strikes_s.first().map_or(if foot == 0 { 0.5 } else { 0.0 }, |s| s * fit.cadence_hz);
        let legs = [0, 1].map(|foot| leg_angles(fit, foot, strike(foot)));
        Some(Walk { filmed, strides, cycle, legs, start_s, walks: activity == Activity::Walking })
    }

    /// Tables of the footage and of the cycle; what is alike in every cycle has no spread.
    pub fn tables(&self) -> [(&'static str, Vec<Line>); 2] {
        let mut cycle = self.cycle.table(self.walks);
        for line in &mut cycle {
            line.sides.iter_mut().chain([&mut line.both]).flatten().for_each(|m| (m.sd, m.n) = (None, 1));
        }
        [("filmed", self.filmed.table(self.walks)), ("cycle", cycle)]
    }

    /// Curves for `angles_cycle.csv`.
    pub fn curves(&self) -> Vec<CycleAngles<'_>> {
        let cycles = [0, 1].map(|foot| CycleAngles::of_cycle(foot, &self.legs[foot]));
        let mut counts = [0, 0];
        let strides = self.strides.iter().map(|(foot, _, angles)| {
            counts[*foot] += 1;
            CycleAngles { source: format!("stride {}", counts[*foot]), foot: *foot, angles, sigmas: None }
        });
        cycles.into_iter().chain(strides).collect()
    }
}

/// The part of a page.
pub(super) fn section(walk: &Walk) -> Markup {
    let count = |foot: usize| walk.filmed.feet[foot].strides.len();
    let [(_, filmed), (_, cycle)] = walk.tables();
    html! {
        p {
            "Heel strikes and toe-offs after Zeni et al. (2008). The footage shows " (count(0)) " whole strides of the left and "
            (count(1)) " of the right foot. The fitted cycle is the same person going on steadily, so that both sides are whole however short the footage."
        }
        div.gallery.halves {
            div { h3 { "In the footage" } (lines(&filmed)) }
            div { h3 { "Of the fitted cycle" } (lines(&cycle)) }
        }
        p.small.soft { "Mean and, from two strides or steps on, standard deviation. Asymmetry: 100 (left - right) / mean. Shares are of the gait cycle." }
        (gallery(&[angles(walk, 0), angles(walk, 1), angles(walk, 2)]))
        (events(walk))
    }
}

pub(super) fn lines(lines: &[Line]) -> Markup {
    let percent = |line: &Line| if line.unit.starts_with("share") { 100.0 } else { 1.0 };
    let unit = |line: &Line| if percent(line) > 1.0 { "%".to_string() } else { line.unit.to_string() };
    let cell = |line: &Line, m: Option<Measure>| {
        let Some(m) = m else { return "\u{2013}".to_string() };
        let decimals = if percent(line) > 1.0 || line.unit == "steps/min" { 1 } else { 3 };
        let sd = m.sd.map_or(String::new(), |sd| format!(" ± {:.decimals$}", percent(line) * sd));
        format!("{:.decimals$}{sd}", percent(line) * m.mean)
    };
    let asymmetry = |line: &Line| match line.asymmetry_percent() {
        None => "\u{2013}".to_string(),
        Some(a) if a.abs() < 0.05 => "0.0 %".to_string(),
        Some(a) => format!("{a:+.1} %"),
    };
    let rows: Vec<Vec<String>> = lines
        .iter()
        .filter(|l| l.both.is_some())
        .map(|l| vec![l.name.to_string(), unit(l), cell(l, l.sides[0]), cell(l, l.sides[1]), asymmetry(l), cell(l, l.both)])
        .collect();
    if rows.is_empty() {
        return html! { p { "Too short for a step." } };
    }
    table(&["", "unit", "left", "right", "asymmetry", "both"], &rows, 2)
}

const NAMES: [&str; 3] = ["Hip flexion", "Knee flexion", "Ankle dorsiflexion"];

fn over_cycle(angles: &[f64; PERCENTS]) -> Vec<[f64; 2]> {
    angles.iter().enumerate().map(|(k, a)| [k as f64, a.to_degrees()]).collect()
}

/// One joint of both legs over the cycle.
fn angles(walk: &Walk, joint: usize) -> Markup {
    let curve = |foot: usize| Curve {
        label: format!("{} with 95 % band", SIDES[foot]),
        points: over_cycle(&walk.legs[foot].angles[joint]),
        dashed: false,
        colour: foot,
        band: walk.legs[foot].sigmas[joint].iter().map(|s| BAND * s.to_degrees()).collect(),
    };
    let stride = |(foot, _, angles): &(usize, Stride, [[f64; PERCENTS]; 3])| Curve {
        label: String::new(),
        points: over_cycle(&angles[joint]),
        dashed: false,
        colour: *foot,
        band: Vec::new(),
    };
    let toe_offs = (0..2).filter(|_| walk.walks).filter_map(|foot| {
        let stance = walk.cycle.table(true).iter().find(|l| l.name == "stance")?.sides[foot]?.mean;
        Some((100.0 * stance, foot))
    });
    Chart {
        title: NAMES[joint].into(),
        x_label: "gait cycle (%)".into(),
        y_label: "degrees".into(),
        x_range: Some([0.0, 100.0]),
        curves: vec![curve(0), curve(1)],
        faint: walk.strides.iter().map(stride).collect(),
        marks: toe_offs.collect(),
        caption: if walk.walks {
            "Fitted cycle with 95 % band; thin: strides of the footage; dotted: toe-off.".into()
        } else {
            "Fitted cycle with 95 % band; thin: strides of the footage.".into()
        },
        ..Chart::default()
    }
    .figure()
}

/// Times of strikes and toe-offs in the footage.
fn events(walk: &Walk) -> Markup {
    let times = |times: &[f64]| {
        let words: Vec<String> = times.iter().map(|t| format!("{:.2}", t + walk.start_s)).collect();
        if words.is_empty() { "\u{2013}".to_string() } else { words.join(", ") }
    };
    let rows: Vec<Vec<String>> = [0, 1]
        .map(|foot| vec![SIDES[foot].to_string(), times(&walk.filmed.feet[foot].strikes_s), times(&walk.filmed.feet[foot].toe_offs_s)])
        .to_vec();
    html! {
        h3 { "Events in the footage (s)" }
        (table(&["foot", "heel strikes", "toe-offs"], &rows, 3))
    }
}
