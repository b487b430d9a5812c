//! The few vector operations that the micro-kernels need, for each register width.

use crate::kernels::isa::Isa;

/// A register of f32. The compiler keeps arrays of these in registers, which it does not do for a
/// large array of f32.
///
/// # Safety
/// `load` and `widen_bf16` must read, and `store` must write, [`Vector::LANES`] elements of four bytes from the pointer on, of any
/// alignment, and nothing else.
pub(in crate::kernels) unsafe trait Vector: Copy {
    /// Proof that the CPU has the instructions.
    type Isa: Isa;
    const LANES: usize;
    /// How many such registers there are.
    const REGISTERS: usize;

    fn splat(isa: Self::Isa, x: f32) -> Self;

    /// # Safety
    /// `from` must be good for reads of `LANES` elements.
    unsafe fn load(isa: Self::Isa, from: *const f32) -> Self;

    /// # Safety
    /// `to` must be good for writes of `LANES` elements.
    unsafe fn store(self, isa: Self::Isa, to: *mut f32);

    /// `self * b + c`.
    fn madd(self, isa: Self::Isa, b: Self, c: Self) -> Self;

    /// The lower and the upper bf16 of `LANES` words, as f32.
    ///
    /// # Safety
    /// `from` must be good for reads of `LANES` words.
    unsafe fn widen_bf16(isa: Self::Isa, from: *const u32) -> [Self; 2];
}

/// An instruction set that has registers of f32.
pub(in crate::kernels) trait Simd: Isa {
    type F32: Vector<Isa = Self>;
}

/// Four f32 for the compiler to vectorise, where there is no register that every CPU has.
#[cfg(not(target_arch = "x86_64"))]
mod portable {
    use super::{Simd, Vector};
    use crate::kernels::isa::Portable;
    use crate::kernels::simd::math::madd;

    #[derive(Clone, Copy)]
    pub(in crate::kernels) struct PortableF32x4([f32; 4]);

    impl Simd for Portable {
        type F32 = PortableF32x4;
    }

    // SAFETY: arrays of four f32 or u32 are what is read and written.
    unsafe impl Vector for PortableF32x4 {
        type Isa = Portable;
        const LANES: usize = 4;
        const REGISTERS: usize = 16;

        #[inline(always)]
        fn splat(_: Portable, x: f32) -> Self {
            PortableF32x4([x; 4])
        }
        #[inline(always)]
        unsafe fn load(_: Portable, from: *const f32) -> Self {
            // SAFETY: the caller's pointer is good for four elements.
            PortableF32x4(unsafe { from.cast::<[f32; 4]>().read_unaligned() })
        }
        #[inline(always)]
        unsafe fn store(self, _: Portable, to: *mut f32) {
            // SAFETY: the caller's pointer is good for four elements.
            unsafe { to.cast::<[f32; 4]>().write_unaligned(self.0) }
        }
        #[inline(always)]
        fn madd(self, isa: Portable, b: Self, c: Self) -> Self {
            PortableF32x4(std::array::from_fn(|i| madd(isa, self.0[i], b.0[i], c.0[i])))
        }
        #[inline(always)]
        unsafe fn widen_bf16(_: Portable, from: *const u32) -> [Self; 2] {
            // SAFETY: the caller's pointer is good for four words.
            let words = unsafe { from.cast::<[u32; 4]>().read_unaligned() };
            let (lower, upper) = (words.map(|w| w << 16), words.map(|w| w & 0xffff_0000));
            [lower, upper].map(|half| PortableF32x4(half.map(f32::from_bits)))
        }
    }
}
