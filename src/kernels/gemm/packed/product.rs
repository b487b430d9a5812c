//! How a product is cut into tasks and calls of the micro-kernel.

use super::activations::{Activations, TASK_ROWS};
use super::micro_kernel::{MAX_ROWS, MicroKernel, Operands, PREFETCH_WORDS};
use super::panels::{HALF_PANEL, PANEL_WIDTH, WordPanels};
use crate::kernels::isa::Isa;
use crate::kernels::simd::{prefetch_l1, prefetch_l2, sigmoid};
use rayon::prelude::*;
use std::mem::MaybeUninit;
use std::ops::Range;

/// Steps of a panel multiplied before the next panel's turn: what of it stays in the second-level cache beside the rows of a task.
const BLOCK_STEPS: usize = 512;
/// Panels of a task, at most: what of the sums stays in the second-level cache between blocks of steps.
const MAX_TASK_PANELS: usize = 8;
/// Tasks of a product, if it is large enough: so many that no thread waits long for another one's last.
const TASKS: usize = 64;
/// Work of a task, at least, as steps of panels times rows: some ten microseconds.
const MIN_TASK_WORK: usize = 1 << 17;
/// Steps of a product, at least, for its results' cache lines to be prefetched: a shorter call of the micro-kernel takes less time than
/// the prefetches before it.
const MIN_STEPS_TO_PREFETCH: usize = 256;
/// Values of a cache line.
const LINE_VALUES: usize = 16;

/// What is done to the sums.
#[derive(Clone, Copy)]
pub(in crate::kernels) struct Finish<'a> {
    /// One value per channel.
    pub(in crate::kernels) bias: Option<&'a [f32]>,
    /// For sums that are integers.
    pub(in crate::kernels) channels: Option<Channels<'a>>,
    /// Whether a panel's first half are gates of the other: `silu(first) * second`.
    pub(in crate::kernels) gated: bool,
    /// What is added to the outputs at last, `[n, m]`.
    pub(in crate::kernels) residual: Option<&'a [f32]>,
}

/// What turns the integer sums of each channel into its outputs.
#[derive(Clone, Copy)]
pub(in crate::kernels) struct Channels<'a> {
    pub(super) scales: &'a [f32],
    /// What the sums are too large by where activations are unsigned.
    pub(super) offsets: &'a [i32],
}

impl Finish<'_> {
    /// For signed activations.
    pub(super) fn without_offsets(self) -> Self {
        Finish { channels: self.channels.map(|channels| Channels { offsets: &[], ..channels }), ..self }
    }

    /// Outputs of a panel.
    fn width(&self) -> usize {
        if self.gated { HALF_PANEL } else { PANEL_WIDTH }
    }

    /// What concerns one panel.
    #[inline(always)]
    fn panel(&self, panel: usize) -> PanelFinish {
        let first = panel * PANEL_WIDTH;
        let bias = self.bias.map_or([0.0; PANEL_WIDTH], |bias| of_panel(bias, first));
        match self.channels {
            None => PanelFinish { start: bias.map(f32::to_bits), scales: None },
            Some(Channels { scales, offsets }) => {
                let start = of_panel(offsets, first).map(|offset| offset.wrapping_neg() as u32);
                PanelFinish { start, scales: Some((of_panel(scales, first), bias)) }
            }
        }
    }
}

/// The values of a panel's channels; zeros for those that do not exist.
#[inline(always)]
fn of_panel<T: Copy + Default>(values: &[T], first: usize) -> [T; PANEL_WIDTH] {
    let values = &values[first.min(values.len())..];
    match values.first_chunk() {
        Some(whole) => *whole,
        None => std::array::from_fn(|i| values.get(i).copied().unwrap_or_default()),
    }
}

/// [`Finish`] of one panel.
struct PanelFinish {
    /// What every row's sums start from.
    start: [u32; PANEL_WIDTH],
    /// Of integer sums, with the bias.
    scales: Option<([f32; PANEL_WIDTH], [f32; PANEL_WIDTH])>,
}

impl PanelFinish {
    /// Turns a row's sums into its outputs, as bits; `scale` is that of the row.
    #[inline(always)]
    fn row(&self, sums: &mut [u32; PANEL_WIDTH], scale: f32) {
        if let Some((scales, bias)) = &self.scales {
            for (sum, (by, bias)) in sums.iter_mut().zip(scales.iter().zip(bias)) {
                *sum = (*sum as i32 as f32 * (scale * by) + bias).to_bits();
            }
        }
    }
}

/// `silu(gate) * value` of a row whose first half are gates, in its first half.
#[inline(always)]
fn gate<S: Isa>(isa: S, row: &mut [u32; PANEL_WIDTH]) {
    let (gates, values) = row.split_at_mut(HALF_PANEL);
    for (gate, value) in gates.iter_mut().zip(values) {
        let z = f32::from_bits(*gate);
        *gate = (z * sigmoid(isa, z) * f32::from_bits(*value)).to_bits();
    }
}

/// A product with a packed weight.
#[derive(Clone, Copy)]
pub(super) struct Product<'a> {
    pub(super) left: &'a Activations,
    pub(super) panels: &'a WordPanels,
    /// Outputs.
    pub(super) m: usize,
    pub(super) finish: Finish<'a>,
}

/// Some columns of the product, as a matrix of their own.
#[derive(Clone, Copy)]
struct OutputPart {
    data: *mut f32,
    first: usize,
    columns: usize,
}

impl OutputPart {
    /// Which of some columns of the product are its own: the first, and how many.
    #[inline(always)]
    fn own_columns(&self, columns: &Range<usize>) -> (usize, usize) {
        let start = columns.start.max(self.first);
        (start, columns.end.min(self.first + self.columns).saturating_sub(start))
    }
}

/// The results' buffers.
#[derive(Clone, Copy)]
struct Outputs<'a>(&'a [OutputPart]);

// SAFETY: the buffers are written through `TaskOutput`s alone, no two of which share an element.
unsafe impl Send for Outputs<'_> {}
// SAFETY: as above.
unsafe impl Sync for Outputs<'_> {}

impl<'a> Outputs<'a> {
    /// # Safety
    /// The rows and panels must be some of the product's, and none of another `TaskOutput`'s elements that is in use.
    unsafe fn task(self, rows: Range<usize>, panels: Range<usize>) -> TaskOutput<'a> {
        TaskOutput { parts: self.0, rows, panels }
    }
}

/// The elements of the results that one task writes, and nobody else: some rows of some panels' columns.
pub(super) struct TaskOutput<'a> {
    parts: &'a [OutputPart],
    rows: Range<usize>,
    panels: Range<usize>,
}

impl Product<'_> {
    /// The product's columns that a panel gives.
    #[inline(always)]
    fn columns(&self, panel: usize) -> Range<usize> {
        let width = self.finish.width();
        panel * width..self.m.min((panel + 1) * width)
    }

    /// Writes every element of the results, `[n, columns]` each, which share the product's `m` columns in turn; `run` is [`run_task`]
    /// of one task.
    pub(super) fn write(
        &self,
        results: &mut [&mut [MaybeUninit<f32>]],
        run: impl Fn(TaskOutput<'_>) + Sync + Send,
    ) {
        let (n, m) = (self.left.n, self.m);
        if n == 0 || m == 0 {
            return;
        }
        let mut first = 0;
        let part = |result: &mut &mut [MaybeUninit<f32>]| {
            assert!(result.len().is_multiple_of(n));
            let part = OutputPart { data: result.as_mut_ptr().cast(), first, columns: result.len() / n };
            first += part.columns;
            part
        };
        let parts: Vec<OutputPart> = results.iter_mut().map(part).collect();
        assert!(first == m && self.finish.residual.is_none_or(|r| r.len() == n * m));
        let outputs = Outputs(&parts);
        let count = m.div_ceil(self.finish.width());
        assert!(count * PANEL_WIDTH * self.panels.steps <= self.panels.words().len());
        let down = n.div_ceil(TASK_ROWS);
        let min_panels = MIN_TASK_WORK.div_ceil((n.div_ceil(down) * self.panels.steps).max(1));
        let wide = (count * down / TASKS).max(min_panels).clamp(1, MAX_TASK_PANELS);
        let across = count.div_ceil(wide);
        // One by one: rayon would give a thread a quarter of them at once, which the other could not take over.
        (0..across * down).into_par_iter().with_max_len(1).for_each(|task| {
            let (row, panel) = (task / across * TASK_ROWS, task % across * wide);
            let rows = row..n.min(row + TASK_ROWS);
            let panels = panel..count.min(panel + wide);
            // SAFETY: no two tasks share both a row and a panel, and all are within the product.
            run(unsafe { outputs.task(rows, panels) });
        });
    }
}

/// Writes the elements of a task.
#[inline(always)]
pub(super) fn run_task<M: MicroKernel>(isa: M::Isa, product: &Product<'_>, mut output: TaskOutput<'_>) {
    let Product { left, panels: weight, .. } = product;
    let (rows, panels) = (output.rows.clone(), output.panels.clone());
    let mut state = M::start(isa);
    let calls = rows.len().div_ceil(M::ROWS);
    // Even calls, so that none has too few rows to keep the multipliers busy.
    let bound = |t: usize| if M::EVEN { t * rows.len() / calls } else { rows.len().min(t * M::ROWS) };
    // Blocks of steps cut a sum, but do not change its order.
    let blocks = weight.steps.div_ceil(BLOCK_STEPS).max(1);
    let mut kept = vec![0u32; if blocks == 1 { 0 } else { rows.len() * panels.len() * PANEL_WIDTH }];
    let mut single = [0u32; MAX_ROWS * PANEL_WIDTH];
    for block in 0..blocks {
        let steps = block * BLOCK_STEPS..weight.steps.min((block + 1) * BLOCK_STEPS);
        for (i, panel) in panels.clone().enumerate() {
            let right = (panel * weight.steps + steps.start) * PANEL_WIDTH;
            let right = &weight.words()[right..right + steps.len() * PANEL_WIDTH];
            let by = product.finish.panel(panel);
            for t in 0..calls {
                let (first, count) = (bound(t), bound(t + 1) - bound(t));
                let sums = match blocks {
                    1 => &mut single[..count * PANEL_WIDTH],
                    _ => &mut kept[(i * rows.len() + first) * PANEL_WIDTH..][..count * PANEL_WIDTH],
                };
                if block == 0 {
                    for sums in sums.as_chunks_mut::<PANEL_WIDTH>().0 {
                        *sums = by.start;
                    }
                }
                let row = rows.start + first;
                let mut operands = operands::<M>(left, row..row + count, right, &steps);
                // Each call prefetches its share of what comes after this panel's block.
                operands.next = right.as_ptr_range().end.wrapping_add(
                    (weight.steps - steps.len()) * PANEL_WIDTH + t * PREFETCH_WORDS * steps.len(),
                );
                if block + 1 == blocks && weight.steps >= MIN_STEPS_TO_PREFETCH {
                    prefetch_outputs(product, &output, row..row + count, panel);
                }
                // SAFETY: `operands` checked that the rows, the spare ones and the steps are there; `sums` holds `count` rows.
                unsafe { M::multiply(isa, &mut state, count, operands, sums.as_mut_ptr()) };
                if block + 1 == blocks {
                    finish(isa, product, &by, &mut output, row, panel, sums);
                }
            }
        }
    }
}

/// The operands of a call, all of which are there.
#[inline(always)]
fn operands<M: MicroKernel>(
    left: &Activations,
    rows: Range<usize>,
    right: &[u32],
    steps: &Range<usize>,
) -> Operands {
    assert!(steps.len() * PANEL_WIDTH <= right.len() && steps.len().is_multiple_of(M::STEP_MULTIPLE));
    assert!(rows.end <= left.n && M::SPARE_ROWS <= left.spare_rows && steps.end * M::WORDS <= left.stride);
    let words = &left.words()[rows.start * left.stride + steps.start * M::WORDS..];
    assert!((rows.len() + M::SPARE_ROWS) * left.stride <= words.len() + steps.start * M::WORDS);
    Operands {
        left: words.as_ptr(),
        stride: left.stride,
        right: right.as_ptr(),
        next: right.as_ptr(),
        steps: steps.len(),
    }
}

/// Prefetches what [`finish`] will write and read, before the micro-kernel's call that it comes after.
#[inline(always)]
fn prefetch_outputs(product: &Product<'_>, output: &TaskOutput<'_>, rows: Range<usize>, panel: usize) {
    let columns = product.columns(panel);
    for row in rows {
        for part in output.parts {
            let (start, count) = part.own_columns(&columns);
            let to = part.data.wrapping_add(row * part.columns + start - part.first);
            for line in (0..count).step_by(LINE_VALUES) {
                prefetch_l1(to.wrapping_add(line).cast());
            }
        }
        if let Some(residual) = product.finish.residual {
            let from = residual.as_ptr().wrapping_add(row * product.m + columns.start);
            for line in (0..columns.len()).step_by(LINE_VALUES) {
                prefetch_l2(from.wrapping_add(line).cast());
            }
        }
    }
}

/// Writes the task's rows from `row` on of a panel, from their sums.
#[inline(always)]
fn finish<S: Isa>(
    isa: S,
    product: &Product<'_>,
    by: &PanelFinish,
    output: &mut TaskOutput<'_>,
    row: usize,
    panel: usize,
    sums: &mut [u32],
) {
    let columns = product.columns(panel);
    let rows = sums.as_chunks_mut::<PANEL_WIDTH>().0;
    for (r, sums) in rows.iter_mut().enumerate() {
        by.row(sums, product.left.scales[row + r]);
        if product.finish.gated {
            gate(isa, sums);
        }
        if let Some(residual) = product.finish.residual {
            let residual = &residual[(row + r) * product.m..][columns.clone()];
            for (sum, x) in sums.iter_mut().zip(residual) {
                *sum = (f32::from_bits(*sum) + x).to_bits();
            }
        }
    }
    assert!(output.panels.contains(&panel));
    assert!(output.rows.start <= row && row + rows.len() <= output.rows.end);
    for part in output.parts {
        let (start, count) = part.own_columns(&columns);
        for (r, sums) in rows.iter().enumerate().filter(|_| count > 0) {
            let sums = &sums[start - columns.start..][..count];
            // SAFETY: the task owns these elements: the rows and the panel are its own, and the columns are some of the part's. The
            // bits are those of f32.
            unsafe {
                let to = part.data.add((row + r) * part.columns + start - part.first).cast::<u32>();
                match count {
                    PANEL_WIDTH => to.copy_from_nonoverlapping(sums.as_ptr(), PANEL_WIDTH),
                    _ => to.copy_from_nonoverlapping(sums.as_ptr(), count),
                }
            }
        }
    }
}
