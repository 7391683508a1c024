//! A calibration board to print, with its size on it: PNG with its resolution in the file, or SVG in millimetres.

use std::fmt::Write as _;
use std::path::Path;

use image::{GrayImage, Luma, imageops};

use super::canvas::{Align, Canvas, INK, WHITE, text_width_px};
use super::{ReportError, png_bytes};
use crate::footage::board::Board;
use crate::io::write_atomic;

/// Resolution aimed at; squares are whole pixels, so the file says the exact one.
const DOTS_PER_M: f64 = 300.0 / 0.0254;
/// White around the squares: detectors want half a square, printers leave 5 mm, the caption needs its room, and the boards
/// of `calib/` fit on A4.
const MARGIN_SQUARES: f64 = 0.6;
const MARGIN_M: [f64; 2] = [0.012, 0.016];
const CAPITAL_M: f64 = 0.0025;

/// A board on its sheet.
pub struct Sheet {
    pub picture: GrayImage,
    pub pixels_per_m: u32,
}

fn margin_m(board: &Board) -> f64 {
    (MARGIN_SQUARES * board.square_m()).clamp(MARGIN_M[0], MARGIN_M[1])
}

fn caption(board: &Board) -> String {
    let [width, height] = board.size_m().map(|m| (m * 1e4).round() / 10.0);
    format!("{board}. Print at 100 %: black to black {width} x {height} mm.")
}

/// The board in grey levels at about 300 dpi.
pub fn sheet(board: &Board) -> Result<Sheet, ReportError> {
    let px_per_square = (board.square_m() * DOTS_PER_M).round().max(8.0);
    let scale = px_per_square / board.square_m();
    let pattern = board.raster(px_per_square as u32)?;
    let margin = (margin_m(board) * scale).round() as u32;
    let mut canvas = Canvas::new(pattern.width() + 2 * margin, pattern.height() + 2 * margin, WHITE);
    let below = f64::from(pattern.height() + margin) + 0.65 * f64::from(margin);
    // Narrow boards have smaller letters.
    let (text, capital_px) = (caption(board), CAPITAL_M * scale);
    let fitting_px = capital_px * f64::from(pattern.width()) / text_width_px(&text, capital_px)?;
    canvas.text([f64::from(margin), below], &text, capital_px.min(fitting_px), INK, Align::Left)?;
    let mut picture = GrayImage::from_fn(canvas.picture.width(), canvas.picture.height(), |x, y| Luma([canvas.picture.get_pixel(x, y)[0]]));
    imageops::replace(&mut picture, &pattern, margin.into(), margin.into());
    Ok(Sheet { picture, pixels_per_m: scale.round() as u32 })
}

/// Writes the board as PNG.
pub fn save_png(path: &Path, board: &Board) -> Result<(), ReportError> {
    let sheet = sheet(board)?;
    let png = with_resolution(png_bytes(path, &sheet.picture.into())?, sheet.pixels_per_m);
    write_atomic(path, &png).map_err(|error| ReportError::Write { path: path.into(), error })
}

/// Writes the board as SVG, in millimetres and exact.
pub fn save_svg(path: &Path, board: &Board) -> Result<(), ReportError> {
    let text = svg(board)?;
    write_atomic(path, text.as_bytes()).map_err(|error| ReportError::Write { path: path.into(), error })
}

fn svg(board: &Board) -> Result<String, ReportError> {
    let margin = margin_m(board);
    let mm = |m: f64| (m * 1e7).round() / 1e4;
    let [width, height] = board.size_m().map(|m| mm(m + 2.0 * margin));
    let mut text = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}mm\" height=\"{height}mm\" viewBox=\"0 0 {width} {height}\">\n\
         <rect width=\"{width}\" height=\"{height}\" fill=\"white\"/>\n<g shape-rendering=\"crispEdges\">\n"
    );
    for [x, y, w, h] in board.rectangles()? {
        let (x, y) = (mm(x + margin), mm(y + margin));
        // Writing into a String cannot fail.
        let _ = writeln!(text, "<rect x=\"{x}\" y=\"{y}\" width=\"{}\" height=\"{}\"/>", mm(w), mm(h));
    }
    let (x, y) = (mm(margin), mm(board.size_m()[1] + 1.65 * margin));
    let text_width = mm(board.size_m()[0]).min(150.0);
    let _ = writeln!(
        text,
        "</g>\n<text x=\"{x}\" y=\"{y}\" font-family=\"sans-serif\" font-size=\"3.5\" textLength=\"{text_width}\" lengthAdjust=\"spacingAndGlyphs\">{}</text>\n</svg>",
        caption(board)
    );
    Ok(text)
}

/// The PNG with a pHYs chunk after its header: pixels per metre both ways.
fn with_resolution(png: Vec<u8>, pixels_per_m: u32) -> Vec<u8> {
    /// Signature and IHDR chunk.
    const HEADER: usize = 8 + 25;
    let mut chunk = b"pHYs".to_vec();
    chunk.extend(pixels_per_m.to_be_bytes().repeat(2));
    chunk.push(1);
    let check = crc32(&chunk);
    let mut whole = png;
    let inserted = [&9u32.to_be_bytes()[..], &chunk, &check.to_be_bytes()].concat();
    whole.splice(HEADER..HEADER, inserted);
    whole
}

/// The check sum of PNG's chunks (ISO 3309).
fn crc32(bytes: &[u8]) -> u32 {
    let step = |crc: u32, byte: &u8| (0..8).fold(crc ^ u32::from(*byte), |c, _| if c & 1 == 1 { 0xedb8_8320 ^ (c >> 1) } else { c >> 1 });
    !bytes.iter().fold(!0, step)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn check_sums_are_pngs() {
        // The empty IEND chunk of every PNG file.
        assert_eq!(crc32(b"IEND"), 0xae42_6082);
    }

    #[test]
    fn sheets_have_their_printed_size_and_are_found_again() {
        let folder = tempfile::tempdir().unwrap();
        for (name, board) in
            [("a.png", Board::chessboard(9, 6, 0.025).unwrap()), ("b.png", Board::charuco([7, 5], 0.035, 0.026, "4x4_50", false).unwrap())]
        {
            let path = folder.path().join(name);
            save_png(&path, &board).unwrap();
            // As large as in a photograph.
            let picture = crate::io::images::read_grey(&path).unwrap();
            let (width, height) = (picture.width() / 4, picture.height() / 4);
            let picture = imageops::resize(&picture, width, height, imageops::FilterType::Triangle);
            let bytes = std::fs::read(&path).unwrap();
            assert_eq!(&bytes[37..41], b"pHYs");
            let per_m = f64::from(u32::from_be_bytes(bytes[41..45].try_into().unwrap()));
            let target = board.target().unwrap();
            let found = board.find(&picture, &target).unwrap().unwrap();
            assert_eq!(found.len(), target.points.len());
            let (first, last) = (found.iter().find(|c| c.0 == 0).unwrap(), found.iter().max_by_key(|c| c.0).unwrap());
            let apart_m = (target.points[last.0] - target.points[0]).norm();
            assert!(((last.1 - first.1).norm() * 4.0 / per_m / apart_m - 1.0).abs() < 1e-3, "{name}");
        }
    }

    #[test]
    fn svg_is_exact_in_millimetres() {
        let text = svg(&Board::chessboard(9, 6, 0.0254).unwrap()).unwrap();
        assert_eq!(text.matches("<rect x=").count(), 35);
        assert!(text.contains("<rect x=\"15.24\" y=\"15.24\" width=\"25.4\" height=\"25.4\"/>"), "{text}");
        assert!(text.contains("width=\"284.48mm\""));
    }
}
