//! Masks (0 or 255): dilation and erosion by discs, votes of boxes, connected regions, holes.
//!
//! What lies outside the picture counts neither as inside nor as outside. Checked against cv::dilate, cv::erode and
//! cv::connectedComponents.

use image::GrayImage;
use std::ops::Range;

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
    keep(mask, |piece| runs_area_px(piece) >= smallest_px)
}

/// Keeps the 8-connected regions that hold a pixel of `seeds`.
pub fn keep_seeded(mask: &GrayImage, seeds: &GrayImage) -> GrayImage {
    let seeds = seeds.as_raw();
    let width = mask.width() as usize;
    let seeded = |run: &Run| seeds.get(run.pixels(width)).is_some_and(|part| part.iter().any(|&s| s > 0));
    keep(mask, |piece| piece.iter().any(seeded))
}

fn keep(mask: &GrayImage, wanted: impl Fn(&[Run]) -> bool) -> GrayImage {
    let mut pixels = vec![0; mask.as_raw().len()];
    for run in runs(mask, true).iter().filter(|p| wanted(p)).flatten() {
        pixels[run.pixels(mask.width() as usize)].fill(ON);
    }
    with_pixels(mask, pixels)
}

/// Fills holes (4-connected, off the border) of at most `largest_px` pixels.
pub fn fill_holes(mask: &GrayImage, largest_px: usize) -> GrayImage {
    let (width, height) = (mask.width() as usize, mask.height() as usize);
    let on_border = |run: &Run| run.from == 0 || run.to == width || run.y == 0 || run.y + 1 == height;
    let mut pixels = mask.as_raw().clone();
    for hole in runs(&invert(mask), false).iter().filter(|p| runs_area_px(p) <= largest_px && !p.iter().any(on_border)) {
        hole.iter().for_each(|run| pixels[run.pixels(width)].fill(ON));
    }
    with_pixels(mask, pixels)
}

/// Set pixels of row `y` from column `from` to before `to`, with none on either side.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Run {
    pub y: usize,
    pub from: usize,
    pub to: usize,
}

impl Run {
    /// Indices of the run's pixels in a picture of this width.
    pub fn pixels(&self, width: usize) -> Range<usize> {
        self.y * width + self.from..self.y * width + self.to
    }
}

/// Number of pixels of a piece.
pub fn runs_area_px(piece: &[Run]) -> usize {
    piece.iter().map(|run| run.to - run.from).sum()
}

/// Connected pieces of the mask, in scan order, as their pixel indices, in scan order; neighbours are 8 with `diagonal`, else 4.
pub fn pieces(mask: &GrayImage, diagonal: bool) -> Vec<Vec<usize>> {
    runs(mask, diagonal).iter().map(|piece| piece.iter().flat_map(|run| run.pixels(mask.width() as usize)).collect()).collect()
}

/// Connected pieces of the mask, in scan order, as their runs, in scan order; neighbours are 8 with `diagonal`, else 4.
pub fn runs(mask: &GrayImage, diagonal: bool) -> Vec<Vec<Run>> {
    let reach = usize::from(diagonal);
    let mut found: Vec<Run> = Vec::new();
    let mut joined = Joined::default();
    let mut above = 0..0;
    for (y, row) in mask.as_raw().chunks_exact(mask.width().max(1) as usize).enumerate() {
        let first = found.len();
        let mut from = 0;
        while let Some(skipped) = row[from..].iter().position(|&p| p > 0) {
            from += skipped;
            let to = row[from..].iter().position(|&p| p == 0).map_or(row.len(), |length| from + length);
            let own = joined.add();
            while above.start < above.end && found[above.start].to + reach <= from {
                above.start += 1;
            }
            above.clone().take_while(|&k| found[k].from < to + reach).for_each(|k| joined.join(own, k));
            found.push(Run { y, from, to });
            from = to;
        }
        above = first..found.len();
    }
    let mut places = vec![0; found.len()];
    let mut grouped: Vec<Vec<Run>> = Vec::new();
    for (k, run) in found.into_iter().enumerate() {
        let first = joined.first(k);
        if first == k {
            places[k] = grouped.len();
            grouped.push(Vec::new());
        }
        grouped[places[first]].push(run);
    }
    grouped
}

/// Things, numbered from 0, that are joined to pieces (union-find).
#[derive(Default)]
pub struct Joined {
    parents: Vec<usize>,
}

impl Joined {
    /// One more, alone; its number.
    pub fn add(&mut self) -> usize {
        self.parents.push(self.parents.len());
        self.parents.len() - 1
    }

    /// The lowest number in the piece of `k`.
    pub fn first(&mut self, mut k: usize) -> usize {
        while self.parents[k] != k {
            self.parents[k] = self.parents[self.parents[k]];
            k = self.parents[k];
        }
        k
    }

    pub fn join(&mut self, a: usize, b: usize) {
        let (a, b) = (self.first(a), self.first(b));
        self.parents[a.max(b)] = a.min(b);
    }
}

/// Number of pixels in the mask.
pub fn area_px(mask: &GrayImage) -> usize {
    mask.iter().filter(|&&p| p > 0).count()
}

/// Sets pixels whose (2r+1)² box holds more than `share` set pixels: 0.5 smooths, 0 dilates, just below 1 erodes.
pub fn box_vote(mask: &GrayImage, r: usize, share: f64) -> GrayImage {
    let (width, height) = (mask.width() as usize, mask.height() as usize);
    let row = |y: usize| &mask.as_raw()[y * width..][..width];
    let mut set = vec![0; mask.len()];
    // Of every column the set pixels in the box's rows, and of those the sums up to every column.
    let mut counts = vec![0u32; width];
    let mut sums = vec![0u32; width + 1];
    (0..r.min(height)).for_each(|y| counts.iter_mut().zip(row(y)).for_each(|(n, &v)| *n += u32::from(v != 0)));
    for (y, out) in set.chunks_exact_mut(width.max(1)).enumerate() {
        if y + r < height {
            counts.iter_mut().zip(row(y + r)).for_each(|(n, &v)| *n += u32::from(v != 0));
        }
        if y > r {
            counts.iter_mut().zip(row(y - r - 1)).for_each(|(n, &v)| *n -= u32::from(v != 0));
        }
        if counts.iter().all(|&n| n == 0) {
            continue;
        }
        let rows = (y + r + 1).min(height) - y.saturating_sub(r);
        let least = |columns: usize| (share * (rows * columns) as f64).floor() as u32 + 1;
        sums[1..].iter_mut().zip(&counts).fold(0, |sum, (total, n)| {
            *total = sum + n;
            *total
        });
        let inner = r..width.saturating_sub(r).max(r);
        let ends = (0..inner.start.min(width)).chain(inner.end.min(width)..width);
        for x in ends {
            let (from, to) = (x.saturating_sub(r), (x + r + 1).min(width));
            out[x] = if sums[to] - sums[from] >= least(to - from) { ON } else { 0 };
        }
        let (least, inner) = (least(2 * r + 1), inner.start.min(width)..inner.end.min(width));
        for ((out, from), to) in out[inner].iter_mut().zip(&sums).zip(sums.iter().skip(2 * r + 1)) {
            *out = if to - from >= least { ON } else { 0 };
        }
    }
    with_pixels(mask, set)
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
    use image::Luma;
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
