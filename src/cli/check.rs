//! `muybridge check`: what is wrong with a session and what to do, before any long work.

use super::progress;
use anyhow::{Result, bail, ensure};
use image::GrayImage;
use muybridge::footage::check::{Fit, Survey, judge_offsets, masks, survey};
use muybridge::footage::epipolar::{PairMatches, PairResidual, pair_matches};
use muybridge::footage::misfit::{Change, Fault, diagnose};
use muybridge::footage::person::{self, Doubt, Person};
use muybridge::footage::reduce::{enlarged, reduced, reduction};
use muybridge::footage::synchrony::{self, Instant, Offset, camera_offsets};
use muybridge::footage::{FrameSet, spread};
use muybridge::io::session::{Session, Source};
use muybridge::rig::{Rig, Up};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Instants at which corners of the person are matched between the cameras.
const INSTANTS: usize = 8;

#[derive(clap::Args)]
pub struct CheckArgs {
    /// Session folder with Calib.toml and one folder of pictures or one video per camera
    session: PathBuf,
    /// Frames per second, instead of what the videos or muybridge.toml say
    #[arg(long)]
    fps: Option<f64>,
}

pub fn run(args: &CheckArgs) -> Result<()> {
    let (session, notices) = Session::open(&args.session, args.fps)?;
    print_session(&session);
    notices.iter().for_each(|notice| println!("notice: {notice}"));
    let found = look(&session)?;
    print_findings(&session, &found);
    let warnings = found.warnings(&session);
    println!();
    warnings.iter().for_each(|warning| println!("warning: {warning}"));
    found.refuse(&session)?;
    println!("{}", if warnings.is_empty() { "ready" } else { "usable, with these warnings" });
    Ok(())
}

/// What a look at all frames found.
pub struct Findings {
    seen: Survey,
    still: Vec<PairResidual>,
    moving: Vec<PairResidual>,
    fault: Option<Fault>,
    /// One per camera; empty where the calibration does not fit, for then nothing can be told.
    offsets: Vec<Option<Offset>>,
    person: Option<Person>,
}

impl Findings {
    /// What the user should know, one sentence each.
    pub fn warnings(&self, session: &Session) -> Vec<String> {
        let rig = &session.rig;
        let mut warnings = self.seen.warnings(rig);
        match &self.fault {
            Some(fault) if !self.unusable() => warnings.push(fault_text(rig, fault)),
            None if self.seen.refusal(rig).is_none() => warnings.extend(self.still.iter().filter_map(|r| residual_warning(rig, r))),
            _ => {}
        }
        warnings.extend(judge_offsets(rig, &self.offsets, session.fps).1);
        warnings
    }

    /// An error where no tracking can come of the session.
    pub fn refuse(&self, session: &Session) -> Result<()> {
        let rig = &session.rig;
        let unsharp = || self.seen.blurred(rig).filter(|_| matches!(self.fault, Some(Fault::NothingInCommon { .. } | Fault::Whole)));
        let misfit = || self.fault.as_ref().filter(|_| self.unusable()).map(|f| fault_text(rig, f));
        let doubt = || self.person.and_then(|p| p.doubt(rig)).map(|d| doubt_text(rig, &d));
        let refusal = self
            .seen
            .refusal(rig)
            .or_else(unsharp)
            .or_else(misfit)
            .or_else(|| judge_offsets(rig, &self.offsets, session.fps).0)
            .or_else(doubt);
        match refusal {
            Some(refusal) => bail!("{}: {refusal}", session.folder.display()),
            None => Ok(()),
        }
    }

    /// Measures what needs a calibration that fits: residuals and size of the person, and the cameras' times.
    fn look_at_person(&mut self, session: &Session, stages: &[GrayImage]) -> Result<()> {
        let rig = &session.rig;
        let coarse = self.seen.signatures.offsets();
        let shifts = whole_shifts(rig, &coarse);
        let instants = instants(session, &self.seen.together, &shifts)?;
        let small = small_masks(rig, stages, &instants);
        let moving = matches_on_person(rig, &instants, &small);
        let mut fine = Vec::new();
        for pair in &moving {
            if let Some(mut found) = synchrony::pair_offset(pair, &instants)? {
                found.offset.frames -= (shifts[pair.second] - shifts[pair.first]) as f64;
                fine.push(found);
            }
        }
        self.person = person::measure(rig, &moving, &small);
        self.moving = moving.iter().map(PairResidual::from).collect();
        self.offsets = camera_offsets(rig.cameras.len(), &synchrony::better(&coarse, &fine));
        Ok(())
    }

    /// Whether the misfit is more than correlation bears.
    fn unusable(&self) -> bool {
        match self.fault {
            None => false,
            Some(Fault::Turned { .. }) => self.still.iter().any(|r| matches!(Fit::of(r), Fit::Unusable | Fit::Unknown)),
            Some(_) => true,
        }
    }
}

/// Looks at all frames of a session; an error where nobody is in view.
pub fn look(session: &Session) -> Result<Findings> {
    let rig = &session.rig;
    rig.validate_stereo()?;
    let stages = session.stages()?;
    let bar = progress::bar("frames", session.frame_count as u64);
    let seen = survey(session.frames().inspect(|_| bar.inc(1)), rig, &stages)?;
    bar.finish();
    ensure!(
        seen.somebody_in_view(),
        "{}: no person in view: no picture differs from the empty stage; film somebody, or give pictures of the stage without them (cam_NN_background.png)",
        session.folder.display()
    );
    let still: Vec<PairResidual> = pair_matches(rig, &[&stages], None).iter().map(PairResidual::from).collect();
    let fits = still.iter().all(|r| Fit::of(r) == Fit::Good);
    let blind = seen.refusal(rig).is_some();
    let fault = if fits || blind { None } else { diagnose(rig, &stages)? };
    let mut found = Findings { seen, still, moving: Vec::new(), fault, offsets: Vec::new(), person: None };
    if !blind && !found.unusable() {
        found.look_at_person(session, &stages)?;
    }
    Ok(found)
}

/// What a misfit means that no fault explains.
fn residual_warning(rig: &Rig, residual: &PairResidual) -> Option<String> {
    let pair = format!("{} and {}", rig.cameras[residual.first].name, rig.cameras[residual.second].name);
    match Fit::of(residual) {
        Fit::Good => None,
        Fit::Unknown => Some(format!(
            "{pair}: too few common corners ({}) to judge the calibration; do both see the stage sharply, and has it texture?",
            residual.matches
        )),
        Fit::Loose | Fit::Unusable => {
            let px = residual.median_px.unwrap_or(0.0);
            Some(format!("{pair}: common corners lie {px:.1} px from their epipolar lines; calibrate again"))
        }
    }
}

/// How many frames later each camera's pictures must be taken to be about simultaneous.
fn whole_shifts(rig: &Rig, coarse: &[synchrony::PairOffset]) -> Vec<i64> {
    let offsets = camera_offsets(rig.cameras.len(), coarse);
    offsets.iter().map(|o| o.map_or(0, |o| -o.frames.round() as i64)).collect()
}

/// Pictures around instants in which somebody is in view of all cameras.
fn instants(session: &Session, together: &[usize], shifts: &[i64]) -> Result<Vec<Instant>> {
    let numbers = &session.frame_numbers;
    let index = |number: usize, by: i64| numbers.binary_search(&number.checked_add_signed(by as isize)?).ok();
    let around = |number: usize| -> Option<Vec<[usize; 3]>> {
        shifts.iter().map(|&s| Some([index(number, s - 1)?, index(number, s)?, index(number, s + 1)?])).collect()
    };
    let possible: Vec<Vec<[usize; 3]>> = together.iter().filter_map(|&number| around(number)).collect();
    let chosen: Vec<_> = spread(possible.len(), INSTANTS).into_iter().map(|k| &possible[k]).collect();
    let wanted: Vec<usize> = chosen.iter().copied().flatten().flatten().copied().collect();
    let frames = frames_at(session, &wanted)?;
    let picture = |index: &usize, camera: usize| frames.get(index).and_then(|f| f.images.get(camera)).cloned().unwrap_or_default();
    let instant = |around: &Vec<[usize; 3]>| Instant {
        images: around.iter().enumerate().map(|(camera, three)| three.each_ref().map(|index| picture(index, camera))).collect(),
    };
    Ok(chosen.into_iter().map(instant).collect())
}

/// Frames by their positions; a video is read from its start.
fn frames_at(session: &Session, wanted: &[usize]) -> Result<BTreeMap<usize, FrameSet>> {
    if session.has_random_access() {
        let wanted: std::collections::BTreeSet<usize> = wanted.iter().copied().collect();
        return wanted.into_iter().map(|index| Ok((index, session.frame(index)?))).collect();
    }
    let last = wanted.iter().max().map_or(0, |last| last + 1);
    let frames = session.frames().take(last).enumerate().filter(|(index, frame)| frame.is_err() || wanted.contains(index));
    frames.map(|(index, frame)| Ok((index, frame?))).collect()
}

/// Reduced masks per instant and camera.
fn small_masks(rig: &Rig, stages: &[GrayImage], instants: &[Instant]) -> Vec<Vec<GrayImage>> {
    let small = |images: &[&GrayImage]| -> Vec<GrayImage> {
        images.iter().zip(&rig.cameras).map(|(image, c)| reduced(image, reduction(c.size_px))).collect()
    };
    let stages = small(&stages.iter().collect::<Vec<_>>());
    instants.iter().map(|at| masks(&small(&at.images.iter().map(|three| &three[1]).collect::<Vec<_>>()), &stages)).collect()
}

fn matches_on_person(rig: &Rig, instants: &[Instant], small: &[Vec<GrayImage>]) -> Vec<PairMatches> {
    let sets: Vec<Vec<GrayImage>> = instants.iter().map(|at| at.images.iter().map(|three| three[1].clone()).collect()).collect();
    let sets: Vec<&[GrayImage]> = sets.iter().map(Vec::as_slice).collect();
    let large = |masks: &Vec<GrayImage>| {
        masks.iter().zip(&rig.cameras).map(|(mask, c)| enlarged(mask, reduction(c.size_px), c.size_px)).collect::<Vec<_>>()
    };
    pair_matches(rig, &sets, Some(&small.iter().map(large).collect::<Vec<_>>()))
}

fn fault_text(rig: &Rig, fault: &Fault) -> String {
    let name = |k: usize| rig.cameras[k].name.clone();
    match fault {
        Fault::Exchanged { first, second } => {
            format!("the pictures of {0} and {1} are exchanged; rename {0} to {1} and {1} to {0}", name(*first), name(*second))
        }
        Fault::Permuted { seen_by } => {
            let moves = seen_by.iter().enumerate().filter(|(k, by)| k != *by).map(|(k, by)| format!("{} to {}", name(k), name(*by)));
            format!("the pictures of the cameras are mixed up; rename {}", moves.collect::<Vec<_>>().join(", "))
        }
        Fault::Changed { camera, change } => {
            let whose = camera.map_or("all cameras".into(), name);
            format!(
                "the pictures of {whose} are {} against the calibration; bring them back to how they were calibrated",
                change_text(*change)
            )
        }
        Fault::Turned { cameras, angle_deg } => {
            let names = cameras.iter().map(|&k| name(k)).collect::<Vec<_>>().join(" or ");
            let other = if *angle_deg > 1.0 { ", or take the Calib.toml of this rig" } else { "" };
            format!("{names} is turned by {angle_deg:.1} degrees (or moved) against the calibration: calibrate again{other}")
        }
        Fault::Whole => {
            "the calibration does not fit these pictures, and no single camera explains it; is this Calib.toml of this rig? Calibrate again"
                .into()
        }
        Fault::NothingInCommon { first, second, matches } => format!(
            "{} and {} have almost nothing in common ({matches} features) to judge the calibration by; do both see the stage sharply, and has it texture?",
            name(*first),
            name(*second)
        ),
    }
}

fn change_text(change: Change) -> &'static str {
    match change {
        Change::Mirrored => "mirrored left to right",
        Change::Flipped => "mirrored top to bottom",
        Change::Rotated(1) => "rotated by 90 degrees clockwise",
        Change::Rotated(3) => "rotated by 90 degrees counterclockwise",
        Change::Rotated(_) => "rotated by 180 degrees",
    }
}

fn doubt_text(rig: &Rig, doubt: &Doubt) -> String {
    let said = if rig.up == Up::Y { "y" } else { "z" };
    match doubt {
        Doubt::Units { height_m, scale } => format!(
            "the person would be {height_m:.2} m tall by Calib.toml, so its translations are not in metres; `muybridge rig convert --scale {scale}` makes them so"
        ),
        Doubt::Up { axis, positive: true } if (*axis == 1 && rig.up == Up::Z) || (*axis == 2 && rig.up == Up::Y) => {
            let axis = ["x", "y", "z"][*axis];
            format!(
                "the person stands along the world's {axis} axis but {said} is up by Calib.toml; write up = \"{axis}\" under [metadata] there"
            )
        }
        Doubt::Up { axis, positive } => {
            let (sign, axis) = (if *positive { "+" } else { "-" }, ["x", "y", "z"][*axis]);
            format!(
                "the person stands along the world's {sign}{axis} axis but {said} is up by Calib.toml; calibrate with a board on the floor (`muybridge calibrate --floor-view`)"
            )
        }
        Doubt::UpsideDown => format!(
            "the person stands on their head by Calib.toml: its {said} axis points down; calibrate with a board on the floor (`muybridge calibrate --floor-view`)"
        ),
    }
}

fn print_session(session: &Session) {
    let (first, last) = (session.frame_numbers.first().unwrap_or(&0), session.frame_numbers.last().unwrap_or(&0));
    let duration_s = (last - first) as f64 / session.fps;
    println!(
        "{}: {} frames ({first} to {last}), {} frames/s, {duration_s:.2} s",
        session.folder.display(),
        session.frame_count,
        session.fps
    );
    for (camera, source) in session.rig.cameras.iter().zip(&session.cameras) {
        let [width, height] = camera.size_px;
        let kind = if matches!(source, Source::Images(_)) { "pictures" } else { "video" };
        println!("{}: {width}x{height} px, focal length {:.1} px, {kind}", camera.name, camera.matrix[(0, 0)]);
    }
    for (i, k, baseline_m) in session.rig.baselines_m() {
        println!("baseline {} to {}: {baseline_m:.4} m", session.rig.cameras[i].name, session.rig.cameras[k].name);
    }
    println!("empty stage: {}", if session.backgrounds.is_some() { "pictures" } else { "median of the frames" });
}

fn print_findings(session: &Session, found: &Findings) {
    let name = |k: usize| &session.rig.cameras[k].name;
    for (camera, facts) in session.rig.cameras.iter().zip(&found.seen.cameras) {
        println!(
            "{}: foreground {:.1} % of the picture; stage: contrast {:.0} grey levels, detail {:.2} of it",
            camera.name,
            100.0 * facts.foreground_share,
            facts.contrast_grey,
            facts.detail
        );
    }
    if let Some(person) = found.person {
        println!("person: {:.2} m tall, feet at {:.2} m", person.height_m, person.feet_m);
    }
    println!("\ndistance of common corners from their epipolar lines, median");
    for (k, still) in found.still.iter().enumerate() {
        print_pair(session, still, found.moving.get(k));
    }
    if found.offsets.iter().any(Option::is_some) {
        println!("\ntime of the pictures against the other cameras'");
    }
    for (k, offset) in found.offsets.iter().enumerate() {
        if let Some(o) = offset {
            println!("{}: {:+.3} +- {:.3} frames", name(k), o.frames, o.sigma);
        }
    }
}

fn print_pair(session: &Session, still: &PairResidual, moving: Option<&PairResidual>) {
    let text = |r: &PairResidual| match r.median_px {
        Some(px) => format!("{px:.2} px ({} corners)", r.matches),
        None => "no corners".into(),
    };
    let name = |k: usize| &session.rig.cameras[k].name;
    let person = moving.map_or(String::new(), |m| format!(", person {}", text(m)));
    println!("{} and {}: stage {}{person}", name(still.first), name(still.second), text(still));
}
