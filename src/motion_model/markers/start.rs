//! Where the body is before the solver begins: up axis, unit and stature from the markers' heights at rest, the root of every
//! frame from the pelvis.
//!
//! Over all frames, x_m ≈ x̄ + d (h_m − h̄) with h_m the marker's height in a standing template: the direction of d is up, its
//! length says how many of the file's units a metre of template is, so that millimetres taken for metres are seen.      (1)
//! The root of a frame is the rigid motion of the pelvis' markers (Kabsch 1976, Acta Cryst. A32).

use nalgebra::{Isometry3, Matrix3, Rotation3, UnitQuaternion, Vector3};

use super::Markers;
use super::ik::IkError;
use super::set::{MarkerSet, Match, STATURE_M};
use crate::body::{Joint, Pose};
use crate::math::rotation::between;

/// What length of d makes a person: statures from 0.9 to 2.3 m, less what bent legs take.
const PERSON: std::ops::Range<f64> = 0.45..1.35;
/// Share of d along one axis of a standing person.
const UPRIGHT: f64 = 0.8;
/// Units of length that files use, metres.
const UNITS: [(&str, f64); 3] = [("m", 1.0), ("mm", 0.001), ("cm", 0.01)];
/// Largest r.m.s. distance of pelvis markers to the set's that still is a pelvis, metres: people and soft tissue differ, but
/// exchanged markers are off by more.
const PELVIS_M: f64 = 0.08;

/// A recording in metres with y up, its columns those of the matches.
pub struct Upright {
    pub frames: Vec<Vec<Option<Vector3<f64>>>>,
    pub stature_m: f64,
    pub notices: Vec<String>,
}

/// Position of a set's marker on a standing template, metres.
fn at_rest(set: &MarkerSet, marker: usize) -> Vector3<f64> {
    set.markers[marker].near.rest_position() * STATURE_M + set.markers[marker].at
}

/// Slope d of equation (1), in the file's axes and units per metre; `None` without markers at two heights.
fn slope(markers: &Markers, set: &MarkerSet, matches: &[Match]) -> Option<Vector3<f64>> {
    let (mut along, mut square) = (Vector3::zeros(), 0.0);
    for frame in &markers.frames {
        let seen: Vec<(f64, Vector3<f64>)> =
            matches.iter().filter_map(|m| Some((at_rest(set, m.marker).y, frame.get(m.column).copied()??))).collect();
        let n = seen.len() as f64;
        let (h, x) = seen.iter().fold((0.0, Vector3::zeros()), |(h, x), s| (h + s.0 / n, x + s.1 / n));
        along += seen.iter().map(|s| (s.1 - x) * (s.0 - h)).sum::<Vector3<f64>>();
        square += seen.iter().map(|s| (s.0 - h).powi(2)).sum::<f64>();
    }
    (square > 0.0).then(|| along / square)
}

/// Turns a recording upright and into metres.
pub fn upright(markers: &Markers, set: &MarkerSet, matches: &[Match]) -> Result<Upright, IkError> {
    let d = slope(markers, set, matches).filter(|d| d.norm() > 0.0).ok_or(IkError::Empty)?;
    let axis = d.iamax();
    if d[axis].abs() < UPRIGHT * d.norm() {
        return Err(IkError::Lying);
    }
    let up = Vector3::ith(axis, d[axis].signum());
    let is_person = |scale: f64| PERSON.contains(&(scale * d.norm()));
    let mut notices = Vec::new();
    let scale = match (markers.metres_per_unit, UNITS.iter().find(|u| is_person(u.1))) {
        (Some(declared), _) if is_person(declared) => declared,
        (None, Some((_, scale))) => *scale,
        (Some(declared), Some((unit, scale))) => {
            let size = STATURE_M * d.norm() * declared;
            notices.push(format!("the file's unit would make a person of {size:.3} m; the markers are taken as {unit}"));
            *scale
        }
        (_, None) => return Err(IkError::Size { size: STATURE_M * d.norm() }),
    };
    let ours_from_file = between(&up, &Vector3::y());
    let placed = |frame: &Vec<Option<Vector3<f64>>>| {
        let one = |m: &Match| Some(ours_from_file * frame.get(m.column).copied()?? * scale);
        matches.iter().map(one).collect()
    };
    Ok(Upright { frames: markers.frames.iter().map(placed).collect(), stature_m: STATURE_M * d.norm() * scale, notices })
}

/// The rotation and translation that carry `from` onto `to` with least squares, and the r.m.s. rest; `None` for fewer than
/// three points or points on a line.
fn rigid(from: &[Vector3<f64>], to: &[Vector3<f64>]) -> Option<(Isometry3<f64>, f64)> {
    let n = from.len() as f64;
    if from.len() < 3 {
        return None;
    }
    let (a, b) = (from.iter().sum::<Vector3<f64>>() / n, to.iter().sum::<Vector3<f64>>() / n);
    let covariance: Matrix3<f64> = from.iter().zip(to).map(|(x, y)| (y - b) * (x - a).transpose()).sum();
    let svd = covariance.svd(true, true);
    let (u, v) = (svd.u?, svd.v_t?);
    if svd.singular_values[1] < 1e-6 * svd.singular_values[0] {
        return None;
    }
    let mut flip = Matrix3::identity();
    flip[(2, 2)] = (u * v).determinant().signum();
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(u * flip * v));
    let to_from = Isometry3::from_parts((b - rotation * a).into(), rotation);
    let rest = from.iter().zip(to).map(|(x, y)| (to_from * nalgebra::Point3::from(*x) - nalgebra::Point3::from(*y)).norm_squared());
    Some((to_from, (rest.sum::<f64>() / n).sqrt()))
}

/// Root of a frame from markers at `offsets` of the root; `None` where too few are seen or they are no pelvis.
pub fn root(frame: &[Option<Vector3<f64>>], set: &MarkerSet, matches: &[Match], offsets: &[Vector3<f64>]) -> Option<Isometry3<f64>> {
    let on_pelvis = |i: usize| set.markers[matches[i].marker].on == Joint::Root;
    let seen = (0..matches.len()).filter(|&i| on_pelvis(i)).filter_map(|i| Some((offsets[i], frame[i]?)));
    let (from, to): (Vec<_>, Vec<_>) = seen.unzip();
    rigid(&from, &to).filter(|(_, rest)| *rest < PELVIS_M).map(|(root, _)| root)
}

/// The longest run of frames in which no gap without a root is longer than `longest_gap`; first and last frame have one.
pub fn longest_run(roots: &[Option<Isometry3<f64>>], longest_gap: usize) -> Option<std::ops::RangeInclusive<usize>> {
    let known: Vec<usize> = (0..roots.len()).filter(|&i| roots[i].is_some()).collect();
    let mut runs: Vec<(usize, usize)> = Vec::new();
    for i in known {
        match runs.last_mut() {
            Some(run) if i - run.1 <= longest_gap + 1 => run.1 = i,
            _ => runs.push((i, i)),
        }
    }
    // The first of equals.
    runs.into_iter().rev().max_by_key(|r| r.1 - r.0).map(|r| r.0..=r.1)
}

/// Poses with the roots of their frames, those without between their neighbours'.
pub fn fill_roots(poses: &mut [Pose], roots: &[Option<Isometry3<f64>>]) {
    let known: Vec<usize> = (0..roots.len()).filter(|&i| roots[i].is_some()).collect();
    let at = |i: usize| roots[i].unwrap_or_default();
    for (i, pose) in poses.iter_mut().enumerate() {
        let after = known.partition_point(|&k| k < i);
        let (a, b) = match (known.get(after.saturating_sub(1)), known.get(after)) {
            (Some(&a), Some(&b)) if a < b && i < b => (a, b),
            (Some(&a), None) => (a, a),
            (_, Some(&b)) => (b, b),
            _ => continue,
        };
        let part = if a == b { 0.0 } else { (i as f64 - a as f64) / (b - a) as f64 };
        let place = |k: usize| {
            let mut rest = Pose::rest(at(k).translation.vector);
            rest.world_from_root = at(k).rotation;
            rest
        };
        let between = place(a).towards(&place(b), part);
        pose.root = between.root;
        pose.world_from_root = between.world_from_root;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::rotation::exp;

    #[test]
    fn rigid_recovers_a_motion_and_refuses_lines() {
        let motion = Isometry3::from_parts(Vector3::new(1.0, -2.0, 0.5).into(), exp(&Vector3::new(0.4, 2.0, -0.3)));
        let from = [Vector3::new(0.1, 0.0, 0.0), Vector3::new(-0.1, 0.02, 0.0), Vector3::new(0.0, 0.0, -0.2)];
        let to = from.map(|x| (motion * nalgebra::Point3::from(x)).coords);
        let (found, rest) = rigid(&from, &to).unwrap();
        assert!((found.to_matrix() - motion.to_matrix()).norm() < 1e-12 && rest < 1e-12);
        assert!(rigid(&[Vector3::zeros(), Vector3::x(), Vector3::x() * 2.0], &to).is_none());
    }

    #[test]
    fn roots_between_gaps_are_interpolated_and_runs_are_cut_at_long_gaps() {
        let place = |x: f64| Some(Isometry3::translation(x, 0.0, 0.0));
        let roots = [None, place(1.0), None, None, place(4.0), place(5.0), None];
        let mut poses = vec![Pose::rest(Vector3::zeros()); 7];
        fill_roots(&mut poses, &roots);
        assert_eq!(poses.iter().map(|p| p.root.x).collect::<Vec<_>>(), [1.0, 1.0, 2.0, 3.0, 4.0, 5.0, 5.0]);
        assert_eq!(longest_run(&roots, 2), Some(1..=5));
        assert_eq!(longest_run(&roots, 1), Some(4..=5));
        assert_eq!(longest_run(&[None], 1), None);
    }
}
