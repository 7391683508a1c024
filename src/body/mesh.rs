//! The skin as triangles, and which joints move them.
//!
//! Surface nets (Gibson 1998): one vertex in every grid cell that the surface crosses, at the mean of its edges' crossings; one
//! quadrilateral for every grid edge that it crosses. The vertices are then drawn to their neighbours' mean and back onto the
//! surface, x ← x − r n with the distance r of [`surface`](super::surface), so that they lie on it and are spread evenly.
//! A vertex goes with node k by the field's shares, w_k = Σ_{b on k} exp(−2 d_b)/F, smoothed along the mesh; the four largest stay.
//!
//! Hanging arms touch the hips and thighs touch each other, which would weld them: the mesh is taken in a stance with arms and
//! legs apart. Linear blending (what glTF has) then loses volume where joints bend far from it. Checked against the field
//! itself, its volume by counting, and posed implicit surfaces.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::pose::Pose;
use super::skeleton::{Joint, NODES};
use super::surface::{Evaluation, PosedSurface, SKIN};
use crate::math::rotation::exp;

/// Joints of one vertex and their weights, largest first, sum 1.
pub type Shares = [(Joint, f64); 4];

/// A closed surface; corners run counter-clockwise seen from outside.
#[derive(Clone, Debug)]
pub struct Mesh {
    /// Metres, in the world of the pose.
    pub vertices: Vec<Vector3<f64>>,
    pub triangles: Vec<[u32; 3]>,
    /// One per vertex.
    pub shares: Vec<Shares>,
}

/// Rounds of drawing vertices to their neighbours' mean, and of smoothing weights.
const RELAX: usize = 3;
const SMOOTH: usize = 4;
/// Newton steps onto the surface.
const STEPS: usize = 4;
/// Abduction of hips and shoulders and flexion of knees and elbows in the stance, radians.
const HIP: f64 = 0.2;
const SHOULDER: f64 = 0.6;
const KNEE: f64 = 0.2;
const ELBOW: f64 = 0.35;

/// Standing with arms and legs apart, knees and elbows slightly bent, feet flat on the floor; `offsets` as in
/// [`place`](super::place).
pub fn stance(offsets: &[Vector3<f64>; NODES]) -> Pose {
    use Joint::*;
    let mut pose = Pose::rest(offsets[0]);
    for (side, hip, knee, ankle, shoulder, elbow) in
        [(1.0, LHip, LKnee, LAnkle, LShoulder, LElbow), (-1.0, RHip, RKnee, RAnkle, RShoulder, RElbow)]
    {
        let abducted = |angle: f64| exp(&Vector3::new(0.0, 0.0, side * angle));
        let bent = |angle: f64| exp(&Vector3::new(angle, 0.0, 0.0));
        let mut set = |joint: Joint, rotation| pose.joints[joint as usize - 1] = rotation;
        set(hip, abducted(HIP) * bent(-0.5 * KNEE));
        set(knee, bent(KNEE));
        set(ankle, (abducted(HIP) * bent(0.5 * KNEE)).inverse());
        set(shoulder, abducted(SHOULDER));
        set(elbow, bent(-ELBOW));
    }
    let leg = |pose: &Pose| super::place(offsets, pose).position(LAnkle).y;
    pose.root.y += leg(&Pose::rest(offsets[0])) - leg(&pose);
    pose
}

/// The skin with grid cells of `cell_m` metres.
pub fn mesh(skin: &PosedSurface, cell_m: f64) -> Mesh {
    let grid = Grid::new(skin, cell_m);
    let (mut vertices, quads) = grid.nets();
    let neighbours = neighbours(vertices.len(), &quads);
    for round in 0..=RELAX {
        vertices = vertices
            .par_iter()
            .enumerate()
            .map_init(Evaluation::default, |scratch, (i, v)| {
                let start = if round == 0 { *v } else { mean(&neighbours[i], &vertices) };
                onto(skin, start, cell_m, scratch)
            })
            .collect();
    }
    let triangles = quads.iter().flat_map(|quad| split(*quad, &vertices)).collect();
    let shares = shares(skin, &vertices, &neighbours);
    Mesh { vertices, triangles, shares }
}

/// √d_eff − √d_0 on a grid: negative inside.
struct Grid {
    low: Vector3<f64>,
    cell_m: f64,
    counts: [usize; 3],
    values: Vec<f64>,
}

impl Grid {
    fn new(skin: &PosedSurface, cell_m: f64) -> Grid {
        // On the skin of n primitives at least one has exp(−2d) ≥ 1/(2n).
        let reach = (0.5 * (2.0 * skin.primitives.len().max(1) as f64).ln()).sqrt();
        let (mut low, mut high) = (Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY));
        for p in &skin.primitives {
            // Half the width of an ellipsoid's box: the lengths of the rows of R A.
            let half = reach * Vector3::from_fn(|i, _| p.world_from_node.row(i).transpose().component_mul(&p.semi_axes).norm());
            (low, high) = (low.inf(&(p.centre - half)), high.sup(&(p.centre + half)));
        }
        let margin = Vector3::repeat(2.0 * cell_m);
        let extent = if skin.primitives.is_empty() { Vector3::zeros() } else { high - low + 2.0 * margin };
        let counts: [usize; 3] = extent.map(|e| (e / cell_m).ceil() as usize + 1).into();
        let mut grid = Grid { low: low - margin, cell_m, counts, values: Vec::new() };
        grid.values = (0..counts.iter().product())
            .into_par_iter()
            .with_min_len(1024)
            .map_init(Evaluation::default, |scratch, index| {
                skin.evaluate_into(&grid.point(grid.place(index)), scratch);
                scratch.root() - SKIN.sqrt()
            })
            .collect();
        grid
    }

    fn place(&self, index: usize) -> [usize; 3] {
        [index % self.counts[0], index / self.counts[0] % self.counts[1], index / self.counts[0] / self.counts[1]]
    }

    fn point(&self, at: [usize; 3]) -> Vector3<f64> {
        self.low + Vector3::from(at.map(|v| v as f64)) * self.cell_m
    }

    /// Vertices, and quadrilaterals of them.
    fn nets(&self) -> (Vec<Vector3<f64>>, Vec<[u32; 4]>) {
        let (mut vertices, mut quads) = (Vec::new(), Vec::new());
        let mut vertex_of_cell = vec![u32::MAX; self.values.len()];
        for (index, cell) in vertex_of_cell.iter_mut().enumerate() {
            if let Some(vertex) = self.crossing(index) {
                *cell = vertices.len() as u32;
                vertices.push(vertex);
            }
        }
        for (index, value) in self.values.iter().enumerate() {
            for axis in 0..3 {
                let Some(next) = self.values.get(index + self.stride(axis)) else { continue };
                if (*value < 0.0) == (*next < 0.0) {
                    continue;
                }
                let (at, b, c) = (self.place(index), (axis + 1) % 3, (axis + 2) % 3);
                if at[axis] + 1 >= self.counts[axis] || at[b] == 0 || at[c] == 0 {
                    continue;
                }
                let (b, c) = (self.stride(b), self.stride(c));
                let mut quad = [index, index - b, index - b - c, index - c].map(|cell| vertex_of_cell[cell]);
                if *value >= 0.0 {
                    quad.reverse();
                }
                quads.push(quad);
            }
        }
        (vertices, quads)
    }

    fn stride(&self, axis: usize) -> usize {
        [1, self.counts[0], self.counts[0] * self.counts[1]][axis]
    }

    /// Mean of the crossings on the twelve edges of the cell from point `index`.
    fn crossing(&self, index: usize) -> Option<Vector3<f64>> {
        let offset = |n: usize| (n & 1) + (n >> 1 & 1) * self.stride(1) + (n >> 2) * self.stride(2);
        let values: [f64; 8] = self.values.get(index..=index + offset(7)).map(|near| std::array::from_fn(|n| near[offset(n)]))?;
        let inside = values.iter().filter(|v| **v < 0.0).count();
        let at = if inside % 8 == 0 { return None } else { self.place(index) };
        if (0..3).any(|k| at[k] + 1 >= self.counts[k]) {
            return None;
        }
        let corner = |n: usize| [at[0] + (n & 1), at[1] + (n >> 1 & 1), at[2] + (n >> 2)];
        let (mut sum, mut count) = (Vector3::zeros(), 0.0);
        for from in 0..8usize {
            for to in [from | 1, from | 2, from | 4].into_iter().filter(|to| *to != from) {
                let (a, b) = (values[from], values[to]);
                if (a < 0.0) != (b < 0.0) {
                    sum += self.point(corner(from)).lerp(&self.point(corner(to)), a / (a - b));
                    count += 1.0;
                }
            }
        }
        (count > 0.0).then(|| sum / count)
    }
}

impl Mesh {
    /// Takes off the rings that primitives leave on limbs, by Taubin's filter: waves shorter than a few cells fade, longer ones,
    /// and with them the volume, stay.
    pub fn smooth(&mut self) {
        const PASSES: usize = 40;
        let quads: Vec<[u32; 4]> = self.triangles.iter().map(|[a, b, c]| [*a, *b, *c, *a]).collect();
        let neighbours = neighbours(self.vertices.len(), &quads);
        for part in [0.5, -0.526].repeat(PASSES) {
            let drawn = |(i, v): (usize, &Vector3<f64>)| v + (mean(&neighbours[i], &self.vertices) - v) * part;
            self.vertices = self.vertices.iter().enumerate().map(drawn).collect();
        }
    }
}

/// Ends of the quadrilaterals' edges at every vertex, each once, in increasing order.
fn neighbours(vertices: usize, quads: &[[u32; 4]]) -> Vec<Vec<u32>> {
    let mut lists = vec![Vec::new(); vertices];
    for quad in quads {
        for k in 0..4 {
            let (a, b) = (quad[k], quad[(k + 1) % 4]);
            lists[a as usize].push(b);
            lists[b as usize].push(a);
        }
    }
    for (own, list) in (0u32..).zip(&mut lists) {
        list.sort_unstable();
        list.dedup();
        list.retain(|other| *other != own);
    }
    lists
}

fn mean(of: &[u32], vertices: &[Vector3<f64>]) -> Vector3<f64> {
    of.iter().map(|i| vertices[*i as usize]).sum::<Vector3<f64>>() / of.len() as f64
}

/// The point of the skin next to `x`.
fn onto(skin: &PosedSurface, mut x: Vector3<f64>, cell_m: f64, scratch: &mut Evaluation) -> Vector3<f64> {
    for _ in 0..STEPS {
        skin.evaluate_into(&x, scratch);
        let Some(normal) = scratch.gradient.try_normalize(1e-9) else { break };
        x -= normal * scratch.distance().clamp(-cell_m, cell_m);
    }
    x
}

/// Two triangles along the shorter diagonal.
fn split([a, b, c, d]: [u32; 4], vertices: &[Vector3<f64>]) -> [[u32; 3]; 2] {
    let length = |i: u32, j: u32| (vertices[i as usize] - vertices[j as usize]).norm_squared();
    if length(a, c) <= length(b, d) { [[a, b, c], [a, c, d]] } else { [[a, b, d], [b, c, d]] }
}

fn shares(skin: &PosedSurface, vertices: &[Vector3<f64>], neighbours: &[Vec<u32>]) -> Vec<Shares> {
    let mut scratch = Evaluation::default();
    let mut all: Vec<[f64; NODES]> = vertices
        .iter()
        .map(|x| {
            skin.evaluate_into(x, &mut scratch);
            let mut of_node = [0.0; NODES];
            for share in &scratch.shares {
                of_node[skin.primitives[share.primitive].node as usize] += (2.0 * (scratch.d_eff - share.unit.norm_squared())).exp();
            }
            of_node
        })
        .collect();
    for _ in 0..SMOOTH {
        let smooth = |(own, list): (&[f64; NODES], &Vec<u32>)| {
            let mean = |k: usize| list.iter().map(|i| all[*i as usize][k]).sum::<f64>() / list.len() as f64;
            std::array::from_fn(|k| 0.5 * own[k] + 0.5 * mean(k))
        };
        all = all.iter().zip(neighbours).map(smooth).collect();
    }
    all.iter().map(largest).collect()
}

fn largest(of_node: &[f64; NODES]) -> Shares {
    let mut order = Joint::ALL;
    order.sort_by(|a, b| of_node[*b as usize].total_cmp(&of_node[*a as usize]));
    let four: [Joint; 4] = std::array::from_fn(|k| order[k]);
    let sum: f64 = four.iter().map(|j| of_node[*j as usize]).sum();
    four.map(|j| (j, of_node[j as usize] / sum))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::{Shape, Surface, place};
    use std::collections::BTreeMap;

    fn person() -> (PosedSurface, Mesh) {
        let shape = Shape::template(1.75);
        let offsets = shape.offsets();
        let skin = PosedSurface::new(&Surface::new(&shape), &place(&offsets, &stance(&offsets)));
        let taken = mesh(&skin, 0.016);
        (skin, taken)
    }

    fn volume(mesh: &Mesh) -> f64 {
        let corner = |t: &[u32; 3], k: usize| mesh.vertices[t[k] as usize];
        mesh.triangles.iter().map(|t| corner(t, 0).dot(&corner(t, 1).cross(&corner(t, 2))) / 6.0).sum()
    }

    #[test]
    fn a_ball_is_a_ball() {
        let shape = Shape::template(1.7);
        let placed = place(&shape.offsets(), &Pose::rest(Vector3::new(0.3, 1.0, -0.2)));
        let skin = PosedSurface::new(&Surface::ball(Joint::Root, 0.1), &placed);
        let ball = mesh(&skin, 0.008);
        let off = ball.vertices.iter().map(|v| ((v - placed.positions[0]).norm() - 0.1).abs()).fold(0.0, f64::max);
        let exact = 4.0 / 3.0 * std::f64::consts::PI * 1e-3;
        assert!(off < 1e-7 && (volume(&ball) / exact - 1.0).abs() < 0.01, "{off} {}", volume(&ball) / exact);
        assert!(ball.shares.iter().all(|s| s[0] == (Joint::Root, 1.0) && s[1].1 == 0.0));
    }

    #[test]
    fn a_person_is_closed_whole_and_on_the_surface() {
        let (skin, taken) = person();
        let off = taken.vertices.iter().map(|v| skin.distance(v).abs()).fold(0.0, f64::max);
        assert!(off < 1e-4, "{off} m from the surface");
        // Every edge has as many triangles on one side as on the other.
        let mut edges: BTreeMap<(u32, u32), i32> = BTreeMap::new();
        let mut group: Vec<usize> = (0..taken.vertices.len()).collect();
        fn find(group: &mut [usize], mut k: usize) -> usize {
            while group[k] != k {
                group[k] = group[group[k]];
                k = group[k];
            }
            k
        }
        for [a, b, c] in &taken.triangles {
            for (a, b) in [(*a, *b), (*b, *c), (*c, *a)] {
                *edges.entry((a.min(b), a.max(b))).or_default() += if a < b { 1 } else { -1 };
                let (i, j) = (find(&mut group, a as usize), find(&mut group, b as usize));
                group[i] = j;
            }
        }
        assert!(edges.values().all(|balance| *balance == 0));
        let first = find(&mut group, 0);
        assert!((0..group.len()).all(|k| find(&mut group, k) == first), "more than one piece");
        // V − E + F = 2: no holes, no handles, so neither arms nor legs are welded.
        assert_eq!(taken.vertices.len() as i64 - edges.len() as i64 + taken.triangles.len() as i64, 2);
        // Volume by counting points of the field.
        let step = 0.01;
        let count = (0..160)
            .flat_map(|i| (0..190).flat_map(move |j| (0..60).map(move |k| [i, j, k])))
            .filter(|[i, j, k]| {
                skin.field(&(Vector3::new(f64::from(*i), f64::from(*j), f64::from(*k)) * step - Vector3::new(0.8, 0.0, 0.3))) > 0.5
            })
            .count();
        let counted = count as f64 * step * step * step;
        println!("{} vertices, {:.2} l, counted {:.2} l", taken.vertices.len(), 1e3 * volume(&taken), 1e3 * counted);
        assert!((volume(&taken) / counted - 1.0).abs() < 0.02);
    }

    #[test]
    fn limbs_go_with_their_own_joints() {
        let (skin, taken) = person();
        for (v, shares) in taken.vertices.iter().zip(&taken.shares) {
            assert!((shares.iter().map(|s| s.1).sum::<f64>() - 1.0).abs() < 1e-9 && shares.windows(2).all(|w| w[0].1 >= w[1].1));
            let nearest = skin.primitives.iter().min_by(|a, b| (a.centre - v).norm().total_cmp(&(b.centre - v).norm())).unwrap();
            let side = |j: Joint| j.name().starts_with("l_") as i32 - j.name().starts_with("r_") as i32;
            // Far from the middle nothing follows the other side.
            if v.x.abs() > 0.05 && side(nearest.node) != 0 {
                assert!(shares.iter().all(|(j, w)| *w < 0.1 || side(*j) * side(nearest.node) >= 0), "{v:?} {shares:?}");
            }
        }
    }

    #[test]
    fn the_stance_stands_flat() {
        let offsets = Shape::template(1.8).offsets();
        let placed = place(&offsets, &stance(&offsets));
        let rest = place(&offsets, &Pose::rest(offsets[0]));
        for joint in [Joint::LAnkle, Joint::RAnkle] {
            assert!(placed.world_from_node[joint as usize].angle() < 1e-9);
            assert!((placed.position(joint).y - rest.position(joint).y).abs() < 1e-12);
        }
        assert!(placed.position(Joint::LWrist).x > rest.position(Joint::LWrist).x + 0.2);
    }
}
