//! Which matches to believe.
//!
//! - uniqueness: no rival more than one hypothesis away costs less than (1 + u) times the winner;
//! - consistency: every pixel of another view belongs to the cheapest of the winners that lead to it; a winner stands when the
//!   view's owner of its place has the same disparity (left-right, top-bottom, without matching again). One confirming view
//!   is enough where the other does not contradict: an owner that is nearer hides the pixel, one that is farther would be
//!   hidden by it;
//! - surface: connected pieces of slowly changing disparity smaller than an area are dropped (cv::filterSpeckles).
//!
//! A bar for texture is left out: where there is none, rivals are as good as the winner, and a bar that adds anything to
//! uniqueness takes bare skin first.

use super::correlate::{Matches, Pair, Scores};
use crate::footage::regions::Joined;
use crate::rig::rectify::Plane;
use image::GrayImage;
use rayon::prelude::*;

/// Whether the winner of a pixel stands alone.
#[inline(always)]
pub fn unique(scores: Scores, ratio: f32) -> bool {
    f32::from(scores[3]) > f32::from(scores[1]) * (1.0 + ratio)
}

/// Bits of the views that confirm each pixel of row `y` of a region, none where any contradicts.
pub fn confirm(best: &[u16], owners: &[Owners], y: usize, tolerance: u16, bits: &mut [u8]) {
    match owners {
        [one] => confirm_row([one], best, y, tolerance, bits),
        [one, other] => confirm_row([one, other], best, y, tolerance, bits),
        _ => bits.fill(0),
    }
}

#[inline(always)]
fn confirm_row<const VIEWS: usize>(owners: [&Owners; VIEWS], best: &[u16], y: usize, tolerance: u16, bits: &mut [u8]) {
    let rows = owners.map(|owners| (&owners.keys[y * owners.width..], &owners.shifts[..]));
    let tolerance = i32::from(tolerance);
    for (x, (bits, &h)) in bits.iter_mut().zip(best).enumerate() {
        let (mut found, mut contradicted) = (0, false);
        for (k, (keys, shifts)) in rows.iter().enumerate() {
            let Some(shift) = shifts.get(usize::from(h)) else { continue };
            let above = i32::from(!keys[x + *shift as usize] as u16) - i32::from(h) + tolerance;
            found |= u8::from(above as u32 <= 2 * tolerance as u32) << k;
            contradicted |= above < 0;
        }
        *bits = if contradicted { 0 } else { found };
    }
}

/// For every place of another view, the cheapest winner that leads to it.
pub struct Owners {
    /// 255 less the cost above the complement of the hypothesis, so that the greatest key is the cheapest winner, and of equal
    /// ones the farthest. [`NOBODY`] and [`UNKNOWN`] hold the complement of [`super::correlate::NO_MATCH`], nearer than all.
    keys: Vec<u32>,
    width: usize,
    /// How far each hypothesis leads in `keys`.
    shifts: Vec<u32>,
}

/// Key of a place that no winner leads to.
const NOBODY: u32 = 0;
/// Key of a place that the other picture does not show; greater than any winner's.
const UNKNOWN: u32 = 0xffff_0000;

impl Owners {
    pub fn new(matches: &Matches, pair: &Pair) -> Self {
        let (width, height) = (matches.region.width(), matches.region.height());
        // NO_MATCH becomes 0.
        let reach = matches.best.iter().map(|best| best.wrapping_add(1)).max().map_or(0, usize::from);
        let shifts: Vec<[isize; 2]> = (0..reach).map(|h| (pair.step * h as f64).map(|v| v.round() as isize).into()).collect();
        let ends = |i: usize| shifts.iter().fold([0, 0], |[low, high], s| [s[i].min(low), s[i].max(high)]);
        let ([left, right], [top, bottom]) = (ends(0), ends(1));
        let wide = width + (right - left) as usize;
        let start = [matches.region.x[0] as isize + left, matches.region.y[0] as isize + top];
        let mut keys = unclaimed(wide, height + (bottom - top) as usize, &pair.other, start);
        let shifts: Vec<u32> = shifts.iter().map(|s| ((s[1] - top) as usize * wide + (s[0] - left) as usize) as u32).collect();
        let rows = matches.best.chunks_exact(width.max(1)).zip(matches.scores.chunks_exact(width.max(1)));
        for (y, (best, scores)) in rows.enumerate() {
            let keys = &mut keys[y * wide..];
            for (x, (&h, scores)) in best.iter().zip(scores).enumerate() {
                let Some(shift) = shifts.get(usize::from(h)) else { continue };
                let key = &mut keys[x + *shift as usize];
                *key = (*key).max(u32::from(!scores[1]) << 16 | u32::from(!h));
            }
        }
        Self { keys, width: wide, shifts }
    }
}

/// Keys of `tall` rows of `wide` places, the first of which is pixel `start`: [`UNKNOWN`] where the picture shows nothing.
fn unclaimed(wide: usize, tall: usize, picture: &GrayImage, start: [isize; 2]) -> Vec<u32> {
    let (width, height) = (picture.width() as isize, picture.height() as isize);
    let (from, to) = (start[0].clamp(0, width), (start[0] + wide as isize).clamp(0, width));
    let mut keys = Vec::with_capacity(wide * tall);
    for y in (start[1]..).take(tall) {
        let end = keys.len() + wide;
        if y >= 0 && y < height && from < to {
            keys.resize(keys.len() + (from - start[0]) as usize, UNKNOWN);
            let known = &picture.as_raw()[(y * width + from) as usize..(y * width + to) as usize];
            keys.extend(known.iter().map(|&value| if value == 0 { UNKNOWN } else { NOBODY }));
        }
        keys.resize(end, UNKNOWN);
    }
    keys
}

/// Removes connected pieces of fewer than `area_px` pixels; neighbours belong together when they differ by at most `step_px`.
pub fn remove_speckles(disparity: &mut Plane, area_px: usize, step_px: f32) {
    let width = disparity.width() as usize;
    if width == 0 {
        return;
    }
    let near = |a: f32, b: f32| (a - b).abs() <= step_px;
    // Runs of pixels in a row, joined where they touch the row above: start, end, and the run that stands for the piece.
    let runs_of = |row: &[f32]| {
        let mut runs: Vec<[u32; 2]> = Vec::new();
        let mut x = 0;
        while x < row.len() {
            let start = x;
            x += 1;
            if row[start].is_nan() {
                continue;
            }
            while x < row.len() && near(row[x], row[x - 1]) {
                x += 1;
            }
            runs.push([start as u32, x as u32]);
        }
        runs
    };
    let rows: Vec<Vec<[u32; 2]>> = disparity.as_raw().par_chunks_exact(width).map(runs_of).collect();
    let firsts: Vec<usize> = rows.iter().scan(0, |sum, runs| Some(std::mem::replace(sum, *sum + runs.len()))).collect();
    let mut joined = Joined::default();
    rows.iter().flatten().for_each(|_| {
        joined.add();
    });
    for y in 1..rows.len() {
        let (above, here) = (&disparity.as_raw()[(y - 1) * width..][..width], &disparity.as_raw()[y * width..][..width]);
        let mut upper = 0;
        for (k, run) in rows[y].iter().enumerate() {
            while upper < rows[y - 1].len() && rows[y - 1][upper][1] <= run[0] {
                upper += 1;
            }
            for (j, other) in rows[y - 1].iter().enumerate().skip(upper).take_while(|(_, other)| other[0] < run[1]) {
                let shared = run[0].max(other[0]) as usize..run[1].min(other[1]) as usize;
                if shared.into_iter().any(|x| near(above[x], here[x])) {
                    joined.join(firsts[y] + k, firsts[y - 1] + j);
                }
            }
        }
    }
    let mut areas = vec![0; rows.iter().map(Vec::len).sum()];
    for (runs, first) in rows.iter().zip(&firsts) {
        for (k, run) in runs.iter().enumerate() {
            areas[joined.first(first + k)] += (run[1] - run[0]) as usize;
        }
    }
    let values: &mut [f32] = disparity;
    for ((runs, first), row) in rows.iter().zip(&firsts).zip(values.chunks_exact_mut(width)) {
        for (k, run) in runs.iter().enumerate() {
            if areas[joined.first(first + k)] < area_px {
                row[run[0] as usize..run[1] as usize].fill(f32::NAN);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clouds::correlate::{NO_MATCH, Region};
    use image::Luma;
    use nalgebra::Vector2;

    #[test]
    fn speckle_filter_meets_opencv() {
        use opencv::{calib3d, core, prelude::*};
        let field = |x: usize, y: usize| 16 * (5 + (x / 9 + y / 5) % 3 * 4) as i16 + ((x * 31 + y * 17) % 7) as i16;
        let values: Vec<i16> = (0..60 * 80).map(|i| if (i * 7919) % 11 < 3 { -16 } else { field(i % 80, i / 80) }).collect();
        let mut theirs = core::Mat::new_rows_cols_with_data(60, 80, &values).unwrap().try_clone().unwrap();
        calib3d::filter_speckles(&mut theirs, -16.0, 25, 16.0, &mut core::no_array()).unwrap();
        let known = |v: i16| if v == -16 { f32::NAN } else { f32::from(v) / 16.0 };
        let mut ours = Plane::from_raw(80, 60, values.iter().map(|&v| known(v)).collect()).unwrap();
        remove_speckles(&mut ours, 26, 1.0);
        let theirs: Vec<bool> = theirs.data_typed::<i16>().unwrap().iter().map(|&v| v == -16).collect();
        let ours: Vec<bool> = ours.as_raw().iter().map(|v| v.is_nan()).collect();
        assert_eq!(ours, theirs);
        assert!(theirs.iter().filter(|&&gone| gone).count() > values.iter().filter(|&&v| v == -16).count() + 50);
    }

    #[test]
    fn the_cheapest_winner_owns_a_place() {
        // 10, 12 and 13 lead to place 6 of a view on the right, 14 alone to place 10, 3 leaves the picture.
        let region = Region { x: [0, 20], y: [0, 1] };
        let mut matches = Matches { region, best: vec![NO_MATCH; 20], scores: vec![[9, 9, 9, 255]; 20] };
        for (x, h, cost) in [(10, 4, 7), (12, 6, 5), (13, 7, 9), (16, 10, 9), (14, 4, 100), (3, 4, 1)] {
            matches.best[x] = h;
            matches.scores[x][1] = cost;
        }
        let pair = |x: f64, y: f64| Pair {
            reference: GrayImage::from_pixel(20, 1, Luma([128])),
            other: GrayImage::from_pixel(20, 30, Luma([128])),
            step: Vector2::new(x, y),
        };
        let at = |bits: &[u8]| [10, 12, 13, 16, 14, 3].map(|i: usize| bits[i]);
        let confirmed = |matches: &Matches, pairs: &[Pair]| {
            let owners: Vec<Owners> = pairs.iter().map(|pair| Owners::new(matches, pair)).collect();
            let mut bits = vec![0; 20];
            confirm(&matches.best, &owners, 0, 1, &mut bits);
            bits
        };
        // 10 is hidden by 12, 13 is near enough to it, 16 would hide 12 if it were right.
        assert_eq!(at(&confirmed(&matches, &[pair(-1.0, 0.0)])), [0, 1, 1, 0, 1, 0]);
        assert_eq!(at(&confirmed(&matches, &[pair(-1.0, 0.0), pair(0.0, 1.0)])), [2, 3, 3, 0, 3, 2]);
        // A farther winner contradicts all that would hide it.
        (matches.best[8], matches.scores[8][1]) = (2, 1);
        assert_eq!(at(&confirmed(&matches, &[pair(-1.0, 0.0), pair(0.0, 1.0)])), [0, 0, 0, 0, 3, 2]);
    }
}
