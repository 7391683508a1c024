//! What all report pages share: one self-contained HTML page, verdict first, light and dark, on paper too.
//!
//! Pictures are data URIs, charts inline SVG, nothing is fetched. Text goes through `maud`, which escapes it. Colours are CSS
//! variables: the palette of [`canvas`](super::canvas) on white, the same hues lightened on dark.

use image::codecs::jpeg::JpegEncoder;
use image::{DynamicImage, RgbImage};
use maud::{DOCTYPE, Markup, PreEscaped, html};

use super::{ReportError, png_bytes};

const STYLE: &str = include_str!("page.css");

/// How a run went, in one word for eyes that look at hundreds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Grade {
    Failed,
    Look,
    Good,
}

impl Grade {
    pub fn word(self) -> &'static str {
        match self {
            Grade::Failed => "failed",
            Grade::Look => "look at it",
            Grade::Good => "good",
        }
    }

    pub(super) fn class(self) -> &'static str {
        match self {
            Grade::Failed => "failed",
            Grade::Look => "look",
            Grade::Good => "good",
        }
    }
}

/// The first thing on a page: what came out, and what to know before trusting it.
#[derive(Clone, Debug)]
pub struct Verdict {
    pub grade: Grade,
    pub sentence: String,
    pub notes: Vec<String>,
}

/// A part of a page with its heading.
pub struct Section {
    pub heading: &'static str,
    pub body: Markup,
}

impl Section {
    pub fn new(heading: &'static str, body: Markup) -> Section {
        Section { heading, body }
    }

    fn anchor(&self) -> String {
        self.heading.to_lowercase().replace(|c: char| !c.is_ascii_alphanumeric(), "-")
    }
}

/// The whole page. `command` is the program's part that made it, such as "muybridge track".
pub fn page(command: &str, title: &str, verdict: &Verdict, sections: &[Section]) -> String {
    let markup = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta name="color-scheme" content="light dark";
                title { (title) " - " (command) }
                style { (PreEscaped(STYLE)) }
            }
            body {
                header {
                    p.kicker { (command) }
                    h1 { (title) }
                    div class={ "verdict " (verdict.grade.class()) } {
                        p { strong { (verdict.grade.word()) } " " (verdict.sentence) }
                        @if !verdict.notes.is_empty() {
                            ul { @for note in &verdict.notes { li { (note) } } }
                        }
                    }
                    @if sections.len() > 2 {
                        nav { @for section in sections { a href={ "#" (section.anchor()) } { (section.heading) } } }
                    }
                }
                main {
                    @for section in sections {
                        section id=(section.anchor()) {
                            h2 { (section.heading) }
                            (section.body)
                        }
                    }
                }
                footer { "muybridge " (env!("CARGO_PKG_VERSION")) ". This page is one file; it loads nothing from elsewhere." }
            }
        }
    };
    markup.into_string()
}

/// Names and values, two columns.
pub fn facts(rows: &[(&str, String)]) -> Markup {
    html! { div.scroll { table.facts { @for (name, value) in rows { tr { th scope="row" { (name) } td { (value) } } } } } }
}

/// A table of text; cells of the columns from `numbers_from` on stand to the right.
pub fn table(head: &[&str], rows: &[Vec<String>], numbers_from: usize) -> Markup {
    let class = |k: usize| if k >= numbers_from { "number" } else { "" };
    html! {
        div.scroll {
            table {
                thead { tr { @for (k, name) in head.iter().enumerate() { th class=(class(k)) scope="col" { (name) } } } }
                tbody {
                    @for row in rows {
                        tr { @for (k, cell) in row.iter().enumerate() { td class=(class(k)) { (cell) } } }
                    }
                }
            }
        }
    }
}

/// Figures side by side as far as there is room.
pub fn gallery(figures: &[Markup]) -> Markup {
    html! { div.gallery { @for figure in figures { (figure) } } }
}

/// Small pictures side by side, such as frames.
pub fn tiles(figures: &[Markup]) -> Markup {
    html! { div.tiles { @for figure in figures { (figure) } } }
}

/// A picture with its caption; the caption is the text for those who cannot see it, too.
pub fn picture(uri: &str, caption: &str) -> Markup {
    html! { figure { img src=(uri) alt=(caption); figcaption { (caption) } } }
}

/// Photographs: small and good enough.
pub fn jpeg(picture: &RgbImage) -> Result<Vec<u8>, ReportError> {
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, 82)
        .encode_image(picture)
        .map_err(|error| ReportError::Encode { path: "a page's picture".into(), error })?;
    Ok(bytes)
}

pub fn jpeg_uri(picture: &RgbImage) -> Result<String, ReportError> {
    Ok(format!("data:image/jpeg;base64,{}", base64(&jpeg(picture)?)))
}

/// Drawings: sharp.
pub fn png_uri(picture: &RgbImage) -> Result<String, ReportError> {
    Ok(png_file_uri(&png_bytes("a page's picture".as_ref(), &DynamicImage::from(picture.clone()))?))
}

/// The bytes of a PNG file.
pub fn png_file_uri(bytes: &[u8]) -> String {
    format!("data:image/png;base64,{}", base64(bytes))
}

/// RFC 4648.
pub fn base64(bytes: &[u8]) -> String {
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
    }

    #[test]
    fn names_are_escaped_everywhere() {
        const NASTY: &str = "<script>alert(1)</script> \"Müller's\" & 'co'";
        let verdict = Verdict { grade: Grade::Look, sentence: NASTY.into(), notes: vec![NASTY.into()] };
        let body = html! {
            (facts(&[(NASTY, NASTY.into())]))
            (table(&[NASTY], &[vec![NASTY.into()]], 0))
            (picture("data:image/png;base64,", NASTY))
        };
        let text = page(NASTY, NASTY, &verdict, &[Section::new("A", body)]);
        assert_eq!(text.matches("<script").count(), 0);
        assert!(text.matches("&lt;script&gt;alert(1)&lt;/script&gt; &quot;Müller's&quot; &amp; 'co'").count() >= 10);
        assert!(!text.contains("\"Müller"));
        assert!(!text.contains("http:") && !text.contains("https:") && !STYLE.contains("url("));
    }
}
