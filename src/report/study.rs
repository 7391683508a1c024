//! A study at a glance: one row per session, failures first, each with a picture and a way to its own report.

use std::fmt::Write;

use maud::{Markup, PreEscaped, html};

use super::page::{Grade, Section, Verdict, base64, page};

const SCRIPT: &str = include_str!("study.js");

/// One session.
#[derive(Clone, Debug, Default)]
pub struct StudyRow<'a> {
    pub session: &'a str,
    /// `failed`, `running`, `pending` or `done`.
    pub state: &'a str,
    /// Why it failed or waits.
    pub reason: Option<&'a str>,
    /// Path of the session's report from the page, parts joined by `/`.
    pub report: Option<&'a str>,
    /// Bytes of a JPEG.
    pub thumbnail: Option<&'a [u8]>,
    /// What [`Study::columns`] names; numbers as they are to be read.
    pub values: Vec<String>,
}

/// A study's sessions, in natural order.
#[derive(Clone, Debug, Default)]
pub struct Study<'a> {
    pub title: &'a str,
    pub columns: Vec<&'a str>,
    pub rows: Vec<StudyRow<'a>>,
}

/// Failures first.
const ORDER: [&str; 4] = ["failed", "running", "pending", "done"];

fn rank(state: &str) -> usize {
    ORDER.iter().position(|s| *s == state).unwrap_or(0)
}

fn grade(state: &str) -> Grade {
    match state {
        "done" => Grade::Good,
        "pending" | "running" => Grade::Look,
        _ => Grade::Failed,
    }
}

/// The whole page.
pub fn html(study: &Study) -> String {
    let mut rows: Vec<&StudyRow> = study.rows.iter().collect();
    rows.sort_by_key(|row| rank(row.state));
    page("muybridge batch", study.title, &verdict(study), &[Section::new("Sessions", body(study, &rows))])
}

fn verdict(study: &Study) -> Verdict {
    let count = |state: &str| study.rows.iter().filter(|r| rank(r.state) == rank(state)).count();
    let words: Vec<String> = ORDER.iter().rev().filter(|s| count(s) > 0).map(|s| format!("{} {s}", count(s))).collect();
    let sentence = match study.rows.len() {
        0 => "No sessions.".to_string(),
        n => format!("{n} sessions: {}.", words.join(", ")),
    };
    let grade = if count("failed") > 0 {
        Grade::Failed
    } else if count("done") == study.rows.len() {
        Grade::Good
    } else {
        Grade::Look
    };
    Verdict { grade, sentence, notes: Vec::new() }
}

fn body(study: &Study, rows: &[&StudyRow]) -> Markup {
    let pictures = study.rows.iter().any(|r| r.thumbnail.is_some());
    let reasons = study.rows.iter().any(|r| r.reason.is_some());
    let sortable = |name: &str, class: &str| html! { th class=(class) scope="col" aria-sort="none" { button type="button" { (name) } } };
    html! {
        p.soft.small { "Failures first. A click on a heading sorts; the name opens the session's own report." }
        div.scroll {
            table.study id="study" {
                thead {
                    tr {
                        @if pictures { th scope="col" {} }
                        (sortable("session", ""))
                        (sortable("state", ""))
                        @if reasons { (sortable("reason", "")) }
                        @for column in &study.columns { (sortable(column, "number")) }
                    }
                }
                tbody {
                    @for row in rows {
                        tr {
                            @if pictures { td { (thumbnail(row)) } }
                            td data-key=(row.session) { @if let Some(report) = row.report { a href=(link(report)) { (row.session) } } @else { (row.session) } }
                            td data-key=(rank(row.state)) { span class={ "grade " (grade(row.state).class()) } { (row.state) } }
                            @if reasons { td.reason { (row.reason.unwrap_or("")) } }
                            @for k in 0..study.columns.len() { td.number { (row.values.get(k).map_or("", String::as_str)) } }
                        }
                    }
                }
            }
        }
        script { (PreEscaped(SCRIPT)) }
    }
}

fn thumbnail(row: &StudyRow) -> Markup {
    html! {
        @if let Some(bytes) = row.thumbnail {
            img src={ "data:image/jpeg;base64," (base64(bytes)) } alt={ "a frame of " (row.session) };
        }
    }
}

/// A relative reference whose path no name can turn into anything else.
fn link(path: &str) -> String {
    path.bytes().fold(String::from("./"), |mut text, byte| {
        if byte.is_ascii_alphanumeric() || b"-._~/".contains(&byte) {
            text.push(char::from(byte));
        } else {
            // Writing to a string cannot fail.
            let _ = write!(text, "%{byte:02X}");
        }
        text
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn failures_come_first_and_names_are_harmless() {
        let row = |session, state| StudyRow { session, state, ..StudyRow::default() };
        let mut rows = vec![row("a1", "done"), row("b2", "failed"), row("c3", "pending"), row("d4", "done"), row("e5", "failed")];
        rows[1].reason = Some("<script>alert(1)</script>");
        rows[0].report = Some("a b/\"x\"?#ü.html");
        rows[3].values = vec!["1.25".into()];
        let text = html(&Study { title: "<b>", columns: vec!["speed (m/s)"], rows });
        let places: Vec<usize> = ["b2", "e5", "c3", "a1", "d4"].iter().map(|n| text.find(&format!("data-key=\"{n}\"")).unwrap()).collect();
        assert!(places.is_sorted(), "{places:?}");
        assert!(text.contains("5 sessions: 2 done, 1 pending, 2 failed."));
        assert!(text.contains("href=\"./a%20b/%22x%22%3F%23%C3%BC.html\"") && text.contains("&lt;script&gt;alert(1)"));
        assert!(!text.contains("<script>alert") && !text.contains("<b>") && text.contains("<td class=\"number\">1.25</td>"));
        assert_eq!(link("javascript:alert(1)"), "./javascript%3Aalert%281%29");
        assert!(html(&Study::default()).contains("No sessions."));
    }
}
