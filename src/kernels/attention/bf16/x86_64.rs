//! [`super::kernel`] by AVX512-BF16 and by AMX.

use super::kernel::*;
use crate::kernels::gemm::packed::amx::{Tiles, Unit};
use crate::kernels::gemm::packed::amx_unit;
use crate::kernels::gemm::packed::dot_bf16::x86::Bf16;
use crate::kernels::gemm::packed::panel::WIDTH;
use crate::kernels::gemm::packed::panel::{HALF, STEP_BLOCK};
use crate::kernels::gemm::packed::tile::{Operands, Tile, by_registers};
use crate::kernels::gemm::packed::words::from_f32;
use std::arch::x86_64::*;

macro_rules! attend {
    ($(#[$meta:meta])* $constant:ident, $tile:ty) => {
        $(#[$meta])*
        pub(super) const $constant: Attend = {
            // A function of its own: within a larger one the compiler does not keep the sums in registers.
            #[inline(never)]
            #[target_feature(enable = "avx512bf16,avx512f,avx512vl,avx512dq,avx512bw,avx2,fma")]
            unsafe fn multiply(
                state: &mut <$tile as Tile>::State,
                (rows, half): (usize, bool),
                operands: Operands,
                sums: *mut u32,
            ) {
                // SAFETY: the caller's promise.
                unsafe {
                    match half {
                        true => <$tile as Halves>::half(state, rows, operands, sums),
                        false => <$tile as Tile>::multiply(state, rows, operands, sums),
                    }
                }
            }
            #[target_feature(enable = "avx512bf16,avx512f,avx512vl,avx512dq,avx512bw,avx2,fma")]
            unsafe fn run(rows: Rows<'_>, space: &mut Space) {
                // SAFETY: the caller's promise.
                unsafe { attend::<$tile>(rows, space, multiply) }
            }
            Attend { rows: <$tile as Tile>::ROWS, run }
        };
    };
}
attend!(DOT, Bf16);
attend!(AMX, Tiles<amx_unit::Tiles, false>);
attend!(
    #[cfg(test)]
    EMULATED,
    Tiles<crate::kernels::gemm::packed::amx::Emulated, false>
);

/// [`Tile::multiply`], by whole panels or by their first half.
type Multiply<S> = unsafe fn(&mut S, (usize, bool), Operands, *mut u32);

/// Half panels.
trait Halves: Tile {
    /// [`Tile::multiply`], of which only the first half of the channels is wanted.
    ///
    /// # Safety
    /// As there.
    #[inline(always)]
    unsafe fn half(state: &mut Self::State, rows: usize, operands: Operands, sums: *mut u32) {
        // SAFETY: the caller's promise.
        unsafe { Self::multiply(state, rows, operands, sums) }
    }
}

impl<U: Unit> Halves for Tiles<U, false> {}

impl Halves for Bf16 {
    #[inline(always)]
    unsafe fn half(_: &mut (), rows: usize, operands: Operands, sums: *mut u32) {
        macro_rules! by_rows {
            ($($rows:literal)+) => {
                match rows {
                    // SAFETY: the caller's promise.
                    $($rows => unsafe { by_registers::<Bf16, $rows, 1>(operands, sums) },)+
                    _ => {}
                }
            };
        }
        by_rows!(1 2 3 4 5 6 7 8 9 10 11 12);
    }
}

/// Where the matrices of a call lie in its buffer, in words.
struct Shape {
    rows: usize,
    /// Panels of keys of each part that some row sees.
    panels: [usize; PARTS],
    /// Words multiplied of a query row, and from row to row.
    steps: usize,
    /// From row to row of the probabilities: an odd number of cache lines, so that rows do not compete for the same sets.
    stride: usize,
    scores: usize,
    weights: usize,
    sums: usize,
    end: usize,
}

impl Shape {
    fn new<T: Tile>(job: &Rows<'_>) -> Shape {
        let rows = job.totals.len();
        let mut panels = [0; PARTS];
        for (panels, part) in panels.iter_mut().zip(job.parts) {
            *panels = part.seen.iter().max().map_or(0, |seen| seen.div_ceil(WIDTH));
        }
        let all: usize = panels.iter().sum();
        let block = if T::EVEN { 4 } else { STEP_BLOCK };
        let steps = job.head_dim.div_ceil(2).next_multiple_of(block);
        let stride = ((all * PANEL_WORDS).div_ceil(16) | 1) * 16;
        // A tile unit reads rows after the last.
        let scores = (T::ROWS * steps).next_multiple_of(16);
        let weights = scores + all * rows * WIDTH;
        let sums = weights + T::ROWS * stride;
        Shape { rows, panels, steps, stride, scores, weights, sums, end: sums + rows * WIDTH }
    }
}

/// # Safety
/// The CPU must have `T`'s instructions and AVX512-BF16; `multiply` must be `T`'s.
#[inline(always)]
unsafe fn attend<T: Tile>(job: Rows<'_>, space: &mut Space, multiply: Multiply<T::State>) {
    let shape = Shape::new::<T>(&job);
    check::<T>(&job, &shape);
    if space.words.len() < shape.end + 15 {
        space.words = vec![0; shape.end + 15];
    }
    let start = space.words.as_ptr().align_offset(64).min(15);
    let words = &mut space.words[start..start + shape.end];
    let (q, rest) = words.split_at_mut(shape.scores);
    let (scores, rest) = rest.split_at_mut(shape.weights - shape.scores);
    let (weights, sums) = rest.split_at_mut(shape.sums - shape.weights);
    for (words, q) in q.chunks_exact_mut(shape.steps).zip(job.q.chunks_exact(job.head_dim)) {
        from_f32(q, words);
        words[job.head_dim.div_ceil(2)..].fill(0);
    }
    // SAFETY: the caller's promise for the CPU; `check` compared what the operands hold with what is read.
    unsafe {
        let mut state = T::start();
        let mut panel = 0;
        for (part, panels) in job.parts.iter().zip(shape.panels) {
            let right = part.keys.keys.words();
            let length = part.keys.keys.steps * WIDTH;
            for p in 0..panels {
                let to = &mut scores[panel * shape.rows * WIDTH..][..shape.rows * WIDTH];
                to.fill(0);
                let right = right[p * length..(p + 1) * length].as_ptr();
                let (left, stride, steps) = (q.as_ptr(), shape.steps, shape.steps);
                let operands = Operands { left, stride, right, next: right, steps };
                multiply(&mut state, (shape.rows, false), operands, to.as_mut_ptr());
                panel += 1;
            }
        }
        for r in 0..shape.rows {
            let given = job.given.get_mut(r * GIVEN..(r + 1) * GIVEN);
            let weights = &mut weights[r * shape.stride..(r + 1) * shape.stride];
            job.totals[r] = softmax(job.parts, &shape, r, scores, given, weights);
        }
        for column in (0..job.head_dim).step_by(WIDTH) {
            sums.fill(0);
            let half = job.head_dim - column <= HALF;
            let mut panel = 0;
            for (part, panels) in job.parts.iter().zip(shape.panels) {
                let steps = panels * PANEL_WORDS;
                let from = column * part.keys.steps;
                let right = part.keys.values.get()[from..from + steps * WIDTH].as_ptr();
                let left = weights[panel * PANEL_WORDS..].as_ptr();
                let operands = Operands { left, stride: shape.stride, right, next: right, steps };
                multiply(&mut state, (shape.rows, half), operands, sums.as_mut_ptr());
                panel += panels;
            }
            let count = WIDTH.min(job.head_dim - column);
            for (to, from) in job.sums.chunks_exact_mut(job.head_dim).zip(sums.chunks_exact(WIDTH)) {
                for (to, from) in to[column..column + count].iter_mut().zip(from) {
                    *to = f32::from_bits(*from);
                }
            }
        }
    }
}

/// That all operands are there.
#[inline(always)]
fn check<T: Tile>(job: &Rows<'_>, shape: &Shape) {
    let (rows, hd) = (shape.rows, job.head_dim);
    assert!(rows <= T::ROWS && hd > 0 && job.parts.len() <= PARTS);
    assert!(job.q.len() == rows * hd && job.sums.len() == rows * hd);
    assert!(job.given.is_empty() || job.given.len() == rows * GIVEN);
    for part in job.parts {
        assert!(part.seen.len() == rows && part.seen.iter().all(|&seen| seen <= part.keys.keys.m));
        assert!(part.keys.keys.k == hd && shape.steps <= part.keys.keys.steps);
    }
}

/// Turns one row's scores into weights `2^(s - max)`, those of the parts in bf16, and returns their sum.
///
/// # Safety
/// The CPU must have AVX512-BF16. The buffers must be those of the shape.
#[inline(always)]
unsafe fn softmax(
    parts: &[Part<'_>],
    shape: &Shape,
    row: usize,
    scores: &mut [u32],
    given: Option<&mut [f32]>,
    weights: &mut [u32],
) -> f32 {
    // From panel to panel.
    let jump = shape.rows * WIDTH;
    let scores = scores.as_mut_ptr().wrapping_add(row * WIDTH).cast::<f32>();
    // SAFETY: the caller's promise; panels end within the scores and the weights, a row of `GIVEN` is 16 elements.
    unsafe {
        let mut maxima = [_mm512_set1_ps(f32::NEG_INFINITY); 2];
        let mut first = 0;
        for (part, panels) in parts.iter().zip(shape.panels) {
            let (whole, rest) = (part.seen[row] / WIDTH, part.seen[row] % WIDTH);
            if rest > 0 {
                let at = scores.add((first + whole) * jump);
                for half in 0..2 {
                    let unseen = !((1u32 << rest) - 1) >> (16 * half);
                    let lowest = _mm512_set1_ps(f32::NEG_INFINITY);
                    _mm512_mask_storeu_ps(at.add(16 * half), unseen as u16, lowest);
                }
            }
            for panel in first..first + part.seen[row].div_ceil(WIDTH) {
                for (half, max) in maxima.iter_mut().enumerate() {
                    // The second operand is taken where the first is NaN.
                    *max = _mm512_max_ps(_mm512_loadu_ps(scores.add(panel * jump + 16 * half)), *max);
                }
            }
            first += panels;
        }
        let mut max = _mm512_max_ps(maxima[0], maxima[1]);
        if let Some(given) = &given {
            max = _mm512_max_ps(_mm512_loadu_ps(given.as_ptr()), max);
        }
        let max = _mm512_set1_ps(_mm512_reduce_max_ps(max));
        let mut totals = [_mm512_setzero_ps(); 2];
        let mut to = weights.as_mut_ptr();
        let mut first = 0;
        for (part, panels) in parts.iter().zip(shape.panels) {
            let seen = part.seen[row].div_ceil(WIDTH);
            for panel in first..first + seen {
                let at = scores.add(panel * jump);
                let low = exp2(_mm512_sub_ps(_mm512_loadu_ps(at), max));
                let high = exp2(_mm512_sub_ps(_mm512_loadu_ps(at.add(16)), max));
                totals = [_mm512_add_ps(totals[0], low), _mm512_add_ps(totals[1], high)];
                let pairs = std::mem::transmute::<__m512bh, __m512i>(_mm512_cvtne2ps_pbh(high, low));
                _mm512_storeu_si512(to.cast(), pairs);
                to = to.add(PANEL_WORDS);
            }
            to.write_bytes(0, (panels - seen) * PANEL_WORDS);
            to = to.add((panels - seen) * PANEL_WORDS);
            first += panels;
        }
        let mut total = _mm512_add_ps(totals[0], totals[1]);
        if let Some(given) = given {
            let exponentials = exp2(_mm512_sub_ps(_mm512_loadu_ps(given.as_ptr()), max));
            _mm512_storeu_ps(given.as_mut_ptr(), exponentials);
            total = _mm512_add_ps(total, exponentials);
        }
        _mm512_reduce_add_ps(total)
    }
}

/// `2^x` for `x <= 0` to 3e-6 of itself, 0 below -200.
///
/// # Safety
/// The CPU must have AVX-512.
#[inline(always)]
unsafe fn exp2(x: __m512) -> __m512 {
    // Of least relative error among polynomials of degree 4 on 0..1 (Remez's algorithm).
    const POLYNOMIAL: [f32; 5] = [0.013_534_168, 0.052_011_46, 0.241_442_75, 0.693_003_83, 1.000_002_6];
    const FLOOR: i32 = 9;
    // SAFETY: the caller's promise.
    unsafe {
        // A NaN stays, being the second operand; minus infinity has no remainder.
        let x = _mm512_max_ps(_mm512_set1_ps(-200.0), x);
        let r = _mm512_reduce_ps::<FLOOR>(x);
        let [highest, rest @ ..] = POLYNOMIAL;
        let mut p = _mm512_set1_ps(highest);
        for c in rest {
            p = _mm512_fmadd_ps(p, r, _mm512_set1_ps(c));
        }
        _mm512_scalef_ps(p, x)
    }
}
