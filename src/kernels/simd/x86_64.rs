//! The registers of x86-64: SSE2, which every CPU of this architecture has, AVX2 and AVX-512.

use super::vector::{Simd, Vector};
use crate::kernels::isa::{Avx2, Avx512, Portable};
use std::arch::x86_64::*;

macro_rules! vector {
    (
        $isa:ident: $type:ty, $lanes:literal lanes of $registers:literal, $splat:ident, $load:ident, $store:ident,
        |$a:ident, $b:ident, $c:ident| $madd:expr, |$from:ident| $widen:expr
    ) => {
        impl Simd for $isa {
            type F32 = $type;
        }

        // SAFETY: the intrinsics read and write one register of `LANES` elements, of any alignment.
        unsafe impl Vector for $type {
            type Isa = $isa;
            const LANES: usize = $lanes;
            const REGISTERS: usize = $registers;

            #[inline(always)]
            fn splat(_: $isa, x: f32) -> Self {
                // SAFETY: the token proves that the CPU has the instruction.
                unsafe { $splat(x) }
            }
            #[inline(always)]
            unsafe fn load(_: $isa, from: *const f32) -> Self {
                // SAFETY: the token proves that the CPU has the instruction; the caller's pointer is good for it.
                unsafe { $load(from) }
            }
            #[inline(always)]
            unsafe fn store(self, _: $isa, to: *mut f32) {
                // SAFETY: the token proves that the CPU has the instruction; the caller's pointer is good for it.
                unsafe { $store(to, self) }
            }
            #[inline(always)]
            fn madd(self, _: $isa, $b: Self, $c: Self) -> Self {
                let $a = self;
                // SAFETY: the token proves that the CPU has the instructions.
                unsafe { $madd }
            }
            #[inline(always)]
            unsafe fn widen_bf16(_: $isa, $from: *const u32) -> [Self; 2] {
                // SAFETY: the token proves that the CPU has the instructions; the caller's pointer is good for a register.
                unsafe { $widen }
            }
        }
    };
}

vector!(
    Avx512: __m512,
    16 lanes of 32,
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
    Avx2: __m256,
    8 lanes of 16,
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
    Portable: __m128,
    4 lanes of 16,
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
