//! Interpolation by Gaussian radial basis functions, written as weights of the nodes.
//!
//! h(r) = exp(−a r²), a = ln 2;  H_ij = h(|p_i − p_j|);  w(p) = H⁻¹ h(p),  h_i(p) = h(|p − p_i|).             (1)
//! Favreau et al. (2004), equations (6) to (15): with as many nodes as functions (HᵀH)⁻¹Hᵀ is H⁻¹, and H, not HᵀH, is
//! factorised, whose condition number is the root. Fails for nodes in one point, where H is singular.
//! Checked against the closed form of two nodes, the paper's pseudo-inverse, and w(p_i) = e_i.

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};

/// h(1) = 1/2: unit-variance coordinates put nodes about 2 apart.
pub const A: f64 = std::f64::consts::LN_2;

/// h of a squared distance.
pub fn kernel(squared_distance: f64) -> f64 {
    (-A * squared_distance).exp()
}

pub fn squared_distance(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum()
}

/// H of some points.
pub fn kernel_matrix(points: &[Vec<f64>]) -> DMatrix<f64> {
    DMatrix::from_fn(points.len(), points.len(), |i, j| kernel(squared_distance(&points[i], &points[j])))
}

/// Nodes with their factorised H.
#[derive(Clone, Debug)]
pub struct Rbf {
    nodes: Vec<Vec<f64>>,
    factor: Cholesky<f64, Dyn>,
}

impl Rbf {
    /// `None` where two nodes lie in one point, or none is given.
    pub fn new(nodes: Vec<Vec<f64>>) -> Option<Rbf> {
        Rbf::smoothing(nodes, 0.0)
    }

    /// With H + `ridge` I in place of H: nodes are smoothed over, not reproduced, and may lie in one point.
    pub fn smoothing(nodes: Vec<Vec<f64>>, ridge: f64) -> Option<Rbf> {
        let h = kernel_matrix(&nodes) + DMatrix::identity(nodes.len(), nodes.len()) * ridge;
        let factor = h.cholesky()?;
        // A pivot below this is rounding.
        let smallest = factor.l().diagonal().iter().copied().fold(f64::INFINITY, f64::min);
        (smallest.is_finite() && smallest > 1e-7).then_some(Rbf { nodes, factor })
    }

    /// w(p): 1 for a node at itself and 0 for the others; the sum is near 1 near the nodes.
    pub fn weights(&self, p: &[f64]) -> Vec<f64> {
        let h = DVector::from_iterator(self.nodes.len(), self.nodes.iter().map(|n| kernel(squared_distance(n, p))));
        self.factor.solve(&h).as_slice().to_vec()
    }
}

/// Weights brought back into the hull of the nodes: none negative, sum 1. Equal parts where none is positive.
pub fn in_hull(weights: &[f64]) -> Vec<f64> {
    let sum: f64 = weights.iter().map(|w| w.max(0.0)).sum();
    if sum > 0.0 { weights.iter().map(|w| w.max(0.0) / sum).collect() } else { vec![1.0 / weights.len() as f64; weights.len()] }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn nodes() -> Vec<Vec<f64>> {
        vec![vec![1.0, 0.2], vec![-0.1, 1.3], vec![-1.2, 0.0], vec![0.3, -1.1]]
    }

    #[test]
    fn two_nodes_have_their_closed_form() {
        let rbf = Rbf::new(vec![vec![0.0], vec![2.0]]).unwrap();
        // h(2) = 1/16.
        for x in [-0.5, 0.0, 0.7, 1.0, 3.0f64] {
            let (a, b, h) = (kernel(x * x), kernel((x - 2.0).powi(2)), 1.0 / 16.0);
            let expected = [(a - h * b) / (1.0 - h * h), (b - h * a) / (1.0 - h * h)];
            let found = rbf.weights(&[x]);
            assert!((found[0] - expected[0]).abs() < 1e-12 && (found[1] - expected[1]).abs() < 1e-12);
        }
        assert_eq!(kernel(1.0), 0.5);
    }

    #[test]
    fn nodes_are_reproduced_and_the_papers_pseudo_inverse_agrees() {
        let rbf = Rbf::new(nodes()).unwrap();
        for (i, node) in nodes().iter().enumerate() {
            assert!(rbf.weights(node).iter().enumerate().all(|(j, w)| (w - f64::from(u8::from(i == j))).abs() < 1e-12));
        }
        let h = kernel_matrix(&nodes());
        let pseudo = (h.transpose() * &h).try_inverse().unwrap() * h.transpose();
        let p = [0.4, 0.3];
        let row = DVector::from_iterator(4, nodes().iter().map(|n| kernel(squared_distance(n, &p))));
        let theirs = pseudo.transpose() * row;
        assert!(rbf.weights(&p).iter().zip(theirs.iter()).all(|(a, b)| (a - b).abs() < 1e-10));
    }

    #[test]
    fn two_nodes_in_one_point_share_what_a_ridge_leaves() {
        let rbf = Rbf::smoothing(vec![vec![1.0], vec![1.0]], 0.5).unwrap();
        // (1 + 1/2) w + w = 1 for each.
        assert!(rbf.weights(&[1.0]).iter().all(|w| (w - 1.0 / 2.5).abs() < 1e-12));
    }

    #[test]
    fn equal_nodes_are_refused_and_the_hull_is_kept() {
        assert!(Rbf::new(vec![vec![1.0, 2.0], vec![1.0, 2.0]]).is_none());
        assert!(Rbf::new(Vec::new()).is_none());
        assert_eq!(in_hull(&[-0.5, 1.0, 3.0]), [0.0, 0.25, 0.75]);
        assert_eq!(in_hull(&[-1.0, -2.0]), [0.5, 0.5]);
    }
}
