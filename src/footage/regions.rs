//! Masks (0 or 255): dilation and erosion by discs, votes of boxes, connected regions, holes.
//!
//! What lies outside the picture counts neither as inside nor as outside. Checked against cv::dilate, cv::erode and
//! cv::connectedComponents.

use image::{GrayImage, Luma};

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
    keep(mask, |piece| piece.len() >= smallest_px)
}

/// Keeps the 8-connected regions that hold a pixel of `seeds`.
pub fn keep_seeded(mask: &GrayImage, seeds: &GrayImage) -> GrayImage {
    let seeds = seeds.as_raw();
    keep(mask, |piece| piece.iter().any(|&i| seeds.get(i).is_some_and(|&s| s > 0)))
}

fn keep(mask: &GrayImage, wanted: impl Fn(&[usize]) -> bool) -> GrayImage {
    let mut pixels = vec![0; mask.as_raw().len()];
    for piece in pieces(mask, true).iter().filter(|p| wanted(p)) {
        piece.iter().for_each(|&i| pixels[i] = ON);
    }
    with_pixels(mask, pixels)
}

/// Fills holes (4-connected, off the border) of at most `largest_px` pixels.
pub fn fill_holes(mask: &GrayImage, largest_px: usize) -> GrayImage {
    let (width, height) = (mask.width() as usize, mask.height() as usize);
    let on_border = |i: &usize| i.is_multiple_of(width) || i % width == width - 1 || i / width == 0 || i / width == height - 1;
    let mut pixels = mask.as_raw().clone();
    for hole in pieces(&invert(mask), false).iter().filter(|p| p.len() <= largest_px && !p.iter().any(on_border)) {
        hole.iter().for_each(|&i| pixels[i] = ON);
    }
    with_pixels(mask, pixels)
}

/// Connected pieces of the mask, each a list of pixel indices, in scan order; neighbours are 8 with `diagonal`, else 4.
pub fn pieces(mask: &GrayImage, diagonal: bool) -> Vec<Vec<usize>> {
    let (width, height) = (mask.width() as usize, mask.height() as usize);
    let mut open: Vec<bool> = mask.iter().map(|&p| p > 0).collect();
    let mut found = Vec::new();
    for start in 0..open.len() {
        if !std::mem::replace(&mut open[start], false) {
            continue;
        }
        let mut piece = vec![start];
        let mut next = 0;
        while let Some(&at) = piece.get(next) {
            next += 1;
            let (x, y) = (at % width, at / width);
            for ny in y.saturating_sub(1)..=(y + 1).min(height - 1) {
                for nx in x.saturating_sub(1)..=(x + 1).min(width - 1) {
                    let near = ny * width + nx;
                    if (diagonal || nx == x || ny == y) && std::mem::replace(&mut open[near], false) {
                        piece.push(near);
                    }
                }
            }
        }
        found.push(piece);
    }
    found
}

/// Number of pixels in the mask.
pub fn area_px(mask: &GrayImage) -> usize {
    mask.iter().filter(|&&p| p > 0).count()
}

/// Sets pixels whose (2r+1)² box holds more than `share` set pixels: 0.5 smooths, 0 dilates, just below 1 erodes.
pub fn box_vote(mask: &GrayImage, r: i64, share: f64) -> GrayImage {
    let (width, height) = (i64::from(mask.width()), i64::from(mask.height()));
    let stride = width as usize + 1;
    let mut sums = vec![0u32; stride * (height as usize + 1)];
    for (y, row) in mask.as_raw().chunks_exact(width.max(1) as usize).enumerate() {
        let mut across = 0;
        for (x, &v) in row.iter().enumerate() {
            across += u32::from(v != 0);
            sums[(y + 1) * stride + x + 1] = sums[y * stride + x + 1] + across;
        }
    }
    GrayImage::from_fn(mask.width(), mask.height(), |x, y| {
        let (x, y) = (i64::from(x), i64::from(y));
        let (x0, x1) = ((x - r).max(0) as usize, (x + r + 1).min(width) as usize);
        let (y0, y1) = ((y - r).max(0) as usize, (y + r + 1).min(height) as usize);
        let inside = sums[y1 * stride + x1] + sums[y0 * stride + x0] - sums[y0 * stride + x1] - sums[y1 * stride + x0];
        let all = (x1 - x0) * (y1 - y0);
        Luma([if f64::from(inside) > share * all as f64 { 255 } else { 0 }])
    })
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
    use opencv::core::{BORDER_CONSTANT, Mat, Point, Size};
    use opencv::imgproc;
    use opencv::prelude::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn speckles(seed: u64, share: f64) -> GrayImage {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        GrayImage::from_fn(53, 37, |_, _| Luma([if random.random_bool(share) { ON } else { 0 }]))
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
    fn votes_of_all_and_of_any_match_opencv() {
        let border = imgproc::morphology_default_border_value().unwrap();
        let square = imgproc::get_structuring_element(imgproc::MORPH_RECT, Size::new(5, 5), Point::new(-1, -1)).unwrap();
        for (mask, share, grow) in [(speckles(4, 0.05), 0.0, true), (speckles(5, 0.95), 0.999, false)] {
            let mut expected = Mat::default();
            let operation = if grow { imgproc::dilate } else { imgproc::erode };
            operation(&mat(&mask), &mut expected, &square, Point::new(-1, -1), 1, BORDER_CONSTANT, border).unwrap();
            assert_eq!(box_vote(&mask, 2, share).as_raw(), expected.data_bytes().unwrap(), "share {share}");
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
            let ours = pieces(&mask, diagonal);
            let labels = labels.data_typed::<i32>().unwrap();
            assert!(ours.iter().all(|piece| piece.iter().all(|&i| labels[i] == labels[piece[0]])));
            let mut found: Vec<usize> = ours.iter().map(Vec::len).collect();
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
        let mask = GrayImage::from_fn(9, 5, |x, y| Luma([if rows[y as usize].as_bytes()[x as usize] == b'#' { ON } else { 0 }]));
        let filled = fill_holes(&mask, 4);
        assert_eq!(area_px(&filled), area_px(&mask) + 4);
        assert_eq!(area_px(&fill_holes(&mask, 99)), area_px(&mask) + 4 + 7);
        let seeds = GrayImage::from_fn(9, 5, |x, y| Luma([if (x, y) == (0, 0) { ON } else { 0 }]));
        assert_eq!(keep_seeded(&mask, &seeds), mask);
        assert_eq!(area_px(&keep_seeded(&mask, &GrayImage::new(9, 5))), 0);
    }
}
