//! Weights as panels of 32 output channels.

use rayon::prelude::*;
use std::cell::Cell;

/// Output channels of a panel.
pub(in crate::kernels) const WIDTH: usize = 32;
/// Channels of each weight in a panel of two.
pub(in crate::kernels) const HALF: usize = WIDTH / 2;
/// Steps come in so many, as a tile unit takes them.
pub(in crate::kernels) const STEP_BLOCK: usize = 16;
/// Words transposed together: the part of 32 rows that stays in the first-level cache.
const PIECE: usize = 128;

thread_local!(
    /// The buffer of this thread's last product, so that the next need not have fresh pages from the system.
    static SPARE: Cell<Vec<u32>> = const { Cell::new(Vec::new()) }
);

/// Words whose first is at the start of a cache line, so that no register-wide load crosses one.
#[derive(Debug)]
pub(in crate::kernels) struct Words {
    data: Vec<u32>,
    start: usize,
    len: usize,
}

impl Words {
    /// Zeros.
    pub(in crate::kernels) fn zeros(len: usize) -> Self {
        let data = vec![0u32; len + 15];
        // The distance is 15 at most where the address is a multiple of 4, as it is for u32.
        let start = data.as_ptr().align_offset(64).min(15);
        Words { data, start, len }
    }

    /// With whatever an earlier buffer of this thread held.
    pub(in crate::kernels) fn recycled(len: usize) -> Self {
        let data = SPARE.take();
        if data.len() < len + 15 {
            return Words::zeros(len);
        }
        let start = data.as_ptr().align_offset(64).min(15);
        Words { data, start, len }
    }

    /// Keeps the buffer for [`Words::recycled`].
    pub(in crate::kernels) fn recycle(self) {
        SPARE.set(self.data);
    }

    pub(in crate::kernels) fn get(&self) -> &[u32] {
        &self.data[self.start..self.start + self.len]
    }

    pub(in crate::kernels) fn get_mut(&mut self) -> &mut [u32] {
        &mut self.data[self.start..self.start + self.len]
    }
}

/// A weight `[m, k]` as `[panel][step][channel]`; channels and values that do not exist are zeros.
#[derive(Debug)]
pub(in crate::kernels) struct Panels {
    words: Words,
    pub(in crate::kernels) m: usize,
    pub(in crate::kernels) k: usize,
    /// Steps through the inner dimension, those that pad it included.
    pub(in crate::kernels) steps: usize,
}

impl Panels {
    /// Packs rows that `fill(row, words)` writes, `per_step` values to a word. Also gives what it returned for each row.
    pub(in crate::kernels) fn build<T: Send>(
        m: usize,
        k: usize,
        per_step: usize,
        fill: impl Fn(usize, &mut [u32]) -> T + Sync,
    ) -> (Self, Vec<T>) {
        let steps = padded_steps(k, per_step);
        let mut words = Words::zeros(m.div_ceil(WIDTH) * WIDTH * steps);
        if steps == 0 {
            let results = (0..m).map(|row| fill(row, &mut [])).collect();
            return (Panels { words, m, k, steps }, results);
        }
        let pack = |rows: &mut Vec<u32>, (p, panel): (usize, &mut [u32])| -> Vec<T> {
            let first = p * WIDTH;
            let count = WIDTH.min(m - first);
            rows.resize(WIDTH * steps, 0);
            let filled = rows.chunks_exact_mut(steps).take(count).enumerate();
            let results = filled.map(|(r, row)| fill(first + r, &mut row[..k.div_ceil(per_step)])).collect();
            transpose(panel, rows, steps, count);
            results
        };
        let panels = words.get_mut().par_chunks_exact_mut(WIDTH * steps).enumerate();
        let results: Vec<Vec<T>> = panels.map_init(Vec::new, pack).collect();
        (Panels { words, m, k, steps }, results.into_iter().flatten().collect())
    }

    /// All panels.
    pub(in crate::kernels) fn words(&self) -> &[u32] {
        self.words.get()
    }

    /// Memory held, in bytes.
    pub(in crate::kernels) fn bytes(&self) -> usize {
        self.words.data.len() * size_of::<u32>()
    }

    /// The words of one row, which must be below `m`.
    pub(in crate::kernels) fn row(&self, row: usize) -> impl Iterator<Item = u32> + '_ {
        let panel = row / WIDTH * WIDTH * self.steps;
        let words = &self.words()[panel..panel + WIDTH * self.steps];
        words.chunks_exact(WIDTH).map(move |step| step[row % WIDTH])
    }
}

/// Steps for `k` values, `per_step` to a step.
pub(in crate::kernels) fn padded_steps(k: usize, per_step: usize) -> usize {
    k.div_ceil(per_step).next_multiple_of(STEP_BLOCK)
}

/// `count` rows of `steps` words to `steps` rows of [`WIDTH`].
fn transpose(panel: &mut [u32], rows: &[u32], steps: usize, count: usize) {
    for (piece, panel) in panel.chunks_mut(PIECE * WIDTH).enumerate() {
        for (c, row) in rows.chunks_exact(steps).take(count).enumerate() {
            for (step, word) in panel.chunks_exact_mut(WIDTH).zip(&row[piece * PIECE..]) {
                step[c] = *word;
            }
        }
    }
}
