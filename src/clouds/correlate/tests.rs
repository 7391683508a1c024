use super::*;
use image::Luma;
use rand::RngExt;
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

const SIZE: [i64; 2] = [61, 40];

/// Values like those of gradient pictures, with holes.
fn noise(seed: u64) -> GrayImage {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut value = || if random.random_range(0..40) == 0 { 0 } else { random.random_range(97..=159) };
    GrayImage::from_fn(SIZE[0] as u32, SIZE[1] as u32, |_, _| Luma([value()]))
}

fn pair(seed: u64, step: [f64; 2]) -> Pair {
    Pair { reference: noise(1), other: noise(seed), step: step.into() }
}

fn read(image: &GrayImage, x: i64, y: i64) -> f64 {
    let inside = x >= 0 && y >= 0 && x < SIZE[0] && y < SIZE[1];
    if inside { f64::from(image.get_pixel(x as u32, y as u32).0[0]) } else { 0.0 }
}

/// Bilinear, rounded to a grey level; 0 where a pixel that counts is unknown.
fn sample(image: &GrayImage, x: f64, y: f64) -> f64 {
    let taps = [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)].map(|(i, j)| {
        let (u, v) = (x.floor() + i, y.floor() + j);
        ((1.0 - (x - u).abs()) * (1.0 - (y - v).abs()), read(image, u as i64, v as i64))
    });
    let counts = |weight: f64| weight > 1e-9;
    if taps.iter().any(|(weight, value)| counts(*weight) && *value == 0.0) {
        0.0
    } else {
        taps.iter().map(|(w, v)| w * v).sum::<f64>().round()
    }
}

/// Equations (1) and (2), grey levels.
fn pixel_cost(pairs: &[Pair], x: i64, y: i64, h: usize) -> u32 {
    let truncated = |pair: &Pair| {
        let a = read(&pair.reference, x, y);
        let b = sample(&pair.other, x as f64 + pair.step.x * h as f64, y as f64 + pair.step.y * h as f64);
        if a == 0.0 || b == 0.0 { 24 } else { ((a - b).abs() as u32).min(24) }
    };
    match pairs {
        [one] => truncated(one),
        _ => {
            let [a, b] = [truncated(&pairs[0]), truncated(&pairs[1])];
            (a + b).min(2 * a.min(b) + 16)
        }
    }
}

/// S of equation (4) for all pixels of the picture, `[y][x][h]`, whole hypotheses only.
fn by_definition(pairs: &[Pair], range: Range<usize>, radius: i64) -> Vec<Vec<Vec<u32>>> {
    let (width, height, depth) = (SIZE[0], SIZE[1], range.len());
    let halvings = [0, 0, 0, 1, 1, 2, 2, 2, 2][radius as usize];
    let mean = |x: i64, y: i64, h: usize| {
        let mut sum = 0;
        for v in y - radius..=y + radius {
            for u in x - radius..=x + radius {
                sum += (0..halvings).fold(pixel_cost(pairs, u, v, range.start + h), |c, _| c.div_ceil(2));
            }
        }
        let area = (2 * radius + 1) * (2 * radius + 1);
        (sum * ((1 << 16 << halvings) / (area as u32 * pairs.len() as u32)) + (1 << 14)) >> 15
    };
    let costs: Vec<Vec<Vec<u32>>> =
        (0..height).map(|y| (0..width).map(|x| (0..depth).map(|h| mean(x, y, h)).collect()).collect()).collect();
    let mut sums = vec![vec![vec![0; depth]; width as usize]; height as usize];
    for [dx, dy] in [[1, 0], [-1, 0], [0, 1]] {
        let mut path = vec![vec![vec![0u32; depth]; width as usize]; height as usize];
        for y in 0..height as usize {
            for k in 0..width as usize {
                let x = if dx < 0 { width as usize - 1 - k } else { k };
                let before = [x as i64 - dx, y as i64 - dy];
                let outside = before[0] < 0 || before[1] < 0 || before[0] >= width;
                let before = if outside { vec![0; depth] } else { path[before[1] as usize][before[0] as usize].clone() };
                let least = *before.iter().min().unwrap();
                for h in 0..depth {
                    let beside = [h.wrapping_sub(1), h + 1].iter().filter_map(|j| before.get(*j)).min().unwrap() + 12;
                    path[y][x][h] = costs[y][x][h] + before[h].min(beside).min(least + 32) - least;
                    sums[y][x][h] += path[y][x][h];
                }
            }
        }
    }
    sums
}

#[test]
fn running_sums_meet_the_definition() {
    let range = 3..3 + LANES;
    let region = Region { x: [0, SIZE[0] as usize], y: [0, SIZE[1] as usize] };
    let cases: [(&[[f64; 2]], usize); 6] = [
        (&[[-1.0, 0.0]], 2),
        (&[[-1.0, 0.0], [0.0, 1.0]], 2),
        (&[[1.0, 0.0], [1.0, -1.0]], 3),
        (&[[0.0, -1.0], [-1.0, -1.0]], 1),
        (&[[-1.0, 0.0], [-0.5, 0.0]], 2),
        (&[[0.0, 1.0], [0.0, -0.5]], 5),
    ];
    for (steps, radius) in cases {
        let pairs: Vec<Pair> = steps.iter().zip(2..).map(|(step, seed)| pair(seed, *step)).collect();
        let found = correlate(&pairs, region, range.clone(), radius);
        let expected = by_definition(&pairs, range.clone(), radius as i64);
        for (i, sums) in expected.iter().flatten().enumerate() {
            let known = pairs[0].reference.as_raw()[i] != 0;
            let best = (0..sums.len()).min_by_key(|h| sums[*h]).unwrap();
            let rival = (0..sums.len()).filter(|h| h.abs_diff(best) > 1).map(|h| sums[h]).min().unwrap();
            let cost = |h: usize| sums.get(h).map_or(255, |s| *s as u8);
            assert_eq!(found.best[i], if known { (best + 3) as u16 } else { NO_MATCH }, "{steps:?} pixel {i}");
            assert_eq!(found.scores[i], [cost(best.wrapping_sub(1)), cost(best), cost(best + 1), rival as u8], "{steps:?} pixel {i}");
        }
    }
}

#[test]
fn both_instruction_sets_give_the_same() {
    let pairs = [pair(2, [-1.0, 0.0]), pair(3, [0.0, 1.0])];
    let region = Region { x: [4, 50], y: [3, 37] };
    let found = correlate(&pairs, region, 5..90, 2);
    let (mut best, mut scores) = (vec![0; 46 * 34], vec![[0; 4]; 46 * 34]);
    let band = Band { best: &mut best, scores: &mut scores };
    match_band_with::<[u8; LANES]>(&Job::new(&pairs, region, 5..90, 2), 0, band);
    assert_eq!((found.best, found.scores), (best, scores));
}

#[test]
fn pixels_outside_every_view_have_no_say() {
    // The other view is the reference moved by 20 px; the band of 20 px without a partner stays expensive.
    let a = noise(4);
    let moved = GrayImage::from_fn(61, 40, |x, y| if x + 20 < 61 { *a.get_pixel(x + 20, y) } else { Luma([0]) });
    let found =
        correlate(&[Pair { reference: a, other: moved, step: Vector2::new(-1.0, 0.0) }], Region { x: [0, 61], y: [0, 40] }, 0..32, 2);
    let column = |x: usize| (5..35).map(move |y| y * 61 + x);
    assert!((30..61).flat_map(column).all(|i| found.best[i] == 20 || found.best[i] == NO_MATCH));
    assert!((0..12).flat_map(column).all(|i| found.scores[i][1] > 60));
}
