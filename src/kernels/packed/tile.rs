//! The register tile: some rows of activations by one panel of the weight.

use super::super::vector::Vector;
use super::panel::WIDTH;
use std::marker::PhantomData;

/// How one step is added to the sums, by an instruction set and format.
///
/// # Safety
/// Functions may be called only where the CPU has the type's instructions. Pointers must be good for `LANES` words
/// (`left`: `WORDS`), of any alignment.
pub(super) trait Dot {
    /// Sums of `LANES` channels, f32 or i32.
    type Sum: Copy;
    /// One step of a row, in every lane.
    type Left: Copy;
    /// One step of `LANES` channels.
    type Right: Copy;
    const LANES: usize;
    /// Words of a row in one step.
    const WORDS: usize;
    /// Most rows, and registers of channels, of a tile: what the registers hold beside the operands.
    const ROWS: usize;
    const REGISTERS: usize;
    unsafe fn load(from: *const u32) -> Self::Sum;
    unsafe fn store(sum: Self::Sum, to: *mut u32);
    unsafe fn left(from: *const u32) -> Self::Left;
    unsafe fn right(from: *const u32) -> Self::Right;
    unsafe fn add(sum: Self::Sum, left: Self::Left, right: Self::Right) -> Self::Sum;
}

/// The operands of a tile.
#[derive(Clone, Copy)]
pub(super) struct Operands {
    /// First row's first word.
    pub(super) left: *const u32,
    /// Words from row to row.
    pub(super) stride: usize,
    /// First step of the panel.
    pub(super) right: *const u32,
    pub(super) steps: usize,
}

/// Adds to `sums`, rows of [`WIDTH`], the product of `rows` rows, at most `D::ROWS`.
///
/// # Safety
/// The CPU must have `D`'s instructions. `left` must be good for `rows` rows of `steps * D::WORDS` words, `right` for `steps * WIDTH`
/// words, `sums` for `rows * WIDTH`.
#[inline(always)]
pub(super) unsafe fn tile<D: Dot>(rows: usize, operands: Operands, sums: *mut u32) {
    macro_rules! by_rows {
        ($($rows:literal)+) => {
            match rows {
                // SAFETY: the caller's promise.
                $($rows => unsafe { by_strips::<D, $rows>(operands, sums) },)+
                _ => {}
            }
        };
    }
    const { assert!(D::ROWS == 6 || D::ROWS == 12) };
    if D::ROWS == 6 || rows <= 6 {
        by_rows!(1 2 3 4 5 6);
    } else {
        by_rows!(7 8 9 10 11 12);
    }
}

/// # Safety
/// As [`tile`], for `ROWS` rows.
#[inline(always)]
unsafe fn by_strips<D: Dot, const ROWS: usize>(operands: Operands, sums: *mut u32) {
    const { assert!(D::REGISTERS == 2 && WIDTH.is_multiple_of(2 * D::LANES)) };
    for column in (0..WIDTH).step_by(2 * D::LANES) {
        // SAFETY: the caller's promise; a strip lies within the panel.
        unsafe {
            let strip = Operands { right: operands.right.add(column), ..operands };
            by_registers::<D, ROWS, 2>(strip, sums.add(column));
        }
    }
}

/// # Safety
/// As [`tile`], for `ROWS` rows and `COLUMNS` registers of channels.
#[inline(always)]
unsafe fn by_registers<D: Dot, const ROWS: usize, const COLUMNS: usize>(operands: Operands, sums: *mut u32) {
    let Operands { left, stride, right, steps } = operands;
    // SAFETY: the caller's promise.
    unsafe {
        let mut acc: [[D::Sum; COLUMNS]; ROWS] =
            std::array::from_fn(|r| std::array::from_fn(|c| D::load(sums.add(r * WIDTH + c * D::LANES))));
        for step in 0..steps {
            let right = right.add(step * WIDTH);
            let right: [D::Right; COLUMNS] = std::array::from_fn(|c| D::right(right.add(c * D::LANES)));
            for (r, acc) in acc.iter_mut().enumerate() {
                let left = D::left(left.add(r * stride + step * D::WORDS));
                for c in 0..COLUMNS {
                    acc[c] = D::add(acc[c], left, right[c]);
                }
            }
        }
        for (r, acc) in acc.iter().enumerate() {
            for (c, acc) in acc.iter().enumerate() {
                D::store(*acc, sums.add(r * WIDTH + c * D::LANES));
            }
        }
    }
}

/// bf16 weights widened to f32 in registers: for instruction sets without a bf16 product.
pub(super) struct Widened<V, const ROWS: usize>(PhantomData<V>);

impl<V: Vector, const R: usize> Dot for Widened<V, R> {
    type Sum = V;
    type Left = [V; 2];
    type Right = [V; 2];
    const LANES: usize = V::LANES;
    const WORDS: usize = 2;
    const ROWS: usize = R;
    const REGISTERS: usize = 2;

    #[inline(always)]
    unsafe fn load(from: *const u32) -> V {
        // SAFETY: the caller's promise.
        unsafe { V::load(from.cast()) }
    }
    #[inline(always)]
    unsafe fn store(sum: V, to: *mut u32) {
        // SAFETY: the caller's promise.
        unsafe { sum.store(to.cast()) }
    }
    #[inline(always)]
    unsafe fn left(from: *const u32) -> [V; 2] {
        // SAFETY: the caller's promise.
        unsafe { [V::splat(f32::from_bits(*from)), V::splat(f32::from_bits(*from.add(1)))] }
    }
    #[inline(always)]
    unsafe fn right(from: *const u32) -> [V; 2] {
        // SAFETY: the caller's promise.
        unsafe { V::halves(from) }
    }
    #[inline(always)]
    unsafe fn add(sum: V, left: [V; 2], right: [V; 2]) -> V {
        // SAFETY: the caller's promise.
        unsafe { left[1].madd(right[1], left[0].madd(right[0], sum)) }
    }
}

#[cfg(target_arch = "x86_64")]
pub(super) mod x86 {
    use super::Dot;
    use std::arch::x86_64::*;

    /// AVX512-BF16: two products a lane and instruction.
    pub(in super::super) struct Bf16;

    impl Dot for Bf16 {
        type Sum = __m512;
        type Left = __m512i;
        type Right = __m512i;
        const LANES: usize = 16;
        const WORDS: usize = 1;
        const ROWS: usize = 12;
        const REGISTERS: usize = 2;

        #[inline(always)]
        unsafe fn load(from: *const u32) -> __m512 {
            // SAFETY: the caller's promise.
            unsafe { _mm512_loadu_ps(from.cast()) }
        }
        #[inline(always)]
        unsafe fn store(sum: __m512, to: *mut u32) {
            // SAFETY: the caller's promise.
            unsafe { _mm512_storeu_ps(to.cast(), sum) }
        }
        #[inline(always)]
        unsafe fn left(from: *const u32) -> __m512i {
            // SAFETY: the caller's promise.
            unsafe { _mm512_set1_epi32(*from.cast()) }
        }
        #[inline(always)]
        unsafe fn right(from: *const u32) -> __m512i {
            // SAFETY: the caller's promise.
            unsafe { _mm512_loadu_si512(from.cast()) }
        }
        #[inline(always)]
        unsafe fn add(sum: __m512, left: __m512i, right: __m512i) -> __m512 {
            // SAFETY: the caller has the instruction set; the types differ in name only.
            unsafe {
                let pairs = |x| std::mem::transmute::<__m512i, __m512bh>(x);
                _mm512_dpbf16_ps(sum, pairs(right), pairs(left))
            }
        }
    }
}
