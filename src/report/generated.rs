//! The report of generated motions: the same person at other speeds or lengths.

use maud::{Markup, html};
use nalgebra::DVector;

use super::chart::Chart;
use super::curves::Curve;
use super::page::{Grade, Section, Verdict, facts, gallery, page, picture, png_uri, table};
use super::style_charts::{against_parameter, clusters};
use super::{ReportError, stick_figures};
use crate::body::Clip;
use crate::motion::Synthesis;
use crate::motion_model::gait::{Gait, Measure, PERCENTS, cycle_angles, gait};
use crate::motion_model::{Activity, Model};
use crate::style::Style;

/// Figures of one row of the chronophotograph, over this time.
const FIGURES: usize = 7;
const SECONDS: f64 = 1.5;
/// Weights that are drawn against the parameter.
const DRAWN: usize = 4;

/// One generated motion.
pub struct Made<'a> {
    pub file: &'a str,
    pub synthesis: &'a Synthesis,
    pub clip: &'a Clip,
}

/// What was made of whom with what.
pub struct GeneratedReport<'a> {
    pub model: &'a Model,
    pub model_name: &'a str,
    pub style: &'a Style,
    pub style_name: &'a str,
    pub made: Vec<Made<'a>>,
    /// Options by name.
    pub options: &'a [(&'a str, String)],
}

impl GeneratedReport<'_> {
    fn unit(&self) -> &'static str {
        if self.model.activity.is_cyclic() { "m/s" } else { "m" }
    }

    /// The whole page.
    pub fn html(&self) -> Result<String, ReportError> {
        let gaits: Vec<Gait> = self.made.iter().map(|m| gait(m.clip)).collect();
        let mut sections = vec![Section::new(
            "Motions",
            html! { (self.table()) (picture(&png_uri(&self.figures()?)?, "The motions from the subject's right, to one scale; early instants pale.")) },
        )];
        if self.model.activity.is_cyclic() {
            sections.push(Section::new("Gait", self.gait(&gaits)));
        }
        sections.push(Section::new("Style", self.style_charts()));
        sections.push(Section::new("What was done", self.facts()));
        Ok(page("muybridge generate", self.style_name, &self.verdict(), &sections))
    }

    fn verdict(&self) -> Verdict {
        let values: Vec<String> = self.made.iter().map(|m| format!("{:.2}", m.synthesis.parameter)).collect();
        let sentence = format!(
            "{} at {} {}; the person was seen at {:.2} {}.",
            self.model.activity,
            values.join(", "),
            self.unit(),
            self.style.parameter,
            self.unit()
        );
        let mut notes: Vec<String> =
            self.made.iter().filter_map(|m| Some(format!("{}: {}", m.file, m.synthesis.notice.as_ref()?))).collect();
        if self.model.synthetic {
            notes.push("The model is synthetic.".into());
        }
        Verdict { grade: if notes.is_empty() { Grade::Good } else { Grade::Look }, sentence, notes }
    }

    fn table(&self) -> Markup {
        let row = |m: &Made| {
            let s = m.synthesis;
            let nearest = s.shares.iter().max_by(|a, b| a.1.total_cmp(&b.1));
            let nearest = nearest.map_or("\u{2013}".to_string(), |(subject, share)| format!("{subject} ({:.0} %)", 100.0 * share));
            vec![
                m.file.to_string(),
                nearest,
                format!("{:.3}", s.parameter),
                format!("{:.3}", s.frequency_hz),
                s.angle_sd().map_or("\u{2013}".into(), |sd| format!("{:.2}", sd.to_degrees())),
                m.clip.poses.len().to_string(),
            ]
        };
        let rows: Vec<Vec<String>> = self.made.iter().map(row).collect();
        let parameter = format!("{} ({})", if self.model.activity.is_cyclic() { "speed" } else { "length" }, self.unit());
        table(&["file", "subject that counts most", &parameter, "cycles/s", "angles' standard deviation (deg)", "frames"], &rows, 2)
    }

    fn figures(&self) -> Result<image::RgbImage, ReportError> {
        let short = |clip: &Clip| {
            let count = ((SECONDS * clip.fps) as usize + 1).min(clip.poses.len());
            Clip { poses: clip.poses[..count].to_vec(), ..clip.clone() }
        };
        let clips: Vec<(String, Clip)> =
            self.made.iter().map(|m| (format!("{:.2} {}", m.synthesis.parameter, self.unit()), short(m.clip))).collect();
        let labelled: Vec<(String, &Clip)> = clips.iter().map(|(label, clip)| (label.clone(), clip)).collect();
        stick_figures(&labelled, FIGURES)
    }

    /// Table over the motions, and the right leg's angles.
    fn gait(&self, gaits: &[Gait]) -> Markup {
        let tables: Vec<_> = gaits.iter().map(|g| g.table(self.model.activity == Activity::Walking)).collect();
        let cell = |m: Option<Measure>, unit: &str| {
            m.map_or(
                "\u{2013}".into(),
                |m| if unit.starts_with("share") { format!("{:.1}", 100.0 * m.mean) } else { format!("{:.3}", m.mean) },
            )
        };
        let rows: Vec<Vec<String>> = (0..tables.first().map_or(0, Vec::len))
            .map(|k| {
                let line = &tables[0][k];
                let unit = if line.unit.starts_with("share") { "%" } else { line.unit };
                [line.name.to_string(), unit.to_string()].into_iter().chain(tables.iter().map(|t| cell(t[k].both, t[k].unit))).collect()
            })
            .collect();
        let labels: Vec<String> = self.made.iter().map(|m| format!("{:.2} {}", m.synthesis.parameter, self.unit())).collect();
        let head: Vec<&str> = ["", "unit"].into_iter().chain(labels.iter().map(String::as_str)).collect();
        let charts =
            ["Hip flexion", "Knee flexion", "Ankle dorsiflexion"].iter().enumerate().map(|(j, name)| self.angles(gaits, &labels, j, name));
        html! {
            (table(&head, &rows, 2))
            (gallery(&charts.collect::<Vec<_>>()))
        }
    }

    fn angles(&self, gaits: &[Gait], labels: &[String], joint: usize, name: &str) -> Markup {
        let curve = |k: usize| {
            let stride = gaits[k].feet[1].strides.first()?;
            let angles = cycle_angles(self.made[k].clip, 1, stride)[joint];
            let points = (0..PERCENTS).map(|i| [i as f64, angles[i].to_degrees()]).collect();
            Some(Curve { label: labels[k].clone(), points, dashed: k >= 7, colour: k % 7, band: Vec::new() })
        };
        Chart {
            title: format!("{name}, right"),
            x_label: "gait cycle (%)".into(),
            y_label: "degrees".into(),
            x_range: Some([0.0, 100.0]),
            curves: (0..self.made.len()).filter_map(curve).collect(),
            ..Chart::default()
        }
        .figure()
    }

    fn style_charts(&self) -> Markup {
        let made: Vec<(f64, &DVector<f64>)> = self.made.iter().map(|m| (m.synthesis.parameter, &m.synthesis.weights)).collect();
        let mut figures: Vec<Markup> =
            (0..DRAWN.min(self.style.weights.len())).map(|i| against_parameter(self.model, self.style, i, &made)).collect();
        figures.push(clusters(self.model, self.style));
        gallery(&figures)
    }

    fn facts(&self) -> Markup {
        let (model, style) = (self.model, self.style);
        let mut rows = vec![
            ("style", self.style_name.to_string()),
            ("seen at", format!("{:.3} {}, hip joints at {:.3} m", style.parameter, self.unit(), style.hip_height_m)),
            (
                "model",
                format!("{}: {}, {} cycles of {} subjects", self.model_name, model.activity, model.members.len(), model.subjects().len()),
            ),
            ("model's hash", style.model_hash.clone()),
        ];
        rows.extend(self.options.iter().cloned());
        rows.push(("version", concat!("muybridge ", env!("CARGO_PKG_VERSION")).to_string()));
        html! {
            (facts(&rows))
            p.small.soft { "Numbers beside this page: generated.csv." }
        }
    }
}
