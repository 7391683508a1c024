//! What moved against the scenery, under a panning camera.
//!
//! Background keeps its place under a homography between frames (a turning camera, or far or flat scenery). Corners are
//! tracked (Lucas and Kanade) to frames 6, 12, 18 and 30 before and after; RANSAC finds the homography that most obey.
//! Each such frame is warped onto this one; a pixel's change to it is the distance of its colour to the range of colours
//! in the 3×3 pixels around its image there, which forgives misregistration. The second smallest change over all these
//! frames (the smallest of up to four) is small for scenery, which the animal covers in few of them, and large for an animal that moved by its own
//! width; the inside of a large uniform animal stays small. Fails for still animals and for near scenery with parallax.
//! Checked against rendered clips with known motion.

use image::RgbImage;
use nalgebra::Matrix3;
use opencv::core::{self, BORDER_CONSTANT, Mat, Point2f, Size, TermCriteria, Vec3b, Vector};
use opencv::prelude::*;
use opencv::{calib3d, imgproc, video};
use rayon::prelude::*;

/// Frames between a frame and those that it is held against.
const LAGS: [usize; 4] = [6, 12, 18, 30];
/// Of so many frames the animal may cover a place in all but one.
const FEW: u8 = 4;
/// Corners tracked per frame.
const CORNERS: i32 = 400;
/// Fewer inliers do not make a homography.
const FEWEST: usize = 12;

/// The frames of a clip as OpenCV wants them, and the camera's turns.
pub struct Scenery {
    /// 8-bit L*a*b*, slightly blurred.
    blurred: Vec<Mat>,
    grey: Vec<Mat>,
    /// (from, to, `to_from_from`) for frames a lag apart.
    pairs: Vec<(usize, usize, Matrix3<f64>)>,
    /// `first_from_frame` of every frame, composed of neighbours; `None` after a break.
    pub first_from_frame: Vec<Option<Matrix3<f64>>>,
}

/// 8-bit L*a*b* of a picture, L in 0 to 255.
pub fn lab(picture: &RgbImage) -> opencv::Result<Vec<[f32; 3]>> {
    let lab = lab_mat(picture)?;
    Ok(lab.data_typed::<Vec3b>()?.iter().map(|p| p.0.map(f32::from)).collect())
}

fn lab_mat(picture: &RgbImage) -> opencv::Result<Mat> {
    let rgb = Mat::new_rows_cols_with_bytes::<Vec3b>(picture.height() as i32, picture.width() as i32, picture.as_raw())?;
    let mut lab = Mat::default();
    imgproc::cvt_color_def(&rgb, &mut lab, imgproc::COLOR_RGB2Lab)?;
    Ok(lab)
}

impl Scenery {
    /// Registers the frames, all of one size.
    pub fn new(frames: &[RgbImage]) -> opencv::Result<Scenery> {
        let prepared = frames
            .par_iter()
            .map(|frame| {
                let mut blurred = Mat::default();
                imgproc::gaussian_blur_def(&lab_mat(frame)?, &mut blurred, Size::new(0, 0), 0.8)?;
                let rgb = Mat::new_rows_cols_with_bytes::<Vec3b>(frame.height() as i32, frame.width() as i32, frame.as_raw())?;
                let mut grey = Mat::default();
                imgproc::cvt_color_def(&rgb, &mut grey, imgproc::COLOR_RGB2GRAY)?;
                let corners = corners(&grey)?;
                Ok((blurred, grey, corners))
            })
            .collect::<opencv::Result<Vec<_>>>()?;
        let n = prepared.len();
        let steps = (1..n)
            .into_par_iter()
            .map(|f| homography(&prepared[f - 1], &prepared[f].1, &Matrix3::identity()))
            .collect::<opencv::Result<Vec<_>>>()?;
        // frame_from_first.
        let mut chain = vec![Some(Matrix3::identity()); n.min(1)];
        for step in &steps {
            let last = chain[chain.len() - 1];
            chain.push(last.zip(*step).map(|(chain, step)| normalised(step * chain)));
        }
        let wanted: Vec<(usize, usize)> = (0..n).flat_map(|f| LAGS.map(|lag| (f, f + lag))).filter(|p| p.1 < n).collect();
        let pairs = wanted
            .into_par_iter()
            .map(|(from, to)| {
                let Some(guess) = chain[to].zip(chain[from]).and_then(|(to, from)| Some(normalised(to * from.try_inverse()?))) else {
                    return Ok(None);
                };
                Ok(homography(&prepared[from], &prepared[to].1, &guess)?.map(|h| (from, to, h)))
            })
            .collect::<opencv::Result<Vec<_>>>()?;
        let first_from_frame = chain.iter().map(|h| h.and_then(|h| h.try_inverse())).collect();
        let (blurred, grey) = prepared.into_iter().map(|(b, g, _)| (b, g)).unzip();
        Ok(Scenery { blurred, grey, pairs: pairs.into_iter().flatten().collect(), first_from_frame })
    }

    /// Second smallest change of every pixel of a frame (of up to four the smallest), grey levels; NaN where no other frame shows its place.
    pub fn change(&self, frame: usize) -> opencv::Result<Vec<f32>> {
        let here = &self.blurred[frame];
        let mut smallest = vec![[f32::NAN; 2]; here.total()];
        let mut seen = vec![0u8; here.total()];
        for (from, to, to_from_from) in &self.pairs {
            let (other, here_from_other) = match frame {
                f if f == *to => (*from, *to_from_from),
                f if f == *from => match to_from_from.try_inverse() {
                    Some(h) => (*to, h),
                    None => continue,
                },
                _ => continue,
            };
            accumulate(here, &self.blurred[other], &here_from_other, &mut smallest, &mut seen)?;
        }
        Ok(smallest.iter().zip(seen).map(|([a, b], seen)| if seen > FEW { *b } else { *a }).collect())
    }

    /// Optical flow: where every pixel of `frame` was in frame `other`, px relative.
    pub fn flow(&self, frame: usize, other: usize) -> opencv::Result<Vec<[f32; 2]>> {
        let mut dis = video::DISOpticalFlow::create(video::DISOpticalFlow_PRESET_ULTRAFAST)?;
        let mut flow = Mat::default();
        dis.calc(&self.grey[frame], &self.grey[other], &mut flow)?;
        Ok(flow.data_typed::<core::Vec2f>()?.iter().map(|v| v.0).collect())
    }
}

type Prepared = (Mat, Mat, Vector<Point2f>);

fn corners(grey: &Mat) -> opencv::Result<Vector<Point2f>> {
    let mut corners = Vector::new();
    imgproc::good_features_to_track(grey, &mut corners, CORNERS, 0.01, 6.0, &core::no_array(), 3, false, 0.04)?;
    Ok(corners)
}

fn apply(h: &Matrix3<f64>, p: Point2f) -> Point2f {
    let q = h * nalgebra::Vector3::new(f64::from(p.x), f64::from(p.y), 1.0);
    Point2f::new((q.x / q.z) as f32, (q.y / q.z) as f32)
}

fn normalised(h: Matrix3<f64>) -> Matrix3<f64> {
    h / h[(2, 2)]
}

/// `to_from_from` by tracked corners, sought from where `guess` puts them; `None` where too few agree.
fn homography(from: &Prepared, to: &Mat, guess: &Matrix3<f64>) -> opencv::Result<Option<Matrix3<f64>>> {
    if from.2.len() < FEWEST {
        return Ok(None);
    }
    let mut tracked: Vector<Point2f> = from.2.iter().map(|p| apply(guess, p)).collect();
    let (mut status, mut error) = (Vector::<u8>::new(), Vector::<f32>::new());
    let levels = if *guess == Matrix3::identity() { 3 } else { 1 };
    let stop = TermCriteria::new(3, 30, 0.01)?;
    let flags = video::OPTFLOW_USE_INITIAL_FLOW;
    video::calc_optical_flow_pyr_lk(
        &from.1,
        to,
        &from.2,
        &mut tracked,
        &mut status,
        &mut error,
        Size::new(17, 17),
        levels,
        stop,
        flags,
        1e-4,
    )?;
    let found: Vec<_> = from.2.iter().zip(&tracked).zip(&status).filter(|(_, s)| *s > 0).map(|(pair, _)| pair).collect();
    let (a, b): (Vector<Point2f>, Vector<Point2f>) = (found.iter().map(|p| p.0).collect(), found.iter().map(|p| p.1).collect());
    if a.len() < FEWEST {
        return Ok(None);
    }
    let mut inliers = Mat::default();
    let h = calib3d::find_homography(&a, &b, &mut inliers, calib3d::RANSAC, 1.0)?;
    if h.empty() || core::count_non_zero(&inliers)? < FEWEST as i32 {
        return Ok(None);
    }
    Ok(Some(normalised(Matrix3::from_row_slice(h.data_typed::<f64>()?))))
}

/// Warps `other` onto `here` and keeps every pixel's two smallest changes.
fn accumulate(here: &Mat, other: &Mat, here_from_other: &Matrix3<f64>, smallest: &mut [[f32; 2]], seen: &mut [u8]) -> opencv::Result<()> {
    let h = Mat::from_slice_2d(&[0, 1, 2].map(|r| [0, 1, 2].map(|c| here_from_other[(r, c)])))?;
    let full = Mat::new_rows_cols_with_default(here.rows(), here.cols(), core::CV_8UC1, 255.0.into())?;
    let warp = |source: &Mat| -> opencv::Result<Mat> {
        let mut warped = Mat::default();
        imgproc::warp_perspective(source, &mut warped, &h, here.size()?, imgproc::INTER_LINEAR, BORDER_CONSTANT, core::Scalar::default())?;
        Ok(warped)
    };
    let (there, inside) = (warp(other)?, warp(&full)?);
    let square = imgproc::get_structuring_element_def(imgproc::MORPH_RECT, Size::new(3, 3))?;
    let (mut low, mut high, mut valid) = (Mat::default(), Mat::default(), Mat::default());
    imgproc::erode_def(&there, &mut low, &square)?;
    imgproc::dilate_def(&there, &mut high, &square)?;
    imgproc::erode_def(&inside, &mut valid, &square)?;
    let colours = here.data_typed::<Vec3b>()?.iter().zip(low.data_typed::<Vec3b>()?).zip(high.data_typed::<Vec3b>()?);
    for (((c, low), high), (valid, (two, seen))) in colours.zip(valid.data_bytes()?.iter().zip(smallest.iter_mut().zip(seen))) {
        if *valid < 255 {
            continue;
        }
        *seen += 1;
        let squares = (0..3).map(|k| f32::from(c[k].saturating_sub(high[k]).max(low[k].saturating_sub(c[k]))).powi(2));
        let change = squares.sum::<f32>().sqrt();
        if two[0].is_nan() || change < two[0] {
            *two = [change, two[0]];
        } else if two[1].is_nan() || change < two[1] {
            two[1] = change;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Rgb;

    /// Seeded blotches of scenery seen by a camera that pans 2.5 px a frame; a disc moves 4 px a frame against it.
    pub(crate) fn pan(n: usize) -> Vec<RgbImage> {
        let scene = |x: f64, y: f64| -> [u8; 3] {
            let wave = |a: f64, b: f64, c: f64| 120.0 + 60.0 * (x * a + y * b + c).sin() + 40.0 * (x * b - y * a * 1.7).cos();
            [wave(0.31, 0.17, 0.0), wave(0.23, 0.41, 1.0), wave(0.12, 0.29, 2.0)].map(|v| v.clamp(0.0, 255.0) as u8)
        };
        (0..n)
            .map(|t| {
                RgbImage::from_fn(160, 120, |x, y| {
                    let (x, y) = (f64::from(x) + 2.5 * t as f64, f64::from(y));
                    let inside = (x - 40.0 - 4.0 * t as f64).hypot(y - 60.0) < 14.0;
                    Rgb(if inside { [210, 60, 40] } else { scene(x, y) })
                })
            })
            .collect()
    }

    #[test]
    fn a_pan_is_registered_and_the_mover_changes() {
        let frames = pan(20);
        let scenery = Scenery::new(&frames).unwrap();
        let back = scenery.first_from_frame[19].unwrap();
        let middle = apply(&back, Point2f::new(80.0, 60.0));
        assert!((middle.x - 80.0 - 2.5 * 19.0).abs() < 1.5 && (middle.y - 60.0).abs() < 1.5, "{middle:?}");
        let change = scenery.change(8).unwrap();
        let (mut mover, mut rest) = (Vec::new(), Vec::new());
        for (i, c) in change.iter().enumerate().filter(|(_, c)| !c.is_nan()) {
            let (x, y) = ((i % 160) as f64, (i / 160) as f64);
            let r = (x + 20.0 - 40.0 - 32.0).hypot(y - 60.0);
            if r < 12.0 {
                mover.push(*c)
            } else if r > 17.0 {
                rest.push(*c)
            }
        }
        let share = |v: &[f32]| v.iter().filter(|c| **c > 8.0).count() as f64 / v.len() as f64;
        assert!(share(&mover) > 0.9 && share(&rest) < 0.08, "{} {}", share(&mover), share(&rest));
        let flow = scenery.flow(8, 7).unwrap();
        assert!((flow[60 * 160 + 120][0] - 2.5).abs() < 0.7);
    }
}
