//! What each measurement counts: Cauchy weights over variances along the normal, gates, and how well a state explains all.
//!
//! ω = base / ((nᵀ Σ n + σ²) (1 + (r/cσ)²)). Weights, κ and the points of rays are frozen for one solver run.
//! A cloud point counts with its distance to the skin, the point x of a ray nearest to the body likewise. With y the point of
//! the skin that x most probably is, least (x − y)ᵀ (Σ + σ² I)⁻¹ (x − y), and n the normal there, r = nᵀ(x − y) + κ (√d_eff(y) −
//! √d_0), y frozen. Taken at x itself, the derivative for a limb's width would be larger for points outside than for those
//! inside, and limbs found 2 to 5 % too wide in noise; with the nearest y, whatever Σ, points behind a limb's middle go to its
//! back, and at a disparity noise of 1 px bodies came out 40 instead of 13 mm off. From afar fewer steps lead there with x in
//! place of y.
//! A point near the back of a limb, within c σ, was seen on its front, if no other limb is before it: y is there in the line of sight.
//! Without this an arm that came to lie before its points stays there. Other points behind the skin count nothing: drawn
//! to a front from farther off a third of clutter made 44 mm of 10, drawn to another limb's the filmed run 29 mm of 24.
//! As [`PointResidual::Ray`] a cloud point counts with how far, t, it lies along its line of sight d behind where that meets the
//! front of the body: r = t nᵀd + κ (√d_eff(y) − √d_0), y the front.
//! Checked against a dense search (rays, lines of sight); the weights enter the Jacobian tests of `problem`.

use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

use super::curve::Curve;
use super::problem::{Frame, Known, Outside, Settings, Target};
use super::state::State;
use crate::body::surface::{Evaluation, Near, SKIN};
use crate::body::{PosedSurface, Surface};

/// Frozen quantities of one target.
#[derive(Clone, Copy, Debug, Default)]
pub struct Frozen {
    pub x: Vector3<f64>,
    /// The primitives that count.
    pub near: Near,
    /// ω_i.
    pub weight: f64,
    /// κ_i.
    pub metres_per_root: f64,
    /// Signed distance and the target's own variance in it, m and m².
    pub distance_m: f64,
    pub variance: f64,
    /// Cauchy weight, 0 to 1.
    pub robust: f64,
    /// Node that the skin there belongs to.
    pub node: u8,
    pub is_point: bool,
    pub residual: PointResidual,
    /// Added to the residual at `x`, metres.
    pub offset_m: f64,
}

impl Frozen {
    /// Residual where √d_eff at `x` is `root`, metres, and its derivative for it.
    pub fn at(&self, root: f64) -> (f64, f64) {
        let (value, slope) = match self.residual {
            PointResidual::Field => {
                let field = (-2.0 * root * root).exp();
                ((0.5 - field) / (2.0 * SKIN.sqrt()), 2.0 * root * field / SKIN.sqrt())
            }
            PointResidual::Distance | PointResidual::Ray => (root - SKIN.sqrt(), 1.0),
        };
        (self.offset_m + self.metres_per_root * value, self.metres_per_root * slope)
    }
}

/// What of a cloud point is made small.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum PointResidual {
    /// Its distance to the skin.
    #[default]
    Distance,
    /// Its distance along the line of sight to the front of the body; to the skin where that misses the body.
    Ray,
    /// T − F of the paper, as metres at the skin: it saturates away from it.
    Field,
}

/// Frozen quantities of one primitive in one silhouette's picture.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct FrozenOutside {
    pub weight: f64,
    /// Depth over focal length.
    pub metres_per_px: f64,
}

/// Scale of the Cauchy loss in standard deviations: 95 % efficiency for Gaussian noise.
const CAUCHY: f64 = 2.385;
/// The same for silhouettes: a limb far outside is a hole in the mask less often than a limb out of place.
const OUTSIDE_CAUCHY: f64 = 6.0;
/// Skin whose outward normal makes a larger cosine than this with the line of sight is not seen.
const FACING: f64 = 0.2;
/// As the surface itself leaves primitives out, so that exact points of the skin have no distance.
const MARGIN: f32 = 5.0;
/// Primitives that a ray passes nearest to, tried as the start of its closest approach.
const CANDIDATES: usize = 4;
/// Newton steps from there.
const STEPS: usize = 3;
/// Outlines lower than this above the floor are those of contact shadows.
const CONTACT_M: f64 = 0.06;
/// Added to the distance of a point that only the far side of the body explains.
const BEHIND_M: f64 = 0.1;

/// How well a state explains the targets, robustly.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Fitness {
    /// Σ ω ½c² ln(1 + (r/cσ)²) over the targets, without priors.
    pub cost: f64,
    /// Sum of squared distances of points within 3 σ, m², and their number.
    pub inlier_square: f64,
    pub inliers: usize,
    /// Effective number of measurements: sum of weights relative to a full-weight target.
    pub effective: f64,
}

impl Fitness {
    fn add(self, other: Fitness) -> Fitness {
        Fitness {
            cost: self.cost + other.cost,
            inlier_square: self.inlier_square + other.inlier_square,
            inliers: self.inliers + other.inliers,
            effective: self.effective + other.effective,
        }
    }
}

/// Frozen weights of one frame at a posed surface, and how well it fits.
pub(super) fn freeze(frame: &Frame, surface: &PosedSurface, settings: &Settings, known: &Known) -> (Vec<Frozen>, Fitness) {
    let mut evaluation = Evaluation::default();
    let mut fitness = Fitness::default();
    let frozen = frame.targets.iter().map(|target| {
        let (x, near, deeper_m, base) = match target {
            Target::Point { x, .. } if settings.residual == PointResidual::Ray => {
                let (y, near) = front(surface, &known.viewpoint, x, &mut evaluation);
                let deeper_m = (x - known.viewpoint).norm() - (y - known.viewpoint).norm();
                (y, near, deeper_m, settings.point_weight)
            }
            Target::Point { x, .. } => (*x, evaluate_near(surface, x, &mut evaluation), 0.0, settings.point_weight),
            Target::Ray { origin, direction, .. } => {
                let (along, near) = surface.nearest_on_line(origin, direction, MARGIN, [CANDIDATES, STEPS], &mut evaluation);
                let x = origin + direction * along;
                surface.evaluate_among(&near, &x, &mut evaluation);
                (x, near, 0.0, settings.ray_weight)
            }
        };
        let sight = (x - known.viewpoint).normalize();
        let is_point = matches!(target, Target::Point { .. });
        let is_distance = is_point && settings.residual == PointResidual::Distance;
        let to_skin = settings.at_skin && (!is_point || is_distance);
        let (mut at, mut near) = match target {
            _ if !to_skin => (x, near),
            Target::Point { covariance, .. } => {
                let noise = sight * sight.dot(&(covariance * sight)).sqrt();
                foot(surface, &x, near, &(covariance + Matrix3::identity() * settings.model_m.powi(2)), &noise, &mut evaluation)
            }
            Target::Ray { .. } => foot(surface, &x, near, &Matrix3::identity(), &Vector3::zeros(), &mut evaluation),
        };
        let looked_at = |evaluation: &Evaluation| {
            let normal = evaluation.gradient.normalize();
            let (variance, hidden) = match target {
                Target::Point { covariance, .. } => (normal.dot(&(covariance * normal)), normal.dot(&sight) > FACING),
                Target::Ray { origin, sigma, .. } => ((sigma * (x - origin).norm()).powi(2), near_floor(known, &x)),
            };
            (normal, hidden, variance)
        };
        let (mut normal, mut hidden, mut variance) = looked_at(&evaluation);
        let to_back_m = (x - at).dot(&normal) + evaluation.distance();
        if is_distance && hidden && to_back_m.powi(2) < CAUCHY.powi(2) * (variance + settings.model_m.powi(2)) {
            (at, near) = front_of_limb(surface, &known.viewpoint, &x, (at, near), &mut evaluation);
            (normal, hidden, variance) = looked_at(&evaluation);
        }
        let precision = 1.0 / (variance + settings.model_m.powi(2));
        let behind = hidden && is_point;
        let frozen = Frozen {
            x: at,
            near,
            metres_per_root: evaluation.metres_per_root(),
            variance,
            node: limb(surface, &evaluation),
            is_point,
            residual: if is_point { settings.residual } else { PointResidual::Distance },
            offset_m: (x - at).dot(&normal) + deeper_m * normal.dot(&sight),
            ..Frozen::default()
        };
        let distance_m = frozen.at(evaluation.root()).0;
        let distance = distance_m.abs() + if behind { BEHIND_M } else { 0.0 };
        let scaled = distance * distance * precision / (CAUCHY * CAUCHY);
        let robust = if hidden { 0.0 } else { 1.0 / (1.0 + scaled) };
        fitness.cost += base * 0.5 * CAUCHY * CAUCHY * scaled.ln_1p();
        fitness.effective += base * robust;
        if distance * distance * precision < 9.0 && is_point {
            fitness.inliers += 1;
            fitness.inlier_square += distance * distance;
        }
        Frozen { weight: base * robust * precision, distance_m, robust, ..frozen }
    });
    (frozen.collect(), fitness)
}

pub(super) fn outside_px(outside: &Outside, x: &Vector3<f64>) -> f64 {
    outside.camera.project(x).map_or(0.0, |pixel| outside.field.at(pixel.x, pixel.y).0)
}

/// Frozen quantities of the primitives in a frame's silhouettes, and their robust cost.
pub(super) fn freeze_outsides(frame: &Frame, surface: &PosedSurface, settings: &Settings) -> (Vec<FrozenOutside>, f64) {
    let mut cost = 0.0;
    let precision = 1.0 / (settings.model_m * settings.model_m);
    let frozen = frame.outsides.iter().flat_map(|o| surface.primitives.iter().map(move |p| (o, p))).map(|(outside, p)| {
        let metres_per_px = outside.camera.camera_point(&p.centre).z / outside.camera.matrix[(0, 0)];
        let scaled = (outside_px(outside, &p.centre) * metres_per_px).powi(2) * precision / (OUTSIDE_CAUCHY * OUTSIDE_CAUCHY);
        if scaled > 0.0 {
            cost += settings.outside_weight * 0.5 * OUTSIDE_CAUCHY * OUTSIDE_CAUCHY * scaled.ln_1p();
        }
        FrozenOutside { weight: settings.outside_weight * precision / (1.0 + scaled), metres_per_px }
    });
    (frozen.collect(), cost)
}

fn near_floor(known: &Known, x: &Vector3<f64>) -> bool {
    known.floor_m.is_some_and(|floor| x.dot(&known.up) < floor + CONTACT_M)
}

/// Robust fitness of each frame at a state.
pub fn fitness(curve: &Curve, frames: &[Frame], settings: &Settings, known: &Known, state: &State) -> Vec<Fitness> {
    let body = Surface::new(&state.shape);
    let of_frame = |t: usize| {
        let surface = state.posed(curve, &body, t).surface;
        let points = freeze(&frames[t], &surface, settings, known).1;
        Fitness { cost: points.cost + freeze_outsides(&frames[t], &surface, settings).1, ..points }
    };
    (0..frames.len()).into_par_iter().map(of_frame).collect()
}

/// Sum over frames, in their order.
pub fn total(fitness: &[Fitness]) -> Fitness {
    fitness.iter().fold(Fitness::default(), |sum, f| sum.add(*f))
}

/// Node that the skin belongs to where the surface was evaluated.
fn limb(surface: &PosedSurface, evaluation: &Evaluation) -> u8 {
    let nearest = evaluation.shares.iter().min_by(|a, b| a.unit.norm_squared().total_cmp(&b.unit.norm_squared()));
    nearest.map_or(0, |share| surface.primitives[share.primitive].node as u8)
}

/// The front of the limb in the line of sight of a point `x` that is nearest to the limb's back, with what makes the skin there;
/// `place`, where the surface was evaluated, if another limb is before it.
fn front_of_limb(
    surface: &PosedSurface,
    eye: &Vector3<f64>,
    x: &Vector3<f64>,
    place: (Vector3<f64>, Near),
    evaluation: &mut Evaluation,
) -> (Vector3<f64>, Near) {
    let back = limb(surface, evaluation);
    let found = front(surface, eye, x, evaluation);
    if limb(surface, evaluation) == back {
        return found;
    }
    surface.evaluate_among(&place.1, &place.0, evaluation);
    place
}

/// Longest step to the skin, metres, and number of steps.
const TO_SKIN_M: f64 = 0.04;
const TO_SKIN: usize = 2;

/// The point y of the skin from which `x` comes most probably, with the least (x − y)ᵀ Σ⁻¹ (x − y), and what makes the skin
/// there; the surface has been evaluated at `x`, and then is there. A point that only the back of the body is near to is first
/// brought against the line of sight by its own `noise`, once or twice.
fn foot(
    surface: &PosedSurface,
    x: &Vector3<f64>,
    near: Near,
    spread: &Matrix3<f64>,
    noise: &Vector3<f64>,
    evaluation: &mut Evaluation,
) -> (Vector3<f64>, Near) {
    let (mut y, mut near) = (*x, near);
    for _ in 0..2 {
        if evaluation.gradient.normalize().dot(noise) > FACING * noise.norm() {
            y -= noise;
            near = evaluate_near(surface, &y, evaluation);
        }
    }
    for step in 0..TO_SKIN {
        let normal = evaluation.gradient.normalize();
        let off_m = normal.dot(&(x - y)) + evaluation.distance().clamp(-TO_SKIN_M, TO_SKIN_M);
        let way = spread * normal;
        y = x - way * (off_m / normal.dot(&way));
        if step == 0 {
            near = surface.near(&y, MARGIN, evaluation);
        }
        surface.evaluate_among(&near, &y, evaluation);
    }
    (y, near)
}

/// Steps from within the body to its front, metres, and halvings of the last one: to half a millimetre; what is left is in √d_eff.
const TO_FRONT_M: f64 = 0.04;
const HALVINGS: usize = 6;

/// Where the line of sight from `eye` to `x` first meets the skin, its point nearest to the skin where it misses, and what makes
/// the skin there; the surface then is evaluated there.
fn front(surface: &PosedSurface, eye: &Vector3<f64>, x: &Vector3<f64>, evaluation: &mut Evaluation) -> (Vector3<f64>, Near) {
    let direction = (x - eye).normalize();
    let y = eye + direction * along_to_front(surface, eye, &direction, evaluation);
    (y, evaluate_near(surface, &y, evaluation))
}

/// How far from `eye` that is, metres.
fn along_to_front(surface: &PosedSurface, eye: &Vector3<f64>, direction: &Vector3<f64>, evaluation: &mut Evaluation) -> f64 {
    let (nearest, near) = surface.nearest_on_line(eye, direction, MARGIN, [CANDIDATES, STEPS], evaluation);
    let mut inside = |along: f64| {
        let y = eye + direction * along;
        let near = surface.near(&y, MARGIN, evaluation);
        surface.root_among(&near, &y) < SKIN.sqrt()
    };
    let closest = |i: usize| {
        let p = &surface.primitives[i];
        let (from, step) = (p.unit_from_world * (eye - p.centre), p.unit_from_world * direction);
        -from.dot(&step) / step.norm_squared()
    };
    let places = near.indices().map(closest).chain([nearest]);
    let Some(mut within) = places.filter(|along| inside(*along)).reduce(f64::min) else { return nearest };
    while within > TO_FRONT_M && inside(within - TO_FRONT_M) {
        within -= TO_FRONT_M;
    }
    let mut outside = within - TO_FRONT_M;
    for _ in 0..HALVINGS {
        let middle = 0.5 * (outside + within);
        if inside(middle) { within = middle } else { outside = middle }
    }
    0.5 * (outside + within)
}

/// The primitives that count at `y`; the surface then is evaluated there.
fn evaluate_near(surface: &PosedSurface, y: &Vector3<f64>, evaluation: &mut Evaluation) -> Near {
    let near = surface.near(y, MARGIN, evaluation);
    surface.evaluate_among(&near, y, evaluation);
    near
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::{Joint, Pose, Shape, place};
    use crate::fit::curve::tests::made_up_model;
    use crate::fit::problem::tests::{KNOWN, SETTINGS, frames, state};

    #[test]
    fn ray_point_is_the_least_of_a_dense_search() {
        let model = made_up_model(3);
        let curve = Curve::new(&model, 3);
        let state = state();
        let surface = state.posed(&curve, &Surface::new(&state.shape), 0).surface;
        for target in &frames(&curve, &state)[0].targets {
            if let Target::Ray { origin, direction, .. } = target {
                let steps = [CANDIDATES, STEPS];
                let (along, near) = surface.nearest_on_line(origin, direction, MARGIN, steps, &mut Evaluation::default());
                let found = origin + direction * along;
                assert!((surface.root_among(&near, &found) - surface.evaluate(&found).root()).abs() < 1e-4);
                let dense =
                    (0..8000).map(|i| surface.evaluate(&(origin + direction * (i as f64 * 1e-3))).d_eff).fold(f64::INFINITY, f64::min);
                assert!(surface.evaluate(&found).d_eff < dense + 0.02, "{} {dense}", surface.evaluate(&found).d_eff);
            }
        }
    }

    /// Of 5 cm, four metres before the cameras.
    fn ball() -> PosedSurface {
        let placement = place(&Shape::template(1.7).offsets(), &Pose::rest(Vector3::new(0.0, 4.0, 1.0)));
        PosedSurface::new(&Surface::ball(Joint::Root, 0.05), &placement)
    }

    #[test]
    fn feet_are_on_the_skin_and_the_distance_is_the_way_there() {
        let surface = ball();
        let centre = surface.primitives[0].centre;
        let along = [Vector3::x(), -Vector3::z(), Vector3::new(1.0, -1.0, -0.5).normalize()];
        let distances = [-0.012, -0.004, 0.004, 0.03, 0.1];
        let points = along.iter().flat_map(|n| distances.map(|d| centre + n * (0.05 + d)));
        let targets = points.map(|x| Target::Point { x, covariance: nalgebra::Matrix3::zeros() }).collect();
        let frozen = freeze(&Frame { targets, ..Frame::default() }, &surface, &SETTINGS, &KNOWN).0;
        for (k, f) in frozen.iter().enumerate() {
            let (n, d) = (along[k / distances.len()], distances[k % distances.len()]);
            assert!((f.distance_m - d).abs() < 1e-6, "{} {d}", f.distance_m);
            // Beyond two of the longest steps the derivative is that of a point outside.
            let foot = centre + n * (0.05 + (d - 2.0 * TO_SKIN_M).max(0.0));
            assert!((f.x - foot).norm() < 1e-6, "{:?} {foot:?}", f.x);
        }
    }

    #[test]
    fn a_noisy_point_comes_from_the_most_probable_of_the_skin_that_is_seen() {
        let surface = ball();
        let centre = surface.primitives[0].centre;
        let sight = (centre - KNOWN.viewpoint).normalize();
        let across = sight.cross(&Vector3::z()).normalize();
        let covariance = sight * sight.transpose() * 0.06f64.powi(2) + Matrix3::identity() * 0.002f64.powi(2);
        let settings = Settings { model_m: 0.004, ..SETTINGS };
        let spread = covariance + Matrix3::identity() * settings.model_m.powi(2);
        // Before, within and behind the ball, also where only its back is near.
        for (deep_m, aside_m) in [(-0.1, 0.0), (-0.06, 0.02), (-0.02, 0.01), (0.03, 0.0), (0.04, 0.015), (0.08, -0.02)] {
            let x = centre + sight * deep_m + across * aside_m;
            let frame = Frame { targets: vec![Target::Point { x, covariance }], ..Frame::default() };
            let found = freeze(&frame, &surface, &settings, &KNOWN).0.remove(0).x;
            let skin = (0..200).flat_map(|i| (0..400).map(move |j| (i as f64 * 0.00785, j as f64 * 0.0157)));
            let down = sight.cross(&across);
            let front = skin.map(|(a, b)| centre + (-sight * a.cos() + (across * b.cos() + down * b.sin()) * a.sin()) * 0.05);
            let far = |y: &Vector3<f64>| (x - y).dot(&(spread.try_inverse().unwrap() * (x - y)));
            let known = front.min_by(|p, q| far(p).total_cmp(&far(q))).unwrap();
            assert!((found - known).norm() < 0.004, "{deep_m} {aside_m}: {:?} {:?}", found - centre, known - centre);
        }
    }

    #[test]
    fn points_behind_a_limb_count_with_its_front_in_their_line_of_sight() {
        let (surface, eye) = (ball(), KNOWN.viewpoint);
        let centre = surface.primitives[0].centre;
        let sight = (centre - eye).normalize();
        let across = sight.cross(&Vector3::z()).normalize();
        for (behind_m, aside_m) in [(0.05, 0.0), (0.06, 0.02), (0.09, -0.03), (0.12, 0.01), (0.2, 0.0)] {
            let x = centre + sight * behind_m + across * aside_m;
            let frame = Frame { targets: vec![Target::Point { x, covariance: Matrix3::zeros() }], ..Frame::default() };
            for at_skin in [false, true] {
                let found = freeze(&frame, &surface, &Settings { at_skin, model_m: 0.03, ..SETTINGS }, &KNOWN).0.remove(0);
                if behind_m > 0.05 + CAUCHY * 0.03 {
                    assert!(found.weight == 0.0, "{found:?}");
                    continue;
                }
                // Line and sphere.
                let d = (x - eye).normalize();
                let along = (centre - eye).dot(&d);
                let y = eye + d * (along - (0.05f64.powi(2) - (eye + d * along - centre).norm_squared()).sqrt());
                let wanted = (y - centre).normalize().dot(&(x - y));
                assert!((found.x - y).norm() < 1e-3, "{behind_m} {aside_m}: {:?} {y:?}", found.x);
                assert!((found.distance_m - wanted).abs() < 1e-3 && found.weight > 0.0, "{behind_m} {aside_m}: {found:?} {wanted}");
            }
        }
    }

    #[test]
    fn points_behind_a_limb_that_another_one_hides_count_nothing() {
        let model = made_up_model(3);
        let curve = Curve::new(&model, 3);
        let state = state();
        let surface = state.posed(&curve, &Surface::new(&state.shape), 0).surface;
        let eye = KNOWN.viewpoint;
        let node = |y: &Vector3<f64>| limb(&surface, &surface.evaluate(y));
        let (mut hidden, mut seen) = (0, 0);
        for p in &surface.primitives {
            // From the limb's middle to its back.
            let away = (p.centre - eye).normalize();
            let Some(x) = (1..40).map(|i| p.centre + away * (0.01 * f64::from(i))).find(|x| surface.distance(x) > 0.005) else { continue };
            if surface.gradient(&x).normalize().dot(&away) <= FACING {
                continue;
            }
            let root = |along: f64| surface.evaluate(&(eye + away * along)).root();
            let first = (0..8000).map(|i| 1.0 + f64::from(i) * 5e-4).find(|along| root(*along) < SKIN.sqrt()).unwrap();
            let (before, own) = (node(&(eye + away * first)), node(&x));
            let frame = Frame { targets: vec![Target::Point { x, covariance: Matrix3::zeros() }], ..Frame::default() };
            let found = freeze(&frame, &surface, &Settings { at_skin: false, ..SETTINGS }, &KNOWN).0.remove(0);
            if before == own {
                assert!(found.weight > 0.0 && (found.x - (eye + away * first)).norm() < 0.005, "{found:?}");
                seen += 1;
            } else {
                assert!(found.weight == 0.0 && found.x == x, "{found:?}");
                hidden += 1;
            }
        }
        println!("{hidden} hidden by another limb, {seen} by their own");
        assert!(hidden >= 3 && seen >= 3, "{hidden} {seen}");
    }

    #[test]
    fn front_is_the_first_skin_of_a_dense_search() {
        let model = made_up_model(3);
        let curve = Curve::new(&model, 3);
        let state = state();
        let surface = state.posed(&curve, &Surface::new(&state.shape), 0).surface;
        let (eye, mut met) = (KNOWN.viewpoint, 0);
        for p in &surface.primitives {
            let direction = (p.centre - eye).normalize();
            let root = |along: f64| surface.evaluate(&(eye + direction * along)).root();
            let dense = (4000..8000).map(|i| i as f64 * 5e-4).find(|along| root(*along) < SKIN.sqrt());
            let found = (front(&surface, &eye, &(eye + direction), &mut Evaluation::default()).0 - eye).norm();
            // Fields of primitives beside the line, which it leaves out, move the skin by less than a millimetre.
            if let Some(first) = dense {
                assert!((found - first).abs() < 1e-3, "{found} {first}");
                met += 1;
            }
        }
        assert!(met > surface.primitives.len() / 2, "{met}");
    }

    #[test]
    fn just_before_the_front_distance_and_line_of_sight_agree() {
        let model = made_up_model(3);
        let curve = Curve::new(&model, 3);
        let state = state();
        let surface = state.posed(&curve, &Surface::new(&state.shape), 0).surface;
        let eye = KNOWN.viewpoint;
        let mut targets = Vec::new();
        for p in &surface.primitives {
            let y = front(&surface, &eye, &p.centre, &mut Evaluation::default()).0;
            let normal = surface.gradient(&y).normalize();
            if surface.distance(&y).abs() < 1e-3 && normal.dot(&(y - eye).normalize()) < -0.7 {
                targets.push(Target::Point { x: y + normal * 0.004, covariance: nalgebra::Matrix3::zeros() });
            }
        }
        assert!(targets.len() > 5, "{}", targets.len());
        let frame = Frame { targets, ..Frame::default() };
        for residual in [PointResidual::Distance, PointResidual::Ray, PointResidual::Field] {
            for frozen in freeze(&frame, &surface, &Settings { residual, ..SETTINGS }, &KNOWN).0 {
                assert!((frozen.distance_m - 0.004).abs() < 1.5e-3, "{residual:?}: {}", frozen.distance_m);
            }
        }
    }
}
