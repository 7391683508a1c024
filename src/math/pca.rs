//! Principal components, of few long vectors through the M×M Gram matrix.
//!
//! With centred examples X (D×M):  XᵀX/M · u = λ u,   Θ = X u / √(Mλ)                                     (1)
//! gives the same Θ and λ as the D×D covariance XXᵀ/M, which is taken where it is the smaller one. λ has the divisor M, so the λ sum to
//! the total variance.
//! Signs are a convention: the entry of Θ_i with the largest magnitude is positive.
//! Checked against the singular values of X and against the covariance's eigenvectors.

use nalgebra::{DMatrix, DVector};

/// Components with λ below this part of the largest are rounding errors: their direction means nothing.
const NULL_SPACE: f64 = 1e-12;

#[derive(Clone, Debug)]
pub struct Pca {
    /// Length D.
    pub mean: DVector<f64>,
    /// Orthonormal columns Θ_i, D×m, of those with a λ above rounding as many as were asked for.
    pub basis: DMatrix<f64>,
    /// λ_i of all min(M−1, D) components, largest first, none negative.
    pub eigenvalues: Vec<f64>,
}

/// PCA of the columns of `examples` (D×M). Without columns everything is empty.
pub fn pca(examples: &DMatrix<f64>) -> Pca {
    with(&mut examples.clone(), |eigenvalues| eigenvalues.len())
}

/// The same with no more of the leading components than hold `part` (0 to 1) of the variance; leaves the examples without their mean.
pub fn leading(examples: &mut DMatrix<f64>, part: f64) -> Pca {
    with(examples, |eigenvalues| components(eigenvalues, part))
}

fn with(centred: &mut DMatrix<f64>, count: impl Fn(&[f64]) -> usize) -> Pca {
    let (d, m) = centred.shape();
    if m == 0 {
        return Pca { mean: DVector::zeros(d), basis: DMatrix::zeros(d, 0), eigenvalues: Vec::new() };
    }
    let mean = centred.column_mean();
    centred.column_iter_mut().for_each(|mut column| column -= &mean);
    let centred = &*centred;
    // A product with a transposed copy runs in blocks, `tr_mul` does not.
    let few = m <= d;
    let products = if few { centred.transpose() * centred } else { centred * centred.transpose() };
    let eigen = (products / m as f64).symmetric_eigen();
    let mut order: Vec<usize> = (0..m.min(d)).collect();
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]).then(a.cmp(&b)));
    order.truncate((m - 1).min(d));
    let eigenvalues: Vec<f64> = order.iter().map(|&i| eigen.eigenvalues[i].max(0.0)).collect();
    let real = eigenvalues.iter().take_while(|&&l| l > NULL_SPACE * eigenvalues[0]).count();
    let kept = real.min(count(&eigenvalues));
    let vectors = eigen.eigenvectors.select_columns(&order[..kept]);
    let mut basis = if few { centred * vectors } else { vectors };
    for mut component in basis.column_iter_mut() {
        let sign = if component[component.iamax()] < 0.0 { -1.0 } else { 1.0 };
        component *= sign / component.norm();
    }
    Pca { mean, basis, eigenvalues }
}

/// Number of leading components that hold `part` (0 to 1) of the variance, equation (3) of the style paper.
pub fn components(eigenvalues: &[f64], part: f64) -> usize {
    let total: f64 = eigenvalues.iter().sum();
    let mut sum = 0.0;
    for (i, l) in eigenvalues.iter().enumerate() {
        if sum >= part * total * (1.0 - 1e-12) {
            return i;
        }
        sum += l;
    }
    eigenvalues.len()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// M examples with a decaying spectrum.
    fn examples(d: usize, m: usize) -> DMatrix<f64> {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let shape = DMatrix::from_fn(d, d, |_, j| (rng.random::<f64>() - 0.5) / (1 + j) as f64);
        let draws = DMatrix::from_fn(d, m, |_, _| rng.random::<f64>() - 0.5);
        shape * draws + DMatrix::from_element(d, m, 3.0)
    }

    #[test]
    fn agrees_with_singular_values_and_covariance() {
        for (d, m) in [(40, 9), (5, 30)] {
            let x = examples(d, m);
            let found = pca(&x);
            let mut centred = x.clone();
            centred.column_iter_mut().for_each(|mut c| c -= &found.mean);
            let singular = centred.clone().svd(false, false).singular_values;
            let total = centred.norm_squared() / m as f64;
            assert!((found.eigenvalues.iter().sum::<f64>() - total).abs() < 1e-10 * total);
            let covariance = &centred * centred.transpose() / m as f64;
            for (i, column) in found.basis.column_iter().enumerate() {
                assert!((found.eigenvalues[i] - singular[i].powi(2) / m as f64).abs() < 1e-10 * total);
                assert!((&covariance * column - column * found.eigenvalues[i]).norm() < 1e-10 * total);
                assert!(column[column.iamax()] > 0.0);
            }
            let identity = found.basis.tr_mul(&found.basis);
            assert!((identity - DMatrix::identity(found.basis.ncols(), found.basis.ncols())).norm() < 1e-9);
            assert_eq!(found.basis.ncols(), (m - 1).min(d));
        }
    }

    #[test]
    fn counts_components_of_a_part_of_the_variance() {
        let l = [6.0, 3.0, 1.0];
        assert_eq!([0.0, 0.6, 0.61, 0.9, 1.0].map(|p| components(&l, p)), [0, 1, 2, 2, 3]);
    }

    #[test]
    fn leading_components_are_the_first_of_all() {
        let x = examples(40, 9);
        let (all, some) = (pca(&x), leading(&mut x.clone(), 0.9));
        let count = components(&all.eigenvalues, 0.9);
        assert!(count > 1 && count < all.basis.ncols());
        assert_eq!((&some.eigenvalues, &some.mean), (&all.eigenvalues, &all.mean));
        assert_eq!(some.basis.ncols(), count);
        assert!((&some.basis - all.basis.columns(0, count)).norm() < 1e-12);
    }

    #[test]
    fn equal_examples_have_no_components() {
        let found = pca(&DMatrix::from_element(6, 4, 2.5));
        assert_eq!(found.basis.ncols(), 0);
        assert_eq!(found.mean[3], 2.5);
    }
}
