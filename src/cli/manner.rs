//! Attributes and caricature of a generated motion, steady or over time.
use std::path::PathBuf;
use std::str::FromStr;

use anyhow::{Context, Result, bail};
use clap::Args;
use muybridge::io::space_npz::read_space;
use muybridge::motion::{Change, Course, Gait};
use muybridge::style::space::attributes::{direction, spread};
use muybridge::style::space::{Method, Space, Vectors};

use super::motions::file_name;

#[derive(Args)]
pub struct MannerArgs {
    /// Space of `blend build` that knows the attributes
    #[arg(long, value_name = "SPACE", requires = "attribute")]
    space: Option<PathBuf>,
    /// More or less of an attribute, in standard deviations of its labels, the others held: NAME=AMOUNT, or over time
    /// NAME=SECONDS:AMOUNT,SECONDS:AMOUNT; repeat for several
    #[arg(long, value_name = "NAME=AMOUNT", requires = "space", allow_hyphen_values = true)]
    attribute: Vec<Knob>,
    /// What is one's own against the model's people, exaggerated: 1 is the original, 0 the mean; DEGREE, or over time
    /// SECONDS:DEGREE,SECONDS:DEGREE
    #[arg(long, value_name = "DEGREE", allow_hyphen_values = true)]
    caricature: Option<Amount>,
}

/// An attribute and how much of it.
#[derive(Clone)]
struct Knob {
    name: String,
    amount: Amount,
}

#[derive(Clone)]
struct Amount(Vec<(f64, f64)>);

impl Amount {
    /// The highest value above zero and the lowest below it.
    fn sides(&self) -> impl Iterator<Item = f64> {
        let values = || self.0.iter().map(|p| p.1);
        [values().fold(0.0, f64::max), values().fold(0.0, f64::min)].into_iter().filter(|side| *side != 0.0)
    }
}

/// The same course with a point where it crosses zero, so that its two sides are straight too.
fn with_zeros(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let mut all = points[..1].to_vec();
    for w in points.windows(2) {
        let ((t, v), (u, w)) = (w[0], w[1]);
        all.extend((v * w < 0.0).then(|| (t + (u - t) * v / (v - w), 0.0)));
        all.push((u, w));
    }
    all
}

impl FromStr for Knob {
    type Err = String;
    fn from_str(text: &str) -> Result<Knob, String> {
        let (name, amount) = text.rsplit_once('=').ok_or("must be NAME=AMOUNT or NAME=SECONDS:AMOUNT,...")?;
        Ok(Knob { name: name.trim().into(), amount: amount.parse()? })
    }
}

impl FromStr for Amount {
    type Err = String;
    fn from_str(text: &str) -> Result<Amount, String> {
        let number = |t: &str| t.trim().parse::<f64>().map_err(|_| format!("`{t}` in `{text}` is not a number"));
        let point = |part: &str| match part.split_once(':') {
            Some((time_s, value)) => Ok((number(time_s.trim_end_matches('s'))?, number(value)?)),
            None => Ok((0.0, number(part)?)),
        };
        let points = text.split(',').map(point).collect::<Result<Vec<_>, String>>()?;
        Course::new(points.clone()).map_err(|e| e.to_string())?;
        Ok(Amount(with_zeros(&points)))
    }
}

/// What [`MannerArgs`] ask for, read once for all motions.
pub struct Manner<'a> {
    args: &'a MannerArgs,
    /// The space with one standard deviation more of every attribute that is asked for, the others held.
    space: Option<(Space, Vec<Vectors>)>,
    /// Amounts over time, in the order in which [`Manner::teach`] adds the changes.
    pub courses: Vec<Course>,
}

impl MannerArgs {
    pub fn is_plain(&self) -> bool {
        self.attribute.is_empty() && self.caricature.is_none()
    }

    /// Reads the space.
    pub fn read(&self) -> Result<Manner<'_>> {
        let space = self.space.as_ref().map(|path| {
            let space = read_space(path)?;
            if !space.layout.cyclic {
                bail!("{} is a space of whole motions; attributes of gaits need one of cycles", file_name(path));
            }
            let units = self.attribute.iter().map(|knob| unit(&space, &knob.name)).collect::<Result<Vec<_>>>()?;
            Ok((space, units))
        });
        Ok(Manner { args: self, space: space.transpose()?, courses: self.courses()? })
    }

    /// Attributes that stay as they are make one change together.
    fn is_steady(&self) -> bool {
        !self.attribute.is_empty() && self.attribute.iter().all(|knob| knob.amount.0.len() == 1)
    }

    fn courses(&self) -> Result<Vec<Course>> {
        let scaled = |a: &Amount, f: &dyn Fn(f64) -> f64| a.0.iter().map(|(t, v)| (*t, f(*v))).collect();
        let sides = |knob: &Knob| knob.amount.sides().map(|side| scaled(&knob.amount, &|v| (v / side).max(0.0))).collect::<Vec<_>>();
        let mut all: Vec<Vec<(f64, f64)>> =
            if self.is_steady() { vec![vec![(0.0, 1.0)]] } else { self.attribute.iter().flat_map(sides).collect() };
        all.extend(self.caricature.iter().map(|degree| scaled(degree, &|v| v - 1.0)));
        Ok(all.into_iter().map(Course::new).collect::<Result<_, _>>()?)
    }
}

impl Manner<'_> {
    /// Adds the changes to a gait; `typical` is that of the model's people on average, and `speed_m_s` where the two are compared.
    pub fn teach(&self, gait: &mut Gait, typical: impl FnOnce() -> Option<Gait>, speed_m_s: f64) -> Result<()> {
        let mut changes = self.attributes(gait);
        if self.args.caricature.is_some() {
            changes.push(gait.difference(&typical().context("the model's people make no gait")?, speed_m_s));
        }
        for change in changes {
            gait.add_change(change).context("a change of another length than the gait's")?;
        }
        Ok(())
    }

    /// All attributes together where they are steady, else the most and the least wanted of each: what `blend attribute` makes.
    fn attributes(&self, gait: &Gait) -> Vec<Change> {
        let Some((space, units)) = &self.space else { return Vec::new() };
        let mean = space.mean();
        let change = |to: &Vectors| gait.change(&space.play(&mean), &space.play(to));
        let knobs = || self.args.attribute.iter().zip(units);
        if self.args.is_steady() {
            let all = knobs().flat_map(|(knob, unit)| knob.amount.0.iter().map(move |point| (point.1, unit)));
            return vec![change(&all.fold(mean.clone(), |sum, (amount, unit)| sum.plus(unit, amount, amount)))];
        }
        knobs().flat_map(|(knob, unit)| knob.amount.sides().map(|side| change(&mean.plus(unit, side, side))).collect::<Vec<_>>()).collect()
    }
}

/// One standard deviation more of an attribute, the others held.
fn unit(space: &Space, name: &str) -> Result<Vectors> {
    let attribute = space.attribute(name)?;
    let all: Vec<usize> = (0..space.attributes.len()).collect();
    let vector = direction(space, attribute, Method::Joint, &all)?;
    let deviation = spread(&space.attributes[attribute]).1;
    Ok(Vectors { shape: vector.shape * deviation, timing: vector.timing * deviation })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn amounts_are_numbers_or_courses() {
        let knob: Knob = "hand-height=-1.5".parse().unwrap();
        assert_eq!((knob.name.as_str(), knob.amount.0), ("hand-height", vec![(0.0, -1.5)]));
        let course: Amount = "1:0, 4s:2".parse().unwrap();
        assert_eq!(course.0, [(1.0, 0.0), (4.0, 2.0)]);
        let sides = |text: &str| text.parse::<Amount>().unwrap().sides().collect::<Vec<_>>();
        assert_eq!([sides("1:0.5,2:-2,3:1"), sides("0"), sides("-0.3")], [vec![1.0, -2.0], vec![], vec![-0.3]]);
        let attribute = vec!["energy=1:0.5,2:-2,3:1".parse().unwrap()];
        let courses = MannerArgs { space: None, attribute, caricature: "1.3".parse().ok() }.courses().unwrap();
        assert_eq!([1.0, 1.2, 2.0, 3.0].map(|t| courses[0].at(t)), [0.5, 0.0, 0.0, 1.0]);
        assert_eq!([1.0, 1.2, 2.0, 3.0].map(|t| courses[1].at(t)), [0.0, 0.0, 1.0, 0.0]);
        assert!(courses.len() == 3 && (courses[2].at(7.0) - 0.3).abs() < 1e-12);
        let attribute = ["energy=1", "grace=-2"].map(|k| k.parse().unwrap()).to_vec();
        let steady = MannerArgs { space: None, attribute, caricature: None }.courses().unwrap();
        assert!(steady.len() == 1 && steady[0].at(3.0) == 1.0);
        let said = |text: &str| text.parse::<Knob>().err().unwrap();
        assert!(said("energy").contains("NAME=AMOUNT") && said("energy=much").contains("`much` in `much` is not a number"));
        assert!(said("energy=0:1,0:2").contains("times must increase") && said("energy=nan").contains("finite"));
    }
}
