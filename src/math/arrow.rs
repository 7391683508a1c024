//! Least squares with arrow structure, and its Levenberg–Marquardt as an argmin solver.
//!
//! Unknowns: y, chained by a band (poses of frames or boards), and z, shared by all (weights, shape, cameras):
//!   [ K   B ] [y]     [g_y]
//!   [ Bᵀ  C ] [z] = − [g_z],   S = C − Bᵀ K⁻¹ B,   S z = −g_z + Bᵀ K⁻¹ g_y,   y = −K⁻¹ (g_y + B z).          (1)
//! The Jacobian is never stored; the cost of a step is linear in the number of frames. Damping scales the diagonal
//! (Marquardt) and follows Nielsen's rule; a step is judged by the true cost.
//! Fails when: K + λ diag K is singular although damped; then the damping grows until the step is too short to matter.
//! Checked against dense normal equations, and on a problem whose undamped step must be rejected.

use argmin::core::{Error, Executor, IterState, KV, Problem, Solver, TerminationReason, TerminationStatus};
use nalgebra::{DMatrix, DVector};

use super::banded::BandMatrix;

/// Half the sum of squares at a state, its gradient and its Gauss–Newton Hessian in the parts of equation (1).
#[derive(Clone, Debug)]
pub struct NormalEquations {
    pub cost: f64,
    pub local: BandMatrix,
    pub border: DMatrix<f64>,
    pub shared: DMatrix<f64>,
    pub local_gradient: DVector<f64>,
    pub shared_gradient: DVector<f64>,
}

impl NormalEquations {
    pub fn zeros(locals: usize, bandwidth: usize, shareds: usize) -> NormalEquations {
        NormalEquations {
            cost: 0.0,
            local: BandMatrix::zeros(locals, bandwidth),
            border: DMatrix::zeros(locals, shareds),
            shared: DMatrix::zeros(shareds, shareds),
            local_gradient: DVector::zeros(locals),
            shared_gradient: DVector::zeros(shareds),
        }
    }

    /// The matrices of self + `factor` `other`, without gradients.
    pub fn plus(&self, factor: f64, other: &NormalEquations) -> NormalEquations {
        NormalEquations {
            local: self.local.plus(factor, &other.local),
            border: &self.border + factor * &other.border,
            shared: &self.shared + factor * &other.shared,
            ..NormalEquations::zeros(0, 0, 0)
        }
    }

    /// The step (y, z) of equation (1) with the diagonal scaled by 1 + `damping`; `None` if singular.
    pub fn step(&self, damping: f64) -> Option<(DVector<f64>, DVector<f64>)> {
        let mut local = self.local.clone();
        for i in 0..local.size() {
            local.add(i, i, damping * self.local.get(i, i) + 1e-12);
        }
        let mut shared = self.shared.clone();
        for i in 0..shared.nrows() {
            shared[(i, i)] += damping * self.shared[(i, i)] + 1e-12;
        }
        let factor = local.cholesky()?;
        let eliminated = factor.solve(&self.border);
        let y_free = factor.solve(&DMatrix::from_column_slice(local.size(), 1, self.local_gradient.as_slice())).column(0).into_owned();
        let schur = shared - self.border.tr_mul(&eliminated);
        let z = schur.cholesky()?.solve(&(self.border.tr_mul(&y_free) - &self.shared_gradient));
        let y = -(y_free + eliminated * &z);
        Some((y, z))
    }

    /// Covariance of the shared unknowns for unit noise: S⁻¹; `None` if singular.
    pub fn shared_covariance(&self) -> Option<DMatrix<f64>> {
        let eliminated = self.local.cholesky()?.solve(&self.border);
        Some((&self.shared - self.border.tr_mul(&eliminated)).cholesky()?.inverse())
    }
}

/// A least-squares problem of arrow structure.
pub trait ArrowProblem {
    type State: Clone;
    /// Half the sum of squared residuals.
    fn cost(&self, state: &Self::State) -> f64;
    fn linearise(&self, state: &Self::State) -> NormalEquations;
    /// The state moved by the tangent step (y, z).
    fn retract(&self, state: &Self::State, y: &DVector<f64>, z: &DVector<f64>) -> Self::State;
}

/// When to stop.
#[derive(Clone, Copy, Debug)]
pub struct LmOptions {
    pub max_iterations: u64,
    /// Stop when a step lowers the cost by less than this fraction.
    pub relative_cost: f64,
}

/// What happened.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LmSummary {
    pub initial_cost: f64,
    pub final_cost: f64,
    pub iterations: u64,
    pub rejected_steps: u64,
    pub converged: bool,
}

/// Levenberg–Marquardt for argmin's executor.
struct LevenbergMarquardt {
    relative_cost: f64,
    damping: f64,
    growth: f64,
    initial_cost: Option<f64>,
    rejected_steps: u64,
    converged: bool,
}

type LmState<P> = IterState<P, (), (), (), (), f64>;

/// Damping above which a step is too short to matter.
const HOPELESS: f64 = 1e12;

impl<O: ArrowProblem> Solver<O, LmState<O::State>> for LevenbergMarquardt {
    fn name(&self) -> &str {
        "Levenberg-Marquardt with arrow structure"
    }

    fn next_iter(&mut self, problem: &mut Problem<O>, mut state: LmState<O::State>) -> Result<(LmState<O::State>, Option<KV>), Error> {
        let at = state.take_param().ok_or_else(|| Error::msg("Levenberg-Marquardt needs a start"))?;
        let normal = problem.problem("linearise", |o| Ok(o.linearise(&at)))?;
        self.initial_cost.get_or_insert(normal.cost);
        while self.damping < HOPELESS {
            if let Some((y, z)) = normal.step(self.damping) {
                let (trial, cost) = problem.problem("cost", |o| {
                    let trial = o.retract(&at, &y, &z);
                    let cost = o.cost(&trial);
                    Ok((trial, cost))
                })?;
                let slope = normal.local_gradient.dot(&y) + normal.shared_gradient.dot(&z);
                let damped: f64 = (0..y.len()).map(|i| normal.local.get(i, i) * y[i] * y[i]).sum::<f64>()
                    + (0..z.len()).map(|i| normal.shared[(i, i)] * z[i] * z[i]).sum::<f64>();
                let predicted = 0.5 * (self.damping * damped - slope);
                if cost < normal.cost {
                    let gain = (normal.cost - cost) / predicted;
                    self.damping = (self.damping * (1.0 - (2.0 * gain - 1.0).powi(3)).max(1.0 / 3.0)).max(1e-12);
                    self.growth = 2.0;
                    self.converged = normal.cost - cost <= self.relative_cost * normal.cost;
                    return Ok((state.param(trial).cost(cost), None));
                }
            }
            self.rejected_steps += 1;
            self.damping *= self.growth;
            self.growth *= 2.0;
        }
        self.converged = true;
        Ok((state.param(at).cost(normal.cost), None))
    }

    fn terminate(&mut self, _state: &LmState<O::State>) -> TerminationStatus {
        if self.converged { TerminationStatus::Terminated(TerminationReason::SolverConverged) } else { TerminationStatus::NotTerminated }
    }
}

/// Minimises `problem` from `start`.
pub fn minimise<O: ArrowProblem>(problem: O, start: O::State, options: &LmOptions) -> (O::State, LmSummary) {
    let solver = LevenbergMarquardt {
        relative_cost: options.relative_cost,
        damping: 1e-4,
        growth: 2.0,
        initial_cost: None,
        rejected_steps: 0,
        converged: false,
    };
    let run = Executor::new(problem, solver).configure(|s| s.param(start.clone()).max_iters(options.max_iterations)).run();
    // The solver itself returns no errors and always puts a state back.
    let Ok(mut result) = run else {
        return (start, LmSummary { initial_cost: f64::NAN, final_cost: f64::NAN, iterations: 0, rejected_steps: 0, converged: false });
    };
    let summary = LmSummary {
        initial_cost: result.solver.initial_cost.unwrap_or(f64::NAN),
        final_cost: result.state.cost,
        iterations: result.state.iter,
        rejected_steps: result.solver.rejected_steps,
        converged: result.solver.converged,
    };
    (result.state.take_param().unwrap_or(start), summary)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Exponential decays with a shared rate and an amplitude per "frame", chained by a smoothness term.
    struct Decays {
        data: Vec<[f64; 5]>,
    }

    impl Decays {
        fn residuals(&self, (amplitudes, rate): &(Vec<f64>, f64)) -> Vec<f64> {
            let mut r = Vec::new();
            for (a, row) in amplitudes.iter().zip(&self.data) {
                r.extend(row.iter().enumerate().map(|(i, d)| a * (-rate * i as f64).exp() - d));
            }
            r.extend(amplitudes.windows(2).map(|w| 0.1 * (w[1] - w[0])));
            r
        }

        fn jacobian(&self, state: &(Vec<f64>, f64)) -> DMatrix<f64> {
            let n = self.data.len();
            let h = 1e-6;
            let columns: Vec<_> = (0..=n)
                .map(|k| {
                    let mut moved = [state.clone(), state.clone()];
                    for (m, sign) in moved.iter_mut().zip([h, -h]) {
                        if k < n { m.0[k] += sign } else { m.1 += sign }
                    }
                    DVector::from_vec(self.residuals(&moved[0])) - DVector::from_vec(self.residuals(&moved[1]))
                })
                .map(|c| c / (2.0 * h))
                .collect();
            DMatrix::from_columns(&columns)
        }
    }

    impl ArrowProblem for &Decays {
        type State = (Vec<f64>, f64);
        fn cost(&self, state: &Self::State) -> f64 {
            0.5 * self.residuals(state).iter().map(|r| r * r).sum::<f64>()
        }
        fn linearise(&self, state: &Self::State) -> NormalEquations {
            let n = self.data.len();
            let j = self.jacobian(state);
            let h = j.tr_mul(&j);
            let g = j.tr_mul(&DVector::from_vec(self.residuals(state)));
            let mut normal = NormalEquations::zeros(n, 1, 1);
            normal.cost = self.cost(state);
            for i in 0..n {
                normal.local.add(i, i, h[(i, i)]);
                if i > 0 {
                    normal.local.add(i, i - 1, h[(i, i - 1)]);
                }
                normal.border[(i, 0)] = h[(i, n)];
                normal.local_gradient[i] = g[i];
            }
            normal.shared[(0, 0)] = h[(n, n)];
            normal.shared_gradient[0] = g[n];
            normal
        }
        fn retract(&self, state: &Self::State, y: &DVector<f64>, z: &DVector<f64>) -> Self::State {
            (state.0.iter().zip(y.iter()).map(|(a, d)| a + d).collect(), state.1 + z[0])
        }
    }

    fn decays() -> Decays {
        let data = (0..6).map(|k| std::array::from_fn(|i| (1.0 + 0.1 * k as f64) * (-0.7 * i as f64).exp())).collect();
        Decays { data }
    }

    #[test]
    fn step_and_covariance_equal_the_dense_ones() {
        let problem = decays();
        let state = (vec![1.4, 0.9, 1.1, 1.0, 2.0, 1.3], 0.2);
        let j = problem.jacobian(&state);
        let h = j.tr_mul(&j);
        let g = j.tr_mul(&DVector::from_vec(problem.residuals(&state)));
        let expected = -h.clone().cholesky().unwrap().solve(&g);
        let normal = (&problem).linearise(&state);
        let (y, z) = normal.step(0.0).unwrap();
        assert!((y - expected.rows(0, 6)).amax() < 1e-9 && (z[0] - expected[6]).abs() < 1e-9);
        let covariance = h.try_inverse().unwrap();
        assert!((normal.shared_covariance().unwrap()[(0, 0)] - covariance[(6, 6)]).abs() < 1e-9);
    }

    #[test]
    fn finds_the_rate_from_a_start_whose_plain_step_overshoots() {
        let problem = decays();
        let start = (vec![0.01; 6], 4.0);
        let (y, z) = (&problem).linearise(&start).step(0.0).unwrap();
        let overshoot = (&problem).retract(&start, &y, &z);
        assert!((&problem).cost(&overshoot) > (&problem).cost(&start), "the test needs a step to reject");
        let (state, summary) = minimise(&problem, start, &LmOptions { max_iterations: 100, relative_cost: 1e-12 });
        assert!(summary.rejected_steps > 0 && summary.converged && summary.final_cost < summary.initial_cost);
        // The smoothness term pulls the amplitudes together a little; the rate is that of the data.
        assert!((state.1 - 0.7).abs() < 0.01, "{state:?}");
    }
}
