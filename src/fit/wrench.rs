//! Normal equations of one frame, gathered where they are small.
//!
//! A residual pulls at the few nodes whose primitives make the skin there: its row for the unknowns is
//!   j = Σ_n w_n T_n + e,                                                                                       (1)
//! w_n = (f, x × f) the wrench on node n, T_n the node's twists (fit::state), e what the sizes deform directly. So the sum
//! of ω jᵀj over all residuals is Tᵀ M T with M the sum over (w, e), of which only pairs of neighbouring nodes fill up: a
//! residual costs some 300 multiplications instead of the 5000 of its outer product, and T is applied once a frame.
//! Checked against the outer products of the rows.

use nalgebra::Vector3;

use super::state::{Layout, Motion, SIZES};
use crate::body::NODES;
use crate::math::arrow::NormalEquations;

/// Pairs of nodes, the lower half.
const PAIRS: usize = NODES * (NODES + 1) / 2;
/// More nodes than make the skin at any point.
const MOST_NODES: usize = 16;

/// One residual's row in wrenches and sizes.
#[derive(Default)]
pub(super) struct Pull {
    nodes: [(usize, [f64; 6]); MOST_NODES],
    count: usize,
    sizes: Vec<(usize, f64)>,
}

impl Pull {
    pub fn clear(&mut self) {
        self.count = 0;
        self.sizes.clear();
    }

    /// A force on `node` through the point `at`.
    #[inline]
    pub fn force(&mut self, node: usize, at: &Vector3<f64>, force: &Vector3<f64>) {
        let moment = at.cross(force);
        let wrench = [force.x, force.y, force.z, moment.x, moment.y, moment.z];
        match self.nodes[..self.count].iter_mut().find(|n| n.0 == node) {
            Some((_, sum)) => sum.iter_mut().zip(wrench).for_each(|(s, w)| *s += w),
            None if self.count < MOST_NODES => {
                self.nodes[self.count] = (node, wrench);
                self.count += 1;
            }
            None => {}
        }
    }

    /// Derivative for size `index`, counted from the stature.
    #[inline]
    pub fn size(&mut self, index: usize, value: f64) {
        match self.sizes.iter_mut().find(|s| s.0 == index) {
            Some((_, sum)) => *sum += value,
            None => self.sizes.push((index, value)),
        }
    }

    fn scale(&mut self, factor: f64) {
        self.nodes[..self.count].iter_mut().flat_map(|n| &mut n.1).for_each(|v| *v *= factor);
        self.sizes.iter_mut().for_each(|s| s.1 *= factor);
    }
}

/// Sum of ω r j over wrenches and sizes.
#[derive(Clone)]
pub(super) struct Gradient {
    nodes: [[f64; 6]; NODES],
    sizes: [f64; SIZES],
}

impl Gradient {
    pub fn new() -> Gradient {
        Gradient { nodes: [[0.0; 6]; NODES], sizes: [0.0; SIZES] }
    }

    /// Adds `scale` times the pull.
    #[inline(always)]
    pub fn add(&mut self, scale: f64, pull: &Pull) {
        pull.nodes[..pull.count].iter().for_each(|(node, wrench)| add_scaled(&mut self.nodes[*node], scale, wrench));
        pull.sizes.iter().for_each(|(size, value)| self.sizes[*size] += scale * value);
    }

    /// The same over the first `size` unknowns.
    pub fn expand(&self, motion: &Motion, layout: Layout, size: usize) -> Vec<f64> {
        let mut sum = vec![0.0; size];
        for (wrench, twist) in self.nodes.iter().zip(&motion.twists).filter(|(wrench, _)| **wrench != [0.0; 6]) {
            wrench.iter().enumerate().for_each(|(r, w)| add_scaled(&mut sum, *w, twist.row(r)));
        }
        add_scaled(&mut sum[layout.local + layout.stature()..], 1.0, &self.sizes);
        sum
    }
}

/// Half the sum of ω r², its gradient and Gauss–Newton Hessian over wrenches and sizes.
pub(super) struct Gathered {
    cost: f64,
    gradient: Gradient,
    /// Blocks of nodes i ≥ j at [`pair`]; rows are those of i.
    blocks: Vec<[[f64; 6]; 6]>,
    /// Sizes against wrenches, and against sizes.
    size_nodes: Vec<[[f64; 6]; NODES]>,
    size_sizes: [[f64; SIZES]; SIZES],
    /// Bit j of entry i ≥ j: nodes i and j have met.
    met: [u32; NODES],
}

fn pair(i: usize, j: usize) -> usize {
    i * (i + 1) / 2 + j
}

impl Gathered {
    pub fn new() -> Gathered {
        Gathered {
            cost: 0.0,
            gradient: Gradient::new(),
            blocks: vec![[[0.0; 6]; 6]; PAIRS],
            size_nodes: vec![[[0.0; 6]; NODES]; SIZES],
            size_sizes: [[0.0; SIZES]; SIZES],
            met: [0; NODES],
        }
    }

    /// Adds ½ weight r² with r's derivative `factor` times the pull.
    #[inline(always)]
    pub fn add(&mut self, residual: f64, weight: f64, factor: f64, pull: &mut Pull) {
        pull.scale(factor);
        self.cost += 0.5 * weight * residual * residual;
        self.gradient.add(weight * residual, pull);
        let nodes = &mut pull.nodes[..pull.count];
        nodes.sort_unstable_by_key(|n| n.0);
        for (i, (a, of_a)) in nodes.iter().enumerate() {
            for (b, of_b) in &nodes[..=i] {
                self.met[*a] |= 1 << b;
                let block = &mut self.blocks[pair(*a, *b)];
                block.iter_mut().zip(of_a).for_each(|(row, v)| add_scaled(row, weight * v, of_b));
            }
        }
        for (a, value) in &pull.sizes {
            let scaled = weight * value;
            let of_nodes = &mut self.size_nodes[*a];
            nodes.iter().for_each(|(b, of_b)| add_scaled(&mut of_nodes[*b], scaled, of_b));
            let of_sizes = &mut self.size_sizes[*a];
            pull.sizes.iter().for_each(|(b, other)| of_sizes[*b] += scaled * other);
        }
    }

    /// The same over the first `size` unknowns: Tᵀ M T.
    pub fn expand(&self, motion: &Motion, layout: Layout, size: usize) -> FrameNormal {
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2.
            return unsafe { self.expand_avx2(motion, layout, size) };
        }
        self.expand_with(motion, layout, size)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn expand_avx2(&self, motion: &Motion, layout: Layout, size: usize) -> FrameNormal {
        self.expand_with(motion, layout, size)
    }

    #[inline(always)]
    fn expand_with(&self, motion: &Motion, layout: Layout, size: usize) -> FrameNormal {
        let first_size = layout.local + layout.stature();
        let mut normal =
            FrameNormal { cost: self.cost, hessian: vec![0.0; size * size], gradient: self.gradient.expand(motion, layout, size) };
        let mut product = vec![0.0; 6 * size];
        let met = |i: usize, j: usize| self.met[i.max(j)] & (1 << i.min(j)) != 0;
        for (i, twist) in motion.twists.iter().enumerate().filter(|(i, _)| met(*i, *i)) {
            product.fill(0.0);
            for (j, other) in motion.twists.iter().enumerate().filter(|(j, _)| met(i, *j)) {
                for (r, row) in product.chunks_exact_mut(size).enumerate() {
                    add_six(row, &self.block_row(i, j, r), std::array::from_fn(|c| &other.row(c)[..size]));
                }
            }
            for (r, row) in product.chunks_exact_mut(size).enumerate() {
                row[first_size..].iter_mut().zip(&self.size_nodes).for_each(|(p, of_nodes)| *p += of_nodes[i][r]);
            }
            for (a, row) in normal.hessian.chunks_exact_mut(size).enumerate() {
                let factors: [f64; 6] = std::array::from_fn(|r| twist.row(r)[a]);
                if factors != [0.0; 6] {
                    add_six(&mut row[..=a], &factors, std::array::from_fn(|r| &product[r * size..=r * size + a]));
                }
            }
        }
        for d in 0..SIZES {
            let a = first_size + d;
            let row = &mut normal.hessian[a * size..=a * size + a];
            for (pairs, twist) in self.size_nodes[d].iter().zip(&motion.twists).filter(|(pairs, _)| **pairs != [0.0; 6]) {
                add_six(row, pairs, std::array::from_fn(|r| &twist.row(r)[..=a]));
            }
            add_scaled(&mut row[first_size..], 1.0, &self.size_sizes[d]);
        }
        normal
    }

    /// Row `r` of block (i, j) of M.
    fn block_row(&self, i: usize, j: usize, r: usize) -> [f64; 6] {
        if i >= j { self.blocks[pair(i, j)][r] } else { self.blocks[pair(j, i)].map(|row| row[r]) }
    }
}

/// sum += factor · row, as far as `sum` goes.
#[inline(always)]
fn add_scaled(sum: &mut [f64], factor: f64, row: &[f64]) {
    sum.iter_mut().zip(row).for_each(|(s, v)| *s += factor * v);
}

/// The same of six rows as long as `sum`, one after the other.
#[inline(always)]
fn add_six(sum: &mut [f64], factors: &[f64; 6], rows: [&[f64]; 6]) {
    let rows = rows.map(|row| &row[..sum.len()]);
    for (i, s) in sum.iter_mut().enumerate() {
        *s = (0..6).fold(*s, |s, r| s + factors[r] * rows[r][i]);
    }
}

/// Normal equations of one frame over its own and the shared unknowns.
pub(super) struct FrameNormal {
    pub cost: f64,
    /// Lower half, row-major.
    pub hessian: Vec<f64>,
    pub gradient: Vec<f64>,
}

impl FrameNormal {
    pub fn scatter(&self, frame: usize, local: usize, normal: &mut NormalEquations) {
        let size = self.gradient.len();
        normal.cost += self.cost;
        for i in 0..size {
            for j in 0..=i {
                let value = self.hessian[i * size + j];
                match (i < local, j < local) {
                    (true, _) => normal.local.add(local * frame + i, local * frame + j, value),
                    (false, true) => normal.border[(local * frame + j, i - local)] += value,
                    (false, false) => {
                        normal.shared[(i - local, j - local)] += value;
                        if i != j {
                            normal.shared[(j - local, i - local)] += value;
                        }
                    }
                }
            }
            if i < local {
                normal.local_gradient[local * frame + i] += self.gradient[i];
            } else {
                normal.shared_gradient[i - local] += self.gradient[i];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::Surface;
    use crate::fit::curve::{Curve, tests::made_up_model};
    use crate::fit::problem::tests::state;

    #[test]
    fn equals_the_outer_products_of_the_rows() {
        let curve = Curve::new(&made_up_model(3), 3);
        let state = state();
        let layout = state.layout();
        let motion = state.motion(&curve, &Surface::new(&state.shape), 1);
        let size = layout.size();
        let mut gathered = Gathered::new();
        let mut expected = vec![0.0; size * size];
        let mut gradient = vec![0.0; size];
        for k in 0..40 {
            let wave = |a: f64| Vector3::new((a * k as f64).sin(), (1.3 * a + k as f64).cos(), (0.7 * k as f64 - a).sin());
            let (residual, weight, factor) = ((0.9 * k as f64).cos(), 1.0 + 0.1 * k as f64, 0.8);
            let pulls = [(k % NODES, wave(1.0)), ((3 * k + 5) % NODES, wave(2.0)), (k % NODES, wave(3.0))];
            let mut pull = Pull::default();
            let mut row = vec![0.0; size];
            for (node, force) in pulls {
                pull.force(node, &wave(0.3), &force);
                let moment = wave(0.3).cross(&force);
                for (r, w) in force.iter().chain(moment.iter()).enumerate() {
                    add_scaled(&mut row, *w, motion.twists[node].row(r));
                }
            }
            for (index, value) in [(0, 0.7), (k % SIZES, -0.4), ((5 * k) % SIZES, 1.1)] {
                pull.size(index, value);
                row[layout.local + layout.stature() + index] += value;
            }
            row.iter_mut().for_each(|v| *v *= factor);
            gathered.add(residual, weight, factor, &mut pull);
            for a in 0..size {
                gradient[a] += weight * residual * row[a];
                (0..size).for_each(|b| expected[a * size + b] += weight * row[a] * row[b]);
            }
        }
        let found = gathered.expand(&motion, layout, size);
        let largest = expected.iter().fold(0.0f64, |m, v| m.max(v.abs()));
        for a in 0..size {
            assert!((found.gradient[a] - gradient[a]).abs() < 1e-11 * largest, "{a}");
            for b in 0..=a {
                assert!((found.hessian[a * size + b] - expected[a * size + b]).abs() < 1e-11 * largest, "{a} {b}");
            }
        }
    }
}
