//! bf16 products: widened to f32 in registers, or by AVX512-BF16.

use super::tile::Dot;
use crate::kernels::simd::vector::Vector;
use std::marker::PhantomData;

/// bf16 weights widened to f32 in registers: for instruction sets without a bf16 product.
pub(in crate::kernels) struct Widened<V, const ROWS: usize>(PhantomData<V>);

impl<V: Vector, const R: usize> Dot for Widened<V, R> {
    type Sum = V;
    type Left = [V; 2];
    type Right = [V; 2];
    const LANES: usize = V::LANES;
    const WORDS: usize = 2;
    const ROWS: usize = R;

    #[inline(always)]
    unsafe fn load(from: *const u32) -> V {
        // SAFETY: the caller's promise.
        unsafe { V::load(from.cast()) }
    }
    #[inline(always)]
    unsafe fn store(sum: V, to: *mut u32) {
        // SAFETY: the caller's promise.
        unsafe { sum.store(to.cast()) }
    }
    #[inline(always)]
    unsafe fn left(from: *const u32) -> [V; 2] {
        // SAFETY: the caller's promise.
        unsafe { [V::splat(f32::from_bits(*from)), V::splat(f32::from_bits(*from.add(1)))] }
    }
    #[inline(always)]
    unsafe fn right(from: *const u32) -> [V; 2] {
        // SAFETY: the caller's promise.
        unsafe { V::halves(from) }
    }
    #[inline(always)]
    unsafe fn add(sum: V, left: [V; 2], right: [V; 2]) -> V {
        // SAFETY: the caller's promise.
        unsafe { left[1].madd(right[1], left[0].madd(right[0], sum)) }
    }
}

#[cfg(target_arch = "x86_64")]
pub(in crate::kernels) mod x86 {
    use super::Dot;
    use std::arch::x86_64::*;

    /// AVX512-BF16: two products a lane and instruction.
    pub(in crate::kernels) struct Bf16;

    impl Dot for Bf16 {
        type Sum = __m512;
        type Left = __m512i;
        type Right = __m512i;
        const LANES: usize = 16;
        const WORDS: usize = 1;
        const ROWS: usize = 12;

        #[inline(always)]
        unsafe fn load(from: *const u32) -> __m512 {
            // SAFETY: the caller's promise.
            unsafe { _mm512_loadu_ps(from.cast()) }
        }
        #[inline(always)]
        unsafe fn store(sum: __m512, to: *mut u32) {
            // SAFETY: the caller's promise.
            unsafe { _mm512_storeu_ps(to.cast(), sum) }
        }
        #[inline(always)]
        unsafe fn left(from: *const u32) -> __m512i {
            // SAFETY: the caller's promise.
            unsafe { _mm512_set1_epi32(*from.cast()) }
        }
        #[inline(always)]
        unsafe fn right(from: *const u32) -> __m512i {
            // SAFETY: the caller's promise.
            unsafe { _mm512_loadu_si512(from.cast()) }
        }
        #[inline(always)]
        unsafe fn add(sum: __m512, left: __m512i, right: __m512i) -> __m512 {
            // SAFETY: the caller has the instruction set; the types differ in name only.
            unsafe {
                let pairs = |x| std::mem::transmute::<__m512i, __m512bh>(x);
                _mm512_dpbf16_ps(sum, pairs(right), pairs(left))
            }
        }
    }
}
