//! Gradient noise: solid, band-limited, the same on every machine.
//!
//! Perlin's (2002) improved noise: gradients on the integer lattice, quintic interpolation. One octave has its energy
//! between about half and one cycle per cell, so a cell of a few pixels neither aliases nor starves a correlation window.
//! Gradients come from an integer hash in place of Perlin's permutation table: no period, one seed per texture.

use nalgebra::Vector3;

/// One octave: cell size in metres and amplitude.
pub type Octave = (f64, f64);

/// Sum of octaves at a point in metres; roughly ±Σ amplitude, standard deviation about 0.27·√Σ amplitude².
pub fn octaves(x: &Vector3<f64>, octaves: &[Octave], seed: u32) -> f64 {
    // Seeds differ by octave, so that lattices of commensurable cells do not line up.
    octaves.iter().zip(seed..).map(|((cell, amplitude), s)| amplitude * gradient_noise(&(x / *cell), s.wrapping_mul(0x9e37_79b9))).sum()
}

/// One octave of unit cells, in about [−1, 1], zero on the lattice.
pub fn gradient_noise(x: &Vector3<f64>, seed: u32) -> f64 {
    let cell = x.map(f64::floor);
    let f = x - cell;
    let corner = |dx: i64, dy: i64, dz: i64| {
        let h = hash([cell.x as i64 + dx, cell.y as i64 + dy, cell.z as i64 + dz], seed);
        gradient_dot(h, f.x - dx as f64, f.y - dy as f64, f.z - dz as f64)
    };
    let s = f.map(|t| t * t * t * (t * (6.0 * t - 15.0) + 10.0));
    let mix = |a: f64, b: f64, t: f64| a + t * (b - a);
    let edge = |dy, dz| mix(corner(0, dy, dz), corner(1, dy, dz), s.x);
    mix(mix(edge(0, 0), edge(1, 0), s.y), mix(edge(0, 1), edge(1, 1), s.y), s.z)
}

/// Scalar product with one of the twelve edge directions of the cube.
fn gradient_dot(hash: u32, x: f64, y: f64, z: f64) -> f64 {
    let (u, v) = match (hash >> 2) % 3 {
        0 => (x, y),
        1 => (y, z),
        _ => (z, x),
    };
    (if hash & 1 == 0 { u } else { -u }) + (if hash & 2 == 0 { v } else { -v })
}

fn hash(cell: [i64; 3], seed: u32) -> u32 {
    let mut h = seed ^ 0x27d4_eb2f;
    for c in cell {
        h = (h ^ c as u32).wrapping_mul(0x85eb_ca6b);
        h ^= h >> 15;
        h = h.wrapping_mul(0xc2b2_ae35);
        h ^= h >> 13;
    }
    h
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_smooth_across_cells_zero_on_the_lattice_and_not_periodic() {
        let (mut sum, mut squares, mut repeats) = (0.0, 0.0, 0);
        for i in 0..4000 {
            let x = Vector3::new(i as f64 * 0.137, i as f64 * 0.071 - 90.0, (i % 61) as f64 * 0.29);
            let value = gradient_noise(&x, 7);
            sum += value;
            squares += value * value;
            assert!((gradient_noise(&x.map(f64::round), 7)).abs() < 1e-12);
            let near = x.map(f64::round) + Vector3::new(1e-7, -1e-7, 1e-7);
            assert!((gradient_noise(&near, 7) - gradient_noise(&(near - Vector3::new(2e-7, 0.0, 2e-7)), 7)).abs() < 2e-6);
            repeats += usize::from((gradient_noise(&(x + Vector3::repeat(256.0)), 7) - value).abs() < 0.01);
        }
        let deviation = (squares / 4000.0).sqrt();
        assert!(repeats < 200, "{repeats}");
        assert!((sum / 4000.0).abs() < 0.03 && (0.2..0.35).contains(&deviation), "{deviation}");
    }
}
