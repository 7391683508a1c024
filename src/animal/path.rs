//! The way of an animal that was animated on the spot.
//!
//! By contact: points of the skin within 4 % of the height above the lowest point, in two successive frames, stand on the
//! ground; the root goes forward by the median of what they go backward. Frames without contact (suspension) go on at the
//! mean of the others. By region: the silhouette's own way across the picture, scaled by the animal's length.
//! Checked on a walking horse: hooves on the ground stay where they are.

use nalgebra::Vector3;

use super::creature::{Creature, Posture};
use crate::math::order::quantile;

/// Nearer to the ground is contact, parts of the height at rest.
const CONTACT: f64 = 0.04;

/// Way forward (+z) since the first frame, by ground contact.
pub fn by_contact(creature: &Creature, postures: &[Posture]) -> Vec<f64> {
    let skins: Vec<Vec<Vector3<f64>>> = postures.iter().map(|p| creature.vertices(p)).collect();
    let height = creature.bounds().map_or(0.0, |[low, high]| high.y - low.y);
    let ground = skins.iter().flatten().map(|v| v.y).fold(f64::INFINITY, f64::min);
    let limit = ground + CONTACT * height;
    let steps: Vec<Option<f64>> = skins
        .windows(2)
        .map(|w| {
            let standing = w[0].iter().zip(&w[1]).filter(|(a, b)| a.y < limit && b.y < limit);
            quantile(standing.map(|(a, b)| a.z - b.z).collect(), 0.5)
        })
        .collect();
    let known: Vec<f64> = steps.iter().flatten().copied().collect();
    let mean = known.iter().sum::<f64>() / known.len().max(1) as f64;
    cumulated(steps.iter().map(|s| s.unwrap_or(mean)))
}

/// Way forward by the centres of mass in the scenery's pixels; `units_per_px` is the model's length over the silhouette's.
/// Whichever way the animal crosses the picture, it goes forward.
pub fn by_region(centres_px: &[[f64; 2]], units_per_px: f64) -> Vec<f64> {
    let ends = centres_px.first().zip(centres_px.last());
    let sign = ends.map_or(1.0, |(a, b)| if b[0] < a[0] { -1.0 } else { 1.0 });
    cumulated(centres_px.windows(2).map(|w| sign * (w[1][0] - w[0][0]) * units_per_px))
}

fn cumulated(steps: impl Iterator<Item = f64>) -> Vec<f64> {
    let mut way = vec![0.0];
    for step in steps {
        way.push(way[way.len() - 1] + step);
    }
    way
}

/// Moves the roots forward (+z of the world).
pub fn travel(creature: &Creature, postures: &mut [Posture], forward: &[f64]) {
    for (posture, way) in postures.iter_mut().zip(forward) {
        for (local, _) in posture.iter_mut().zip(&creature.bones).filter(|(_, b)| b.parent.is_none()) {
            local.translation.z += way;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::animal::horse::{Gait, horse, posture};

    #[test]
    fn standing_hooves_of_a_walking_horse_stay() {
        let horse = horse();
        let mut postures: Vec<Posture> = (0..54).map(|t| posture(&horse, Gait::Walk, f64::from(t) / 26.5)).collect();
        let slip = |postures: &[Posture]| {
            let skins: Vec<_> = postures.iter().map(|p| horse.vertices(p)).collect();
            let steps = skins.windows(2).flat_map(|w| {
                w[0].iter().zip(&w[1]).filter(|(a, b)| a.y < 0.05 && b.y < 0.05).map(|(a, b)| (a.z - b.z).abs()).collect::<Vec<_>>()
            });
            quantile(steps.collect(), 0.5).unwrap()
        };
        let before = slip(&postures);
        let way = by_contact(&horse, &postures);
        travel(&horse, &mut postures, &way);
        // A walking horse makes 1.2 to 2 m/s, two strides here.
        let speed = way[53] / (53.0 / 26.5 * Gait::Walk.stride_s());
        assert!((0.7..2.2).contains(&speed), "{speed}");
        assert!(slip(&postures) < 0.2 * before, "{} {before}", slip(&postures));
    }

    #[test]
    fn regions_go_forward_in_either_direction() {
        let way = by_region(&[[10.0, 0.0], [7.0, 1.0], [3.0, 0.0]], 0.5);
        assert_eq!(way, [0.0, 1.5, 3.5]);
        assert_eq!(by_region(&[[0.0, 0.0]], 1.0), [0.0]);
    }
}
