//! The report of a model's leave-one-subject-out validation.

use maud::{Markup, html};

use super::chart::{Chart, Dots, INK};
use super::page::{Grade, Section, Verdict, facts, gallery, page, table};
use crate::motion_model::Model;
use crate::style::validate::{Score, Validation};

/// What every method is, for readers of the page.
const METHODS: [(&str, &str); 8] = [
    ("default", "the style carried to the other speed or length, as generate does it"),
    ("paper", "the style paper's equation (8)"),
    ("several", "the default from all the person's other speeds or lengths at once"),
    ("mean", "the population's mean at the target"),
    ("unchanged", "the person's own motion unchanged"),
    ("mean-change", "the own motion plus the population's mean change"),
    ("intra", "cycles of one subject at one speed among themselves"),
    ("inter", "cycles of different subjects"),
];

/// What the errors are measured by, in the order of the page.
struct Metric {
    name: &'static str,
    title: &'static str,
    column: &'static str,
    unit: &'static str,
    decimals: usize,
}

const METRICS: [Metric; 4] = [
    Metric { name: "rms_deg", title: "Joint angles, r.m.s.", column: "angles, deg", unit: "degrees", decimals: 2 },
    Metric { name: "rms_mm", title: "Joints' places, r.m.s.", column: "joints, mm", unit: "mm", decimals: 1 },
    Metric { name: "eq6", title: "Weights, equation (6)", column: "eq. (6)", unit: "distance", decimals: 2 },
    Metric { name: "mahalanobis", title: "Weights, Mahalanobis", column: "Mahalanobis", unit: "distance", decimals: 2 },
];

/// A validated model.
pub struct ValidationReport<'a> {
    pub model: &'a Model,
    /// The model's file, as given.
    pub name: &'a str,
    pub hash: &'a str,
    /// Part of the variance that the rebuilt models keep.
    pub variance: f64,
    pub validation: &'a Validation,
}

/// Methods in the order in which they come first.
fn methods(scores: &[Score]) -> Vec<&'static str> {
    scores.iter().fold(Vec::new(), |mut known, s| {
        if !known.contains(&s.method) {
            known.push(s.method);
        }
        known
    })
}

fn meaning(method: &str) -> &'static str {
    METHODS.iter().find(|m| m.0 == method).map_or("", |m| m.1)
}

impl ValidationReport<'_> {
    /// The whole page.
    pub fn html(&self) -> String {
        let charts: Vec<Markup> = METRICS.iter().map(|metric| self.chart(metric)).collect();
        let sections = [
            Section::new("Errors", html! { (self.means()) (gallery(&charts)) }),
            Section::new("By subject", self.subjects()),
            Section::new("What was done", self.facts()),
        ];
        page("muybridge model validate", self.name, &self.verdict(), &sections)
    }

    fn value(&self, method: &str, metric: &str, left_out: &str) -> Option<f64> {
        let of = |s: &&Score| s.method == method && s.metric == metric && s.left_out == left_out;
        self.validation.scores.iter().find(of).map(|s| s.value)
    }

    fn verdict(&self) -> Verdict {
        let method = if self.value("default", "rms_deg", "all").is_some() { "default" } else { "paper" };
        let error = |method: &str| self.value(method, "rms_deg", "all").unwrap_or(f64::NAN);
        let baselines = ["mean", "unchanged", "mean-change"].map(|b| (b, error(b)));
        let ours = error(method);
        let better: Vec<&str> = baselines.iter().filter(|b| b.1 <= ours).map(|b| b.0).collect();
        let words: Vec<String> = baselines.iter().map(|(name, value)| format!("{value:.2} for {}", meaning(name))).collect();
        let sentence = format!(
            "The motion of somebody who is not in the database is off by {ours:.2} degrees (r.m.s. over the joints) at another speed or length; {}.",
            words.join(", ")
        );
        let mut notes: Vec<String> =
            better.iter().map(|b| format!("As good or better is {}: this model's styles do not carry over.", meaning(b))).collect();
        if self.model.synthetic {
            notes.push("The model is synthetic: these figures say nothing about people.".into());
        }
        let grade = if !ours.is_finite() {
            Grade::Failed
        } else if notes.is_empty() {
            Grade::Good
        } else {
            Grade::Look
        };
        Verdict { grade, sentence, notes }
    }

    fn means(&self) -> Markup {
        let cell = |method: &str, metric: &Metric| self.cell(method, metric, "all");
        let rows: Vec<Vec<String>> = methods(&self.validation.scores)
            .into_iter()
            .map(|method| {
                [method, meaning(method)].map(String::from).into_iter().chain(METRICS.iter().map(|metric| cell(method, metric))).collect()
            })
            .collect();
        let head: Vec<&str> = ["method", ""].into_iter().chain(METRICS.iter().map(|metric| metric.column)).collect();
        html! {
            (table(&head, &rows, 2))
            p.small.soft {
                "Means over the left-out subjects against their recordings, angles pooled; eq. (6) is the paper's distance of weights, Mahalanobis the one that their covariance gives."
            }
        }
    }

    fn cell(&self, method: &str, metric: &Metric, left_out: &str) -> String {
        self.value(method, metric.name, left_out).map_or("\u{2013}".into(), |v| format!("{v:.*}", metric.decimals))
    }

    /// One dot per subject and method, the mean larger.
    fn chart(&self, metric: &Metric) -> Markup {
        let methods = methods(&self.validation.scores);
        let places = |all: bool| -> Vec<[f64; 2]> {
            let own = |(k, method): (usize, &&str)| {
                let scores = self.validation.scores.iter().filter(|s| s.method == *method && s.metric == metric.name);
                scores.filter(|s| (s.left_out == "all") == all).map(|s| [k as f64, s.value]).collect::<Vec<_>>()
            };
            methods.iter().enumerate().flat_map(own).collect()
        };
        let top = places(false).iter().chain(&places(true)).map(|p| p[1]).fold(0.0, f64::max);
        Chart {
            title: metric.title.into(),
            y_label: metric.unit.into(),
            x_range: Some([-0.5, methods.len() as f64 - 0.5]),
            y_range: Some([0.0, 1.06 * top.max(1e-9)]),
            dots: vec![
                Dots { label: "left-out subject".into(), points: places(false), colour: 0, radius: 2.6, ..Dots::default() },
                Dots { label: "all".into(), points: places(true), colour: INK, radius: 5.0, ..Dots::default() },
            ],
            ticks: methods.iter().enumerate().map(|(k, m)| (k as f64, m.to_string())).collect(),
            ..Chart::default()
        }
        .figure()
    }

    fn subjects(&self) -> Markup {
        let methods = methods(&self.validation.scores);
        let rows: Vec<Vec<String>> = self
            .model
            .subjects()
            .into_iter()
            .map(|subject| {
                let cycles = self.model.members.iter().filter(|m| m.subject == subject).count();
                [subject.to_string(), cycles.to_string()]
                    .into_iter()
                    .chain(methods.iter().map(|m| self.cell(m, &METRICS[0], subject)))
                    .collect()
            })
            .collect();
        let head: Vec<&str> = ["left out", "cycles"].into_iter().chain(methods.iter().copied()).collect();
        html! { p.soft { "Joint angles, r.m.s., degrees" } (table(&head, &rows, 1)) }
    }

    fn facts(&self) -> Markup {
        let (model, v) = (self.model, self.validation);
        let (low, high) = model.parameter_range();
        let unit = if model.activity.is_cyclic() { "m/s" } else { "m" };
        html! {
            (facts(&[
                ("model", self.name.to_string()),
                ("model's hash", self.hash.to_string()),
                ("database", format!("{}, {} cycles of {} subjects, {low:.2} to {high:.2} {unit}", model.activity, model.members.len(), model.subjects().len())),
                ("variance kept", format!("{}", self.variance)),
                ("cases", match v.sparse_cases {
                    0 => v.cases.to_string(),
                    few => format!("{}, in {few} of them too few other subjects were recorded at both ends", v.cases),
                }),
                ("version", concat!("muybridge ", env!("CARGO_PKG_VERSION")).to_string()),
            ]))
            p.small.soft { "Numbers beside this page: validation.csv, of every angle degrees.csv, of every pair of parameters pairs.csv." }
        }
    }
}
