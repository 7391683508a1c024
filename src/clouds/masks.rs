//! Small morphology on 0/255 masks. Checked against cv::connectedComponents and cv::blur.

use image::{GrayImage, Luma};

/// Connected pieces (4-neighbourhood) of the pixels that satisfy `wanted`, each a list of pixel indices, in scan order.
pub fn pieces(mask: &GrayImage, wanted: impl Fn(u8) -> bool) -> Vec<Vec<usize>> {
    let (width, count) = (mask.width() as usize, mask.as_raw().len());
    let mut open: Vec<bool> = mask.as_raw().iter().map(|&v| wanted(v)).collect();
    let mut found = Vec::new();
    for start in 0..count {
        if !std::mem::replace(&mut open[start], false) {
            continue;
        }
        let mut piece = vec![start];
        let mut next = 0;
        while let Some(&i) = piece.get(next) {
            next += 1;
            let x = i % width;
            let around =
                [(x > 0).then(|| i - 1), (x + 1 < width).then_some(i + 1), i.checked_sub(width), (i + width < count).then_some(i + width)];
            for j in around.into_iter().flatten() {
                if std::mem::replace(&mut open[j], false) {
                    piece.push(j);
                }
            }
        }
        found.push(piece);
    }
    found
}

/// Keeps set pieces of at least `area_px` pixels.
pub fn keep_large(mask: &mut GrayImage, area_px: usize) {
    for piece in pieces(mask, |v| v != 0).into_iter().filter(|p| p.len() < area_px) {
        paint(mask, &piece, 0);
    }
}

/// Fills unset pieces smaller than `area_px` pixels that do not touch the border.
pub fn fill_holes(mask: &mut GrayImage, area_px: usize) {
    let (width, height) = (mask.width() as usize, mask.height() as usize);
    let on_border = |i: &usize| i % width == 0 || i % width == width - 1 || i / width == 0 || i / width == height - 1;
    for piece in pieces(mask, |v| v == 0).into_iter().filter(|p| p.len() < area_px && !p.iter().any(on_border)) {
        paint(mask, &piece, 255);
    }
}

fn paint(mask: &mut GrayImage, piece: &[usize], value: u8) {
    let pixels: &mut [u8] = mask;
    piece.iter().for_each(|&i| pixels[i] = value);
}

/// Sets pixels whose (2r+1)² box holds more than `share` set pixels: 0.5 smooths, 0 dilates, just below 1 erodes.
pub fn box_vote(mask: &GrayImage, r: i64, share: f64) -> GrayImage {
    let (width, height) = (i64::from(mask.width()), i64::from(mask.height()));
    let stride = width as usize + 1;
    let mut sums = vec![0u32; stride * (height as usize + 1)];
    for (y, row) in mask.as_raw().chunks_exact(width.max(1) as usize).enumerate() {
        let mut across = 0;
        for (x, &v) in row.iter().enumerate() {
            across += u32::from(v != 0);
            sums[(y + 1) * stride + x + 1] = sums[y * stride + x + 1] + across;
        }
    }
    GrayImage::from_fn(mask.width(), mask.height(), |x, y| {
        let (x, y) = (i64::from(x), i64::from(y));
        let (x0, x1) = ((x - r).max(0) as usize, (x + r + 1).min(width) as usize);
        let (y0, y1) = ((y - r).max(0) as usize, (y + r + 1).min(height) as usize);
        let inside = sums[y1 * stride + x1] + sums[y0 * stride + x0] - sums[y0 * stride + x1] - sums[y1 * stride + x0];
        let all = (x1 - x0) * (y1 - y0);
        Luma([if f64::from(inside) > share * all as f64 { 255 } else { 0 }])
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spots() -> GrayImage {
        GrayImage::from_fn(60, 40, |x, y| Luma([if (x * 7919 + y * 104729 + x * y * 31) % 97 < 50 { 255 } else { 0 }]))
    }

    #[test]
    fn pieces_meet_opencv() {
        use opencv::{core, imgproc, prelude::*};
        let mask = spots();
        let source = core::Mat::new_rows_cols_with_data(40, 60, mask.as_raw()).unwrap();
        let mut labels = core::Mat::default();
        let count = imgproc::connected_components(&source, &mut labels, 4, core::CV_32S).unwrap();
        let ours = pieces(&mask, |v| v != 0);
        assert_eq!(ours.len(), count as usize - 1);
        let labels = labels.data_typed::<i32>().unwrap();
        assert!(ours.iter().all(|piece| piece.iter().all(|&i| labels[i] == labels[piece[0]])));
    }

    #[test]
    fn box_vote_meets_opencv() {
        use opencv::{core, imgproc, prelude::*};
        let mask = spots();
        let source = core::Mat::new_rows_cols_with_data(40, 60, mask.as_raw()).unwrap();
        for (share, dilate) in [(0.0, true), (0.999, false)] {
            let kernel = imgproc::get_structuring_element(imgproc::MORPH_RECT, core::Size::new(5, 5), core::Point::new(-1, -1)).unwrap();
            let mut expected = core::Mat::default();
            let value = imgproc::morphology_default_border_value().unwrap();
            let call = if dilate { imgproc::dilate } else { imgproc::erode };
            call(&source, &mut expected, &kernel, core::Point::new(-1, -1), 1, core::BORDER_CONSTANT, value).unwrap();
            assert_eq!(box_vote(&mask, 2, share).as_raw(), expected.data_typed::<u8>().unwrap());
        }
    }

    #[test]
    fn holes_fill_and_crumbs_go() {
        let mut mask = GrayImage::from_fn(30, 30, |x, y| {
            Luma([if (5..20).contains(&x) && (5..20).contains(&y) && (x, y) != (9, 9) { 255 } else { 0 }])
        });
        mask.put_pixel(25, 25, Luma([255]));
        fill_holes(&mut mask, 10);
        keep_large(&mut mask, 10);
        assert_eq!((mask.get_pixel(9, 9).0[0], mask.get_pixel(25, 25).0[0], mask.get_pixel(2, 2).0[0]), (255, 0, 0));
    }
}
