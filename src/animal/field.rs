//! Fields over the pixels of a mask: distances, couplings of neighbours, mean-field beliefs.
//!
//! A Potts model with log-odds U and couplings w_ij = exp(−β|Δcolour|²)/distance, β from the frame's mean step (as GrabCut's,
//! Rother et al. 2004), is solved by mean field:  q_i ← tanh(U_i/2 + λ Σ_j w_ij q_j).                          (1)
//! Checked against brute-force distances, beliefs without couplings, and exact marginals of small weakly coupled pictures.

use image::GrayImage;
use rayon::prelude::*;

/// λ of equation (1): larger ones close gaps between legs, smaller ones leave speckles.
const COUPLING: f32 = 1.5;
const ROUNDS: usize = 10;
/// Right, below, below right, below left.
const NEIGHBOURS: [(i64, i64); 4] = [(1, 0), (0, 1), (1, 1), (-1, 1)];

/// Chamfer distance (1, √2) of pixels to the nearest one outside (`inside`) or inside the mask; 0 on the other side.
pub fn distance(mask: &GrayImage, inside: bool) -> Vec<f32> {
    const DIAGONAL: f32 = std::f32::consts::SQRT_2;
    let (width, height) = (mask.width() as usize, mask.height() as usize);
    let mut d: Vec<f32> = mask.iter().map(|&p| if (p > 0) == inside { 1e6 } else { 0.0 }).collect();
    for y in 0..height {
        for x in 0..width {
            let i = y * width + x;
            let mut best = d[i];
            if x > 0 {
                best = best.min(d[i - 1] + 1.0)
            }
            if y > 0 {
                best = best.min(d[i - width] + 1.0);
                if x > 0 {
                    best = best.min(d[i - width - 1] + DIAGONAL)
                }
                if x + 1 < width {
                    best = best.min(d[i - width + 1] + DIAGONAL)
                }
            }
            d[i] = best;
        }
    }
    for y in (0..height).rev() {
        for x in (0..width).rev() {
            let i = y * width + x;
            let mut best = d[i];
            if x + 1 < width {
                best = best.min(d[i + 1] + 1.0)
            }
            if y + 1 < height {
                best = best.min(d[i + width] + 1.0);
                if x > 0 {
                    best = best.min(d[i + width - 1] + DIAGONAL)
                }
                if x + 1 < width {
                    best = best.min(d[i + width + 1] + DIAGONAL)
                }
            }
            d[i] = best;
        }
    }
    d
}

/// exp(−β|Δcolour|²) over the distance of the pixels, β from the frame's mean step.
pub fn couplings(lab: &[[f32; 3]], width: usize) -> [Vec<f32>; 4] {
    let height = lab.len() / width.max(1);
    let steps = NEIGHBOURS.map(|(dx, dy)| {
        let step = |i: usize| {
            let (x, y) = ((i % width) as i64 + dx, (i / width) as i64 + dy);
            let inside = (0..width as i64).contains(&x) && (0..height as i64).contains(&y);
            if !inside {
                return f32::INFINITY;
            }
            let j = y as usize * width + x as usize;
            (0..3).map(|k| (lab[i][k] - lab[j][k]).powi(2)).sum()
        };
        (0..lab.len()).map(step).collect::<Vec<f32>>()
    });
    let (sum, count) = steps.iter().flatten().filter(|s| s.is_finite()).fold((0.0, 0.0), |(s, n), v| (s + f64::from(*v), n + 1.0));
    let beta = (count / (2.0 * sum + 1e-6)) as f32;
    let mut k = 0;
    steps.map(|s| {
        let (dx, dy) = NEIGHBOURS[k];
        k += 1;
        let length = ((dx * dx + dy * dy) as f32).sqrt();
        s.into_iter().map(|d| (-beta * d).exp() / length).collect()
    })
}

/// Beliefs, −1 to 1, after ten rounds of equation (1), all pixels at once.
pub fn mean_field(odds: &[f32], couplings: &[Vec<f32>; 4], width: usize) -> Vec<f32> {
    let mut belief: Vec<f32> = odds.iter().map(|u| (u / 2.0).tanh()).collect();
    let mut next = belief.clone();
    for _ in 0..ROUNDS {
        next.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
            for (x, value) in row.iter_mut().enumerate() {
                let i = y * width + x;
                let mut sum = 0.0;
                for (w, (dx, dy)) in couplings.iter().zip(NEIGHBOURS) {
                    let step = dy as isize * width as isize + dx as isize;
                    // Couplings beyond the picture are 0.
                    if w[i] > 0.0 {
                        sum += w[i] * belief[i.wrapping_add_signed(step)];
                    }
                    let back = (x as i64 - dx, y as i64 - dy);
                    if back.0 >= 0 && back.1 >= 0 && back.0 < width as i64 {
                        let j = back.1 as usize * width + back.0 as usize;
                        sum += w[j] * belief[j];
                    }
                }
                *value = (odds[i] / 2.0 + COUPLING * sum).tanh();
            }
        });
        std::mem::swap(&mut belief, &mut next);
    }
    belief
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Luma;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn distances_are_within_a_chamfers_error_of_brute_force() {
        let mut random = ChaCha8Rng::seed_from_u64(2);
        let mask = GrayImage::from_fn(31, 23, |_, _| Luma([if random.random_bool(0.03) { 255 } else { 0 }]));
        let on: Vec<(f32, f32)> = mask.enumerate_pixels().filter(|(_, _, p)| p.0[0] > 0).map(|(x, y, _)| (x as f32, y as f32)).collect();
        for (i, d) in distance(&mask, false).iter().enumerate() {
            let (x, y) = ((i % 31) as f32, (i / 31) as f32);
            let exact = on.iter().map(|(a, b)| (a - x).hypot(b - y)).fold(f32::INFINITY, f32::min);
            assert!(*d >= exact - 1e-4 && *d <= 1.09 * exact, "{d} {exact}");
        }
        assert!(distance(&mask, true).iter().zip(mask.iter()).all(|(d, p)| (*d > 0.0) == (*p > 0)));
    }

    #[test]
    fn beliefs_are_exact_marginals_to_the_couplings_second_order() {
        let mut random = ChaCha8Rng::seed_from_u64(4);
        let (width, n) = (3, 9);
        let odds: Vec<f32> = (0..n).map(|_| 3.0 * (random.random::<f32>() - 0.5)).collect();
        let lab: Vec<[f32; 3]> = (0..n).map(|_| [100.0 * random.random::<f32>(), 0.0, 0.0]).collect();
        let full = couplings(&lab, width);
        let weak = full.each_ref().map(|c| c.iter().map(|w| 0.04 * w).collect::<Vec<f32>>());
        let found = mean_field(&odds, &weak, width);
        // All 512 pictures, spins ±1 with energy Σ U/2 s + λ Σ w s s.
        let mut sums = vec![0.0f64; n + 1];
        for picture in 0..512u32 {
            let spin = |i: usize| if picture >> i & 1 == 1 { 1.0f64 } else { -1.0 };
            let mut log: f64 = (0..n).map(|i| f64::from(odds[i]) / 2.0 * spin(i)).sum();
            for (w, (dx, dy)) in weak.iter().zip(NEIGHBOURS) {
                for i in (0..n).filter(|i| w[*i] > 0.0) {
                    let j = (i as i64 + dy * width as i64 + dx) as usize;
                    log += f64::from(COUPLING * w[i]) * spin(i) * spin(j);
                }
            }
            let weight = log.exp();
            sums[n] += weight;
            (0..n).for_each(|i| sums[i] += weight * spin(i));
        }
        for i in 0..n {
            let exact = sums[i] / sums[n];
            assert!((f64::from(found[i]) - exact).abs() < 0.006, "{i}: {} {exact}", found[i]);
        }
        assert!((0..n).any(|i| (found[i] - (odds[i] / 2.0).tanh()).abs() > 0.02));
        let none = full.each_ref().map(|c| vec![0.0; c.len()]);
        assert!(mean_field(&odds, &none, width).iter().zip(&odds).all(|(q, u)| (q - (u / 2.0).tanh()).abs() < 1e-6));
    }
}
