//! How a product is cut into tasks and tiles.

use super::isa::Kernel;
use super::lhs::Left;
use super::panel::{Panels, WIDTH};
use super::tile::{Dot, Operands, tile};
use rayon::prelude::*;
use std::ops::Range;

/// Steps of a panel multiplied at once: what of it stays in the second-level cache beside the rows of a task.
const STEPS: usize = 1024;
/// Rows of a task.
const ROWS: usize = 96;
/// Panels of a task, at most: what of the sums stays in the second-level cache between blocks of steps.
const PANELS: usize = 8;
/// Most rows of a tile.
const TALLEST: usize = 12;

/// What is done to the sums.
#[derive(Clone, Copy)]
pub(super) struct Finish<'a> {
    /// One value per channel.
    pub(super) bias: Option<&'a [f32]>,
    /// For sums that are integers.
    pub(super) channels: Option<Channels<'a>>,
}

/// What turns the integer sums of each channel into its outputs.
#[derive(Clone, Copy)]
pub(super) struct Channels<'a> {
    pub(super) scales: &'a [f32],
    /// What the sums are too large by, activations being unsigned.
    pub(super) offsets: &'a [i32],
}

impl Finish<'_> {
    /// One row of a panel, from channel `first` on.
    #[inline(always)]
    fn row(&self, sums: &[u32], scale: f32, first: usize, out: &mut [f32]) {
        match self.channels {
            None => {
                for (o, sum) in out.iter_mut().zip(sums) {
                    *o = f32::from_bits(*sum);
                }
            }
            Some(Channels { scales, offsets }) => {
                let channels = scales[first..].iter().zip(&offsets[first..]);
                for ((o, sum), (by, offset)) in out.iter_mut().zip(sums).zip(channels) {
                    *o = (*sum as i32 - offset) as f32 * (scale * by);
                }
            }
        }
        if let Some(bias) = self.bias {
            for (o, bias) in out.iter_mut().zip(&bias[first..]) {
                *o += bias;
            }
        }
    }
}

/// A product with a packed weight.
#[derive(Clone, Copy)]
pub(super) struct Job<'a> {
    pub(super) kernel: Kernel,
    pub(super) left: &'a Left,
    pub(super) panels: &'a Panels,
    pub(super) finish: Finish<'a>,
}

/// The result's buffer, of which tasks write rectangles that do not overlap.
#[derive(Clone, Copy)]
pub(super) struct Target {
    data: *mut f32,
    columns: usize,
}

// SAFETY: the tasks that share a `Target` write different elements.
unsafe impl Send for Target {}
// SAFETY: as above.
unsafe impl Sync for Target {}

impl Target {
    /// # Safety
    /// The elements must lie in the buffer and nothing else may use them meanwhile.
    #[inline(always)]
    unsafe fn row<'a>(self, row: usize, columns: Range<usize>) -> &'a mut [f32] {
        // SAFETY: the caller's promise.
        unsafe {
            std::slice::from_raw_parts_mut(self.data.add(row * self.columns + columns.start), columns.len())
        }
    }
}

impl Job<'_> {
    /// Writes every element of `out`, `[n, m]`.
    pub(super) fn run(&self, out: &mut [f32]) {
        let (n, m) = (self.left.n, self.panels.m);
        assert_eq!(out.len(), n * m);
        if out.is_empty() {
            return;
        }
        let target = Target { data: out.as_mut_ptr(), columns: m };
        let (across, down) = (m.div_ceil(PANELS * WIDTH), n.div_ceil(ROWS));
        (0..across * down).into_par_iter().for_each(|task| {
            let (row, panel) = (task / across * ROWS, task % across * PANELS);
            let rows = row..n.min(row + ROWS);
            let panels = panel..m.div_ceil(WIDTH).min(panel + PANELS);
            // SAFETY: a `Kernel` exists only where the CPU has its instructions; its panels and rows were made
            // for it; no two tasks share both a row and a panel.
            unsafe { (self.kernel.run)(self, target, rows, panels) }
        });
    }
}

/// Writes the product's `rows` and `panels`.
///
/// # Safety
/// The CPU must have `D`'s instructions, and the job must be for `D`. `target` must be the `[n, m]` result, in which
/// nothing else uses these rows of these panels.
#[inline(always)]
pub(super) unsafe fn run<D: Dot>(job: &Job<'_>, target: Target, rows: Range<usize>, panels: Range<usize>) {
    let Job { left, panels: weight, .. } = job;
    let (total, m) = (weight.steps, weight.m);
    assert!(rows.end <= left.n && panels.end <= m.div_ceil(WIDTH));
    assert!(total * D::WORDS <= left.stride);
    // Tiles of equal height, so that none is too low to keep the multipliers busy.
    let tiles = rows.len().div_ceil(D::ROWS);
    let tile_rows = |t: usize| t * rows.len() / tiles..(t + 1) * rows.len() / tiles;
    let blocks = total.div_ceil(STEPS).max(1);
    let mut scratch = vec![0u32; if blocks == 1 { 0 } else { rows.len() * panels.len() * WIDTH }];
    let mut single = [0u32; TALLEST * WIDTH];
    for block in 0..blocks {
        let first = block * total / blocks;
        let steps = (block + 1) * total / blocks - first;
        for (i, panel) in panels.clone().enumerate() {
            let right = &weight.words()[(panel * total + first) * WIDTH..][..steps * WIDTH];
            for t in 0..tiles {
                let local = tile_rows(t);
                let sums = if blocks == 1 {
                    let sums = &mut single[..local.len() * WIDTH];
                    sums.fill(0);
                    sums
                } else {
                    &mut scratch[(i * rows.len() + local.start) * WIDTH..][..local.len() * WIDTH]
                };
                let row = rows.start + local.start;
                let words = &left.words()[row * left.stride + first * D::WORDS..];
                assert!((local.len() - 1) * left.stride + steps * D::WORDS <= words.len());
                let operands =
                    Operands { left: words.as_ptr(), stride: left.stride, right: right.as_ptr(), steps };
                // SAFETY: the caller's promise for the CPU; the sizes were checked above.
                unsafe { tile::<D>(local.len(), operands, sums.as_mut_ptr()) };
                if block + 1 < blocks {
                    continue;
                }
                let columns = panel * WIDTH..m.min((panel + 1) * WIDTH);
                for (r, sums) in sums.chunks_exact(WIDTH).enumerate() {
                    // SAFETY: the caller's promise; the panel's last column is below `m`.
                    let out = unsafe { target.row(row + r, columns.clone()) };
                    job.finish.row(sums, left.scales[row + r], columns.start, out);
                }
            }
        }
    }
}
