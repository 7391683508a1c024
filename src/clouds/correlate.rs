//! Correlation over all baselines together.
//!
//! For a pixel p of the reference view and a disparity d, view k is read at p + d s_k:
//!   c_k(p, d) = Σ_{q in window(p)} min(|F_0(q) − F_k(q + d s_k)|, T).                                (1)
//! The pairs are added; where one view is occluded the other counts twice, plus a penalty π per pixel:
//!   c(p, d) = min(Σ_k c_k, m (min_k c_k + π)),   m = number of pairs.                                (2)
//! Small windows keep outlines in place, large ones decide ties. So (1) uses a small box, and
//!   C(p, d) = c(p, d) + the two smallest of c at the four diagonal neighbours p + (±2r, ±2r)          (3)
//! lets the window lean away from an edge.
//!
//! (1) with one d for all baselines is Okutomi and Kanade's SSSD; (3) is the multiple-window scheme of Hirschmüller, Innocent
//! and Garibaldi (2002), section 3. Running sums make the work independent of the box. Disparity outermost, pixels of a row
//! innermost: the compiler vectorises every inner loop.

use image::GrayImage;
use nalgebra::Vector2;
use rayon::prelude::*;

/// Rows per unit of parallel work; fixed, and sums are integers, so results do not depend on the threads.
const BAND_ROWS: usize = 24;

/// Marks a pixel without any match.
pub const NO_MATCH: u16 = u16::MAX;

/// A box of pixels, half open.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Region {
    pub x: [usize; 2],
    pub y: [usize; 2],
}

impl Region {
    pub fn width(&self) -> usize {
        self.x[1] - self.x[0]
    }

    pub fn height(&self) -> usize {
        self.y[1] - self.y[0]
    }
}

/// What to search and how.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Search {
    /// Disparities `first ..= last`, pixels.
    pub first: usize,
    pub last: usize,
    /// Half-width r of the small box.
    pub radius: usize,
    /// T of (1).
    pub truncation: u8,
    /// π of (2).
    pub occlusion_penalty: u16,
}

/// Winner-take-all result for a region, row by row.
#[derive(Clone, Debug, PartialEq)]
pub struct Matches {
    pub region: Region,
    /// Best whole disparity, px, or [`NO_MATCH`].
    pub best: Vec<u16>,
    /// C at the best disparity, just below and just above it.
    pub cost: Vec<[u16; 3]>,
    /// The lowest C more than one disparity away from the best.
    pub rival: Vec<u16>,
}

/// Finds the best disparity of every pixel of `region`. `others` are the other views' pictures with their steps against the
/// reference's.
pub fn correlate(reference: &GrayImage, others: &[(&GrayImage, Vector2<f64>)], region: Region, search: &Search) -> Matches {
    let starts: Vec<usize> = (region.y[0]..region.y[1]).step_by(BAND_ROWS).collect();
    let bands: Vec<Matches> = starts
        .into_par_iter()
        .map(|y| {
            let band = Region { x: region.x, y: [y, (y + BAND_ROWS).min(region.y[1])] };
            let volume = band_volume(reference, others, band, search);
            winners(&volume, band, search, others.len())
        })
        .collect();
    let mut all = Matches { region, best: Vec::new(), cost: Vec::new(), rival: Vec::new() };
    for band in bands {
        all.best.extend(band.best);
        all.cost.extend(band.cost);
        all.rival.extend(band.rival);
    }
    all
}

/// C of (3) for all disparities of a band: `[row][disparity][x]`.
fn band_volume(reference: &GrayImage, others: &[(&GrayImage, Vector2<f64>)], band: Region, search: &Search) -> Vec<u16> {
    let (r, lean) = (search.radius, 2 * search.radius);
    let (width, height) = (band.width(), band.height());
    let (wide, tall) = (width + 2 * lean, height + 2 * lean);
    let disparities = search.last + 1 - search.first;
    let mut volume = vec![0u16; height * disparities * width];
    let mut differences = vec![0u8; (wide + 2 * r) * (tall + 2 * r)];
    let mut pairs = vec![vec![0u16; wide * tall]; others.len()];
    let origin = [band.x[0] as isize - (lean + r) as isize, band.y[0] as isize - (lean + r) as isize];
    for d in 0..disparities {
        for ((other, step), sums) in others.iter().zip(&mut pairs) {
            let shift = step * (d + search.first) as f64;
            truncated_differences(reference, other, shift, origin, wide + 2 * r, search.truncation, &mut differences);
            box_sums(&differences, wide + 2 * r, r, sums);
        }
        let together = combine(&pairs, search.occlusion_penalty * ((2 * r + 1) * (2 * r + 1)) as u16);
        for y in 0..height {
            let row = |dy: usize, dx: usize| &together[(y + dy) * wide + dx..][..width];
            let out = &mut volume[(y * disparities + d) * width..][..width];
            lean_windows(row(lean, lean), [row(0, 0), row(0, 2 * lean), row(2 * lean, 0), row(2 * lean, 2 * lean)], out);
        }
    }
    volume
}

/// min(|F_0 − F_k|, T) on a window of the reference; T where either is unknown.
fn truncated_differences(
    reference: &GrayImage,
    other: &GrayImage,
    shift: Vector2<f64>,
    origin: [isize; 2],
    wide: usize,
    truncation: u8,
    out: &mut [u8],
) {
    let mut a = vec![0u8; wide];
    let mut b = vec![0u8; wide];
    for (row, out) in out.chunks_exact_mut(wide).enumerate() {
        let y = origin[1] + row as isize;
        shifted_row(reference, Vector2::zeros(), origin[0], y, &mut a);
        shifted_row(other, shift, origin[0], y, &mut b);
        for ((&a, &b), o) in a.iter().zip(&b).zip(out) {
            let difference = a.abs_diff(b).min(truncation);
            *o = if a == 0 || b == 0 { truncation } else { difference };
        }
    }
}

/// Pixels `x0..` of row `y` of the picture moved back by `shift`; 0 outside. Fractional shifts are interpolated.
fn shifted_row(image: &GrayImage, shift: Vector2<f64>, x0: isize, y: isize, out: &mut [u8]) {
    // Steps come from an inverted matrix: 1 + 2e-16 must not cost an interpolation.
    let shift = shift.map(|s| if (s - s.round()).abs() < 1e-6 { s.round() } else { s });
    let (whole, part) = (shift.map(f64::floor), shift - shift.map(f64::floor));
    let (x0, y) = (x0 + whole.x as isize, y + whole.y as isize);
    if part.norm() < 1e-6 {
        return copy_row(image, x0, y, out);
    }
    let mut corner = vec![0u8; out.len()];
    let mut sum = vec![0.0f32; out.len()];
    let mut known = vec![true; out.len()];
    for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
        let weight = |k: isize, t: f64| if k == 0 { 1.0 - t } else { t };
        let weight = (weight(dx, part.x) * weight(dy, part.y)) as f32;
        if weight > 1e-6 {
            copy_row(image, x0 + dx, y + dy, &mut corner);
            sum.iter_mut().zip(&corner).for_each(|(s, c)| *s += weight * f32::from(*c));
            known.iter_mut().zip(&corner).for_each(|(k, c)| *k &= *c != 0);
        }
    }
    for ((o, s), k) in out.iter_mut().zip(&sum).zip(&known) {
        *o = if *k { s.round() as u8 } else { 0 };
    }
}

fn copy_row(image: &GrayImage, x0: isize, y: isize, out: &mut [u8]) {
    out.fill(0);
    let (width, height) = (image.width() as isize, image.height() as isize);
    let (from, to) = (x0.clamp(0, width), (x0 + out.len() as isize).clamp(0, width));
    if (0..height).contains(&y) && from < to {
        let source = &image.as_raw()[(y * width + from) as usize..(y * width + to) as usize];
        out[(from - x0) as usize..][..source.len()].copy_from_slice(source);
    }
}

/// Sums over (2r+1)² boxes; `sums` is smaller than `values` by r on every side.
fn box_sums(values: &[u8], wide: usize, r: usize, sums: &mut [u16]) {
    let width = wide - 2 * r;
    let mut column = vec![0u16; wide];
    for row in values.chunks_exact(wide).take(2 * r) {
        column.iter_mut().zip(row).for_each(|(c, v)| *c += u16::from(*v));
    }
    for (y, out) in sums.chunks_exact_mut(width).enumerate() {
        let entering = &values[(y + 2 * r) * wide..][..wide];
        column.iter_mut().zip(entering).for_each(|(c, v)| *c += u16::from(*v));
        out.fill(0);
        for k in 0..=2 * r {
            out.iter_mut().zip(&column[k..]).for_each(|(o, c)| *o += c);
        }
        let leaving = &values[y * wide..][..wide];
        column.iter_mut().zip(leaving).for_each(|(c, v)| *c -= u16::from(*v));
    }
}

/// Equation (2).
fn combine(pairs: &[Vec<u16>], penalty: u16) -> Vec<u16> {
    match pairs {
        [a, b] => a.iter().zip(b).map(|(a, b)| (a + b).min(2 * (a.min(b) + penalty))).collect(),
        [a] => a.clone(),
        _ => (0..pairs.first().map_or(0, Vec::len)).map(|i| pairs.iter().map(|p| p[i]).sum()).collect(),
    }
}

/// Equation (3).
fn lean_windows(centre: &[u16], corners: [&[u16]; 4], out: &mut [u16]) {
    let [a, b, c, d] = corners;
    for i in 0..out.len() {
        let (low1, high1) = (a[i].min(b[i]), a[i].max(b[i]));
        let (low2, high2) = (c[i].min(d[i]), c[i].max(d[i]));
        let two_smallest = (low1 + low2).min(low1 + high1).min(low2 + high2);
        out[i] = centre[i] + two_smallest;
    }
}

fn winners(volume: &[u16], band: Region, search: &Search, pairs: usize) -> Matches {
    let width = band.width();
    let disparities = search.last + 1 - search.first;
    let count = width * band.height();
    let mut found = Matches { region: band, best: vec![0; count], cost: vec![[0; 3]; count], rival: vec![u16::MAX; count] };
    let mut lowest = vec![u16::MAX; width];
    for y in 0..band.height() {
        let at = |d: usize| &volume[(y * disparities + d) * width..][..width];
        let best = &mut found.best[y * width..][..width];
        lowest.fill(u16::MAX);
        for d in 0..disparities {
            for ((c, low), b) in at(d).iter().zip(&mut lowest).zip(best.iter_mut()) {
                *b = if c < low { d as u16 } else { *b };
                *low = (*low).min(*c);
            }
        }
        let rival = &mut found.rival[y * width..][..width];
        for d in 0..disparities {
            for ((c, b), r) in at(d).iter().zip(best.iter()).zip(rival.iter_mut()) {
                *r = if (d as u16).abs_diff(*b) > 1 { (*r).min(*c) } else { *r };
            }
        }
        let none = search.truncation as usize * (2 * search.radius + 1).pow(2) * 3 * pairs;
        for x in 0..width {
            let b = best[x] as usize;
            let cost = |d: Option<usize>| d.filter(|&d| d < disparities).map_or(u16::MAX, |d| at(d)[x]);
            found.cost[y * width + x] = [cost(b.checked_sub(1)), cost(Some(b)), cost(Some(b + 1))];
            best[x] = if usize::from(lowest[x]) >= none { NO_MATCH } else { (b + search.first) as u16 };
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Luma;
    use rand::RngExt;
    use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

    fn noise(seed: u64) -> GrayImage {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        GrayImage::from_fn(70, 50, |_, _| Luma([random.random_range(1..=255)]))
    }

    /// Equations (1) to (3) as they are written.
    fn by_definition(reference: &GrayImage, others: &[(&GrayImage, Vector2<f64>)], at: [i64; 2], d: i64, search: &Search) -> u16 {
        let read = |image: &GrayImage, x: i64, y: i64| {
            if x < 0 || y < 0 || x >= 70 || y >= 50 { 0 } else { image.get_pixel(x as u32, y as u32).0[0] }
        };
        let r = search.radius as i64;
        let pair = |centre: [i64; 2], k: usize| {
            let (other, step) = others[k];
            let mut sum = 0;
            for y in centre[1] - r..=centre[1] + r {
                for x in centre[0] - r..=centre[0] + r {
                    let (a, b) = (read(reference, x, y), read(other, x + step.x as i64 * d, y + step.y as i64 * d));
                    sum += u16::from(if a == 0 || b == 0 { search.truncation } else { a.abs_diff(b).min(search.truncation) });
                }
            }
            sum
        };
        let together = |centre: [i64; 2]| {
            let costs: Vec<u16> = (0..others.len()).map(|k| pair(centre, k)).collect();
            let penalty = search.occlusion_penalty * ((2 * r + 1) * (2 * r + 1)) as u16;
            if costs.len() == 2 { costs.iter().sum::<u16>().min(2 * (costs.iter().min().unwrap() + penalty)) } else { costs.iter().sum() }
        };
        let mut corners: Vec<u16> =
            [(-1, -1), (1, -1), (-1, 1), (1, 1)].map(|(i, j)| together([at[0] + 2 * r * i, at[1] + 2 * r * j])).into();
        corners.sort_unstable();
        together(at) + corners[0] + corners[1]
    }

    #[test]
    fn running_sums_meet_the_definition() {
        let (a, b, c) = (noise(1), noise(2), noise(3));
        let steps = [Vector2::new(-1.0, 0.0), Vector2::new(0.0, 1.0)];
        let search = Search { first: 2, last: 9, radius: 2, truncation: 50, occlusion_penalty: 3 };
        let region = Region { x: [0, 70], y: [0, 50] };
        for others in [&[(&b, steps[0])][..], &[(&b, steps[0]), (&c, steps[1])]] {
            let found = correlate(&a, others, region, &search);
            for i in (0..3500).step_by(37) {
                let at = [(i % 70) as i64, (i / 70) as i64];
                let costs: Vec<u16> = (2..=9).map(|d| by_definition(&a, others, at, d, &search)).collect();
                let best = costs.iter().enumerate().min_by_key(|(_, c)| **c).unwrap().0;
                let rival = costs.iter().enumerate().filter(|(d, _)| d.abs_diff(best) > 1).map(|(_, c)| *c).min().unwrap();
                let none = costs[best] >= 50 * 75 * others.len() as u16;
                assert_eq!(found.best[i], if none { NO_MATCH } else { best as u16 + 2 });
                assert_eq!((found.cost[i][1], found.rival[i]), (costs[best], rival));
            }
        }
    }

    #[test]
    fn fractional_steps_find_the_shift() {
        // A camera at 1.5 baselines: its picture is the reference moved by 1.5 d, here with d = 6.
        let a = noise(4);
        let moved = GrayImage::from_fn(70, 50, |x, y| if x + 9 < 70 { *a.get_pixel(x + 9, y) } else { Luma([0]) });
        let search = Search { first: 0, last: 12, radius: 2, truncation: 50, occlusion_penalty: 3 };
        let found = correlate(&a, &[(&moved, Vector2::new(-1.5, 0.0))], Region { x: [20, 60], y: [8, 40] }, &search);
        assert!(found.best.iter().all(|&d| d == 6));
    }

    #[test]
    fn no_texture_in_common_is_no_match() {
        let search = Search { first: 0, last: 5, radius: 1, truncation: 20, occlusion_penalty: 0 };
        let (dark, bright) = (GrayImage::from_pixel(70, 50, Luma([10])), GrayImage::from_pixel(70, 50, Luma([200])));
        let found = correlate(&dark, &[(&bright, Vector2::new(-1.0, 0.0))], Region { x: [10, 20], y: [10, 20] }, &search);
        assert!(found.best.iter().all(|&d| d == NO_MATCH));
    }
}
