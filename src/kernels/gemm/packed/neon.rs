//! Products by NEON and its extensions. What the instructions do stands in the Arm Architecture Reference Manual.
//!
//! They multiply a register by one place of another, so that four words of a row are loaded at once, and none is
//! spread over a register first.

use super::panel::WIDTH;
use super::tile::{AHEAD, Operands, Tile, fetch, opaque};
use std::arch::aarch64::*;
use std::arch::asm;
use std::marker::PhantomData;

/// f32, i32 or words to a register.
const LANES: usize = 4;

/// How four words of a row are multiplied by the steps that they stand for.
///
/// # Safety
/// Functions may be called only where the CPU has the type's instructions.
pub(in crate::kernels) trait Quad {
    /// Sums of four channels.
    type Sum: Copy;
    /// Words of a row in one step: 1 or 2.
    const WORDS: usize;

    /// # Safety
    /// `from` must be good for four words.
    unsafe fn load(from: *const u32) -> Self::Sum;

    /// # Safety
    /// `to` must be good for four words.
    unsafe fn store(sum: Self::Sum, to: *mut u32);

    /// The steps, [`WIDTH`] words apart, of four channels, as [`Quad::add`] takes them.
    ///
    /// # Safety
    /// `from` must be good for four words of each step.
    unsafe fn right(from: *const u32) -> [uint32x4_t; LANES];

    /// Adds one place's share: what the `PLACE`th of the registers of [`Quad::right`] is multiplied by.
    unsafe fn add<const PLACE: i32>(sum: Self::Sum, left: uint32x4_t, right: uint32x4_t) -> Self::Sum;
}

/// Rows by a panel, by the instructions of `Q`.
pub(in crate::kernels) struct Neon<Q>(PhantomData<Q>);

impl<Q: Quad> Tile for Neon<Q> {
    type State = ();
    const LANES: usize = LANES;
    const WORDS: usize = Q::WORDS;
    /// Sixteen registers of sums and eight of the weight leave eight of the 32.
    const ROWS: usize = 8;
    const EVEN: bool = true;

    #[inline(always)]
    unsafe fn start() {}

    #[inline(always)]
    unsafe fn multiply(_: &mut (), rows: usize, operands: Operands, sums: *mut u32) {
        macro_rules! by_rows {
            ($($rows:literal x $columns:literal)+) => {
                match rows {
                    // SAFETY: the caller's promise.
                    $($rows => unsafe { by_strips::<Q, $rows, $columns>(operands, sums) },)+
                    _ => {}
                }
            };
        }
        // Few rows by more columns, so that there are sums enough to wait for.
        by_rows!(1 x 4 2 x 4 3 x 2 4 x 2 5 x 2 6 x 2 7 x 2 8 x 2);
    }
}

/// # Safety
/// As [`Tile::multiply`], for `ROWS` rows.
#[inline(always)]
unsafe fn by_strips<Q: Quad, const ROWS: usize, const COLUMNS: usize>(operands: Operands, sums: *mut u32) {
    const { assert!(WIDTH.is_multiple_of(COLUMNS * LANES)) };
    for column in (0..WIDTH).step_by(COLUMNS * LANES) {
        // SAFETY: the caller's promise; a strip lies within the panel.
        unsafe {
            let strip = Operands { right: operands.right.add(column), ..operands };
            by_registers::<Q, ROWS, COLUMNS>(strip, sums.add(column));
        }
    }
}

/// # Safety
/// As [`Tile::multiply`], for `ROWS` rows and `COLUMNS` registers of channels.
#[inline(always)]
unsafe fn by_registers<Q: Quad, const ROWS: usize, const COLUMNS: usize>(operands: Operands, sums: *mut u32) {
    let Operands { left, stride, mut right, mut next, steps } = operands;
    let mut rows: [*const u32; ROWS] = std::array::from_fn(|r| opaque(left.wrapping_add(r * stride)));
    let at_once = LANES / Q::WORDS;
    // SAFETY: the caller's promise; steps come in multiples of four.
    unsafe {
        let mut acc: [[Q::Sum; COLUMNS]; ROWS] =
            std::array::from_fn(|r| std::array::from_fn(|c| Q::load(sums.add(r * WIDTH + c * LANES))));
        for _ in 0..steps / at_once {
            let steps: [_; COLUMNS] = std::array::from_fn(|c| Q::right(right.add(c * LANES)));
            // Written out: the compiler keeps the sums of no loop of eight in registers.
            macro_rules! rows {
                ($($r:literal)+) => {
                    $(if $r < ROWS {
                        add::<Q, COLUMNS>(&mut acc[$r], vld1q_u32(rows[$r]), &steps);
                        rows[$r] = rows[$r].wrapping_add(LANES);
                    })+
                };
            }
            rows!(0 1 2 3 4 5 6 7);
            right = right.wrapping_add(at_once * WIDTH);
            fetch(next);
            next = next.wrapping_add(at_once * AHEAD);
        }
        for (r, acc) in acc.iter().enumerate() {
            for (c, acc) in acc.iter().enumerate() {
                Q::store(*acc, sums.add(r * WIDTH + c * LANES));
            }
        }
    }
}

/// Adds a row's four words' share to its sums.
///
/// # Safety
/// The CPU must have `Q`'s instructions.
#[inline(always)]
unsafe fn add<Q: Quad, const COLUMNS: usize>(
    sums: &mut [Q::Sum; COLUMNS],
    left: uint32x4_t,
    steps: &[[uint32x4_t; LANES]; COLUMNS],
) {
    macro_rules! places {
        ($($place:literal)+) => {
            $(for (sum, steps) in sums.iter_mut().zip(steps) {
                // SAFETY: the caller's promise.
                *sum = unsafe { Q::add::<$place>(*sum, left, steps[$place]) };
            })+
        };
    }
    places!(0 1 2 3);
}

macro_rules! sums {
    (f32) => {
        type Sum = float32x4_t;
        #[inline(always)]
        unsafe fn load(from: *const u32) -> float32x4_t {
            // SAFETY: the caller's promise.
            unsafe { vld1q_f32(from.cast()) }
        }
        #[inline(always)]
        unsafe fn store(sum: float32x4_t, to: *mut u32) {
            // SAFETY: the caller's promise.
            unsafe { vst1q_f32(to.cast(), sum) }
        }
    };
    (i32) => {
        type Sum = int32x4_t;
        #[inline(always)]
        unsafe fn load(from: *const u32) -> int32x4_t {
            // SAFETY: the caller's promise.
            unsafe { vld1q_s32(from.cast()) }
        }
        #[inline(always)]
        unsafe fn store(sum: int32x4_t, to: *mut u32) {
            // SAFETY: the caller's promise.
            unsafe { vst1q_s32(to.cast(), sum) }
        }
    };
}

/// Four steps as they lie.
///
/// # Safety
/// As [`Quad::right`].
#[inline(always)]
unsafe fn four_steps(from: *const u32) -> [uint32x4_t; LANES] {
    // SAFETY: the caller's promise.
    std::array::from_fn(|step| unsafe { vld1q_u32(from.add(step * WIDTH)) })
}

/// bf16 widened to f32: a word of a row is one value, a step has two.
pub(in crate::kernels) struct Widened;

impl Quad for Widened {
    const WORDS: usize = 2;
    sums!(f32);

    #[inline(always)]
    unsafe fn right(from: *const u32) -> [uint32x4_t; LANES] {
        // SAFETY: the caller's promise.
        unsafe {
            let [a, b] = [vld1q_u32(from), vld1q_u32(from.add(WIDTH))];
            let upper = vdupq_n_u32(0xffff_0000);
            [vshlq_n_u32::<16>(a), vandq_u32(a, upper), vshlq_n_u32::<16>(b), vandq_u32(b, upper)]
        }
    }

    #[inline(always)]
    unsafe fn add<const PLACE: i32>(sum: float32x4_t, left: uint32x4_t, right: uint32x4_t) -> float32x4_t {
        // SAFETY: the caller has the instruction set.
        unsafe { vfmaq_laneq_f32::<PLACE>(sum, vreinterpretq_f32_u32(right), vreinterpretq_f32_u32(left)) }
    }
}

/// Bytes widened to 16 bits: a row's words hold the values 0 and 2, then 1 and 3, of a step.
pub(in crate::kernels) struct Bytes;

impl Quad for Bytes {
    const WORDS: usize = 2;
    sums!(i32);

    /// The bytes 0 and 1, then 2 and 3, of the first and of the second step, for all four channels each.
    #[inline(always)]
    unsafe fn right(from: *const u32) -> [uint32x4_t; LANES] {
        // SAFETY: the caller's promise.
        let pairs = |step: usize| unsafe {
            let bytes = vreinterpretq_s16_u32(vld1q_u32(from.add(step * WIDTH)));
            let (even, odd) = (vshrq_n_s16::<8>(vshlq_n_s16::<8>(bytes)), vshrq_n_s16::<8>(bytes));
            [vreinterpretq_u32_s16(vuzp1q_s16(even, odd)), vreinterpretq_u32_s16(vuzp2q_s16(even, odd))]
        };
        let [[a, b], [c, d]] = [pairs(0), pairs(1)];
        [a, b, c, d]
    }

    #[inline(always)]
    unsafe fn add<const PLACE: i32>(sum: int32x4_t, left: uint32x4_t, right: uint32x4_t) -> int32x4_t {
        macro_rules! two {
            ($first:literal, $second:literal) => {
                // SAFETY: the caller has the instruction set.
                unsafe {
                    let (left, right) = (vreinterpretq_s16_u32(left), vreinterpretq_s16_u32(right));
                    let sum = vmlal_laneq_s16::<$first>(sum, vget_low_s16(right), left);
                    vmlal_high_laneq_s16::<$second>(sum, right, left)
                }
            };
        }
        match PLACE {
            0 => two!(0, 2),
            1 => two!(1, 3),
            2 => two!(4, 6),
            _ => two!(5, 7),
        }
    }
}

/// Pairs of bf16, by FEAT_BF16.
pub(in crate::kernels) struct Bf16;

impl Quad for Bf16 {
    const WORDS: usize = 1;
    sums!(f32);

    #[inline(always)]
    unsafe fn right(from: *const u32) -> [uint32x4_t; LANES] {
        // SAFETY: the caller's promise.
        unsafe { four_steps(from) }
    }

    #[inline(always)]
    unsafe fn add<const PLACE: i32>(sum: float32x4_t, left: uint32x4_t, right: uint32x4_t) -> float32x4_t {
        // SAFETY: the caller's promise.
        unsafe { bfdot::<PLACE>(sum, left, right) }
    }
}

/// Four signed bytes, by FEAT_DotProd.
pub(in crate::kernels) struct Dot;

impl Quad for Dot {
    const WORDS: usize = 1;
    sums!(i32);

    #[inline(always)]
    unsafe fn right(from: *const u32) -> [uint32x4_t; LANES] {
        // SAFETY: the caller's promise.
        unsafe { four_steps(from) }
    }

    #[inline(always)]
    unsafe fn add<const PLACE: i32>(sum: int32x4_t, left: uint32x4_t, right: uint32x4_t) -> int32x4_t {
        // SAFETY: the caller's promise.
        unsafe { sdot::<PLACE>(sum, left, right) }
    }
}

// The standard library has no stable names for these two.

/// Adds the products of the two bf16 of each word of `right` and of the `PLACE`th of `left`.
///
/// It rounds to odd after the sum of the pair and again after adding it; subnormal values are zeros.
#[inline]
#[target_feature(enable = "neon,bf16")]
pub(in crate::kernels) fn bfdot<const PLACE: i32>(
    mut sum: float32x4_t,
    left: uint32x4_t,
    right: uint32x4_t,
) -> float32x4_t {
    // SAFETY: the instruction reads and writes these registers alone.
    unsafe {
        asm!(
            "bfdot {sum:v}.4s, {right:v}.8h, {left:v}.2h[{place}]",
            sum = inout(vreg) sum,
            right = in(vreg) right,
            left = in(vreg) left,
            place = const PLACE,
            options(pure, nomem, nostack, preserves_flags),
        );
    }
    sum
}

/// Adds the products of the four signed bytes of each word of `right` and of the `PLACE`th of `left`.
#[inline]
#[target_feature(enable = "neon,dotprod")]
pub(in crate::kernels) fn sdot<const PLACE: i32>(
    mut sum: int32x4_t,
    left: uint32x4_t,
    right: uint32x4_t,
) -> int32x4_t {
    // SAFETY: the instruction reads and writes these registers alone.
    unsafe {
        asm!(
            "sdot {sum:v}.4s, {right:v}.16b, {left:v}.4b[{place}]",
            sum = inout(vreg) sum,
            right = in(vreg) right,
            left = in(vreg) left,
            place = const PLACE,
            options(pure, nomem, nostack, preserves_flags),
        );
    }
    sum
}
