//! bf16 weights widened to f32 in registers.

use super::micro_kernel::DotProduct;
use crate::kernels::simd::Vector;
use std::marker::PhantomData;

/// For instruction sets without a bf16 product: registers of `V`, tiles of `ROWS` rows.
pub(super) struct WidenedBf16<V, const ROWS: usize>(PhantomData<V>);

// SAFETY: `load`, `store` and `right` go over one register of `V::LANES` words, `left` reads two words.
unsafe impl<V: Vector, const R: usize> DotProduct for WidenedBf16<V, R> {
    type Isa = V::Isa;
    type Sum = V;
    type Left = [V; 2];
    type Right = [V; 2];
    const LANES: usize = V::LANES;
    const WORDS: usize = 2;
    const ROWS: usize = R;

    #[inline(always)]
    unsafe fn load(isa: V::Isa, from: *const u32) -> V {
        // SAFETY: the caller's pointer is good for a register.
        unsafe { V::load(isa, from.cast()) }
    }
    #[inline(always)]
    unsafe fn store(isa: V::Isa, sum: V, to: *mut u32) {
        // SAFETY: the caller's pointer is good for a register.
        unsafe { sum.store(isa, to.cast()) }
    }
    #[inline(always)]
    unsafe fn left(isa: V::Isa, from: *const u32) -> [V; 2] {
        // SAFETY: the caller's pointer is good for two words.
        let [first, second] = unsafe { [*from, *from.add(1)] };
        [V::splat(isa, f32::from_bits(first)), V::splat(isa, f32::from_bits(second))]
    }
    #[inline(always)]
    unsafe fn right(isa: V::Isa, from: *const u32) -> [V; 2] {
        // SAFETY: the caller's pointer is good for a register.
        unsafe { V::widen_bf16(isa, from) }
    }
    #[inline(always)]
    fn add(isa: V::Isa, sum: V, left: [V; 2], right: [V; 2]) -> V {
        left[1].madd(isa, right[1], left[0].madd(isa, right[0], sum))
    }
}
