//! The micro-kernel of NEON and its extensions.
//!
//! The instructions multiply a register by one place of another, so that four words of a row are loaded at once, and none is
//! spread over a register first.

use super::micro_kernel::{MicroKernel, Operands, PREFETCH_WORDS};
use super::panels::PANEL_WIDTH;
use crate::kernels::isa::Isa;
use crate::kernels::simd::{opaque, prefetch_l2};
use std::arch::aarch64::*;
use std::marker::PhantomData;

/// f32, i32 or words to a register.
pub(super) const LANES: usize = 4;

/// How four words of a row are multiplied by the steps that they stand for.
///
/// # Safety
/// `load` must read, and `store` write, four words from the pointer on; `right` must read four words of each of `4 / WORDS` steps, which are
/// [`PANEL_WIDTH`] words apart; and nothing else.
pub(super) unsafe trait FourWords {
    /// Proof that the CPU has the instructions.
    type Isa: Isa;
    /// Sums of four channels.
    type Sum: Copy;
    /// Words of a row in one step: 1 or 2.
    const WORDS: usize;

    /// # Safety
    /// `from` must be good for reads of four words.
    unsafe fn load(isa: Self::Isa, from: *const u32) -> Self::Sum;

    /// # Safety
    /// `to` must be good for writes of four words.
    unsafe fn store(isa: Self::Isa, sum: Self::Sum, to: *mut u32);

    /// The steps, [`PANEL_WIDTH`] words apart, of four channels, as [`FourWords::add`] takes them.
    ///
    /// # Safety
    /// `from` must be good for reads of four words of each step.
    unsafe fn right(isa: Self::Isa, from: *const u32) -> [uint32x4_t; LANES];

    /// Adds one place's share: what the `PLACE`th of the registers of [`FourWords::right`] is multiplied by.
    fn add<const PLACE: i32>(
        isa: Self::Isa,
        sum: Self::Sum,
        left: uint32x4_t,
        right: uint32x4_t,
    ) -> Self::Sum;
}

/// Rows by a panel, by the instructions of `Q`.
pub(super) struct NeonMicroKernel<Q>(PhantomData<Q>);

// SAFETY: see `by_registers`.
unsafe impl<Q: FourWords> MicroKernel for NeonMicroKernel<Q> {
    type Isa = Q::Isa;
    type State = ();
    const WORDS: usize = Q::WORDS;
    /// Sixteen registers of sums and eight of the weight leave eight of the 32.
    const ROWS: usize = 8;
    const EVEN: bool = true;
    const SPARE_ROWS: usize = 0;
    const STEP_MULTIPLE: usize = LANES;

    #[inline(always)]
    fn start(_: Q::Isa) {}

    #[inline(always)]
    unsafe fn multiply(isa: Q::Isa, _: &mut (), rows: usize, operands: Operands, sums: *mut u32) {
        macro_rules! by_rows {
            ($($rows:literal x $columns:literal)+) => {
                match rows {
                    // SAFETY: the caller's promise, for this number of rows.
                    $($rows => unsafe { by_strips::<Q, $rows, $columns>(isa, operands, sums) },)+
                    _ => {}
                }
            };
        }
        // Few rows by more columns, so that there are sums enough to hide the latency of each.
        by_rows!(1 x 4 2 x 4 3 x 2 4 x 2 5 x 2 6 x 2 7 x 2 8 x 2);
    }
}

/// # Safety
/// As [`MicroKernel::multiply`], for `ROWS` rows.
#[inline(always)]
unsafe fn by_strips<Q: FourWords, const ROWS: usize, const COLUMNS: usize>(
    isa: Q::Isa,
    operands: Operands,
    sums: *mut u32,
) {
    const { assert!(PANEL_WIDTH.is_multiple_of(COLUMNS * LANES)) };
    for column in (0..PANEL_WIDTH).step_by(COLUMNS * LANES) {
        // SAFETY: the caller's promise is for all columns of the panel, which the strip's are some of.
        unsafe {
            let strip = Operands { right: operands.right.add(column), ..operands };
            by_registers::<Q, ROWS, COLUMNS>(isa, strip, sums.add(column));
        }
    }
}

/// # Safety
/// As [`MicroKernel::multiply`], for `ROWS` rows and `COLUMNS` registers of channels.
#[inline(always)]
unsafe fn by_registers<Q: FourWords, const ROWS: usize, const COLUMNS: usize>(
    isa: Q::Isa,
    operands: Operands,
    sums: *mut u32,
) {
    let Operands { left, stride, mut right, mut next, steps } = operands;
    let mut rows: [*const u32; ROWS] = std::array::from_fn(|r| opaque(left.wrapping_add(r * stride)));
    let steps_of_load = LANES / Q::WORDS;
    // SAFETY: the caller's promise: each row, step and register below is one of those that it names; steps come in multiples of
    // four. NEON itself is part of what this architecture's code is compiled for.
    unsafe {
        let mut acc: [[Q::Sum; COLUMNS]; ROWS] = std::array::from_fn(|r| {
            std::array::from_fn(|c| Q::load(isa, sums.add(r * PANEL_WIDTH + c * LANES)))
        });
        for _ in 0..steps / steps_of_load {
            let steps: [_; COLUMNS] = std::array::from_fn(|c| Q::right(isa, right.add(c * LANES)));
            // Written out: the compiler keeps the sums of no loop of eight in registers.
            macro_rules! rows {
                ($($r:literal)+) => {
                    $(if $r < ROWS {
                        add::<Q, COLUMNS>(isa, &mut acc[$r], vld1q_u32(rows[$r]), &steps);
                        rows[$r] = rows[$r].wrapping_add(LANES);
                    })+
                };
            }
            rows!(0 1 2 3 4 5 6 7);
            right = right.wrapping_add(steps_of_load * PANEL_WIDTH);
            prefetch_l2(next);
            next = next.wrapping_add(steps_of_load * PREFETCH_WORDS);
        }
        for (r, acc) in acc.iter().enumerate() {
            for (c, acc) in acc.iter().enumerate() {
                Q::store(isa, *acc, sums.add(r * PANEL_WIDTH + c * LANES));
            }
        }
    }
}

/// Adds a row's four words' share to its sums.
#[inline(always)]
fn add<Q: FourWords, const COLUMNS: usize>(
    isa: Q::Isa,
    sums: &mut [Q::Sum; COLUMNS],
    left: uint32x4_t,
    steps: &[[uint32x4_t; LANES]; COLUMNS],
) {
    macro_rules! places {
        ($($place:literal)+) => {
            $(for (sum, steps) in sums.iter_mut().zip(steps) {
                *sum = Q::add::<$place>(isa, *sum, left, steps[$place]);
            })+
        };
    }
    places!(0 1 2 3);
}
