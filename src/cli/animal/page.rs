//! The report of an animal's clip: one HTML page with all figures inside.

use std::path::Path;

use anyhow::{Context, Result};
use muybridge::io::animal_json::{self, AnalysisRecord, KeysRecord};
use muybridge::io::write_atomic;

use super::{analyse, keys};

/// Pictures of the stages' folders with their captions, in the order of the page.
const PICTURES: [(&str, &str); 10] = [
    ("masks.png", "Silhouettes over the frames"),
    ("analysis/eigenimages.png", "Mean image, and what the first three components add and take away"),
    ("analysis/spectrum.png", "Spectrum of the first components, peak and band"),
    ("analysis/coefficients.png", "Coefficients over time"),
    ("keys/plane.png", "The clip in the component plane; discs are keys, rings alternates"),
    ("keys/keys.png", "Key images"),
    ("keys/alternates.png", "Keys and their silhouettes in the other half of the stride"),
    ("animation/weights.png", "Weights of the key poses"),
    ("animation/keys_and_poses.png", "Key images and the artist's poses"),
    ("animation/motion.png", "The animation, on the spot"),
];

/// Writes `FOLDER/report.html` from what the stages left there.
pub fn write(folder: &Path, title: &str) -> Result<()> {
    let mut body = format!("<h1>{}</h1>\n", escaped(title));
    if let Ok(record) = animal_json::read::<AnalysisRecord>(&folder.join("analysis")) {
        body += &format!("<pre>{}</pre>\n", escaped(&analyse::table(&record)));
    }
    if let Ok(record) = animal_json::read::<KeysRecord>(&folder.join("keys")) {
        body += &format!("<pre>{}</pre>\n", escaped(&keys::words(&record)));
    }
    for (name, caption) in PICTURES {
        let path = folder.join(name);
        if path.exists() {
            let bytes = std::fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
            body += &format!(
                "<figure><img alt=\"{caption}\" src=\"data:image/png;base64,{}\"><figcaption>{caption}</figcaption></figure>\n",
                base64(&bytes)
            );
        }
    }
    let style = "body{font:16px/1.5 sans-serif;max-width:1040px;margin:2em auto;padding:0 1em;color:#282828}img{max-width:100%}\
                 figure{margin:2em 0}figcaption{color:#666}pre{background:#f4f4f4;padding:1em;overflow-x:auto}";
    let page = format!(
        "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><title>{}</title><style>{style}</style></head><body>\n{body}</body></html>\n",
        escaped(title)
    );
    let path = folder.join("report.html");
    write_atomic(&path, page.as_bytes()).with_context(|| format!("cannot write {}", path.display()))
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for three in bytes.chunks(3) {
        let word = three.iter().fold(0u32, |w, b| (w << 8) | u32::from(*b)) << (8 * (3 - three.len()));
        for k in 0..4 {
            let digit = DIGITS[(word >> (18 - 6 * k)) as usize & 63];
            text.push(if k <= three.len() { char::from(digit) } else { '=' });
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base64_is_the_rfcs() {
        for (plain, coded) in [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foobar", "Zm9vYmFy")] {
            assert_eq!(base64(plain.as_bytes()), coded);
        }
        assert_eq!(escaped("<a & \"b\">"), "&lt;a &amp; &quot;b&quot;&gt;");
    }
}
