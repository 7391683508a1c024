//! Correlation over all baselines in one pass, made coherent along three scanline paths.
//!
//! A hypothesis h moves pixel p of the reference to p + h s_k in view k, where the longest baseline's step has length 1.
//! With the gradient pictures G of [`super::prefilter`]:
//!   e_k(p, h) = min(|G_0(p) − G_k(p + h s_k)|, T),                                                  (1)
//!   e(p, h)   = min(e_1 + e_2, 2 min(e_1, e_2) + π)   with two pairs, e_1 with one,                 (2)
//!   C(p, h)   = mean of e over the (2r+1)² window of p,                                             (3)
//!   L(p, h)   = C(p, h) + min(L(q, h), L(q, h ± 1) + P1, min L(q, ·) + P2) − min L(q, ·),           (4)
//! S = sum of L over the paths from q = left, right and upper neighbour; the winner is the least S.
//!
//! (1) with one h for all baselines is Okutomi and Kanade's SSSD (1993); (2) lets a pixel count that one view does not see;
//! (4) is Hirschmueller (2008), with the three paths that need one row in memory (OpenCV's MODE_SGBM_3WAY). Sums run, so the
//! work does not depend on r. Everything but the sums of (3) fits 8 bits: T = 24 and P2 = 16 grey levels in half levels give
//! S <= 240. Bands of rows are independent; each starts its downward path [`WARM_UP_ROWS`] rows above itself.
//!
//! Checked against (1) to (4) as written, and the two instruction sets against each other.
//!
//! Tried on ten Middlebury pairs and the three-view cones (share of errors above 1 px on StereoBM's pixels as a ratio to
//! StereoBM's own, density; mean error of three views as a ratio to two):
//!
//! | cost                                                        | ratio | density | three/two |
//! |-------------------------------------------------------------|-------|---------|-----------|
//! | normalised by local mean and contrast, 5x5 + leaning, no (4) | 0.92  | 0.79    | 0.77      |
//! | the same, (4) in place of leaning windows                   | 0.83  | 0.95    | 0.58      |
//! | difference from local mean, (4)                             | 0.92  | 0.94    | 0.58      |
//! | gradient along the baseline, (4), P1 2, P2 12               | 0.67  | 0.94    | 0.59      |
//! | gradient over local mean gradient, (4)                      | 0.77  | 0.94    | 0.63      |
//! | gradient, P1 6, P2 16 (kept)                                | 0.57  | 0.95    | 0.57      |
//! | kept, window 3x3 / 7x7                                      | 0.89 / 0.64 | 0.91 / 0.96 | 0.62 / 0.60 |
//! | kept, 2 / 4 / 5 / 8 paths                                   | 0.65 / 0.62 / 0.60 / 0.62 | 0.94 to 0.95 | 0.57 to 0.63 |
//! | kept, costs in 1/8 or 1 grey level                          | 0.59 / 0.59 | 0.95 | 0.57 / 0.59 |

// The indexed loops over blocks are what the compiler unrolls.
#![allow(clippy::needless_range_loop)]

use super::candidates::{Candidates, Padded};
use super::lanes::{LANES, Lanes};
use image::GrayImage;
use nalgebra::Vector2;
use rayon::prelude::*;
use std::ops::Range;

/// T of (1), grey levels of the gradient picture.
const TRUNCATION: u8 = 24;
/// π of (2), grey levels.
const OCCLUSION_PENALTY: u8 = 16;
/// P1 and P2 of (4), half grey levels.
pub(super) const STEP_PENALTIES: [u8; 2] = [12, 32];
/// Rows of a band; more are slower to share out (frames are shared out too), fewer warm up more often.
const BAND_ROWS: usize = 240;
/// Rows until a path has forgotten where it began.
const WARM_UP_ROWS: usize = 6;
/// Largest r of (3).
pub const LARGEST_RADIUS: usize = 15;

/// Marks a pixel without any match.
pub const NO_MATCH: u16 = u16::MAX;

/// A box of pixels, half open.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Region {
    pub x: [usize; 2],
    pub y: [usize; 2],
}

impl Region {
    pub fn width(&self) -> usize {
        self.x[1] - self.x[0]
    }

    pub fn height(&self) -> usize {
        self.y[1] - self.y[0]
    }

    /// The box around two.
    pub fn around(self, other: Self) -> Self {
        let both = |a: [usize; 2], b: [usize; 2]| [a[0].min(b[0]), a[1].max(b[1])];
        Self { x: both(self.x, other.x), y: both(self.y, other.y) }
    }

    /// Its upper left pixel.
    pub fn corner(&self) -> [usize; 2] {
        [self.x[0], self.y[0]]
    }

    /// Where in the region, row by row, pixel `i` of a picture of this width is; `None` outside.
    pub fn place(&self, i: usize, width: usize) -> Option<usize> {
        let (x, y) = (i % width, i / width);
        let inside = (self.x[0]..self.x[1]).contains(&x) && (self.y[0]..self.y[1]).contains(&y);
        inside.then(|| (y - self.y[0]) * self.width() + x - self.x[0])
    }

    /// Where its rows lie in a picture of this width.
    pub fn rows(&self, width: usize) -> impl Iterator<Item = Range<usize>> {
        let [from, to] = self.x;
        (self.y[0]..self.y[1]).map(move |y| y * width + from..y * width + to)
    }

    /// Its part of a picture of this width.
    pub fn cut<T: Copy>(&self, values: &[T], width: usize) -> Vec<T> {
        let mut part = Vec::with_capacity(self.width() * self.height());
        self.rows(width).for_each(|row| part.extend_from_slice(&values[row]));
        part
    }
}

/// Gradient pictures of the reference and another view along their baseline; 0 where unknown.
pub struct Pair {
    pub reference: GrayImage,
    pub other: GrayImage,
    /// Pixels per hypothesis, no component above 1.
    pub step: Vector2<f64>,
}

/// Winner-take-all result for a region, row by row.
#[derive(Clone, Debug, PartialEq)]
pub struct Matches {
    pub region: Region,
    /// Best hypothesis or [`NO_MATCH`].
    pub best: Vec<u16>,
    pub scores: Vec<Scores>,
}

/// S just below, at and just above the best hypothesis, 255 beyond the range; and the lowest S more than one away from it.
pub type Scores = [u8; 4];

/// Finds the best of the hypotheses `range` for every pixel of `region`, with windows of half-width `radius` (1 to
/// [`LARGEST_RADIUS`]). One or two pairs of one picture size.
pub fn correlate(pairs: &[Pair], region: Region, range: Range<usize>, radius: usize) -> Matches {
    let job = Job::new(pairs, region, range, radius.clamp(1, LARGEST_RADIUS));
    let count = region.width() * region.height();
    let mut found = Matches { region, best: vec![NO_MATCH; count], scores: vec![[0; 4]; count] };
    let bands = region.height().div_ceil(BAND_ROWS).max(1);
    let rows = region.height().div_ceil(bands).max(1);
    let chunk = (rows * region.width()).max(1);
    let chunks = found.best.par_chunks_mut(chunk).zip(found.scores.par_chunks_mut(chunk));
    chunks.enumerate().for_each(|(band, (best, scores))| match_band(&job, band * rows, Band { best, scores }));
    found
}

/// Where the winners of some rows go.
struct Band<'a> {
    best: &'a mut [u16],
    scores: &'a mut [Scores],
}

/// Everything that the bands share. Coordinates of the padded region start r pixels outside of it.
struct Job {
    region: Region,
    range: Range<usize>,
    radius: usize,
    /// Hypotheses, a multiple of [`LANES`].
    depth: usize,
    /// Columns of the padded region.
    width: usize,
    pairs: Vec<PairRows>,
    /// How often costs are halved so that a column of a window fits 8 bits.
    halvings: u32,
    /// Window sum to mean in half grey levels, times 2^15.
    scale: i16,
}

struct PairRows {
    /// The padded region of [`Padded::reference`].
    reference: Vec<u8>,
    candidates: Candidates,
}

impl PairRows {
    #[inline(always)]
    fn reference_row(&self, y: usize, width: usize) -> &[u8] {
        &self.reference[y * width..][..width]
    }
}

impl Job {
    fn new(pairs: &[Pair], region: Region, range: Range<usize>, radius: usize) -> Self {
        let blocks = range.len().div_ceil(LANES);
        let depth = DEPTHS.into_iter().find(|d| *d >= blocks).unwrap_or(MOST_BLOCKS) * LANES;
        let padded = Padded {
            x: region.x[0] as isize - radius as isize..(region.x[1] + radius) as isize,
            y: region.y[0] as isize - radius as isize..(region.y[1] + radius) as isize,
        };
        let rows = |pair: &Pair| PairRows {
            reference: padded.reference(&pair.reference),
            candidates: Candidates::new(&pair.other, pair.step, &padded, range.start as isize, depth),
        };
        let side = 2 * radius + 1;
        let halvings = (0..).find(|h| (side * usize::from(2 * TRUNCATION)) >> h <= usize::from(u8::MAX)).unwrap_or(0);
        let scale = ((1 << (16 + halvings)) / (side * side * pairs.len().max(1))) as i16;
        let pairs = pairs.par_iter().map(rows).collect();
        Self { region, range, radius, depth, width: padded.x.len(), pairs, halvings, scale }
    }
}

/// Finds the winners of the rows of `band`, the first of which is `start`.
fn match_band(job: &Job, start: usize, band: Band) {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        return unsafe { match_band_avx2(job, start, band) };
    }
    match_band_with::<[u8; LANES]>(job, start, band);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn match_band_avx2(job: &Job, start: usize, band: Band) {
    match_band_with::<super::lanes::avx2::Register>(job, start, band);
}

/// Blocks of hypotheses that kernels are made for; the number in need is rounded up to one of them.
const DEPTHS: [usize; 9] = [1, 2, 3, 4, 6, 8, 12, 16, MOST_BLOCKS];
const MOST_BLOCKS: usize = 32;
/// Hypotheses beyond this many are not searched.
pub const MOST_HYPOTHESES: usize = MOST_BLOCKS * LANES;

#[inline(always)]
fn match_band_with<L: Lanes>(job: &Job, start: usize, band: Band) {
    match job.depth / LANES {
        1 => match_rows::<L, 1>(job, start, band),
        2 => match_rows::<L, 2>(job, start, band),
        3 => match_rows::<L, 3>(job, start, band),
        4 => match_rows::<L, 4>(job, start, band),
        6 => match_rows::<L, 6>(job, start, band),
        8 => match_rows::<L, 8>(job, start, band),
        12 => match_rows::<L, 12>(job, start, band),
        16 => match_rows::<L, 16>(job, start, band),
        _ => match_rows::<L, MOST_BLOCKS>(job, start, band),
    }
}

#[inline(always)]
fn match_rows<L: Lanes, const N: usize>(job: &Job, start: usize, band: Band) {
    let (side, width) = (2 * job.radius + 1, job.region.width());
    let end = start + band.best.len() / width.max(1);
    let mut rows = Rows::<N>::new(job);
    let first = start.saturating_sub(WARM_UP_ROWS);
    for (n, y) in (first..end + side - 1).enumerate() {
        if n + 1 < side {
            rows.enter::<L>(job, n % side, y);
            continue;
        }
        rows.forwards::<L>(job, n % side, y);
        if let Some(row) = (y + 1).checked_sub(side + start) {
            let values = &job.pairs[0].reference_row(y - job.radius, job.width)[job.radius..][..width];
            let row = row * width..(row + 1) * width;
            let out = Band { best: &mut band.best[row.clone()], scores: &mut band.scores[row] };
            rows.backwards::<L>(job, values, out);
        }
    }
}

/// All hypotheses of a pixel.
type Pixel<const N: usize> = [[u8; LANES]; N];

/// What is kept from row to row. Two sweeps make a row: forwards the costs, their means, the downward path and the path to the
/// right; backwards the path to the left and the winners. So each sweep waits for one path only, and works meanwhile.
struct Rows<const N: usize> {
    /// (2) of the rows in the windows.
    ring: Vec<Vec<Pixel<N>>>,
    /// Their sums over the rows.
    columns: Vec<Pixel<N>>,
    /// (3) in half grey levels.
    means: Vec<Pixel<N>>,
    /// L of the downward path, and its least values.
    down: Vec<Pixel<N>>,
    down_least: Vec<u8>,
    /// L of the downward and the right path together.
    sums: Vec<Pixel<N>>,
    /// S of a pixel between blocks of 255.
    whole: Vec<[u8; LANES]>,
    scratch: [Vec<u8>; 2],
}

impl<const N: usize> Rows<N> {
    fn new(job: &Job) -> Self {
        let (padded, row) = (vec![[[0; LANES]; N]; job.width], vec![[[0; LANES]; N]; job.region.width()]);
        let down_least = vec![0; row.len()];
        let ring = vec![padded.clone(); 2 * job.radius + 1];
        Self {
            ring,
            columns: padded,
            means: row.clone(),
            down: row.clone(),
            down_least,
            sums: row,
            whole: vec![[u8::MAX; LANES]; N + 2],
            scratch: Default::default(),
        }
    }

    /// Padded row `y` takes the place of the oldest in the columns.
    #[inline(always)]
    fn enter<L: Lanes>(&mut self, job: &Job, oldest: usize, y: usize) {
        let [scratch, second] = &mut self.scratch;
        let rows = CostRows::new(job, y, [scratch, second]);
        for (x, (old, column)) in self.ring[oldest].iter_mut().zip(&mut self.columns).enumerate() {
            rows.replace::<L, N>(job, x, old, column);
        }
    }

    /// [`Self::enter`], (3) and the two paths that come from above and from the left, in one sweep.
    #[inline(always)]
    fn forwards<L: Lanes>(&mut self, job: &Job, oldest: usize, y: usize) {
        let reach = 2 * job.radius;
        let Self { ring, columns, means, down, down_least, sums, scratch: [scratch, second], .. } = self;
        let rows = CostRows::new(job, y, [scratch, second]);
        let width = means.len();
        let (ring_start, ring) = ring[oldest].split_at_mut(reach);
        let ring = &mut ring[..width];
        let mut window = [L::wide_zero(); N];
        for x in 0..reach {
            let entering = rows.replace::<L, N>(job, x, &mut ring_start[x], &mut columns[x]);
            for k in 0..N {
                window[k] = L::wide_slide(window[k], entering[k], L::splat(0));
            }
        }
        let (down, down_least, sums) = (&mut down[..width], &mut down_least[..width], &mut sums[..width]);
        let mut leaving = [L::splat(0); N];
        let mut right = [L::splat(0); N];
        let mut right_least = L::splat(0);
        for x in 0..width {
            let entering = rows.replace::<L, N>(job, x + reach, &mut ring[x], &mut columns[x + reach]);
            let mut cost = [L::splat(0); N];
            for k in 0..N {
                window[k] = L::wide_slide(window[k], entering[k], leaving[k]);
                cost[k] = L::scaled(window[k], job.scale);
                cost[k].store(&mut means[x][k]);
                leaving[k] = L::load(&columns[x][k]);
            }
            let (below, least) = step(&cost, &loaded(&down[x]), L::splat(down_least[x]));
            down_least[x] = least.first();
            (right, right_least) = step(&cost, &right, right_least);
            for k in 0..N {
                below[k].store(&mut down[x][k]);
                below[k].add(right[k]).store(&mut sums[x][k]);
            }
        }
    }

    /// The path from the right, and the winners of the three paths together. `values` are the reference's.
    #[inline(always)]
    fn backwards<L: Lanes>(&mut self, job: &Job, values: &[u8], out: Band) {
        let mut left = [L::splat(0); N];
        let mut least = L::splat(0);
        let (first, last, width) = (job.range.start, job.range.end - 1, values.len());
        let Self { means, sums, whole, .. } = self;
        let (means, sums) = (&means[..width], &sums[..width]);
        let (best, scores) = (&mut out.best[..width], &mut out.scores[..width]);
        for x in (0..width).rev() {
            (left, least) = step(&loaded(&means[x]), &left, least);
            let mut sum = [L::splat(0); N];
            for k in 0..N {
                sum[k] = L::load(&sums[x][k]).add(left[k]);
            }
            let (winner, score) = winner(&sum, whole);
            scores[x] = score;
            best[x] = if values[x] == u8::MAX || first + winner > last { NO_MATCH } else { (first + winner) as u16 };
        }
    }
}

/// A row of the reference for each pair.
struct CostRows<'a> {
    first: CostRow<'a>,
    second: Option<CostRow<'a>>,
}

/// Values of the reference, and where the hypotheses of its pixels lie.
struct CostRow<'a> {
    values: &'a [u8],
    data: &'a [u8],
    /// Place of the first pixel's hypotheses, and distance to the next pixel's.
    origin: isize,
    per_x: isize,
}

impl<'a> CostRows<'a> {
    fn new(job: &'a Job, y: usize, [scratch, second_scratch]: [&'a mut Vec<u8>; 2]) -> Self {
        let of = |pair: &'a PairRows, scratch| {
            let (data, origin, per_x) = pair.candidates.row(y, job.width, job.depth, scratch);
            CostRow { values: pair.reference_row(y, job.width), data, origin, per_x }
        };
        Self { first: of(&job.pairs[0], scratch), second: job.pairs.get(1).map(|pair| of(pair, second_scratch)) }
    }

    /// The costs of pixel x take the place of the oldest in its column, which is returned.
    #[inline(always)]
    fn replace<L: Lanes, const N: usize>(&self, job: &Job, x: usize, old: &mut Pixel<N>, column: &mut Pixel<N>) -> [L; N] {
        let mut cost = truncated::<L, N>(&self.first, x);
        if let Some(second) = &self.second {
            let other = truncated::<L, N>(second, x);
            for k in 0..N {
                let lower = cost[k].min(other[k]);
                cost[k] = cost[k].add(other[k]).min(lower.add(lower).add(L::splat(OCCLUSION_PENALTY)));
            }
        }
        for k in 0..N {
            for _ in 0..job.halvings {
                cost[k] = cost[k].halved();
            }
            let sum = L::load(&column[k]).add(cost[k]).sub(L::load(&old[k]));
            sum.store(&mut column[k]);
            cost[k].store(&mut old[k]);
            cost[k] = sum;
        }
        cost
    }
}

/// Equation (1) at pixel x.
#[inline(always)]
fn truncated<L: Lanes, const N: usize>(row: &CostRow, x: usize) -> [L; N] {
    let value = L::splat(row.values[x]);
    let hypotheses = &row.data[(row.origin + x as isize * row.per_x) as usize..][..N * LANES].as_chunks::<LANES>().0[..N];
    let mut cost = [value; N];
    for k in 0..N {
        cost[k] = value.abs_diff(L::load(&hypotheses[k])).min(L::splat(TRUNCATION));
    }
    cost
}

#[inline(always)]
fn loaded<L: Lanes, const N: usize>(pixel: &Pixel<N>) -> [L; N] {
    let mut out = [L::splat(0); N];
    for k in 0..N {
        out[k] = L::load(&pixel[k]);
    }
    out
}

/// Equation (4): a path one pixel on, from L and its least value at the pixel before; and its least value there.
#[inline(always)]
fn step<L: Lanes, const N: usize>(costs: &[L; N], before: &[L; N], before_least: L) -> ([L; N], L) {
    let [small, large] = STEP_PENALTIES.map(L::splat);
    let (end, jump) = (L::splat(u8::MAX), before_least.add(large));
    let (mut here, mut least) = (*costs, end);
    for k in 0..N {
        let below = before[k].raised(if k > 0 { before[k - 1] } else { end });
        let above = before[k].lowered(if k + 1 < N { before[k + 1] } else { end });
        let beside = below.min(above).add_to_top(small);
        here[k] = before[k].min(beside).min(jump).sub(before_least).add(costs[k]);
        least = least.min(here[k]);
    }
    (here, least.least())
}

/// Three bytes that no minimum takes, in a row of bytes that any minimum takes.
const MIDDLE: [u8; 2 * LANES + 3] = {
    let mut row = [0; 2 * LANES + 3];
    row[LANES] = 255;
    row[LANES + 1] = 255;
    row[LANES + 2] = 255;
    row
};

/// The winner of a pixel from its S, which are left in `whole`.
#[inline(always)]
fn winner<L: Lanes, const N: usize>(sums: &[L; N], whole: &mut [[u8; LANES]]) -> (usize, Scores) {
    let mut least = sums[0];
    for sum in &sums[1..] {
        least = least.min(*sum);
    }
    let least = least.least();
    let mut best = 0;
    for k in (0..N).rev() {
        let bits = sums[k].equal(least);
        best = if bits != 0 { k * LANES + bits.trailing_zeros() as usize } else { best };
    }
    let mut other = L::splat(u8::MAX);
    let whole = &mut whole[..N + 2];
    for k in 0..N {
        let shift = (k * LANES + LANES + 1).saturating_sub(best).min(LANES + 3);
        if let Some(beside) = MIDDLE[shift..].first_chunk() {
            other = other.min(sums[k].or(L::load(beside)));
        }
        sums[k].store(&mut whole[k + 1]);
    }
    let mut scores = [u8::MAX; 4];
    if let Some(beside) = whole.as_flattened()[LANES - 1 + best..].first_chunk() {
        scores = *beside;
    }
    scores[3] = other.least().first();
    (best, scores)
}

#[cfg(test)]
mod tests;
