//! `muybridge animal run`: all stages by one TOML file.
//!
//! A stage runs again when its options, its inputs' bytes, an earlier stage or the program's version have changed.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use muybridge::io::animal_clip::read_masks;
use muybridge::io::write_atomic;
use muybridge::report::animal::mask_sheet;
use serde::Deserialize;

use super::analyse::AnalyseChoices;
use super::animate::AnimateChoices;
use super::keys::KeyChoices;
use super::masks::MaskChoices;
use super::{analyse, animate, keys, masks, page, save};

#[derive(clap::Args)]
pub struct RunArgs {
    /// TOML file: `video` (or `masks`, a folder, or `strokes`, a folder of drawings), `output`, and the tables [silhouettes],
    /// [analyse], [keys], [animate] with the options of the single commands
    study: PathBuf,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Study {
    video: Option<PathBuf>,
    /// Ready masks instead.
    masks: Option<PathBuf>,
    /// Drawn strokes instead.
    strokes: Option<PathBuf>,
    /// Relative to the file; its name without `.toml` where missing.
    output: Option<PathBuf>,
    #[serde(default)]
    silhouettes: MaskChoices,
    #[serde(default)]
    analyse: AnalyseChoices,
    #[serde(default)]
    keys: KeyChoices,
    animate: Option<AnimateChoices>,
}

pub fn run(args: &RunArgs) -> Result<()> {
    let name = args.study.display().to_string();
    let text = std::fs::read_to_string(&args.study).with_context(|| format!("cannot read {name}"))?;
    let mut study: Study = toml::from_str(&text).with_context(|| name.clone())?;
    let home = args.study.parent().map_or_else(PathBuf::new, Path::to_path_buf);
    let sources = [&study.video, &study.masks, &study.strokes].iter().filter(|s| s.is_some()).count();
    ensure!(sources == 1, "{name}: give one of video, masks and strokes");
    let output = home.join(study.output.take().unwrap_or_else(|| args.study.file_stem().map_or_else(|| "out".into(), PathBuf::from)));
    if let Some(template) = study.keys.template_mut() {
        *template = home.join(&*template);
    }
    if let Some(animate) = &mut study.animate {
        animate.poses = home.join(&animate.poses);
    }
    std::fs::create_dir_all(&output).with_context(|| format!("cannot create {}", output.display()))?;
    let stages = Stages { folder: &output };
    let (folder, before) = silhouettes(&stages, &study, &home)?;
    study.analyse.strokes |= study.strokes.is_some();
    let analysis = output.join("analysis");
    let before = stages.once("analysis", &[&before, &json(&study.analyse)?], || analyse::make(&folder, &study.analyse, &analysis))?;
    let chosen = output.join("keys");
    let template = study.keys.template_mut().clone().map_or(Ok(String::new()), |t| digest(&t))?;
    let before = stages.once("keys", &[&before, &json(&study.keys)?, &template], || keys::make(&analysis, &study.keys, &chosen))?;
    match &study.animate {
        Some(choices) => {
            let folder = output.join("animation");
            stages.once("animation", &[&before, &json(choices)?, &digest(&choices.poses)?], || {
                animate::make(&analysis, &chosen, choices, &folder)
            })?;
        }
        None => println!(
            "next: set a pose on every frame of {}, and name the file as poses in [animate]",
            chosen.join("template.glb").display()
        ),
    }
    let source = [("video", &study.video), ("masks", &study.masks), ("strokes", &study.strokes)];
    let mut facts: Vec<(&str, String)> =
        source.iter().filter_map(|(what, path)| Some((*what, path.as_ref()?.display().to_string()))).collect();
    facts.extend([("[silhouettes]", json(&study.silhouettes)?), ("[analyse]", json(&study.analyse)?), ("[keys]", json(&study.keys)?)]);
    if let Some(animate) = &study.animate {
        facts.push(("[animate]", json(animate)?));
    }
    page::write(&output, &name, &facts)?;
    println!("report: {}", output.join("report.html").display());
    Ok(())
}

/// The folder of silhouettes and the hash of what they come from.
fn silhouettes(stages: &Stages, study: &Study, home: &Path) -> Result<(PathBuf, String)> {
    if let Some(ready) = study.masks.as_ref().or(study.strokes.as_ref()) {
        let folder = home.join(ready);
        let hash = digest(&folder)?;
        return Ok((folder, hash));
    }
    let video = home.join(study.video.as_deref().unwrap_or(Path::new("")));
    let folder = stages.folder.join("masks");
    let hash = stages.once("masks", &[&digest(&video)?, &json(&study.silhouettes)?], || {
        let frames = masks::make(&video, &study.silhouettes, &folder)?;
        save(&stages.folder.join("masks.png"), &mask_sheet(&frames, &read_masks(&folder, None)?, 12)?)
    })?;
    Ok((folder, hash))
}

fn json<T: serde::Serialize>(value: &T) -> Result<String> {
    Ok(serde_json::to_string(value)?)
}

/// Hash of a file's bytes, or of all files directly in a folder with their names.
fn digest(path: &Path) -> Result<String> {
    let failed = || format!("cannot read {}", path.display());
    let mut hasher = blake3::Hasher::new();
    if path.is_dir() {
        let mut files: Vec<PathBuf> =
            path.read_dir().with_context(failed)?.filter_map(|e| Some(e.ok()?.path())).filter(|p| p.is_file()).collect();
        files.sort();
        for file in files {
            hasher.update(file.file_name().map_or(&[][..], |n| n.as_encoded_bytes()));
            hasher.update(&std::fs::read(&file).with_context(failed)?);
        }
    } else {
        hasher.update(&std::fs::read(path).with_context(failed)?);
    }
    Ok(hasher.finalize().to_hex().to_string())
}

struct Stages<'a> {
    folder: &'a Path,
}

impl Stages<'_> {
    /// Does `work` unless it was done with the same inputs; the inputs' hash, for the next stage.
    fn once(&self, stage: &str, inputs: &[&str], work: impl FnOnce() -> Result<()>) -> Result<String> {
        let mut hasher = blake3::Hasher::new();
        for part in [env!("CARGO_PKG_VERSION"), stage].iter().chain(inputs) {
            hasher.update(&(part.len() as u64).to_le_bytes());
            hasher.update(part.as_bytes());
        }
        let hash = hasher.finalize().to_hex().to_string();
        let mark = self.folder.join(format!(".{stage}.hash"));
        if std::fs::read_to_string(&mark).is_ok_and(|done| done == hash) && self.folder.join(stage).exists() {
            println!("{stage}: unchanged");
            return Ok(hash);
        }
        let _ = std::fs::remove_file(&mark);
        work()?;
        write_atomic(&mark, hash.as_bytes()).with_context(|| format!("cannot write {}", mark.display()))?;
        Ok(hash)
    }
}
