//! Euclidean distance to a set of pixels, exact (Felzenszwalb and Huttenlocher 2012), read between pixels.
//!
//! D(x) = min over set pixels p of |x − p|; along columns by counting, along rows as lower envelope of parabolas, O(pixels).
//! Checked against brute force.

/// Distances in pixels of the grid that it was made from.
#[derive(Clone, Debug)]
pub struct DistanceField {
    width: usize,
    height: usize,
    /// Pixels of the original grid per cell.
    step: f64,
    values: Vec<f32>,
}

impl DistanceField {
    /// Distance to the cells where `inside(x, y)`, for a grid of `width` × `height` pixels seen in cells of `step` pixels.
    /// Without any such cell all distances are zero: nothing is known.
    pub fn new(width: usize, height: usize, step: usize, inside: impl Fn(usize, usize) -> bool) -> DistanceField {
        let (w, h) = (width.div_ceil(step), height.div_ceil(step));
        // Within a column the distance to the nearest set cell, infinite without one.
        let set = |i: usize| inside((i % w * step).min(width - 1), (i / w * step).min(height - 1));
        let mut columns: Vec<f64> = (0..w * h).map(|i| if set(i) { 0.0 } else { f64::INFINITY }).collect();
        for i in w..w * h {
            columns[i] = columns[i].min(columns[i - w] + 1.0);
        }
        for i in (0..(w * h).saturating_sub(w)).rev() {
            columns[i] = columns[i].min(columns[i + w] + 1.0);
        }
        let mut parabolas = Vec::with_capacity(w);
        let mut values = vec![0.0; w * h];
        for (row, out) in columns.chunks_exact(w.max(1)).zip(values.chunks_exact_mut(w.max(1))) {
            lowest(row, &mut parabolas, |x, square| out[x] = (square.sqrt() * step as f64) as f32);
        }
        DistanceField { width: w, height: h, step: step as f64, values }
    }

    /// Bilinear distance and its gradient at pixel (x, y); zero beyond the grid, where nothing is known.
    pub fn at(&self, x: f64, y: f64) -> (f64, [f64; 2]) {
        let (u, v) = (x / self.step, y / self.step);
        if !(u >= 0.0 && v >= 0.0 && u < (self.width - 1) as f64 && v < (self.height - 1) as f64) {
            return (0.0, [0.0; 2]);
        }
        let (i, j) = (u as usize, v as usize);
        let (a, b) = (u - i as f64, v - j as f64);
        let value = |di: usize, dj: usize| f64::from(self.values[(j + dj) * self.width + i + di]);
        let (top, bottom) = (value(0, 0) * (1.0 - a) + value(1, 0) * a, value(0, 1) * (1.0 - a) + value(1, 1) * a);
        let across = (value(1, 0) - value(0, 0)) * (1.0 - b) + (value(1, 1) - value(0, 1)) * b;
        (top * (1.0 - b) + bottom * b, [across / self.step, (bottom - top) / self.step])
    }
}

/// min over q of f(q)² + (p − q)² for every p: the lower envelope of parabolas, those with infinite f left out. `scratch` takes
/// their roots and where each begins to be the lowest; `found` is told nothing where there is no parabola.
fn lowest(f: &[f64], scratch: &mut Vec<(usize, f64)>, mut found: impl FnMut(usize, f64)) {
    scratch.clear();
    let height = |q: usize| f[q] * f[q] + (q * q) as f64;
    for q in (0..f.len()).filter(|q| f[*q].is_finite()) {
        let mut begin = f64::NEG_INFINITY;
        while let Some((p, start)) = scratch.last() {
            begin = (height(q) - height(*p)) / (2 * (q - p)) as f64;
            if begin > *start {
                break;
            }
            scratch.pop();
            begin = f64::NEG_INFINITY;
        }
        scratch.push((q, begin));
    }
    if scratch.is_empty() {
        return;
    }
    let mut k = 0;
    for p in 0..f.len() {
        while k + 1 < scratch.len() && scratch[k + 1].1 < p as f64 {
            k += 1;
        }
        let q = scratch[k].0;
        let offset = p as f64 - q as f64;
        found(p, f[q] * f[q] + offset * offset);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equals_brute_force_on_scattered_pixels() {
        let (w, h) = (37, 29);
        let set: Vec<(usize, usize)> = (0..9).map(|i| ((i * 17 + 5) % w, (i * i * 7 + 3) % h)).collect();
        let field = DistanceField::new(w, h, 1, |x, y| set.contains(&(x, y)));
        for y in 0..h - 1 {
            for x in 0..w - 1 {
                let brute = set.iter().map(|(a, b)| (*a as f64 - x as f64).hypot(*b as f64 - y as f64)).fold(f64::INFINITY, f64::min);
                assert!((field.at(x as f64, y as f64).0 - brute).abs() < 1e-5, "{x} {y}");
            }
        }
    }

    #[test]
    fn slope_away_from_an_edge_is_one_in_pixels_of_the_grid() {
        let field = DistanceField::new(200, 100, 2, |x, _| x < 60);
        let (value, gradient) = field.at(101.3, 50.0);
        assert!((value - (101.3 - 58.0)).abs() < 1e-4 && (gradient[0] - 1.0).abs() < 1e-5 && gradient[1].abs() < 1e-5);
        assert_eq!(field.at(20.0, 50.0).0, 0.0);
        assert_eq!(field.at(-5.0, 50.0).0, 0.0);
        assert_eq!(DistanceField::new(20, 20, 1, |_, _| false).at(5.0, 5.0).0, 0.0);
    }
}
