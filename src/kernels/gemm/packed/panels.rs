//! Weights as panels of 32 output channels.

use rayon::prelude::*;
use std::cell::Cell;

/// Output channels of a panel.
pub(in crate::kernels) const PANEL_WIDTH: usize = 32;
/// Channels of each weight in a panel that two weights share.
pub(in crate::kernels) const HALF_PANEL: usize = PANEL_WIDTH / 2;
/// The number of steps is padded to a multiple of this, the steps that a tile unit takes at once.
pub(in crate::kernels) const STEP_BLOCK: usize = 16;
/// Words of a cache line.
const LINE_WORDS: usize = 16;
/// Words of each row that are transposed together: this part of 32 rows stays in the first-level cache.
const TRANSPOSE_WORDS: usize = 128;

thread_local!(
    /// The buffer of this thread's last product, so that the next one needs no fresh pages from the system.
    static SPARE: Cell<Vec<u32>> = const { Cell::new(Vec::new()) }
);

/// Words of which the first is at the start of a cache line, so that no register-wide load crosses one.
#[derive(Debug)]
pub(in crate::kernels) struct AlignedWords {
    data: Vec<u32>,
    start: usize,
    len: usize,
}

impl AlignedWords {
    /// Zeros.
    pub(in crate::kernels) fn zeros(len: usize) -> Self {
        let data = vec![0u32; len + LINE_WORDS - 1];
        // The distance is 15 at most where the address is a multiple of 4, as it is for u32.
        let start = data.as_ptr().align_offset(64).min(LINE_WORDS - 1);
        AlignedWords { data, start, len }
    }

    /// Holding whatever an earlier buffer of this thread held.
    pub(in crate::kernels) fn recycled(len: usize) -> Self {
        let data = SPARE.take();
        if data.len() < len + LINE_WORDS - 1 {
            return AlignedWords::zeros(len);
        }
        let start = data.as_ptr().align_offset(64).min(LINE_WORDS - 1);
        AlignedWords { data, start, len }
    }

    /// Keeps the buffer for [`AlignedWords::recycled`].
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
pub(in crate::kernels) struct WordPanels {
    words: AlignedWords,
    pub(in crate::kernels) m: usize,
    pub(in crate::kernels) k: usize,
    /// Steps through the inner dimension, those that pad it included.
    pub(in crate::kernels) steps: usize,
}

impl WordPanels {
    /// Packs rows that `fill(row, words)` writes, `per_step` values to a word. Also gives what it returned for each row.
    pub(in crate::kernels) fn build<T: Send>(
        m: usize,
        k: usize,
        per_step: usize,
        fill: impl Fn(usize, &mut [u32]) -> T + Sync,
    ) -> (Self, Vec<T>) {
        let steps = padded_steps(k, per_step);
        let mut words = AlignedWords::zeros(m.div_ceil(PANEL_WIDTH) * PANEL_WIDTH * steps);
        if steps == 0 {
            let results = (0..m).map(|row| fill(row, &mut [])).collect();
            return (WordPanels { words, m, k, steps }, results);
        }
        let pack = |rows: &mut Vec<u32>, (p, panel): (usize, &mut [u32])| -> Vec<T> {
            let first = p * PANEL_WIDTH;
            let count = PANEL_WIDTH.min(m - first);
            rows.resize(PANEL_WIDTH * steps, 0);
            let filled = rows.chunks_exact_mut(steps).take(count).enumerate();
            let results = filled.map(|(r, row)| fill(first + r, &mut row[..k.div_ceil(per_step)])).collect();
            transpose(panel, rows, steps, count);
            results
        };
        let panels = words.get_mut().par_chunks_exact_mut(PANEL_WIDTH * steps).enumerate();
        let results: Vec<Vec<T>> = panels.map_init(Vec::new, pack).collect();
        (WordPanels { words, m, k, steps }, results.into_iter().flatten().collect())
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
        let panel = row / PANEL_WIDTH * PANEL_WIDTH * self.steps;
        let words = &self.words()[panel..panel + PANEL_WIDTH * self.steps];
        words.chunks_exact(PANEL_WIDTH).map(move |step| step[row % PANEL_WIDTH])
    }
}

/// Steps for `k` values, `per_step` to a step.
pub(in crate::kernels) fn padded_steps(k: usize, per_step: usize) -> usize {
    k.div_ceil(per_step).next_multiple_of(STEP_BLOCK)
}

/// `count` rows of `steps` words to `steps` rows of [`PANEL_WIDTH`].
fn transpose(panel: &mut [u32], rows: &[u32], steps: usize, count: usize) {
    for (block, panel) in panel.chunks_mut(TRANSPOSE_WORDS * PANEL_WIDTH).enumerate() {
        for (c, row) in rows.chunks_exact(steps).take(count).enumerate() {
            for (step, word) in panel.chunks_exact_mut(PANEL_WIDTH).zip(&row[block * TRANSPOSE_WORDS..]) {
                step[c] = *word;
            }
        }
    }
}
