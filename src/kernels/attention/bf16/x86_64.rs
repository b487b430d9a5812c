//! The kernels of AVX512-BF16 and of AMX.

use super::job::{CompiledAttention, KeyPart, MAX_KEY_PARTS, MAX_READY_SCORES, QueryRows, Workspace};
use crate::kernels::gemm::packed::{
    AmxMicroKernel, Bf16Dot, HALF_PANEL, MicroKernel, Operands, PANEL_WIDTH, from_f32, multiply_by_registers,
};
#[cfg(test)]
use crate::kernels::isa::EmulatedUnit;
use crate::kernels::isa::{AmxUnit, Avx512Bf16, TileUnit, call_compiled, compiled_for};
use std::arch::x86_64::*;

/// Words of a panel of keys in a row of probabilities.
const PANEL_PAIRS: usize = PANEL_WIDTH / 2;
/// Words of a cache line.
const LINE_WORDS: usize = 16;

/// A micro-kernel's products, by whole panels or by their first half, compiled for AVX512-BF16 apart from everything else.
///
/// # Safety
/// `multiply` must read and write no more than its own promise says.
unsafe trait PanelProducts: Copy + Send + Sync {
    type Micro: MicroKernel;

    fn start(self) -> <Self::Micro as MicroKernel>::State;

    /// [`MicroKernel::multiply`] of some rows by a panel, or by its first half.
    ///
    /// # Safety
    /// As there.
    unsafe fn multiply(
        self,
        state: &mut <Self::Micro as MicroKernel>::State,
        rows_and_half: (usize, bool),
        operands: Operands,
        sums: *mut u32,
    );
}

/// Defines `fn $name` that gives a kernel, and the rows that it takes, of the tokens of AVX512-BF16 and of a micro-kernel.
macro_rules! attention_kernel {
    ($(#[$meta:meta])* fn $name:ident = $micro:ty) => {
        $(#[$meta])*
        pub(super) fn $name(
            isa: Avx512Bf16,
            micro_isa: <$micro as MicroKernel>::Isa,
        ) -> (usize, Box<dyn CompiledAttention>) {
            #[derive(Clone, Copy)]
            struct Compiled(Avx512Bf16, <$micro as MicroKernel>::Isa);

            // SAFETY: either product keeps the promise.
            unsafe impl PanelProducts for Compiled {
                type Micro = $micro;

                #[inline(always)]
                fn start(self) -> <$micro as MicroKernel>::State {
                    <$micro as MicroKernel>::start(self.1)
                }

                #[inline(always)]
                unsafe fn multiply(
                    self,
                    state: &mut <$micro as MicroKernel>::State,
                    rows_and_half: (usize, bool),
                    operands: Operands,
                    sums: *mut u32,
                ) {
                    compiled_for! {
                        Avx512Bf16,
                        // A function of its own: within a larger one the compiler does not keep the sums in registers.
                        #[inline(never)]
                        unsafe fn apart(
                            isa: <$micro as MicroKernel>::Isa,
                            state: &mut <$micro as MicroKernel>::State,
                            (rows, half): (usize, bool),
                            operands: Operands,
                            sums: *mut u32,
                        ) {
                            // SAFETY: the caller's promise is that of either.
                            unsafe {
                                match half {
                                    true => <$micro as HalfPanels>::multiply_half(isa, state, rows, operands, sums),
                                    false => <$micro as MicroKernel>::multiply(isa, state, rows, operands, sums),
                                }
                            }
                        }
                    }
                    // SAFETY: the first token proves that the CPU has what `apart` is compiled for; the rest is the caller's promise.
                    unsafe { apart(self.1, state, rows_and_half, operands, sums) }
                }
            }

            impl CompiledAttention for Compiled {
                fn run(&self, rows: QueryRows<'_>, workspace: &mut Workspace) {
                    let products = *self;
                    call_compiled!(Avx512Bf16, self.0, attend_rows::<Compiled>, (
                        products: Compiled,
                        rows: QueryRows<'_>,
                        workspace: &mut Workspace,
                    ))
                }
            }

            (<$micro as MicroKernel>::ROWS, Box::new(Compiled(isa, micro_isa)))
        }
    };
}
attention_kernel!(
    /// By AVX512-BF16.
    fn dot_products = Bf16Dot
);
attention_kernel!(
    /// By AMX; the softmax by AVX-512.
    fn amx = AmxMicroKernel<AmxUnit, false>
);
attention_kernel!(
    /// The same by an emulated unit.
    #[cfg(test)]
    fn emulated_amx = AmxMicroKernel<EmulatedUnit, false>
);

/// Products with half panels.
trait HalfPanels: MicroKernel {
    /// [`MicroKernel::multiply`], of which only the first half of the channels is wanted.
    ///
    /// # Safety
    /// As there.
    #[inline(always)]
    unsafe fn multiply_half(
        isa: Self::Isa,
        state: &mut Self::State,
        rows: usize,
        operands: Operands,
        sums: *mut u32,
    ) {
        // SAFETY: the caller's promise.
        unsafe { Self::multiply(isa, state, rows, operands, sums) }
    }
}

impl<U: TileUnit> HalfPanels for AmxMicroKernel<U, false> {}

impl HalfPanels for Bf16Dot {
    #[inline(always)]
    unsafe fn multiply_half(isa: Avx512Bf16, _: &mut (), rows: usize, operands: Operands, sums: *mut u32) {
        macro_rules! by_rows {
            ($($rows:literal)+) => {
                match rows {
                    // SAFETY: the caller's promise is for whole panels, of which this is half.
                    $($rows => unsafe { multiply_by_registers::<Bf16Dot, $rows, 1>(isa, operands, sums) },)+
                    _ => {}
                }
            };
        }
        by_rows!(1 2 3 4 5 6 7 8 9 10 11 12);
    }
}

/// Where the matrices of a call lie in the workspace, in words: rows of queries, scores, weights and sums, one after the other.
struct WorkspaceLayout {
    rows: usize,
    /// Panels of keys of each part that some row sees.
    panels: [usize; MAX_KEY_PARTS],
    /// Words of a converted query row, all of which are multiplied.
    steps: usize,
    /// Words from one row of weights to the next: an odd number of cache lines, so that rows do not compete for the same sets of the
    /// cache.
    stride: usize,
    scores: usize,
    weights: usize,
    sums: usize,
    end: usize,
}

impl WorkspaceLayout {
    fn new<M: MicroKernel>(job: &QueryRows<'_>) -> WorkspaceLayout {
        let rows = job.totals.len();
        let mut panels = [0; MAX_KEY_PARTS];
        for (panels, part) in panels.iter_mut().zip(job.parts) {
            *panels = part.seen.iter().max().map_or(0, |seen| seen.div_ceil(PANEL_WIDTH));
        }
        let all: usize = panels.iter().sum();
        let steps = job.head_dim.div_ceil(2).next_multiple_of(M::STEP_MULTIPLE);
        let stride = ((all * PANEL_PAIRS).div_ceil(16) | 1) * 16;
        // As many rows as the micro-kernel may read: a tile unit reads rows after the last.
        let scores = (M::ROWS * steps).next_multiple_of(16);
        let weights = scores + all * rows * PANEL_WIDTH;
        let sums = weights + M::ROWS * stride;
        WorkspaceLayout { rows, panels, steps, stride, scores, weights, sums, end: sums + rows * PANEL_WIDTH }
    }
}

/// [`CompiledAttention::run`].
#[inline(always)]
fn attend_rows<P: PanelProducts>(
    isa: Avx512Bf16,
    products: P,
    job: QueryRows<'_>,
    workspace: &mut Workspace,
) {
    let shape = WorkspaceLayout::new::<P::Micro>(&job);
    check::<P::Micro>(&job, &shape);
    if workspace.words.len() < shape.end + LINE_WORDS - 1 {
        workspace.words = vec![0; shape.end + LINE_WORDS - 1];
    }
    let start = workspace.words.as_ptr().align_offset(64).min(LINE_WORDS - 1);
    let words = &mut workspace.words[start..start + shape.end];
    let (q, rest) = words.split_at_mut(shape.scores);
    let (scores, rest) = rest.split_at_mut(shape.weights - shape.scores);
    let (weights, sums) = rest.split_at_mut(shape.sums - shape.weights);
    for (words, q) in q.chunks_exact_mut(shape.steps).zip(job.q.chunks_exact(job.head_dim)) {
        from_f32(q, words);
        words[job.head_dim.div_ceil(2)..].fill(0);
    }
    let mut state = products.start();
    // SAFETY: `check` compared what the operands hold with what is read; the workspace has room for as many rows as a micro-kernel
    // may read.
    unsafe {
        let mut panel = 0;
        for (part, panels) in job.parts.iter().zip(shape.panels) {
            let right = part.keys.keys.words();
            let length = part.keys.keys.steps * PANEL_WIDTH;
            for p in 0..panels {
                let to = &mut scores[panel * shape.rows * PANEL_WIDTH..][..shape.rows * PANEL_WIDTH];
                to.fill(0);
                let right = right[p * length..(p + 1) * length].as_ptr();
                let (left, stride, steps) = (q.as_ptr(), shape.steps, shape.steps);
                let operands = Operands { left, stride, right, next: right, steps };
                products.multiply(&mut state, (shape.rows, false), operands, to.as_mut_ptr());
                panel += 1;
            }
        }
        for r in 0..shape.rows {
            let ready = job.ready.get_mut(r * MAX_READY_SCORES..(r + 1) * MAX_READY_SCORES);
            let weights = &mut weights[r * shape.stride..(r + 1) * shape.stride];
            job.totals[r] = softmax_of_row(isa, job.parts, &shape, r, scores, ready, weights);
        }
        for column in (0..job.head_dim).step_by(PANEL_WIDTH) {
            sums.fill(0);
            let half = job.head_dim - column <= HALF_PANEL;
            let mut panel = 0;
            for (part, panels) in job.parts.iter().zip(shape.panels) {
                let steps = panels * PANEL_PAIRS;
                let from = column * part.keys.steps;
                let right = part.keys.values.get()[from..from + steps * PANEL_WIDTH].as_ptr();
                let left = weights[panel * PANEL_PAIRS..].as_ptr();
                let operands = Operands { left, stride: shape.stride, right, next: right, steps };
                products.multiply(&mut state, (shape.rows, half), operands, sums.as_mut_ptr());
                panel += panels;
            }
            let count = PANEL_WIDTH.min(job.head_dim - column);
            for (to, from) in job.sums.chunks_exact_mut(job.head_dim).zip(sums.chunks_exact(PANEL_WIDTH)) {
                for (to, from) in to[column..column + count].iter_mut().zip(from) {
                    *to = f32::from_bits(*from);
                }
            }
        }
    }
}

/// Checks that all operands are there.
#[inline(always)]
fn check<M: MicroKernel>(job: &QueryRows<'_>, shape: &WorkspaceLayout) {
    let (rows, hd) = (shape.rows, job.head_dim);
    assert!(rows <= M::ROWS && hd > 0 && job.parts.len() <= MAX_KEY_PARTS);
    assert!(job.q.len() == rows * hd && job.sums.len() == rows * hd);
    assert!(job.ready.is_empty() || job.ready.len() == rows * MAX_READY_SCORES);
    for part in job.parts {
        assert!(part.seen.len() == rows && part.seen.iter().all(|&seen| seen <= part.keys.keys.m));
        assert!(part.keys.keys.k == hd && shape.steps <= part.keys.keys.steps);
    }
}

/// Turns one row's scores into weights `2^(s - max)`, those of the parts in bf16, and returns their sum.
///
/// # Safety
/// `scores` and `weights` must be the shape's, `ready` a row of [`MAX_READY_SCORES`], and no part have more panels than the shape.
#[inline(always)]
unsafe fn softmax_of_row(
    isa: Avx512Bf16,
    parts: &[KeyPart<'_>],
    shape: &WorkspaceLayout,
    row: usize,
    scores: &mut [u32],
    ready: Option<&mut [f32]>,
    weights: &mut [u32],
) -> f32 {
    // From a row of scores of one panel to that of the next.
    let jump = shape.rows * PANEL_WIDTH;
    let scores = scores.as_mut_ptr().wrapping_add(row * PANEL_WIDTH).cast::<f32>();
    // SAFETY: the token proves that the CPU has the instructions; panels end within the scores and the weights, and a row of
    // `MAX_READY_SCORES` is one register.
    unsafe {
        let mut maxima = [_mm512_set1_ps(f32::NEG_INFINITY); 2];
        let mut first = 0;
        for (part, panels) in parts.iter().zip(shape.panels) {
            let (whole, rest) = (part.seen[row] / PANEL_WIDTH, part.seen[row] % PANEL_WIDTH);
            if rest > 0 {
                let at = scores.add((first + whole) * jump);
                for half in 0..2 {
                    let unseen = !((1u32 << rest) - 1) >> (16 * half);
                    let lowest = _mm512_set1_ps(f32::NEG_INFINITY);
                    _mm512_mask_storeu_ps(at.add(16 * half), unseen as u16, lowest);
                }
            }
            for panel in first..first + part.seen[row].div_ceil(PANEL_WIDTH) {
                for (half, max) in maxima.iter_mut().enumerate() {
                    // This gives its second operand where the first is NaN: the maximum is one of the numbers.
                    *max = _mm512_max_ps(_mm512_loadu_ps(scores.add(panel * jump + 16 * half)), *max);
                }
            }
            first += panels;
        }
        let mut max = _mm512_max_ps(maxima[0], maxima[1]);
        if let Some(ready) = &ready {
            max = _mm512_max_ps(_mm512_loadu_ps(ready.as_ptr()), max);
        }
        let max = _mm512_set1_ps(_mm512_reduce_max_ps(max));
        let mut totals = [_mm512_setzero_ps(); 2];
        let mut to = weights.as_mut_ptr();
        let mut first = 0;
        for (part, panels) in parts.iter().zip(shape.panels) {
            let seen = part.seen[row].div_ceil(PANEL_WIDTH);
            for panel in first..first + seen {
                let at = scores.add(panel * jump);
                let low = exp2(isa, _mm512_sub_ps(_mm512_loadu_ps(at), max));
                let high = exp2(isa, _mm512_sub_ps(_mm512_loadu_ps(at.add(16)), max));
                totals = [_mm512_add_ps(totals[0], low), _mm512_add_ps(totals[1], high)];
                let pairs = std::mem::transmute::<__m512bh, __m512i>(_mm512_cvtne2ps_pbh(high, low));
                _mm512_storeu_si512(to.cast(), pairs);
                to = to.add(PANEL_PAIRS);
            }
            to.write_bytes(0, (panels - seen) * PANEL_PAIRS);
            to = to.add((panels - seen) * PANEL_PAIRS);
            first += panels;
        }
        let mut total = _mm512_add_ps(totals[0], totals[1]);
        if let Some(ready) = ready {
            let exponentials = exp2(isa, _mm512_sub_ps(_mm512_loadu_ps(ready.as_ptr()), max));
            _mm512_storeu_ps(ready.as_mut_ptr(), exponentials);
            total = _mm512_add_ps(total, exponentials);
        }
        _mm512_reduce_add_ps(total)
    }
}

/// `2^x` for `x <= 0` to 3e-6 of itself, 0 below -200.
#[inline(always)]
fn exp2(_: Avx512Bf16, x: __m512) -> __m512 {
    // The polynomial of degree 4 with the least relative error on 0..1, by Remez's algorithm.
    const POLYNOMIAL: [f32; 5] = [0.013_534_168, 0.052_011_46, 0.241_442_75, 0.693_003_83, 1.000_002_6];
    const FLOOR: i32 = 9;
    // SAFETY: the token proves that the CPU has the instructions.
    unsafe {
        // A NaN stays one, since the second operand is taken where either is NaN. Minus infinity is raised, since it has no
        // remainder.
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
