//! One person's points out of clouds that may hold several people.
//!
//! Seen from above a standing person is one piece, and people who do not touch are several. Points are counted in cells of
//! [`CELL_M`]; occupied cells that touch, with diagonals, are one piece. The largest piece of a frame is the person, the
//! rest is dropped; a second piece nearly as large in many frames is a second person, who cannot be told apart by size.
//! Fails when people touch or hide each other.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::Vector3;

use super::targets::Observation;

const CELL_M: f64 = 0.12;
/// Fewer points in a cell are stray.
const FEWEST_IN_CELL: usize = 3;
/// A second piece with more points than this part of the largest is a person too.
const ANOTHER: f64 = 0.4;

/// Observations with the points of the largest piece alone, and the number of frames that show another person.
pub fn largest(observations: &[Observation], up: &Vector3<f64>) -> (Vec<Observation>, usize) {
    let mut crowded = 0;
    let alone = observations.iter().map(|o| {
        let finite: Vec<usize> = (0..o.cloud.points.len()).filter(|i| o.cloud.points[*i].position.iter().all(|v| v.is_finite())).collect();
        let places: Vec<Vector3<f64>> = finite.iter().map(|i| o.cloud.points[*i].position).collect();
        let pieces = pieces(&places, up);
        crowded += usize::from(pieces.len() > 1 && pieces[1].len() as f64 > ANOTHER * pieces[0].len() as f64);
        let mut alone = o.clone();
        alone.cloud.points = pieces.first().map_or(Vec::new(), |p| p.iter().map(|i| o.cloud.points[finite[*i]].clone()).collect());
        alone
    });
    let alone = alone.collect();
    (alone, crowded)
}

/// Indices of the points of each piece, largest first, in the points' order.
fn pieces(points: &[Vector3<f64>], up: &Vector3<f64>) -> Vec<Vec<usize>> {
    let across = if up.x.abs() < 0.9 { up.cross(&Vector3::x()) } else { up.cross(&Vector3::z()) }.normalize();
    let along = up.cross(&across);
    let mut cells: BTreeMap<[i64; 2], Vec<usize>> = BTreeMap::new();
    for (i, x) in points.iter().enumerate() {
        let cell = [x.dot(&across), x.dot(&along)].map(|v| (v / CELL_M).floor() as i64);
        cells.entry(cell).or_default().push(i);
    }
    cells.retain(|_, points| points.len() >= FEWEST_IN_CELL);
    let mut open: BTreeSet<[i64; 2]> = cells.keys().copied().collect();
    let mut pieces = Vec::new();
    while let Some(first) = open.pop_first() {
        let (mut piece, mut front) = (Vec::new(), vec![first]);
        while let Some([x, y]) = front.pop() {
            piece.extend(&cells[&[x, y]]);
            let around = (-1..=1).flat_map(|dx| (-1..=1).map(move |dy| [x + dx, y + dy]));
            front.extend(around.filter(|c| open.remove(c)));
        }
        piece.sort_unstable();
        pieces.push(piece);
    }
    pieces.sort_by(|a: &Vec<usize>, b| b.len().cmp(&a.len()).then(a.cmp(b)));
    pieces
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clouds::{Cloud, CloudPoint};
    use nalgebra::Matrix3;

    fn column(at: [f64; 2], count: usize) -> Vec<CloudPoint> {
        let point = |i: usize| CloudPoint {
            position: Vector3::new(at[0] + 0.15 * (i as f64).sin(), at[1] + 0.1 * (1.7 * i as f64).cos(), 1.7 * i as f64 / count as f64),
            colour: [0; 3],
            confidence: 1.0,
            covariance: Matrix3::identity(),
        };
        (0..count).map(point).collect()
    }

    fn observation(points: Vec<CloudPoint>) -> Observation {
        Observation { cloud: Cloud { points }, ..Observation::default() }
    }

    #[test]
    fn somebody_small_in_the_background_is_dropped_and_an_equal_is_counted() {
        let person = column([0.0, 3.0], 900);
        let with = |others: Vec<CloudPoint>| observation(person.iter().cloned().chain(others).collect());
        let mut broken = column([0.0, 3.0], 3);
        broken.iter_mut().for_each(|p| p.position.y = f64::NAN);
        let all = [with(Vec::new()), with(column([1.5, 5.0], 200)), with(column([0.9, 3.1], 800)), with(broken)];
        let (alone, crowded) = largest(&all, &Vector3::z());
        assert_eq!(crowded, 1);
        assert!(alone.iter().all(|o| o.cloud.points == person));
        assert!(largest(&[Observation::default()], &Vector3::z()).0[0].cloud.points.is_empty());
    }
}
