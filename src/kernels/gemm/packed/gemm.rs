//! How a product is cut into tasks and tiles.

use super::isa::Kernel;
use super::lhs::Left;
use super::panel::{HALF, Panels, STEP_BLOCK, WIDTH};
use super::tile::{AHEAD, Operands, Tile, fetch, fetch_near};
use crate::kernels::simd::math::sigmoid;
use rayon::prelude::*;
use std::mem::MaybeUninit;
use std::ops::Range;

/// Steps of a panel multiplied at once: what of it stays in the second-level cache beside the rows of a task.
const STEPS: usize = 512;
/// Rows of a task.
pub(in crate::kernels) const TASK_ROWS: usize = 96;
/// Panels of a task, at most: what of the sums stays in the second-level cache between blocks of steps.
const PANELS: usize = 8;
/// Tasks of a product, if it is large enough: so many that no thread waits long for another one's last.
const TASKS: usize = 64;
/// Steps of panels by rows in a task, at least: some ten microseconds.
const LEAST: usize = 1 << 17;
/// Steps of a tile that takes longer than it takes to ask for its results' lines.
const LONG: usize = 256;
/// Values of a cache line.
const LINE: usize = 16;
/// Most rows of a tile.
const TALLEST: usize = 32;

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
    pub(in crate::kernels) scales: &'a [f32],
    /// What the sums are too large by where activations are unsigned.
    pub(in crate::kernels) offsets: &'a [i32],
}

impl Finish<'_> {
    /// For signed activations.
    pub(in crate::kernels) fn without_offsets(self) -> Self {
        Finish { channels: self.channels.map(|channels| Channels { offsets: &[], ..channels }), ..self }
    }

    /// Outputs of a panel.
    fn width(&self) -> usize {
        if self.gated { HALF } else { WIDTH }
    }

    /// What concerns one panel.
    #[inline(always)]
    fn panel(&self, panel: usize) -> PanelFinish {
        let first = panel * WIDTH;
        let bias = self.bias.map_or([0.0; WIDTH], |bias| part(bias, first));
        match self.channels {
            None => PanelFinish { start: bias.map(f32::to_bits), scales: None },
            Some(Channels { scales, offsets }) => {
                let start = part(offsets, first).map(|offset| offset.wrapping_neg() as u32);
                PanelFinish { start, scales: Some((part(scales, first), bias)) }
            }
        }
    }
}

/// The values of a panel's channels; zeros for those that do not exist.
#[inline(always)]
fn part<T: Copy + Default>(values: &[T], first: usize) -> [T; WIDTH] {
    let values = &values[first.min(values.len())..];
    match values.first_chunk() {
        Some(whole) => *whole,
        None => std::array::from_fn(|i| values.get(i).copied().unwrap_or_default()),
    }
}

/// [`Finish`] of one panel.
struct PanelFinish {
    /// What every row's sums start from.
    start: [u32; WIDTH],
    /// Of integer sums, with the bias.
    scales: Option<([f32; WIDTH], [f32; WIDTH])>,
}

impl PanelFinish {
    /// Turns a row's sums into its outputs, as bits; `scale` is that of the row.
    #[inline(always)]
    fn row(&self, sums: &mut [u32; WIDTH], scale: f32) {
        if let Some((scales, bias)) = &self.scales {
            for (sum, (by, bias)) in sums.iter_mut().zip(scales.iter().zip(bias)) {
                *sum = (*sum as i32 as f32 * (scale * by) + bias).to_bits();
            }
        }
    }
}

/// `silu(gate) * value` of a row whose first half are gates, in its first half.
#[inline(always)]
fn gate<const LANES: usize>(row: &mut [u32; WIDTH]) {
    let (gates, values) = row.split_at_mut(HALF);
    for (gate, value) in gates.iter_mut().zip(values) {
        let z = f32::from_bits(*gate);
        *gate = (z * sigmoid::<LANES>(z) * f32::from_bits(*value)).to_bits();
    }
}

/// A product with a packed weight.
#[derive(Clone, Copy)]
pub(in crate::kernels) struct Job<'a> {
    pub(in crate::kernels) kernel: Kernel,
    pub(in crate::kernels) left: &'a Left,
    pub(in crate::kernels) panels: &'a Panels,
    /// Outputs.
    pub(in crate::kernels) m: usize,
    pub(in crate::kernels) finish: Finish<'a>,
}

/// Some columns of the product, as a matrix of their own.
#[derive(Clone, Copy)]
struct Part {
    data: *mut f32,
    first: usize,
    columns: usize,
}

/// The results' buffers, of which tasks write rectangles that do not overlap.
#[derive(Clone, Copy)]
pub(in crate::kernels) struct Target<'a>(&'a [Part]);

// SAFETY: the tasks that share a `Target` write different elements.
unsafe impl Send for Target<'_> {}
// SAFETY: as above.
unsafe impl Sync for Target<'_> {}

impl Part {
    /// Which of some columns of the product are its own: the first, and how many.
    #[inline(always)]
    fn of(&self, columns: &Range<usize>) -> (usize, usize) {
        let start = columns.start.max(self.first);
        (start, columns.end.min(self.first + self.columns).saturating_sub(start))
    }
}

impl Job<'_> {
    /// The product's columns that a panel gives.
    #[inline(always)]
    fn columns(&self, panel: usize) -> Range<usize> {
        let width = self.finish.width();
        panel * width..self.m.min((panel + 1) * width)
    }

    /// Writes every element of the results, `[n, columns]` each, which share the product's `m` columns in turn.
    pub(in crate::kernels) fn run(&self, results: &mut [&mut [MaybeUninit<f32>]]) {
        let (n, m) = (self.left.n, self.m);
        if n == 0 || m == 0 {
            return;
        }
        let mut first = 0;
        let part = |result: &mut &mut [MaybeUninit<f32>]| {
            assert!(result.len().is_multiple_of(n));
            let part = Part { data: result.as_mut_ptr().cast(), first, columns: result.len() / n };
            first += part.columns;
            part
        };
        let parts: Vec<Part> = results.iter_mut().map(part).collect();
        assert!(first == m && self.finish.residual.is_none_or(|r| r.len() == n * m));
        let target = Target(&parts);
        let count = m.div_ceil(self.finish.width());
        assert!(count * WIDTH * self.panels.steps <= self.panels.words().len());
        let down = n.div_ceil(TASK_ROWS);
        let least = LEAST.div_ceil((n.div_ceil(down) * self.panels.steps).max(1));
        let wide = (count * down / TASKS).max(least).clamp(1, PANELS);
        let across = count.div_ceil(wide);
        // One by one: rayon would give a thread a quarter of them at once, which the other could not take over.
        (0..across * down).into_par_iter().with_max_len(1).for_each(|task| {
            let (row, panel) = (task / across * TASK_ROWS, task % across * wide);
            let rows = row..n.min(row + TASK_ROWS);
            let panels = panel..count.min(panel + wide);
            // SAFETY: a `Kernel` exists only where the CPU has its instructions; its panels and rows were made
            // for it; no two tasks share both a row and a panel.
            unsafe { (self.kernel.run)(self, target, rows, panels) }
        });
    }
}

/// Writes the product's `rows` and `panels`.
///
/// # Safety
/// The CPU must have `T`'s instructions, and the job must be for `T`. `target` must be the results, `[n, columns]` each and `m` columns in
/// all, in which nothing else uses these rows of these panels.
#[inline(always)]
pub(in crate::kernels) unsafe fn run<T: Tile>(
    job: &Job<'_>,
    target: Target<'_>,
    rows: Range<usize>,
    panels: Range<usize>,
) {
    let Job { left, panels: weight, .. } = job;
    // SAFETY: the caller has the instructions.
    let mut state = unsafe { T::start() };
    let tiles = rows.len().div_ceil(T::ROWS);
    // Even tiles, so that none is too low to keep the multipliers busy.
    let bound = |t: usize| if T::EVEN { t * rows.len() / tiles } else { rows.len().min(t * T::ROWS) };
    // Blocks of steps cut a sum, but do not change its order.
    let blocks = weight.steps.div_ceil(STEPS).max(1);
    let mut kept = vec![0u32; if blocks == 1 { 0 } else { rows.len() * panels.len() * WIDTH }];
    let mut single = [0u32; TALLEST * WIDTH];
    for block in 0..blocks {
        let steps = block * STEPS..weight.steps.min((block + 1) * STEPS);
        for (i, panel) in panels.clone().enumerate() {
            let right = (panel * weight.steps + steps.start) * WIDTH;
            let right = &weight.words()[right..right + steps.len() * WIDTH];
            let by = job.finish.panel(panel);
            for t in 0..tiles {
                let (first, count) = (bound(t), bound(t + 1) - bound(t));
                let sums = match blocks {
                    1 => &mut single[..count * WIDTH],
                    _ => &mut kept[(i * rows.len() + first) * WIDTH..][..count * WIDTH],
                };
                if block == 0 {
                    for sums in sums.as_chunks_mut::<WIDTH>().0 {
                        *sums = by.start;
                    }
                }
                let row = rows.start + first;
                let mut operands = operands::<T>(left, row..row + count, right, &steps);
                // Each tile asks for its share of what comes after this panel's block.
                operands.next = right
                    .as_ptr_range()
                    .end
                    .wrapping_add((weight.steps - steps.len()) * WIDTH + t * AHEAD * steps.len());
                if block + 1 == blocks && weight.steps >= LONG {
                    announce(job, target, row..row + count, panel);
                }
                // SAFETY: the caller's promise for the CPU; the operands and the sums are long enough.
                unsafe { T::multiply(&mut state, count, operands, sums.as_mut_ptr()) };
                if block + 1 == blocks {
                    // SAFETY: the caller's promise.
                    unsafe { finish::<T>(job, &by, target, row, panel, sums) };
                }
            }
        }
    }
}

/// Checks that all of them is there.
#[inline(always)]
fn operands<T: Tile>(left: &Left, rows: Range<usize>, right: &[u32], steps: &Range<usize>) -> Operands {
    assert!(steps.len() * WIDTH <= right.len() && steps.len().is_multiple_of(STEP_BLOCK));
    assert!(rows.end <= left.n && steps.end * T::WORDS <= left.stride);
    let words = &left.words()[rows.start * left.stride + steps.start * T::WORDS..];
    assert!(rows.len() * left.stride <= words.len() + steps.start * T::WORDS);
    Operands {
        left: words.as_ptr(),
        stride: left.stride,
        right: right.as_ptr(),
        next: right.as_ptr(),
        steps: steps.len(),
    }
}

/// Asks for the cache lines that [`finish`] will use, while there is a tile to multiply until then.
#[inline(always)]
fn announce(job: &Job<'_>, target: Target<'_>, rows: Range<usize>, panel: usize) {
    let columns = job.columns(panel);
    for row in rows {
        for part in target.0 {
            let (start, count) = part.of(&columns);
            let to = part.data.wrapping_add(row * part.columns + start - part.first);
            for line in (0..count).step_by(LINE) {
                fetch_near(to.wrapping_add(line).cast());
            }
        }
        if let Some(residual) = job.finish.residual {
            let from = residual.as_ptr().wrapping_add(row * job.m + columns.start);
            for line in (0..columns.len()).step_by(LINE) {
                fetch(from.wrapping_add(line).cast());
            }
        }
    }
}

/// Writes the rows of a panel from the sums.
///
/// # Safety
/// As for [`run`], for these rows and this panel.
#[inline(always)]
unsafe fn finish<T: Tile>(
    job: &Job<'_>,
    by: &PanelFinish,
    target: Target<'_>,
    row: usize,
    panel: usize,
    sums: &mut [u32],
) {
    let columns = job.columns(panel);
    let rows = sums.as_chunks_mut::<WIDTH>().0;
    for (r, sums) in rows.iter_mut().enumerate() {
        by.row(sums, job.left.scales[row + r]);
        if job.finish.gated {
            match T::LANES {
                16 => gate::<16>(sums),
                8 => gate::<8>(sums),
                _ => gate::<4>(sums),
            }
        }
        if let Some(residual) = job.finish.residual {
            let residual = &residual[(row + r) * job.m..][columns.clone()];
            for (sum, x) in sums.iter_mut().zip(residual) {
                *sum = (f32::from_bits(*sum) + x).to_bits();
            }
        }
    }
    for part in target.0 {
        let (start, count) = part.of(&columns);
        for (r, sums) in rows.iter().enumerate().filter(|_| count > 0) {
            let sums = &sums[start - columns.start..][..count];
            // SAFETY: the caller's promise; the columns are some of the part's; the bits are those of f32.
            unsafe {
                let to = part.data.add((row + r) * part.columns + start - part.first).cast::<u32>();
                match count {
                    WIDTH => to.copy_from_nonoverlapping(sums.as_ptr(), WIDTH),
                    _ => to.copy_from_nonoverlapping(sums.as_ptr(), count),
                }
            }
        }
    }
}
