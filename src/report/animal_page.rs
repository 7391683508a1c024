//! The report of an animal's clip: whether it is usable, and the figures of all stages.

use maud::{Markup, html};

use super::chart::Chart;
use super::curves::Curve;
use super::page::{Grade, Section, Verdict, facts, gallery, page, picture, png_file_uri};
use crate::animal::rhythm;
use crate::io::animal_json::AnalysisRecord;

/// Components whose coefficients are drawn.
const DRAWN: usize = 3;

/// What the stages left.
pub struct AnimalReport<'a> {
    pub title: &'a str,
    pub analysis: Option<&'a AnalysisRecord>,
    /// What the stages said, as they print it.
    pub analysis_text: &'a str,
    pub keys_text: &'a str,
    /// Captions and the bytes of PNG files.
    pub pictures: &'a [(&'a str, Vec<u8>)],
    /// Options and inputs by name.
    pub facts: &'a [(&'a str, String)],
}

impl AnimalReport<'_> {
    /// The whole page.
    pub fn html(&self) -> String {
        let pictures: Vec<Markup> = self.pictures.iter().map(|(caption, png)| picture(&png_file_uri(png), caption)).collect();
        let mut sections = vec![Section::new("Pictures", html! { div.gallery.wide { @for p in &pictures { (p) } } })];
        if let Some(record) = self.analysis {
            sections
                .push(Section::new("Rhythm", html! { (gallery(&[coefficients(record), explained(record)])) pre { (self.analysis_text) } }));
        }
        if !self.keys_text.is_empty() {
            sections.push(Section::new("Key images", html! { pre { (self.keys_text) } }));
        }
        sections.push(Section::new("What was done", self.what()));
        page("muybridge animal run", self.title, &self.verdict(), &sections)
    }

    fn verdict(&self) -> Verdict {
        let Some(record) = self.analysis else {
            return Verdict { grade: Grade::Failed, sentence: "The clip was not analysed.".into(), notes: Vec::new() };
        };
        let rhythm = &record.rhythm;
        let grade = match rhythm.verdict {
            rhythm::Verdict::Usable => Grade::Good,
            rhythm::Verdict::Sketch => Grade::Look,
            rhythm::Verdict::NotUsable => Grade::Failed,
        };
        let sentence = match rhythm.period_frames {
            Some(period) => format!(
                "{}: a silhouette every {period:.1} frames ({:.2} Hz) over {} frames.",
                rhythm.verdict.words(),
                record.fps / period,
                record.coefficients.len()
            ),
            None => format!("{}: no rhythm in {} frames.", rhythm.verdict.words(), record.coefficients.len()),
        };
        Verdict { grade, sentence, notes: rhythm.reasons.clone() }
    }

    fn what(&self) -> Markup {
        let mut rows: Vec<(&str, String)> = self.facts.to_vec();
        if let Some(record) = self.analysis {
            rows.push(("frames", format!("{} from {}, {} frames/s", record.coefficients.len(), record.first_frame, record.fps)));
            rows.push(("window", format!("{} x {} px", record.window_px[0], record.window_px[1])));
            rows.push(("band-pass", if record.filter { "on" } else { "off" }.to_string()));
            rows.push(("trend taken away", format!("degree {}", record.trend_degree)));
        }
        rows.push(("version", concat!("muybridge ", env!("CARGO_PKG_VERSION")).to_string()));
        facts(&rows)
    }
}

fn coefficients(record: &AnalysisRecord) -> Markup {
    let curve = |k: usize| Curve {
        label: format!("PC{}", k + 1),
        points: record
            .coefficients
            .iter()
            .enumerate()
            .map(|(t, row)| [(record.first_frame + t) as f64 / record.fps, row.get(k).copied().unwrap_or(f64::NAN)])
            .collect(),
        dashed: false,
        colour: k,
        band: Vec::new(),
    };
    Chart {
        title: "Coefficients of the silhouettes".into(),
        x_label: "time (s)".into(),
        y_label: "standard deviations".into(),
        curves: (0..DRAWN.min(record.explained.len())).map(curve).collect(),
        ..Chart::default()
    }
    .figure()
}

fn explained(record: &AnalysisRecord) -> Markup {
    let shares = || record.explained.iter().enumerate();
    let sum = shares().scan(0.0, |sum, (k, share)| {
        *sum += 100.0 * share;
        Some([(k + 1) as f64, *sum])
    });
    let curve = |label: &str, points: Vec<[f64; 2]>, colour: usize, dashed: bool| Curve {
        label: label.into(),
        points,
        dashed,
        colour,
        band: Vec::new(),
    };
    Chart {
        title: "Variance of the silhouettes".into(),
        x_label: "component".into(),
        y_label: "% of the variance".into(),
        y_range: Some([0.0, 100.0]),
        ticks: shares().map(|(k, _)| ((k + 1) as f64, (k + 1).to_string())).collect(),
        curves: vec![
            curve("of the component", shares().map(|(k, s)| [(k + 1) as f64, 100.0 * s]).collect(), 0, false),
            curve("of all up to it", sum.collect(), 6, true),
        ],
        ..Chart::default()
    }
    .figure()
}
