//! Symmetric positive definite band matrices and their Cholesky factor, O(n·bandwidth²).
//!
//! Checked against nalgebra's dense Cholesky.

use nalgebra::DMatrix;
use rayon::prelude::*;

/// Lower half of a symmetric band matrix: entry (i, j) with 0 ≤ i − j ≤ bandwidth.
#[derive(Clone, Debug)]
pub struct BandMatrix {
    size: usize,
    bandwidth: usize,
    rows: Vec<f64>,
}

/// Cholesky factor L of a [`BandMatrix`], of the same bandwidth.
#[derive(Clone, Debug)]
pub struct BandCholesky(BandMatrix);

impl BandMatrix {
    pub fn zeros(size: usize, bandwidth: usize) -> BandMatrix {
        BandMatrix { size, bandwidth, rows: vec![0.0; size * (bandwidth + 1)] }
    }

    pub fn size(&self) -> usize {
        self.size
    }

    fn index(&self, row: usize, column: usize) -> usize {
        debug_assert!(row >= column && row - column <= self.bandwidth);
        row * (self.bandwidth + 1) + self.bandwidth + column - row
    }

    /// Entry of the lower half; zero outside the band.
    pub fn get(&self, row: usize, column: usize) -> f64 {
        let (row, column) = (row.max(column), row.min(column));
        if row - column > self.bandwidth { 0.0 } else { self.rows[self.index(row, column)] }
    }

    /// Adds to entry (row, column) of the lower half, row ≥ column within the band.
    pub fn add(&mut self, row: usize, column: usize, value: f64) {
        let index = self.index(row, column);
        self.rows[index] += value;
    }

    /// self + `factor` `other`, of the same size and bandwidth.
    pub fn plus(&self, factor: f64, other: &BandMatrix) -> BandMatrix {
        let rows = self.rows.iter().zip(&other.rows).map(|(a, b)| a + factor * b).collect();
        BandMatrix { rows, ..*self }
    }

    /// Makes row and column `i` those of the identity.
    pub fn isolate(&mut self, i: usize) {
        for other in i.saturating_sub(self.bandwidth)..(i + self.bandwidth + 1).min(self.size) {
            let index = self.index(i.max(other), i.min(other));
            self.rows[index] = if other == i { 1.0 } else { 0.0 };
        }
    }

    /// The factor L with L Lᵀ = self; `None` unless positive definite.
    pub fn cholesky(&self) -> Option<BandCholesky> {
        let mut l = self.clone();
        for row in 0..self.size {
            let first = row.saturating_sub(self.bandwidth);
            for column in first..=row {
                let from = first.max(column.saturating_sub(self.bandwidth));
                let index = l.index(row, column);
                let (of_row, of_column) = (l.index(row, from), l.index(column, from));
                let sum = l.rows[index] - dot(&l.rows[of_row..index], &l.rows[of_column..][..column - from]);
                if row == column {
                    if sum.is_nan() || sum <= 0.0 {
                        return None;
                    }
                    l.rows[index] = sum.sqrt();
                } else {
                    l.rows[index] = sum / l.rows[l.index(column, column)];
                }
            }
        }
        Some(BandCholesky(l))
    }
}

impl BandCholesky {
    /// The entries of (L Lᵀ)⁻¹ within the band, O(n·bandwidth²) (Takahashi, Fagan and Chin 1973):
    ///   Z_ij = (δ_ij/L_jj − Σ_{k>j} L_kj Z_ki) / L_jj for i ≥ j, from the last column to the first.
    pub fn selected_inverse(&self) -> BandMatrix {
        let l = &self.0;
        let mut z = BandMatrix::zeros(l.size, l.bandwidth);
        for j in (0..l.size).rev() {
            let last = (j + l.bandwidth).min(l.size - 1);
            let (column, diagonal): (Vec<f64>, f64) = ((j + 1..=last).map(|k| l.rows[l.index(k, j)]).collect(), l.rows[l.index(j, j)]);
            // Σ L_kj Z_ki for all i > j: rows are read in their order, each for both triangles.
            let mut known = vec![0.0; column.len()];
            for (k, own) in column.iter().enumerate() {
                let row = &z.rows[z.index(j + 1 + k, j + 1)..][..=k];
                known[k] += dot(row, &column[..=k]);
                known[..k].iter_mut().zip(row).for_each(|(sum, entry)| *sum += own * entry);
            }
            for (k, known) in known.iter_mut().enumerate() {
                let at = z.index(j + 1 + k, j);
                *known = -*known / diagonal;
                z.rows[at] = *known;
            }
            let at = z.index(j, j);
            z.rows[at] = (1.0 / diagonal - dot(&column, &known)) / diagonal;
        }
        z
    }

    /// X with L Lᵀ X = `right`.
    pub fn solve(&self, right: &DMatrix<f64>) -> DMatrix<f64> {
        let l = &self.0;
        let mut x = right.clone();
        x.as_mut_slice().par_chunks_exact_mut(l.size.max(1)).for_each(|column| self.solve_column(column));
        x
    }

    fn solve_column(&self, column: &mut [f64]) {
        let l = &self.0;
        for row in 0..l.size {
            let first = row.saturating_sub(l.bandwidth);
            let entries = &l.rows[l.index(row, first)..=l.index(row, row)];
            column[row] = (column[row] - dot(&entries[..row - first], &column[first..row])) / entries[row - first];
        }
        for row in (0..l.size).rev() {
            let first = row.saturating_sub(l.bandwidth);
            let entries = &l.rows[l.index(row, first)..=l.index(row, row)];
            let value = column[row] / entries[row - first];
            column[row] = value;
            column[first..row].iter_mut().zip(entries).for_each(|(c, e)| *c -= e * value);
        }
    }
}

/// Sum of products, four at a time.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let (quads_a, quads_b) = (a.chunks_exact(4), b.chunks_exact(4));
    let rest: f64 = quads_a.remainder().iter().zip(quads_b.remainder()).map(|(x, y)| x * y).sum();
    let mut sums = [0.0; 4];
    for (x, y) in quads_a.zip(quads_b) {
        (0..4).for_each(|i| sums[i] += x[i] * y[i]);
    }
    sums.iter().sum::<f64>() + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn solves_like_the_dense_factorisation() {
        let (n, bandwidth) = (23, 4);
        let mut band = BandMatrix::zeros(n, bandwidth);
        let mut dense = DMatrix::zeros(n, n);
        for i in 0..n {
            for j in i.saturating_sub(bandwidth)..=i {
                let value = if i == j { 5.0 } else { ((i * 7 + j * 3) as f64).sin() };
                band.add(i, j, value);
                dense[(i, j)] = value;
                dense[(j, i)] = value;
            }
        }
        let right = DMatrix::from_fn(n, 3, |i, j| ((i + 11 * j) as f64).cos());
        let expected = dense.cholesky().unwrap().solve(&right);
        assert!((band.cholesky().unwrap().solve(&right) - expected).amax() < 1e-12);
        let inverse = band.cholesky().unwrap().selected_inverse();
        let dense_inverse = band.cholesky().unwrap().solve(&DMatrix::identity(n, n));
        for i in 0..n {
            (i.saturating_sub(bandwidth)..=i).for_each(|j| assert!((inverse.get(i, j) - dense_inverse[(i, j)]).abs() < 1e-13));
        }
        let mut isolated = band.clone();
        isolated.isolate(7);
        assert!((isolated.cholesky().unwrap().solve(&right).row(7) - right.row(7)).amax() < 1e-12);
        band.add(9, 9, -100.0);
        assert!(band.cholesky().is_none());
    }
}
