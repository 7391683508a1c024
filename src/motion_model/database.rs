//! The set of cycles that a model is built from.
//!
//! Real databases hold a few subjects with dozens of repeats; left alone, these would own the mean and the first components.

use super::cycle::Cycle;

/// No subject counts for more than this many times the median subject's number of cycles. Less throws away the knowledge of
/// how one person varies, more turns the model into that person's.
pub const MEDIAN_MULTIPLE: usize = 3;

/// A subject whose cycles were thinned.
#[derive(Clone, Debug, PartialEq)]
pub struct Thinned {
    pub subject: String,
    pub before: usize,
    pub after: usize,
}

/// Keeps at most [`MEDIAN_MULTIPLE`] times the median count per subject, evenly over the subject's parameters; order is kept.
pub fn thin(cycles: Vec<Cycle>) -> (Vec<Cycle>, Vec<Thinned>) {
    let mut subjects: Vec<String> = cycles.iter().map(|c| c.subject.clone()).collect();
    subjects.sort_by(|a, b| natord::compare(a, b).then(a.cmp(b)));
    subjects.dedup();
    let indices = |subject: &str| -> Vec<usize> { (0..cycles.len()).filter(|&i| cycles[i].subject == subject).collect() };
    let mut counts: Vec<usize> = subjects.iter().map(|s| indices(s).len()).collect();
    counts.sort();
    let most = MEDIAN_MULTIPLE * counts.get(counts.len() / 2).copied().unwrap_or(0);
    let (mut keep, mut thinned) = (vec![true; cycles.len()], Vec::new());
    for subject in subjects {
        let mut own = indices(&subject);
        if own.len() > most {
            own.sort_by(|&a, &b| cycles[a].parameter.total_cmp(&cycles[b].parameter).then(a.cmp(&b)));
            own.iter().for_each(|&i| keep[i] = false);
            (0..most).for_each(|k| keep[own[(2 * k + 1) * own.len() / (2 * most)]] = true);
            thinned.push(Thinned { subject, before: own.len(), after: most });
        }
    }
    let kept = cycles.into_iter().zip(keep).filter_map(|(c, k)| k.then_some(c)).collect();
    (kept, thinned)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion_model::Activity;

    fn cycle(subject: &str, parameter: f64) -> Cycle {
        Cycle {
            subject: subject.into(),
            source: String::new(),
            activity: Activity::Walking,
            parameter,
            hip_height_m: 0.9,
            duration_s: 1.0,
            joints: Vec::new(),
            root: Vec::new(),
        }
    }

    #[test]
    fn thins_evenly_over_speeds_and_keeps_the_rest() {
        let mut cycles: Vec<Cycle> = (0..20).map(|i| cycle("many", (i * 7 % 20) as f64)).collect();
        cycles.extend(["a", "a", "b", "b", "c"].map(|s| cycle(s, 1.0)));
        let (kept, thinned) = thin(cycles);
        assert_eq!(thinned, [Thinned { subject: "many".into(), before: 20, after: 6 }]);
        let mut speeds: Vec<f64> = kept.iter().filter(|c| c.subject == "many").map(|c| c.parameter).collect();
        speeds.sort_by(f64::total_cmp);
        assert_eq!(speeds, [1.0, 5.0, 8.0, 11.0, 15.0, 18.0]);
        assert_eq!(kept.len(), 11);
    }

    #[test]
    fn equal_subjects_stay_whole() {
        let cycles: Vec<Cycle> = ["a", "b", "a", "b"].map(|s| cycle(s, 1.0)).to_vec();
        assert_eq!(thin(cycles).0.len(), 4);
    }
}
