//! The animal's region: the connected piece nearest to the previous centre of mass, and a window of constant size round it.
//!
//! Of the pieces of at least 15 % of the largest one's area the one whose centre of mass is nearest is followed. The
//! window, centred on the centre of mass, takes the camera's movement out of the images, and with it the animal's
//! vertical movement (Favreau et al. 2004, section 2.2). Checked against rendered discs of known place.

use image::{GrayImage, Luma, imageops};

use crate::footage::regions::pieces;

/// Smaller pieces, against the largest one, are no animals.
const SPECKLE: f64 = 0.15;
/// A second piece of this part of the followed one is worth a notice.
const SECOND: f64 = 0.5;

/// The region of one frame.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Region {
    pub area_px: usize,
    /// Centre of mass; integers are pixel centres.
    pub centre_px: [f64; 2],
    /// x0, y0, x1, y1, the last ones inside.
    pub bounds_px: [u32; 4],
    /// Area of the largest other piece, where it is half as large or more.
    pub second_px: Option<usize>,
}

/// The mask with nothing but the followed piece, and that piece; `None` for an empty mask. `near` is the previous centre of
/// mass; without it the largest piece is taken.
pub fn follow(mask: &GrayImage, near: Option<[f64; 2]>) -> Option<(GrayImage, Region)> {
    let width = mask.width() as usize;
    let found = pieces(mask, true);
    let largest = found.iter().map(Vec::len).max()?;
    let centre = |piece: &[usize]| {
        let sum = piece.iter().fold([0, 0], |[x, y], i| [x + i % width, y + i / width]);
        sum.map(|s| s as f64 / piece.len() as f64)
    };
    let cost = |piece: &[usize]| match near {
        Some(near) => {
            let c = centre(piece);
            (c[0] - near[0]).hypot(c[1] - near[1])
        }
        None => -(piece.len() as f64),
    };
    let animals = found.iter().enumerate().filter(|(_, p)| p.len() as f64 >= SPECKLE * largest as f64);
    let (own, piece) = animals.min_by(|a, b| cost(a.1).total_cmp(&cost(b.1)))?;
    let second = found.iter().enumerate().filter(|(k, _)| *k != own).map(|(_, p)| p.len()).max();
    let mut only = GrayImage::new(mask.width(), mask.height());
    let mut bounds_px = [u32::MAX, u32::MAX, 0, 0];
    for i in piece {
        let (x, y) = ((i % width) as u32, (i / width) as u32);
        only.put_pixel(x, y, Luma([255]));
        bounds_px = [bounds_px[0].min(x), bounds_px[1].min(y), bounds_px[2].max(x), bounds_px[3].max(y)];
    }
    let second_px = second.filter(|s| *s as f64 >= SECOND * piece.len() as f64);
    Some((only, Region { area_px: piece.len(), centre_px: centre(piece), bounds_px, second_px }))
}

/// Width and height of the smallest window that, centred on the centres of mass, holds every region and two pixels more.
pub fn window_size(regions: &[Region]) -> [u32; 2] {
    [0, 1].map(|k| {
        let reach =
            regions.iter().map(|r| (r.centre_px[k] - f64::from(r.bounds_px[k])).max(f64::from(r.bounds_px[k + 2]) - r.centre_px[k]));
        2 * (reach.fold(0.0, f64::max).ceil() as u32 + 2) + 1
    })
}

/// The part of a mask of `size` pixels whose middle is `centre_px`; black beyond the picture.
pub fn window(mask: &GrayImage, centre_px: [f64; 2], size: [u32; 2]) -> GrayImage {
    let corner = [0, 1].map(|k| centre_px[k].round() as i64 - i64::from(size[k] / 2));
    let mut cut = GrayImage::new(size[0], size[1]);
    imageops::replace(&mut cut, mask, -corner[0], -corner[1]);
    cut
}

#[cfg(test)]
mod tests {
    use super::*;

    fn discs(list: &[(f64, f64, f64)]) -> GrayImage {
        GrayImage::from_fn(90, 60, |x, y| {
            Luma([if list.iter().any(|(cx, cy, r)| (f64::from(x) - cx).hypot(f64::from(y) - cy) <= *r) { 255 } else { 0 }])
        })
    }

    #[test]
    fn the_nearest_animal_is_followed_and_the_other_one_told() {
        let mask = discs(&[(20.0, 30.0, 8.0), (60.0, 25.0, 10.0), (85.0, 5.0, 1.0)]);
        let (only, region) = follow(&mask, Some([30.0, 30.0])).unwrap();
        assert_eq!((region.centre_px, region.bounds_px), ([20.0, 30.0], [12, 22, 28, 38]));
        assert!(region.second_px.is_some() && only.get_pixel(60, 25).0 == [0]);
        // Without a previous centre the largest, and never a speckle however near.
        assert_eq!(follow(&mask, None).unwrap().1.centre_px, [60.0, 25.0]);
        assert_eq!(follow(&mask, Some([85.0, 5.0])).unwrap().1.centre_px, [60.0, 25.0]);
        assert!(follow(&GrayImage::new(5, 5), None).is_none());
    }

    #[test]
    fn windows_hold_the_region_in_their_middle_even_at_the_border() {
        let mask = discs(&[(3.0, 30.0, 8.0)]);
        let (_, region) = follow(&mask, None).unwrap();
        let size = window_size(&[region]);
        let cut = window(&mask, region.centre_px, size);
        assert_eq!(cut.dimensions(), (size[0], size[1]));
        let kept = cut.iter().filter(|p| **p > 0).count();
        assert_eq!(kept, region.area_px);
        assert_eq!(cut.get_pixel(size[0] / 2, size[1] / 2).0, [255]);
    }
}
