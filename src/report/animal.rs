//! Pictures of the animal pipeline, after the figures of Favreau et al. (2004).

use image::{GrayImage, Rgb, RgbImage, imageops};

use super::ReportError;
use super::canvas::{Align, Canvas, GRID, INK, LEFT, PALETTE, RIGHT, WHITE, faded, tick_label, ticks};
use super::curves::{Curve, curves};
use super::overlay::{outlines, strip};
use crate::animal::eigen::Eigenimages;
use crate::animal::rhythm::Rhythm;
use crate::math::spectrum::amplitudes;

/// Figures 7 and 8: mean minus component, mean, mean plus component, one row each.
pub fn eigenimages(eigen: &Eigenimages, components: usize) -> Result<RgbImage, ReportError> {
    let rows = components.min(eigen.images.ncols());
    let tiles: Vec<(RgbImage, String)> = (0..rows)
        .flat_map(|k| [(-1.0, '-'), (0.0, ' '), (1.0, '+')].map(|(a, sign)| (k, a, sign)))
        .map(|(k, a, sign)| {
            let caption = if a == 0.0 { "mean".into() } else { format!("mean {sign} PC{} ({:.1} %)", k + 1, 100.0 * eigen.explained(k)) };
            (colour(&eigen.picture(k, a)), caption)
        })
        .collect();
    strip(&tiles, 3, 280)
}

pub fn colour(mask: &GrayImage) -> RgbImage {
    RgbImage::from_fn(mask.width(), mask.height(), |x, y| Rgb([mask.get_pixel(x, y)[0]; 3]))
}

/// Figure 3: the frames in the plane of the first two components; keys as discs with their numbers, alternates as rings.
pub fn plane(points: &[Vec<f64>], keys: &[usize], alternates: &[usize]) -> Result<RgbImage, ReportError> {
    const SIDE: f64 = 760.0;
    const MARGIN: f64 = 70.0;
    let mut canvas = Canvas::new(SIDE as u32, SIDE as u32, WHITE);
    let reach = points.iter().flat_map(|p| p.iter().take(2)).fold(0.5f64, |m, v| m.max(v.abs())) * 1.12;
    let at = |x: f64, y: f64| [SIDE / 2.0 + x / reach * (SIDE / 2.0 - MARGIN), SIDE / 2.0 - y / reach * (SIDE / 2.0 - MARGIN)];
    let marks = ticks(-reach, reach, 6);
    for mark in &marks {
        canvas.line(at(*mark, -reach), at(*mark, reach), GRID, 1)?;
        canvas.line(at(-reach, *mark), at(reach, *mark), GRID, 1)?;
        let (below, left) = (at(*mark, -reach), at(-reach, *mark));
        canvas.text([below[0], below[1] + 22.0], &tick_label(*mark, &marks), 10.0, INK, Align::Centre)?;
        canvas.text([left[0] - 8.0, left[1] + 5.0], &tick_label(*mark, &marks), 10.0, INK, Align::Right)?;
    }
    canvas.text([SIDE / 2.0, SIDE - 16.0], "PC1 (standard deviations)", 11.0, INK, Align::Centre)?;
    canvas.text([MARGIN - 50.0, 34.0], "PC2 (standard deviations)", 11.0, INK, Align::Left)?;
    let place = |f: usize| points.get(f).map(|p| at(p.first().copied().unwrap_or(0.0), p.get(1).copied().unwrap_or(0.0)));
    let path: Vec<[f64; 2]> = (0..points.len()).filter_map(place).collect();
    canvas.polyline(&path, faded(LEFT, 0.55), 2, false)?;
    for p in &path {
        canvas.disc(*p, 3.0, faded(LEFT, 0.2))?;
    }
    for (frames, colour, filled) in [(alternates, PALETTE[2], false), (keys, RIGHT, true)] {
        for frame in frames {
            let Some(p) = place(*frame) else { continue };
            if filled {
                canvas.disc(p, 8.0, colour)?
            } else {
                canvas.circle(p, 10.0, colour, 3)?
            }
            let away = (p[0] - SIDE / 2.0).hypot(p[1] - SIDE / 2.0).max(1.0);
            let label = [0, 1].map(|k| p[k] + (p[k] - SIDE / 2.0) / away * 22.0);
            canvas.text([label[0], label[1] + 5.0], &frame.to_string(), 11.0, colour, Align::Centre)?;
        }
    }
    Ok(canvas.picture)
}

/// Figure 9: amplitudes of the first three components, the peak function and the band.
pub fn spectrum(eigen: &Eigenimages, rhythm: &Rhythm, fps: f64) -> Result<RgbImage, ReportError> {
    let n = eigen.frames() as f64;
    let mut series: Vec<Curve> = Vec::new();
    let mut top = 0.0f64;
    for k in 0..3.min(eigen.coefficients.ncols()) {
        let amplitude: Vec<f64> = amplitudes(&eigen.series(k)).iter().map(|a| 2.0 * a / n).collect();
        top = amplitude.iter().copied().fold(top, f64::max);
        let points = amplitude.iter().enumerate().map(|(i, a)| [i as f64 * fps / n, *a]).collect();
        let r = rhythm.correlations.get(k).map_or_else(String::new, |r| format!(" (r = {r:.2})"));
        series.push(Curve { label: format!("PC{}{r}", k + 1), points, dashed: false, colour: k, band: Vec::new() });
    }
    if let Some(peak) = &rhythm.peak {
        let height = series[0].points.iter().map(|p| p[1]).fold(0.0, f64::max);
        let grid = (0..=400).map(|i| i as f64 / 400.0 * n / 2.0);
        let points = grid.map(|bin| [bin * fps / n, height * peak.at(bin)]).collect();
        series.push(Curve { label: "peak".into(), points, dashed: true, colour: 6, band: Vec::new() });
        let [low, high] = peak.band.map(|b| b * fps / n);
        let points = vec![[low, 0.0], [low, 1.03 * top], [high, 1.03 * top], [high, 0.0]];
        series.push(Curve { label: "band".into(), points, dashed: true, colour: 5, band: Vec::new() });
    }
    let title = match rhythm.period_frames {
        Some(period) => format!("spectrum: {:.2} Hz, a silhouette every {period:.1} frames, {}", fps / period, rhythm.verdict.words()),
        None => format!("spectrum: no peak, {}", rhythm.verdict.words()),
    };
    curves(&title, "frequency (Hz)", "amplitude (standard deviations)", &series)
}

/// Coefficients over time; with a filter, filtered ones dashed.
pub fn coefficients(eigen: &Eigenimages, filtered: Option<&[Vec<f64>]>, fps: f64) -> Result<RgbImage, ReportError> {
    let time = |values: Vec<f64>| values.into_iter().enumerate().map(|(t, v)| [t as f64 / fps, v]).collect();
    let mut series: Vec<Curve> = (0..2.min(eigen.coefficients.ncols()))
        .map(|k| Curve { label: format!("PC{}", k + 1), points: time(eigen.series(k)), dashed: false, colour: k, band: Vec::new() })
        .collect();
    if let Some(points) = filtered {
        for k in 0..series.len() {
            let values = points.iter().filter_map(|p| p.get(k).copied()).collect();
            series.push(Curve { label: format!("PC{} filtered", k + 1), points: time(values), dashed: true, colour: k, band: Vec::new() });
        }
    }
    curves("coefficients of the silhouettes", "time (s)", "standard deviations", &series)
}

/// Figure 10: the weight of every key pose over time, and their sum dashed; a second half of the keys in the colours of the
/// first, dashed.
pub fn weights(rows: &[Vec<f64>], keys: &[usize], fps: f64) -> Result<RgbImage, ReportError> {
    let over_time = |f: &dyn Fn(&[f64]) -> f64| rows.iter().enumerate().map(|(t, r)| [t as f64 / fps, f(r)]).collect();
    let half = if keys.len() > 6 { keys.len() / 2 } else { keys.len() };
    let mut series: Vec<Curve> = keys
        .iter()
        .enumerate()
        .map(|(k, frame)| Curve {
            label: format!("{frame}"),
            points: over_time(&|r| r[k]),
            dashed: k >= half,
            colour: k % half.max(1),
            band: Vec::new(),
        })
        .collect();
    series.push(Curve { label: "sum".into(), points: over_time(&|r| r.iter().sum()), dashed: true, colour: 6, band: Vec::new() });
    curves("weights of the key poses, by the keys' frames", "time (s)", "weight", &series)
}

/// A frame with the outline of its silhouette.
pub fn outlined(frame: &RgbImage, mask: &GrayImage) -> Result<RgbImage, ReportError> {
    let mut canvas = Canvas { picture: frame.clone() };
    let width = (frame.width() / 300).max(1) as i32;
    canvas.contours(&outlines(mask, frame.width(), frame.height())?, [240, 60, 30], width)?;
    Ok(canvas.picture)
}

/// Up to `count` frames of a clip with their outlines, evenly spread.
pub fn mask_sheet(frames: &[RgbImage], masks: &[GrayImage], count: usize) -> Result<RgbImage, ReportError> {
    let n = frames.len().min(masks.len());
    let shown: Vec<usize> = (0..count.min(n)).map(|i| i * n / count.min(n)).collect();
    let tiles =
        shown.iter().map(|t| Ok((outlined(&frames[*t], &masks[*t])?, format!("frame {t}")))).collect::<Result<Vec<_>, ReportError>>()?;
    strip(&tiles, 4, 320)
}

/// Figure 11: key images in the upper row of each block, the poses below, `columns` abreast.
pub fn keys_and_poses(images: &[(RgbImage, String)], poses: &[RgbImage], columns: usize) -> Result<RgbImage, ReportError> {
    let mut tiles = Vec::new();
    for (block, pictures) in images.chunks(columns).enumerate() {
        tiles.extend(pictures.iter().cloned());
        tiles.extend(
            (pictures.len()..columns).filter(|_| images.len() > columns).map(|_| (RgbImage::from_pixel(4, 3, Rgb(WHITE)), String::new())),
        );
        tiles.extend(poses.iter().skip(block * columns).take(pictures.len()).map(|p| (p.clone(), "pose".to_string())));
    }
    strip(&tiles, columns.min(images.len()), 240)
}

/// A silhouette's window enlarged to a readable tile.
pub fn tile(mask: &GrayImage) -> RgbImage {
    let factor = (240 / mask.width().max(1)).max(1);
    imageops::resize(&colour(mask), mask.width() * factor, mask.height() * factor, imageops::FilterType::Nearest)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::animal::analysis::analyse;
    use crate::animal::horse::{Gait, horse, posture};
    use crate::animal::render::{View, silhouette};

    #[test]
    fn every_figure_shows_what_it_is_for() {
        let horse = horse();
        let view = View::side(&horse, [160, 120]);
        let masks: Vec<GrayImage> =
            (0..40).map(|t| silhouette(&horse, &posture(&horse, Gait::Canter, f64::from(t) / 16.0), &view)).collect();
        let found = analyse(&masks, false, 0).unwrap();
        let points = found.rhythm.points(&found.eigen, 2, true);
        let sheet = eigenimages(&found.eigen, 3).unwrap();
        assert_eq!(sheet.width(), 3 * 288 + 8);
        let drawn = plane(&points, &[3, 7], &[12]).unwrap();
        let count = |picture: &RgbImage, c: [u8; 3]| picture.pixels().filter(|p| p.0 == c).count();
        assert!(count(&drawn, RIGHT) > 250 && count(&drawn, PALETTE[2]) > 60 && count(&drawn, faded(LEFT, 0.2)) > 200);
        assert!(count(&spectrum(&found.eigen, &found.rhythm, 25.0).unwrap(), PALETTE[0]) > 300);
        let rows: Vec<Vec<f64>> = (0..40).map(|t| vec![(f64::from(t) / 6.0).sin(), 0.4]).collect();
        assert!(count(&weights(&rows, &[3, 7], 25.0).unwrap(), PALETTE[1]) > 300);
        assert!(count(&coefficients(&found.eigen, Some(&points), 25.0).unwrap(), PALETTE[1]) > 300);
        let frames = vec![RgbImage::from_pixel(160, 120, Rgb([9, 9, 9])); 40];
        let outline = mask_sheet(&frames, &masks, 8).unwrap();
        assert!(outline.pixels().filter(|p| p[0] > 150 && p[1] < 110).count() > 1000);
        let tiles: Vec<_> = masks[..2].iter().map(|m| (tile(m), "frame".to_string())).collect();
        assert_eq!(keys_and_poses(&tiles, &[colour(&masks[0]), colour(&masks[1])], 4).unwrap().width(), 2 * 248 + 8);
    }
}
