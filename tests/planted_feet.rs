//! Planted feet of recorded people, whose toes move, followed by forward kinematics. Data lie beside the project; without them
//! the test says so and passes.

use crate::common::cycles;
use muybridge::body::{Clip, Joint, Shape};
use muybridge::math::{order, rotation::log};
use muybridge::motion::contact::FootTrack;
use muybridge::motion::footing::LEGS;
use muybridge::motion::{Length, Planted, plant_feet, play, synthesize};
use muybridge::motion_model::{Activity, Cycle, Model, database};
use muybridge::style::{Method, Population, Style};
use nalgebra::Vector3;

/// How far a point of the sole goes from where it touched (on the floor or within 2 mm of the lowest), per contact, mm.
fn drifts_mm(clip: &Clip, planted: &Planted) -> Vec<f64> {
    let mut all = Vec::new();
    for (side, contacts) in planted.contacts.iter().enumerate() {
        let track = FootTrack::new(clip, LEGS[side][2]);
        for contact in contacts {
            let (mut first, mut worst) = ([None; 3], 0.0f64);
            for sole in &track.soles[contact.clone()] {
                let lowest = sole.iter().map(|p| p.y.max(0.0)).fold(f64::INFINITY, f64::min);
                for (first, p) in first.iter_mut().zip(sole) {
                    *first = (p.y < lowest + 0.002).then(|| first.unwrap_or(*p));
                    worst = worst.max(first.map_or(0.0, |f: Vector3<f64>| (p - f).xz().norm()));
                }
            }
            all.push(1e3 * worst);
        }
    }
    all
}

/// Largest second difference of the rotations of legs and toes, rad/s².
fn largest_acceleration(clip: &Clip) -> f64 {
    let turn = |a: usize, b: usize, j: Joint| log(&(clip.poses[a].joint(j).inverse() * clip.poses[b].joint(j)));
    let of = |t: usize| LEGS.iter().flatten().map(|j| (turn(t, t + 1, *j) - turn(t - 1, t, *j)).norm()).fold(0.0, f64::max);
    (1..clip.poses.len() - 1).map(of).fold(0.0, f64::max) * clip.fps.powi(2)
}

/// Largest changes, degrees: of hips, knees and ankles while their feet do not stand, of toes then, of all while they stand.
fn changes_deg(clip: &Clip, planted: &Planted) -> [f64; 3] {
    let mut worst = [0.0f64; 3];
    for (frame, (a, b)) in clip.poses.iter().zip(&planted.clip.poses).enumerate() {
        for (side, leg) in LEGS.iter().enumerate() {
            let stands = planted.contacts[side].iter().any(|c| c.contains(&frame));
            for (k, joint) in leg.iter().enumerate() {
                let place = if stands { 2 } else { usize::from(k == 3) };
                worst[place] = worst[place].max(a.joint(*joint).angle_to(b.joint(*joint)).to_degrees());
            }
        }
        let others = Joint::ALL.into_iter().skip(1).filter(|j| !LEGS.iter().flatten().any(|leg| leg == j));
        others.for_each(|j| assert_eq!(a.joint(j), b.joint(j)));
    }
    worst
}

/// What all takes of a data set came to.
#[derive(Default)]
struct Found {
    drifts_mm: [Vec<f64>; 2],
    /// Of every take, see [`changes_deg`].
    changes_deg: Vec<[f64; 3]>,
    /// Largest acceleration after over that before.
    shaken: f64,
}

fn quantile(values: Vec<f64>, part: f64) -> f64 {
    order::quantile(values, part).unwrap()
}

/// Every subject at three speeds, as `generate` makes them.
fn plant_all(folder: &str, activity: Activity, factors: [f64; 3]) -> Option<Found> {
    let (cycles, _) = database::thin(cycles(folder, activity)?);
    let model = Model::build(activity, false, &cycles).unwrap();
    let mut subjects: Vec<&str> = cycles.iter().map(|c| c.subject.as_str()).collect();
    subjects.sort();
    subjects.dedup();
    let mut found = Found::default();
    for (subject, factor) in subjects.iter().flat_map(|s| factors.map(|f| (s, f))) {
        let own: Vec<Cycle> = cycles.iter().filter(|c| c.subject == *subject).cloned().collect();
        let style = Style::of_cycles(&model, "", &own).unwrap();
        let population = Population::new(&model, style.weights.len());
        let speed = factor * style.parameter;
        let made = synthesize(&model, &population, Method::Default, &style, speed, style.hip_height_m).unwrap();
        let shape = Shape::template(style.hip_height_m / 0.53);
        let clip = play(&model, &made, &shape.offsets(), 60.0, Length::Cycles(4));
        let planted = plant_feet(&clip);
        let drifts = [&clip, &planted.clip].map(|c| drifts_mm(c, &planted));
        let [calm, shaken] = [&clip, &planted.clip].map(largest_acceleration);
        let changes = changes_deg(&clip, &planted);
        let [before, after] = drifts.each_ref().map(|d| d.iter().copied().fold(0.0, f64::max));
        println!(
            "{folder} {subject} {speed:.2} m/s: drift {before:.1} -> {after:.2} mm; {changes:.1?} deg; {calm:.0} -> {shaken:.0} rad/s2"
        );
        found.drifts_mm.iter_mut().zip(drifts).for_each(|(all, d)| all.extend(d));
        found.changes_deg.push(changes);
        found.shaken = found.shaken.max(shaken / calm);
    }
    Some(found)
}

#[test]
fn recorded_people_stand_still_too() {
    for (folder, activity, factors) in [
        ("cmu-asfamc", Activity::Walking, [0.75, 1.0, 1.3]),
        ("schreiber-walking", Activity::Walking, [0.75, 1.0, 1.3]),
        ("hamner-running", Activity::Running, [0.7, 1.0, 1.4]),
    ] {
        let Some(found) = plant_all(folder, activity, factors) else { continue };
        let [before, after] = &found.drifts_mm;
        let sliding = |d: &[f64]| d.iter().filter(|d| **d > 5.0).count();
        let [legs, toes, standing] = [0, 1, 2].map(|k| {
            let of: Vec<f64> = found.changes_deg.iter().map(|c| c[k]).collect();
            (quantile(of.clone(), 0.5), quantile(of, 1.0))
        });
        println!(
            "{folder}: {} -> {} of {} contacts slide by more than 5 mm; median {:.1} -> {:.2}, largest {:.1} -> {:.1} mm; degrees in the \
             median and at most: legs that do not stand {legs:.1?}, their toes {toes:.1?}, standing {standing:.1?}; largest acceleration \
             times {:.2}",
            sliding(before),
            sliding(after),
            after.len(),
            quantile(before.clone(), 0.5),
            quantile(after.clone(), 0.5),
            quantile(before.clone(), 1.0),
            quantile(after.clone(), 1.0),
            found.shaken,
        );
        assert!(sliding(before) * 10 > 9 * before.len() && sliding(after) * 40 < after.len());
        assert!(quantile(after.clone(), 1.0) < 10.0);
        assert!(legs.1 < 3.0 && found.shaken < 1.1);
    }
}
