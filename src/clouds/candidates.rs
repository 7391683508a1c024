//! Pictures laid out for [`super::correlate`]: the hypotheses of a pixel side by side.
//!
//! Hypothesis h of pixel p is the other view's value at p + h s. Along an axis or a diagonal (s or 1 / s whole) the values
//! p + h s of all p and h are lines of the picture, stored once; along other steps every row is sampled anew, bilinearly.
//!
//! Checked against sampling pixel by pixel, here and in [`super::correlate`].

use image::GrayImage;
use nalgebra::Vector2;
use rayon::prelude::*;
use std::ops::Range;

/// Lines that are read together: a quarter of a cache line, so that a tile's columns stay in the first cache.
const TILE: usize = 16;

/// A region with the windows' reach around it; it may leave the picture.
pub struct Padded {
    pub x: Range<isize>,
    pub y: Range<isize>,
}

impl Padded {
    /// The reference's values; 255 where unknown, which no known value matches.
    pub fn reference(&self, image: &GrayImage) -> Vec<u8> {
        let (width, height) = (image.width() as isize, image.height() as isize);
        let mut values = vec![u8::MAX; self.x.len() * self.y.len()];
        let (from, to) = (self.x.start.clamp(0, width), self.x.end.clamp(0, width));
        for (y, out) in self.y.clone().zip(values.chunks_exact_mut(self.x.len())) {
            if y >= 0 && y < height && from < to {
                let row = &image.as_raw()[(y * width + from) as usize..(y * width + to) as usize];
                let out = &mut out[(from - self.x.start) as usize..][..row.len()];
                out.iter_mut().zip(row).for_each(|(out, &value)| *out = if value == 0 { u8::MAX } else { value });
            }
        }
        values
    }
}

/// 0 outside.
#[inline(always)]
fn pixel(image: &GrayImage, x: isize, y: isize) -> u8 {
    let inside = x >= 0 && y >= 0 && x < image.width() as isize && y < image.height() as isize;
    if inside { image.as_raw()[y as usize * image.width() as usize + x as usize] } else { 0 }
}

/// Another view, stored so that a pixel's hypotheses lie side by side.
pub enum Candidates {
    /// Those of the padded pixel (x, y) begin at `origin + x per_x + y per_y`.
    Lines { data: Vec<u8>, origin: isize, per_x: isize, per_y: isize },
    /// Steps along no axis or diagonal: sampled again for every row.
    Sampled { image: GrayImage, step: Vector2<f64>, first: isize, corner: [isize; 2] },
}

impl Candidates {
    /// `depth` hypotheses from `first` on of every pixel of `padded`, `step` apart.
    pub fn new(image: &GrayImage, step: Vector2<f64>, padded: &Padded, first: isize, depth: usize) -> Self {
        // Steps come from an inverted matrix: 1 + 2e-16 must not cost an interpolation.
        let whole = |v: f64| ((v - v.round()).abs() < 1e-6).then_some(v.round() as isize);
        let fold = |s: f64| if s == 0.0 { None } else { whole(1.0 / s) };
        let axes = [(padded.x.start, padded.x.len()), (padded.y.start, padded.y.len())];
        let line = |fold, shear, main: usize| Lines { fold, shear, main, axes, first, depth }.of(image);
        match (whole(step.x), whole(step.y)) {
            (Some(x), Some(y)) if x != 0 => line(x, x * y, 0),
            (_, Some(0)) if fold(step.x).is_some() => line(fold(step.x).unwrap_or(1), 0, 0),
            (Some(0), _) if fold(step.y).is_some() => line(fold(step.y).unwrap_or(1), 0, 1),
            _ => Self::Sampled { image: image.clone(), step, first, corner: [padded.x.start, padded.y.start] },
        }
    }

    /// Buffer, place of the first pixel's hypotheses in it and distance to the next pixel's, for a row of the padded region.
    #[inline(always)]
    pub fn row<'a>(&'a self, y: usize, width: usize, depth: usize, scratch: &'a mut Vec<u8>) -> (&'a [u8], isize, isize) {
        match self {
            Self::Lines { data, origin, per_x, per_y } => (data, origin + y as isize * per_y, *per_x),
            Self::Sampled { image, step, first, corner } => {
                scratch.resize(width * depth, 0);
                for h in 0..depth {
                    let sample = Sample::new(step * (first + h as isize) as f64);
                    for x in 0..width {
                        scratch[x * depth + h] = sample.at(image, corner[0] + x as isize, corner[1] + y as isize);
                    }
                }
                (scratch, 0, depth as isize)
            }
        }
    }
}

/// How a picture is laid out in lines along a step of 1 / `fold` pixels of the main axis (0 is x, 1 is y) and `shear` / `fold`
/// of the other: padded pixel (m, n) lies on line n − shear m, its first hypothesis at place fold m.
struct Lines {
    fold: isize,
    shear: isize,
    main: usize,
    /// Start and length of the padded region along x and y.
    axes: [(isize, usize); 2],
    first: isize,
    depth: usize,
}

impl Lines {
    fn of(&self, image: &GrayImage) -> Candidates {
        let [(_, main), (_, other)] = [self.axes[self.main], self.axes[1 - self.main]];
        let far = main as isize - 1;
        let (lowest_place, lowest_line) = ((self.fold * far).min(0), (-self.shear * far).min(0));
        let length = (self.fold.abs() * far) as usize + self.depth;
        let count = other + (self.shear * far).unsigned_abs();
        let place = lowest_place + self.first;
        let mut data = vec![0u8; count * length];
        data.par_chunks_mut(TILE * length).enumerate().for_each(|(k, out)| {
            let line = (k * TILE) as isize + lowest_line;
            if self.fold.abs() == 1 {
                self.read_tile(image, line, place * self.fold, length, out);
            } else {
                out.chunks_exact_mut(length).zip(line..).for_each(|(out, line)| self.read_between(image, line, place, out));
            }
        });
        let length = length as isize;
        let per = [self.fold - self.shear * length, length];
        let origin = -lowest_line * length - lowest_place;
        Candidates::Lines { data, origin, per_x: per[self.main], per_y: per[1 - self.main] }
    }

    /// Lines of `length` from `first` on, main coordinates from `start` in steps of `fold`. Columns of the picture are read
    /// together, row by row, for the cache's sake.
    fn read_tile(&self, image: &GrayImage, first: isize, start: isize, length: usize, out: &mut [u8]) {
        let span = |line| self.span(image, line, start, self.fold, length);
        let count = out.len() / length;
        let spans: Vec<Span> = (first..).take(count).map(span).collect();
        let beside = spans.windows(2).all(|s| s[0].part == s[1].part && s[0].place + 1 == s[1].place);
        if !beside || self.main == 0 {
            return out.chunks_exact_mut(length).zip(&spans).for_each(|(out, span)| span.read(image, out));
        }
        let Some(span) = spans.first() else { return };
        let mut place = span.place;
        for k in span.part.clone() {
            for (j, value) in image.as_raw()[place as usize..][..count].iter().enumerate() {
                out[j * length + k] = *value;
            }
            place += span.per;
        }
    }

    /// A line from place `first` on, between the pixels where places are not whole.
    fn read_between(&self, image: &GrayImage, line: isize, first: isize, out: &mut [u8]) {
        let mut whole = vec![0; out.len() / self.fold.unsigned_abs() + 3];
        let start = first.div_euclid(self.fold);
        self.span(image, line, start, self.fold.signum(), whole.len()).read(image, &mut whole);
        for (out, place) in out.iter_mut().zip(first..) {
            let (steps, rest) = ((place.div_euclid(self.fold) - start).unsigned_abs(), place.rem_euclid(self.fold));
            *out = if rest == 0 { whole[steps] } else { between(whole[steps], whole[steps + 1], rest, self.fold.abs()) };
        }
    }

    /// The part in the picture of the `length` places of a line from main coordinate `start` on, in steps of ±1.
    fn span(&self, image: &GrayImage, line: isize, start: isize, step: isize, length: usize) -> Span {
        let [(main_start, _), (other_start, _)] = [self.axes[self.main], self.axes[1 - self.main]];
        let (width, height, length) = (image.width() as isize, image.height() as isize, length as isize);
        let at = |k: isize| {
            let m = start + k * step;
            let (m, n) = (m + main_start, line + self.shear * m + other_start);
            if self.main == 0 { [m, n] } else { [n, m] }
        };
        let ([x, y], [next_x, next_y]) = (at(0), at(1));
        let inside = |from: isize, per: isize, size: isize| match per {
            0 if from >= 0 && from < size => 0..length,
            0 => 0..0,
            1 => -from..size - from,
            _ => from + 1 - size..from + 1,
        };
        let (across, down) = (inside(x, next_x - x, width), inside(y, next_y - y, height));
        let (from, to) = (across.start.max(down.start).max(0), across.end.min(down.end).min(length));
        let part = if from < to { from as usize..to as usize } else { 0..0 };
        Span { part, place: at(from)[1] * width + at(from)[0], per: (next_y - y) * width + next_x - x }
    }
}

/// Places of a line that lie in the picture: the first one's pixel, and how far it is from pixel to pixel.
struct Span {
    part: Range<usize>,
    place: isize,
    per: isize,
}

impl Span {
    /// What lies outside of the picture stays.
    fn read(&self, image: &GrayImage, line: &mut [u8]) {
        let (line, raw, mut place) = (&mut line[self.part.clone()], image.as_raw(), self.place);
        if line.is_empty() {
            return;
        }
        match self.per {
            1 => line.copy_from_slice(&raw[place as usize..][..line.len()]),
            -1 => line.iter_mut().zip(raw[..=place as usize].iter().rev()).for_each(|(out, value)| *out = *value),
            per => line.iter_mut().for_each(|out| {
                *out = raw[place as usize];
                place += per;
            }),
        }
    }
}

/// Value `rest / parts` of the way from a to b; 0 where either is unknown.
fn between(a: u8, b: u8, rest: isize, parts: isize) -> u8 {
    if a == 0 || b == 0 { 0 } else { ((isize::from(a) * (parts - rest) + isize::from(b) * rest + parts / 2) / parts) as u8 }
}

/// A bilinear look at a shifted picture.
struct Sample {
    whole: [isize; 2],
    /// Of the upper left, upper right, lower left and lower right pixel, in 256ths.
    weights: [u32; 4],
}

impl Sample {
    fn new(shift: Vector2<f64>) -> Self {
        let whole = shift.map(f64::floor);
        let [x, y] = (shift - whole).map(|part| (part * 16.0).round() as u32).into();
        Self { whole: [whole.x as isize, whole.y as isize], weights: [(16 - x) * (16 - y), x * (16 - y), (16 - x) * y, x * y] }
    }

    fn at(&self, image: &GrayImage, x: isize, y: isize) -> u8 {
        let (x, y) = (x + self.whole[0], y + self.whole[1]);
        let mut sum = 128;
        for (weight, [dx, dy]) in self.weights.iter().zip([[0, 0], [1, 0], [0, 1], [1, 1]]) {
            let value = u32::from(pixel(image, x + dx, y + dy));
            if *weight > 0 && value == 0 {
                return 0;
            }
            sum += weight * value;
        }
        (sum >> 8) as u8
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Luma;
    use rand::RngExt;
    use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

    const SIZE: [u32; 2] = [61, 40];

    fn noise() -> GrayImage {
        let mut random = ChaCha8Rng::seed_from_u64(5);
        GrayImage::from_fn(SIZE[0], SIZE[1], |_, _| Luma([random.random_range(97..=159)]))
    }

    /// Value at a place, interpolated; 0 beside the picture.
    fn sample(image: &GrayImage, x: f64, y: f64) -> f64 {
        let mut sum = 0.0;
        for (u, v) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)].map(|(i, j)| (x.floor() + i, y.floor() + j)) {
            let weight = (1.0 - (x - u).abs()) * (1.0 - (y - v).abs());
            if weight > 1e-9 {
                let inside = u >= 0.0 && v >= 0.0 && u < f64::from(SIZE[0]) && v < f64::from(SIZE[1]);
                let value = if inside { image.get_pixel(u as u32, v as u32).0[0] } else { 0 };
                sum += weight * if value == 0 { f64::NAN } else { value.into() };
            }
        }
        if sum.is_nan() { 0.0 } else { sum }
    }

    #[test]
    fn all_steps_meet_sampling_pixel_by_pixel() {
        let image = noise();
        let padded = Padded { x: -3..58, y: 2..44 };
        // Weights off the axes are 16ths of a pixel: 62 grey levels between neighbours leave at most 4.
        let cases = [
            ([-1.0, 0.0], 0.0),
            ([1.0, 0.0], 0.0),
            ([0.0, -1.0], 0.0),
            ([0.0, 1.0], 0.0),
            ([-1.0, 1.0], 0.0),
            ([0.0, 0.5], 0.5),
            ([-0.7, 0.2], 4.0),
        ];
        for (step, tolerance) in cases {
            let candidates = Candidates::new(&image, step.into(), &padded, 4, 32);
            for y in 0..padded.y.len() {
                let mut scratch = Vec::new();
                let (data, origin, per_x) = candidates.row(y, padded.x.len(), 32, &mut scratch);
                for (x, h) in (0..padded.x.len()).flat_map(|x| (0..32).map(move |h| (x, h))) {
                    let [u, v] = [0, 1].map(|k| step[k] * (h + 4) as f64);
                    let expected = sample(&image, x as f64 - 3.0 + u, y as f64 + 2.0 + v);
                    let ours = f64::from(data[(origin + x as isize * per_x) as usize + h]);
                    assert!((ours - expected).abs() <= tolerance, "{step:?}: {x} {y} {h}: {ours} {expected}");
                }
            }
        }
    }
}
