//! Intel AMX: products of tiles of 16 rows by 64 bytes.
//!
//! What the unit does stands in the instruction set reference: `tdpbf16ps` and `tdpbusd` add to a tile of sums `[16 rows][16]`
//! the product of a tile of rows `[16][16 words]` and a tile of steps `[16][16 channels]`, which is how the panels lie.

use super::panel::{STEP_BLOCK, WIDTH};
use super::tile::{Operands, Tile};
use std::marker::PhantomData;

/// Rows, and words of a row, of a tile.
const SIDE: usize = 16;
/// Rows multiplied at once: two tiles.
const ROWS: usize = 2 * SIDE;

/// Eight tiles, by number.
///
/// # Safety
/// The machine must have the unit. Pointers must be good for 16 rows of 64 bytes, `stride` bytes from one to the next.
pub(in crate::kernels) trait Unit {
    /// All tiles in their full size.
    unsafe fn start() -> Self;
    unsafe fn load<const T: usize>(&mut self, from: *const u32, stride: usize);
    unsafe fn store<const T: usize>(&mut self, to: *mut u32, stride: usize);
    /// `SUM += A * B`, two bf16 to a word, sums in f32.
    unsafe fn add_bf16<const SUM: usize, const A: usize, const B: usize>(&mut self);
    /// The same with four bytes, unsigned in `A` and signed in `B`, and sums in i32.
    unsafe fn add_int8<const SUM: usize, const A: usize, const B: usize>(&mut self);
}

/// A panel by 32 rows, in a unit `U`, of bytes or of bf16.
pub(in crate::kernels) struct Tiles<U, const INT8: bool>(PhantomData<U>);

impl<U: Unit, const INT8: bool> Tile for Tiles<U, INT8> {
    type State = U;
    const LANES: usize = 16;
    const WORDS: usize = 1;
    const ROWS: usize = ROWS;
    const EVEN: bool = false;

    #[inline(always)]
    unsafe fn start() -> U {
        // SAFETY: the caller has the unit.
        unsafe { U::start() }
    }

    /// Reads, but does not use, rows after the last: up to 32 in all.
    #[inline(always)]
    unsafe fn multiply(unit: &mut U, rows: usize, operands: Operands, sums: *mut u32) {
        debug_assert!(operands.steps.is_multiple_of(STEP_BLOCK));
        if rows == ROWS {
            // SAFETY: the caller's promise.
            return unsafe { four::<U, INT8>(unit, operands, sums) };
        }
        // Whole tiles are stored, so the last rows go by way of a buffer that has room for them.
        let mut whole = [0u32; ROWS * WIDTH];
        // SAFETY: `sums` holds `rows` rows, fewer than `whole`; for the rest, the caller's promise.
        unsafe {
            whole.as_mut_ptr().copy_from_nonoverlapping(sums, rows * WIDTH);
            match rows <= SIDE {
                true => two::<U, INT8>(unit, operands, whole.as_mut_ptr()),
                false => four::<U, INT8>(unit, operands, whole.as_mut_ptr()),
            }
            sums.copy_from_nonoverlapping(whole.as_ptr(), rows * WIDTH);
        }
    }
}

/// Bytes from one row of a panel, or of the sums, to the next.
const PANEL: usize = WIDTH * size_of::<u32>();

/// Two by two tiles: each operand that is loaded is used twice.
///
/// # Safety
/// As [`Tile::multiply`], for 32 rows.
#[inline(always)]
unsafe fn four<U: Unit, const INT8: bool>(unit: &mut U, operands: Operands, sums: *mut u32) {
    let Operands { left, stride, right, steps, .. } = operands;
    // SAFETY: the caller's promise; the second tiles are 16 rows or channels on.
    unsafe {
        let below = sums.add(SIDE * WIDTH);
        unit.load::<0>(sums, PANEL);
        unit.load::<1>(sums.add(SIDE), PANEL);
        unit.load::<2>(below, PANEL);
        unit.load::<3>(below.add(SIDE), PANEL);
        for step in (0..steps).step_by(STEP_BLOCK) {
            let (left, right) = (left.add(step), right.add(step * WIDTH));
            unit.load::<4>(left, stride * size_of::<u32>());
            unit.load::<6>(right, PANEL);
            add::<U, INT8, 0, 4, 6>(unit);
            unit.load::<7>(right.add(SIDE), PANEL);
            add::<U, INT8, 1, 4, 7>(unit);
            unit.load::<5>(left.add(SIDE * stride), stride * size_of::<u32>());
            add::<U, INT8, 2, 5, 6>(unit);
            add::<U, INT8, 3, 5, 7>(unit);
        }
        unit.store::<0>(sums, PANEL);
        unit.store::<1>(sums.add(SIDE), PANEL);
        unit.store::<2>(below, PANEL);
        unit.store::<3>(below.add(SIDE), PANEL);
    }
}

/// One by two tiles.
///
/// # Safety
/// As [`Tile::multiply`], for 16 rows.
#[inline(always)]
unsafe fn two<U: Unit, const INT8: bool>(unit: &mut U, operands: Operands, sums: *mut u32) {
    let Operands { left, stride, right, steps, .. } = operands;
    // SAFETY: the caller's promise; the second tile is 16 channels on.
    unsafe {
        unit.load::<0>(sums, PANEL);
        unit.load::<1>(sums.add(SIDE), PANEL);
        for step in (0..steps).step_by(STEP_BLOCK) {
            let (left, right) = (left.add(step), right.add(step * WIDTH));
            unit.load::<4>(left, stride * size_of::<u32>());
            unit.load::<6>(right, PANEL);
            add::<U, INT8, 0, 4, 6>(unit);
            unit.load::<7>(right.add(SIDE), PANEL);
            add::<U, INT8, 1, 4, 7>(unit);
        }
        unit.store::<0>(sums, PANEL);
        unit.store::<1>(sums.add(SIDE), PANEL);
    }
}

/// # Safety
/// As [`Unit`].
#[inline(always)]
unsafe fn add<U: Unit, const INT8: bool, const SUM: usize, const A: usize, const B: usize>(unit: &mut U) {
    // SAFETY: the caller's promise.
    unsafe {
        match INT8 {
            true => unit.add_int8::<SUM, A, B>(),
            false => unit.add_bf16::<SUM, A, B>(),
        }
    }
}

/// The unit in plain code, for the tests of everything above on machines without it.
#[cfg(test)]
pub(in crate::kernels) struct Emulated([[u32; SIDE * SIDE]; 8]);

#[cfg(test)]
impl Emulated {
    fn each<const SUM: usize, const A: usize, const B: usize>(&mut self, add: impl Fn(u32, u32, u32) -> u32) {
        for row in 0..SIDE {
            for step in 0..SIDE {
                for channel in 0..SIDE {
                    let (a, b) = (self.0[A][row * SIDE + step], self.0[B][step * SIDE + channel]);
                    let sum = &mut self.0[SUM][row * SIDE + channel];
                    *sum = add(*sum, a, b);
                }
            }
        }
    }
}

#[cfg(test)]
impl Unit for Emulated {
    unsafe fn start() -> Self {
        // The numbers that a unit just started must not rely on.
        Emulated([[0x7fc0_0001; SIDE * SIDE]; 8])
    }
    unsafe fn load<const T: usize>(&mut self, from: *const u32, stride: usize) {
        for (row, words) in self.0[T].chunks_exact_mut(SIDE).enumerate() {
            // SAFETY: the caller's promise.
            let from = unsafe { std::slice::from_raw_parts(from.byte_add(row * stride), SIDE) };
            words.copy_from_slice(from);
        }
    }
    unsafe fn store<const T: usize>(&mut self, to: *mut u32, stride: usize) {
        for (row, words) in self.0[T].chunks_exact(SIDE).enumerate() {
            // SAFETY: the caller's promise.
            unsafe { to.byte_add(row * stride).copy_from_nonoverlapping(words.as_ptr(), SIDE) };
        }
    }
    unsafe fn add_bf16<const SUM: usize, const A: usize, const B: usize>(&mut self) {
        self.each::<SUM, A, B>(|sum, a, b| {
            let ([a0, a1], [b0, b1]) = (super::words::halves(a), super::words::halves(b));
            (f32::from_bits(sum) + a0 * b0 + a1 * b1).to_bits()
        });
    }
    unsafe fn add_int8<const SUM: usize, const A: usize, const B: usize>(&mut self) {
        self.each::<SUM, A, B>(|sum, a, b| {
            let products = a.to_le_bytes().into_iter().zip(b.to_le_bytes());
            products.fold(sum, |sum, (a, b)| sum.wrapping_add((i32::from(a) * i32::from(b as i8)) as u32))
        });
    }
}
