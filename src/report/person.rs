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

/// The part of a camera's picture that holds these bodies; the whole picture where none is in it.
pub fn crop<'a>(camera: &Camera, bodies: impl Iterator<Item = &'a [Vector3<f64>; NODES]>) -> Crop {
    let [width, height] = camera.size_px.map(f64::from);
    let seen = bodies.flatten().filter_map(|x| camera.project(x)).filter(|p| (0.0..width).contains(&p.x) && (0.0..height).contains(&p.y));
    let none = [f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY];
    let [x0, y0, x1, y1] = seen.fold(none, |[a, b, c, d], p| [a.min(p.x), b.min(p.y), c.max(p.x), d.max(p.y)]);
    if x0 > x1 {
        return [0, 0, camera.size_px[0], camera.size_px[1]];
    }
    let (left, top) = ((x0 - MARGIN_PX).max(0.0), (y0 - MARGIN_PX).max(0.0));
    let (right, bottom) = ((x1 + MARGIN_PX).min(width), (y1 + MARGIN_PX).min(height));
    [left as u32, top as u32, (right - left).ceil() as u32, (bottom - top).ceil() as u32]
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
        let part = crop(&camera, std::iter::once(&placed.positions));
        // 1.55 m of joints at 4 m are 194 px high.
        assert!((200..280).contains(&part[3]) && part[2] < 160, "{part:?}");
        let mask = silhouette(&Surface::new(&shape), &shape.offsets(), &placed, &camera);
        let text = figure(&GrayImage::new(640, 480), &camera, &placed.positions, &mask, part, "a < b").unwrap().into_string();
        let knee = camera.project(&placed.position(Joint::LKnee)).unwrap();
        let at = [knee.x + 0.5 - f64::from(part[0]), knee.y + 0.5 - f64::from(part[1])].map(tenth);
        assert!(text.contains(&format!("class=\"joint left\" cx=\"{}\" cy=\"{}\"", at[0], at[1])), "{text}");
        assert!(text.contains("a &lt; b") && text.matches("class=\"joint").count() == NODES - 1);
        let behind = Camera { translation: Vector3::new(0.0, 0.9, -4.0), ..camera };
        assert_eq!(crop(&behind, std::iter::once(&placed.positions)), [0, 0, 640, 480]);
    }
}
