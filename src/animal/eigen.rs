//! Principal components of binary images by the Gram trick.
//!
//! Images i(t) ∈ {0,1}^P, t = 1 … n, mean ī, rows of I: i(t) − ī. With (1/n) I Iᵀ V = V D:
//!   E = Iᵀ V D^(−1/2)/√n,   p_k(t) = (i(t) − ī)·E_k/√D_k = √n V_tk                                        (1)
//! so that coefficients have unit variance (Favreau et al. 2004, equations 1 to 5). Binary images make the Gram matrix
//! counts of common pixels, taken from bit sets, exact and then centred. Sign: the largest |entry| of E_k is positive.
//! An animal that turns or comes nearer drifts: with Q an orthonormal basis of the polynomials of time up to a degree,
//! T = 1 − QQᵀ takes every pixel's trend away, (1/n) T I Iᵀ T its Gram matrix (degree 0 is the mean, as in the paper).
//! Checked against nalgebra's SVD, math::pca and cv::PCACompute.

use image::GrayImage;
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

/// Components with less of the largest one's variance are rounding.
const NULL_SPACE: f64 = 1e-10;

#[derive(Debug, thiserror::Error)]
pub enum EigenError {
    #[error("{0} silhouettes are too few; three or more are needed")]
    TooFew(usize),
    #[error("silhouette {frame} has {found:?} pixels where the others have {wanted:?}; crop them to one size")]
    Size { frame: usize, found: (u32, u32), wanted: (u32, u32) },
    #[error("all silhouettes are the same picture; nothing moves in this clip")]
    Still,
}

#[derive(Clone, Debug)]
pub struct Eigenimages {
    pub size_px: [u32; 2],
    /// ī, row by row, 0 to 1.
    pub mean: DVector<f64>,
    /// Orthonormal columns E_k, P×m.
    pub images: DMatrix<f64>,
    /// D, all of them above rounding, largest first.
    pub eigenvalues: Vec<f64>,
    /// p_k(t), n×m.
    pub coefficients: DMatrix<f64>,
}

/// PCA of masks (pixels above 127 are 1) of one size, with at most `components` components, every pixel's polynomial trend
/// of a degree taken away; degree 0 takes the mean.
pub fn eigenimages(masks: &[GrayImage], components: usize, trend_degree: usize) -> Result<Eigenimages, EigenError> {
    let n = masks.len();
    if n < 3 {
        return Err(EigenError::TooFew(n));
    }
    let (width, height) = masks[0].dimensions();
    if let Some((frame, other)) = masks.iter().enumerate().find(|(_, m)| m.dimensions() != (width, height)) {
        return Err(EigenError::Size { frame, found: other.dimensions(), wanted: (width, height) });
    }
    let eigen = gram_without(masks, &trends(n, trend_degree)).symmetric_eigen();
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]).then(a.cmp(&b)));
    let largest = eigen.eigenvalues[order[0]];
    // Less than a thousandth of a pixel.
    if largest < 1e-3 {
        return Err(EigenError::Still);
    }
    order.retain(|&k| eigen.eigenvalues[k] > NULL_SPACE * largest);
    let eigenvalues: Vec<f64> = order.iter().map(|&k| eigen.eigenvalues[k]).collect();
    order.truncate(components);
    let mut vectors = DMatrix::from_fn(n, order.len(), |t, k| eigen.eigenvectors[(t, order[k])]);
    let images: Vec<DVector<f64>> =
        (0..order.len()).map(|k| vectors.column(k) / (n as f64 * eigenvalues[k]).sqrt()).map(|w| sum_of(masks, &w)).collect();
    let mut images = DMatrix::from_columns(&images);
    for k in 0..order.len() {
        let column = images.column(k);
        if column[column.iamax()] < 0.0 {
            images.column_mut(k).neg_mut();
            vectors.column_mut(k).neg_mut();
        }
    }
    let mean = sum_of(masks, &DVector::from_element(n, 1.0 / n as f64));
    Ok(Eigenimages { size_px: [width, height], mean, images, eigenvalues, coefficients: vectors * (n as f64).sqrt() })
}

/// Orthonormal polynomials of time of degrees 0 … `degree`, one column each.
fn trends(n: usize, degree: usize) -> DMatrix<f64> {
    let time = |t: usize| 2.0 * t as f64 / (n - 1) as f64 - 1.0;
    DMatrix::from_fn(n, (degree + 1).min(n - 1), |t, k| time(t).powi(k as i32)).qr().q()
}

/// (1/n) T I Iᵀ T from numbers of common pixels.
fn gram_without(masks: &[GrayImage], trends: &DMatrix<f64>) -> DMatrix<f64> {
    let n = masks.len();
    let bits: Vec<Vec<u64>> = masks.par_iter().map(|m| m.as_raw().chunks(64).map(word).collect()).collect();
    let common = |a: &[u64], b: &[u64]| a.iter().zip(b).map(|(a, b)| (a & b).count_ones()).sum::<u32>();
    let rows: Vec<Vec<f64>> = bits.par_iter().map(|a| bits.iter().map(|b| f64::from(common(a, b))).collect()).collect();
    let gram = DMatrix::from_fn(n, n, |i, j| rows[i][j] / n as f64);
    let keep = DMatrix::identity(n, n) - trends * trends.transpose();
    let kept = &keep * gram * &keep;
    // Symmetric to the last bit.
    (&kept + kept.transpose()) * 0.5
}

fn word(pixels: &[u8]) -> u64 {
    pixels.iter().enumerate().fold(0, |word, (i, &p)| word | (u64::from(p > 127) << i))
}

/// Σ_t w_t i(t). For weights of sum 0 the mean does not matter.
fn sum_of(masks: &[GrayImage], weights: &DVector<f64>) -> DVector<f64> {
    let mut sum = DVector::zeros(masks[0].as_raw().len());
    for (mask, w) in masks.iter().zip(weights.iter()) {
        for (s, _) in sum.iter_mut().zip(mask.as_raw()).filter(|(_, p)| **p > 127) {
            *s += w;
        }
    }
    sum
}

impl Eigenimages {
    pub fn frames(&self) -> usize {
        self.coefficients.nrows()
    }

    /// Share of the variance of component `k`, counted from 0.
    pub fn explained(&self, k: usize) -> f64 {
        self.eigenvalues.get(k).map_or(0.0, |l| l / self.eigenvalues.iter().sum::<f64>())
    }

    /// p_k over time.
    pub fn series(&self, k: usize) -> Vec<f64> {
        self.coefficients.column(k).iter().copied().collect()
    }

    /// p of another mask of the same size, (1).
    pub fn project(&self, mask: &GrayImage) -> Vec<f64> {
        let centred = DVector::from_iterator(
            self.mean.len(),
            mask.as_raw().iter().zip(self.mean.iter()).map(|(&p, m)| f64::from(u8::from(p > 127)) - m),
        );
        (0..self.images.ncols()).map(|k| self.images.column(k).dot(&centred) / self.eigenvalues[k].sqrt()).collect()
    }

    /// ī + a·√D_k·E_k as grey values, cut off at black and white; a = 0 is the mean picture.
    pub fn picture(&self, k: usize, a: f64) -> GrayImage {
        let scale = a * self.eigenvalues[k].sqrt();
        let column = self.images.column(k);
        let pixels = self.mean.iter().zip(column.iter()).map(|(m, e)| ((m + scale * e) * 255.0).round().clamp(0.0, 255.0) as u8);
        let mut picture = GrayImage::new(self.size_px[0], self.size_px[1]);
        picture.iter_mut().zip(pixels).for_each(|(p, v)| *p = v);
        picture
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use image::Luma;
    use opencv::core::{self, Mat};
    use opencv::prelude::*;

    /// A leg that swings below a body.
    pub(crate) fn pendulum(n: usize) -> Vec<GrayImage> {
        (0..n)
            .map(|t| {
                let slope = 0.6 * (t as f64 * 0.7).sin();
                GrayImage::from_fn(41, 30, |x, y| {
                    let body = y < 10 && (5..36).contains(&x);
                    let leg = y >= 10 && (f64::from(x) - 20.0 - slope * (f64::from(y) - 10.0)).abs() < 3.0 + (t as f64 * 0.3).cos();
                    Luma([if body || leg { 255 } else { 0 }])
                })
            })
            .collect()
    }

    fn matrix(masks: &[GrayImage]) -> DMatrix<f64> {
        DMatrix::from_fn(masks[0].as_raw().len(), masks.len(), |i, t| f64::from(masks[t].as_raw()[i]) / 255.0)
    }

    #[test]
    fn agrees_with_svd_and_with_the_general_pca() {
        let masks = pendulum(17);
        let found = eigenimages(&masks, 5, 0).unwrap();
        let general = crate::math::pca::pca(&matrix(&masks));
        let mut centred = matrix(&masks);
        let mean = centred.column_mean();
        centred.column_iter_mut().for_each(|mut c| c -= &mean);
        let singular = centred.clone().svd(false, false).singular_values;
        for k in 0..5 {
            assert!((found.eigenvalues[k] - singular[k].powi(2) / 17.0).abs() < 1e-9);
            // The sign may differ where several pixels are largest.
            assert!((found.images.column(k).dot(&general.basis.column(k)).abs() - 1.0).abs() < 1e-9, "{k}");
            let series = found.series(k);
            assert!((series.iter().map(|v| v * v).sum::<f64>() / 17.0 - 1.0).abs() < 1e-9 && series.iter().sum::<f64>().abs() < 1e-9);
        }
        assert!((found.mean.clone() - general.mean).norm() < 1e-12);
        for (t, mask) in masks.iter().enumerate() {
            assert!(found.project(mask).iter().enumerate().all(|(k, p)| (p - found.coefficients[(t, k)]).abs() < 1e-9));
        }
        let total: f64 = (0..found.eigenvalues.len()).map(|k| found.explained(k)).sum();
        assert!((total - 1.0).abs() < 1e-12 && found.explained(0) > 0.3);
    }

    #[test]
    fn trends_are_taken_from_every_pixel() {
        let masks = pendulum(20);
        let found = eigenimages(&masks, 3, 2).unwrap();
        // Pixel by pixel: residuals of a least-squares parabola, then the general PCA.
        let mut pixels = matrix(&masks).transpose();
        let design = DMatrix::from_fn(20, 3, |t, k| (t as f64).powi(k as i32));
        let fit = (design.transpose() * &design).try_inverse().unwrap() * design.transpose();
        let trend = &design * (fit * &pixels);
        pixels -= trend;
        let general = crate::math::pca::pca(&pixels.transpose());
        let plain = eigenimages(&masks, 3, 0).unwrap();
        for k in 0..3 {
            assert!(
                (found.eigenvalues[k] - general.eigenvalues[k]).abs() < 1e-7 && (found.eigenvalues[k] - plain.eigenvalues[k]).abs() > 1e-3
            );
            assert!((found.images.column(k).dot(&general.basis.column(k)).abs() - 1.0).abs() < 1e-6, "{k}");
        }
    }

    #[test]
    fn agrees_with_opencv() {
        let masks = pendulum(12);
        let found = eigenimages(&masks, 4, 0).unwrap();
        let rows: Vec<f64> = masks.iter().flat_map(|m| m.iter().map(|p| f64::from(*p) / 255.0)).collect();
        let data = Mat::new_rows_cols_with_data(12, masks[0].as_raw().len() as i32, &rows).unwrap().try_clone().unwrap();
        let (mut mean, mut vectors, mut values) = (Mat::default(), Mat::default(), Mat::default());
        core::pca_compute2(&data, &mut mean, &mut vectors, &mut values, 4).unwrap();
        for k in 0..4 {
            let theirs = DVector::from_column_slice(vectors.at_row::<f64>(k as i32).unwrap());
            assert!((found.eigenvalues[k] - values.at::<f64>(k as i32).unwrap()).abs() < 1e-9);
            assert!((found.images.column(k).dot(&theirs).abs() - 1.0).abs() < 1e-9);
        }
    }

    #[test]
    fn pictures_and_bad_input() {
        let masks = pendulum(9);
        let found = eigenimages(&masks, 2, 0).unwrap();
        assert_eq!(found.picture(0, 0.0).get_pixel(20, 4).0, [255]);
        assert!(found.picture(0, 1.0) != found.picture(0, -1.0));
        assert!(matches!(eigenimages(&masks[..2], 2, 0), Err(EigenError::TooFew(2))));
        assert!(matches!(eigenimages(&vec![masks[0].clone(); 6], 2, 0), Err(EigenError::Still)));
        let odd = [&masks[..], &[GrayImage::new(4, 4)]].concat();
        assert!(matches!(eigenimages(&odd, 2, 0), Err(EigenError::Size { frame: 9, .. })));
    }
}
