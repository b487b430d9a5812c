//! What a tile unit does, and an emulation of it.
//!
//! The instructions are those of the instruction set reference: `tdpbf16ps` and `tdpbusd` add to a tile of sums `[16 rows][16]`
//! the product of a tile of rows `[16][16 words]` and a tile of steps `[16][16 channels]`.

use crate::kernels::isa::token::{Isa, Portable};

/// Rows of a tile, and words of a row.
pub(in crate::kernels) const TILE_SIDE: usize = 16;

/// Eight tiles, by number.
///
/// # Safety
/// `load` must read, and `store` write, 16 rows of 64 bytes that start `stride` bytes apart, and nothing else.
pub(in crate::kernels) unsafe trait TileUnit {
    /// Proof that the machine has the unit.
    type Isa: Isa;

    /// Starts the unit with all tiles in their full size, holding anything.
    fn start(isa: Self::Isa) -> Self;

    /// # Safety
    /// `from` must be good for reads of 16 rows of 64 bytes, `stride` bytes from one to the next.
    unsafe fn load<const T: usize>(&mut self, from: *const u32, stride: usize);

    /// # Safety
    /// `to` must be good for writes of 16 rows of 64 bytes, `stride` bytes from one to the next.
    unsafe fn store<const T: usize>(&mut self, to: *mut u32, stride: usize);

    /// `SUM += A * B`, two bf16 to a word, sums in f32.
    fn add_bf16<const SUM: usize, const A: usize, const B: usize>(&mut self);

    /// The same with four bytes, unsigned in `A` and signed in `B`, and sums in i32.
    fn add_int8<const SUM: usize, const A: usize, const B: usize>(&mut self);
}

/// The unit in plain code.
pub(in crate::kernels) struct EmulatedUnit([[u32; TILE_SIDE * TILE_SIDE]; 8]);

impl EmulatedUnit {
    fn each<const SUM: usize, const A: usize, const B: usize>(&mut self, add: impl Fn(u32, u32, u32) -> u32) {
        for row in 0..TILE_SIDE {
            for step in 0..TILE_SIDE {
                for channel in 0..TILE_SIDE {
                    let (a, b) = (self.0[A][row * TILE_SIDE + step], self.0[B][step * TILE_SIDE + channel]);
                    let sum = &mut self.0[SUM][row * TILE_SIDE + channel];
                    *sum = add(*sum, a, b);
                }
            }
        }
    }
}

// SAFETY: `load` and `store` go over 16 rows of 16 words.
unsafe impl TileUnit for EmulatedUnit {
    type Isa = Portable;

    fn start(_: Portable) -> Self {
        // NaN: nothing may rely on what a unit holds that was just started.
        EmulatedUnit([[0x7fc0_0001; TILE_SIDE * TILE_SIDE]; 8])
    }

    unsafe fn load<const T: usize>(&mut self, from: *const u32, stride: usize) {
        for (row, words) in self.0[T].chunks_exact_mut(TILE_SIDE).enumerate() {
            // SAFETY: the caller's pointer is good for this row; `words` is as long.
            unsafe { words.as_mut_ptr().copy_from_nonoverlapping(from.byte_add(row * stride), TILE_SIDE) };
        }
    }

    unsafe fn store<const T: usize>(&mut self, to: *mut u32, stride: usize) {
        for (row, words) in self.0[T].chunks_exact(TILE_SIDE).enumerate() {
            // SAFETY: the caller's pointer is good for this row; `words` is as long.
            unsafe { to.byte_add(row * stride).copy_from_nonoverlapping(words.as_ptr(), TILE_SIDE) };
        }
    }

    fn add_bf16<const SUM: usize, const A: usize, const B: usize>(&mut self) {
        let halves = |word: u32| [f32::from_bits(word << 16), f32::from_bits(word & 0xffff_0000)];
        self.each::<SUM, A, B>(|sum, a, b| {
            let ([a0, a1], [b0, b1]) = (halves(a), halves(b));
            (f32::from_bits(sum) + a0 * b0 + a1 * b1).to_bits()
        });
    }

    fn add_int8<const SUM: usize, const A: usize, const B: usize>(&mut self) {
        self.each::<SUM, A, B>(|sum, a, b| {
            let products = a.to_le_bytes().into_iter().zip(b.to_le_bytes());
            products.fold(sum, |sum, (a, b)| sum.wrapping_add((i32::from(a) * i32::from(b as i8)) as u32))
        });
    }
}
