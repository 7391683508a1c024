//! A person over a photograph as lines that stay sharp: the skeleton and the body's outline as SVG on the embedded picture.

use std::fmt::Write;

use image::{GrayImage, RgbImage, imageops};
use maud::{Markup, html};
use nalgebra::Vector3;

use super::ReportError;
use super::overlay::outlines;
use super::page::jpeg_uri;
use crate::body::{Joint, NODES};
use crate::rig::Camera;

/// Room around the person, px.
const MARGIN_PX: f64 = 36.0;
/// Every so many points of an outline are enough.
const THIN: usize = 3;

/// Part of a camera's picture: left, top, width, height in px.
pub type Crop = [u32; 4];

/// Where the joints of a body lie in a camera's picture: low and high corner; `None` where it is out of view.
fn bounds(camera: &Camera, body: &[Vector3<f64>; NODES]) -> Option<[f64; 4]> {
    let [width, height] = camera.size_px.map(f64::from);
    let seen = body.iter().filter_map(|x| camera.project(x)).filter(|p| (0.0..width).contains(&p.x) && (0.0..height).contains(&p.y));
    let none = [f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY];
    let found = seen.fold(none, |[a, b, c, d], p| [a.min(p.x), b.min(p.y), c.max(p.x), d.max(p.y)]);
    (found[0] <= found[2]).then_some(found)
}

/// Parts of a camera's picture, all of one size, each around one of the bodies; the whole picture for a body out of view.
pub fn crops(camera: &Camera, bodies: &[&[Vector3<f64>; NODES]]) -> Vec<Crop> {
    let [width, height] = camera.size_px.map(f64::from);
    let found: Vec<Option<[f64; 4]>> = bodies.iter().map(|body| bounds(camera, body)).collect();
    let reach = |low: usize, most: f64| {
        let widest = found.iter().flatten().map(|b| b[low + 2] - b[low]).fold(0.0, f64::max);
        (widest + 2.0 * MARGIN_PX).ceil().min(most)
    };
    let size = [reach(0, width), reach(1, height)];
    let one = |bounds: &Option<[f64; 4]>| {
        let Some(b) = bounds else { return [0, 0, camera.size_px[0], camera.size_px[1]] };
        let start = |k: usize, most: f64| (0.5 * (b[k] + b[k + 2] - size[k])).clamp(0.0, most - size[k]) as u32;
        [start(0, width), start(1, height), size[0] as u32, size[1] as u32]
    };
    found.iter().map(one).collect()
}

/// A crop of the picture with the skeleton at `positions` and the outline of `mask`.
pub fn figure(
    picture: &GrayImage,
    camera: &Camera,
    positions: &[Vector3<f64>; NODES],
    mask: &GrayImage,
    [left, top, width, height]: Crop,
    caption: &str,
) -> Result<Markup, ReportError> {
    let part = imageops::crop_imm(picture, left, top, width, height).to_image();
    let colour = RgbImage::from_fn(part.width(), part.height(), |x, y| image::Rgb([part.get_pixel(x, y)[0]; 3]));
    let (width, height) = colour.dimensions();
    // The picture's pixel centres are at integers, the drawing's pixel edges.
    let at = |x: f64, y: f64| [x + 0.5 - f64::from(left), y + 0.5 - f64::from(top)];
    let nodes = positions.map(|x| camera.project(&x).map(|p| at(p.x, p.y)).filter(|p| p.iter().all(|v| v.abs() < 1e5)));
    Ok(html! {
        figure {
            div.person {
                img src=(jpeg_uri(&colour)?) alt=(caption) width=(width) height=(height);
                svg viewBox={ "0 0 " (width) " " (height) } aria-hidden="true" {
                    path.outline d=(outline(mask, &at)?) {}
                    (skeleton(&nodes))
                }
            }
            figcaption { (caption) }
        }
    })
}

fn outline(mask: &GrayImage, at: &dyn Fn(f64, f64) -> [f64; 2]) -> Result<String, ReportError> {
    let mut text = String::new();
    for contour in outlines(mask, mask.width(), mask.height())? {
        for (k, p) in contour.iter().step_by(THIN).enumerate() {
            let [x, y] = at(f64::from(p.x), f64::from(p.y));
            // Writing to a string cannot fail.
            let _ = write!(text, "{}{x:.0} {y:.0}", if k == 0 { 'M' } else { 'L' });
        }
        text.push('Z');
    }
    Ok(text)
}

fn side(joint: Joint) -> &'static str {
    match joint.name().as_bytes() {
        [b'l', b'_', ..] => "left",
        [b'r', b'_', ..] => "right",
        _ => "middle",
    }
}

fn skeleton(nodes: &[Option<[f64; 2]>; NODES]) -> Markup {
    let bones: Vec<_> =
        Joint::ALL.into_iter().filter_map(|joint| Some((side(joint), nodes[joint.parent()? as usize]?, nodes[joint as usize]?))).collect();
    let path = |which: &str| {
        let own = bones.iter().filter(|b| which.is_empty() || b.0 == which);
        own.fold(String::new(), |mut text, (_, a, b)| {
            let _ = write!(text, "M{:.1} {:.1}L{:.1} {:.1}", a[0], a[1], b[0], b[1]);
            text
        })
    };
    html! {
        path.rim d=(path("")) {}
        @for which in ["middle", "left", "right"] { path class={ "bone " (which) } d=(path(which)) {} }
        @for (which, _, b) in &bones { circle class={ "joint " (which) } cx=(tenth(b[0])) cy=(tenth(b[1])) r="2.6" {} }
    }
}

fn tenth(v: f64) -> f64 {
    (v * 10.0).round() / 10.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::body::{Pose, Shape, Surface, place};
    use crate::phantom::silhouette;
    use nalgebra::{Matrix3, Rotation3};

    #[test]
    fn the_person_fills_the_crop_and_each_side_has_its_class() {
        let camera = Camera {
            name: "c".into(),
            size_px: [640, 480],
            matrix: Matrix3::new(500.0, 0.0, 320.0, 0.0, 500.0, 240.0, 0.0, 0.0, 1.0),
            lens: crate::rig::Lens::IDEAL,
            camera_from_world: Rotation3::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI),
            translation: Vector3::new(0.0, 0.9, 4.0),
        };
        let shape = Shape::template(1.7);
        let placed = place(&shape.offsets(), &Pose::rest(shape.offsets()[0]));
        let mut farther = placed.positions;
        farther.iter_mut().for_each(|x| x.x += 0.6);
        let parts = crops(&camera, &[&placed.positions, &farther]);
        let part = parts[0];
        // 1.55 m of joints at 4 m are 194 px high; 0.6 m there are 75 px.
        assert!((200..280).contains(&part[3]) && part[2] < 160 && parts[1][2..] == part[2..], "{parts:?}");
        assert!((74..=76).contains(&(parts[1][0] - part[0])) && parts[1][1] == part[1], "{parts:?}");
        let mask = silhouette(&Surface::new(&shape), &shape.offsets(), &placed, &camera);
        let text = figure(&GrayImage::new(640, 480), &camera, &placed.positions, &mask, part, "a < b").unwrap().into_string();
        let knee = camera.project(&placed.position(Joint::LKnee)).unwrap();
        let at = [knee.x + 0.5 - f64::from(part[0]), knee.y + 0.5 - f64::from(part[1])].map(tenth);
        assert!(text.contains(&format!("class=\"joint left\" cx=\"{}\" cy=\"{}\"", at[0], at[1])), "{text}");
        assert!(text.contains("a &lt; b") && text.matches("class=\"joint").count() == NODES - 1);
        let behind = Camera { translation: Vector3::new(0.0, 0.9, -4.0), ..camera };
        assert_eq!(crops(&behind, &[&placed.positions]), [[0, 0, 640, 480]]);
    }
}
