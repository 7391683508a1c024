//! Motions as files of every kind, and strips of stick figures: what `track` and `generate` have in common.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::Args;
use muybridge::body::{Clip, Shape};
use muybridge::io::exchange::{c3d, mot, trc};
use muybridge::io::manifest::find_motions;
use muybridge::io::outputs_json::{FileNote, Kind, Outputs, Source};
use muybridge::io::{bvh, glb, people_glb};
use muybridge::math::euler::Order;
use muybridge::motion::{Length, play_cycle};
use muybridge::motion_model::{Activity, Cycle, Model};
use muybridge::report::{self, strips};
use muybridge::style::{Nearest, Style};
use nalgebra::Rotation3;

use super::motions::read_recordings;

/// Figures in a row of a strip.
const FIGURES: &str = "9";
/// A recording belongs to a wanted speed or length that differs by less than this part.
const SAME: f64 = 0.1;

/// Options of `generate` about its files.
#[derive(Args)]
pub struct OutputArgs {
    /// Order of the rotation channels of BVH files: zxy, xyz and so on
    #[arg(long, value_name = "ORDER", default_value = "zxy")]
    bvh_order: Order,
    /// Also draw strips.png and strips.svg: the person's own motion and every generated one, this many figures each
    #[arg(long, value_name = "FIGURES", num_args = 0..=1, default_missing_value = FIGURES, value_parser = clap::value_parser!(u16).range(2..=60))]
    strips: Option<u16>,
    /// Recorded motion to draw pale below the generated one of its speed or length; may be repeated. The word `nearest` also
    /// draws strips_nearest.png and .svg over the person of the database who is nearest by the paper's equation 6
    #[arg(long, value_name = "MOTION", requires = "strips")]
    over: Vec<PathBuf>,
}

/// What `--over nearest` stands for.
const NEAREST: &str = "nearest";

/// Names of one motion's files.
pub struct Names {
    pub bvh: String,
    pub glb: String,
    pub trc: String,
    pub c3d: String,
    pub mot: String,
}

impl Names {
    /// `stem.bvh` and so on.
    pub fn of(stem: &str) -> Names {
        let [bvh, glb, trc, c3d, mot] = ["bvh", "glb", "trc", "c3d", "mot"].map(|ending| format!("{stem}.{ending}"));
        Names { bvh, glb, trc, c3d, mot }
    }

    /// Those of `track`.
    pub fn tracked() -> Names {
        let [bvh, glb, trc, c3d, mot] = ["motion.bvh", "motion.glb", "joints.trc", "joints.c3d", "angles.mot"].map(String::from);
        Names { bvh, glb, trc, c3d, mot }
    }
}

/// Writes motions of one body into a folder, and at the end `outputs.json` and the file that holds them all.
pub struct Writer {
    folder: PathBuf,
    order: Order,
    /// The body without motions.
    person: muybridge::animal::creature::Creature,
    clip_from_rig: Option<Rotation3<f64>>,
    source: Source,
    outputs: Outputs,
}

impl Writer {
    pub fn new(folder: &Path, shape: &Shape, clip_from_rig: Option<Rotation3<f64>>, order: Order, source: Source) -> Writer {
        Writer {
            folder: folder.into(),
            order,
            person: people_glb::person(shape),
            clip_from_rig,
            source,
            outputs: Outputs::of_folder(folder),
        }
    }

    /// One motion as BVH, GLB, TRC, C3D and MOT; `title` names the animation.
    pub fn motion(&mut self, names: &Names, title: &str, clip: &Clip) -> Result<()> {
        let at = |name: &String| self.folder.join(name);
        bvh::write_clip_in(&at(&names.bvh), clip, self.clip_from_rig.as_ref(), self.order)?;
        let motion = people_glb::motion(title, clip);
        self.person.motions = vec![motion];
        glb::write(&at(&names.glb), &self.person)?;
        trc::write(&at(&names.trc), clip)?;
        c3d::write(&at(&names.c3d), clip)?;
        mot::write(&at(&names.mot), clip)?;
        let kinds =
            [(&names.bvh, Kind::Bvh), (&names.glb, Kind::Glb), (&names.trc, Kind::Trc), (&names.c3d, Kind::C3d), (&names.mot, Kind::Mot)];
        for (name, kind) in kinds {
            self.outputs.files.insert(name.clone(), FileNote::new(kind, &self.source, clip.fps, self.clip_from_rig.as_ref()));
        }
        Ok(())
    }

    /// All motions as the animations of one GLB file.
    pub fn together(&mut self, name: &str, motions: &[Made]) -> Result<()> {
        let Some(first) = motions.first() else { return Ok(()) };
        self.person.motions = motions.iter().map(|m| people_glb::motion(&m.stem, &m.clip)).collect();
        glb::write(&self.folder.join(name), &self.person)?;
        self.outputs.files.insert(name.into(), FileNote::new(Kind::Glb, &self.source, first.clip.fps, self.clip_from_rig.as_ref()));
        Ok(())
    }

    pub fn finish(self) -> Result<()> {
        Ok(self.outputs.write(&self.folder)?)
    }
}

/// A generated motion.
pub struct Made {
    /// File name without its ending.
    pub stem: String,
    /// Speed in m/s or length in m.
    pub value: f64,
    pub clip: Clip,
    pub frequency_hz: f64,
}

impl OutputArgs {
    /// Everything that `generate` writes of its motions: each in all formats, all in one GLB named after the activity, the strips.
    pub fn write(&self, folder: &Path, shape: &Shape, source: Source, motions: &[Made], model: &Model, style: &Style) -> Result<()> {
        let mut writer = Writer::new(folder, shape, None, self.bvh_order, source);
        for made in motions {
            writer.motion(&Names::of(&made.stem), &made.stem, &made.clip)?;
        }
        writer.together(&format!("{}.glb", model.activity), motions)?;
        writer.finish()?;
        let Some(figures) = self.strips else { return Ok(()) };
        let (words, files): (Vec<PathBuf>, Vec<PathBuf>) = self.over.iter().cloned().partition(|f| f.as_os_str() == NEAREST);
        let recorded = recorded(&files, model.activity)?;
        let rows = Rows { shape, motions, own: &own_cycle(model, style), figures: figures.into() };
        rows.draw(&folder.join("strips"), "recorded", &|value| same(&recorded, value).cloned())?;
        if !words.is_empty() { rows.draw_over_nearest(folder, model, style) } else { Ok(()) }
    }
}

/// The person's motion as observed.
pub fn own_cycle(model: &Model, style: &Style) -> Cycle {
    let frequency_hz = style.cadence_factor * model.cadence().frequency_hz(style.parameter, style.hip_height_m);
    model.cycle_with(&style.weights, style.detail.as_ref(), style.parameter, style.hip_height_m, 1.0 / frequency_hz)
}

/// Strips to draw: the person's own motion, and every generated one.
pub struct Rows<'a> {
    pub shape: &'a Shape,
    pub motions: &'a [Made],
    pub own: &'a Cycle,
    pub figures: usize,
}

impl Rows<'_> {
    /// Writes strips_nearest.png and .svg over the database's nearest person.
    pub fn draw_over_nearest(&self, folder: &Path, model: &Model, style: &Style) -> Result<()> {
        let nearest = Nearest::new(model, style).context("the model holds nobody")?;
        let legend = format!("{}, nearest of the database by equation 6", nearest.subject);
        self.draw(&folder.join("strips_nearest"), &legend, &|value| Some(nearest.cycle(model, value, style.hip_height_m)))
    }

    /// Writes `stem`.png and `stem`.svg, with what `below` has at a speed or length drawn pale below.
    pub fn draw(&self, stem: &Path, legend: &str, below: &dyn Fn(f64) -> Option<Cycle>) -> Result<()> {
        let cyclic = self.own.activity.is_cyclic();
        let unit = if cyclic { "m/s" } else { "m" };
        let of_body = |cycle: &Cycle| Played::new(cycle, self.shape);
        let values: Vec<f64> = std::iter::once(self.own.parameter).chain(self.motions.iter().map(|m| m.value)).collect();
        let under: Vec<Option<Played>> = values.iter().map(|v| below(*v).as_ref().map(of_body)).collect();
        let own = of_body(self.own);
        let made = self.motions.iter().map(|m| strips::Phases { clip: &m.clip, cycle_s: 1.0 / m.frequency_hz });
        let rows: Vec<strips::Strip> = std::iter::once(own.phases())
            .chain(made)
            .enumerate()
            .map(|(k, made)| strips::Strip {
                label: format!("{}{:.2} {unit}", if k == 0 { "own, " } else { "" }, values[k]),
                made,
                below: under[k].as_ref().map(Played::phases),
                cyclic,
            })
            .collect();
        let drawing = strips::strips(&rows, self.figures, strips::FROM_THE_SIDE, legend)?;
        report::save(&stem.with_extension("png"), &drawing.picture()?)?;
        Ok(report::save_drawing(&stem.with_extension("svg"), &drawing)?)
    }
}

/// One cycle on a body.
struct Played {
    clip: Clip,
    cycle_s: f64,
}

impl Played {
    fn new(cycle: &Cycle, shape: &Shape) -> Played {
        let cycle = Cycle { hip_height_m: shape.hip_height_m(), ..cycle.clone() };
        let fps = 120.0;
        Played { clip: play_cycle(&cycle, &shape.offsets(), fps, Length::Cycles(1)), cycle_s: cycle.duration_s }
    }

    fn phases(&self) -> strips::Phases<'_> {
        strips::Phases { clip: &self.clip, cycle_s: self.cycle_s }
    }
}

/// Cycles of recorded files.
fn recorded(files: &[PathBuf], activity: Activity) -> Result<Vec<Cycle>> {
    if files.is_empty() {
        return Ok(Vec::new());
    }
    let recordings = read_recordings(&find_motions(files, None)?, activity);
    if recordings.cycles.is_empty() {
        bail!("--over shows no whole cycle of {activity}{}", recordings.first_reason());
    }
    Ok(recordings.cycles)
}

/// The recorded cycle of about this speed or length.
pub fn same(recorded: &[Cycle], value: f64) -> Option<&Cycle> {
    let off = |c: &Cycle| (c.parameter / value - 1.0).abs();
    recorded.iter().filter(|c| off(c) < SAME).min_by(|a, b| off(a).total_cmp(&off(b)))
}
