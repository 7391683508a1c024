//! Euclidean distance to a set of pixels, exact (Felzenszwalb and Huttenlocher 2012), read between pixels.
//!
//! D(x) = min over set pixels p of |x − p|; along columns by counting, along rows as lower envelope of parabolas, O(pixels).
//! Checked against brute force.

/// Cells around the set ones for which distances are kept.
const MARGIN: usize = 16;

/// Distances in pixels of the grid that it was made from, kept about the set pixels. Farther off it is the distance to the set
/// pixel that is nearest to the nearest place of those kept, up to a fifth too much.
#[derive(Clone, Debug)]
pub struct DistanceField {
    /// Of the whole grid, cells.
    size: [usize; 2],
    /// First cell that is kept, and how many are.
    first: [usize; 2],
    kept: [usize; 2],
    /// Pixels of the original grid per cell.
    step: f64,
    values: Vec<f32>,
}

impl DistanceField {
    /// Distance to the cells where `inside(x, y)`, for a grid of `width` × `height` pixels seen in cells of `step` pixels.
    /// Without any such cell all distances are zero: nothing is known.
    pub fn new(width: usize, height: usize, step: usize, inside: impl Fn(usize, usize) -> bool) -> DistanceField {
        let size = [width.div_ceil(step), height.div_ceil(step)];
        let set: Vec<bool> =
            (0..size[0] * size[1]).map(|i| inside((i % size[0] * step).min(width - 1), (i / size[0] * step).min(height - 1))).collect();
        let Some([least, most]) = extent((0..set.len()).filter(|i| set[*i]).map(|i| [i % size[0], i / size[0]])) else {
            return DistanceField { size, first: [0; 2], kept: [0; 2], step: step as f64, values: Vec::new() };
        };
        let [left, top] = least.map(|v| v.saturating_sub(MARGIN));
        let (w, h) = ((most[0] + MARGIN + 1).min(size[0]) - left, (most[1] + MARGIN + 1).min(size[1]) - top);
        // Within a column the distance to the nearest set cell, infinite without one.
        let of_cell = |i: usize| if set[(top + i / w) * size[0] + left + i % w] { 0.0 } else { f64::INFINITY };
        let mut columns: Vec<f64> = (0..w * h).map(of_cell).collect();
        for i in w..w * h {
            columns[i] = columns[i].min(columns[i - w] + 1.0);
        }
        for i in (0..w * h - w).rev() {
            columns[i] = columns[i].min(columns[i + w] + 1.0);
        }
        let mut parabolas = Vec::with_capacity(w);
        let mut values = vec![0.0; w * h];
        for (row, out) in columns.chunks_exact(w).zip(values.chunks_exact_mut(w)) {
            lowest(row, &mut parabolas, |x, square| out[x] = (square.sqrt() * step as f64) as f32);
        }
        DistanceField { size, first: [left, top], kept: [w, h], step: step as f64, values }
    }

    /// Distance and its gradient at pixel (x, y); zero beyond the grid, where nothing is known.
    pub fn at(&self, x: f64, y: f64) -> (f64, [f64; 2]) {
        let cell = [x / self.step, y / self.step];
        if self.values.is_empty() || !(0..2).all(|k| cell[k] >= 0.0 && cell[k] < self.size[k].saturating_sub(1) as f64) {
            return (0.0, [0.0; 2]);
        }
        let from_first = [0, 1].map(|k| cell[k] - self.first[k] as f64);
        let nearest = [0, 1].map(|k| from_first[k].clamp(0.0, (self.kept[k] - 1) as f64));
        let (value, slopes) = self.between(nearest);
        if nearest == from_first {
            return (value, slopes);
        }
        let beyond = [0, 1].map(|k| (from_first[k] - nearest[k]) * self.step);
        let steepness = slopes[0].hypot(slopes[1]).max(1e-9);
        let way = [0, 1].map(|k| beyond[k] + value * slopes[k] / steepness);
        let length = way[0].hypot(way[1]);
        let along = (way[0] * slopes[0] + way[1] * slopes[1]) / (steepness * length);
        (length, [0, 1].map(|k| if beyond[k] == 0.0 { along * slopes[k] } else { way[k] / length }))
    }

    /// Bilinear value and gradient at a place among the kept cells.
    fn between(&self, [u, v]: [f64; 2]) -> (f64, [f64; 2]) {
        let [w, h] = self.kept;
        // The last cell is the end of the step to it.
        let (i, j) = ((u as usize).min(w.saturating_sub(2)), (v as usize).min(h.saturating_sub(2)));
        let (a, b) = (u - i as f64, v - j as f64);
        let (right, below) = ((i + 1).min(w - 1), (j + 1).min(h - 1));
        let [p, q, r, s] = [j * w + i, j * w + right, below * w + i, below * w + right].map(|k| f64::from(self.values[k]));
        let (top, bottom) = (p * (1.0 - a) + q * a, r * (1.0 - a) + s * a);
        let across = (q - p) * (1.0 - b) + (s - r) * b;
        (top * (1.0 - b) + bottom * b, [across / self.step, (bottom - top) / self.step])
    }
}

/// The least and the largest coordinates of places; `None` without any.
pub fn extent(mut places: impl Iterator<Item = [usize; 2]>) -> Option<[[usize; 2]; 2]> {
    let first = places.next()?;
    Some(places.fold([first; 2], |[least, most], p| [[0, 1].map(|k| least[k].min(p[k])), [0, 1].map(|k| most[k].max(p[k]))]))
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
    fn far_off_it_is_little_too_much() {
        // A figure with an arm stretched out.
        let set =
            |x: usize, y: usize| (200..230).contains(&x) && (80..230).contains(&y) || (230..290).contains(&x) && (110..120).contains(&y);
        let field = DistanceField::new(640, 480, 2, set);
        assert!(field.values.len() < 640 * 480 / 4 / 4);
        let edge: Vec<(f64, f64)> = (0..480)
            .step_by(2)
            .flat_map(|y| (0..640).step_by(2).map(move |x| (x, y)))
            .filter(|p| set(p.0, p.1))
            .map(|p| (p.0 as f64, p.1 as f64))
            .collect();
        let mut worst: f64 = 0.0;
        for (x, y) in (0..47).flat_map(|j| (0..63).map(move |i| (10.0 * i as f64 + 3.3, 10.0 * j as f64 + 1.7))) {
            let (found, gradient) = field.at(x, y);
            let known = edge.iter().map(|(a, b)| (x - a).hypot(y - b)).fold(f64::INFINITY, f64::min);
            worst = worst.max(found / known.max(20.0) - 1.0);
            assert!(found > known - 1.5, "{x} {y}: {found} {known}");
            // It leads away from a pixel that is hardly farther than the nearest.
            let away = |&(a, b): &(f64, f64)| {
                let way = [x - a, y - b];
                let length = way[0].hypot(way[1]);
                length < 1.2 * known && (gradient[0] * way[0] + gradient[1] * way[1]) / length > 0.9
            };
            assert!(known < 64.0 || edge.iter().any(away), "{x} {y}: {gradient:?}");
        }
        assert!(worst < 0.2, "{worst}");
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
