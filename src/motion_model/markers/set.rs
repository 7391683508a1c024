//! Marker sets: which marker rides on which segment, and about where.
//!
//! A set is a TOML file: tables `middle` and `left` of `NAME = { on, near, at, spread, also }`. `on` is the H-Anim node that the
//! marker rides on, `near` the node from which `at` counts (`on` itself, or a child that it carries), `at` metres in a body of
//! [`STATURE_M`] at rest (x left, y up, z forward), `spread` the standard deviation of `at` between people and technicians, `also`
//! other names. Entries of `left` are mirrored: names that begin with L get a right twin with R.
//! Names are compared without the subject's prefix (`Subject:LASI`), case and blanks.

use std::collections::BTreeMap;

use nalgebra::Vector3;
use serde::Deserialize;

use crate::body::Joint;

/// Stature of the body that a set's offsets belong to, metres.
pub const STATURE_M: f64 = 1.75;
/// Spread of a marker on a bone's landmark, metres.
const LANDMARK_M: f64 = 0.02;
/// Markers on the pelvis that place it, and on each leg that show it.
const PELVIS: usize = 3;
const LEG: usize = 4;

#[derive(Clone, Debug, PartialEq)]
pub struct SetMarker {
    /// First the set's own name, then others.
    pub names: Vec<String>,
    pub on: Joint,
    /// The node from which `at` counts, `on` or a child of it.
    pub near: Joint,
    /// Metres in a body of [`STATURE_M`].
    pub at: Vector3<f64>,
    pub spread_m: f64,
}

#[derive(Clone, Debug, PartialEq)]
pub struct MarkerSet {
    pub name: String,
    pub markers: Vec<SetMarker>,
}

/// A column of a recording and the marker of the set that it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Match {
    pub column: usize,
    pub marker: usize,
}

#[derive(Debug, thiserror::Error, PartialEq)]
pub enum SetError {
    #[error("{0}")]
    Syntax(String),
    #[error("marker {marker}: no node `{node}`; write an H-Anim name like l_knee or humanoid_root")]
    Node { marker: String, node: String },
    #[error("marker {marker}: `near` is {near}, which {on} does not carry")]
    Near { marker: String, near: &'static str, on: &'static str },
    #[error("marker {marker}: `at` and `spread` must be metres below 1")]
    Size { marker: String },
    #[error("marker {0} stands in [left] but does not begin with L")]
    Side(String),
    #[error("marker {0} has two places")]
    Twice(String),
    #[error(
        "the markers fit no known set ({nearest} comes nearest but misses {missing}): describe yours in a markers.toml beside the file; seen are {names}"
    )]
    Unknown { nearest: String, missing: String, names: String },
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    name: String,
    #[serde(default)]
    middle: BTreeMap<String, Entry>,
    #[serde(default)]
    left: BTreeMap<String, Entry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    on: String,
    near: Option<String>,
    at: [f64; 3],
    spread: Option<f64>,
    #[serde(default)]
    also: Vec<String>,
}

impl MarkerSet {
    pub fn parse(text: &str) -> Result<MarkerSet, SetError> {
        let file: File = toml::from_str(text).map_err(|e| SetError::Syntax(e.to_string().lines().collect::<Vec<_>>().join(" ")))?;
        let mut markers = Vec::new();
        for (name, entry) in &file.middle {
            markers.push(marker(name, entry)?);
        }
        for (name, entry) in &file.left {
            let left = marker(name, entry)?;
            markers.push(mirrored(&left)?);
            markers.push(left);
        }
        let mut names: Vec<String> = markers.iter().flat_map(|m| m.names.iter().map(|n| plain(n))).collect();
        names.sort();
        match names.windows(2).find(|w| w[0] == w[1]) {
            Some(twice) => Err(SetError::Twice(twice[0].clone())),
            None => Ok(MarkerSet { name: file.name, markers }),
        }
    }

    /// The sets that need no file: Plug-in Gait, Hamner and Delp's runners, Schreiber and Moissenet's walkers.
    pub fn supplied() -> Result<Vec<MarkerSet>, SetError> {
        [include_str!("sets/plug_in_gait.toml"), include_str!("sets/hamner.toml"), include_str!("sets/schreiber_moissenet.toml")]
            .into_iter()
            .map(MarkerSet::parse)
            .collect()
    }

    /// Which columns are which markers; of columns with one name the first counts.
    pub fn matches(&self, columns: &[String]) -> Vec<Match> {
        let columns: Vec<String> = columns.iter().map(|c| plain(c)).collect();
        let column_of = |m: &SetMarker| m.names.iter().find_map(|n| columns.iter().position(|c| *c == plain(n)));
        self.markers.iter().enumerate().filter_map(|(marker, m)| Some(Match { column: column_of(m)?, marker })).collect()
    }

    /// What the matched markers cannot show; empty when legs and pelvis are seen.
    fn missing(&self, matches: &[Match]) -> Vec<&'static str> {
        let count = |joints: &[Joint]| matches.iter().filter(|m| joints.contains(&self.markers[m.marker].on)).count();
        use Joint::*;
        let parts = [
            ("the pelvis", PELVIS, &[Root, Sacroiliac][..]),
            ("the left leg", LEG, &[LHip, LKnee, LAnkle, LMidtarsal]),
            ("the right leg", LEG, &[RHip, RKnee, RAnkle, RMidtarsal]),
        ];
        parts.iter().filter(|(_, least, joints)| count(joints) < *least).map(|(what, ..)| *what).collect()
    }
}

/// The set that explains most of the columns' names, and which column is which of its markers.
pub fn choose<'a>(sets: &'a [MarkerSet], columns: &[String]) -> Result<(&'a MarkerSet, Vec<Match>), SetError> {
    // The first of equals.
    let best = sets.iter().map(|s| (s, s.matches(columns))).rev().max_by_key(|(_, m)| m.len());
    let Some((set, matches)) = best else { return Err(SetError::Syntax("no marker set is given".into())) };
    let missing = set.missing(&matches);
    if missing.is_empty() {
        return Ok((set, matches));
    }
    const SHOWN: usize = 24;
    let mut names = columns.iter().take(SHOWN).map(|c| c.trim()).collect::<Vec<_>>().join(" ");
    if columns.len() > SHOWN {
        names += &format!(" and {} more", columns.len() - SHOWN);
    }
    Err(SetError::Unknown { nearest: set.name.clone(), missing: missing.join(", "), names })
}

/// Without the subject's prefix, in capitals, without blanks.
fn plain(name: &str) -> String {
    let last = name.rsplit(':').next().unwrap_or(name);
    last.chars().filter(|c| !c.is_whitespace() && !c.is_control()).flat_map(char::to_uppercase).collect()
}

fn node(marker: &str, name: &str) -> Result<Joint, SetError> {
    let found = Joint::ALL.into_iter().find(|j| j.name() == name);
    found.ok_or_else(|| SetError::Node { marker: marker.into(), node: name.into() })
}

fn marker(name: &str, entry: &Entry) -> Result<SetMarker, SetError> {
    let on = node(name, &entry.on)?;
    let near = entry.near.as_ref().map_or(Ok(on), |n| node(name, n))?;
    if near != on && near.parent() != Some(on) {
        return Err(SetError::Near { marker: name.into(), near: near.name(), on: on.name() });
    }
    let spread_m = entry.spread.unwrap_or(LANDMARK_M);
    if !(entry.at.iter().all(|v| v.abs() < 1.0) && spread_m > 0.0 && spread_m < 1.0) {
        return Err(SetError::Size { marker: name.into() });
    }
    let names = std::iter::once(name.to_string()).chain(entry.also.iter().cloned()).collect();
    Ok(SetMarker { names, on, near, at: Vector3::from(entry.at), spread_m })
}

fn mirrored(left: &SetMarker) -> Result<SetMarker, SetError> {
    let other = |name: &String| {
        let rest = name.strip_prefix(['L', 'l']).ok_or_else(|| SetError::Side(name.clone()))?;
        Ok(format!("R{rest}"))
    };
    Ok(SetMarker {
        names: left.names.iter().map(other).collect::<Result<_, _>>()?,
        on: left.on.mirror(),
        near: left.near.mirror(),
        at: Vector3::new(-left.at.x, left.at.y, left.at.z),
        spread_m: left.spread_m,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn columns(text: &str) -> Vec<String> {
        text.split_whitespace().map(str::to_string).collect()
    }

    #[test]
    fn supplied_sets_are_chosen_by_the_names_present() {
        let sets = MarkerSet::supplied().unwrap();
        assert_eq!(sets.iter().map(|s| s.markers.len()).collect::<Vec<_>>(), [6 + 2 * 17, 2 + 2 * 26, 4 + 2 * 24]);
        let vicon =
            "Jo:LASI Jo:RASI Jo:SACR Jo:LTHI Jo:LKNE Jo:LTIB Jo:LANK Jo:LHEE Jo:LTOE Jo:RTHI Jo:RKNE Jo:RTIB Jo:RANK Jo:RHEE Jo:RTOE";
        let (set, matches) = choose(&sets, &columns(vicon)).unwrap();
        assert_eq!((set.name.as_str(), matches.len()), ("Plug-in Gait", 15));
        let left_ankle = matches.iter().find(|m| m.column == 6).unwrap();
        assert_eq!((set.markers[left_ankle.marker].on, set.markers[left_ankle.marker].near), (Joint::LKnee, Joint::LAnkle));
        let (set, _) = choose(&sets, &columns("LASI RASI LPSI RPSI LTH1 LTH2 LTH3 LTB1 LTB2 RTH1 RTH2 RTB1 RTB2 RCAL RTOE")).unwrap();
        assert_eq!(set.name, "Hamner and Delp");
        let (set, _) = choose(&sets, &columns("l_ias r_ias l_ips L_FLE L_FME L_FAL L_FCC R_FLE R_FME R_FAL R_FCC")).unwrap();
        assert_eq!(set.name, "Schreiber and Moissenet");
    }

    #[test]
    fn mirrored_markers_lie_on_the_other_side() {
        let set = MarkerSet::parse("name = \"x\"\n[left]\nL_X = { also = [\"Lx2\"], on = \"l_hip\", at = [0.1, 0.2, 0.3] }\n").unwrap();
        let right = &set.markers[0];
        assert_eq!((right.names.clone(), right.on, right.at.x), (vec!["R_X".to_string(), "Rx2".to_string()], Joint::RHip, -0.1));
    }

    #[test]
    fn errors_say_what_to_mend() {
        let sets = MarkerSet::supplied().unwrap();
        let error = choose(&sets, &columns("LASI RASI LPSI LKNE LANK LHEE LTOE M1 M2")).unwrap_err().to_string();
        assert!(error.contains("Plug-in Gait comes nearest but misses the right leg") && error.contains("M1 M2"), "{error}");
        for (text, part) in [
            ("name = 1", "invalid type"),
            ("name = \"x\"\n[middle]\nA = { on = \"tail\", at = [0, 0, 0] }", "no node `tail`"),
            ("name = \"x\"\n[middle]\nA = { on = \"l_hip\", near = \"l_ankle\", at = [0, 0, 0] }", "`near` is l_ankle"),
            ("name = \"x\"\n[middle]\nA = { on = \"l_hip\", at = [40, 0, 0] }", "metres"),
            ("name = \"x\"\n[left]\nA = { on = \"l_hip\", at = [0, 0, 0] }", "A stands in [left]"),
            ("name = \"x\"\n[middle]\nA = { on = \"l_hip\", at = [0, 0, 0], also = [\"a\"] }", "A has two places"),
        ] {
            let error = MarkerSet::parse(text).unwrap_err().to_string();
            assert!(error.contains(part) && !error.contains('\n'), "{error}");
        }
    }
}
