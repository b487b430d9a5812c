//! The kernels that every CPU can run.

use super::activations;
use super::format::WeightFormat;
use super::kernel::{GemmKernel, gemm_kernel};
#[cfg(not(target_arch = "x86_64"))]
use super::micro_kernel::DotProduct;
use super::quantise;
use super::widened::WidenedBf16;
#[cfg(target_arch = "x86_64")]
use super::x86_64::PairsSse2 as PortableInt8;
use crate::kernels::isa::Portable;
use crate::kernels::simd::Simd;

/// Four i32 for the compiler to vectorise, where there is no register that every CPU has.
#[cfg(not(target_arch = "x86_64"))]
struct PortableInt8;

#[cfg(not(target_arch = "x86_64"))]
// SAFETY: arrays of four i32 or u32 are what `load`, `store` and `right` go over; `left` reads two words.
unsafe impl DotProduct for PortableInt8 {
    type Isa = Portable;
    type Sum = [i32; 4];
    type Left = [[i32; 2]; 2];
    type Right = [u32; 4];
    const LANES: usize = 4;
    const WORDS: usize = 2;
    const ROWS: usize = 6;

    #[inline(always)]
    unsafe fn load(_: Portable, from: *const u32) -> [i32; 4] {
        // SAFETY: the caller's pointer is good for four words.
        unsafe { from.cast::<[i32; 4]>().read_unaligned() }
    }
    #[inline(always)]
    unsafe fn store(_: Portable, sum: [i32; 4], to: *mut u32) {
        // SAFETY: the caller's pointer is good for four words.
        unsafe { to.cast::<[i32; 4]>().write_unaligned(sum) }
    }
    #[inline(always)]
    unsafe fn left(_: Portable, from: *const u32) -> [[i32; 2]; 2] {
        // SAFETY: the caller's pointer is good for two words.
        let words = unsafe { [*from, *from.add(1)] };
        words.map(|w| [(w & 0xffff) as i32, (w >> 16) as i32])
    }
    #[inline(always)]
    unsafe fn right(_: Portable, from: *const u32) -> [u32; 4] {
        // SAFETY: the caller's pointer is good for four words.
        unsafe { from.cast::<[u32; 4]>().read_unaligned() }
    }
    #[inline(always)]
    fn add(_: Portable, sum: [i32; 4], [[a0, a2], [a1, a3]]: [[i32; 2]; 2], right: [u32; 4]) -> [i32; 4] {
        std::array::from_fn(|i| {
            let byte = |shift: u32| (right[i] << (24 - shift)) as i32 >> 24;
            sum[i] + a0 * byte(0) + a1 * byte(8) + a2 * byte(16) + a3 * byte(24)
        })
    }
}

gemm_kernel!(bf16(Portable) = "portable", 2, activations::widened_bf16, WidenedBf16<<Portable as Simd>::F32, 6>);
gemm_kernel!(int8(Portable) = "portable", 4, quantise::unsigned_pairs, PortableInt8);

/// The kernel of a format.
pub(super) fn kernel(format: WeightFormat) -> GemmKernel {
    if format == WeightFormat::Int8 { int8(Portable) } else { bf16(Portable) }
}
