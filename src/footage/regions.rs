//! Masks (0 or 255): dilation and erosion by discs, connected regions, holes.
//!
//! What lies outside the picture counts neither as inside nor as outside. Checked against cv::dilate, cv::erode and
//! cv::connectedComponents.

use image::GrayImage;

const ON: u8 = 255;

/// Grows the mask by a disc: all offsets with dx² + dy² <= radius².
pub fn dilate(mask: &GrayImage, radius_px: u32) -> GrayImage {
    let (width, height, radius) = (mask.width() as usize, mask.height() as usize, radius_px as isize);
    let source = mask.as_raw();
    let mut grown = vec![0u8; source.len()];
    if width == 0 {
        return mask.clone();
    }
    for (y, row) in grown.chunks_exact_mut(width).enumerate() {
        for dy in -radius..=radius {
            let Some(from) = y.checked_add_signed(dy).filter(|&from| from < height) else { continue };
            let reach = ((radius * radius - dy * dy) as f64).sqrt() as usize;
            let line = &source[from * width..(from + 1) * width];
            for dx in 0..=reach.min(width - 1) {
                or_into(&mut row[dx..], &line[..width - dx]);
                or_into(&mut row[..width - dx], &line[dx..]);
            }
        }
    }
    with_pixels(mask, grown)
}

/// Shrinks the mask by a disc.
pub fn erode(mask: &GrayImage, radius_px: u32) -> GrayImage {
    invert(&dilate(&invert(mask), radius_px))
}

/// Removes what a disc does not fit into.
pub fn open(mask: &GrayImage, radius_px: u32) -> GrayImage {
    dilate(&erode(mask, radius_px), radius_px)
}

/// Fills gaps that a disc does not fit into.
pub fn close(mask: &GrayImage, radius_px: u32) -> GrayImage {
    erode(&dilate(mask, radius_px), radius_px)
}

/// Keeps the 8-connected regions of at least `smallest_px` pixels.
pub fn keep_large(mask: &GrayImage, smallest_px: usize) -> GrayImage {
    let regions = label(mask, true);
    select(mask, &regions, |region| region.area_px >= smallest_px)
}

/// Keeps the 8-connected regions that hold a pixel of `seeds`.
pub fn keep_seeded(mask: &GrayImage, seeds: &GrayImage) -> GrayImage {
    let regions = label(mask, true);
    let mut seeded = vec![false; regions.list.len()];
    for (&label, &seed) in regions.labels.iter().zip(seeds.as_raw()) {
        if label > 0 && seed > 0 {
            seeded[label as usize - 1] = true;
        }
    }
    let pixels = regions.labels.iter().map(|&l| if l > 0 && seeded[l as usize - 1] { ON } else { 0 }).collect();
    with_pixels(mask, pixels)
}

/// Fills holes (4-connected, off the border) of at most `largest_px` pixels.
pub fn fill_holes(mask: &GrayImage, largest_px: usize) -> GrayImage {
    let outside = invert(mask);
    let holes = label(&outside, false);
    let filled = select(mask, &holes, |hole| hole.area_px <= largest_px && !hole.on_border);
    with_pixels(mask, filled.iter().zip(mask.iter()).map(|(a, b)| a | b).collect())
}

/// Number of pixels in the mask.
pub fn area_px(mask: &GrayImage) -> usize {
    mask.iter().filter(|&&p| p > 0).count()
}

struct Region {
    area_px: usize,
    on_border: bool,
}

/// Per pixel 0 or the position in `list` plus 1.
struct Regions {
    labels: Vec<u32>,
    list: Vec<Region>,
}

fn label(mask: &GrayImage, diagonal: bool) -> Regions {
    let (width, height) = (mask.width() as usize, mask.height() as usize);
    let source = mask.as_raw();
    let (mut labels, mut list, mut todo) = (vec![0u32; source.len()], Vec::new(), Vec::new());
    for start in 0..source.len() {
        if source[start] == 0 || labels[start] > 0 {
            continue;
        }
        let id = list.len() as u32 + 1;
        let mut region = Region { area_px: 0, on_border: false };
        labels[start] = id;
        todo.push(start);
        while let Some(at) = todo.pop() {
            let (x, y) = (at % width, at / width);
            region.area_px += 1;
            region.on_border |= x == 0 || y == 0 || x + 1 == width || y + 1 == height;
            for ny in y.saturating_sub(1)..=(y + 1).min(height - 1) {
                for nx in x.saturating_sub(1)..=(x + 1).min(width - 1) {
                    let next = ny * width + nx;
                    if (diagonal || nx == x || ny == y) && source[next] > 0 && labels[next] == 0 {
                        labels[next] = id;
                        todo.push(next);
                    }
                }
            }
        }
        list.push(region);
    }
    Regions { labels, list }
}

fn select(like: &GrayImage, regions: &Regions, wanted: impl Fn(&Region) -> bool) -> GrayImage {
    let chosen: Vec<bool> = regions.list.iter().map(wanted).collect();
    let pixels = regions.labels.iter().map(|&l| if l > 0 && chosen[l as usize - 1] { ON } else { 0 }).collect();
    with_pixels(like, pixels)
}

fn or_into(target: &mut [u8], source: &[u8]) {
    target.iter_mut().zip(source).for_each(|(t, s)| *t |= s);
}

fn invert(mask: &GrayImage) -> GrayImage {
    with_pixels(mask, mask.iter().map(|&p| if p > 0 { 0 } else { ON }).collect())
}

/// A mask of the size of `like`; `pixels` has as many entries.
pub(super) fn with_pixels(like: &GrayImage, pixels: Vec<u8>) -> GrayImage {
    let mut mask = GrayImage::new(like.width(), like.height());
    mask.copy_from_slice(&pixels);
    mask
}

#[cfg(test)]
mod tests {
    use super::*;
    use opencv::core::{BORDER_CONSTANT, Mat, Point};
    use opencv::imgproc;
    use opencv::prelude::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn speckles(seed: u64, share: f64) -> GrayImage {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        GrayImage::from_fn(53, 37, |_, _| image::Luma([if random.random_bool(share) { ON } else { 0 }]))
    }

    fn mat(mask: &GrayImage) -> Mat {
        Mat::new_rows_cols_with_data(mask.height() as i32, mask.width() as i32, mask.as_raw()).unwrap().try_clone().unwrap()
    }

    fn disc(radius: i32) -> Mat {
        let side = 2 * radius + 1;
        let bytes: Vec<u8> = (0..side * side)
            .map(|i| (i % side - radius, i / side - radius))
            .map(|(dx, dy)| u8::from(dx * dx + dy * dy <= radius * radius))
            .collect();
        Mat::new_rows_cols_with_data(side, side, &bytes).unwrap().try_clone().unwrap()
    }

    #[test]
    fn dilation_and_erosion_match_opencv() {
        let border = imgproc::morphology_default_border_value().unwrap();
        for radius in 0..5 {
            for (mask, ours, grow) in
                [(speckles(1, 0.03), dilate as fn(&GrayImage, u32) -> GrayImage, true), (speckles(2, 0.97), erode, false)]
            {
                let mut expected = Mat::default();
                let operation = if grow { imgproc::dilate } else { imgproc::erode };
                operation(&mat(&mask), &mut expected, &disc(radius as i32), Point::new(-1, -1), 1, BORDER_CONSTANT, border).unwrap();
                assert_eq!(ours(&mask, radius).as_raw(), expected.data_bytes().unwrap(), "radius {radius}, grow {grow}");
            }
        }
    }

    #[test]
    fn regions_match_opencv() {
        for (share, diagonal) in [(0.3, true), (0.5, false)] {
            let mask = speckles(3, share);
            let (mut labels, mut stats, mut centroids) = (Mat::default(), Mat::default(), Mat::default());
            let connectivity = if diagonal { 8 } else { 4 };
            let components = imgproc::connected_components_with_stats(
                &mat(&mask),
                &mut labels,
                &mut stats,
                &mut centroids,
                connectivity,
                opencv::core::CV_32S,
            )
            .unwrap();
            let mut expected: Vec<usize> = (1..components).map(|i| *stats.at_2d::<i32>(i, 4).unwrap() as usize).collect();
            let mut found: Vec<usize> = label(&mask, diagonal).list.iter().map(|r| r.area_px).collect();
            expected.sort_unstable();
            found.sort_unstable();
            assert!(found == expected && found.len() > 10);
            let kept: usize = expected.iter().filter(|&&area| area >= 9).sum();
            if diagonal {
                assert_eq!(area_px(&keep_large(&mask, 9)), kept);
            }
        }
    }

    #[test]
    fn holes_are_filled_and_bays_are_not() {
        let rows = ["#######..", "#..#..#..", "#..#...#.", "####..##.", "...####.."];
        let mask = GrayImage::from_fn(9, 5, |x, y| image::Luma([if rows[y as usize].as_bytes()[x as usize] == b'#' { ON } else { 0 }]));
        let filled = fill_holes(&mask, 4);
        assert_eq!(area_px(&filled), area_px(&mask) + 4);
        assert_eq!(area_px(&fill_holes(&mask, 99)), area_px(&mask) + 4 + 7);
        let seeds = GrayImage::from_fn(9, 5, |x, y| image::Luma([if (x, y) == (0, 0) { ON } else { 0 }]));
        assert_eq!(keep_seeded(&mask, &seeds), mask);
        assert_eq!(area_px(&keep_seeded(&mask, &GrayImage::new(9, 5))), 0);
    }
}
