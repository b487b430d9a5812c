//! The register tile: some rows of activations by one panel of the weight.

use super::panel::{STEP_BLOCK, WIDTH};

/// How one step is added to the sums, by an instruction set and format.
///
/// # Safety
/// Functions may be called only where the CPU has the type's instructions. Pointers must be good for `LANES` words
/// (`left`: `WORDS`), of any alignment.
pub(in crate::kernels) trait Dot {
    /// Sums of `LANES` channels, f32 or i32.
    type Sum: Copy;
    /// One step of a row, in every lane.
    type Left: Copy;
    /// One step of `LANES` channels.
    type Right: Copy;
    const LANES: usize;
    /// Words of a row in one step.
    const WORDS: usize;
    /// Most rows of a tile, which is two registers wide: what the registers hold beside the operands.
    const ROWS: usize;
    unsafe fn load(from: *const u32) -> Self::Sum;
    unsafe fn store(sum: Self::Sum, to: *mut u32);
    unsafe fn left(from: *const u32) -> Self::Left;
    unsafe fn right(from: *const u32) -> Self::Right;
    unsafe fn add(sum: Self::Sum, left: Self::Left, right: Self::Right) -> Self::Sum;
}

/// The operands of a tile.
#[derive(Clone, Copy)]
pub(in crate::kernels) struct Operands {
    /// First row's first word.
    pub(in crate::kernels) left: *const u32,
    /// Words from row to row.
    pub(in crate::kernels) stride: usize,
    /// First step of the panel.
    pub(in crate::kernels) right: *const u32,
    /// What will be read by a later tile, to be fetched ahead: [`AHEAD`] words for each step. It may lie outside of any buffer.
    pub(in crate::kernels) next: *const u32,
    pub(in crate::kernels) steps: usize,
}

/// How some rows are multiplied by a panel: by registers of sums, or by a tile unit.
///
/// # Safety
/// Functions may be called only where the CPU has the type's instructions.
pub(in crate::kernels) trait Tile {
    /// What a task sets up once.
    type State;
    /// f32 to a register.
    const LANES: usize;
    /// Words of a row in one step.
    const WORDS: usize;
    /// Most rows.
    const ROWS: usize;
    /// Whether rows are best shared out evenly; else as many whole tiles as there can be.
    const EVEN: bool;

    unsafe fn start() -> Self::State;

    /// Adds to `sums`, rows of [`WIDTH`], the product of `rows` rows, at most `ROWS`.
    ///
    /// # Safety
    /// `left` must be good for `rows` rows of `steps * WORDS` words, `right` for `steps * WIDTH` words, `sums` for `rows * WIDTH`.
    unsafe fn multiply(state: &mut Self::State, rows: usize, operands: Operands, sums: *mut u32);
}

impl<D: Dot> Tile for D {
    type State = ();
    const LANES: usize = <D as Dot>::LANES;
    const WORDS: usize = <D as Dot>::WORDS;
    const ROWS: usize = <D as Dot>::ROWS;
    const EVEN: bool = true;

    #[inline(always)]
    unsafe fn start() {}

    #[inline(always)]
    unsafe fn multiply(_: &mut (), rows: usize, operands: Operands, sums: *mut u32) {
        macro_rules! by_rows {
            ($($rows:literal)+) => {
                match rows {
                    // SAFETY: the caller's promise.
                    $($rows => unsafe { by_strips::<D, $rows>(operands, sums) },)+
                    _ => {}
                }
            };
        }
        const { assert!(<D as Dot>::ROWS == 6 || <D as Dot>::ROWS == 12) };
        if <D as Dot>::ROWS == 6 || rows <= 6 {
            by_rows!(1 2 3 4 5 6);
        } else {
            by_rows!(7 8 9 10 11 12);
        }
    }
}

/// # Safety
/// As [`Tile::multiply`], for `ROWS` rows.
#[inline(always)]
unsafe fn by_strips<D: Dot, const ROWS: usize>(operands: Operands, sums: *mut u32) {
    const { assert!(WIDTH.is_multiple_of(2 * <D as Dot>::LANES)) };
    for column in (0..WIDTH).step_by(2 * <D as Dot>::LANES) {
        // SAFETY: the caller's promise; a strip lies within the panel.
        unsafe {
            let strip = Operands { right: operands.right.add(column), ..operands };
            by_registers::<D, ROWS, 2>(strip, sums.add(column));
        }
    }
}

/// Steps of one pass of the inner loop.
const UNROLL: usize = 4;
const _: () = assert!(STEP_BLOCK.is_multiple_of(UNROLL));
/// Words fetched ahead for each step: one cache line for each pass of the inner loop, so that eight tiles fetch all of a panel.
pub(in crate::kernels) const AHEAD: usize = 16 / UNROLL;
/// Rows that are reached from one pointer: what the addresses of one instruction can do, with the stride once or twice.
const SHARING: usize = 3;
/// Pointers for the most rows of any tile.
const POINTERS: usize = 4;

/// Brings a cache line into the second-level cache. Any address will do.
#[inline(always)]
pub(in crate::kernels) fn fetch(at: *const u32) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T1, _mm_prefetch};
        // SAFETY: a hint, which reads nothing that the program sees.
        unsafe { _mm_prefetch::<_MM_HINT_T1>(at.cast()) };
    }
    #[cfg(target_arch = "aarch64")]
    // SAFETY: as above.
    unsafe {
        std::arch::asm!("prfm pldl2keep, [{}]", in(reg) at, options(nostack, preserves_flags, readonly))
    };
    #[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
    let _ = at;
}

/// Brings a cache line into the first-level cache. Any address will do.
#[inline(always)]
pub(in crate::kernels) fn fetch_near(at: *const u32) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // SAFETY: a hint, which changes nothing that the program sees.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(at.cast()) };
    }
    #[cfg(target_arch = "aarch64")]
    // SAFETY: as above.
    unsafe {
        std::arch::asm!("prfm pstl1keep, [{}]", in(reg) at, options(nostack, preserves_flags, readonly))
    };
    #[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
    let _ = at;
}

/// The same pointer, of which the compiler knows nothing: else it works out each row's address from the first one's, at every step.
#[inline(always)]
pub(in crate::kernels) fn opaque(pointer: *const u32) -> *const u32 {
    #[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
    {
        let mut pointer = pointer;
        // SAFETY: no instruction at all.
        #[allow(clippy::pointers_in_nomem_asm_block)]
        unsafe {
            std::arch::asm!("/* {} */", inout(reg) pointer, options(nomem, nostack, preserves_flags))
        };
        pointer
    }
    #[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
    pointer
}

/// # Safety
/// As [`Tile::multiply`], for `ROWS` rows and `COLUMNS` registers of channels.
#[inline(always)]
pub(in crate::kernels) unsafe fn by_registers<D: Dot, const ROWS: usize, const COLUMNS: usize>(
    operands: Operands,
    sums: *mut u32,
) {
    let Operands { left, stride, mut right, mut next, steps } = operands;
    let mut left: [*const u32; POINTERS] =
        std::array::from_fn(|p| left.wrapping_add((p * SHARING).min(ROWS - 1) * stride));
    // SAFETY: the caller's promise; steps come in multiples of `UNROLL`.
    unsafe {
        let mut acc: [[D::Sum; COLUMNS]; ROWS] = std::array::from_fn(|r| {
            std::array::from_fn(|c| D::load(sums.add(r * WIDTH + c * <D as Dot>::LANES)))
        });
        for _ in 0..steps / UNROLL {
            for step in 0..UNROLL {
                let right: [D::Right; COLUMNS] =
                    std::array::from_fn(|c| D::right(right.add(step * WIDTH + c * <D as Dot>::LANES)));
                for (r, acc) in acc.iter_mut().enumerate() {
                    let row = left[r / SHARING].add(r % SHARING * stride);
                    let left = D::left(row.add(step * <D as Dot>::WORDS));
                    for c in 0..COLUMNS {
                        acc[c] = D::add(acc[c], left, right[c]);
                    }
                }
            }
            right = right.wrapping_add(UNROLL * WIDTH);
            fetch(next);
            next = next.wrapping_add(UNROLL * AHEAD);
            for left in &mut left {
                *left = opaque(left.wrapping_add(UNROLL * <D as Dot>::WORDS));
            }
        }
        for (r, acc) in acc.iter().enumerate() {
            for (c, acc) in acc.iter().enumerate() {
                D::store(*acc, sums.add(r * WIDTH + c * <D as Dot>::LANES));
            }
        }
    }
}
