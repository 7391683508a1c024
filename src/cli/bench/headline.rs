//! `muybridge bench headline`: the style paper's claim on recorded people (its Figures 12 and 13).
//!
//! A person recorded at several speeds is taken out of the database. The phantom films one of the recordings before its own
//! rig, the footage is tracked with the model of the others, and the tracked motion is made to go at the person's other
//! speeds. Errors against what was recorded there, beside those of the same methods from the recorded motion itself:
//! `default`, `paper` (equations 6 to 8) and `unchanged`, the motion as it was filmed.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use clap::Args;
use muybridge::body::{Pose, Shape};
use muybridge::fit::{self, Fit, FitOptions};
use muybridge::io::manifest::{Entry, find_motions};
use muybridge::io::session::Session;
use muybridge::io::style_json::write_style;
use muybridge::io::{calib_toml, read_clip, write_atomic};
use muybridge::motion::{Length, play, synthesize};
use muybridge::motion_model::{Activity, Cycle, Detail, Member, Model, overground};
use muybridge::phantom::{Scene, SightOptions, Stage, staging};
use muybridge::rig::Rig;
use muybridge::style::curves::{SAME_PARAMETER, knots, mean_root, mean_vector};
use muybridge::style::errors::{Errors, Ruler};
use muybridge::style::{Method, Metric, Population, Style};

use super::super::interrupt;
use super::super::model::default_variance;
use super::super::motions::{ActivityName, file_name, read_recordings};
use super::super::outputs::{Made, Rows, own_cycle, same};
use super::super::render::{Take, write_session};
use super::super::track::{self, NamedModel};
use super::takes::observe;

const RIG: &str = include_str!("../../../calib/phantom_lab.toml");
const METHODS: [&str; 3] = ["default", "paper", "unchanged"];
/// Figures of a strip's row, frames per second of the motions.
const FIGURES: usize = 9;
const MADE_FPS: f64 = 60.0;

#[derive(Args)]
pub struct HeadlineArgs {
    /// Motion files of several people at several speeds each, or folders
    #[arg(required = true)]
    mocap: Vec<PathBuf>,
    #[arg(long, default_value = "walking")]
    activity: ActivityName,
    /// Person to film and to leave out of the model; repeat for several
    #[arg(long, required = true)]
    subject: Vec<String>,
    /// Speed of the recording to film, m/s; the slowest without it
    #[arg(long, value_parser = super::super::positive)]
    at: Option<f64>,
    /// Frames per second of the footage
    #[arg(long, default_value_t = 60.0, value_parser = super::super::positive)]
    fps: f64,
    /// Points and outlines with the errors of stereo in place of pictures, in a tenth of the time
    #[arg(long)]
    sighted: bool,
    /// Components of the model that the fit uses
    #[arg(long, default_value_t = FitOptions::default().components)]
    components: usize,
    /// Folder for headline.csv and for each person the footage, what was tracked, style.json, the strips and angles.csv
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
}

/// One person out of the database.
struct Person<'a> {
    name: &'a str,
    /// Mean recorded cycles by speed, relative to the model of the others.
    recorded: Vec<Cycle>,
    /// Cycles at the speed that is filmed.
    seen: Vec<Cycle>,
    entry: &'a Entry,
    others: NamedModel,
}

/// One number of the table.
struct Score {
    at_m_s: f64,
    from: &'static str,
    method: &'static str,
    errors: Errors,
}

pub fn run(args: &HeadlineArgs) -> Result<()> {
    let entries = find_motions(&args.mocap, None)?;
    let cycles = read_recordings(&entries, args.activity.into()).cycles;
    let mut csv = String::from("subject,filmed_m_s,at_m_s,from,method,deg,mm\n");
    let mut all: Vec<Score> = Vec::new();
    for name in &args.subject {
        interrupt::check()?;
        let person = Person::new(args, &entries, &cycles, name)?;
        let scores = person.scores(args)?;
        print!("{}", table(&scores));
        for s in &scores {
            let (deg, mm) = (s.errors.angle_rad.to_degrees(), 1e3 * s.errors.position_m);
            writeln!(csv, "{name},{:.3},{:.3},{},{},{deg:.3},{mm:.2}", person.filmed(), s.at_m_s, s.from, s.method)?;
        }
        all.extend(scores.into_iter().filter(|s| (s.at_m_s - person.filmed()).abs() > SAME_PARAMETER));
    }
    println!("root mean square over all other speeds");
    print!("{}", pooled(&all));
    let path = args.output.join("headline.csv");
    write_atomic(&path, csv.as_bytes()).with_context(|| path.display().to_string())
}

impl<'a> Person<'a> {
    fn new(args: &HeadlineArgs, entries: &'a [Entry], cycles: &[Cycle], name: &'a str) -> Result<Person<'a>> {
        ensure!(entries.iter().any(|e| e.subject == name), "--subject {name} is nobody of the recordings");
        let (own, others): (Vec<Cycle>, Vec<Cycle>) = cycles.iter().cloned().partition(|c| c.subject == name);
        let wanted = args.at.unwrap_or(0.0);
        let nearest = own.iter().min_by(|a, b| (a.parameter - wanted).abs().total_cmp(&(b.parameter - wanted).abs()));
        let Some(filmed) = nearest else { bail!("{name} shows no whole cycle") };
        let is_source = |e: &&Entry| e.subject == name && filmed.source.starts_with(&file_name(&e.path));
        let entry = entries.iter().find(is_source).with_context(|| format!("no file of {}", filmed.source))?;
        let activity = Activity::from(args.activity);
        let others = NamedModel::new(Model::build(activity, false, &others)?, format!("model without {name}"));
        let members: Vec<Member> = own.iter().map(|c| others.model.member_of(c)).collect();
        let recorded: Vec<Cycle> = knots(&members)
            .iter()
            .map(|k| {
                let mean = Member { vector: mean_vector(k), root: mean_root(k), parameter: k.parameter, ..(*k.members[0]).clone() };
                others.model.cycle_of(&mean)
            })
            .collect();
        ensure!(recorded.len() > 1, "{name} was recorded at one speed only");
        let seen = own.iter().filter(|c| (c.parameter - filmed.parameter).abs() < SAME_PARAMETER).cloned().collect();
        Ok(Person { name, recorded, seen, entry, others })
    }

    /// Speed of the filmed recording, m/s.
    fn filmed(&self) -> f64 {
        self.seen.iter().map(|c| c.parameter).sum::<f64>() / self.seen.len() as f64
    }

    /// Films, tracks, generates, measures; writes the person's folder.
    fn scores(&self, args: &HeadlineArgs) -> Result<Vec<Score>> {
        let folder = args.output.join(self.name);
        let (fit, tracked) = self.track(args, &folder)?;
        let (model, hash) = (&self.others.model, &self.others.hash);
        write_style(&folder.join("style.json"), &tracked)?;
        let recorded = Style::of_cycles(model, hash, &self.seen).context("no cycle at the filmed speed")?;
        println!(
            "{} filmed at {:.2} m/s, {} frames; tracked at {:.2} m/s and {:.2} cycles/s with the model of {} others",
            self.name,
            self.filmed(),
            fit.poses.len(),
            fit.speed_m_s,
            fit.cadence_hz,
            model.subjects().len()
        );
        let ruler = Ruler::new(model, self.seen[0].hip_height_m);
        let mut scores = Vec::new();
        for (from, style) in [("tracked", &tracked), ("recorded", &recorded)] {
            for target in &self.recorded {
                for method in METHODS {
                    let cycle = carried(model, style, method, target.parameter)?;
                    scores.push(Score { at_m_s: target.parameter, from, method, errors: ruler.errors(&cycle, target) });
                }
            }
        }
        let own = |s: &&Score| (s.at_m_s - self.filmed()).abs() < SAME_PARAMETER && s.from == "tracked" && s.method == "unchanged";
        if let Some(own) = scores.iter().find(own) {
            let path = folder.join("angles.csv");
            write_atomic(&path, angles(&ruler, &own.errors).as_bytes()).with_context(|| path.display().to_string())?;
        }
        self.draw(&folder, &fit, &tracked)?;
        Ok(scores)
    }

    /// The recording before the phantom's rig, and the fit to what is seen of it with the style.
    fn track(&self, args: &HeadlineArgs, folder: &Path) -> Result<(Fit, Style)> {
        let rig = calib_toml::parse_rig(RIG, Path::new("calib/phantom_lab.toml"))?;
        let read = read_clip(&self.entry.path)?;
        let clip = overground(&read.clip, self.filmed());
        let (shape, ends) = (staging::subject_of(&clip), (self.entry.start_s, self.entry.end_s));
        let clip = staging::resample(&clip, args.fps, ends.0.unwrap_or(0.0), ends.1.unwrap_or(f64::INFINITY));
        let heading = staging::crossing_heading(&rig);
        let start = staging::cross_the_view(&rig, &clip, &shape, heading).context("the motion finds no place before the phantom's rig")?;
        let poses = staging::poses_in_world(&clip, &shape, rig.up, start, heading);
        let poses = &poses[staging::longest_run_in_view(&rig, &shape, &poses)];
        let options = FitOptions { components: args.components, ..FitOptions::default() };
        if args.sighted { self.sight(args, &rig, &shape, poses, &options) } else { self.film(args, folder, &rig, &shape, poses, &options) }
    }

    fn sight(&self, args: &HeadlineArgs, rig: &Rig, shape: &Shape, poses: &[Pose], options: &FitOptions) -> Result<(Fit, Style)> {
        let frames: Vec<(usize, f64)> = (0..poses.len()).map(|i| (i, i as f64 / args.fps)).collect();
        let seen = observe(rig, shape, &frames, poses, &SightOptions::default())?;
        let fit = fit::fit(&seen, rig, &[&self.others.model], Some(0.0), options, &|_| !interrupt::came())?;
        let style = track::style(&fit, &self.others);
        Ok((fit, style))
    }

    fn film(
        &self,
        args: &HeadlineArgs,
        folder: &Path,
        rig: &Rig,
        shape: &Shape,
        poses: &[Pose],
        options: &FitOptions,
    ) -> Result<(Fit, Style)> {
        let path: Vec<_> = poses.iter().map(|p| p.root).collect();
        let scene = Scene::new(Stage::around(rig, &path), shape);
        write_session(&folder.join("session"), &Take { scene: &scene, rig, poses, fps: args.fps, depth_every: None })?;
        let (session, _) = Session::open(&folder.join("session"), None)?;
        let seen = track::look(&session, None, |_, _, _| Ok(()))?;
        let tracked = track::fit_to(&session, seen, std::slice::from_ref(&self.others), options, None)?;
        track::write(&folder.join("track"), &session, std::slice::from_ref(&self.others), &tracked)?;
        Ok((tracked.fit, tracked.style))
    }

    /// Strips over the recordings and over the nearest person of the database.
    fn draw(&self, folder: &Path, fit: &Fit, style: &Style) -> Result<()> {
        let (model, shape) = (&self.others.model, fit.shape());
        let population = Population::new(model, style.weights.len());
        let made = |cycle: &Cycle| -> Result<Made> {
            let synthesis = synthesize(model, &population, Method::Default, style, cycle.parameter, shape.hip_height_m())?;
            let clip = play(model, &synthesis, &shape.offsets(), MADE_FPS, Length::Cycles(1));
            Ok(Made { stem: String::new(), value: cycle.parameter, clip, frequency_hz: synthesis.frequency_hz })
        };
        let others = self.recorded.iter().filter(|c| (c.parameter - self.filmed()).abs() > SAME_PARAMETER);
        let motions = others.map(made).collect::<Result<Vec<Made>>>()?;
        let own = own_cycle(model, style);
        let rows = Rows { shape, motions: &motions, own: &own, figures: FIGURES };
        rows.draw(&folder.join("strips"), "recorded", &|value| same(&self.recorded, value).cloned())?;
        rows.draw_over_nearest(folder, model, style)
    }
}

/// The motion that a method makes of a style at a speed.
fn carried(model: &Model, style: &Style, method: &str, parameter: f64) -> Result<Cycle> {
    let cycle = |weights: &[f64], detail: Option<&Detail>| model.cycle_with(weights, detail, parameter, style.hip_height_m, 1.0);
    let at = |components: usize, method| style.at(&Population::new(model, components.min(style.weights.len())), method, parameter);
    Ok(match method {
        "unchanged" => cycle(&style.weights, style.detail.as_ref()),
        "paper" => cycle(at(model.components(default_variance(model.activity)), Method::Paper(Metric::Paper))?.weights.as_slice(), None),
        _ => {
            let found = at(style.weights.len(), Method::Default)?;
            cycle(found.weights.as_slice(), found.detail.as_ref())
        }
    })
}

fn table(scores: &[Score]) -> String {
    let mut text = format!("{:>5}     {:>28}  {:>28}\n{:>5}     ", "", "from the tracked motion", "from the recorded motion", "m/s");
    for _ in 0..2 {
        METHODS.iter().for_each(|m| text += &format!("{m:>9} "));
        text.push_str("  ");
    }
    text.push('\n');
    let mut speeds: Vec<f64> = scores.iter().map(|s| s.at_m_s).collect();
    speeds.sort_by(f64::total_cmp);
    speeds.dedup();
    for at in speeds {
        for unit in ["deg", "mm"] {
            let of = |e: &Errors| if unit == "deg" { e.angle_rad.to_degrees() } else { 1e3 * e.position_m };
            text += &format!("{at:>5.2} {unit:<4}");
            for from in ["tracked", "recorded"] {
                for method in METHODS {
                    let score = scores.iter().find(|s| s.at_m_s == at && s.from == from && s.method == method);
                    text += &format!("{:>9.2} ", score.map_or(f64::NAN, |s| of(&s.errors)));
                }
                text.push_str("  ");
            }
            text.push('\n');
        }
    }
    text
}

fn pooled(scores: &[Score]) -> String {
    let mut text = String::new();
    for from in ["tracked", "recorded"] {
        for method in METHODS {
            let own: Vec<&Score> = scores.iter().filter(|s| s.from == from && s.method == method).collect();
            let rms = |of: &dyn Fn(&Errors) -> f64| (own.iter().map(|s| of(&s.errors).powi(2)).sum::<f64>() / own.len() as f64).sqrt();
            let (deg, mm) = (rms(&|e| e.angle_rad).to_degrees(), 1e3 * rms(&|e| e.position_m));
            text += &format!("{from:<9} {method:<10}{deg:>7.2} deg{mm:>8.1} mm\n");
        }
    }
    text
}

/// What tracking misses of each angle at the filmed speed.
fn angles(ruler: &Ruler, errors: &Errors) -> String {
    let mut text = String::from("angle,rms_deg,mean_deg\n");
    for (name, (rms, mean)) in ruler.names().iter().zip(&errors.by_angle) {
        text += &format!("{name},{:.3},{:.3}\n", rms.to_degrees(), mean.to_degrees());
    }
    text
}
