//! Sums of [`super::subpixel`] over the windows of many pixels at once: the plane through the disparities and equation (2).
//!
//! A block of [`LANES`] pixels of a row walks over the places of a window together; what does not belong to a pixel's surface counts
//! nothing. Rounding is that of the sums pixel by pixel. Checked against these.

// Indexed loops of fixed length are what the compiler turns into vectors.
#![allow(clippy::needless_range_loop)]

use rayon::prelude::*;

/// Half-width of all windows here.
pub const RADIUS: usize = 2;
/// Pixels of a block.
const LANES: usize = 8;

type Block = [f32; LANES];
/// One weight per place of a window, row by row.
pub type Weights = [[f32; 2 * RADIUS + 1]; 2 * RADIUS + 1];

/// Sums of equation (2) for one window.
#[derive(Clone, Copy, Default, Debug, PartialEq)]
pub struct Sums {
    /// Σ w.
    pub weight: f32,
    /// Σ w g², Σ w g e and Σ w e².
    pub gg: f32,
    pub ge: f32,
    pub ee: f32,
}

/// A picture with a border, so that every block has its window.
struct Padded {
    values: Vec<f32>,
    stride: usize,
}

impl Padded {
    fn new(values: &[f32], width: usize, border: f32) -> Padded {
        let mut padded = Padded::filled(width, values.len() / width.max(1), border);
        let stride = padded.stride;
        for (out, row) in padded.values[RADIUS * stride..].chunks_exact_mut(stride).zip(values.chunks_exact(width.max(1))) {
            out[RADIUS..][..width].copy_from_slice(row);
        }
        padded
    }

    fn filled(width: usize, height: usize, value: f32) -> Padded {
        let stride = width.next_multiple_of(LANES) + 2 * RADIUS;
        Padded { values: vec![value; (height + 2 * RADIUS) * stride], stride }
    }

    /// The block that lies `dx` and `dy`, 0 to 2 [`RADIUS`], from the upper left of the window of that at (x, y).
    #[inline(always)]
    fn block(&self, x: usize, y: usize, dx: usize, dy: usize) -> Block {
        *self.values[(y + dy) * self.stride + x + dx..].first_chunk().unwrap_or(&[f32::NAN; LANES])
    }
}

/// A view along the surface: g and e of equation (2), 0 where unknown, and whether they are known.
pub struct View {
    slope: Padded,
    misfit: Padded,
    known: Padded,
}

impl View {
    /// Of a picture of `width` × `height` pixels: index, g and e of those that are seen; what is NaN is unknown.
    pub fn new([width, height]: [usize; 2], seen: impl Iterator<Item = (usize, f32, f32)>) -> View {
        let [mut slope, mut misfit, mut known] = [(); 3].map(|()| Padded::filled(width, height, 0.0));
        for (i, g, e) in seen.filter(|(_, g, e)| !(g + e).is_nan()) {
            let at = (i / width + RADIUS) * slope.stride + i % width + RADIUS;
            (slope.values[at], misfit.values[at], known.values[at]) = (g, e, 1.0);
        }
        View { slope, misfit, known }
    }
}

/// Value at every pixel of the least-squares plane through the disparities of its window that differ by at most `same_px`, with a
/// little weight on no slope; NaN where there is no disparity.
pub fn planes(disparity: &[f32], width: usize, same_px: f32) -> Vec<f32> {
    let padded = Padded::new(disparity, width, f32::NAN);
    let mut planes = vec![f32::NAN; disparity.len()];
    planes.par_chunks_exact_mut(width.max(1)).enumerate().for_each(|(y, out)| planes_row(&padded, y, same_px, out));
    planes
}

/// Sums over the windows of all pixels, of places whose plane differs by at most `same_px`; `None` where there is no plane.
pub fn sums(planes: &[f32], width: usize, views: &[View], weights: &Weights, same_px: f32) -> Vec<Option<Sums>> {
    let padded = Padded::new(planes, width, f32::NAN);
    let mut sums = vec![None; planes.len()];
    let rows = sums.par_chunks_exact_mut(width.max(1)).enumerate();
    rows.for_each(|(y, out)| sums_row(&padded, views, weights, y, same_px, out));
    sums
}

fn planes_row(padded: &Padded, y: usize, same_px: f32, out: &mut [f32]) {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        return unsafe { planes_row_avx2(padded, y, same_px, out) };
    }
    planes_row_plain(padded, y, same_px, out);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn planes_row_avx2(padded: &Padded, y: usize, same_px: f32, out: &mut [f32]) {
    planes_row_plain(padded, y, same_px, out);
}

#[inline(always)]
fn planes_row_plain(padded: &Padded, y: usize, same_px: f32, out: &mut [f32]) {
    for (k, out) in out.chunks_mut(LANES).enumerate() {
        if padded.block(k * LANES, y, RADIUS, RADIUS).iter().any(|d| !d.is_nan()) {
            let values = plane_block(padded, k * LANES, y, same_px);
            out.iter_mut().zip(values).for_each(|(out, value)| *out = value);
        }
    }
}

#[inline(always)]
fn plane_block(padded: &Padded, x: usize, y: usize, same_px: f32) -> Block {
    let here = padded.block(x, y, RADIUS, RADIUS);
    // Sums of 1, x, y, x², xy, y², and of d, d x, d y.
    let (zero, half) = ([0.0; LANES], [0.5; LANES]);
    let [mut n, mut sx, mut sy, mut xx, mut xy, mut yy] = [zero, zero, zero, half, zero, half];
    let [mut d0, mut dx, mut dy] = [zero; 3];
    for row in 0..=2 * RADIUS {
        for column in 0..=2 * RADIUS {
            let there = padded.block(x, y, column, row);
            let [across, down] = [column, row].map(|k| k as f32 - RADIUS as f32);
            for i in 0..LANES {
                let d = there[i] - here[i];
                let (one, d) = if d.abs() <= same_px { (1.0, d) } else { (0.0, 0.0) };
                n[i] += one;
                sx[i] += one * across;
                sy[i] += one * down;
                xx[i] += one * (across * across);
                xy[i] += one * (across * down);
                yy[i] += one * (down * down);
                d0[i] += d;
                dx[i] += d * across;
                dy[i] += d * down;
            }
        }
    }
    let mut values = here;
    for i in 0..LANES {
        // The slopes are eliminated; their equations are regular thanks to the weight on none.
        let determinant = xx[i] * yy[i] - xy[i] * xy[i];
        let (p, q) = (yy[i] * sx[i] - xy[i] * sy[i], xx[i] * sy[i] - xy[i] * sx[i]);
        values[i] += (d0[i] * determinant - p * dx[i] - q * dy[i]) / (n[i] * determinant - p * sx[i] - q * sy[i]);
    }
    values
}

fn sums_row(padded: &Padded, views: &[View], weights: &Weights, y: usize, same_px: f32, out: &mut [Option<Sums>]) {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        return unsafe { sums_row_avx2(padded, views, weights, y, same_px, out) };
    }
    sums_row_plain(padded, views, weights, y, same_px, out);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn sums_row_avx2(padded: &Padded, views: &[View], weights: &Weights, y: usize, same_px: f32, out: &mut [Option<Sums>]) {
    sums_row_plain(padded, views, weights, y, same_px, out);
}

#[inline(always)]
fn sums_row_plain(padded: &Padded, views: &[View], weights: &Weights, y: usize, same_px: f32, out: &mut [Option<Sums>]) {
    for (k, out) in out.chunks_mut(LANES).enumerate() {
        let here = padded.block(k * LANES, y, RADIUS, RADIUS);
        if here.iter().all(|d| d.is_nan()) {
            continue;
        }
        let [weight, gg, ge, ee] = sums_block(padded, views, weights, k * LANES, y, same_px);
        for (i, out) in out.iter_mut().enumerate().filter(|(i, _)| !here[*i].is_nan()) {
            *out = Some(Sums { weight: weight[i], gg: gg[i], ge: ge[i], ee: ee[i] });
        }
    }
}

#[inline(always)]
fn sums_block(padded: &Padded, views: &[View], weights: &Weights, x: usize, y: usize, same_px: f32) -> [Block; 4] {
    let here = padded.block(x, y, RADIUS, RADIUS);
    let [mut weight, mut gg, mut ge, mut ee] = [[0.0; LANES]; 4];
    for row in 0..=2 * RADIUS {
        for column in 0..=2 * RADIUS {
            let there = padded.block(x, y, column, row);
            let mut own = [0.0; LANES];
            for i in 0..LANES {
                own[i] = if (there[i] - here[i]).abs() <= same_px { weights[row][column] } else { 0.0 };
            }
            for view in views {
                let [g, e, known] = [&view.slope, &view.misfit, &view.known].map(|picture| picture.block(x, y, column, row));
                for i in 0..LANES {
                    weight[i] += own[i] * known[i];
                    gg[i] += own[i] * g[i] * g[i];
                    ge[i] += own[i] * g[i] * e[i];
                    ee[i] += own[i] * e[i] * e[i];
                }
            }
        }
    }
    [weight, gg, ge, ee]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clouds::subpixel::around;
    use nalgebra::{Matrix3, Vector3};

    const WIDTH: usize = 37;
    const SAME_PX: f32 = 1.5;

    /// Two surfaces with holes.
    fn disparity() -> Vec<f32> {
        let at = |i: usize| (i % WIDTH, i / WIDTH);
        let value = |i: usize| match at(i) {
            _ if i * 7919 % 11 < 3 => f32::NAN,
            (x, y) if x < 15 => 12.3 + 0.11 * x as f32 - 0.07 * y as f32,
            (x, y) => 7.1 - 0.05 * x as f32 + 0.02 * (y * y % 7) as f32,
        };
        (0..WIDTH * 23).map(value).collect()
    }

    #[test]
    fn planes_meet_the_normal_equations_pixel_by_pixel() {
        let disparity = disparity();
        for (i, found) in planes(&disparity, WIDTH, SAME_PX).into_iter().enumerate() {
            let (mut normal, mut right) = (Matrix3::from_diagonal(&Vector3::new(0.0, 0.5, 0.5)), Vector3::zeros());
            for (dx, dy, j) in around(i, RADIUS as isize, WIDTH, disparity.len()) {
                let row = Vector3::new(1.0, dx as f64, dy as f64);
                let d = f64::from(disparity[j] - disparity[i]);
                if d.abs() <= f64::from(SAME_PX) {
                    normal += row * row.transpose();
                    right += row * d;
                }
            }
            let expected = normal.cholesky().map(|c| f64::from(disparity[i]) + c.solve(&right)[0]);
            assert_eq!(found.is_nan(), disparity[i].is_nan());
            assert!(found.is_nan() || (f64::from(found) - expected.unwrap()).abs() < 1e-5, "{i}: {found} {expected:?}");
        }
    }

    #[test]
    fn sums_are_those_pixel_by_pixel() {
        let planes = disparity();
        let wave = |a: f32, hole: usize| -> Vec<f32> {
            (0..planes.len()).map(|i| if i % hole == 0 { f32::NAN } else { (a * i as f32).sin() }).collect()
        };
        let views = [[wave(0.7, 13), wave(1.9, 17)], [wave(0.3, 5), wave(2.3, 29)]];
        let seen = |k: usize| (0..planes.len()).map(move |i| (i, k)).map(|(i, k)| (i, views[k][0][i], views[k][1][i]));
        let prepared = [0, 1].map(|k| View::new([WIDTH, planes.len() / WIDTH], seen(k)));
        let weights: Weights = std::array::from_fn(|y| std::array::from_fn(|x| 1.0 / (1.0 + (x + 2 * y) as f32)));
        for (i, found) in sums(&planes, WIDTH, &prepared, &weights, SAME_PX).into_iter().enumerate() {
            let mut expected = Sums::default();
            for (dx, dy, j) in around(i, RADIUS as isize, WIDTH, planes.len()) {
                let w = weights[(dy + RADIUS as isize) as usize][(dx + RADIUS as isize) as usize];
                for [slope, misfit] in views.iter().filter(|_| (planes[j] - planes[i]).abs() <= SAME_PX) {
                    let (g, e) = (slope[j], misfit[j]);
                    if !(g + e).is_nan() {
                        expected.weight += w;
                        expected.gg += w * g * g;
                        expected.ge += w * g * e;
                        expected.ee += w * e * e;
                    }
                }
            }
            assert_eq!(found, (!planes[i].is_nan()).then_some(expected), "{i}");
        }
    }
}
