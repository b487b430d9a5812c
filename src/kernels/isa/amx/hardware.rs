//! The unit of the CPU: one instruction to a function.

use super::token::Amx;
use super::unit::{EmulatedUnit, TILE_SIDE, TileUnit};
use crate::kernels::isa::token::Portable;
use std::arch::asm;
use std::sync::OnceLock;

/// The tiles of the thread that holds this.
pub(in crate::kernels) struct AmxUnit(());

/// What `ldtilecfg` reads: palette 1, and for each of eight tiles its rows and the bytes of a row.
#[repr(C, align(64))]
struct Config {
    palette: u8,
    start_row: u8,
    reserved: [u8; 14],
    row_bytes: [u16; 16],
    rows: [u8; 16],
}

static FULL_TILES: Config = {
    let (mut row_bytes, mut rows) = ([0; 16], [0; 16]);
    let mut tile = 0;
    while tile < 8 {
        (row_bytes[tile], rows[tile]) = (64, 16);
        tile += 1;
    }
    Config { palette: 1, start_row: 0, reserved: [0; 14], row_bytes, rows }
};

// The compiler itself uses no tile registers in code that is not compiled for AMX, as this is not: what one
// `asm!` block leaves in them the next one finds.
//
// SAFETY: `tileloadd` and `tilestored` go over the 16 rows of 64 bytes that `FULL_TILES` sets.
unsafe impl TileUnit for AmxUnit {
    type Isa = Amx;

    #[inline(always)]
    fn start(_: Amx) -> Self {
        // SAFETY: the token proves that the unit is there; `FULL_TILES` is a valid configuration.
        unsafe { asm!("ldtilecfg [{}]", in(reg) &raw const FULL_TILES, options(nostack, preserves_flags)) };
        AmxUnit(())
    }

    #[inline(always)]
    unsafe fn load<const T: usize>(&mut self, from: *const u32, stride: usize) {
        // SAFETY: the unit was started; the caller's pointer is good for what is read.
        unsafe {
            asm!("tileloadd tmm{}, [{} + {}*1]", const T, in(reg) from, in(reg) stride, options(nostack, preserves_flags));
        }
    }

    #[inline(always)]
    unsafe fn store<const T: usize>(&mut self, to: *mut u32, stride: usize) {
        // SAFETY: the unit was started; the caller's pointer is good for what is written.
        unsafe {
            asm!("tilestored [{} + {}*1], tmm{}", in(reg) to, in(reg) stride, const T, options(nostack, preserves_flags));
        }
    }

    #[inline(always)]
    fn add_bf16<const SUM: usize, const A: usize, const B: usize>(&mut self) {
        // SAFETY: the unit was started; the instruction changes a tile of it and nothing else.
        unsafe {
            asm!("tdpbf16ps tmm{}, tmm{}, tmm{}", const SUM, const A, const B, options(nostack, preserves_flags));
        }
    }

    #[inline(always)]
    fn add_int8<const SUM: usize, const A: usize, const B: usize>(&mut self) {
        // SAFETY: the unit was started; the instruction changes a tile of it and nothing else.
        unsafe {
            asm!("tdpbusd tmm{}, tmm{}, tmm{}", const SUM, const A, const B, options(nostack, preserves_flags));
        }
    }
}

impl Drop for AmxUnit {
    fn drop(&mut self) {
        // SAFETY: an `AmxUnit` exists only where the unit was started. Tiles left in use would have to be saved at each
        // change of threads.
        unsafe { asm!("tilerelease", options(nostack, preserves_flags)) };
    }
}

/// The token, if the unit is there, may be used and multiplies as the emulation does.
pub(in crate::kernels) fn usable() -> Option<Amx> {
    static USABLE: OnceLock<Option<Amx>> = OnceLock::new();
    *USABLE.get_or_init(|| {
        let amx = Amx::detect()?;
        let right = product::<AmxUnit, false>(amx) == product::<EmulatedUnit, false>(Portable)
            && product::<AmxUnit, true>(amx) == product::<EmulatedUnit, true>(Portable);
        if !right {
            tracing::warn!("AMX fails its check on this machine and is not used");
        }
        right.then_some(amx)
    })
}

/// Words from row to row of the check's operands: there is a space between rows.
const CHECK_STRIDE: usize = TILE_SIDE + 3;

/// The sum of two products of tiles, of bytes or of bf16.
fn product<U: TileUnit, const INT8: bool>(isa: U::Isa) -> Vec<u32> {
    // Small integers, whose products and sums bf16 and f32 hold exactly.
    let bf16 = |i: usize| ((i % 15) as f32 - 7.0).to_bits() >> 16;
    let word = |i: usize| match INT8 {
        true => (i as u32).wrapping_mul(0x9e37_79b9),
        false => bf16(7 * i) | bf16(5 * i + 3) << 16,
    };
    let operand: Vec<u32> = (0..TILE_SIDE * CHECK_STRIDE).map(word).collect();
    let mut sums = vec![0u32; TILE_SIDE * CHECK_STRIDE];
    let stride = CHECK_STRIDE * size_of::<u32>();
    let mut unit = U::start(isa);
    // SAFETY: both buffers hold 16 rows of `CHECK_STRIDE` words, which is more than one word longer than a tile's.
    unsafe {
        unit.load::<1>(sums.as_ptr(), stride);
        unit.load::<4>(operand.as_ptr(), stride);
        unit.load::<7>(operand.as_ptr().add(1), stride);
    }
    if INT8 {
        unit.add_int8::<1, 4, 7>();
        unit.add_int8::<1, 7, 4>();
    } else {
        unit.add_bf16::<1, 4, 7>();
        unit.add_bf16::<1, 7, 4>();
    }
    // SAFETY: as above.
    unsafe { unit.store::<1>(sums.as_mut_ptr(), stride) };
    sums
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_configuration_is_as_the_instruction_reads_it() {
        assert_eq!((size_of::<Config>(), align_of::<Config>()), (64, 64));
        assert_eq!(std::mem::offset_of!(Config, row_bytes), 16);
        assert_eq!(std::mem::offset_of!(Config, rows), 48);
        let last = |tile: usize| (FULL_TILES.row_bytes[tile], FULL_TILES.rows[tile]);
        assert_eq!([last(7), last(8)], [(64, 16), (0, 0)]);
    }

    #[test]
    fn a_machine_without_the_unit_says_so() {
        if Amx::detect().is_none() {
            assert!(usable().is_none());
        }
    }

    /// What the check compares is what it looks like: sums of products, in the rows alone.
    #[test]
    fn the_check_multiplies() {
        let pairs = product::<EmulatedUnit, false>(Portable);
        for sums in [&pairs, &product::<EmulatedUnit, true>(Portable)] {
            let (rows, spaces): (Vec<_>, Vec<_>) =
                (0..sums.len()).partition(|i| i % CHECK_STRIDE < TILE_SIDE);
            assert!(spaces.iter().all(|&i| sums[i] == 0));
            assert!(rows.iter().filter(|&&i| sums[i] != 0).count() > rows.len() * 9 / 10);
        }
        assert!(pairs.iter().all(|&sum| f32::from_bits(sum).abs() <= 2.0 * 32.0 * 49.0));
    }
}
