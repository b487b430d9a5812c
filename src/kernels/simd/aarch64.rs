//! The registers of 64-bit Arm.

use super::vector::{Simd, Vector};
use crate::kernels::isa::Neon;
use std::arch::aarch64::*;

impl Simd for Neon {
    type F32 = float32x4_t;
}

// SAFETY: the intrinsics read and write one register of four elements, of any alignment.
unsafe impl Vector for float32x4_t {
    type Isa = Neon;
    const LANES: usize = 4;
    const REGISTERS: usize = 32;

    #[inline(always)]
    fn splat(_: Neon, x: f32) -> Self {
        // SAFETY: the token proves that the CPU has NEON.
        unsafe { vdupq_n_f32(x) }
    }
    #[inline(always)]
    unsafe fn load(_: Neon, from: *const f32) -> Self {
        // SAFETY: the token proves that the CPU has NEON; the caller's pointer is good for four elements.
        unsafe { vld1q_f32(from) }
    }
    #[inline(always)]
    unsafe fn store(self, _: Neon, to: *mut f32) {
        // SAFETY: the token proves that the CPU has NEON; the caller's pointer is good for four elements.
        unsafe { vst1q_f32(to, self) }
    }
    #[inline(always)]
    fn madd(self, _: Neon, b: Self, c: Self) -> Self {
        // SAFETY: the token proves that the CPU has NEON.
        unsafe { vfmaq_f32(c, self, b) }
    }
    #[inline(always)]
    unsafe fn widen_bf16(_: Neon, from: *const u32) -> [Self; 2] {
        // SAFETY: the token proves that the CPU has NEON; the caller's pointer is good for four words.
        unsafe {
            let words = vld1q_u32(from);
            let upper = vandq_u32(words, vdupq_n_u32(0xffff_0000));
            [vreinterpretq_f32_u32(vshlq_n_u32::<16>(words)), vreinterpretq_f32_u32(upper)]
        }
    }
}
