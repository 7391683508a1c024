//! Disparity between whole hypotheses.
//!
//! Sums of absolute differences form a V about their minimum, so the first estimate is the equiangular fit
//!   δ = (c₋ − c₊) / (2 (max(c₋, c₊) − c));                                                          (1)
//! a parabola would pull towards whole disparities. The path sums of [`super::correlate`] raise both neighbours by up to P1 per
//! path, which pulls too; as much of it as the lower neighbour shows is taken off both.
//!
//! On people (1) is refined by Gauss-Newton steps on the grey values of all baselines together (Lucas and Kanade 1981). With D(q) the plane fitted to the disparities around q,
//!   e_k(q) = I_k(q + D(q) s_k) − I_0(q),   g_k(q) = dI_k/dD, the mean of both pictures' derivatives,
//!   δ(p) = −Σ w g e / (Σ w g² + s² / σ_0²),   s² = Σ w (e + δ g)² / Σ w,                            (2)
//! sums over a window of Gaussian weights w on one surface and over the views k that confirm p; pictures are brought to one
//! exposure first. D is what correlation says and σ_0 how well, so bare skin keeps it. Following D inside the window keeps
//! slanted and round limbs from biasing δ.
//!
//! The standard deviation of the result:
//!   σ² = a / (Σ w g² / s² + 1/σ_0²) + b (s²/g²)₄ + c j²,                                            (3)
//! noise; residuals that one pixel's gradient does not explain, at most 4 px²; and j, how much nearer a surface begins within
//! 5 px, at most 3 px. a, b and c were fitted once to the phantom's depth (four renders: two rigs, noise of 1, 2 and 4 grey
//! levels). Errors over σ within 3 σ (97 % of all) have variance 0.86 to 1.18 on fourteen renders: three rigs, noise of 1 to 4
//! grey levels, near and far, lossless and JPEG. Larger σ than [`LARGEST_SIGMA_PX`] are no measurement.
//! Checked against slanted planes and the phantom's known surface.

use super::correlate::{STEP_PENALTIES, Scores};
use super::windows::{self, RADIUS, Sums, View, Weights};
use crate::rig::rectify::Plane;
use nalgebra::Vector2;
use rayon::prelude::*;

/// P1 of the three paths together.
const RAISED: f32 = 3.0 * STEP_PENALTIES[0] as f32;

/// Part of the lower neighbour's rise that is taken for the penalty at most: on weak texture paths have not reached P1, and
/// taking off all would turn noise into offsets. 0.5 pulls 0.06 px on a plane at 0.3 px, 0.9 adds a third to the noise.
const LARGEST_PART: f32 = 0.65;

/// Offset δ of equation (1) from the costs just below, at and just above a minimum; NaN at the end of the search range.
#[inline(always)]
pub fn equiangular([below, at, above, _]: Scores) -> f32 {
    let (fall, rise) = (f32::from(below) - f32::from(at), f32::from(above) - f32::from(at));
    let (lower, higher) = if fall < rise { (fall, rise) } else { (rise, fall) };
    let part = LARGEST_PART * lower;
    let slope = higher - if part < RAISED { part } else { RAISED };
    let offset = if slope > 0.0 { (fall - rise) / (2.0 * slope) } else { 0.0 };
    if below == u8::MAX || above == u8::MAX { f32::NAN } else { offset }
}

/// Steps of (2); each takes more of the first estimate's pull towards whole disparities away.
const ROUNDS: usize = 3;
/// σ_0 of (2), px. Larger lets noise in where there is no texture, smaller keeps the errors of (1).
const CORRELATION_SIGMA_PX: f32 = 0.07;
/// Standard deviation of the window of (2); larger flattens what is round.
const SPREAD_PX: f32 = 1.5;
/// Neighbours that differ by more lie on another surface.
const SAME_SURFACE_PX: f32 = 1.5;
/// Longest step that is believed.
const LONGEST_STEP_PX: f32 = 1.0;
/// Least s², grey levels²: rounding and a good camera's noise.
const LEAST_VARIANCE: f32 = 1.0;
/// Reach of j in (3).
const JUMP_REACH_PX: usize = 5;
/// a, b and c of (3).
const NOISE_SHARE: f32 = 0.40;
const MISFIT_SHARE: f32 = 0.040;
const JUMP_SHARE: f32 = 0.0107;
/// Disparities with a larger σ are dropped, and those for which no step was believed: beside edges, and without texture.
const LARGEST_SIGMA_PX: f32 = 0.35;

/// Disparities after equation (2).
#[derive(Clone, Debug)]
pub struct Refined {
    /// Pixels; NaN where there was none or [`LARGEST_SIGMA_PX`] was exceeded.
    pub disparity: Plane,
    /// σ of (3), pixels; NaN where there is no disparity.
    pub sigma_px: Plane,
}

/// Another view, for the pixels of a part of the reference.
#[derive(Clone, Copy)]
pub struct Other<'a> {
    plane: &'a Plane,
    step: Vector2<f32>,
    corner: Vector2<f32>,
}

impl<'a> Other<'a> {
    /// `step` is against the reference, `corner` the part's first pixel.
    pub fn new(plane: &'a Plane, step: Vector2<f64>, corner: [usize; 2]) -> Self {
        Self { plane, step: step.map(|s| s as f32), corner: Vector2::from(corner).map(|c| c as f32) }
    }

    /// Its grey value where it sees pixel (x, y) of the part at disparity d; NaN outside.
    #[inline]
    pub fn see(&self, x: f32, y: f32, d: f32) -> f32 {
        sample(self.plane, self.corner.x + x + d * self.step.x, self.corner.y + y + d * self.step.y)
    }
}

/// Equation (2) for one window.
#[derive(Clone, Copy, Default)]
struct Fit {
    step: f32,
    /// Σ w g², grey levels² per px².
    energy: f32,
    /// s².
    variance: f32,
}

/// Refines the disparities of a part of the reference view, `reference`. Bit k of `confirmed` says that view k of `others`
/// agrees.
pub fn refine(reference: &Plane, others: &[Other], disparity: &Plane, confirmed: &[u8]) -> Refined {
    let (width, height) = disparity.dimensions();
    let mut now = disparity.as_raw().clone();
    let mut fits: Vec<Option<Fit>> = vec![None; now.len()];
    let weights = window_weights();
    let here = |other: &Other| slopes(reference, &now, other.step);
    let here: Vec<Vec<f32>> = others.iter().map(here).collect();
    let known: Vec<usize> = (0..now.len()).filter(|i| !now[*i].is_nan()).collect();
    for _ in 0..ROUNDS {
        let planes = windows::planes(&now, width as usize, SAME_SURFACE_PX);
        let look = |(k, other): (usize, &Other)| {
            let confirmed = known.par_iter().copied().filter(|i| confirmed[*i] >> k & 1 != 0);
            look_along(reference, &here[k], other, &planes, confirmed)
        };
        let seen: Vec<View> = others.iter().enumerate().map(look).collect();
        let sums = windows::sums(&planes, width as usize, &seen, &weights, SAME_SURFACE_PX);
        for &i in &known {
            if let Some(fit) = sums[i].and_then(fit).filter(|f| f.step.abs() < LONGEST_STEP_PX) {
                now[i] = planes[i] + fit.step;
                fits[i] = Some(fit);
            }
        }
    }
    let nearest = extremes(&now, width as usize, JUMP_REACH_PX, f32::max);
    let sigma = per_pixel(&now, |i| match fits[i].map(|fit| sigma_px(&fit, (nearest[i] - now[i]).min(3.0))) {
        Some(sigma) if sigma <= LARGEST_SIGMA_PX => sigma,
        _ => f32::NAN,
    });
    now.iter_mut().zip(&sigma).for_each(|(d, s)| *d = if s.is_nan() { f32::NAN } else { *d });
    let plane = |values| Plane::from_raw(width, height, values).expect("one value per pixel");
    Refined { disparity: plane(now), sigma_px: plane(sigma) }
}

/// `f` where there is a disparity, NaN elsewhere.
fn per_pixel(disparity: &[f32], f: impl Fn(usize) -> f32 + Sync) -> Vec<f32> {
    disparity.par_iter().enumerate().map(|(i, d)| if d.is_nan() { f32::NAN } else { f(i) }).collect()
}

/// Pixels (x offset, y offset, index) around pixel `i`, cut at the border.
pub(super) fn around(i: usize, radius: isize, width: usize, count: usize) -> impl Iterator<Item = (isize, isize, usize)> {
    let (x, y, w, h) = ((i % width) as isize, (i / width) as isize, width as isize, (count / width) as isize);
    let rows = (y - radius).max(0)..(y + radius + 1).min(h);
    rows.flat_map(move |qy| ((x - radius).max(0)..(x + radius + 1).min(w)).map(move |qx| (qx - x, qy - y, (qy * w + qx) as usize)))
}

/// Derivative of the reference's picture along a step, where there is a disparity.
fn slopes(reference: &Plane, disparity: &[f32], step: Vector2<f32>) -> Vec<f32> {
    let width = reference.width() as usize;
    per_pixel(disparity, |i| {
        let at = |d: f32| sample(reference, (i % width) as f32 + d * step.x, (i / width) as f32 + d * step.y);
        at(0.5) - at(-0.5)
    })
}

/// The other view where it sees the surface, for the pixels that it confirms. `here` are the reference's own derivatives.
fn look_along(reference: &Plane, here: &[f32], other: &Other, planes: &[f32], confirmed: impl ParallelIterator<Item = usize>) -> View {
    let [width, height] = [reference.width(), reference.height()].map(|s| s as usize);
    let one = |i: usize| {
        let (x, y, d) = ((i % width) as f32, (i / width) as f32, planes[i]);
        let there = |d: f32| other.see(x, y, d);
        (i, there(d), there(d + 0.5) - there(d - 0.5))
    };
    let samples: Vec<(usize, f32, f32)> = confirmed.map(one).collect();
    let grey = reference.as_raw();
    let (gain, offset) = exposure(samples.iter().map(|(i, there, _)| (grey[*i], *there)));
    let seen = |(i, there, slope): &(usize, f32, f32)| (*i, 0.5 * (slope / gain + here[*i]), (there - offset) / gain - grey[*i]);
    View::new([width, height], samples.iter().map(seen))
}

/// Gain and offset of (reference, other) pairs of grey values, from their means and spreads; NaN pairs do not count.
fn exposure(pairs: impl Iterator<Item = (f32, f32)>) -> (f32, f32) {
    let (mut n, mut a, mut b, mut aa, mut bb) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for (r, o) in pairs.filter(|p| !(p.0 + p.1).is_nan()) {
        let (r, o) = (f64::from(r), f64::from(o));
        (n, a, b, aa, bb) = (n + 1.0, a + r, b + o, aa + r * r, bb + o * o);
    }
    let (a, b) = (a / n, b / n);
    let gain = ((bb / n - b * b) / (aa / n - a * a)).sqrt();
    if gain.is_finite() && gain > 0.0 { (gain as f32, (b - gain * a) as f32) } else { (1.0, 0.0) }
}

/// w of (2).
fn window_weights() -> Weights {
    let squared = |k: usize| (k as f32 - RADIUS as f32).powi(2);
    std::array::from_fn(|y| std::array::from_fn(|x| (-0.5 * (squared(x) + squared(y)) / (SPREAD_PX * SPREAD_PX)).exp()))
}

/// Equation (2) from the sums; `None` without a view or without texture.
fn fit(Sums { weight, gg, ge, ee }: Sums) -> Option<Fit> {
    if gg <= 0.0 {
        return None;
    }
    let variance = ((ee - ge * ge / gg) / weight).max(LEAST_VARIANCE);
    let step = -ge / (gg + variance / (CORRELATION_SIGMA_PX * CORRELATION_SIGMA_PX));
    Some(Fit { step, energy: gg, variance })
}

/// Equation (3).
fn sigma_px(fit: &Fit, jump_px: f32) -> f32 {
    let noise = 1.0 / (fit.energy / fit.variance + 1.0 / (CORRELATION_SIGMA_PX * CORRELATION_SIGMA_PX));
    // 14: the weight of a whole window.
    let misfit = (14.0 * fit.variance / fit.energy).min(4.0);
    (NOISE_SHARE * noise + MISFIT_SHARE * misfit + JUMP_SHARE * jump_px * jump_px).sqrt()
}

/// The most extreme known value around every pixel, up to `reach` rows and columns away; `pick` is the minimum or the maximum.
pub(super) fn extremes(values: &[f32], width: usize, reach: usize, pick: impl Fn(f32, f32) -> f32) -> Vec<f32> {
    let height = values.len() / width.max(1);
    let mut padded = vec![f32::NAN; width + 2 * reach];
    let mut across = vec![f32::NAN; values.len()];
    for (out, row) in across.chunks_exact_mut(width.max(1)).zip(values.chunks_exact(width.max(1))) {
        padded[reach..][..width].copy_from_slice(row);
        (0..=2 * reach).for_each(|k| out.iter_mut().zip(&padded[k..]).for_each(|(o, v)| *o = pick(*o, *v)));
    }
    let mut all = vec![f32::NAN; values.len()];
    for (y, out) in all.chunks_exact_mut(width.max(1)).enumerate() {
        let rows = y.saturating_sub(reach)..(y + reach + 1).min(height);
        rows.for_each(|y| out.iter_mut().zip(&across[y * width..]).for_each(|(o, v)| *o = pick(*o, *v)));
    }
    all
}

/// Catmull-Rom interpolation; NaN at the border and beside unknown pixels.
#[inline]
fn sample(plane: &Plane, x: f32, y: f32) -> f32 {
    if !(x >= 1.0 && y >= 1.0) {
        return f32::NAN;
    }
    let (width, height) = (plane.width() as usize, plane.height() as usize);
    let (left, top) = (x as usize - 1, y as usize - 1);
    if left + 4 > width || top + 4 > height {
        return f32::NAN;
    }
    let (across, down) = (catmull_rom(x - (left + 1) as f32), catmull_rom(y - (top + 1) as f32));
    // Four columns together.
    let mut sums = [0.0; 4];
    for (j, weight) in down.into_iter().enumerate() {
        let row = plane.as_raw()[(top + j) * width + left..].first_chunk::<4>().unwrap_or(&[f32::NAN; 4]);
        sums.iter_mut().zip(row).for_each(|(sum, value)| *sum += weight * value);
    }
    (across[0] * sums[0] + across[1] * sums[1]) + (across[2] * sums[2] + across[3] * sums[3])
}

fn catmull_rom(t: f32) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [0.5 * (-t3 + 2.0 * t2 - t), 0.5 * (3.0 * t3 - 5.0 * t2 + 2.0), 0.5 * (-3.0 * t3 + 4.0 * t2 + t), 0.5 * (t3 - t2)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clouds::correlate::Region;
    use crate::clouds::stereo::{StereoOptions, StereoView, match_view};
    use image::Luma;
    use rand::RngExt;
    use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

    const SIZE: [u32; 2] = [240, 180];

    /// Band-limited texture without repetition in view.
    fn texture(x: f64, y: f64) -> f64 {
        let wave = |a: f64, b: f64, c: f64| (a * x + b * y + c).sin();
        128.0 + 14.0 * (wave(0.8, 0.31, 0.3) + wave(-0.43, 0.7, 1.1) + wave(1.1, -0.61, 2.0) + wave(0.23, 1.0, 0.7) + wave(0.5, 0.6, 4.0))
    }

    /// d = a + b u + c v seen by a reference, a right and an upper camera, with Gaussian noise; the right one at another exposure.
    fn slanted([a, b, c]: [f64; 3], noise: f64, exposure: [f64; 2]) -> [(Plane, Vector2<f64>); 3] {
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let mut picture = |gain: f64, offset: f64, f: &dyn Fn(f64, f64) -> f64| {
            Plane::from_fn(SIZE[0], SIZE[1], |x, y| {
                let normal = (0..12).map(|_| random.random::<f64>()).sum::<f64>() - 6.0;
                Luma([(gain * f(x.into(), y.into()) + offset + noise * normal).round() as f32])
            })
        };
        [
            (picture(1.0, 0.0, &texture), Vector2::zeros()),
            (picture(exposure[0], exposure[1], &|u, v| texture((u + a + c * v) / (1.0 - b), v)), Vector2::new(-1.0, 0.0)),
            (picture(1.0, 0.0, &|u, v| texture(u, (v - a - b * u) / (1.0 + c))), Vector2::new(0.0, 1.0)),
        ]
    }

    /// Error before and after refinement, sigma and true disparity of the refined pixels.
    fn matched(views: &[(Plane, Vector2<f64>); 3], [a, b, c]: [f64; 3]) -> Vec<[f64; 4]> {
        let views_of: Vec<StereoView> = views.iter().map(|(plane, step)| StereoView { plane: plane.clone(), step: *step }).collect();
        let all = Region { x: [0, SIZE[0] as usize], y: [0, SIZE[1] as usize] };
        let found = match_view(&views_of, 0, all, [5, 45], &StereoOptions::default());
        let others = [1, 2].map(|k| Other::new(&views[k].0, views[k].1, [0, 0]));
        let refined = refine(&views[0].0, &others, &found.disparity, &found.confirmed);
        let inner = found.disparity.enumerate_pixels().filter(|(x, y, _)| (60..230).contains(x) && (10..120).contains(y));
        let inner = inner.filter(|(x, y, _)| !refined.disparity.get_pixel(*x, *y).0[0].is_nan());
        inner
            .map(|(x, y, d)| {
                let truth = a + b * f64::from(x) + c * f64::from(y);
                let [after, sigma] = [&refined.disparity, &refined.sigma_px].map(|p| f64::from(p.get_pixel(x, y).0[0]));
                [f64::from(d.0[0]) - truth, after - truth, sigma, truth]
            })
            .collect()
    }

    fn rms(values: impl Iterator<Item = f64>) -> f64 {
        let (sum, n) = values.fold((0.0, 0.0), |(sum, n), v| (sum + v * v, n + 1.0));
        (sum / n).sqrt()
    }

    #[test]
    fn slanted_planes_are_met_without_bias_under_another_exposure_too() {
        for (slant, exposure) in [([20.3, 0.0, 0.0], [1.0, 0.0]), ([20.3, 0.05, -0.03], [1.0, 0.0]), ([19.6, -0.04, 0.06], [1.3, -20.0])] {
            let errors = matched(&slanted(slant, 2.0, exposure), slant);
            let (before, after) = (rms(errors.iter().map(|e| e[0])), rms(errors.iter().map(|e| e[1])));
            let bias = errors.iter().map(|e| e[1]).sum::<f64>() / errors.len() as f64;
            println!("{slant:?}: rms {before:.4} -> {after:.4} px, bias {bias:.4}, {} pixels", errors.len());
            assert!(errors.len() > 15000 && after < 0.04 && bias.abs() < 0.02, "{after} {bias}");
        }
    }

    #[test]
    fn refinement_does_not_pull_towards_whole_disparities() {
        // On a plane all fractional parts are equally frequent; equal counts of n pixels scatter by sqrt(n).
        let slant = [20.0, 0.061, 0.037];
        let errors = matched(&slanted(slant, 2.0, [1.0, 0.0]), slant);
        let unevenness = |k: usize| {
            let mut counts = [0.0f64; 10];
            errors.iter().for_each(|e| counts[((e[3] + e[k]).rem_euclid(1.0) * 10.0) as usize % 10] += 1.0);
            let mean = errors.len() as f64 / 10.0;
            println!("fractions {counts:?}");
            rms(counts.iter().map(|c| c / mean - 1.0))
        };
        let (before, after) = (unevenness(0), unevenness(1));
        assert!(before > 0.1 && after < 0.6 * before, "{before} {after}");
    }

    #[test]
    fn sigma_follows_the_noise() {
        let slant = [20.3, 0.03, -0.02];
        let [quiet, loud] = [1.0, 6.0].map(|noise| {
            let errors = matched(&slanted(slant, noise, [1.0, 0.0]), slant);
            [rms(errors.iter().map(|e| e[1])), rms(errors.iter().map(|e| e[2]))]
        });
        println!("error and sigma {quiet:?} {loud:?}");
        assert!(loud[0] > 2.0 * quiet[0] && loud[1] > 1.5 * quiet[1]);
        assert!([quiet, loud].iter().all(|[error, sigma]| (0.4..2.5).contains(&(sigma / error))), "{quiet:?} {loud:?}");
    }
}
