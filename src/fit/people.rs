//! One person's points and outlines out of observations that may hold several people.
//!
//! Seen from above a standing person is one piece, and people who do not touch are several. Points are counted in cells of
//! [`CELL_M`]; occupied cells that touch, with diagonals, are one piece. The largest piece of a frame is the person, the
//! rest is left out; a second piece nearly as large in many frames is a second person, who cannot be told apart by size.
//! Pixels of a silhouette that are nearer to another person's points than to this one's are not this person's.
//! Fails when people touch or hide each other.
//! Checked against made-up people, and footage with a child in the background.

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};

use nalgebra::Vector3;
use rayon::prelude::*;

use super::silhouette::Silhouette;
use super::targets::Observation;
use crate::clouds::CloudPoint;
use crate::math::distance_field::DistanceField;
use crate::rig::{Camera, Rig};

const CELL_M: f64 = 0.12;
/// Fewer points in a cell are stray.
const FEWEST_IN_CELL: usize = 3;
/// A second piece with more points than this part of the largest is a person too.
const ANOTHER: f64 = 0.4;
/// With fewer it is stray, or a hand, and says nothing about silhouettes.
const SOMEBODY: f64 = 0.1;
/// Cells of the distances to people's points.
const STEP_PX: usize = 2;

/// What an observation shows of one person.
#[derive(Clone, Debug)]
pub struct Person<'a> {
    observation: &'a Observation,
    points: Vec<u32>,
    /// As in the observation.
    pub silhouettes: Cow<'a, [Option<Silhouette>]>,
}

impl Person<'_> {
    pub fn points(&self) -> impl ExactSizeIterator<Item = &CloudPoint> {
        self.points.iter().map(|i| &self.observation.cloud.points[*i as usize])
    }

    pub fn time_s(&self) -> f64 {
        self.observation.time_s
    }
}

/// The largest person of every observation, and the number of those that show another one.
pub fn largest<'a>(observations: &'a [Observation], rig: &Rig) -> (Vec<Person<'a>>, usize) {
    let up = rig.up.direction();
    let each = observations.par_iter().map(|observation| {
        let points = &observation.cloud.points;
        let finite = (0..points.len() as u32).filter(|i| points[*i as usize].position.iter().all(|v| v.is_finite()));
        let mut pieces = pieces(points, finite, &up);
        let most = pieces.first().map_or(0, Vec::len) as f64;
        let crowd = pieces.len() > 1 && pieces[1].len() as f64 > ANOTHER * most;
        let others: Vec<u32> = pieces.iter().skip(1).filter(|p| p.len() as f64 > SOMEBODY * most).flatten().copied().collect();
        let own = if pieces.is_empty() { Vec::new() } else { pieces.swap_remove(0) };
        let silhouettes = if others.is_empty() {
            Cow::Borrowed(observation.silhouettes.as_slice())
        } else {
            let place = |which: &[u32]| -> Vec<Vector3<f64>> { which.iter().map(|i| points[*i as usize].position).collect() };
            let (own, others) = (place(&own), place(&others));
            let cut = |(camera, all): (&Camera, &Option<Silhouette>)| all.as_ref().map(|all| own_part(all, camera, &own, &others));
            Cow::Owned(rig.cameras.iter().zip(observation.silhouettes.iter()).map(cut).collect())
        };
        (Person { observation, points: own, silhouettes }, crowd)
    });
    let (people, crowds): (Vec<Person>, Vec<bool>) = each.unzip();
    (people, crowds.into_iter().filter(|crowd| *crowd).count())
}

/// The pixels that are not nearer to the points of others than to the person's own.
fn own_part(all: &Silhouette, camera: &Camera, own: &[Vector3<f64>], others: &[Vector3<f64>]) -> Silhouette {
    let [width, height] = all.size_px();
    let (columns, rows) = (width.div_ceil(STEP_PX), height.div_ceil(STEP_PX));
    let distances = |points: &[Vector3<f64>]| {
        let mut seen = vec![false; columns * rows];
        let cells = points.iter().filter_map(|x| camera.project(x)).filter(|p| p.x >= 0.0 && p.y >= 0.0);
        let cells = cells.map(|p| (p.x as usize / STEP_PX, p.y as usize / STEP_PX)).filter(|(x, y)| *x < columns && *y < rows);
        cells.for_each(|(x, y)| seen[y * columns + x] = true);
        DistanceField::new(width, height, STEP_PX, |x, y| seen[y / STEP_PX * columns + x / STEP_PX])
    };
    let (to_own, to_others) = (distances(own), distances(others));
    let of = |field: &DistanceField, x: u32, y: u32| field.at(f64::from(x), f64::from(y)).0;
    all.retained(|x, y| of(&to_others, x, y) >= of(&to_own, x, y))
}

/// The indices `which` of points by pieces, largest first, in the points' order.
fn pieces(points: &[CloudPoint], which: impl Iterator<Item = u32>, up: &Vector3<f64>) -> Vec<Vec<u32>> {
    let across = if up.x.abs() < 0.9 { up.cross(&Vector3::x()) } else { up.cross(&Vector3::z()) }.normalize();
    let along = up.cross(&across);
    let mut cells: BTreeMap<[i64; 2], Vec<u32>> = BTreeMap::new();
    for i in which {
        let x = &points[i as usize].position;
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
    pieces.sort_by(|a: &Vec<u32>, b| b.len().cmp(&a.len()).then(a.cmp(b)));
    pieces
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clouds::Cloud;
    use crate::rig::{Lens, Up};
    use image::{GrayImage, Luma};
    use nalgebra::{Matrix3, Rotation3};
    use std::sync::Arc;

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

    /// Two cameras at a height of a metre that look along y.
    fn rig() -> Rig {
        let camera_from_world = Rotation3::from_matrix_unchecked(Matrix3::new(1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0));
        let camera = |x: f64| Camera {
            name: format!("at {x}"),
            size_px: [640, 480],
            matrix: Matrix3::new(550.0, 0.0, 320.0, 0.0, 550.0, 240.0, 0.0, 0.0, 1.0),
            lens: Lens::BrownConrady([0.0; 8]),
            camera_from_world,
            translation: -(camera_from_world * Vector3::new(x, 0.0, 1.0)),
        };
        Rig { cameras: [0.0, 0.3].map(camera).to_vec(), up: Up::Z }
    }

    #[test]
    fn somebody_small_in_the_background_is_dropped_and_an_equal_is_counted() {
        let person = column([0.0, 3.0], 900);
        let with = |others: Vec<CloudPoint>| observation(person.iter().cloned().chain(others).collect());
        let mut broken = column([0.0, 3.0], 3);
        broken.iter_mut().for_each(|p| p.position.y = f64::NAN);
        let all = [with(Vec::new()), with(column([1.5, 5.0], 200)), with(column([0.9, 3.1], 800)), with(broken)];
        let (people, crowded) = largest(&all, &rig());
        assert_eq!(crowded, 1);
        assert!(people.iter().all(|p| p.points().eq(person.iter())));
        assert_eq!(largest(&[Observation::default()], &rig()).0[0].points().len(), 0);
    }

    #[test]
    fn outlines_of_others_are_cut() {
        let rig = rig();
        let (person, child) = (column([0.0, 3.0], 4000), column([0.6, 5.0], 900));
        let painted = |camera: &Camera, people: &[&[CloudPoint]]| {
            let mut mask = GrayImage::new(camera.size_px[0], camera.size_px[1]);
            let pixels = people.iter().flat_map(|points| points.iter()).filter_map(|p| camera.project(&p.position));
            for (x, y) in pixels.flat_map(|p| (-4..=4).flat_map(move |dx| (-4..=4).map(move |dy| (p.x as i32 + dx, p.y as i32 + dy)))) {
                if let Some(pixel) = mask.get_pixel_mut_checked(x.max(0) as u32, y.max(0) as u32) {
                    *pixel = Luma([255]);
                }
            }
            Silhouette::new(&mask)
        };
        let of = |people: &[&[CloudPoint]]| Observation {
            silhouettes: Arc::new(rig.cameras.iter().map(|camera| Some(painted(camera, people))).collect()),
            ..observation(people.iter().flat_map(|points| points.iter().cloned()).collect())
        };
        let (alone, both) = ([of(&[&person])], [of(&[&person, &child])]);
        let found = largest(&both, &rig).0;
        for (k, cut) in found[0].silhouettes.iter().enumerate() {
            let [cut, own, all] = [cut, &alone[0].silhouettes[k], &both[0].silhouettes[k]].map(|s| s.as_ref().unwrap());
            let pixels = || (0..480).flat_map(|y| (0..640).map(move |x| (x, y)));
            let differ = |a: &Silhouette, b: &Silhouette| pixels().filter(|(x, y)| a.contains(*x, *y) != b.contains(*x, *y)).count();
            assert!(20 * differ(cut, own) < differ(all, own), "camera {k}: {} of {}", differ(cut, own), differ(all, own));
        }
        assert!(matches!(largest(&alone, &rig).0[0].silhouettes, Cow::Borrowed(_)));
    }
}
