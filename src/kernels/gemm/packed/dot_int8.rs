//! Products of bytes, exact in i32: by the byte instructions of VNNI, or by pairs of 16-bit values.
//!
//! Activations are unsigned (128 is zero), as those instructions want them.

use super::tile::Dot;

/// Four i32 for the compiler to vectorise, where there is nothing better.
#[cfg(not(target_arch = "x86_64"))]
pub(in crate::kernels) struct Four;

#[cfg(not(target_arch = "x86_64"))]
impl Dot for Four {
    type Sum = [i32; 4];
    type Left = [[i32; 2]; 2];
    type Right = [u32; 4];
    const LANES: usize = 4;
    const WORDS: usize = 2;
    const ROWS: usize = 6;

    #[inline(always)]
    unsafe fn load(from: *const u32) -> [i32; 4] {
        // SAFETY: the caller's promise.
        unsafe { from.cast::<[i32; 4]>().read_unaligned() }
    }
    #[inline(always)]
    unsafe fn store(sum: [i32; 4], to: *mut u32) {
        // SAFETY: the caller's promise.
        unsafe { to.cast::<[i32; 4]>().write_unaligned(sum) }
    }
    #[inline(always)]
    unsafe fn left(from: *const u32) -> [[i32; 2]; 2] {
        // SAFETY: the caller's promise.
        let words = unsafe { [*from, *from.add(1)] };
        words.map(|w| [(w & 0xffff) as i32, (w >> 16) as i32])
    }
    #[inline(always)]
    unsafe fn right(from: *const u32) -> [u32; 4] {
        // SAFETY: the caller's promise.
        unsafe { from.cast::<[u32; 4]>().read_unaligned() }
    }
    #[inline(always)]
    unsafe fn add(sum: [i32; 4], [[a0, a2], [a1, a3]]: [[i32; 2]; 2], right: [u32; 4]) -> [i32; 4] {
        std::array::from_fn(|i| {
            let byte = |shift: u32| (right[i] << (24 - shift)) as i32 >> 24;
            sum[i] + a0 * byte(0) + a1 * byte(8) + a2 * byte(16) + a3 * byte(24)
        })
    }
}

#[cfg(target_arch = "x86_64")]
pub(in crate::kernels) mod x86 {
    use super::Dot;
    use std::arch::x86_64::*;

    /// Defines a [`Dot`] of a register type; all that differs is the names of the instructions.
    macro_rules! dot {
        (
            $(#[$meta:meta])* $name:ident, $register:ty, $left:ty, $right:ty, $words:literal x $lanes:literal, rows $rows:literal,
            $load:ident, $store:ident, left |$at:ident| $get:expr, right |$loaded:ident| $split:expr,
            |$sum:ident, $a:ident, $b:ident| $add:expr
        ) => {
            $(#[$meta])*
            pub(in crate::kernels) struct $name;

            impl Dot for $name {
                type Sum = $register;
                type Left = $left;
                type Right = $right;
                const LANES: usize = $lanes;
                const WORDS: usize = $words;
                const ROWS: usize = $rows;

                #[inline(always)]
                unsafe fn load(from: *const u32) -> $register {
                    // SAFETY: the caller's promise.
                    unsafe { $load(from.cast()) }
                }
                #[inline(always)]
                unsafe fn store(sum: $register, to: *mut u32) {
                    // SAFETY: the caller's promise.
                    unsafe { $store(to.cast(), sum) }
                }
                #[inline(always)]
                unsafe fn left(from: *const u32) -> $left {
                    let $at = from.cast::<i32>();
                    // SAFETY: the caller's promise.
                    unsafe { $get }
                }
                #[inline(always)]
                unsafe fn right(from: *const u32) -> $right {
                    // SAFETY: the caller's promise.
                    unsafe {
                        let $loaded = $load(from.cast());
                        $split
                    }
                }
                #[inline(always)]
                unsafe fn add($sum: $register, $a: $left, $b: $right) -> $register {
                    // SAFETY: the caller has the instruction set.
                    unsafe { $add }
                }
            }
        };
    }

    dot!(
        /// AVX512-VNNI.
        Vnni512, __m512i, __m512i, __m512i, 1 x 16, rows 12, _mm512_loadu_si512, _mm512_storeu_si512,
        left |at| _mm512_set1_epi32(*at), right |word| word,
        |sum, a, b| _mm512_dpbusd_epi32(sum, a, b)
    );
    dot!(
        /// AVX-VNNI.
        Vnni256, __m256i, __m256i, __m256i, 1 x 8, rows 6, _mm256_loadu_si256, _mm256_storeu_si256,
        left |at| _mm256_set1_epi32(*at), right |word| word,
        |sum, a, b| _mm256_dpbusd_avx_epi32(sum, a, b)
    );
    dot!(
        /// AVX512-BW: the bytes at even and at odd places, widened to 16 bits.
        Pairs512, __m512i, [__m512i; 2], [__m512i; 2], 2 x 16, rows 12, _mm512_loadu_si512, _mm512_storeu_si512,
        left |at| [_mm512_set1_epi32(*at), _mm512_set1_epi32(*at.add(1))],
        right |word| [_mm512_srai_epi16(_mm512_slli_epi16(word, 8), 8), _mm512_srai_epi16(word, 8)],
        |sum, a, b| _mm512_add_epi32(_mm512_add_epi32(sum, _mm512_madd_epi16(a[0], b[0])), _mm512_madd_epi16(a[1], b[1]))
    );
    dot!(
        /// AVX2, likewise.
        Pairs256, __m256i, [__m256i; 2], [__m256i; 2], 2 x 8, rows 6, _mm256_loadu_si256, _mm256_storeu_si256,
        left |at| [_mm256_set1_epi32(*at), _mm256_set1_epi32(*at.add(1))],
        right |word| [_mm256_srai_epi16(_mm256_slli_epi16(word, 8), 8), _mm256_srai_epi16(word, 8)],
        |sum, a, b| _mm256_add_epi32(_mm256_add_epi32(sum, _mm256_madd_epi16(a[0], b[0])), _mm256_madd_epi16(a[1], b[1]))
    );
    dot!(
        /// SSE2, which every machine of this architecture has.
        Pairs128, __m128i, [__m128i; 2], [__m128i; 2], 2 x 4, rows 6, _mm_loadu_si128, _mm_storeu_si128,
        left |at| [_mm_set1_epi32(*at), _mm_set1_epi32(*at.add(1))],
        right |word| [_mm_srai_epi16(_mm_slli_epi16(word, 8), 8), _mm_srai_epi16(word, 8)],
        |sum, a, b| _mm_add_epi32(_mm_add_epi32(sum, _mm_madd_epi16(a[0], b[0])), _mm_madd_epi16(a[1], b[1]))
    );
}
