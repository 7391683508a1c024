//! Where a camera saw the person: a mask without the empty rest of its picture.

use image::{GrayImage, Luma};
use nalgebra::Point2;

use crate::math::distance_field::{DistanceField, extent};

/// Cells of the distance to a silhouette: half the memory of pixels in each direction, a centimetre at 3 m.
const FIELD_STEP_PX: usize = 2;
/// Outlines this close to the image border are the border's.
const BORDER_PX: u32 = 3;

/// The pixels of one camera that show the person.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Silhouette {
    size_px: [u32; 2],
    /// The smallest rectangle that holds all of them, from this pixel on.
    corner_px: [u32; 2],
    kept: GrayImage,
}

impl Silhouette {
    /// Of a mask of raw pixels, 255 inside.
    pub fn new(mask: &GrayImage) -> Silhouette {
        let inside = mask.enumerate_pixels().filter(|(_, _, p)| p.0[0] > 127).map(|(x, y, _)| [x as usize, y as usize]);
        let size_px = mask.dimensions().into();
        let Some(extent) = extent(inside) else { return Silhouette { size_px, ..Silhouette::default() } };
        let [least, most] = extent.map(|place| place.map(|v| v as u32));
        let kept = image::imageops::crop_imm(mask, least[0], least[1], most[0] - least[0] + 1, most[1] - least[1] + 1).to_image();
        Silhouette { size_px, corner_px: least, kept }
    }

    /// Width and height of the picture, pixels.
    pub fn size_px(&self) -> [usize; 2] {
        self.size_px.map(|n| n as usize)
    }

    pub fn contains(&self, x: u32, y: u32) -> bool {
        let from_corner = |v: u32, k: usize| v.checked_sub(self.corner_px[k]);
        let pixel = from_corner(x, 0).zip(from_corner(y, 1)).and_then(|(x, y)| self.kept.get_pixel_checked(x, y));
        pixel.is_some_and(|p| p.0[0] > 127)
    }

    /// Without the pixels where `keep` says no.
    pub fn retained(&self, keep: impl Fn(u32, u32) -> bool) -> Silhouette {
        let mut kept = self.kept.clone();
        let [left, top] = self.corner_px;
        kept.enumerate_pixels_mut().filter(|(x, y, _)| !keep(left + x, top + y)).for_each(|(_, _, p)| *p = Luma([0]));
        Silhouette { kept, ..*self }
    }

    /// Points half-way between its pixels and their 4-neighbours outside, row by row.
    pub fn outline(&self) -> Vec<Point2<f64>> {
        let within = |k: usize, length: u32| {
            let end = (self.corner_px[k] + length).min(self.size_px[k].saturating_sub(BORDER_PX));
            self.corner_px[k].max(BORDER_PX)..end
        };
        let mut pixels = Vec::new();
        for y in within(1, self.kept.height()) {
            for x in within(0, self.kept.width()).filter(|x| self.contains(*x, y)) {
                for (dx, dy) in [(-1i32, 0i32), (1, 0), (0, -1), (0, 1)] {
                    if !self.contains((x as i32 + dx) as u32, (y as i32 + dy) as u32) {
                        pixels.push(Point2::new(x as f64 + 0.5 * dx as f64, y as f64 + 0.5 * dy as f64));
                    }
                }
            }
        }
        pixels
    }

    /// Distances to it.
    pub fn distances(&self) -> DistanceField {
        let [width, height] = self.size_px();
        DistanceField::new(width, height, FIELD_STEP_PX, |x, y| self.contains(x as u32, y as u32))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outline_of_a_rectangle_runs_along_its_edges() {
        let within = |x: u32, y: u32| (10..20).contains(&x) && (8..20).contains(&y);
        let found = Silhouette::new(&GrayImage::from_fn(40, 30, |x, y| Luma([if within(x, y) { 255 } else { 0 }])));
        assert_eq!((found.kept.dimensions(), found.size_px()), ((10, 12), [40, 30]));
        assert!((0..40).all(|x| (0..30).all(|y| found.contains(x, y) == within(x, y))));
        let pixels = found.outline();
        assert_eq!(pixels.len(), 2 * (10 + 12));
        assert!(pixels.iter().all(|p| p.x == 9.5 || p.x == 19.5 || p.y == 7.5 || p.y == 19.5));
        // Columns further right are cut off.
        assert_eq!(found.retained(|x, _| x < 15).outline().len(), 2 * (5 + 12));
    }

    #[test]
    fn a_border_is_no_outline_and_nothing_has_none() {
        assert!(Silhouette::new(&GrayImage::from_pixel(40, 30, Luma([255]))).outline().is_empty());
        let nothing = Silhouette::new(&GrayImage::new(40, 30));
        assert!(nothing.outline().is_empty() && !nothing.contains(0, 0) && nothing.size_px() == [40, 30]);
        assert_eq!(nothing.distances().at(5.0, 5.0).0, 0.0);
    }
}
