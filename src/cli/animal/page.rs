//! The report of an animal's clip, from what the stages left.

use std::path::Path;

use anyhow::{Context, Result};
use muybridge::io::animal_json::{self, AnalysisRecord, KeysRecord};
use muybridge::io::write_atomic;
use muybridge::report::animal_page::AnimalReport;

use super::{analyse, keys};

/// Pictures of the stages' folders with their captions, in the order of the page.
const PICTURES: [(&str, &str); 9] = [
    ("masks.png", "Silhouettes over the frames"),
    ("animation/keys_and_poses.png", "Key images and the artist's poses"),
    ("animation/motion.png", "The animation, on the spot"),
    ("animation/weights.png", "Weights of the key poses"),
    ("keys/keys.png", "Key images"),
    ("keys/alternates.png", "Keys and their silhouettes in the other half of the stride"),
    ("keys/plane.png", "The clip in the component plane; discs are keys, rings alternates"),
    ("analysis/eigenimages.png", "Mean image, and what the first three components add and take away"),
    ("analysis/spectrum.png", "Spectrum of the first components, peak and band"),
];

/// Writes `FOLDER/report.html`; `facts` are inputs and options by name.
pub fn write(folder: &Path, title: &str, facts: &[(&str, String)]) -> Result<()> {
    let analysis = animal_json::read::<AnalysisRecord>(&folder.join("analysis")).ok();
    let keys = animal_json::read::<KeysRecord>(&folder.join("keys")).ok();
    let mut pictures = Vec::new();
    for (name, caption) in PICTURES {
        let path = folder.join(name);
        if path.exists() {
            pictures.push((caption, std::fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?));
        }
    }
    let page = AnimalReport {
        title,
        analysis: analysis.as_ref(),
        analysis_text: &analysis.as_ref().map(analyse::table).unwrap_or_default(),
        keys_text: &keys.as_ref().map(keys::words).unwrap_or_default(),
        pictures: &pictures,
        facts,
    };
    let path = folder.join("report.html");
    write_atomic(&path, page.html().as_bytes()).with_context(|| format!("cannot write {}", path.display()))
}
