//! `muybridge check`: what is wrong with a session and what to do, before any long work.

use super::progress;
use anyhow::{Result, ensure};
use muybridge::footage::check::{Survey, residual_warnings, survey};
use muybridge::footage::epipolar::{PairResidual, epipolar_residuals};
use muybridge::io::session::{Session, Source};
use std::path::PathBuf;

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
    print_survey(&session, &found.seen);
    println!("\ndistance of common corners from their epipolar lines, median");
    found.still.iter().zip(&found.moving).for_each(|(still, moving)| print_pair(&session, still, moving));
    let warnings = found.warnings(&session);
    println!();
    warnings.iter().for_each(|warning| println!("warning: {warning}"));
    println!("{}", if warnings.is_empty() { "ready" } else { "usable, with these warnings" });
    Ok(())
}

/// What a look at all frames found.
pub struct Findings {
    seen: Survey,
    still: Vec<PairResidual>,
    moving: Vec<PairResidual>,
}

impl Findings {
    /// What the user should know, one sentence each.
    pub fn warnings(&self, session: &Session) -> Vec<String> {
        [self.seen.warnings(&session.rig), residual_warnings(&session.rig, &self.still, &self.moving)].concat()
    }
}

/// Looks at all frames of a session; an error where nobody is in view.
pub fn look(session: &Session) -> Result<Findings> {
    session.rig.validate_stereo()?;
    let stages = session.stages()?;
    let bar = progress::bar("frames", session.frame_count as u64);
    let seen = survey(session.frames().inspect(|_| bar.inc(1)), session.frame_count, &stages)?;
    bar.finish();
    ensure!(
        seen.somebody_in_view(),
        "{}: no person in view: no picture differs from the empty stage; film somebody, or give pictures of the stage without them (cam_NN_background.png)",
        session.folder.display()
    );
    let still = epipolar_residuals(&session.rig, &[&stages], None);
    let (frames, masks): (Vec<_>, Vec<_>) = seen.samples.iter().map(|(frame, masks)| (frame.images.as_slice(), masks.clone())).unzip();
    let moving = epipolar_residuals(&session.rig, &frames, Some(&masks));
    Ok(Findings { seen, still, moving })
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

fn print_survey(session: &Session, survey: &Survey) {
    for (camera, facts) in session.rig.cameras.iter().zip(&survey.cameras) {
        println!("{}: foreground {:.1} % of the picture", camera.name, 100.0 * facts.foreground_share);
    }
}

fn print_pair(session: &Session, still: &PairResidual, moving: &PairResidual) {
    let text = |r: &PairResidual| match r.median_px {
        Some(px) => format!("{px:.2} px ({} corners)", r.matches),
        None => "no corners".into(),
    };
    let name = |k: usize| &session.rig.cameras[k].name;
    println!("{} and {}: stage {}, person {}", name(still.first), name(still.second), text(still), text(moving));
}
