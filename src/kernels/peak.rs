//! What the multipliers of this machine can do when nothing has to come from memory.

use super::gemm::packed::WeightFormat;
use super::isa::{Level, Portable};
use super::simd::{Simd, Vector};
use rayon::prelude::*;
use std::time::Instant;

/// Independent sums: enough to hide the latency of two multipliers.
const SUMS: usize = 16;
/// Products added to each sum.
const STEPS: usize = 1 << 21;

/// Operations per second of all threads, in 10^9, in a loop that adds products in registers alone: the ceiling that a
/// matrix product with weights of this format can be compared with. Two operations per product.
///
/// It takes some tens of milliseconds. Formats whose values are widened in registers have the ceiling of f32.
pub fn peak_gflops(format: WeightFormat) -> f64 {
    let run = || {
        let start = Instant::now();
        let per_thread: Vec<usize> =
            (0..rayon::current_num_threads()).into_par_iter().with_max_len(1).map(|_| once(format)).collect();
        per_thread.iter().sum::<usize>() as f64 / start.elapsed().as_secs_f64() * 1e-9
    };
    (0..5).map(|_| run()).fold(0.0, f64::max)
}

/// Runs the loop of the fastest instruction for a format; gives the number of operations.
fn once(format: WeightFormat) -> usize {
    // Portable code widens every format.
    let _ = format;
    match Level::current() {
        Level::Portable => f32_products(Portable),
        #[cfg(target_arch = "x86_64")]
        Level::Avx2(isa) => x86_64::avx2(isa),
        #[cfg(target_arch = "x86_64")]
        Level::Avx512(isa) => x86_64::avx512(isa, format),
        #[cfg(target_arch = "x86_64")]
        Level::Amx(isa) => x86_64::amx(isa, format),
        #[cfg(target_arch = "aarch64")]
        Level::Neon(isa) => aarch64::neon(isa, format),
    }
}

/// The loop in f32.
#[inline(always)]
fn f32_products<S: Simd>(isa: S) -> usize {
    let mut sums = [S::F32::splat(isa, 0.0); SUMS];
    let [a, b] = [0.5, 0.25].map(|x| S::F32::splat(isa, std::hint::black_box(x)));
    for _ in 0..STEPS {
        for sum in &mut sums {
            *sum = a.madd(isa, b, *sum);
        }
    }
    for sum in sums {
        let mut out = [0f32; 16];
        assert!(S::F32::LANES <= out.len());
        // SAFETY: the buffer holds a register.
        unsafe { sum.store(isa, out.as_mut_ptr()) };
        std::hint::black_box(out);
    }
    2 * S::F32::LANES * SUMS * STEPS
}

#[cfg(target_arch = "aarch64")]
mod aarch64 {
    use super::{STEPS, SUMS, WeightFormat, f32_products};
    use crate::kernels::gemm::packed::{bfdot, sdot};
    use crate::kernels::isa::{Neon, NeonBf16, NeonDotProd, call_compiled};
    use std::arch::aarch64::*;

    pub(super) fn neon(isa: Neon, format: WeightFormat) -> usize {
        match (format, NeonBf16::detect(), NeonDotProd::detect()) {
            (WeightFormat::Bf16, Some(isa), _) => call_compiled!(NeonBf16, isa, bf16_products, () -> usize),
            (WeightFormat::Int8, _, Some(isa)) => {
                call_compiled!(NeonDotProd, isa, int8_products, () -> usize)
            }
            _ => call_compiled!(Neon, isa, f32_products, () -> usize),
        }
    }

    #[inline(always)]
    fn bf16_products(isa: NeonBf16) -> usize {
        // SAFETY: the token proves that the CPU has the instructions.
        unsafe {
            let mut sums = [vdupq_n_f32(0.0); SUMS];
            let halves = vdupq_n_u32(std::hint::black_box(0x3f00_3f00));
            for _ in 0..STEPS {
                for sum in &mut sums {
                    *sum = bfdot::<0>(isa, *sum, halves, halves);
                }
            }
            std::hint::black_box(sums);
        }
        2 * 8 * SUMS * STEPS
    }

    #[inline(always)]
    fn int8_products(isa: NeonDotProd) -> usize {
        // SAFETY: the token proves that the CPU has the instructions.
        unsafe {
            let mut sums = [vdupq_n_s32(0); SUMS];
            let threes = vdupq_n_u32(std::hint::black_box(0x0303_0303));
            for _ in 0..STEPS {
                for sum in &mut sums {
                    *sum = sdot::<0>(isa, *sum, threes, threes);
                }
            }
            std::hint::black_box(sums);
        }
        2 * 16 * SUMS * STEPS
    }
}

#[cfg(target_arch = "x86_64")]
mod x86_64 {
    use super::{STEPS, SUMS, WeightFormat, f32_products};
    use crate::kernels::isa::{
        Amx, AmxUnit, Avx2, Avx512, Avx512Bf16, Avx512Vnni, TILE_SIDE, TileUnit, call_compiled,
    };
    use std::arch::x86_64::*;

    pub(super) fn avx2(isa: Avx2) -> usize {
        call_compiled!(Avx2, isa, f32_products, () -> usize)
    }

    pub(super) fn avx512(isa: Avx512, format: WeightFormat) -> usize {
        match (format, Avx512Bf16::detect(), Avx512Vnni::detect()) {
            (WeightFormat::Bf16, Some(isa), _) => call_compiled!(Avx512Bf16, isa, bf16_products, () -> usize),
            (WeightFormat::Int8, _, Some(isa)) => call_compiled!(Avx512Vnni, isa, int8_products, () -> usize),
            _ => call_compiled!(Avx512, isa, f32_products, () -> usize),
        }
    }

    #[inline(always)]
    fn bf16_products(_: Avx512Bf16) -> usize {
        // SAFETY: the token proves that the CPU has the instructions.
        unsafe {
            let mut sums = [_mm512_setzero_ps(); SUMS];
            let half = _mm512_set1_ps(std::hint::black_box(0.5));
            let a = _mm512_cvtne2ps_pbh(half, half);
            for _ in 0..STEPS {
                for sum in &mut sums {
                    *sum = _mm512_dpbf16_ps(*sum, a, a);
                }
            }
            std::hint::black_box(sums);
        }
        2 * 32 * SUMS * STEPS
    }

    #[inline(always)]
    fn int8_products(_: Avx512Vnni) -> usize {
        // SAFETY: the token proves that the CPU has the instructions.
        unsafe {
            let mut sums = [_mm512_setzero_si512(); SUMS];
            let a = _mm512_set1_epi8(std::hint::black_box(3));
            for _ in 0..STEPS {
                for sum in &mut sums {
                    *sum = _mm512_dpbusd_epi32(*sum, a, a);
                }
            }
            std::hint::black_box(sums);
        }
        2 * 64 * SUMS * STEPS
    }

    /// Multiplies tiles that stay where they are, in turn, so that no product waits for another.
    pub(super) fn amx(isa: Amx, format: WeightFormat) -> usize {
        let rounds = STEPS / 16;
        let per_word = match format {
            WeightFormat::F32 => return call_compiled!(Avx512, isa.into(), f32_products, () -> usize),
            WeightFormat::Bf16 => 2,
            WeightFormat::Int8 => 4,
        };
        let mut unit = AmxUnit::start(isa);
        for _ in 0..rounds {
            if format == WeightFormat::Int8 {
                unit.add_int8::<0, 4, 6>();
                unit.add_int8::<1, 4, 7>();
                unit.add_int8::<2, 5, 6>();
                unit.add_int8::<3, 5, 7>();
            } else {
                unit.add_bf16::<0, 4, 6>();
                unit.add_bf16::<1, 4, 7>();
                unit.add_bf16::<2, 5, 6>();
                unit.add_bf16::<3, 5, 7>();
            }
        }
        rounds * 4 * 2 * TILE_SIDE * TILE_SIDE * TILE_SIDE * per_word
    }
}
