//! The micro-kernels of x86-64: products of bytes and of bf16 by the instructions made for them, or widened in registers.

use super::activations;
use super::format::WeightFormat;
use super::kernel::{GemmKernel, gemm_kernel};
use super::micro_kernel::DotProduct;
use super::quantise;
use super::widened::WidenedBf16;
use super::words::from_f32;
use crate::kernels::isa::{Avx2, Avx512, Avx512Bf16, Avx512Vnni, AvxVnni, Portable};
use std::arch::x86_64::*;

/// Defines a [`DotProduct`] of a register type; all that differs is the names of the instructions.
macro_rules! dot_product {
    (
        $(#[$meta:meta])* $name:ident, $isa:ident, $sum:ty, $left:ty, $right:ty, $words:literal x $lanes:literal, rows $rows:literal,
        $load:ident, $store:ident, left |$at:ident| $get:expr, right |$from:ident| $split:expr,
        |$acc:ident, $a:ident, $b:ident| $add:expr
    ) => {
        $(#[$meta])*
        pub(in crate::kernels) struct $name;

        // SAFETY: `load`, `store` and `right` go over one register of `LANES` words, `left` reads `WORDS`.
        unsafe impl DotProduct for $name {
            type Isa = $isa;
            type Sum = $sum;
            type Left = $left;
            type Right = $right;
            const LANES: usize = $lanes;
            const WORDS: usize = $words;
            const ROWS: usize = $rows;

            #[inline(always)]
            unsafe fn load(_: $isa, from: *const u32) -> $sum {
                // SAFETY: the token proves that the CPU has the instruction; the caller's pointer is good for a register.
                unsafe { $load(from.cast()) }
            }
            #[inline(always)]
            unsafe fn store(_: $isa, sum: $sum, to: *mut u32) {
                // SAFETY: the token proves that the CPU has the instruction; the caller's pointer is good for a register.
                unsafe { $store(to.cast(), sum) }
            }
            #[inline(always)]
            unsafe fn left(_: $isa, from: *const u32) -> $left {
                let $at = from.cast::<i32>();
                // SAFETY: the token proves that the CPU has the instructions; the caller's pointer is good for `WORDS`.
                unsafe { $get }
            }
            #[inline(always)]
            unsafe fn right(_: $isa, $from: *const u32) -> $right {
                // SAFETY: the token proves that the CPU has the instructions; the caller's pointer is good for a register.
                unsafe { $split }
            }
            #[inline(always)]
            fn add(_: $isa, $acc: $sum, $a: $left, $b: $right) -> $sum {
                // SAFETY: the token proves that the CPU has the instructions.
                unsafe { $add }
            }
        }
    };
}

dot_product!(
    /// bf16 by AVX512-BF16: two products a lane and instruction.
    Bf16Dot, Avx512Bf16, __m512, __m512i, __m512i, 1 x 16, rows 12, _mm512_loadu_ps, _mm512_storeu_ps,
    left |at| _mm512_set1_epi32(*at), right |from| _mm512_loadu_si512(from.cast()),
    |sum, a, b| _mm512_dpbf16_ps(sum, bf16_of(b), bf16_of(a))
);
dot_product!(
    /// Bytes by AVX512-VNNI. These instructions take activations as unsigned bytes.
    BytesVnni512, Avx512Vnni, __m512i, __m512i, __m512i, 1 x 16, rows 12, _mm512_loadu_si512, _mm512_storeu_si512,
    left |at| _mm512_set1_epi32(*at), right |from| _mm512_loadu_si512(from.cast()),
    |sum, a, b| _mm512_dpbusd_epi32(sum, a, b)
);
dot_product!(
    /// Bytes by AVX-VNNI.
    BytesVnni256, AvxVnni, __m256i, __m256i, __m256i, 1 x 8, rows 6, _mm256_loadu_si256, _mm256_storeu_si256,
    left |at| _mm256_set1_epi32(*at), right |from| _mm256_loadu_si256(from.cast()),
    |sum, a, b| _mm256_dpbusd_avx_epi32(sum, a, b)
);
dot_product!(
    /// Bytes by AVX512-BW: those at even and those at odd places, widened to 16 bits.
    PairsAvx512, Avx512, __m512i, [__m512i; 2], [__m512i; 2], 2 x 16, rows 12, _mm512_loadu_si512, _mm512_storeu_si512,
    left |at| [_mm512_set1_epi32(*at), _mm512_set1_epi32(*at.add(1))],
    right |from| {
        let word = _mm512_loadu_si512(from.cast());
        [_mm512_srai_epi16(_mm512_slli_epi16(word, 8), 8), _mm512_srai_epi16(word, 8)]
    },
    |sum, a, b| _mm512_add_epi32(_mm512_add_epi32(sum, _mm512_madd_epi16(a[0], b[0])), _mm512_madd_epi16(a[1], b[1]))
);
dot_product!(
    /// The same by AVX2.
    PairsAvx2, Avx2, __m256i, [__m256i; 2], [__m256i; 2], 2 x 8, rows 6, _mm256_loadu_si256, _mm256_storeu_si256,
    left |at| [_mm256_set1_epi32(*at), _mm256_set1_epi32(*at.add(1))],
    right |from| {
        let word = _mm256_loadu_si256(from.cast());
        [_mm256_srai_epi16(_mm256_slli_epi16(word, 8), 8), _mm256_srai_epi16(word, 8)]
    },
    |sum, a, b| _mm256_add_epi32(_mm256_add_epi32(sum, _mm256_madd_epi16(a[0], b[0])), _mm256_madd_epi16(a[1], b[1]))
);
dot_product!(
    /// The same by SSE2, which every CPU of this architecture has.
    PairsSse2, Portable, __m128i, [__m128i; 2], [__m128i; 2], 2 x 4, rows 6, _mm_loadu_si128, _mm_storeu_si128,
    left |at| [_mm_set1_epi32(*at), _mm_set1_epi32(*at.add(1))],
    right |from| {
        let word = _mm_loadu_si128(from.cast());
        [_mm_srai_epi16(_mm_slli_epi16(word, 8), 8), _mm_srai_epi16(word, 8)]
    },
    |sum, a, b| _mm_add_epi32(_mm_add_epi32(sum, _mm_madd_epi16(a[0], b[0])), _mm_madd_epi16(a[1], b[1]))
);

/// The same bits: the types differ in name only.
#[inline(always)]
fn bf16_of(words: __m512i) -> __m512bh {
    // SAFETY: both are 64 bytes, any of which are valid.
    unsafe { std::mem::transmute(words) }
}

/// [`activations::bf16_pairs`] by AVX512-BF16, to which subnormal values are zeros.
#[inline(always)]
fn bf16_pairs_avx512(_: Avx512Bf16, words: &mut [u32], x: &[f32]) -> f32 {
    let (whole, rest) = x.as_chunks::<32>();
    let (first, last) = words.split_at_mut(whole.len() * 16);
    for (words, x) in first.as_chunks_mut::<16>().0.iter_mut().zip(whole) {
        // SAFETY: the token proves that the CPU has the instructions; 32 values become 16 words.
        unsafe {
            let (low, high) = (_mm512_loadu_ps(x.as_ptr()), _mm512_loadu_ps(x.as_ptr().add(16)));
            let pairs = std::mem::transmute::<__m512bh, __m512>(_mm512_cvtne2ps_pbh(high, low));
            _mm512_storeu_ps(words.as_mut_ptr().cast(), pairs);
        }
    }
    from_f32(rest, last);
    1.0
}

gemm_kernel!(bf16_avx2(Avx2) = "avx2", 2, activations::widened_bf16, WidenedBf16<__m256, 6>);
gemm_kernel!(int8_avx2(Avx2) = "avx2", 4, quantise::unsigned_pairs, PairsAvx2);
gemm_kernel!(int8_avx_vnni(AvxVnni) = "avx2-vnni", 4, quantise::unsigned_bytes, BytesVnni256);
gemm_kernel!(bf16_avx512(Avx512) = "avx512", 2, activations::widened_bf16, WidenedBf16<__m512, 12>);
gemm_kernel!(bf16_avx512_bf16(Avx512Bf16) = "avx512-bf16", 2, bf16_pairs_avx512, Bf16Dot);
gemm_kernel!(int8_avx512(Avx512) = "avx512", 4, quantise::unsigned_pairs, PairsAvx512);
gemm_kernel!(int8_avx512_vnni(Avx512Vnni) = "avx512-vnni", 4, quantise::unsigned_bytes_avx512, BytesVnni512);

/// The kernels of AVX2: without its extensions, and with those that the CPU has.
pub(super) fn avx2_kernels(isa: Avx2, format: WeightFormat) -> (GemmKernel, Option<GemmKernel>) {
    match format {
        WeightFormat::Int8 => (int8_avx2(isa), AvxVnni::detect().map(int8_avx_vnni)),
        _ => (bf16_avx2(isa), None),
    }
}

/// The kernels of AVX-512: without its extensions, and with those that the CPU has.
pub(super) fn avx512_kernels(isa: Avx512, format: WeightFormat) -> (GemmKernel, Option<GemmKernel>) {
    match format {
        WeightFormat::Int8 => (int8_avx512(isa), Avx512Vnni::detect().map(int8_avx512_vnni)),
        _ => (bf16_avx512(isa), Avx512Bf16::detect().map(bf16_avx512_bf16)),
    }
}
