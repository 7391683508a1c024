//! Maps of values as colours with a labelled bar.

use image::{ImageBuffer, Luma, Rgb, RgbImage};
use opencv::core::{Mat, MatTraitConstManual, Vec3b};
use opencv::imgproc;

use super::ReportError;
use super::canvas::{Align, Canvas, Colour, INK, WHITE, tick_label, ticks};
use crate::math::order::quantile;

/// Where there is no value.
const NOTHING: Colour = [214, 214, 214];

/// A map of values (one per pixel; NaN or infinite: no value, light grey) from `range.0`, dark, to `range.1`, bright, with
/// a title above and a bar labelled `unit` at the right. Values beyond the range take the colour of its end.
pub fn depth_map(values: &ImageBuffer<Luma<f32>, Vec<f32>>, range: (f64, f64), title: &str, unit: &str) -> Result<RgbImage, ReportError> {
    const TOP: u32 = 44;
    const EDGE: u32 = 12;
    const BAR: u32 = 150;
    let colours = viridis()?;
    let (width, height) = values.dimensions();
    let mut canvas = Canvas::new(width + EDGE + BAR, height + TOP + EDGE, WHITE);
    let span = (range.1 - range.0).max(1e-12);
    let map = RgbImage::from_fn(width, height, |x, y| {
        let value = f64::from(values.get_pixel(x, y)[0]);
        let place = ((value - range.0) / span * 255.0).clamp(0.0, 255.0);
        Rgb(if value.is_finite() { colours[place.round() as usize] } else { NOTHING })
    });
    canvas.paste(&map, EDGE, TOP);
    canvas.text([f64::from(EDGE), 28.0], title, 12.0, INK, Align::Left)?;
    // The bar leaves room for the "none" patch below.
    let (left, bottom) = (width + EDGE + 20, TOP + height * 85 / 100);
    let bar_height = bottom.saturating_sub(TOP + 24).max(1);
    for row in 0..bar_height {
        let place = 255 * (bar_height - 1 - row) / (bar_height - 1).max(1);
        canvas.rectangle(left, TOP + 24 + row, 20, 1, colours[place as usize]);
    }
    canvas.text([f64::from(left), f64::from(TOP) + 12.0], unit, 10.0, INK, Align::Left)?;
    let marks = ticks(range.0, range.1, 5);
    for mark in &marks {
        let y = f64::from(bottom) - (mark - range.0) / span * f64::from(bar_height);
        canvas.line([f64::from(left) + 20.0, y], [f64::from(left) + 26.0, y], INK, 1)?;
        canvas.text([f64::from(left) + 32.0, y + 5.0], &tick_label(*mark, &marks), 10.0, INK, Align::Left)?;
    }
    canvas.rectangle(left, bottom + 16, 20, 14, NOTHING);
    canvas.text([f64::from(left) + 32.0, f64::from(bottom) + 28.0], "no value", 10.0, INK, Align::Left)?;
    Ok(canvas.picture)
}

/// Room around the person in a depth picture, px.
const MARGIN_PX: u32 = 60;

/// Where a map of depths in metres has values, twice as large, from the first to the last hundredth of the values.
pub fn person_depth(depth: &ImageBuffer<Luma<f32>, Vec<f32>>, title: &str) -> Result<RgbImage, ReportError> {
    let values = || depth.enumerate_pixels().filter(|(_, _, d)| d.0[0].is_finite());
    let bounds = |at: fn((u32, u32)) -> u32, size: u32| {
        let (low, high) = values().map(|(x, y, _)| at((x, y))).fold((size, 0), |(low, high), v| (low.min(v), high.max(v)));
        (low.saturating_sub(MARGIN_PX), (high + MARGIN_PX).min(size))
    };
    let ((left, right), (top, bottom)) = (bounds(|p| p.0, depth.width()), bounds(|p| p.1, depth.height()));
    let (width, height) = (right.saturating_sub(left).max(1), bottom.saturating_sub(top).max(1));
    let inside = |x: u32, y: u32| depth.get_pixel_checked(left + x / 2, top + y / 2).copied().unwrap_or(Luma([f32::NAN]));
    let large = ImageBuffer::from_fn(2 * width, 2 * height, inside);
    let sorted: Vec<f64> = values().map(|(_, _, d)| f64::from(d.0[0])).collect();
    let at = |part: f64| quantile(sorted.clone(), part).unwrap_or(1.0);
    depth_map(&large, (at(0.01), at(0.99)), title, "m")
}

/// The 256 colours of viridis: even steps of lightness, also for colour-blind readers and in black and white.
fn viridis() -> Result<Vec<Colour>, ReportError> {
    let ramp: Vec<u8> = (0..=255).collect();
    let mut coloured = Mat::default();
    imgproc::apply_color_map(&Mat::new_rows_cols_with_bytes::<u8>(1, 256, &ramp)?, &mut coloured, imgproc::COLORMAP_VIRIDIS)?;
    // OpenCV's pictures are BGR.
    Ok(coloured.data_typed::<Vec3b>()?.iter().map(|c| [c[2], c[1], c[0]]).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_have_viridis_colours_and_holes_are_grey() {
        let mut values = ImageBuffer::from_pixel(200, 120, Luma([2.0f32]));
        values.put_pixel(10, 10, Luma([5.0]));
        values.put_pixel(11, 10, Luma([f32::NAN]));
        values.put_pixel(12, 10, Luma([f32::INFINITY]));
        values.put_pixel(13, 10, Luma([3.5]));
        let picture = depth_map(&values, (2.0, 5.0), "depth", "m").unwrap();
        let at = |x: u32, y: u32| picture.get_pixel(12 + x, 44 + y).0;
        // The table's published ends and middle (Smith and van der Walt).
        for (found, expected) in [(at(0, 0), [68, 1, 84]), (at(10, 10), [253, 231, 37]), (at(13, 10), [33, 145, 140])] {
            assert!(found.iter().zip(expected).all(|(a, b): (&u8, i32)| (i32::from(*a) - b).abs() <= 2), "{found:?} {expected:?}");
        }
        assert_eq!((at(11, 10), at(12, 10)), (NOTHING, NOTHING));
    }

    #[test]
    fn the_person_alone_is_shown() {
        let mut depth = ImageBuffer::from_pixel(640, 480, Luma([f32::NAN]));
        assert!(person_depth(&depth, "t").is_ok());
        (0..100).for_each(|y| (0..40).for_each(|x| depth.put_pixel(300 + x, 150 + y, Luma([2.0 + 0.01 * y as f32]))));
        let picture = person_depth(&depth, "t").unwrap();
        // 39 + 120 by 99 + 120 px, twice, with title and bar.
        assert_eq!(picture.dimensions(), (2 * 159 + 162, 2 * 219 + 56));
    }
}
