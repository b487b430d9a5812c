//! The few vector operations of the matrix micro-kernel, for each register width.

/// A register of f32. The compiler keeps arrays of these in registers, which it does not do for a
/// large array of f32.
///
/// # Safety
/// Each function may be called only where the CPU has the type's instruction set; pointers must be
/// good for `LANES` elements, of any alignment.
pub(in crate::kernels) trait Vector: Copy {
    const LANES: usize;
    unsafe fn splat(x: f32) -> Self;
    unsafe fn load(from: *const f32) -> Self;
    unsafe fn store(self, to: *mut f32);
    /// `self * b + c`.
    unsafe fn madd(self, b: Self, c: Self) -> Self;
    /// The lower and the upper halves of `LANES` words as f32: what bf16 pairs are widened by.
    unsafe fn halves(from: *const u32) -> [Self; 2];
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::Vector;
    use std::arch::x86_64::*;

    macro_rules! vector {
        ($type:ty, $lanes:literal, $splat:ident, $load:ident, $store:ident, |$a:ident, $b:ident, $c:ident| $madd:expr, |$from:ident| $halves:expr) => {
            impl Vector for $type {
                const LANES: usize = $lanes;
                #[inline(always)]
                unsafe fn splat(x: f32) -> Self {
                    // SAFETY: the caller has the instruction set.
                    unsafe { $splat(x) }
                }
                #[inline(always)]
                unsafe fn load(from: *const f32) -> Self {
                    // SAFETY: the caller has the instruction set and a good pointer.
                    unsafe { $load(from) }
                }
                #[inline(always)]
                unsafe fn store(self, to: *mut f32) {
                    // SAFETY: the caller has the instruction set and a good pointer.
                    unsafe { $store(to, self) }
                }
                #[inline(always)]
                unsafe fn madd(self, $b: Self, $c: Self) -> Self {
                    let $a = self;
                    // SAFETY: the caller has the instruction set.
                    unsafe { $madd }
                }
                #[inline(always)]
                unsafe fn halves($from: *const u32) -> [Self; 2] {
                    // SAFETY: the caller has the instruction set and a good pointer.
                    unsafe { $halves }
                }
            }
        };
    }
    vector!(
        __m512,
        16,
        _mm512_set1_ps,
        _mm512_loadu_ps,
        _mm512_storeu_ps,
        |a, b, c| _mm512_fmadd_ps(a, b, c),
        |from| {
            let words = _mm512_loadu_si512(from.cast());
            let upper = _mm512_and_si512(words, _mm512_set1_epi32(-0x1_0000));
            [_mm512_castsi512_ps(_mm512_slli_epi32(words, 16)), _mm512_castsi512_ps(upper)]
        }
    );
    vector!(
        __m256,
        8,
        _mm256_set1_ps,
        _mm256_loadu_ps,
        _mm256_storeu_ps,
        |a, b, c| _mm256_fmadd_ps(a, b, c),
        |from| {
            let words = _mm256_loadu_si256(from.cast());
            let upper = _mm256_and_si256(words, _mm256_set1_epi32(-0x1_0000));
            [_mm256_castsi256_ps(_mm256_slli_epi32(words, 16)), _mm256_castsi256_ps(upper)]
        }
    );
    vector!(
        __m128,
        4,
        _mm_set1_ps,
        _mm_loadu_ps,
        _mm_storeu_ps,
        |a, b, c| _mm_add_ps(_mm_mul_ps(a, b), c),
        |from| {
            let words = _mm_loadu_si128(from.cast());
            let upper = _mm_and_si128(words, _mm_set1_epi32(-0x1_0000));
            [_mm_castsi128_ps(_mm_slli_epi32(words, 16)), _mm_castsi128_ps(upper)]
        }
    );
}

#[cfg(target_arch = "aarch64")]
mod neon {
    use super::Vector;
    use std::arch::aarch64::*;

    impl Vector for float32x4_t {
        const LANES: usize = 4;
        #[inline(always)]
        unsafe fn splat(x: f32) -> Self {
            // SAFETY: NEON is part of what this architecture's code is compiled for.
            unsafe { vdupq_n_f32(x) }
        }
        #[inline(always)]
        unsafe fn load(from: *const f32) -> Self {
            // SAFETY: the caller's pointer is good for four elements.
            unsafe { vld1q_f32(from) }
        }
        #[inline(always)]
        unsafe fn store(self, to: *mut f32) {
            // SAFETY: the caller's pointer is good for four elements.
            unsafe { vst1q_f32(to, self) }
        }
        #[inline(always)]
        unsafe fn madd(self, b: Self, c: Self) -> Self {
            // SAFETY: as above.
            unsafe { vfmaq_f32(c, self, b) }
        }
        #[inline(always)]
        unsafe fn halves(from: *const u32) -> [Self; 2] {
            // SAFETY: the caller's pointer is good for four words.
            unsafe {
                let words = vld1q_u32(from);
                let upper = vandq_u32(words, vdupq_n_u32(0xffff_0000));
                [vreinterpretq_f32_u32(vshlq_n_u32::<16>(words)), vreinterpretq_f32_u32(upper)]
            }
        }
    }
}

/// The register of portable code: on x86-64 the one that every machine has.
#[cfg(target_arch = "x86_64")]
pub(in crate::kernels) type Baseline = std::arch::x86_64::__m128;
#[cfg(not(target_arch = "x86_64"))]
pub(in crate::kernels) type Baseline = Four;

/// Four f32 for the compiler to vectorise.
#[derive(Clone, Copy)]
#[cfg_attr(target_arch = "x86_64", allow(dead_code))]
pub(in crate::kernels) struct Four([f32; 4]);

impl Vector for Four {
    const LANES: usize = 4;
    #[inline(always)]
    unsafe fn splat(x: f32) -> Self {
        Four([x; 4])
    }
    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        // SAFETY: the caller's pointer is good for four elements.
        Four(unsafe { from.cast::<[f32; 4]>().read_unaligned() })
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        // SAFETY: the caller's pointer is good for four elements.
        unsafe { to.cast::<[f32; 4]>().write_unaligned(self.0) }
    }
    #[inline(always)]
    unsafe fn madd(self, b: Self, c: Self) -> Self {
        Four(std::array::from_fn(|i| super::math::madd::<4>(self.0[i], b.0[i], c.0[i])))
    }
    #[inline(always)]
    unsafe fn halves(from: *const u32) -> [Self; 2] {
        // SAFETY: the caller's pointer is good for four words.
        let words = unsafe { from.cast::<[u32; 4]>().read_unaligned() };
        [Four(words.map(|w| f32::from_bits(w << 16))), Four(words.map(|w| f32::from_bits(w & 0xffff_0000)))]
    }
}
