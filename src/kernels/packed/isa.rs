//! The kernels, one for each instruction set and format.

use super::super::level::Level;
use super::super::vector::Baseline;
use super::WeightFormat;
use super::gemm::{Job, Target, run};
use super::lhs;
use super::tile::Widened;
use std::ops::Range;
use std::sync::Once;

/// A kernel that this machine can run: values come only from this module's checks.
#[derive(Clone, Copy)]
pub(super) struct Kernel {
    pub(super) name: &'static str,
    /// Values of a row in one step.
    pub(super) per_step: usize,
    /// Words of a row in one step.
    pub(super) words: usize,
    /// Converts a row of activations.
    ///
    /// # Safety
    /// The CPU must have the kernel's instructions, as it has where a `Kernel` exists.
    pub(super) convert: unsafe fn(&mut [u32], &[f32]),
    /// [`run`] for the kernel's way of adding; safety as there.
    pub(super) run: unsafe fn(&Job<'_>, Target, Range<usize>, Range<usize>),
}

/// Defines a kernel compiled for some target features.
macro_rules! kernel {
    ($(#[$meta:meta])* $constant:ident = $name:literal, $per_step:literal, $words:literal, $convert:path, $dot:ty $(, $features:literal)?) => {
        $(#[$meta])*
        pub(super) const $constant: Kernel = {
            $(#[target_feature(enable = $features)])?
            unsafe fn convert(words: &mut [u32], x: &[f32]) {
                $convert(words, x)
            }
            $(#[target_feature(enable = $features)])?
            unsafe fn multiply(job: &Job<'_>, target: Target, rows: Range<usize>, panels: Range<usize>) {
                // SAFETY: the caller's promise.
                unsafe { run::<$dot>(job, target, rows, panels) }
            }
            Kernel { name: $name, per_step: $per_step, words: $words, convert, run: multiply }
        };
    };
}

kernel!(BF16_PORTABLE = "portable", 2, 2, lhs::widened, Widened<Baseline, 6>);
#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::super::tile::x86::Bf16;
    use super::*;
    use std::arch::x86_64::{__m256, __m512};
    kernel!(BF16_AVX2 = "avx2", 2, 2, lhs::widened, Widened<__m256, 6>, "avx2,fma");
    kernel!(BF16_AVX512 = "avx512", 2, 2, lhs::widened, Widened<__m512, 12>, "avx512f,avx512vl,avx512dq,avx512bw,avx2,fma");
    kernel!(
        BF16_DOT = "avx512-bf16",
        2,
        1,
        lhs::pairs,
        Bf16,
        "avx512bf16,avx512f,avx512vl,avx512dq,avx512bw,avx2,fma"
    );
}

impl Kernel {
    /// The kernel of the level in use.
    pub(super) fn current(format: WeightFormat) -> Kernel {
        static TOLD: Once = Once::new();
        let kernels = Kernel::at(Level::current(), format);
        let kernel = kernels.last().copied().unwrap_or(BF16_PORTABLE);
        TOLD.call_once(|| tracing::debug!("packed weights are multiplied by the {} kernel", kernel.name));
        kernel
    }

    /// The kernels of a level, slowest first: with and without its extensions.
    pub(super) fn at(level: Level, _format: WeightFormat) -> Vec<Kernel> {
        #[cfg(target_arch = "x86_64")]
        {
            if level.is_avx512() {
                let mut kernels = vec![x86::BF16_AVX512];
                if is_x86_feature_detected!("avx512bf16") {
                    kernels.push(x86::BF16_DOT);
                }
                return kernels;
            }
            if level.is_avx2() {
                return vec![x86::BF16_AVX2];
            }
        }
        let _ = level;
        vec![BF16_PORTABLE]
    }
}
