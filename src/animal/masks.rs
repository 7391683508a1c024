//! Silhouettes of an animal in a clip from a few rectangles.
//!
//! Every pixel's log-odds of being the animal is a sum, at a working size of at most 448 px:
//!   U = w [log p(x|F) − log p(x|B)] (clipped at ±3: mixtures of 5 Gaussians in L*a*b*, [`super::mixture`]; w from 0.6,
//!       where they confuse 5 % of their own samples or more, to 2, where they confuse none)
//!     + [(c/s)² − 1] (clipped to −1 … 4: c the change against the scenery, [`super::change`], s three times its median,
//!       the noise, at least 3)
//!     + [signed distance to the previous mask, carried along by the optical flow, over 6 px of 448] (−4 … 3;
//!       down to a quarter where the flow leads to another colour, by 10 to 30 grey levels)         (1)
//! In the frame of the rectangles the last term falls off with the distance from the subject's rectangle. Mean-field
//! inference of a Potts model whose couplings fall with the colour step ([`super::field`]) smooths U along edges.
//! Both mixtures are learnt anew every 5 frames, the animal's from the mask's inside, the scenery's from round it; where
//! animal and scenery share a colour, that can run away, and the rectangles' colours are better kept.
//! Departure from Favreau et al. (2004): they classify by colour alone. Change and carrying make animals of the colour of
//! their surroundings possible. Fails when animal and scenery agree in colour and the animal stands still.
//! Checked against rendered clips whose silhouettes are known, and hand-made masks of real clips.

use image::{GrayImage, ImageBuffer, Luma, RgbImage, imageops};
use rayon::prelude::*;

use super::change::{Scenery, lab};
use super::field::{couplings, distance, mean_field};
use super::mixture::Mixture;
use super::region::{Region, follow};
use crate::footage::regions::{area_px, box_vote, dilate, erode, fill_holes, open};
use crate::math::order::quantile;

/// Longer side of the pictures that are worked on.
const WORKING_PX: u32 = 448;
/// Frames whose maps are made in parallel before the sequential part.
const BATCH: usize = 24;
const GAUSSIANS: usize = 5;
const BACKGROUND: f32 = -20.0;

#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Rectangle {
    pub x: u32,
    pub y: u32,
    pub width: u32,
    pub height: u32,
}

/// A rectangle that the user drew on a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Mark {
    pub frame: usize,
    /// Inside the animal; else beside it.
    pub subject: bool,
    pub rectangle: Rectangle,
}

#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MaskOptions {
    /// Edge-aware smoothing.
    pub smooth: bool,
    /// The change against the registered scenery; off for animals that stand, or scenery with parallax.
    pub motion: bool,
    /// Frames between two fits of the colours to the masks found so far; 0 keeps the rectangles' colours.
    pub update_every: usize,
}

impl Default for MaskOptions {
    fn default() -> MaskOptions {
        MaskOptions { smooth: true, motion: true, update_every: 5 }
    }
}

#[derive(Debug, thiserror::Error)]
pub enum MaskError {
    #[error("the clip has no frame")]
    Empty,
    #[error("frame {frame} has {found:?} pixels, the first one {wanted:?}; give frames of one size")]
    Size { frame: usize, found: (u32, u32), wanted: (u32, u32) },
    #[error("a rectangle is on frame {frame}, but the clip's last frame is {last}")]
    Frame { frame: usize, last: usize },
    #[error("rectangle {x},{y},{width},{height} on frame {frame} is not inside the {image_width}x{image_height} picture")]
    Outside { frame: usize, x: u32, y: u32, width: u32, height: u32, image_width: u32, image_height: u32 },
    #[error("no rectangle of the {0} is given, or it holds too few pixels; draw a larger one")]
    NoColours(&'static str),
    #[error("no silhouette was found in frame {0}, where the subject's rectangle is; draw rectangles that fit better")]
    Nothing(usize),
    #[error("stopped")]
    Stopped,
    #[error("an image operation failed: {0}")]
    OpenCv(#[from] opencv::Error),
}

#[derive(Clone, Debug)]
pub struct Silhouettes {
    /// 0 or 255, of the clip's size; black where nothing was found.
    pub masks: Vec<GrayImage>,
    /// In the clip's pixels; `None` where nothing was found.
    pub regions: Vec<Option<Region>>,
    /// Centres of mass in the first frame's pixels, the camera's turns taken out; `None` where that is not known.
    pub path_px: Vec<Option<[f64; 2]>>,
}

/// Finds the animal in every frame. `goes_on` is asked after each frame.
pub fn silhouettes(
    frames: &[RgbImage],
    marks: &[Mark],
    options: &MaskOptions,
    goes_on: &mut dyn FnMut() -> bool,
) -> Result<Silhouettes, MaskError> {
    check(frames, marks)?;
    let (width, height) = frames[0].dimensions();
    let scale = (f64::from(WORKING_PX) / f64::from(width.max(height))).min(1.0);
    let [small_width, small_height] = [width, height].map(|n| ((f64::from(n) * scale).round() as u32).max(1));
    let working: Vec<RgbImage> = if scale < 1.0 {
        frames.par_iter().map(|f| shrink(f, small_width, small_height)).collect::<opencv::Result<_>>()?
    } else {
        frames.to_vec()
    };
    let marks: Vec<Mark> = marks.iter().map(|m| Mark { rectangle: scaled(m.rectangle, scale, small_width, small_height), ..*m }).collect();
    let scenery = Scenery::new(&working)?;
    let mut run = Run::new(&working, &marks, options, &scenery)?;
    let mut found =
        Silhouettes { masks: vec![GrayImage::new(width, height); frames.len()], regions: vec![None; frames.len()], path_px: Vec::new() };
    run.both_ways(&mut found, goes_on)?;
    for (region, second) in found.regions.iter_mut().zip(&run.seconds) {
        if let Some(region) = region {
            region.second_px = second.map(|s| (s as f64 / (scale * scale)) as usize);
        }
    }
    let in_scenery = |(region, h): (&Option<Region>, &Option<nalgebra::Matrix3<f64>>)| {
        let (c, h) = (region.as_ref()?.centre_px, (*h)?);
        let p = h * nalgebra::Vector3::new(c[0] * scale, c[1] * scale, 1.0);
        Some([p.x / p.z / scale, p.y / p.z / scale])
    };
    found.path_px = found.regions.iter().zip(&scenery.first_from_frame).map(in_scenery).collect();
    Ok(found)
}

fn check(frames: &[RgbImage], marks: &[Mark]) -> Result<(), MaskError> {
    let wanted = frames.first().ok_or(MaskError::Empty)?.dimensions();
    if let Some((frame, other)) = frames.iter().enumerate().find(|(_, f)| f.dimensions() != wanted) {
        return Err(MaskError::Size { frame, found: other.dimensions(), wanted });
    }
    for m in marks {
        let Rectangle { x, y, width, height } = m.rectangle;
        if m.frame >= frames.len() {
            return Err(MaskError::Frame { frame: m.frame, last: frames.len() - 1 });
        }
        let inside = |from: u32, length: u32, of: u32| length > 0 && from.checked_add(length).is_some_and(|end| end <= of);
        if !inside(x, width, wanted.0) || !inside(y, height, wanted.1) {
            return Err(MaskError::Outside { frame: m.frame, x, y, width, height, image_width: wanted.0, image_height: wanted.1 });
        }
    }
    Ok(())
}

fn shrink(picture: &RgbImage, width: u32, height: u32) -> opencv::Result<RgbImage> {
    use opencv::core::{Mat, Size, Vec3b};
    use opencv::imgproc;
    use opencv::prelude::*;
    let mat = Mat::new_rows_cols_with_bytes::<Vec3b>(picture.height() as i32, picture.width() as i32, picture.as_raw())?;
    let mut small = Mat::default();
    imgproc::resize(&mat, &mut small, Size::new(width as i32, height as i32), 0.0, 0.0, imgproc::INTER_AREA)?;
    let bytes = small.data_bytes()?.to_vec();
    RgbImage::from_raw(width, height, bytes).ok_or_else(|| opencv::Error::new(opencv::core::StsUnmatchedSizes, "size"))
}

fn scaled(r: Rectangle, scale: f64, width: u32, height: u32) -> Rectangle {
    let part = |from: u32, length: u32, of: u32| {
        let start = ((f64::from(from) * scale).round() as u32).min(of - 1);
        (start, ((f64::from(from + length) * scale).round() as u32).clamp(start + 1, of) - start)
    };
    let ((x, w), (y, h)) = (part(r.x, r.width, width), part(r.y, r.height, height));
    Rectangle { x, y, width: w, height: h }
}

/// The mask at full size: the zero line of the interpolated belief, near the kept region only.
fn enlarge(mask: &GrayImage, belief: &[f32], width: u32, height: u32) -> GrayImage {
    if mask.dimensions() == (width, height) || belief.is_empty() {
        return mask.clone();
    }
    let near = dilate(mask, 1);
    let values = belief.iter().zip(near.iter()).map(|(b, n)| if *n > 0 { *b } else { -1.0 }).collect();
    let Some(soft) = ImageBuffer::<Luma<f32>, Vec<f32>>::from_raw(mask.width(), mask.height(), values) else { return mask.clone() };
    let large = imageops::resize(&soft, width, height, imageops::FilterType::Triangle);
    GrayImage::from_fn(width, height, |x, y| Luma([if large.get_pixel(x, y).0[0] > 0.0 { 255 } else { 0 }]))
}

/// What is known of a frame before its mask.
struct Maps {
    lab: Vec<[f32; 3]>,
    change: Vec<f32>,
    /// To the frame that the mask comes from.
    flow: Vec<[f32; 2]>,
    /// How far the flow is believed, 0.25 to 1.
    faith: Vec<f32>,
    /// Couplings to the right, below, below right and below left.
    couplings: [Vec<f32>; 4],
}

struct Run<'a> {
    frames: &'a [RgbImage],
    marks: &'a [Mark],
    options: &'a MaskOptions,
    scenery: &'a Scenery,
    subject: Mixture,
    background: Mixture,
    /// w of equation (1).
    trust: f32,
    /// The rectangles' own colours, to start again from, and their w.
    first: ([Mixture; 2], f32),
    /// Middle of the first subject rectangle.
    anchor: [f64; 2],
    previous: Option<GrayImage>,
    centre: [f64; 2],
    /// Areas of second animals.
    seconds: Vec<Option<usize>>,
}

impl<'a> Run<'a> {
    fn new(frames: &'a [RgbImage], marks: &'a [Mark], options: &'a MaskOptions, scenery: &'a Scenery) -> Result<Run<'a>, MaskError> {
        let colours = |subject: bool| -> Result<Vec<[f32; 3]>, MaskError> {
            let mut colours = Vec::new();
            for m in marks.iter().filter(|m| m.subject == subject) {
                let Rectangle { x, y, width, height } = m.rectangle;
                colours.extend(lab(&imageops::crop_imm(&frames[m.frame], x, y, width, height).to_image())?);
            }
            Ok(colours)
        };
        let (inside, outside) = (colours(true)?, colours(false)?);
        let fit = |colours: &[[f32; 3]], name| Mixture::fit(colours, GAUSSIANS, 1).ok_or(MaskError::NoColours(name));
        let (subject, background) = (fit(&inside, "subject")?, fit(&outside, "background")?);
        let trust = trust(confusion(&subject, &background, &inside, &outside));
        let middle = marks.iter().filter(|m| m.subject).min_by_key(|m| m.frame).map(|m| m.rectangle);
        let anchor = middle.map_or([0.0; 2], |r| [f64::from(r.x) + f64::from(r.width) / 2.0, f64::from(r.y) + f64::from(r.height) / 2.0]);
        let first = ([subject.clone(), background.clone()], trust);
        let seconds = vec![None; frames.len()];
        Ok(Run { frames, marks, options, scenery, subject, background, trust, first, anchor, previous: None, centre: anchor, seconds })
    }

    /// From the first frame with a subject's rectangle to the end, and from there to the beginning.
    fn both_ways(&mut self, found: &mut Silhouettes, goes_on: &mut dyn FnMut() -> bool) -> Result<(), MaskError> {
        let anchor = self.marks.iter().filter(|m| m.subject).map(|m| m.frame).min().unwrap_or(0);
        let forward: Vec<(usize, Option<usize>)> =
            (anchor..self.frames.len()).map(|f| (f, f.checked_sub(1).filter(|p| *p >= anchor))).collect();
        let backward: Vec<(usize, Option<usize>)> = (0..anchor).rev().map(|f| (f, Some(f + 1))).collect();
        let (width, height) = found.masks[anchor].dimensions();
        let mut first = None;
        for way in [forward, backward] {
            self.restart(first.as_ref());
            for batch in way.chunks(BATCH) {
                let maps = batch.par_iter().map(|(f, from)| self.maps(*f, *from)).collect::<Result<Vec<_>, MaskError>>()?;
                let mut small = Vec::with_capacity(batch.len());
                for ((f, _), maps) in batch.iter().zip(&maps) {
                    small.push(self.segment(*f, maps));
                    if *f == anchor {
                        first = small.last().map(|(mask, _)| mask.clone()).filter(|m| area_px(m) > 0);
                        first.as_ref().ok_or(MaskError::Nothing(anchor))?;
                    }
                    if !goes_on() {
                        return Err(MaskError::Stopped);
                    }
                }
                let full: Vec<Option<(GrayImage, Region)>> =
                    small.par_iter().map(|(mask, belief)| follow(&enlarge(mask, belief, width, height), None)).collect();
                for ((f, _), full) in batch.iter().zip(full) {
                    if let Some((mask, region)) = full {
                        (found.masks[*f], found.regions[*f]) = (mask, Some(region));
                    }
                }
            }
        }
        Ok(())
    }

    /// Before each of the two directions: the anchor's mask, once there is one.
    fn restart(&mut self, anchor: Option<&GrayImage>) {
        self.previous = anchor.cloned();
        self.centre = anchor.and_then(|m| follow(m, None)).map_or(self.anchor, |(_, r)| r.centre_px);
        ([self.subject, self.background], self.trust) = self.first.clone();
    }

    fn maps(&self, frame: usize, from: Option<usize>) -> Result<Maps, MaskError> {
        let lab = lab(&self.frames[frame])?;
        let change = if self.options.motion { self.scenery.change(frame)? } else { vec![f32::NAN; lab.len()] };
        let flow = from.map_or(Ok(Vec::new()), |from| self.scenery.flow(frame, from))?;
        let width = self.frames[frame].width() as usize;
        let faith = from.map_or(Ok(Vec::new()), |from| Ok::<_, MaskError>(faith(&lab, &self::lab(&self.frames[from])?, &flow, width)))?;
        let couplings = couplings(&lab, width);
        Ok(Maps { lab, change, flow, faith, couplings })
    }

    /// The frame's mask and belief, −1 to 1.
    fn segment(&mut self, frame: usize, maps: &Maps) -> (GrayImage, Vec<f32>) {
        let (width, height) = self.frames[frame].dimensions();
        let prior = match &self.previous {
            Some(mask) => carried(mask, &maps.flow, reach_px(mask, 6.0)).iter().zip(&maps.faith).map(|(c, f)| c * f).collect(),
            None => self.rectangle_prior(frame),
        };
        let noise = noise(&maps.change);
        let (subject, background, trust) = (&self.subject, &self.background, self.trust);
        let mut odds: Vec<f32> = maps
            .lab
            .par_iter()
            .zip(&maps.change)
            .zip(&prior)
            .map(|((x, change), prior)| {
                let colour = (subject.log_density(*x) - background.log_density(*x)).clamp(-3.0, 3.0);
                let moved = if change.is_nan() { 0.0 } else { ((change / noise).powi(2) - 1.0).clamp(-1.0, 4.0) };
                trust * colour + moved + prior - 0.3
            })
            .collect();
        for m in self.marks.iter().filter(|m| m.frame == frame) {
            let r = m.rectangle;
            for y in r.y..r.y + r.height {
                let row = (y * width + r.x) as usize;
                odds[row..row + r.width as usize].iter_mut().for_each(|u| *u = if m.subject { u.max(3.0) } else { BACKGROUND });
            }
        }
        let belief = if self.options.smooth {
            mean_field(&odds, &maps.couplings, width as usize)
        } else {
            odds.iter().map(|u| (u / 2.0).tanh()).collect()
        };
        let raw: Vec<u8> = belief.iter().map(|b| if *b > 0.0 { 255 } else { 0 }).collect();
        let raw = GrayImage::from_raw(width, height, raw).unwrap_or_else(|| GrayImage::new(width, height));
        let cleaned = follow(&open(&raw, 1), Some(self.centre));
        let Some((mask, region)) = cleaned else { return (GrayImage::new(width, height), Vec::new()) };
        let mask = fill_holes(&mask, (region.area_px / 200).max(4));
        self.seconds[frame] = region.second_px;
        self.centre = region.centre_px;
        self.previous = Some(mask.clone());
        if self.options.update_every > 0 && frame.is_multiple_of(self.options.update_every) {
            self.learn(maps, &mask);
        }
        (mask, belief)
    }

    /// 3 inside the subject's rectangle, falling by 3 per rectangle size beside it.
    fn rectangle_prior(&self, frame: usize) -> Vec<f32> {
        let (width, height) = self.frames[frame].dimensions();
        let subject: Vec<Rectangle> = self.marks.iter().filter(|m| m.subject && m.frame == frame).map(|m| m.rectangle).collect();
        let at = |x: u32, y: u32| {
            let distance = |r: &Rectangle| {
                let beyond = |p: u32, from: u32, length: u32| {
                    let outside = (i64::from(from) - i64::from(p)).max(i64::from(p) - i64::from(from + length)).max(0);
                    outside as f32 / length as f32
                };
                beyond(x, r.x, r.width).hypot(beyond(y, r.y, r.height))
            };
            let nearest = subject.iter().map(distance).fold(f32::INFINITY, f32::min);
            if nearest == 0.0 { 3.0 } else { (2.0 - 3.0 * nearest).max(BACKGROUND) }
        };
        (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).map(|(x, y)| at(x, y)).collect()
    }

    /// Colours of the inside and of a ring round the mask.
    fn learn(&mut self, maps: &Maps, mask: &GrayImage) {
        let reach = |px: f32| reach_px(mask, px) as u32;
        let inner = erode(mask, reach(6.0));
        let noise = noise(&maps.change);
        let (near, far) = (dilate(mask, reach(3.0)), box_vote(mask, reach(30.0) as usize, 0.0));
        let colours =
            |wanted: &dyn Fn(usize) -> bool| -> Vec<[f32; 3]> { (0..maps.lab.len()).filter(|i| wanted(*i)).map(|i| maps.lab[i]).collect() };
        let inside = colours(&|i| inner.as_raw()[i] > 0 || (mask.as_raw()[i] > 0 && maps.change[i] > 2.5 * noise));
        let inside = if inside.len() > 50 { inside } else { colours(&|i| mask.as_raw()[i] > 0) };
        let round = colours(&|i| far.as_raw()[i] > 0 && near.as_raw()[i] == 0);
        if let (Some(subject), Some(background)) = (Mixture::fit(&inside, GAUSSIANS, 1), Mixture::fit(&round, GAUSSIANS, 1)) {
            self.trust = trust(confusion(&subject, &background, &inside, &round));
            (self.subject, self.background) = (subject, background);
        }
    }
}

/// Three times the usual change of scenery, grey levels, at least 3.
fn noise(change: &[f32]) -> f32 {
    let known = change.iter().filter(|c| !c.is_nan()).map(|c| f64::from(*c)).collect();
    3.0 * quantile(known, 0.5).unwrap_or(1.0).max(1.0) as f32
}

/// Pixels of a picture of the working size, in a smaller one; at least 2.
fn reach_px(picture: &GrayImage, px: f32) -> f32 {
    (px * picture.width().max(picture.height()) as f32 / WORKING_PX as f32).max(2.0)
}

/// w of equation (1).
fn trust(confused: f32) -> f32 {
    2.0 - 1.4 * (confused / 0.05).min(1.0)
}

/// The share of their own samples that the mixtures take for the other's, the worse of both.
fn confusion(subject: &Mixture, background: &Mixture, inside: &[[f32; 3]], outside: &[[f32; 3]]) -> f32 {
    let confused = |samples: &[[f32; 3]], own: &Mixture, other: &Mixture| {
        let step = (samples.len() / 1000).max(1);
        let seen: Vec<bool> = samples.iter().step_by(step).map(|x| other.log_density(*x) > own.log_density(*x)).collect();
        seen.iter().filter(|c| **c).count() as f32 / seen.len().max(1) as f32
    };
    confused(inside, subject, background).max(confused(outside, background, subject))
}

/// 1 where the flow leads to the same colour, down to 1/4 where it does not.
fn faith(here: &[[f32; 3]], there: &[[f32; 3]], flow: &[[f32; 2]], width: usize) -> Vec<f32> {
    let height = here.len() / width.max(1);
    let at = |i: usize| {
        let (x, y) = ((i % width) as f32 + flow[i][0], (i / width) as f32 + flow[i][1]);
        let inside = x > -0.5 && y > -0.5 && x < width as f32 - 0.5 && y < height as f32 - 0.5;
        inside.then(|| there[y.round() as usize * width + x.round() as usize])
    };
    let step = |i: usize| at(i).map_or(30.0, |other| (0..3).map(|k| (here[i][k] - other[k]).powi(2)).sum::<f32>().sqrt());
    (0..here.len().min(flow.len())).map(|i| 1.0 - 0.75 * ((step(i) - 10.0) / 20.0).clamp(0.0, 1.0)).collect()
}

/// The previous mask at the places that the flow leads to, as a signed distance over `reach` px.
fn carried(mask: &GrayImage, flow: &[[f32; 2]], reach: f32) -> Vec<f32> {
    let (width, height) = (mask.width() as i64, mask.height() as i64);
    let moved = GrayImage::from_fn(mask.width(), mask.height(), |x, y| {
        let [dx, dy] = flow.get((y * mask.width() + x) as usize).copied().unwrap_or([0.0; 2]);
        let (sx, sy) = ((x as f32 + dx).round() as i64, (y as f32 + dy).round() as i64);
        let inside = (0..width).contains(&sx) && (0..height).contains(&sy);
        if inside { *mask.get_pixel(sx as u32, sy as u32) } else { Luma([0]) }
    });
    let (inside, outside) = (distance(&moved, true), distance(&moved, false));
    inside.iter().zip(&outside).map(|(i, o)| ((i - o) / reach).clamp(-4.0, 3.0)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Rgb;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    const SIZE: (u32, u32) = (160, 120);

    fn inside(t: usize, x: u32, y: u32) -> bool {
        let (dx, dy) = (f64::from(x) - 45.0 - 3.0 * t as f64, f64::from(y) - 60.0);
        let body = (dx / 26.0).powi(2) + (dy / 13.0).powi(2) < 1.0;
        let slope = 0.5 * (t as f64 * 0.8).sin();
        let leg = |at: f64, slope: f64| (0.0..34.0).contains(&dy) && (dx - at - slope * dy).abs() < 4.0;
        body || leg(-16.0, slope) || leg(15.0, -slope)
    }

    /// Colours of a meadow and of its stones, and how rough both are, grey levels.
    struct Ground {
        meadow: [f64; 3],
        stones: [f64; 3],
        rough: f64,
    }

    /// Stones of nearly the animal's colour, stones of its colour, rough sand of its colour.
    const NEAR: Ground = Ground { meadow: [90.0, 140.0, 70.0], stones: [156.0, 124.0, 72.0], rough: 18.0 };
    const SAME: Ground = Ground { meadow: [90.0, 140.0, 70.0], stones: [167.0, 121.0, 63.0], rough: 18.0 };
    const SAND: Ground = Ground { meadow: [165.0, 122.0, 66.0], stones: [160.0, 124.0, 70.0], rough: 40.0 };

    /// A smooth ochre animal on some ground; the truth.
    fn clip(n: usize, ground: &Ground) -> (Vec<RgbImage>, Vec<GrayImage>) {
        let mut random = ChaCha8Rng::seed_from_u64(8);
        // Blades and sand stay, the camera's noise does not.
        let texture: Vec<f64> = (0..SIZE.0 * SIZE.1).map(|_| ground.rough * (random.random::<f64>() - 0.5)).collect();
        let mut pixel = |t: usize, x: u32, y: u32| {
            let rough = if inside(t, x, y) { 0.0 } else { texture[(y * SIZE.0 + x) as usize] };
            let grain = rough + 6.0 * (random.random::<f64>() - 0.5);
            let stone = (x / 23 + y / 31).is_multiple_of(3);
            let base = if inside(t, x, y) {
                [170.0, 120.0, 60.0]
            } else if stone {
                ground.stones
            } else {
                ground.meadow
            };
            Rgb(base.map(|v: f64| (v + grain).clamp(0.0, 255.0) as u8))
        };
        let truth = |t: usize| GrayImage::from_fn(SIZE.0, SIZE.1, |x, y| Luma([if inside(t, x, y) { 255 } else { 0 }]));
        let frames = (0..n).map(|t| RgbImage::from_fn(SIZE.0, SIZE.1, |x, y| pixel(t, x, y))).collect();
        (frames, (0..n).map(truth).collect())
    }

    fn marks() -> Vec<Mark> {
        let mark = |frame, subject, [x, y, width, height]: [u32; 4]| Mark { frame, subject, rectangle: Rectangle { x, y, width, height } };
        vec![mark(0, true, [33, 54, 24, 12]), mark(0, false, [0, 0, 160, 40]), mark(0, false, [90, 40, 70, 80])]
    }

    fn iou(a: &GrayImage, b: &GrayImage) -> f64 {
        let both = a.iter().zip(b.iter()).filter(|(a, b)| **a > 0 && **b > 0).count();
        let either = a.iter().zip(b.iter()).filter(|(a, b)| **a > 0 || **b > 0).count();
        both as f64 / either as f64
    }

    fn score(options: &MaskOptions, marks: &[Mark], ground: &Ground) -> f64 {
        let (frames, truth) = clip(24, ground);
        let found = silhouettes(&frames, marks, options, &mut || true).unwrap();
        found.masks.iter().zip(&truth).map(|(m, t)| iou(m, t)).sum::<f64>() / 24.0
    }

    #[test]
    fn a_walker_on_ground_of_its_colour_is_found() {
        let full = MaskOptions::default();
        let kept = MaskOptions { update_every: 0, ..full.clone() };
        let near = score(&full, &marks(), &NEAR);
        let same = score(&full, &marks(), &SAME);
        let rough = score(&MaskOptions { smooth: false, ..full.clone() }, &marks(), &SAME);
        let [sand, learnt] = [&kept, &full].map(|options| score(options, &marks(), &SAND));
        println!("near {near:.3}; same {same:.3}, without smoothing {rough:.3}; sand {sand:.3}, its colours learnt anew {learnt:.3}");
        assert!(near > 0.97 && same > 0.65 && same > rough + 0.1, "{near} {same} {rough}");
        // Where colours tell little, learning them from the masks makes it worse.
        assert!(sand > 0.4 && sand > learnt + 0.05, "{sand} {learnt}");
    }

    #[test]
    fn rectangles_in_the_middle_of_the_clip_serve_both_directions() {
        let shifted: Vec<Mark> = marks()
            .into_iter()
            .map(|m| Mark { frame: 10, rectangle: Rectangle { x: m.rectangle.x + 30 * u32::from(m.subject), ..m.rectangle }, ..m })
            .filter(|m| m.subject || m.rectangle.x == 0)
            .collect();
        let found = score(&MaskOptions::default(), &shifted, &NEAR);
        assert!(found > 0.95, "{found}");
    }

    #[test]
    fn wrong_rectangles_are_errors_and_one_frame_is_enough() {
        let (frames, truth) = clip(1, &NEAR);
        let run = |marks: &[Mark]| silhouettes(&frames, marks, &MaskOptions::default(), &mut || true);
        let one = run(&marks()).unwrap();
        assert!(iou(&one.masks[0], &truth[0]) > 0.8);
        let wide = Mark { rectangle: Rectangle { x: 150, y: 0, width: 20, height: 5 }, ..marks()[0] };
        assert!(run(&[wide, marks()[1]]).unwrap_err().to_string().contains("150,0,20,5 on frame 0 is not inside the 160x120"));
        assert!(matches!(run(&[Mark { frame: 3, ..marks()[0] }]), Err(MaskError::Frame { frame: 3, last: 0 })));
        assert!(matches!(run(&marks()[..1]), Err(MaskError::NoColours("background"))));
        assert!(matches!(silhouettes(&[], &marks(), &MaskOptions::default(), &mut || true), Err(MaskError::Empty)));
        assert!(matches!(silhouettes(&frames, &marks(), &MaskOptions::default(), &mut || false), Err(MaskError::Stopped)));
    }
}
