//! The micro-kernel: some rows of activations by one panel of the weight.

use super::panels::{PANEL_WIDTH, STEP_BLOCK};
use crate::kernels::isa::Isa;
use crate::kernels::simd::{opaque, prefetch_l2};

/// The operands of a micro-kernel.
#[derive(Clone, Copy)]
pub(in crate::kernels) struct Operands {
    /// First row's first word.
    pub(in crate::kernels) left: *const u32,
    /// Words from row to row.
    pub(in crate::kernels) stride: usize,
    /// First step of the panel.
    pub(in crate::kernels) right: *const u32,
    /// What a later call will read, to be prefetched: [`PREFETCH_WORDS`] words for each step. It may lie outside of any buffer.
    pub(in crate::kernels) next: *const u32,
    /// A multiple of [`MicroKernel::STEP_MULTIPLE`].
    pub(in crate::kernels) steps: usize,
}

/// How some rows are multiplied by a panel: by registers of sums, or by a tile unit.
///
/// # Safety
/// `multiply` must read and write no more than its own promise says, for every number of rows up to [`MicroKernel::ROWS`], which is at
/// most [`MAX_ROWS`].
pub(in crate::kernels) unsafe trait MicroKernel {
    /// Proof that the CPU has the instructions.
    type Isa: Isa;
    /// What a task sets up once.
    type State;
    /// Words of a row in one step.
    const WORDS: usize;
    /// Most rows.
    const ROWS: usize;
    /// Whether a task's rows are best shared out evenly; otherwise as many calls as possible get all [`MicroKernel::ROWS`].
    const EVEN: bool;
    /// Rows after the last that may be read, though they count for nothing.
    const SPARE_ROWS: usize;
    /// Steps come in multiples of this, which divides [`STEP_BLOCK`].
    const STEP_MULTIPLE: usize;

    fn start(isa: Self::Isa) -> Self::State;

    /// Adds to `sums`, rows of [`PANEL_WIDTH`], the product of `rows` rows, at most [`MicroKernel::ROWS`].
    ///
    /// # Safety
    /// `left` must be good for reads of `rows` rows and [`MicroKernel::SPARE_ROWS`] more, of `steps * WORDS` words each, `right` for
    /// `steps * PANEL_WIDTH` words; `sums` must be good for writes of `rows * PANEL_WIDTH`; `steps` must be a multiple of
    /// [`MicroKernel::STEP_MULTIPLE`].
    unsafe fn multiply(
        isa: Self::Isa,
        state: &mut Self::State,
        rows: usize,
        operands: Operands,
        sums: *mut u32,
    );
}

/// Most rows of any micro-kernel.
pub(super) const MAX_ROWS: usize = 32;

/// How one step is added to sums in registers, by an instruction set and format.
///
/// # Safety
/// `load` and `right` must read, and `store` must write, `LANES` words from the pointer on, `left` must read `WORDS` words, of any alignment,
/// and nothing else.
pub(in crate::kernels) unsafe trait DotProduct {
    /// Proof that the CPU has the instructions.
    type Isa: Isa;
    /// Sums of `LANES` channels, f32 or i32.
    type Sum: Copy;
    /// One step of a row, in every lane.
    type Left: Copy;
    /// One step of `LANES` channels.
    type Right: Copy;
    const LANES: usize;
    /// Words of a row in one step.
    const WORDS: usize;
    /// Most rows of a tile, which is two registers wide: what the registers hold beside the operands. 6 or 12.
    const ROWS: usize;

    /// # Safety
    /// `from` must be good for reads of `LANES` words.
    unsafe fn load(isa: Self::Isa, from: *const u32) -> Self::Sum;
    /// # Safety
    /// `to` must be good for writes of `LANES` words.
    unsafe fn store(isa: Self::Isa, sum: Self::Sum, to: *mut u32);
    /// # Safety
    /// `from` must be good for reads of `WORDS` words.
    unsafe fn left(isa: Self::Isa, from: *const u32) -> Self::Left;
    /// # Safety
    /// `from` must be good for reads of `LANES` words.
    unsafe fn right(isa: Self::Isa, from: *const u32) -> Self::Right;
    fn add(isa: Self::Isa, sum: Self::Sum, left: Self::Left, right: Self::Right) -> Self::Sum;
}

// SAFETY: see `multiply_by_registers`.
unsafe impl<D: DotProduct> MicroKernel for D {
    type Isa = D::Isa;
    type State = ();
    const WORDS: usize = <D as DotProduct>::WORDS;
    const ROWS: usize = <D as DotProduct>::ROWS;
    const EVEN: bool = true;
    const SPARE_ROWS: usize = 0;
    const STEP_MULTIPLE: usize = UNROLL;

    #[inline(always)]
    fn start(_: D::Isa) {}

    #[inline(always)]
    unsafe fn multiply(isa: D::Isa, _: &mut (), rows: usize, operands: Operands, sums: *mut u32) {
        macro_rules! by_rows {
            ($($rows:literal)+) => {
                match rows {
                    // SAFETY: the caller's promise, for this number of rows.
                    $($rows => unsafe { by_strips::<D, $rows>(isa, operands, sums) },)+
                    _ => {}
                }
            };
        }
        const { assert!(<D as DotProduct>::ROWS == 6 || <D as DotProduct>::ROWS == 12) };
        if <D as DotProduct>::ROWS == 6 || rows <= 6 {
            by_rows!(1 2 3 4 5 6);
        } else {
            by_rows!(7 8 9 10 11 12);
        }
    }
}

/// # Safety
/// As [`MicroKernel::multiply`], for `ROWS` rows.
#[inline(always)]
unsafe fn by_strips<D: DotProduct, const ROWS: usize>(isa: D::Isa, operands: Operands, sums: *mut u32) {
    const { assert!(PANEL_WIDTH.is_multiple_of(2 * <D as DotProduct>::LANES)) };
    for column in (0..PANEL_WIDTH).step_by(2 * <D as DotProduct>::LANES) {
        // SAFETY: the caller's promise is for all columns of the panel, which the strip's are some of.
        unsafe {
            let strip = Operands { right: operands.right.add(column), ..operands };
            multiply_by_registers::<D, ROWS, 2>(isa, strip, sums.add(column));
        }
    }
}

/// Steps of one pass of the inner loop.
const UNROLL: usize = 4;
const _: () = assert!(STEP_BLOCK.is_multiple_of(UNROLL));
/// Words prefetched for each step: one cache line for each pass of the inner loop, so that eight calls prefetch all of a panel.
pub(super) const PREFETCH_WORDS: usize = 16 / UNROLL;
/// Rows that are reached from one pointer: an instruction can add its row's stride once or twice.
const ROWS_PER_POINTER: usize = 3;
/// Pointers for the most rows of any [`DotProduct`].
const POINTERS: usize = 4;

/// # Safety
/// As [`MicroKernel::multiply`], for `ROWS` rows and the first `COLUMNS` registers of channels: what of the panel and of the sums lies after
/// these need not be there.
#[inline(always)]
pub(in crate::kernels) unsafe fn multiply_by_registers<
    D: DotProduct,
    const ROWS: usize,
    const COLUMNS: usize,
>(
    isa: D::Isa,
    operands: Operands,
    sums: *mut u32,
) {
    let Operands { left, stride, mut right, mut next, steps } = operands;
    let mut left: [*const u32; POINTERS] =
        std::array::from_fn(|p| left.wrapping_add((p * ROWS_PER_POINTER).min(ROWS - 1) * stride));
    // SAFETY: the caller's promise: each row, step and register below is one of those that it names; steps come in multiples of
    // `UNROLL`.
    unsafe {
        let mut acc: [[D::Sum; COLUMNS]; ROWS] = std::array::from_fn(|r| {
            std::array::from_fn(|c| D::load(isa, sums.add(r * PANEL_WIDTH + c * <D as DotProduct>::LANES)))
        });
        for _ in 0..steps / UNROLL {
            for step in 0..UNROLL {
                let right: [D::Right; COLUMNS] = std::array::from_fn(|c| {
                    D::right(isa, right.add(step * PANEL_WIDTH + c * <D as DotProduct>::LANES))
                });
                for (r, acc) in acc.iter_mut().enumerate() {
                    let row = left[r / ROWS_PER_POINTER].add(r % ROWS_PER_POINTER * stride);
                    let left = D::left(isa, row.add(step * <D as DotProduct>::WORDS));
                    for c in 0..COLUMNS {
                        acc[c] = D::add(isa, acc[c], left, right[c]);
                    }
                }
            }
            right = right.wrapping_add(UNROLL * PANEL_WIDTH);
            prefetch_l2(next);
            next = next.wrapping_add(UNROLL * PREFETCH_WORDS);
            for left in &mut left {
                *left = opaque(left.wrapping_add(UNROLL * <D as DotProduct>::WORDS));
            }
        }
        for (r, acc) in acc.iter().enumerate() {
            for (c, acc) in acc.iter().enumerate() {
                D::store(isa, *acc, sums.add(r * PANEL_WIDTH + c * <D as DotProduct>::LANES));
            }
        }
    }
}
