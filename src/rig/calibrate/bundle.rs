//! Bundle adjustment: cameras, lenses and board poses from all corners at once.
//!
//! ½ Σ ρ(|π_c(T_c B_v x_i) − u_cvi|), ρ Huber's loss, over the boards' poses B_v (`rig_from_board`, the local unknowns of
//! the arrow, six each) and the cameras' f_x, f_y, c_x, c_y, lens terms and poses T_c (`camera_from_rig`, shared). The rig's
//! frame is camera 0's: T_0 = 1. Tangents are rotation first, R exp([δ]×), then translation.                    (1)
//! Departure from Triggs et al. (2000), "Bundle adjustment - a modern synthesis": none; the points are a known plane.
//! Jacobians are checked against central differences, the minimum against cv::calibrateCamera and cv::stereoCalibrate.

use super::target::Target;
use crate::math::arrow::{ArrowProblem, NormalEquations};
use crate::math::rotation::{exp, hat};
use crate::rig::{Camera, Lens};
use nalgebra::{DMatrix, DVector, Isometry3, Matrix2x3, Point2, SMatrix, UnitQuaternion, Vector2, Vector3};
use rayon::prelude::*;

/// Columns of a camera's whole intrinsics: f_x, f_y, c_x, c_y, lens terms.
pub const INTRINSICS: usize = 12;

/// Which of a camera's intrinsics are free, and how they share unknowns.
#[derive(Clone, Debug, PartialEq)]
pub struct Layout {
    /// Unknown of each intrinsic column; `None`: fixed.
    pub unknown: [Option<usize>; INTRINSICS],
    /// Number of unknown intrinsics per camera.
    pub count: usize,
}

impl Layout {
    /// Free lens terms by index; `one_focal`: f_x and f_y move together. `None`: all intrinsics are known.
    pub fn new(lens_terms: Option<&[usize]>, one_focal: bool) -> Layout {
        let mut unknown = [None; INTRINSICS];
        let Some(lens_terms) = lens_terms else { return Layout { unknown, count: 0 } };
        let focal = [0, usize::from(!one_focal)];
        let centre = focal[1] + 1;
        unknown[..4].copy_from_slice(&[Some(focal[0]), Some(focal[1]), Some(centre), Some(centre + 1)]);
        for (k, term) in lens_terms.iter().enumerate() {
            unknown[4 + term] = Some(centre + 2 + k);
        }
        Layout { unknown, count: centre + 2 + lens_terms.len() }
    }

    /// First shared unknown of a camera: its intrinsics, then (but for camera 0) its pose.
    pub fn offset(&self, camera: usize) -> usize {
        camera * (self.count + 6) - if camera > 0 { 6 } else { 0 }
    }

    /// Unknowns of a camera.
    pub fn width(&self, camera: usize) -> usize {
        self.count + if camera > 0 { 6 } else { 0 }
    }
}

/// Corners of one board in one camera.
#[derive(Clone, Debug, PartialEq)]
pub struct Sighting {
    pub camera: usize,
    pub corners: Vec<(usize, Point2<f64>)>,
}

/// The measurements of (1), one list of sightings per board pose.
pub struct Bundle<'a> {
    pub target: &'a Target,
    pub views: Vec<Vec<Sighting>>,
    pub layout: Layout,
    /// Where Huber's loss leaves the parabola, px; infinite: plain squares.
    pub huber_px: f64,
}

/// The unknowns of (1).
#[derive(Clone, Debug)]
pub struct Solution {
    /// `camera_from_world` and `translation` are from the rig's frame.
    pub cameras: Vec<Camera>,
    /// `rig_from_board`, one per view.
    pub boards: Vec<Isometry3<f64>>,
}

/// A corner's pixel and its derivatives by the board's pose, the camera's pose and the camera's whole intrinsics.
pub struct Observed {
    pub pixel: Point2<f64>,
    pub by_board: SMatrix<f64, 2, 6>,
    pub by_camera: SMatrix<f64, 2, 6>,
    pub by_intrinsics: SMatrix<f64, 2, INTRINSICS>,
}

/// Pixel of a point on a board; `None` behind the camera.
pub fn pixel(camera: &Camera, rig_from_board: &Isometry3<f64>, x_on_board: &Vector3<f64>) -> Option<Point2<f64>> {
    camera.project(&(rig_from_board.rotation * x_on_board + rig_from_board.translation.vector))
}

/// The same with derivatives.
pub fn observe(camera: &Camera, rig_from_board: &Isometry3<f64>, x_on_board: &Vector3<f64>) -> Option<Observed> {
    let x_in_rig = rig_from_board.rotation * x_on_board + rig_from_board.translation.vector;
    let p = camera.camera_point(&x_in_rig);
    let pixel = camera.project(&x_in_rig)?;
    let ideal = Vector2::new(p.x / p.z, p.y / p.z);
    let (drawn, lens) = camera.lens.distort(&ideal);
    let scale = camera.matrix.fixed_view::<2, 2>(0, 0).into_owned();
    let perspective = Matrix2x3::new(1.0, 0.0, -ideal.x, 0.0, 1.0, -ideal.y) / p.z;
    let by_point = scale * lens * perspective;
    let camera_from_rig = camera.camera_from_world.matrix();
    let board = by_point * camera_from_rig;
    let mut by_board = SMatrix::<f64, 2, 6>::zeros();
    by_board.fixed_view_mut::<2, 3>(0, 0).copy_from(&(-board * rig_from_board.rotation.to_rotation_matrix().matrix() * hat(x_on_board)));
    by_board.fixed_view_mut::<2, 3>(0, 3).copy_from(&board);
    let mut by_camera = SMatrix::<f64, 2, 6>::zeros();
    by_camera.fixed_view_mut::<2, 3>(0, 0).copy_from(&(-board * hat(&x_in_rig)));
    by_camera.fixed_view_mut::<2, 3>(0, 3).copy_from(&by_point);
    let mut by_intrinsics = SMatrix::<f64, 2, INTRINSICS>::zeros();
    by_intrinsics[(0, 0)] = drawn.x;
    by_intrinsics[(1, 1)] = drawn.y;
    by_intrinsics[(0, 2)] = 1.0;
    by_intrinsics[(1, 3)] = 1.0;
    by_intrinsics.fixed_view_mut::<2, 8>(0, 4).copy_from(&(scale * camera.lens.jacobian_by_terms(&ideal)));
    Some(Observed { pixel, by_board, by_camera, by_intrinsics })
}

/// What one camera's sighting adds to the normal equations.
struct Contribution {
    camera: usize,
    local: DMatrix<f64>,
    local_gradient: DVector<f64>,
    border: DMatrix<f64>,
    shared: DMatrix<f64>,
    shared_gradient: DVector<f64>,
}

impl Bundle<'_> {
    /// Residuals of a sighting, model minus picture, px; `None` for a corner behind the camera.
    pub fn residuals(&self, solution: &Solution, view: usize, sighting: &Sighting) -> Vec<Option<Vector2<f64>>> {
        let camera = &solution.cameras[sighting.camera];
        let residual = |(id, seen): &(usize, Point2<f64>)| Some(pixel(camera, &solution.boards[view], &self.target.point(*id))? - seen);
        sighting.corners.iter().map(residual).collect()
    }

    fn loss(&self, error_px: f64) -> f64 {
        let k = self.huber_px;
        if error_px <= k { 0.5 * error_px * error_px } else { k * (error_px - 0.5 * k) }
    }

    fn view_cost(&self, solution: &Solution, view: usize) -> f64 {
        let of_sighting = |s: &Sighting| {
            let errors = self.residuals(solution, view, s).into_iter();
            errors.map(|r| r.map_or(f64::INFINITY, |r| self.loss(r.norm()))).sum::<f64>()
        };
        self.views[view].iter().map(of_sighting).sum()
    }

    fn contribution(&self, solution: &Solution, view: usize, sighting: &Sighting) -> Contribution {
        let camera = &solution.cameras[sighting.camera];
        let (width, rows) = (self.layout.width(sighting.camera), 2 * sighting.corners.len());
        let mut jacobian = DMatrix::zeros(rows, width);
        let mut by_board = DMatrix::zeros(rows, 6);
        let mut residuals = DVector::zeros(rows);
        for (k, (id, seen)) in sighting.corners.iter().enumerate() {
            let Some(o) = observe(camera, &solution.boards[view], &self.target.point(*id)) else { continue };
            let error = o.pixel - seen;
            let weight = (self.huber_px / error.norm()).min(1.0).sqrt();
            by_board.view_mut((2 * k, 0), (2, 6)).copy_from(&(o.by_board * weight));
            residuals.rows_mut(2 * k, 2).copy_from(&(error * weight));
            for (column, unknown) in self.layout.unknown.iter().enumerate() {
                if let Some(unknown) = unknown {
                    let mut to = jacobian.view_mut((2 * k, *unknown), (2, 1));
                    to += o.by_intrinsics.column(column) * weight;
                }
            }
            if sighting.camera > 0 {
                jacobian.view_mut((2 * k, self.layout.count), (2, 6)).copy_from(&(o.by_camera * weight));
            }
        }
        Contribution {
            camera: sighting.camera,
            local: by_board.tr_mul(&by_board),
            local_gradient: by_board.tr_mul(&residuals),
            border: by_board.tr_mul(&jacobian),
            shared: jacobian.tr_mul(&jacobian),
            shared_gradient: jacobian.tr_mul(&residuals),
        }
    }
}

impl ArrowProblem for &Bundle<'_> {
    type State = Solution;

    fn cost(&self, solution: &Solution) -> f64 {
        let costs: Vec<f64> = (0..self.views.len()).into_par_iter().map(|v| self.view_cost(solution, v)).collect();
        costs.iter().sum()
    }

    fn linearise(&self, solution: &Solution) -> NormalEquations {
        let views: Vec<Vec<Contribution>> = (0..self.views.len())
            .into_par_iter()
            .map(|v| self.views[v].iter().map(|s| self.contribution(solution, v, s)).collect())
            .collect();
        let cameras = solution.cameras.len();
        let mut normal = NormalEquations::zeros(6 * views.len(), 5, self.layout.offset(cameras - 1) + self.layout.width(cameras - 1));
        normal.cost = self.cost(solution);
        for (view, contributions) in views.iter().enumerate() {
            for c in contributions {
                let (row, column, width) = (6 * view, self.layout.offset(c.camera), self.layout.width(c.camera));
                for i in 0..6 {
                    (0..=i).for_each(|j| normal.local.add(row + i, row + j, c.local[(i, j)]));
                    normal.local_gradient[row + i] += c.local_gradient[i];
                }
                let mut border = normal.border.view_mut((row, column), (6, width));
                border += &c.border;
                let mut shared = normal.shared.view_mut((column, column), (width, width));
                shared += &c.shared;
                let mut gradient = normal.shared_gradient.rows_mut(column, width);
                gradient += &c.shared_gradient;
            }
        }
        normal
    }

    fn retract(&self, solution: &Solution, y: &DVector<f64>, z: &DVector<f64>) -> Solution {
        let cameras = solution.cameras.iter().enumerate().map(|(k, camera)| {
            let step = z.rows(self.layout.offset(k), self.layout.width(k));
            moved_camera(camera, &self.layout, step.as_slice())
        });
        let boards = solution.boards.iter().enumerate().map(|(v, board)| {
            let step = y.rows(6 * v, 6);
            moved_pose(board, &Vector3::new(step[0], step[1], step[2]), &Vector3::new(step[3], step[4], step[5]))
        });
        Solution { cameras: cameras.collect(), boards: boards.collect() }
    }
}

fn moved_pose(pose: &Isometry3<f64>, turn: &Vector3<f64>, shift: &Vector3<f64>) -> Isometry3<f64> {
    let rotation = UnitQuaternion::new_normalize((pose.rotation * exp(turn)).into_inner());
    Isometry3::from_parts((pose.translation.vector + shift).into(), rotation)
}

/// A camera after the step of its unknowns.
fn moved_camera(camera: &Camera, layout: &Layout, step: &[f64]) -> Camera {
    let mut moved = camera.clone();
    let change: [f64; INTRINSICS] = std::array::from_fn(|k| layout.unknown[k].map_or(0.0, |u| step[u]));
    for (k, place) in [(0, 0), (1, 1), (0, 2), (1, 2)].into_iter().enumerate() {
        moved.matrix[place] += change[k];
    }
    let terms = match &mut moved.lens {
        Lens::BrownConrady(terms) => &mut terms[..],
        Lens::Fisheye(terms) => &mut terms[..],
    };
    terms.iter_mut().zip(&change[4..]).for_each(|(term, change)| *term += change);
    if let [a, b, c, x, y, z] = step[layout.count..] {
        let pose = moved_pose(&camera_pose(camera), &Vector3::new(a, b, c), &Vector3::new(x, y, z));
        set_pose(&mut moved, &pose);
    }
    moved
}

/// `camera_from_rig` as a rigid motion.
pub fn camera_pose(camera: &Camera) -> Isometry3<f64> {
    Isometry3::from_parts(camera.translation.into(), UnitQuaternion::from_rotation_matrix(&camera.camera_from_world))
}

/// Puts a camera at `camera_from_rig`.
pub fn set_pose(camera: &mut Camera, camera_from_rig: &Isometry3<f64>) {
    camera.camera_from_world = camera_from_rig.rotation.to_rotation_matrix();
    camera.translation = camera_from_rig.translation.vector;
}
