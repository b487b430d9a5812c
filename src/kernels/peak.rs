//! What the multipliers of this machine can do when nothing has to come from memory.

use crate::kernels::gemm::packed::WeightFormat;
use crate::kernels::isa::level::Level;
use crate::kernels::simd::vector::{Baseline, Vector};
use rayon::prelude::*;
use std::time::Instant;

/// Independent sums: enough to hide the latency of two multipliers.
const SUMS: usize = 16;
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
    let level = Level::current();
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{__m256, __m512};
        if level.is_amx() && format != WeightFormat::F32 {
            // SAFETY: a `Level` says AMX only where the unit was found and checked.
            return unsafe { crate::kernels::gemm::packed::amx_busy(format, STEPS / 16) };
        }
        if level.is_avx512() {
            // SAFETY: a `Level` says AVX-512 only where the CPU reported it; the extensions are asked for here.
            return unsafe {
                match format {
                    WeightFormat::Bf16 if is_x86_feature_detected!("avx512bf16") => x86::bf16(),
                    WeightFormat::Int8 if is_x86_feature_detected!("avx512vnni") => x86::int8(),
                    _ => x86::avx512::<__m512>(),
                }
            };
        }
        if level.is_avx2() {
            // SAFETY: a `Level` says AVX2 only where the CPU reported AVX2 and FMA.
            return unsafe { x86::avx2::<__m256>() };
        }
    }
    #[cfg(target_arch = "aarch64")]
    if level.is_neon() {
        use std::arch::is_aarch64_feature_detected;
        // SAFETY: NEON is part of what this architecture's code is compiled for; the extensions are asked for here.
        return unsafe {
            match format {
                WeightFormat::Bf16 if is_aarch64_feature_detected!("bf16") => neon::bf16(),
                WeightFormat::Int8 if is_aarch64_feature_detected!("dotprod") => neon::int8(),
                _ => floats::<std::arch::aarch64::float32x4_t>(),
            }
        };
    }
    let _ = (level, format);
    // SAFETY: portable code, or a register that every machine of this architecture has.
    unsafe { floats::<Baseline>() }
}

/// # Safety
/// The CPU has the instruction set of `V`.
#[inline(always)]
unsafe fn floats<V: Vector>() -> usize {
    // SAFETY: the caller's promise; the buffer is larger than any register.
    unsafe {
        let mut sums = [V::splat(0.0); SUMS];
        let (a, b) = (V::splat(std::hint::black_box(0.5)), V::splat(std::hint::black_box(0.25)));
        for _ in 0..STEPS {
            for sum in &mut sums {
                *sum = a.madd(b, *sum);
            }
        }
        for sum in sums {
            let mut out = [0f32; 16];
            sum.store(out.as_mut_ptr());
            std::hint::black_box(out);
        }
    }
    2 * V::LANES * SUMS * STEPS
}

#[cfg(target_arch = "aarch64")]
mod neon {
    use super::{STEPS, SUMS};
    use crate::kernels::gemm::packed::neon::{bfdot, sdot};
    use std::arch::aarch64::*;

    #[target_feature(enable = "neon,bf16")]
    pub(super) fn bf16() -> usize {
        let mut sums = [vdupq_n_f32(0.0); SUMS];
        let halves = vdupq_n_u32(std::hint::black_box(0x3f00_3f00));
        for _ in 0..STEPS {
            for sum in &mut sums {
                *sum = bfdot::<0>(*sum, halves, halves);
            }
        }
        std::hint::black_box(sums);
        2 * 8 * SUMS * STEPS
    }

    #[target_feature(enable = "neon,dotprod")]
    pub(super) fn int8() -> usize {
        let mut sums = [vdupq_n_s32(0); SUMS];
        let threes = vdupq_n_u32(std::hint::black_box(0x0303_0303));
        for _ in 0..STEPS {
            for sum in &mut sums {
                *sum = sdot::<0>(*sum, threes, threes);
            }
        }
        std::hint::black_box(sums);
        2 * 16 * SUMS * STEPS
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::{STEPS, SUMS, Vector, floats};
    use std::arch::x86_64::*;

    /// # Safety
    /// The CPU has AVX-512F.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,avx2,fma")]
    pub(super) unsafe fn avx512<V: Vector>() -> usize {
        // SAFETY: the caller's promise.
        unsafe { floats::<V>() }
    }

    /// # Safety
    /// The CPU has AVX2 and FMA.
    #[target_feature(enable = "avx2,fma")]
    pub(super) unsafe fn avx2<V: Vector>() -> usize {
        // SAFETY: the caller's promise.
        unsafe { floats::<V>() }
    }

    /// # Safety
    /// The CPU has AVX512-BF16.
    #[target_feature(enable = "avx512f,avx512bf16")]
    pub(super) unsafe fn bf16() -> usize {
        let mut sums = [_mm512_setzero_ps(); SUMS];
        let half = _mm512_set1_ps(std::hint::black_box(0.5));
        let a = _mm512_cvtne2ps_pbh(half, half);
        for _ in 0..STEPS {
            for sum in &mut sums {
                *sum = _mm512_dpbf16_ps(*sum, a, a);
            }
        }
        std::hint::black_box(sums);
        2 * 32 * SUMS * STEPS
    }

    /// # Safety
    /// The CPU has AVX512-VNNI.
    #[target_feature(enable = "avx512f,avx512vnni")]
    pub(super) unsafe fn int8() -> usize {
        let mut sums = [_mm512_setzero_si512(); SUMS];
        let a = _mm512_set1_epi8(std::hint::black_box(3));
        for _ in 0..STEPS {
            for sum in &mut sums {
                *sum = _mm512_dpbusd_epi32(*sum, a, a);
            }
        }
        std::hint::black_box(sums);
        2 * 64 * SUMS * STEPS
    }
}
