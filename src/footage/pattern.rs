//! What is printed of a board.

use super::board::{Board, BoardError, Charuco};
use image::{GrayImage, Luma};
use opencv::aruco;
use opencv::core::Mat;
use opencv::prelude::*;

/// A black rectangle, metres: left, top, width, height, from the board's upper left corner, x right and y down.
pub type Rectangle = [f64; 4];

impl Board {
    /// Squares across and down.
    pub fn squares(&self) -> [usize; 2] {
        match self {
            Board::Chessboard { columns, rows, .. } => [columns + 1, rows + 1],
            Board::Charuco(board) => [board.squares_x, board.squares_y],
        }
    }

    /// Width and height of all squares, metres.
    pub fn size_m(&self) -> [f64; 2] {
        self.squares().map(|n| n as f64 * self.square_m())
    }

    /// The black parts; the upper left square of a chessboard is black.
    pub fn rectangles(&self) -> Result<Vec<Rectangle>, BoardError> {
        let ([across, down], side) = (self.squares(), self.square_m());
        let square = |k: usize| [(k % across) as f64 * side, (k / across) as f64 * side, side, side];
        match self {
            Board::Chessboard { .. } => {
                Ok((0..across * down).filter(|k| (k % across + k / across).is_multiple_of(2)).map(square).collect())
            }
            Board::Charuco(board) => {
                let marked = board.marked_squares()?;
                let mut all: Vec<Rectangle> = (0..across * down).filter(|k| !marked.iter().any(|(at, _)| at == k)).map(square).collect();
                for (at, id) in marked {
                    let [left, top, ..] = square(at);
                    all.extend(board.marker(id, left, top)?);
                }
                Ok(all)
            }
        }
    }
}

impl Charuco {
    /// Squares (row by row) that hold markers, with the markers' ids.
    fn marked_squares(&self) -> Result<Vec<(usize, i32)>, BoardError> {
        let board = self.opencv()?.1;
        let square = |corners: opencv::core::Vector<opencv::core::Point3f>| {
            let middle = |k: fn(&opencv::core::Point3f) -> f32| corners.iter().map(|p| f64::from(k(&p))).sum::<f64>() / 4.0;
            let [x, y] = [middle(|p| p.x), middle(|p| p.y)].map(|v| (v / self.square_m).floor() as usize);
            y * self.squares_x + x
        };
        Ok(board.obj_points().iter().map(square).zip(board.ids().iter()).collect())
    }

    /// Black bits of a marker in the square whose corner is given, in runs along the rows.
    fn marker(&self, id: i32, left: f64, top: f64) -> Result<Vec<Rectangle>, BoardError> {
        let dictionary = self.opencv()?.0;
        let bits = dictionary.marker_size() + 2;
        let mut picture = Mat::default();
        aruco::draw_marker(&dictionary, id, bits, &mut picture, 1)?;
        let (bit, margin) = (self.marker_m / f64::from(bits), 0.5 * (self.square_m - self.marker_m));
        let mut runs = Vec::new();
        for row in 0..bits {
            let values = picture.at_row::<u8>(row)?;
            let mut start = 0;
            for part in values.chunk_by(|a, b| a == b) {
                if part[0] == 0 {
                    let [x, y] = [f64::from(start), f64::from(row)].map(|v| margin + v * bit);
                    runs.push([left + x, top + y, part.len() as f64 * bit, bit]);
                }
                start += part.len() as i32;
            }
        }
        Ok(runs)
    }
}

impl Board {
    /// The board without a border, `px_per_square` pixels per square; edges at whole pixels, those of marker bits rounded.
    pub fn raster(&self, px_per_square: u32) -> Result<GrayImage, BoardError> {
        let [width, height] = self.squares().map(|n| n as u32 * px_per_square);
        let scale = f64::from(px_per_square) / self.square_m();
        let mut picture = GrayImage::from_pixel(width, height, Luma([255]));
        for [left, top, width_m, height_m] in self.rectangles()? {
            let range = |from: f64, length: f64| (from * scale).round() as u32..((from + length) * scale).round() as u32;
            for y in range(top, height_m) {
                range(left, width_m).for_each(|x| picture.put_pixel(x, y, Luma([0])));
            }
        }
        Ok(picture)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::GenericImage;
    use opencv::core::Size;

    fn bordered(picture: &GrayImage, border: u32) -> GrayImage {
        let mut all = GrayImage::from_pixel(picture.width() + 2 * border, picture.height() + 2 * border, Luma([255]));
        all.copy_from(picture, border, border).unwrap();
        all
    }

    #[test]
    fn charuco_boards_are_drawn_as_by_opencv() {
        for squares in [[5, 7], [6, 4], [7, 5]] {
            // Six by six bits with the border, so that all edges are whole pixels.
            let board = Board::charuco(squares, 0.04, 0.03, "4x4_50", false).unwrap();
            let ours = board.raster(80).unwrap();
            let Board::Charuco(charuco) = &board else { panic!("a ChArUco board") };
            let mut theirs = Mat::default();
            let size = Size::new(ours.width() as i32, ours.height() as i32);
            charuco.opencv().unwrap().1.draw(size, &mut theirs, 0, 1).unwrap();
            let bytes = theirs.data_bytes().unwrap();
            let different = ours.iter().zip(bytes).filter(|(a, b)| a.abs_diff(**b) > 127).count();
            // OpenCV draws edges a pixel off.
            assert!((different as f64) < 0.01 * bytes.len() as f64, "{squares:?}: {different} of {}", bytes.len());
        }
    }

    #[test]
    fn drawn_boards_are_found_where_they_were_drawn() {
        let boards = [
            Board::chessboard(9, 6, 0.025).unwrap(),
            Board::chessboard(8, 6, 0.025).unwrap(),
            Board::charuco([7, 5], 0.036, 0.027, "DICT_5X5_100", false).unwrap(),
            Board::charuco([6, 4], 0.036, 0.027, "DICT_4X4_50", false).unwrap(),
        ];
        for board in boards {
            let target = board.target().unwrap();
            let picture = bordered(&board.raster(40).unwrap(), 50);
            let mut pictures = vec![picture.clone()];
            if let Board::Charuco(_) = board {
                pictures.push(GrayImage::from_fn(picture.width(), picture.height(), |x, y| Luma([255 - picture.get_pixel(x, y)[0]])));
            }
            for picture in pictures {
                let found = board.find(&picture, &target).unwrap().unwrap();
                assert_eq!(found.len(), target.points.len(), "{board}");
                // The first chessboard corner lies between the first squares, ChArUco ids are OpenCV's.
                let origin = if matches!(board, Board::Chessboard { .. }) { 90.0 } else { 50.0 };
                for (id, pixel) in &found {
                    let expected = target.points[*id] / board.square_m() * 40.0 + nalgebra::Vector2::repeat(origin - 0.5);
                    let symmetric = matches!(board, Board::Chessboard { columns: 8, .. });
                    let other =
                        target.points[target.points.len() - 1 - id] / board.square_m() * 40.0 + nalgebra::Vector2::repeat(origin - 0.5);
                    let error = (pixel.coords - expected).norm();
                    assert!(error < 0.02 || symmetric && (pixel.coords - other).norm() < 0.02, "{board}: {id} {pixel} {expected}");
                }
            }
        }
    }
}
