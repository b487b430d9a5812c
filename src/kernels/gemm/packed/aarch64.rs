//! The micro-kernels of 64-bit Arm. What the instructions do stands in the Arm Architecture Reference Manual.

use super::activations;
use super::format::WeightFormat;
use super::kernel::{GemmKernel, gemm_kernel};
use super::neon::{FourWords, LANES, NeonMicroKernel};
use super::panels::PANEL_WIDTH;
use super::quantise;
use crate::kernels::isa::{Neon, NeonBf16, NeonDotProd, compiled_for};
use std::arch::aarch64::*;
use std::arch::asm;

/// `load` and `store` of four sums for the token `$isa`.
macro_rules! sums {
    ($isa:ident, $sum:ty, $load:ident, $store:ident) => {
        type Isa = $isa;
        type Sum = $sum;
        #[inline(always)]
        unsafe fn load(_: $isa, from: *const u32) -> $sum {
            // SAFETY: the token proves that the CPU has NEON; the caller's pointer is good for four words.
            unsafe { $load(from.cast()) }
        }
        #[inline(always)]
        unsafe fn store(_: $isa, sum: $sum, to: *mut u32) {
            // SAFETY: the token proves that the CPU has NEON; the caller's pointer is good for four words.
            unsafe { $store(to.cast(), sum) }
        }
    };
}

/// Four steps as they lie.
///
/// # Safety
/// As [`FourWords::right`], for one word of a row in one step; the CPU must have NEON.
#[inline(always)]
unsafe fn four_steps(from: *const u32) -> [uint32x4_t; LANES] {
    // SAFETY: the caller's pointer is good for four words of four steps.
    std::array::from_fn(|step| unsafe { vld1q_u32(from.add(step * PANEL_WIDTH)) })
}

/// bf16 widened to f32: a word of a row is one value, a step has two.
struct NeonWidenedBf16;

// SAFETY: `load` and `store` go over one register; `right` reads one of each of two steps.
unsafe impl FourWords for NeonWidenedBf16 {
    const WORDS: usize = 2;
    sums!(Neon, float32x4_t, vld1q_f32, vst1q_f32);

    #[inline(always)]
    unsafe fn right(_: Neon, from: *const u32) -> [uint32x4_t; LANES] {
        // SAFETY: the token proves that the CPU has NEON; the caller's pointer is good for four words of two steps.
        unsafe {
            let [a, b] = [vld1q_u32(from), vld1q_u32(from.add(PANEL_WIDTH))];
            let upper = vdupq_n_u32(0xffff_0000);
            [vshlq_n_u32::<16>(a), vandq_u32(a, upper), vshlq_n_u32::<16>(b), vandq_u32(b, upper)]
        }
    }

    #[inline(always)]
    fn add<const PLACE: i32>(_: Neon, sum: float32x4_t, left: uint32x4_t, right: uint32x4_t) -> float32x4_t {
        // SAFETY: the token proves that the CPU has NEON.
        unsafe { vfmaq_laneq_f32::<PLACE>(sum, vreinterpretq_f32_u32(right), vreinterpretq_f32_u32(left)) }
    }
}

/// Bytes widened to 16 bits: a row's words hold the values 0 and 2, then 1 and 3, of a step.
struct NeonBytes;

// SAFETY: `load` and `store` go over one register; `right` reads one of each of two steps.
unsafe impl FourWords for NeonBytes {
    const WORDS: usize = 2;
    sums!(Neon, int32x4_t, vld1q_s32, vst1q_s32);

    /// The bytes 0 and 1, then 2 and 3, of the first and of the second step, for all four channels each.
    #[inline(always)]
    unsafe fn right(_: Neon, from: *const u32) -> [uint32x4_t; LANES] {
        // SAFETY: the token proves that the CPU has NEON; the caller's pointer is good for four words of two steps.
        let pairs = |step: usize| unsafe {
            let bytes = vreinterpretq_s16_u32(vld1q_u32(from.add(step * PANEL_WIDTH)));
            let (even, odd) = (vshrq_n_s16::<8>(vshlq_n_s16::<8>(bytes)), vshrq_n_s16::<8>(bytes));
            [vreinterpretq_u32_s16(vuzp1q_s16(even, odd)), vreinterpretq_u32_s16(vuzp2q_s16(even, odd))]
        };
        let [[a, b], [c, d]] = [pairs(0), pairs(1)];
        [a, b, c, d]
    }

    #[inline(always)]
    fn add<const PLACE: i32>(_: Neon, sum: int32x4_t, left: uint32x4_t, right: uint32x4_t) -> int32x4_t {
        macro_rules! two {
            ($first:literal, $second:literal) => {
                // SAFETY: the token proves that the CPU has NEON.
                unsafe {
                    let (left, right) = (vreinterpretq_s16_u32(left), vreinterpretq_s16_u32(right));
                    let sum = vmlal_laneq_s16::<$first>(sum, vget_low_s16(right), left);
                    vmlal_high_laneq_s16::<$second>(sum, right, left)
                }
            };
        }
        match PLACE {
            0 => two!(0, 2),
            1 => two!(1, 3),
            2 => two!(4, 6),
            _ => two!(5, 7),
        }
    }
}

/// Pairs of bf16, by FEAT_BF16.
struct NeonBf16Dot;

// SAFETY: `load` and `store` go over one register; `right` reads one of each of four steps.
unsafe impl FourWords for NeonBf16Dot {
    const WORDS: usize = 1;
    sums!(NeonBf16, float32x4_t, vld1q_f32, vst1q_f32);

    #[inline(always)]
    unsafe fn right(_: NeonBf16, from: *const u32) -> [uint32x4_t; LANES] {
        // SAFETY: the token proves that the CPU has NEON; the caller's pointer is good for four words of four steps.
        unsafe { four_steps(from) }
    }

    #[inline(always)]
    fn add<const PLACE: i32>(
        isa: NeonBf16,
        sum: float32x4_t,
        left: uint32x4_t,
        right: uint32x4_t,
    ) -> float32x4_t {
        // SAFETY: the token proves that the CPU has FEAT_BF16.
        unsafe { bfdot::<PLACE>(isa, sum, left, right) }
    }
}

/// Four signed bytes, by FEAT_DotProd.
struct NeonBytesDot;

// SAFETY: `load` and `store` go over one register; `right` reads one of each of four steps.
unsafe impl FourWords for NeonBytesDot {
    const WORDS: usize = 1;
    sums!(NeonDotProd, int32x4_t, vld1q_s32, vst1q_s32);

    #[inline(always)]
    unsafe fn right(_: NeonDotProd, from: *const u32) -> [uint32x4_t; LANES] {
        // SAFETY: the token proves that the CPU has NEON; the caller's pointer is good for four words of four steps.
        unsafe { four_steps(from) }
    }

    #[inline(always)]
    fn add<const PLACE: i32>(
        isa: NeonDotProd,
        sum: int32x4_t,
        left: uint32x4_t,
        right: uint32x4_t,
    ) -> int32x4_t {
        // SAFETY: the token proves that the CPU has FEAT_DotProd.
        unsafe { sdot::<PLACE>(isa, sum, left, right) }
    }
}

// The standard library has no stable names for these two instructions.

compiled_for! {
    NeonBf16,
    /// Adds the products of the two bf16 of each word of `right` and of the `PLACE`th of `left`.
    ///
    /// It rounds to odd after the sum of the pair and again after adding it; subnormal values are zeros.
    #[inline]
    pub(in crate::kernels) fn bfdot<const PLACE: i32>(
        _: NeonBf16,
        mut sum: float32x4_t,
        left: uint32x4_t,
        right: uint32x4_t,
    ) -> float32x4_t {
        // SAFETY: the instruction reads and writes these registers alone.
        unsafe {
            asm!(
                "bfdot {sum:v}.4s, {right:v}.8h, {left:v}.2h[{place}]",
                sum = inout(vreg) sum,
                right = in(vreg) right,
                left = in(vreg) left,
                place = const PLACE,
                options(pure, nomem, nostack, preserves_flags),
            );
        }
        sum
    }
}

compiled_for! {
    NeonDotProd,
    /// Adds the products of the four signed bytes of each word of `right` and of the `PLACE`th of `left`.
    #[inline]
    pub(in crate::kernels) fn sdot<const PLACE: i32>(
        _: NeonDotProd,
        mut sum: int32x4_t,
        left: uint32x4_t,
        right: uint32x4_t,
    ) -> int32x4_t {
        // SAFETY: the instruction reads and writes these registers alone.
        unsafe {
            asm!(
                "sdot {sum:v}.4s, {right:v}.16b, {left:v}.4b[{place}]",
                sum = inout(vreg) sum,
                right = in(vreg) right,
                left = in(vreg) left,
                place = const PLACE,
                options(pure, nomem, nostack, preserves_flags),
            );
        }
        sum
    }
}

gemm_kernel!(bf16(Neon) = "neon", 2, activations::widened_bf16, NeonMicroKernel<NeonWidenedBf16>);
gemm_kernel!(bf16_dot(NeonBf16) = "neon-bf16", 2, activations::bf16_pairs, NeonMicroKernel<NeonBf16Dot>);
gemm_kernel!(int8(Neon) = "neon", 4, quantise::unsigned_pairs, NeonMicroKernel<NeonBytes>);
gemm_kernel!(
    int8_dot(NeonDotProd) = "neon-dotprod",
    4,
    quantise::signed_bytes,
    NeonMicroKernel<NeonBytesDot>
);

/// The kernels of NEON: without its extensions, and with those that the CPU has.
pub(super) fn neon_kernels(isa: Neon, format: WeightFormat) -> (GemmKernel, Option<GemmKernel>) {
    match format {
        WeightFormat::Int8 => {
            let extended = NeonDotProd::detect().map(int8_dot);
            (int8(isa), extended.map(GemmKernel::with_signed_activations))
        }
        _ => (bf16(isa), NeonBf16::detect().map(bf16_dot)),
    }
}
