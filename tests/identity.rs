//! Who a recorded walk belongs to: every CMU trial against a database that has the others, equation (6) beside the evidence.

use muybridge::motion_model::{Activity, Cycle, Model, database};
use muybridge::style::curves::mean_vector;
use muybridge::style::{Pace, Population, Style, curves::knots, identity};
use nalgebra::DVector;
use rayon::prelude::*;

const COMPONENTS: usize = 20;

fn trial(cycle: &Cycle) -> &str {
    cycle.source.split(' ').next().unwrap()
}

#[test]
fn recorded_walkers_are_found_by_evidence() {
    let Some(cycles) = crate::common::cycles("cmu-asfamc", Activity::Walking) else { return };
    let cycles = database::thin(cycles).0;
    let mut trials: Vec<&str> = cycles.iter().map(trial).collect();
    trials.sort();
    trials.dedup();
    // Right by equation (6), by evidence, and whether the person is rather this one than a stranger.
    let found: Vec<[bool; 3]> = trials
        .par_iter()
        .filter_map(|name| {
            let (own, others): (Vec<Cycle>, Vec<Cycle>) = cycles.iter().cloned().partition(|c| trial(c) == *name);
            let subject = own[0].subject.clone();
            others.iter().any(|c| c.subject == subject).then(|| {
                let model = Model::build(Activity::Walking, false, &others).unwrap();
                let members: Vec<_> = own.iter().map(|c| model.member_of(c)).collect();
                let knot = &knots(&members)[0];
                let vector = mean_vector(knot);
                let weights: DVector<f64> = model.project(&vector).rows(0, COMPONENTS).into_owned();
                let style =
                    Style::of_weights(&model, "", &weights, Pace { parameter: knot.parameter, hip_height_m: 0.9, frequency_hz: 1.0 });
                let population = Population::new(&model, COMPONENTS);
                let odds = identity::recognise(&population, &model, &vector, knot.parameter).unwrap().odds;
                let best = odds.iter().max_by(|a, b| a.1.total_cmp(&b.1)).unwrap();
                [style.neighbours[0].subject == subject, best.0 == subject, best.0 == subject && best.1 > 0.0]
            })
        })
        .collect();
    // People without any cycle in the database who seem to be one of its subjects all the same.
    let mut people: Vec<&str> = cycles.iter().map(|c| c.subject.as_str()).collect();
    people.dedup();
    let taken_for_another = |name: &&&str| {
        let (own, others): (Vec<Cycle>, Vec<Cycle>) = cycles.iter().cloned().partition(|c| c.subject == ***name);
        let model = Model::build(Activity::Walking, false, &others).unwrap();
        let odds =
            identity::recognise(&Population::new(&model, COMPONENTS), &model, &model.vector_of(&own[0]), own[0].parameter).unwrap().odds;
        odds.iter().any(|(_, odds)| *odds > 0.0)
    };
    println!("{} of {} strangers are taken for somebody", people.par_iter().filter(taken_for_another).count(), people.len());
    let right = |k: usize| found.iter().filter(|f| f[k]).count();
    println!("{} trials: equation (6) {}, evidence {}, of these not a stranger {}", found.len(), right(0), right(1), right(2));
    assert!(found.len() > 30 && right(1) >= right(0) && 10 * right(1) >= 9 * found.len() && 10 * right(2) >= 8 * found.len());
}
