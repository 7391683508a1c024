//! Pictures made smaller by whole factors, for what needs no detail.

use image::{GrayImage, Luma};
use nalgebra::Point2;

/// Longer sides are reduced to about this; a person of a quarter of it is still 80 px tall.
const SIDE_PX: u32 = 320;

/// The factor for pictures of this size: 1 for small ones.
pub fn reduction(size_px: [u32; 2]) -> u32 {
    (size_px[0].max(size_px[1]) / SIDE_PX).max(1)
}

/// Means over squares of side `factor`, from the upper left corner; what does not fill a square is left out.
pub fn reduced(image: &GrayImage, factor: u32) -> GrayImage {
    if factor <= 1 {
        return image.clone();
    }
    let (width, factor) = (image.width() as usize, factor as usize);
    let area = (factor * factor) as u32;
    GrayImage::from_fn(image.width() / factor as u32, image.height() / factor as u32, |x, y| {
        let start = y as usize * factor * width + x as usize * factor;
        let rows = (0..factor).map(|row| &image.as_raw()[start + row * width..][..factor]);
        let sum: u32 = rows.flatten().map(|&p| u32::from(p)).sum();
        Luma([((sum + area / 2) / area) as u8])
    })
}

/// The pixel of the whole picture at the centre of a reduced pixel.
pub fn full_px(x: u32, y: u32, factor: u32) -> Point2<f64> {
    let at = |v: u32| f64::from(v * factor) + 0.5 * f64::from(factor - 1);
    Point2::new(at(x), at(y))
}

/// A reduced mask at the size of the whole picture.
pub fn enlarged(mask: &GrayImage, factor: u32, size_px: [u32; 2]) -> GrayImage {
    let inside = |v: u32, size: u32| (v / factor.max(1)).min(size.saturating_sub(1));
    GrayImage::from_fn(size_px[0], size_px[1], |x, y| *mask.get_pixel(inside(x, mask.width()), inside(y, mask.height())))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn squares_become_their_means_and_masks_return() {
        let image = GrayImage::from_fn(7, 5, |x, y| Luma([(10 * x + y) as u8]));
        let small = reduced(&image, 2);
        assert_eq!(small.dimensions(), (3, 2));
        assert!(small.enumerate_pixels().all(|(x, y, p)| {
            let centre = full_px(x, y, 2);
            (f64::from(p.0[0]) - (10.0 * centre.x + centre.y)).abs() <= 0.5
        }));
        let mask = GrayImage::from_fn(3, 2, |x, _| Luma([if x == 1 { 255 } else { 0 }]));
        let large = enlarged(&mask, 2, [7, 5]);
        assert!(large.enumerate_pixels().all(|(x, _, p)| (p.0[0] > 0) == (2..4).contains(&x)));
        assert_eq!([[640, 480], [160, 120], [1920, 1080]].map(reduction), [2, 1, 6]);
    }
}
