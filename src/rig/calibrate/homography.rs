//! Plane to picture: homographies and the board poses in them.
//!
//! s (x', y', 1) = H (X, Y, 1), from Σ |x' (h3·X) − h1·X|² + … with both sides scaled to unit size (Hartley and Zisserman,
//! "Multiple View Geometry", algorithm 4.2). With ideal image points H ~ [r1 r2 t] (Zhang 2000, PAMI 22(11), section 3.1).
//! Fails for points on one line. Checked on exact projections.

use nalgebra::{Isometry3, Matrix3, Point2, Rotation3, SMatrix, SVector, SymmetricEigen, Translation3, UnitQuaternion, Vector2, Vector3};

/// Second smallest over largest eigenvalue below which the points lie on one line.
const ON_A_LINE: f64 = 1e-7;

/// The homography that carries `from` onto `to` with the least algebraic error; `None` for fewer than four points or for
/// points on one line.
pub fn homography(from: &[Vector2<f64>], to: &[Vector2<f64>]) -> Option<Matrix3<f64>> {
    if from.len() < 4 || from.len() != to.len() {
        return None;
    }
    let (scaled_from, scaled_to) = (unit_size(from)?, unit_size(to)?);
    let mut normal = SMatrix::<f64, 9, 9>::zeros();
    for (a, b) in from.iter().zip(to) {
        let (p, q) = (scaled_from * a.push(1.0), scaled_to * b.push(1.0));
        let rows =
            [[p.x, p.y, 1.0, 0.0, 0.0, 0.0, -q.x * p.x, -q.x * p.y, -q.x], [0.0, 0.0, 0.0, p.x, p.y, 1.0, -q.y * p.x, -q.y * p.y, -q.y]];
        for row in rows {
            let row = SVector::<f64, 9>::from(row);
            normal += row * row.transpose();
        }
    }
    let eigen = SymmetricEigen::new(normal);
    let mut order: Vec<usize> = (0..9).collect();
    order.sort_by(|a, b| eigen.eigenvalues[*a].total_cmp(&eigen.eigenvalues[*b]));
    if eigen.eigenvalues[order[1]] < ON_A_LINE * eigen.eigenvalues[order[8]] {
        return None;
    }
    let h = Matrix3::from_row_slice(eigen.eigenvectors.column(order[0]).as_slice());
    Some(scaled_to.try_inverse()? * h * scaled_from)
}

/// The similarity that brings the centroid to the origin and the mean distance from it to √2.
fn unit_size(points: &[Vector2<f64>]) -> Option<Matrix3<f64>> {
    let n = points.len() as f64;
    let centre = points.iter().sum::<Vector2<f64>>() / n;
    let size = points.iter().map(|p| (p - centre).norm()).sum::<f64>() / n;
    let scale = std::f64::consts::SQRT_2 / size;
    let finite = scale.is_finite() && centre.norm().is_finite();
    finite.then(|| Matrix3::new(scale, 0.0, -scale * centre.x, 0.0, scale, -scale * centre.y, 0.0, 0.0, 1.0))
}

/// Where a homography puts a point.
pub fn carried(h: &Matrix3<f64>, point: &Vector2<f64>) -> Vector2<f64> {
    let p = h * point.push(1.0);
    Vector2::new(p.x / p.z, p.y / p.z)
}

/// Derivative of [`carried`] by the point.
pub fn carried_jacobian(h: &Matrix3<f64>, point: &Vector2<f64>) -> nalgebra::Matrix2<f64> {
    let p = h * point.push(1.0);
    let at = Vector2::new(p.x / p.z, p.y / p.z);
    (h.fixed_view::<2, 2>(0, 0) - at * h.fixed_view::<1, 2>(2, 0)) / p.z
}

/// `camera_from_board` from corners on the board (metres) and their ideal image points; `None` as for [`homography`].
pub fn board_pose(on_board: &[Vector2<f64>], ideal: &[Vector2<f64>]) -> Option<Isometry3<f64>> {
    let h = homography(on_board, ideal)?;
    let (a, b, t) = (h.column(0).into_owned(), h.column(1).into_owned(), h.column(2).into_owned());
    let scale = 2.0 / (a.norm() + b.norm());
    let centre = on_board.iter().sum::<Vector2<f64>>() / on_board.len() as f64;
    // The board is in front of the camera.
    let scale = if (h * centre.push(1.0)).z < 0.0 { -scale } else { scale };
    let near = Matrix3::from_columns(&[a * scale, b * scale, a.cross(&b) * (scale * scale)]);
    let svd = near.svd(true, true);
    let (u, vt) = (svd.u?, svd.v_t?);
    let sign = (u * vt).determinant().signum();
    let rotation = Rotation3::from_matrix_unchecked(u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * vt);
    let pose = Isometry3::from_parts(Translation3::from(t * scale), UnitQuaternion::from_rotation_matrix(&rotation));
    pose.translation.vector.iter().all(|v| v.is_finite()).then_some(pose)
}

/// Pixels as plain vectors.
pub fn vectors(pixels: &[Point2<f64>]) -> Vec<Vector2<f64>> {
    pixels.iter().map(|p| p.coords).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rig::calibrate::target::grid;

    #[test]
    fn exact_projections_give_the_pose_back() {
        let board = grid(5, 4, 0.04);
        for (turn, place) in
            [([0.2, -0.3, 2.9], [0.1, -0.2, 1.4]), ([0.0, 0.0, 0.0], [0.0, 0.0, 0.6]), ([-0.7, 0.5, -1.2], [0.4, 0.3, 2.0])]
        {
            let pose = Isometry3::new(Vector3::from(place), Vector3::from(turn));
            let ideal: Vec<_> = board
                .iter()
                .map(|p| {
                    let q = pose.rotation * p.push(0.0) + pose.translation.vector;
                    Vector2::new(q.x / q.z, q.y / q.z)
                })
                .collect();
            let found = board_pose(&board, &ideal).unwrap();
            assert!((found.translation.vector - pose.translation.vector).norm() < 1e-9);
            assert!(found.rotation.angle_to(&pose.rotation) < 1e-7);
            let h = homography(&board, &ideal).unwrap();
            assert!((carried(&h, &board[7]) - ideal[7]).norm() < 1e-9);
            let step = Vector2::new(1e-6, -2e-6);
            let slope = (carried(&h, &(board[7] + step)) - carried(&h, &(board[7] - step))) / 2.0;
            assert!((carried_jacobian(&h, &board[7]) * step - slope).norm() < 1e-12);
        }
    }

    #[test]
    fn points_on_a_line_have_no_homography() {
        let line: Vec<_> = (0..6).map(|i| Vector2::new(f64::from(i), 2.0 * f64::from(i))).collect();
        assert!(homography(&line, &line).is_none());
        assert!(homography(&grid(2, 1, 1.0), &grid(2, 1, 1.0)).is_none());
    }
}
