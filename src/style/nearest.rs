//! The database subject who moves most like a person, by equation (6), and that subject's own motion at any parameter.
//! Checked against the smallest distance to any subject's mean motion.

use nalgebra::DVector;

use super::Style;
use super::curves::{Curve, Population};
use crate::motion_model::{Cycle, Model};

/// A database subject with its whole motion.
pub struct Nearest {
    pub subject: String,
    /// Distance (6) over the person's weights.
    pub distance: f64,
    curve: Curve,
    population: Population,
}

impl Nearest {
    /// Of the subjects who move at the parameter of `style`; `None` where the database holds nobody.
    pub fn new(model: &Model, style: &Style) -> Option<Nearest> {
        let (weights, _) = style.place();
        let weights = DVector::from_column_slice(&weights[..weights.len().min(model.basis.ncols())]);
        let found = Population::new(model, weights.len()).neighbours(model, &weights, style.parameter);
        let first = found.first()?;
        let population = Population::new(model, model.basis.ncols());
        let curve = population.curves.iter().find(|c| c.subject == first.subject)?.clone();
        Some(Nearest { subject: first.subject.clone(), distance: first.distance, curve, population })
    }

    /// The subject's mean motion at a speed or length, for a body of `hip_height_m`.
    pub fn cycle(&self, model: &Model, parameter: f64, hip_height_m: f64) -> Cycle {
        let weights = self.population.extended(&self.curve, parameter);
        let duration_s = 1.0 / model.cadence().frequency_hz(parameter, hip_height_m);
        model.cycle(weights.as_slice(), &self.subject, parameter, hip_height_m, duration_s)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion_model::{Activity, synthetic};

    #[test]
    fn nobody_is_nearer_by_brute_force() {
        let speeds = [0.9, 1.2, 1.5];
        let cycles: Vec<Cycle> = (1..=6).flat_map(|s| speeds.map(|v| synthetic::subject(Activity::Walking, s).mean_cycle(v))).collect();
        let model = Model::build(Activity::Walking, true, &cycles).unwrap();
        for stranger in 1000..1004 {
            let own = synthetic::subject(Activity::Walking, stranger).mean_cycle(1.2);
            let style = Style::of_cycles(&model, "", std::slice::from_ref(&own)).unwrap();
            let found = Nearest::new(&model, &style).unwrap();
            let weights = model.project(&model.vector_of(&own));
            let squared: f64 = model.eigenvalues[..weights.len()].iter().map(|l| l * l).sum();
            let at = |cycle: &Cycle| {
                let theirs = model.project(&model.vector_of(cycle));
                let terms = weights.iter().zip(&theirs).zip(&model.eigenvalues);
                (terms.map(|((a, b), l)| (l * (a - b)).powi(2)).sum::<f64>() / squared).sqrt()
            };
            let there = cycles.iter().filter(|c| c.parameter == 1.2);
            let best = there.min_by(|a, b| at(a).total_cmp(&at(b))).unwrap();
            assert_eq!(found.subject, best.subject);
            assert!((found.distance - at(best)).abs() < 1e-9 * (1.0 + at(best)));
            // What is stored of the basis holds 99 % of the variance.
            let (shown, recorded) = (found.cycle(&model, 1.2, 0.9), best);
            let off = (model.vector_of(&shown) - model.vector_of(recorded)).norm();
            let between = (model.vector_of(&own) - model.vector_of(recorded)).norm();
            assert!(off < 0.3 * between, "{off} {between}");
        }
    }
}
