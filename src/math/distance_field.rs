//! Euclidean distance to a set of pixels, exact (Felzenszwalb and Huttenlocher 2012), read between pixels.
//!
//! D(x) = min over set pixels p of |x − p|; rows and columns are lower envelopes of parabolas, O(pixels).
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

/// Stands for infinity in squared distances; larger values lose the parabolas' precision.
const FAR: f64 = 1e12;

impl DistanceField {
    /// Distance to the cells where `inside(x, y)`, for a grid of `width` × `height` pixels seen in cells of `step` pixels.
    /// Without any such cell all distances are zero: nothing is known.
    pub fn new(width: usize, height: usize, step: usize, inside: impl Fn(usize, usize) -> bool) -> DistanceField {
        let (w, h) = (width.div_ceil(step), height.div_ceil(step));
        let mut squares: Vec<f64> =
            (0..w * h).map(|i| if inside((i % w * step).min(width - 1), (i / w * step).min(height - 1)) { 0.0 } else { FAR }).collect();
        let known = squares.contains(&0.0);
        for x in 0..w {
            let column: Vec<f64> = (0..h).map(|y| squares[y * w + x]).collect();
            for (y, value) in envelope(&column).into_iter().enumerate() {
                squares[y * w + x] = value;
            }
        }
        for row in squares.chunks_exact_mut(w) {
            let lowest = envelope(row);
            row.copy_from_slice(&lowest);
        }
        let values = squares.iter().map(|s| if known { (s.sqrt() * step as f64) as f32 } else { 0.0 }).collect();
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

/// min over q of f(q) + (p − q)² for every p: the lower envelope of parabolas.
fn envelope(f: &[f64]) -> Vec<f64> {
    let mut roots: Vec<usize> = Vec::with_capacity(f.len());
    let mut starts: Vec<f64> = Vec::with_capacity(f.len());
    for q in 0..f.len() {
        let meet = |p: usize| ((f[q] + (q * q) as f64) - (f[p] + (p * p) as f64)) / (2 * (q - p)) as f64;
        while let (Some(p), Some(start)) = (roots.last(), starts.last()) {
            if meet(*p) > *start {
                break;
            }
            roots.pop();
            starts.pop();
        }
        starts.push(roots.last().map_or(f64::NEG_INFINITY, |p| meet(*p)));
        roots.push(q);
    }
    let mut k = 0;
    (0..f.len())
        .map(|p| {
            while k + 1 < roots.len() && starts[k + 1] < p as f64 {
                k += 1;
            }
            let offset = p as f64 - roots[k] as f64;
            f[roots[k]] + offset * offset
        })
        .collect()
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
