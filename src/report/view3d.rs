//! Cloud, body and skeleton over time, to turn about: `plotly` draws when the reader opens it.
//!
//! The page holds per frame only the nodes' places and turns and the thinned cloud in millimetres; its script moves the
//! body's primitives, drawn as ellipsoids that reach the skin. plotly's script is text until the view is opened, so that
//! pages load at once.

use maud::{Markup, PreEscaped, html};
use nalgebra::{UnitQuaternion, Vector3};
use serde_json::{Value, json};

use crate::body::{Joint, Placement, Pose, PosedSurface, Shape, Surface, place};
use crate::rig::Up;

const SCRIPT: &str = include_str!("view3d.js");
/// More frames and points make pages heavy, not clearer.
const FRAMES: usize = 24;
const POINTS: usize = 400;
/// Points farther from the root are no part of the person.
const REACH_M: f64 = 1.3;
/// Half the length of an ellipsoid along its limb, of the primitive's semi-axis, which is how far neighbours stand apart.
const ALONG: f64 = 1.0;

/// One instant.
pub struct Instant<'a> {
    pub label: String,
    pub placement: &'a Placement,
    pub points: Vec<Vector3<f64>>,
}

/// What is shown; `towards_viewer` is where the reader stands at first, seen from the body.
pub struct View<'a> {
    pub shape: &'a Shape,
    pub up: Up,
    pub towards_viewer: Vector3<f64>,
    pub instants: Vec<Instant<'a>>,
}

/// At most [`FRAMES`] of `count` frames, evenly spread.
pub fn shown(count: usize) -> Vec<usize> {
    let n = count.min(FRAMES);
    (0..n).map(|i| if n > 1 { i * (count - 1) / (n - 1) } else { 0 }).collect()
}

/// The view, closed, with its script.
pub fn view(view: &View) -> Markup {
    let last = view.instants.len().saturating_sub(1);
    html! {
        details.interactive id="view3d" {
            summary { "Turn it about: cloud, body and skeleton over time" }
            div.view id="view3d-plot" {}
            div.controls {
                button id="view3d-play" type="button" { "Play" }
                label for="view3d-time" { "Frame" }
                input id="view3d-time" type="range" min="0" max=(last) value="0" step="1";
                output id="view3d-label" for="view3d-time" {}
            }
        }
        script type="application/json" id="view3d-scene" { (PreEscaped(inert(&scene(view)))) }
        script type="text/plain" id="view3d-library" { (PreEscaped(library())) }
        script { (PreEscaped(SCRIPT)) }
    }
}

/// plotly's script alone; the crate offers it with a typesetter that nothing here needs.
fn library() -> String {
    let all = plotly::Plot::offline_js_sources();
    let start = all.find("<script").and_then(|at| Some(at + all[at..].find('>')? + 1)).unwrap_or(0);
    let end = all[start..].find("</script>").map_or(all.len(), |at| start + at);
    all[start..end].to_string()
}

/// JSON that cannot end its script.
fn inert(value: &Value) -> String {
    value.to_string().replace('<', "\\u003c")
}

fn scene(view: &View) -> Value {
    let side = |joint: Joint| match joint.name().as_bytes() {
        [b'l', b'_', ..] => 0,
        [b'r', b'_', ..] => 1,
        _ => 2,
    };
    let bones: Vec<[usize; 3]> = Joint::ALL.into_iter().filter_map(|j| Some([j.parent()? as usize, j as usize, side(j)])).collect();
    let instants: Vec<Value> = view.instants.iter().map(instant).collect();
    let up = view.up.direction();
    json!({
        "up": [up.x, up.y, up.z],
        "eye": eye(&view.towards_viewer, &up),
        "bones": bones,
        "body": ellipsoids(view.shape).iter().map(numbers).collect::<Vec<_>>(),
        "instants": instants,
    })
}

/// Above the horizon a little, at plotly's distance.
fn eye(towards_viewer: &Vector3<f64>, up: &Vector3<f64>) -> [f64; 3] {
    let level = (towards_viewer - up * towards_viewer.dot(up)).try_normalize(1e-9).unwrap_or_else(|| up.yzx());
    let eye = level * 1.75 + up * 0.35;
    [eye.x, eye.y, eye.z].map(|v| (v * 1000.0).round() / 1000.0)
}

fn millimetres<'a>(points: impl Iterator<Item = &'a Vector3<f64>>) -> Vec<i64> {
    points.flat_map(|p| [p.x, p.y, p.z]).map(|v| (1000.0 * v).round() as i64).collect()
}

fn instant(instant: &Instant) -> Value {
    let root = instant.placement.positions[0];
    let near: Vec<&Vector3<f64>> = instant.points.iter().filter(|p| (*p - root).norm() < REACH_M).collect();
    let step = near.len().div_ceil(POINTS).max(1);
    let turn = |q: &UnitQuaternion<f64>| [q.i, q.j, q.k, q.w].map(|v| (v * 1e4).round() / 1e4);
    json!({
        "label": instant.label,
        "nodes": millimetres(instant.placement.positions.iter()),
        "turns": instant.placement.world_from_node.iter().flat_map(turn).collect::<Vec<f64>>(),
        "cloud": millimetres(near.into_iter().step_by(step)),
    })
}

/// A primitive of the body as a solid that reaches the skin, metres, in the frame of its node.
pub struct Ellipsoid {
    pub node: Joint,
    pub centre: Vector3<f64>,
    pub half_axes: Vector3<f64>,
}

/// One for every primitive.
pub fn ellipsoids(shape: &Shape) -> Vec<Ellipsoid> {
    let surface = Surface::new(shape);
    let offsets = shape.offsets();
    let posed = PosedSurface::new(&surface, &place(&offsets, &Pose::rest(offsets[0])));
    let reach = |k: usize, axis: usize| {
        let (primitive, centre) = (&surface.primitives[k], posed.primitives[k].centre);
        let own = primitive.semi_axes[axis];
        if axis == primitive.axis {
            return ALONG * own;
        }
        let mut radius = 0.6 * own;
        for _ in 0..6 {
            // At rest the nodes' axes are the world's.
            let gap = posed.distance(&(centre + Vector3::ith(axis, radius))).max(posed.distance(&(centre - Vector3::ith(axis, radius))));
            radius = (radius - gap).clamp(0.4 * own, 1.1 * own);
        }
        radius
    };
    let ellipsoid = |k: usize| {
        let p = &surface.primitives[k];
        Ellipsoid { node: p.node, centre: p.centre, half_axes: Vector3::from_fn(|axis, _| reach(k, axis)) }
    };
    (0..surface.primitives.len()).map(ellipsoid).collect()
}

/// Node, centre and half axes, millimetres.
fn numbers(e: &Ellipsoid) -> Vec<f64> {
    let metres = e.centre.iter().chain(&e.half_axes);
    std::iter::once(e.node as usize as f64).chain(metres.map(|v| (1e4 * v).round() / 10.0)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_spread_from_first_to_last() {
        assert_eq!(shown(0), Vec::<usize>::new());
        assert_eq!(shown(1), [0]);
        assert_eq!(shown(3), [0, 1, 2]);
        let many = shown(100);
        assert_eq!((many.len(), many[0], many[FRAMES - 1]), (FRAMES, 0, 99));
    }

    #[test]
    fn ellipsoids_touch_the_skin() {
        let shape = Shape::template(1.75);
        let posed = PosedSurface::new(&Surface::new(&shape), &place(&shape.offsets(), &Pose::rest(shape.offsets()[0])));
        let mut near = 0;
        let all = ellipsoids(&shape);
        for (e, p) in all.iter().zip(&posed.primitives) {
            for axis in (0..3).filter(|a| *a != p.axis) {
                let tip = p.centre + Vector3::ith(axis, e.half_axes[axis]);
                near += usize::from(posed.distance(&tip).abs() < 0.03);
            }
        }
        assert!(near * 10 > all.len() * 2 * 8, "{near} of {}", 2 * all.len());
    }

    #[test]
    fn the_scene_cannot_end_its_script_and_the_library_is_whole() {
        assert_eq!(inert(&json!({ "label": "</script><b>" })), "{\"label\":\"\\u003c/script>\\u003cb>\"}");
        let library = library();
        assert!(library.contains("plotly.js v") && library.len() > 1_000_000 && !library.contains("</script"));
    }
}
