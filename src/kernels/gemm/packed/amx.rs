//! The micro-kernels of AMX, over any tile unit: panels are what its tiles of steps are, and rows its tiles of rows.

use super::activations;
use super::format::WeightFormat;
use super::kernel::{GemmKernel, gemm_kernel};
use super::micro_kernel::{MicroKernel, Operands};
use super::panels::{PANEL_WIDTH, STEP_BLOCK};
use super::quantise;
use crate::kernels::isa::{TILE_SIDE, TileUnit};
use std::marker::PhantomData;

/// Rows multiplied at once: two tiles.
const ROWS: usize = 2 * TILE_SIDE;

/// A panel by 32 rows, in a unit `U`, of bytes or of bf16.
pub(in crate::kernels) struct AmxMicroKernel<U, const INT8: bool>(PhantomData<U>);

// SAFETY: `two_by_two` reads and writes 32 rows, `one_by_two` 16; where there are fewer, the sums go by way of a buffer that has room
// for all, and the rest are spare rows.
unsafe impl<U: TileUnit, const INT8: bool> MicroKernel for AmxMicroKernel<U, INT8> {
    type Isa = U::Isa;
    type State = U;
    const WORDS: usize = 1;
    const ROWS: usize = ROWS;
    const EVEN: bool = false;
    const SPARE_ROWS: usize = ROWS;
    const STEP_MULTIPLE: usize = STEP_BLOCK;

    #[inline(always)]
    fn start(isa: U::Isa) -> U {
        U::start(isa)
    }

    #[inline(always)]
    unsafe fn multiply(_: U::Isa, unit: &mut U, rows: usize, operands: Operands, sums: *mut u32) {
        debug_assert!(operands.steps.is_multiple_of(STEP_BLOCK));
        if rows == ROWS {
            // SAFETY: the caller's promise is for 32 rows.
            return unsafe { two_by_two::<U, INT8>(unit, operands, sums) };
        }
        let mut whole = [0u32; ROWS * PANEL_WIDTH];
        // SAFETY: `sums` holds `rows` rows, fewer than `whole`; the caller's operands have spare rows up to 32.
        unsafe {
            whole.as_mut_ptr().copy_from_nonoverlapping(sums, rows * PANEL_WIDTH);
            match rows <= TILE_SIDE {
                true => one_by_two::<U, INT8>(unit, operands, whole.as_mut_ptr()),
                false => two_by_two::<U, INT8>(unit, operands, whole.as_mut_ptr()),
            }
            sums.copy_from_nonoverlapping(whole.as_ptr(), rows * PANEL_WIDTH);
        }
    }
}

/// Bytes from one row of a panel, or of the sums, to the next.
const PANEL_BYTES: usize = PANEL_WIDTH * size_of::<u32>();

/// Two tiles of rows by two of channels: each operand that is loaded is used twice.
///
/// # Safety
/// As [`MicroKernel::multiply`], for 32 rows.
#[inline(always)]
unsafe fn two_by_two<U: TileUnit, const INT8: bool>(unit: &mut U, operands: Operands, sums: *mut u32) {
    let Operands { left, stride, right, steps, .. } = operands;
    // SAFETY: the caller's promise; the second tiles are 16 rows or channels on, and a tile takes 16 steps.
    unsafe {
        let below = sums.add(TILE_SIDE * PANEL_WIDTH);
        unit.load::<0>(sums, PANEL_BYTES);
        unit.load::<1>(sums.add(TILE_SIDE), PANEL_BYTES);
        unit.load::<2>(below, PANEL_BYTES);
        unit.load::<3>(below.add(TILE_SIDE), PANEL_BYTES);
        for step in (0..steps).step_by(STEP_BLOCK) {
            let (left, right) = (left.add(step), right.add(step * PANEL_WIDTH));
            unit.load::<4>(left, stride * size_of::<u32>());
            unit.load::<6>(right, PANEL_BYTES);
            add::<U, INT8, 0, 4, 6>(unit);
            unit.load::<7>(right.add(TILE_SIDE), PANEL_BYTES);
            add::<U, INT8, 1, 4, 7>(unit);
            unit.load::<5>(left.add(TILE_SIDE * stride), stride * size_of::<u32>());
            add::<U, INT8, 2, 5, 6>(unit);
            add::<U, INT8, 3, 5, 7>(unit);
        }
        unit.store::<0>(sums, PANEL_BYTES);
        unit.store::<1>(sums.add(TILE_SIDE), PANEL_BYTES);
        unit.store::<2>(below, PANEL_BYTES);
        unit.store::<3>(below.add(TILE_SIDE), PANEL_BYTES);
    }
}

/// One tile of rows by two of channels.
///
/// # Safety
/// As [`MicroKernel::multiply`], for 16 rows.
#[inline(always)]
unsafe fn one_by_two<U: TileUnit, const INT8: bool>(unit: &mut U, operands: Operands, sums: *mut u32) {
    let Operands { left, stride, right, steps, .. } = operands;
    // SAFETY: the caller's promise; the second tile is 16 channels on, and a tile takes 16 steps.
    unsafe {
        unit.load::<0>(sums, PANEL_BYTES);
        unit.load::<1>(sums.add(TILE_SIDE), PANEL_BYTES);
        for step in (0..steps).step_by(STEP_BLOCK) {
            let (left, right) = (left.add(step), right.add(step * PANEL_WIDTH));
            unit.load::<4>(left, stride * size_of::<u32>());
            unit.load::<6>(right, PANEL_BYTES);
            add::<U, INT8, 0, 4, 6>(unit);
            unit.load::<7>(right.add(TILE_SIDE), PANEL_BYTES);
            add::<U, INT8, 1, 4, 7>(unit);
        }
        unit.store::<0>(sums, PANEL_BYTES);
        unit.store::<1>(sums.add(TILE_SIDE), PANEL_BYTES);
    }
}

#[inline(always)]
fn add<U: TileUnit, const INT8: bool, const SUM: usize, const A: usize, const B: usize>(unit: &mut U) {
    match INT8 {
        true => unit.add_int8::<SUM, A, B>(),
        false => unit.add_bf16::<SUM, A, B>(),
    }
}

/// The kernel for a machine with AMX.
#[cfg(target_arch = "x86_64")]
pub(super) fn kernel(isa: crate::kernels::isa::Amx, format: WeightFormat) -> GemmKernel {
    use crate::kernels::isa::AmxUnit;
    gemm_kernel!(bf16(Amx) = "amx", 2, activations::bf16_pairs, AmxMicroKernel<AmxUnit, false>);
    gemm_kernel!(int8(Amx) = "amx", 4, quantise::unsigned_bytes_avx512, AmxMicroKernel<AmxUnit, true>);
    if format == WeightFormat::Int8 { int8(isa) } else { bf16(isa) }
}

/// The same by an emulated unit.
#[cfg(test)]
pub(super) fn emulated_kernel(format: WeightFormat) -> GemmKernel {
    use crate::kernels::isa::{EmulatedUnit, Portable};
    gemm_kernel!(bf16(Portable) = "amx, emulated", 2, activations::bf16_pairs, AmxMicroKernel<EmulatedUnit, false>);
    gemm_kernel!(int8(Portable) = "amx, emulated", 4, quantise::unsigned_bytes, AmxMicroKernel<EmulatedUnit, true>);
    if format == WeightFormat::Int8 { int8(Portable) } else { bf16(Portable) }
}
