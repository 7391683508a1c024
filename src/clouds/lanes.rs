//! Thirty-two bytes at a time: AVX2 where the processor has it, plain arrays elsewhere, the same bytes from both.
//!
//! Kernels are written once over [`Lanes`] and must be `#[inline(always)]` up to the function that enables AVX2; outside of it
//! the intrinsics would be calls.

// Indexed loops of fixed length are what the compiler turns into vectors.
#![allow(clippy::needless_range_loop)]

/// Number of bytes in a block.
pub const LANES: usize = 32;

/// A block of [`LANES`] unsigned bytes.
pub trait Lanes: Copy {
    /// As many 16-bit numbers, in an order of its own.
    type Wide: Copy;
    fn load(from: &[u8; LANES]) -> Self;
    fn store(self, to: &mut [u8; LANES]);
    fn splat(value: u8) -> Self;
    fn min(self, other: Self) -> Self;
    fn abs_diff(self, other: Self) -> Self;
    /// Sum that stays at 255.
    fn add_to_top(self, other: Self) -> Self;
    /// Sum modulo 256.
    fn add(self, other: Self) -> Self;
    /// Difference modulo 256.
    fn sub(self, other: Self) -> Self;
    fn or(self, other: Self) -> Self;
    /// Half, rounded up.
    fn halved(self) -> Self;
    /// The least byte in all places.
    fn least(self) -> Self;
    fn first(self) -> u8;
    /// Bit i is set where byte i equals the other's.
    fn equal(self, other: Self) -> u32;
    /// Every byte one place up, the last of `before` first.
    fn raised(self, before: Self) -> Self;
    /// Every byte one place down, the first of `after` last.
    fn lowered(self, after: Self) -> Self;
    fn wide_zero() -> Self::Wide;
    /// wide + entering - leaving.
    fn wide_slide(wide: Self::Wide, entering: Self, leaving: Self) -> Self::Wide;
    /// wide * factor / 2^15, rounded, for wide and factor below 2^15 and results below 256.
    fn scaled(wide: Self::Wide, factor: i16) -> Self;
}

#[inline(always)]
fn each(f: impl Fn(usize) -> u8) -> [u8; LANES] {
    let mut out = [0; LANES];
    for i in 0..LANES {
        out[i] = f(i);
    }
    out
}

impl Lanes for [u8; LANES] {
    type Wide = [u16; LANES];
    #[inline(always)]
    fn load(from: &[u8; LANES]) -> Self {
        *from
    }
    #[inline(always)]
    fn store(self, to: &mut [u8; LANES]) {
        *to = self;
    }
    #[inline(always)]
    fn splat(value: u8) -> Self {
        [value; LANES]
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        each(|i| self[i].min(other[i]))
    }
    #[inline(always)]
    fn abs_diff(self, other: Self) -> Self {
        each(|i| self[i].abs_diff(other[i]))
    }
    #[inline(always)]
    fn add_to_top(self, other: Self) -> Self {
        each(|i| self[i].saturating_add(other[i]))
    }
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        each(|i| self[i].wrapping_add(other[i]))
    }
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        each(|i| self[i].wrapping_sub(other[i]))
    }
    #[inline(always)]
    fn or(self, other: Self) -> Self {
        each(|i| self[i] | other[i])
    }
    #[inline(always)]
    fn halved(self) -> Self {
        each(|i| self[i].div_ceil(2))
    }
    #[inline(always)]
    fn least(self) -> Self {
        [self.into_iter().fold(u8::MAX, u8::min); LANES]
    }
    #[inline(always)]
    fn first(self) -> u8 {
        self[0]
    }
    #[inline(always)]
    fn equal(self, other: Self) -> u32 {
        (0..LANES).fold(0, |bits, i| bits | u32::from(self[i] == other[i]) << i)
    }
    #[inline(always)]
    fn raised(self, before: Self) -> Self {
        each(|i| if i > 0 { self[i - 1] } else { before[LANES - 1] })
    }
    #[inline(always)]
    fn lowered(self, after: Self) -> Self {
        each(|i| if i + 1 < LANES { self[i + 1] } else { after[0] })
    }
    #[inline(always)]
    fn wide_zero() -> Self::Wide {
        [0; LANES]
    }
    #[inline(always)]
    fn wide_slide(mut wide: Self::Wide, entering: Self, leaving: Self) -> Self::Wide {
        for i in 0..LANES {
            wide[i] = wide[i].wrapping_add(u16::from(entering[i])).wrapping_sub(u16::from(leaving[i]));
        }
        wide
    }
    #[inline(always)]
    fn scaled(wide: Self::Wide, factor: i16) -> Self {
        each(|i| ((i32::from(wide[i]) * i32::from(factor) + (1 << 14)) >> 15) as u8)
    }
}

#[cfg(target_arch = "x86_64")]
pub mod avx2 {
    use super::{LANES, Lanes};
    use std::arch::x86_64::*;

    /// A block in a register. Only for code below a function with the target feature `avx2`.
    #[derive(Clone, Copy)]
    pub struct Register(__m256i);

    // SAFETY of all intrinsics here: kernels use this type only after `is_x86_feature_detected!("avx2")`.
    impl Lanes for Register {
        type Wide = [__m256i; 2];
        #[inline(always)]
        fn load(from: &[u8; LANES]) -> Self {
            // SAFETY: the array is a whole block; unaligned loads are allowed.
            Self(unsafe { _mm256_loadu_si256(from.as_ptr().cast()) })
        }
        #[inline(always)]
        fn store(self, to: &mut [u8; LANES]) {
            // SAFETY: the array is a whole block; unaligned stores are allowed.
            unsafe { _mm256_storeu_si256(to.as_mut_ptr().cast(), self.0) }
        }
        #[inline(always)]
        fn splat(value: u8) -> Self {
            Self(unsafe { _mm256_set1_epi8(value as i8) })
        }
        #[inline(always)]
        fn min(self, other: Self) -> Self {
            Self(unsafe { _mm256_min_epu8(self.0, other.0) })
        }
        #[inline(always)]
        fn abs_diff(self, other: Self) -> Self {
            Self(unsafe { _mm256_or_si256(_mm256_subs_epu8(self.0, other.0), _mm256_subs_epu8(other.0, self.0)) })
        }
        #[inline(always)]
        fn add_to_top(self, other: Self) -> Self {
            Self(unsafe { _mm256_adds_epu8(self.0, other.0) })
        }
        #[inline(always)]
        fn add(self, other: Self) -> Self {
            Self(unsafe { _mm256_add_epi8(self.0, other.0) })
        }
        #[inline(always)]
        fn sub(self, other: Self) -> Self {
            Self(unsafe { _mm256_sub_epi8(self.0, other.0) })
        }
        #[inline(always)]
        fn or(self, other: Self) -> Self {
            Self(unsafe { _mm256_or_si256(self.0, other.0) })
        }
        #[inline(always)]
        fn halved(self) -> Self {
            Self(unsafe { _mm256_avg_epu8(self.0, _mm256_setzero_si256()) })
        }
        #[inline(always)]
        fn least(self) -> Self {
            unsafe {
                let half = _mm_min_epu8(_mm256_castsi256_si128(self.0), _mm256_extracti128_si256::<1>(self.0));
                // The shift brings a zero above each byte, and so does the minimum.
                let pairs = _mm_min_epu8(half, _mm_srli_epi16::<8>(half));
                Self(_mm256_broadcastb_epi8(_mm_minpos_epu16(pairs)))
            }
        }
        #[inline(always)]
        fn first(self) -> u8 {
            unsafe { _mm256_extract_epi8::<0>(self.0) as u8 }
        }
        #[inline(always)]
        fn equal(self, other: Self) -> u32 {
            unsafe { _mm256_movemask_epi8(_mm256_cmpeq_epi8(self.0, other.0)) as u32 }
        }
        #[inline(always)]
        fn raised(self, before: Self) -> Self {
            unsafe {
                let straddling = _mm256_permute2x128_si256::<0x21>(before.0, self.0);
                Self(_mm256_alignr_epi8::<15>(self.0, straddling))
            }
        }
        #[inline(always)]
        fn lowered(self, after: Self) -> Self {
            unsafe {
                let straddling = _mm256_permute2x128_si256::<0x21>(self.0, after.0);
                Self(_mm256_alignr_epi8::<1>(straddling, self.0))
            }
        }
        #[inline(always)]
        fn wide_zero() -> Self::Wide {
            unsafe { [_mm256_setzero_si256(); 2] }
        }
        #[inline(always)]
        fn wide_slide([low, high]: Self::Wide, entering: Self, leaving: Self) -> Self::Wide {
            unsafe {
                // Pairs of bytes times 1 and -1.
                let change = |pairs| _mm256_maddubs_epi16(pairs, _mm256_set1_epi16(-0xff));
                let (low_pairs, high_pairs) = (_mm256_unpacklo_epi8(entering.0, leaving.0), _mm256_unpackhi_epi8(entering.0, leaving.0));
                [_mm256_add_epi16(low, change(low_pairs)), _mm256_add_epi16(high, change(high_pairs))]
            }
        }
        #[inline(always)]
        fn scaled([low, high]: Self::Wide, factor: i16) -> Self {
            unsafe {
                let factor = _mm256_set1_epi16(factor);
                Self(_mm256_packus_epi16(_mm256_mulhrs_epi16(low, factor), _mm256_mulhrs_epi16(high, factor)))
            }
        }
    }
}
