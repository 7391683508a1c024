//! The report of a model's leave-one-subject-out validation.

use maud::{Markup, html};

use super::chart::{Chart, Dots, INK};
use super::page::{Grade, Section, Verdict, facts, gallery, page, table};
use crate::motion_model::Model;
use crate::style::validate::{Score, Validation};

/// What every method and metric is, for readers of the page.
const METHODS: [(&str, &str); 8] = [
    ("default", "the style carried to the other speed or length as `generate` does it"),
    ("paper", "the style paper's equation (8)"),
    ("several", "the default from all the person's other speeds or lengths at once"),
    ("mean", "the population's mean at the target"),
    ("unchanged", "the person's own motion, unchanged"),
    ("mean-change", "the own motion plus the population's mean change"),
    ("intra", "cycles of one subject at one speed among themselves"),
    ("inter", "cycles of different subjects"),
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

/// Names in the order in which they come first.
fn names(scores: &[Score], of: fn(&Score) -> &str) -> Vec<&str> {
    scores.iter().fold(Vec::new(), |mut known, s| {
        if !known.contains(&of(s)) {
            known.push(of(s));
        }
        known
    })
}

impl ValidationReport<'_> {
    /// The whole page.
    pub fn html(&self) -> String {
        let scores = &self.validation.scores;
        let metrics = names(scores, |s| &s.metric);
        let charts: Vec<Markup> = metrics.iter().map(|metric| self.chart(metric)).collect();
        let sections = [
            Section::new("Errors", html! { (self.means(&metrics)) (gallery(&charts)) (methods(scores)) }),
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
        let words: Vec<String> = baselines.iter().map(|(name, value)| format!("{name} {value:.2}")).collect();
        let sentence = format!(
            "A left-out subject's motion at another speed or length is off by {ours:.2} degrees (r.m.s. over joints) with `{method}`; baselines: {}.",
            words.join(", ")
        );
        let mut notes: Vec<String> =
            better.iter().map(|b| format!("The baseline `{b}` is as good or better: this model's styles do not carry over.")).collect();
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

    fn means(&self, metrics: &[&str]) -> Markup {
        let cell = |method: &str, metric: &str| self.value(method, metric, "all").map_or("\u{2013}".into(), |v| format!("{v:.3}"));
        let rows: Vec<Vec<String>> = names(&self.validation.scores, |s| s.method)
            .into_iter()
            .map(|method| std::iter::once(method.to_string()).chain(metrics.iter().map(|metric| cell(method, metric))).collect())
            .collect();
        let head: Vec<&str> = std::iter::once("method").chain(metrics.iter().copied()).collect();
        html! {
            (table(&head, &rows, 1))
            p.small.soft {
                "Means over the left-out subjects, angles pooled; eq6 is the paper's distance of weights, mahalanobis the true one, rms_deg the angle and rms_mm the place of joints against the recording."
            }
        }
    }

    /// One dot per subject and method, the mean larger.
    fn chart(&self, metric: &str) -> Markup {
        let methods = names(&self.validation.scores, |s| s.method);
        let places = |all: bool| -> Vec<[f64; 2]> {
            let own = |(k, method): (usize, &&str)| {
                let scores = self.validation.scores.iter().filter(|s| s.method == *method && s.metric == metric);
                scores.filter(|s| (s.left_out == "all") == all).map(|s| [k as f64, s.value]).collect::<Vec<_>>()
            };
            methods.iter().enumerate().flat_map(own).collect()
        };
        let top = places(false).iter().chain(&places(true)).map(|p| p[1]).fold(0.0, f64::max);
        Chart {
            title: metric.into(),
            y_label: if metric == "rms_deg" {
                "degrees"
            } else if metric == "rms_mm" {
                "mm"
            } else {
                "distance"
            }
            .into(),
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
        let methods = names(&self.validation.scores, |s| s.method);
        let cell = |method: &str, subject: &str| self.value(method, "rms_deg", subject).map_or("\u{2013}".into(), |v| format!("{v:.2}"));
        let rows: Vec<Vec<String>> = self
            .model
            .subjects()
            .into_iter()
            .map(|subject| {
                let cycles = self.model.members.iter().filter(|m| m.subject == subject).count();
                [subject.to_string(), cycles.to_string()].into_iter().chain(methods.iter().map(|m| cell(m, subject))).collect()
            })
            .collect();
        let head: Vec<&str> = ["left out", "cycles"].into_iter().chain(methods.iter().copied()).collect();
        html! { p.soft { "rms_deg, degrees" } (table(&head, &rows, 1)) }
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
                ("cases", format!("{}, in {} of them too few other subjects were recorded at both ends", v.cases, v.sparse_cases)),
                ("version", concat!("muybridge ", env!("CARGO_PKG_VERSION")).to_string()),
            ]))
            p.small.soft { "Numbers beside this page: validation.csv, of every angle degrees.csv, of every pair of parameters pairs.csv." }
        }
    }
}

fn methods(scores: &[Score]) -> Markup {
    let present = names(scores, |s| s.method);
    let rows: Vec<(&str, String)> =
        METHODS.iter().filter(|m| present.contains(&m.0)).map(|(name, what)| (*name, what.to_string())).collect();
    facts(&rows)
}
