//! Strips of superposed stick figures, as in the style paper's Figures 3, 5, 6, 7, 9, 12 and 13: one row per speed or length,
//! figures at even phases side by side, from the subject's right or its front right, walking to the right, another motion (what
//! was recorded, or the nearest person of the database) pale below what was made. Figures 2 to 4 of the vector-space paper are such strips too.
//!
//! Every figure stands on the row's floor with its root at the middle of its place, so that rows compare posture against
//! posture at the same phase, whatever the speed.

use nalgebra::Vector3;

use super::ReportError;
use super::canvas::{Align, Colour, GRID, INK, LEFT, Pen, RIGHT, skeleton_marks, text_width_px};
use super::figures::forward;
use super::marks::{Drawing, Mark};
use crate::body::{Clip, NODES};

const PX_PER_M: f64 = 130.0;
/// Least width of the labels' column.
const LABEL_PX: f64 = 200.0;
const HEAD_PX: f64 = 44.0;
/// Angle between the view and the walking direction, radians.
pub const FROM_THE_SIDE: f64 = std::f64::consts::FRAC_PI_2;
/// Both hands show.
pub const FROM_THE_FRONT_RIGHT: f64 = 0.9;
/// Of what was recorded.
const UNDER: Colour = [150, 160, 175];

/// A motion and the time that one cycle, or the whole jump, takes from its start.
#[derive(Clone, Copy)]
pub struct Phases<'a> {
    pub clip: &'a Clip,
    pub cycle_s: f64,
}

/// One row.
pub struct Strip<'a> {
    pub label: String,
    pub made: Phases<'a>,
    /// Another motion, drawn pale below.
    pub below: Option<Phases<'a>>,
    /// Gaits come round to phase 0, jumps end at phase 1.
    pub cyclic: bool,
}

/// Node positions as (right of the root as seen, height) in metres.
type Figure = [[f64; 2]; NODES];

/// The rows with `figures` instants each, seen at the angle `view`; y-up worlds. `below` says what is drawn pale.
pub fn strips(rows: &[Strip], figures: usize, view: f64, below: &str) -> Result<Drawing, ReportError> {
    let figures = figures.max(2);
    let all: Vec<(Vec<Figure>, Vec<Figure>)> = rows
        .iter()
        .map(|row| {
            let made = instants(&row.made, figures, row.cyclic, view);
            (made, row.below.map_or(Vec::new(), |below| instants(&below, figures, row.cyclic, view)))
        })
        .collect();
    let points = || all.iter().flat_map(|(made, recorded)| made.iter().chain(recorded)).flatten();
    let reach = points().map(|p| p[0].abs()).fold(0.3, f64::max);
    // The head's circle stands above its joint.
    let tall = points().map(|p| p[1]).fold(1.0, f64::max) + 0.17;
    let mut label_px = LABEL_PX;
    for row in rows {
        label_px = label_px.max(text_width_px(&row.label, 12.0)? + 34.0);
    }
    let place_px = 1.75 * reach * PX_PER_M;
    let row_px = tall * PX_PER_M + 26.0;
    let size = [label_px + figures as f64 * place_px + 20.0, HEAD_PX + rows.len() as f64 * row_px + 34.0];
    let mut marks = legend(rows.iter().any(|r| r.below.is_some()).then_some(below), label_px);
    for (i, (row, (made, recorded))) in rows.iter().zip(&all).enumerate() {
        let floor_px = HEAD_PX + (i + 1) as f64 * row_px - 12.0;
        marks.push(Mark::Line { from: [label_px, floor_px], to: [size[0] - 16.0, floor_px], colour: GRID, width_px: 2 });
        let label =
            Mark::Text { at: [14.0, floor_px - 0.5 * row_px], text: row.label.clone(), capital_px: 12.0, colour: INK, align: Align::Left };
        marks.push(label);
        let place = |figure: &Figure, k: usize| {
            let middle = label_px + (k as f64 + 0.5) * place_px;
            figure.map(|p| Some([middle + p[0] * PX_PER_M, floor_px - p[1] * PX_PER_M]))
        };
        let made_pen = Pen { width_px: 2, middle: INK, fade: 0.0, rim: None };
        for (k, figure) in recorded.iter().enumerate() {
            let mut pale = skeleton_marks(&place(figure, k), &Pen { width_px: 6, middle: UNDER, fade: 0.35, rim: None });
            pale.iter_mut().for_each(|mark| tint(mark, UNDER));
            marks.extend(pale);
        }
        marks.extend(made.iter().enumerate().flat_map(|(k, figure)| skeleton_marks(&place(figure, k), &made_pen)));
    }
    let under = size[1] - 14.0;
    let cyclic = rows.iter().all(|r| r.cyclic);
    marks.push(Mark::Text { at: [14.0, under], text: "phase".into(), capital_px: 9.0, colour: INK, align: Align::Left });
    for k in 0..figures {
        let at = [label_px + (k as f64 + 0.5) * place_px, under];
        let text = format!("{:.0} %", 100.0 * phase(k, figures, cyclic));
        marks.push(Mark::Text { at, text, capital_px: 9.0, colour: INK, align: Align::Centre });
    }
    Ok(Drawing { size_px: size.map(|s| s.ceil() as u32), marks })
}

/// Instants of a gait share its cycle out, those of a jump include both ends.
fn phase(k: usize, figures: usize, cyclic: bool) -> f64 {
    k as f64 / if cyclic { figures } else { figures - 1 } as f64
}

fn tint(mark: &mut Mark, with: Colour) {
    if let Mark::Line { colour, .. } | Mark::Disc { colour, .. } | Mark::Circle { colour, .. } = mark {
        *colour = super::canvas::faded(with, 0.35);
    }
}

fn instants(motion: &Phases, figures: usize, cyclic: bool, view: f64) -> Vec<Figure> {
    let Phases { clip, cycle_s } = motion;
    let forward = forward(clip);
    let right_in_view = forward * view.sin() + Vector3::y().cross(&forward) * view.cos();
    let at = |k: usize| {
        let frame = (phase(k, figures, cyclic) * cycle_s * clip.fps).clamp(0.0, clip.poses.len().saturating_sub(1) as f64);
        let before = clip.poses.get(frame as usize)?;
        let after = clip.poses.get(frame as usize + 1).unwrap_or(before);
        let placed = clip.place(&before.towards(after, frame.fract()));
        let root = placed.positions[0];
        Some(placed.positions.map(|x| [(x - root).dot(&right_in_view), x.y]))
    };
    (0..figures).filter_map(at).collect()
}

fn legend(below: Option<&str>, label_px: f64) -> Vec<Mark> {
    let mut entries = vec![("left", LEFT, 3), ("right", RIGHT, 3)];
    if let Some(name) = below {
        entries.push((name, super::canvas::faded(UNDER, 0.35), 6));
    }
    let entry = |(k, (name, colour, width_px)): (usize, (&str, Colour, i32))| {
        let x = label_px + 120.0 * k as f64;
        [
            Mark::Line { from: [x, 22.0], to: [x + 28.0, 22.0], colour, width_px },
            Mark::Text { at: [x + 36.0, 27.0], text: name.into(), capital_px: 10.0, colour: INK, align: Align::Left },
        ]
    };
    entries.into_iter().enumerate().flat_map(entry).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::{Joint, Shape};
    use crate::motion::{Length, play_cycle};
    use crate::motion_model::{Activity, synthetic};

    fn walk(speed_m_s: f64) -> (Clip, f64) {
        let cycle = synthetic::subject(Activity::Walking, 3).cycle(speed_m_s, 0);
        (play_cycle(&cycle, &Shape::template(1.7).offsets(), 120.0, Length::Cycles(1)), cycle.duration_s)
    }

    #[test]
    fn figures_stand_at_even_phases_over_the_recording() {
        let [(slow, slow_s), (fast, fast_s)] = [1.0, 1.7].map(walk);
        let [made, recorded] = [Phases { clip: &fast, cycle_s: fast_s }, Phases { clip: &slow, cycle_s: slow_s }];
        let rows = [
            Strip { label: "1.70 m/s".into(), made, below: Some(made), cyclic: true },
            Strip { label: "1.00 m/s".into(), made: recorded, below: None, cyclic: true },
        ];
        let drawing = strips(&rows, 8, FROM_THE_SIDE, "recorded").unwrap();
        // The recording is the motion itself: every bone lies on a pale one, eight figures of 26 bones in each of the three.
        let lines = |width: i32| -> Vec<([f64; 2], [f64; 2])> {
            let bone = |mark: &Mark| match mark {
                Mark::Line { from, to, width_px, colour } if *width_px == width && *colour != GRID => Some((*from, *to)),
                _ => None,
            };
            drawing.marks.iter().filter_map(bone).filter(|(from, _)| from[1] > HEAD_PX).collect()
        };
        let (pale, strong) = (lines(6), lines(2));
        assert_eq!((pale.len(), strong.len()), (8 * 26, 2 * 8 * 26));
        assert_eq!(pale[..], strong[..8 * 26]);
        // The left heel strikes half a cycle after the right one: at phase 0 the right ankle leads, at 4/8 the left.
        let ahead = |k: usize, joint: Joint| instants(&made, 8, true, FROM_THE_SIDE)[k][joint as usize][0];
        assert!(ahead(0, Joint::RAnkle) > 0.2 && ahead(4, Joint::LAnkle) > 0.2 && ahead(0, Joint::LAnkle) < -0.2);
        let picture = drawing.picture().unwrap();
        assert_eq!([picture.width(), picture.height()], drawing.size_px);
        assert!(drawing.svg().contains(">1.70 m/s</text>") && drawing.svg().contains(">88 %</text>"));
        assert!(drawing.svg().contains(">recorded</text>"));
        assert!(strips(&[], 5, FROM_THE_SIDE, "").unwrap().picture().is_ok());
    }
}
