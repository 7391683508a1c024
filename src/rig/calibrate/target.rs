//! The flat board: where its corners are, and the turns that show the same picture.

use nalgebra::{Isometry3, Point2, Translation3, UnitQuaternion, Vector2, Vector3};

/// A flat board's corners, and the relabellings that a detector cannot tell from each other.
#[derive(Clone, Debug, PartialEq)]
pub struct Target {
    /// Corners on the board, metres: x along a row, y from row to row; the index is the corner's id.
    pub points: Vec<Vector2<f64>>,
    /// The identity first.
    pub turns: Vec<Turn>,
}

/// A turn of the board about its centre after which its picture is the same, but the corners have other ids.
#[derive(Clone, Debug, PartialEq)]
pub struct Turn {
    /// The id that corner k gets.
    pub relabelled: Vec<usize>,
    /// The place of corner `relabelled[k]` is this motion of corner k's.
    pub turned_from_board: Isometry3<f64>,
}

/// One board seen by one camera at one time.
#[derive(Clone, Debug, PartialEq)]
pub struct Detection {
    pub camera: usize,
    /// Number of the view: simultaneous pictures have the same.
    pub view: usize,
    /// Corner ids and their pixels.
    pub corners: Vec<(usize, Point2<f64>)>,
}

impl Target {
    /// `columns` by `rows` inner corners of a chessboard, row by row; squares of `square_m`. With both numbers even or both
    /// odd the colours are the same after half a turn; square boards may be found at every quarter of a turn.
    pub fn chessboard(columns: usize, rows: usize, square_m: f64) -> Target {
        let points = grid(columns, rows, square_m);
        let quarters: &[usize] = match (columns == rows, columns % 2 == rows % 2) {
            (true, _) => &[0, 1, 2, 3],
            (false, true) => &[0, 2],
            (false, false) => &[0],
        };
        let turns = quarters.iter().map(|&q| Turn::new(columns, rows, square_m, q)).collect();
        Target { points, turns }
    }

    /// A board whose corners are known one by one.
    pub fn labelled(points: Vec<Vector2<f64>>) -> Target {
        let turns = vec![Turn { relabelled: (0..points.len()).collect(), turned_from_board: Isometry3::identity() }];
        Target { points, turns }
    }

    /// A corner on the board, metres, z = 0.
    pub fn point(&self, id: usize) -> Vector3<f64> {
        self.points[id].push(0.0)
    }
}

impl Turn {
    /// By `quarters` of a turn; odd numbers for square boards only.
    fn new(columns: usize, rows: usize, square_m: f64, quarters: usize) -> Turn {
        let turned = |k: usize| {
            let (x, y) = (k % columns, k / columns);
            match quarters {
                1 => x * columns + (rows - 1 - y),
                2 => (rows - 1 - y) * columns + (columns - 1 - x),
                3 => (columns - 1 - x) * columns + y,
                _ => k,
            }
        };
        let centre = Vector3::new((columns - 1) as f64, (rows - 1) as f64, 0.0) * (0.5 * square_m);
        let rotation = UnitQuaternion::from_scaled_axis(Vector3::z() * (quarters as f64 * std::f64::consts::FRAC_PI_2));
        let translation = Translation3::from(centre - rotation * centre);
        Turn { relabelled: (0..columns * rows).map(turned).collect(), turned_from_board: Isometry3::from_parts(translation, rotation) }
    }
}

impl Detection {
    /// Distance of a corner from its nearest neighbour, the median of all, px; 0 for a single corner.
    pub fn spacing_px(&self) -> f64 {
        let nearest = |(k, (_, p)): (usize, &(usize, Point2<f64>))| {
            let others = self.corners.iter().enumerate().filter(|(i, _)| *i != k);
            others.map(|(_, (_, q))| (p - q).norm()).fold(f64::INFINITY, f64::min)
        };
        let distances = self.corners.iter().enumerate().map(nearest).filter(|d| d.is_finite()).collect();
        crate::math::order::quantile(distances, 0.5).unwrap_or(0.0)
    }
}

/// Points of a grid, row by row.
pub fn grid(columns: usize, rows: usize, spacing_m: f64) -> Vec<Vector2<f64>> {
    (0..rows * columns).map(|k| Vector2::new((k % columns) as f64, (k / columns) as f64) * spacing_m).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turns_carry_corners_onto_corners_of_the_same_colours() {
        for (columns, rows, count) in [(9, 6, 1), (8, 6, 2), (7, 5, 2), (6, 6, 4), (5, 5, 4)] {
            let target = Target::chessboard(columns, rows, 0.03);
            assert_eq!(target.turns.len(), count, "{columns}x{rows}");
            for turn in &target.turns {
                for (k, &to) in turn.relabelled.iter().enumerate() {
                    let moved = turn.turned_from_board.transform_vector(&target.point(k)) + turn.turned_from_board.translation.vector;
                    assert!((moved - target.point(to)).norm() < 1e-12, "{columns}x{rows}: corner {k}");
                }
                // The square between corners (0,0) and (1,1) lands on one of its own colour.
                let landed = [0, 1, columns, columns + 1].map(|k| turn.relabelled[k]).into_iter().min().unwrap();
                assert!(columns == rows || (landed % columns + landed / columns) % 2 == 0, "{columns}x{rows}");
            }
        }
    }

    #[test]
    fn spacing_is_a_square() {
        let corners = grid(9, 6, 12.5).into_iter().enumerate().map(|(k, p)| (k, Point2::from(p))).collect();
        assert!((Detection { camera: 0, view: 0, corners }.spacing_px() - 12.5).abs() < 1e-9);
    }
}
