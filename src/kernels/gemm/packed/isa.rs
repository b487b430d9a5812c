//! The kernels, one for each instruction set and format.

use super::WeightFormat;
use super::dot_bf16::Widened;
use super::gemm::{Job, Target, run};
use super::lhs;
use super::quantise;
use super::tile::Tile;
use crate::kernels::isa::level::Level;
use crate::kernels::simd::vector::Baseline;
use std::ops::Range;
use std::sync::Once;

/// A kernel that this machine can run: values come only from this module's checks.
#[derive(Clone, Copy)]
pub(in crate::kernels) struct Kernel {
    pub(in crate::kernels) name: &'static str,
    /// Values of a row in one step.
    pub(in crate::kernels) per_step: usize,
    /// Words of a row in one step.
    pub(in crate::kernels) words: usize,
    /// Whether integer activations are signed; else 128 is zero.
    pub(in crate::kernels) signed: bool,
    /// Rows that may be read after the last.
    pub(in crate::kernels) spare_rows: usize,
    /// Converts a row of activations; returns its scale.
    ///
    /// # Safety
    /// The CPU must have the kernel's instructions, as it has where a `Kernel` exists.
    pub(in crate::kernels) convert: unsafe fn(&mut [u32], &[f32]) -> f32,
    /// [`run`] for the kernel's way of adding; safety as there.
    pub(in crate::kernels) run: unsafe fn(&Job<'_>, Target<'_>, Range<usize>, Range<usize>),
}

/// Defines a kernel compiled for some target features.
macro_rules! kernel {
    ($(#[$meta:meta])* $constant:ident = $name:literal, $per_step:literal, $words:literal, $convert:path, $dot:ty $(, $features:literal)?) => {
        $(#[$meta])*
        pub(in crate::kernels) const $constant: Kernel = {
            $(#[target_feature(enable = $features)])?
            unsafe fn convert(words: &mut [u32], x: &[f32]) -> f32 {
                // SAFETY: the caller's promise, where this needs one.
                #[allow(unused_unsafe)]
                unsafe {
                    $convert(words, x)
                }
            }
            $(#[target_feature(enable = $features)])?
            unsafe fn multiply(job: &Job<'_>, target: Target<'_>, rows: Range<usize>, panels: Range<usize>) {
                // SAFETY: the caller's promise.
                unsafe { run::<$dot>(job, target, rows, panels) }
            }
            let spare_rows = if <$dot as Tile>::EVEN { 0 } else { <$dot as Tile>::ROWS };
            Kernel { name: $name, per_step: $per_step, words: $words, signed: false, spare_rows, convert, run: multiply }
        };
    };
}

kernel!(BF16_PORTABLE = "portable", 2, 2, lhs::widened, Widened<Baseline, 6>);
#[cfg(not(target_arch = "x86_64"))]
kernel!(INT8_PORTABLE = "portable", 4, 2, quantise::unsigned_pairs, super::dot_int8::Four);
#[cfg(target_arch = "x86_64")]
kernel!(INT8_PORTABLE = "portable", 4, 2, quantise::unsigned_pairs, super::dot_int8::x86::Pairs128);
#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::super::amx::Tiles;
    use super::super::amx_unit;
    use super::super::dot_bf16::x86::Bf16;
    use super::super::dot_int8::x86::{Pairs256, Pairs512, Vnni256, Vnni512};
    use super::*;
    use std::arch::x86_64::{__m256, __m512};
    kernel!(BF16_AVX2 = "avx2", 2, 2, lhs::widened, Widened<__m256, 6>, "avx2,fma");
    kernel!(BF16_AVX512 = "avx512", 2, 2, lhs::widened, Widened<__m512, 12>, "avx512f,avx512vl,avx512dq,avx512bw,avx2,fma");
    kernel!(INT8_AVX2 = "avx2", 4, 2, quantise::unsigned_pairs, Pairs256, "avx2,fma");
    kernel!(INT8_AVX2_VNNI = "avx2-vnni", 4, 1, quantise::unsigned_bytes, Vnni256, "avxvnni,avx2,fma");
    kernel!(
        INT8_AVX512 = "avx512",
        4,
        2,
        quantise::unsigned_pairs,
        Pairs512,
        "avx512f,avx512vl,avx512dq,avx512bw,avx2,fma"
    );
    kernel!(BF16_AMX = "amx", 2, 1, lhs::pairs, Tiles<amx_unit::Tiles, false>, "avx512f,avx512vl,avx512dq,avx512bw,avx2,fma");
    kernel!(INT8_AMX = "amx", 4, 1, quantise::unsigned_bytes_at_once, Tiles<amx_unit::Tiles, true>, "avx512f,avx512vl,avx512dq,avx512bw,avx2,fma");
    kernel!(
        INT8_AVX512_VNNI = "avx512-vnni",
        4,
        1,
        quantise::unsigned_bytes_at_once,
        Vnni512,
        "avx512vnni,avx512f,avx512vl,avx512dq,avx512bw,avx2,fma"
    );
    kernel!(
        BF16_DOT = "avx512-bf16",
        2,
        1,
        lhs::pairs_at_once,
        Bf16,
        "avx512bf16,avx512f,avx512vl,avx512dq,avx512bw,avx2,fma"
    );
}

#[cfg(target_arch = "aarch64")]
mod arm {
    use super::super::neon::{Bf16, Bytes, Dot, Neon, Widened};
    use super::*;
    kernel!(BF16 = "neon", 2, 2, lhs::widened, Neon<Widened>);
    kernel!(BF16_DOT = "neon-bf16", 2, 1, lhs::pairs, Neon<Bf16>, "neon,bf16");
    kernel!(INT8 = "neon", 4, 2, quantise::unsigned_pairs, Neon<Bytes>);
    kernel!(BYTE_DOT = "neon-dotprod", 4, 1, quantise::signed_bytes, Neon<Dot>, "neon,dotprod");
    pub(in crate::kernels) const INT8_DOT: Kernel = Kernel { signed: true, ..BYTE_DOT };
}

/// The kernels of a level: without its extensions, and with those that the machine has.
pub(in crate::kernels) fn kernels(level: Level, format: WeightFormat) -> (Kernel, Option<Kernel>) {
    #[cfg(target_arch = "x86_64")]
    {
        let int8 = format == WeightFormat::Int8;
        if level.is_amx() {
            return (Kernel::amx(format), None);
        }
        if level.is_avx512() && int8 {
            return (
                x86::INT8_AVX512,
                is_x86_feature_detected!("avx512vnni").then_some(x86::INT8_AVX512_VNNI),
            );
        }
        if level.is_avx512() {
            return (x86::BF16_AVX512, is_x86_feature_detected!("avx512bf16").then_some(x86::BF16_DOT));
        }
        if level.is_avx2() && int8 {
            return (x86::INT8_AVX2, is_x86_feature_detected!("avxvnni").then_some(x86::INT8_AVX2_VNNI));
        }
        if level.is_avx2() {
            return (x86::BF16_AVX2, None);
        }
    }
    #[cfg(target_arch = "aarch64")]
    if level.is_neon() {
        use std::arch::is_aarch64_feature_detected;
        return match format {
            WeightFormat::Int8 => {
                (arm::INT8, is_aarch64_feature_detected!("dotprod").then_some(arm::INT8_DOT))
            }
            _ => (arm::BF16, is_aarch64_feature_detected!("bf16").then_some(arm::BF16_DOT)),
        };
    }
    let _ = level;
    (Kernel::portable(format), None)
}

/// Whether a level has instructions that multiply pairs of bf16.
pub(in crate::kernels) fn multiplies_bf16(level: Level) -> bool {
    #[cfg(target_arch = "x86_64")]
    if level.is_amx() {
        return true;
    }
    kernels(level, WeightFormat::Bf16).1.is_some()
}

impl Kernel {
    pub(in crate::kernels) fn portable(format: WeightFormat) -> Kernel {
        if format == WeightFormat::Int8 { INT8_PORTABLE } else { BF16_PORTABLE }
    }

    /// For a machine that has AMX, which the caller must know.
    #[cfg(target_arch = "x86_64")]
    pub(in crate::kernels) fn amx(format: WeightFormat) -> Kernel {
        if format == WeightFormat::Int8 { x86::INT8_AMX } else { x86::BF16_AMX }
    }

    /// The AMX kernels by plain code.
    #[cfg(test)]
    pub(in crate::kernels) fn emulated_amx(format: WeightFormat) -> Kernel {
        use super::amx::{Emulated, Tiles};
        kernel!(BF16 = "amx, emulated", 2, 1, lhs::pairs, Tiles<Emulated, false>);
        kernel!(INT8 = "amx, emulated", 4, 1, quantise::unsigned_bytes, Tiles<Emulated, true>);
        if format == WeightFormat::Int8 { INT8 } else { BF16 }
    }

    /// The fastest kernel of the level in use.
    pub(in crate::kernels) fn current(format: WeightFormat) -> Kernel {
        static TOLD: Once = Once::new();
        let (plain, extended) = kernels(Level::current(), format);
        let kernel = extended.unwrap_or(plain);
        TOLD.call_once(|| tracing::debug!("packed weights are multiplied by the {} kernel", kernel.name));
        kernel
    }
}
