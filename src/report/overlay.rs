//! Stick figures over camera pictures.

use image::{GrayImage, Luma, RgbImage, imageops};
use nalgebra::Vector3;
use opencv::core::{Mat, Point, Vector};
use opencv::imgproc;

use super::ReportError;
use super::canvas::{Align, Canvas, Colour, INK, Pen, WHITE, skeleton};
use crate::body::NODES;
use crate::rig::Camera;

/// Enlargement of the camera's picture, so that lines are finer than its pixels.
const ENLARGE: u32 = 2;
const OUTLINE: Colour = [240, 228, 66];

/// The skeleton at `positions` (world, by `joint as usize`) over a camera's picture, twice its size; `outline` is a mask
/// whose edge is drawn too, such as [`silhouette`](crate::phantom::silhouette) of the fitted body.
pub fn overlay(
    image: &GrayImage,
    camera: &Camera,
    positions: &[Vector3<f64>; NODES],
    outline: Option<&GrayImage>,
) -> Result<RgbImage, ReportError> {
    let (width, height) = (image.width() * ENLARGE, image.height() * ENLARGE);
    let large = imageops::resize(image, width, height, imageops::FilterType::CatmullRom);
    let mut canvas = Canvas { picture: RgbImage::from_fn(width, height, |x, y| image::Rgb([large.get_pixel(x, y)[0]; 3])) };
    if let Some(mask) = outline {
        canvas.contours(&outlines(mask, width, height)?, OUTLINE, 2)?;
    }
    // Pixel centres are at integers in both pictures.
    let enlarge = |v: f64| (v + 0.5) * f64::from(ENLARGE) - 0.5;
    let nodes = positions.map(|x| camera.project(&x).map(|p| [enlarge(p.x), enlarge(p.y)]));
    let pen = Pen { width_px: 5, middle: [235, 235, 235], fade: 0.0, rim: Some([20, 20, 20]) };
    skeleton(&mut canvas, &nodes, &pen)?;
    Ok(canvas.picture)
}

pub(super) fn outlines(mask: &GrayImage, width: u32, height: u32) -> Result<Vector<Vector<Point>>, ReportError> {
    // Enlarged smoothly and cut at one half: no stairs.
    let mut large = imageops::resize(mask, width, height, imageops::FilterType::Triangle);
    large.pixels_mut().for_each(|p| *p = Luma([if p[0] > 127 { 255 } else { 0 }]));
    let mat = Mat::new_rows_cols_with_bytes::<u8>(height as i32, width as i32, &large)?;
    let mut contours = Vector::new();
    imgproc::find_contours(&mat, &mut contours, imgproc::RETR_CCOMP, imgproc::CHAIN_APPROX_NONE, Point::new(0, 0))?;
    Ok(contours)
}

/// Pictures side by side in rows of `columns`, each `tile_px` wide, with captions below.
pub fn strip(tiles: &[(RgbImage, String)], columns: usize, tile_px: u32) -> Result<RgbImage, ReportError> {
    const GAP: u32 = 8;
    const CAPTION: u32 = 30;
    let scaled: Vec<RgbImage> = tiles
        .iter()
        .map(|(picture, _)| {
            let height = (picture.height() * tile_px / picture.width().max(1)).max(1);
            imageops::resize(picture, tile_px, height, imageops::FilterType::Triangle)
        })
        .collect();
    let columns = columns.clamp(1, tiles.len().max(1)) as u32;
    let row_height = scaled.iter().map(|p| p.height()).max().unwrap_or(0) + CAPTION + GAP;
    let rows = (tiles.len() as u32).div_ceil(columns);
    let mut canvas = Canvas::new(columns * (tile_px + GAP) + GAP, rows * row_height + GAP, WHITE);
    for (i, (picture, (_, caption))) in scaled.iter().zip(tiles).enumerate() {
        let (x, y) = (GAP + (i as u32 % columns) * (tile_px + GAP), GAP + (i as u32 / columns) * row_height);
        canvas.paste(picture, x, y);
        let below = [f64::from(x + tile_px / 2), f64::from(y + picture.height()) + 21.0];
        canvas.text(below, caption, 10.0, INK, Align::Centre)?;
    }
    Ok(canvas.picture)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::{Joint, Pose, Shape, place};
    use crate::phantom::silhouette;
    use crate::report::canvas::{LEFT, RIGHT};
    use nalgebra::{Matrix3, Rotation3};

    #[test]
    fn each_side_has_its_colour_and_the_outline_runs_around_the_body() {
        let camera = Camera {
            name: "c".into(),
            size_px: [320, 240],
            matrix: Matrix3::new(260.0, 0.0, 160.0, 0.0, 260.0, 120.0, 0.0, 0.0, 1.0),
            lens: crate::rig::Lens::IDEAL,
            camera_from_world: Rotation3::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI),
            translation: Vector3::new(0.0, 0.9, 2.6),
        };
        let shape = Shape::template(1.7);
        let placed = place(&shape.offsets(), &Pose::rest(shape.offsets()[0]));
        let surface = crate::body::surface::Surface::new(&shape);
        let mask = silhouette(&surface, &shape.offsets(), &placed, &camera);
        let image = GrayImage::from_pixel(320, 240, Luma([90]));
        let picture = overlay(&image, &camera, &placed.positions, Some(&mask)).unwrap();
        assert_eq!(picture.dimensions(), (640, 480));
        let at = |joint: Joint| {
            let p = camera.project(&placed.position(joint)).unwrap();
            picture.get_pixel((2.0 * p.x + 0.5).round() as u32, (2.0 * p.y + 0.5).round() as u32).0
        };
        assert_eq!((at(Joint::LKnee), at(Joint::RWrist)), (LEFT, RIGHT));
        assert_eq!(picture.get_pixel(5, 5).0, [90; 3]);
        let yellow = picture.pixels().filter(|p| p[0] > 200 && p[1] > 190 && p[2] < 120).count();
        assert!(yellow > 600, "{yellow}");
    }

    #[test]
    fn strip_puts_tiles_in_rows() {
        let tiles = [[255u8, 0, 0], [0, 255, 0], [0, 0, 255]].map(|c| (RgbImage::from_pixel(64, 48, image::Rgb(c)), "frame".to_string()));
        let picture = strip(&tiles, 2, 100).unwrap();
        assert_eq!(picture.dimensions(), (224, 2 * (75 + 38) + 8));
        assert_eq!(picture.get_pixel(50, 40).0, [255, 0, 0]);
        assert_eq!(picture.get_pixel(160, 40).0, [0, 255, 0]);
        assert_eq!(picture.get_pixel(50, 150).0, [0, 0, 255]);
        assert!((84..113).flat_map(|y| (8..108).map(move |x| (x, y))).any(|(x, y)| picture.get_pixel(x, y)[0] < 128));
        assert!(strip(&[], 3, 100).is_ok());
    }
}
