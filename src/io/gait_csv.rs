//! `gait.csv` and `angles_cycle.csv`: a person's strides as a gait laboratory tabulates them, degrees and percent.

use std::fmt::Write;
use std::path::Path;

use super::write_atomic;
use crate::fit::whole_cycle::LegAngles;
use crate::motion_model::gait::{Line, Measure, PERCENTS};

/// Sides in the order of [`Gait::feet`](crate::motion_model::Gait).
pub const SIDES: [&str; 2] = ["left", "right"];

/// Writes `source,measure,unit,side,mean,sd,n,asymmetry_percent`; each table comes with its source's name.
pub fn write_gait(path: &Path, tables: &[(&str, &[Line])]) -> std::io::Result<()> {
    let mut text = String::from("source,measure,unit,side,mean,sd,n,asymmetry_percent\n");
    for (source, lines) in tables {
        for line in *lines {
            let asymmetry = line.asymmetry_percent().map_or(String::new(), |a| format!("{a:.2}"));
            let mut row = |side: &str, measure: Option<Measure>| {
                let Some(m) = measure else { return };
                let sd = m.sd.map_or(String::new(), |sd| format!("{sd:.5}"));
                // Writing to a string cannot fail.
                let _ = writeln!(text, "{source},{},{},{side},{:.5},{sd},{},{asymmetry}", line.name, line.unit, m.mean, m.n);
            };
            SIDES.iter().zip(line.sides).for_each(|(side, m)| row(side, m));
            row("both", line.both);
        }
    }
    write_atomic(path, text.as_bytes())
}

/// Curves of one leg.
pub struct CycleAngles<'a> {
    /// `cycle` for the fitted person's whole cycle, `stride 1` and so on for single strides.
    pub source: String,
    /// 0 left, 1 right.
    pub foot: usize,
    /// Hip, knee, ankle, radians.
    pub angles: &'a [[f64; PERCENTS]; 3],
    pub sigmas: Option<&'a [[f64; PERCENTS]; 3]>,
}

impl<'a> CycleAngles<'a> {
    pub fn of_cycle(foot: usize, leg: &'a LegAngles) -> CycleAngles<'a> {
        CycleAngles { source: "cycle".into(), foot, angles: &leg.angles, sigmas: Some(&leg.sigmas) }
    }
}

/// Writes `source,side,percent` and for each of hip flexion, knee flexion and ankle dorsiflexion the angle and its standard
/// deviation in degrees; empty where it is not known.
pub fn write_angles(path: &Path, curves: &[CycleAngles]) -> std::io::Result<()> {
    let mut text = String::from(
        "source,side,percent,hip_flexion_deg,hip_sigma_deg,knee_flexion_deg,knee_sigma_deg,ankle_dorsiflexion_deg,ankle_sigma_deg\n",
    );
    for curve in curves {
        for k in 0..PERCENTS {
            let _ = write!(text, "{},{},{k}", curve.source, SIDES[curve.foot.min(1)]);
            for j in 0..3 {
                let sigma = curve.sigmas.map(|s| s[j][k]).filter(|s| s.is_finite());
                let sigma = sigma.map_or(String::new(), |s| format!("{:.3}", s.to_degrees()));
                let _ = write!(text, ",{:.3},{sigma}", curve.angles[j][k].to_degrees());
            }
            text.push('\n');
        }
    }
    write_atomic(path, text.as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_have_one_row_per_value() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("gait.csv");
        let m = |mean, n| Some(Measure { mean, sd: (n > 1).then_some(0.01), n });
        let lines = [Line { name: "step length", unit: "m", sides: [m(0.66, 2), m(0.6, 1)], both: m(0.63, 3) }];
        write_gait(&path, &[("filmed", &lines)]).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        let rows: Vec<&str> = text.lines().skip(1).collect();
        assert_eq!(
            rows,
            [
                "filmed,step length,m,left,0.66000,0.01000,2,9.52",
                "filmed,step length,m,right,0.60000,,1,9.52",
                "filmed,step length,m,both,0.63000,0.01000,3,9.52"
            ]
        );
        let path = folder.path().join("angles_cycle.csv");
        let (angles, sigmas) = ([[0.5; PERCENTS]; 3], [[f64::NAN; PERCENTS], [0.1; PERCENTS], [0.1; PERCENTS]]);
        write_angles(&path, &[CycleAngles { source: "cycle".into(), foot: 1, angles: &angles, sigmas: Some(&sigmas) }]).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        assert_eq!(text.lines().nth(101), Some("cycle,right,100,28.648,,28.648,5.730,28.648,5.730"));
    }
}
