//! Activations, converted once per product to what the micro-kernel reads.

use super::panels::{AlignedWords, padded_steps};
use super::words::{bf16, from_f32};
use crate::kernels::isa::Isa;
use rayon::prelude::*;

/// Rows of a task of a product.
pub(super) const TASK_ROWS: usize = 96;
/// Rows converted in one task.
const CONVERTED_ROWS: usize = 16;
/// Bytes of activations that are converted, then multiplied, before the next: what stays in the cache, and what a thread keeps from
/// one product to the next.
const CHUNK_BYTES: usize = 8 << 20;

/// How rows become words.
#[derive(Clone, Copy)]
pub(super) struct RowForm {
    /// Values of a row in one step.
    pub(super) per_step: usize,
    /// Words of a row in one step.
    pub(super) words: usize,
    /// Rows that may be read after the last.
    pub(super) spare_rows: usize,
}

impl RowForm {
    /// Rows of `k` values to convert and multiply before the next.
    pub(super) fn chunk_rows(self, k: usize) -> usize {
        let bytes = padded_steps(k, self.per_step).max(1) * self.words * size_of::<u32>();
        (CHUNK_BYTES / bytes).next_multiple_of(TASK_ROWS).max(4 * TASK_ROWS)
    }
}

/// Rows of words. A row starts at a cache line, and an odd number of lines after the one before, so that
/// the rows of a tile do not compete for the same sets of the cache.
pub(super) struct Activations {
    words: AlignedWords,
    /// Rows after the last that may be read.
    pub(super) spare_rows: usize,
    pub(super) n: usize,
    pub(super) stride: usize,
    /// What each row's integers are multiples of; 1 where the words are floats.
    pub(super) scales: Vec<f32>,
}

impl Activations {
    /// Converts `x` `[n, k]`; `convert` writes the words of a row and returns its scale.
    pub(super) fn new(
        form: RowForm,
        convert: impl Fn(&mut [u32], &[f32]) -> f32 + Sync,
        x: &[f32],
        n: usize,
        k: usize,
    ) -> Self {
        let used = k.div_ceil(form.per_step) * form.words;
        let stride = ((padded_steps(k, form.per_step) * form.words).div_ceil(16) | 1) * 16;
        let mut words = AlignedWords::recycled((n + form.spare_rows) * stride);
        let mut scales = vec![1f32; n];
        let rows = words.get_mut()[..n * stride].par_chunks_mut(CONVERTED_ROWS * stride).enumerate();
        rows.zip(scales.par_chunks_mut(CONVERTED_ROWS)).for_each(|((chunk, words), scales)| {
            for (r, (words, scale)) in words.chunks_exact_mut(stride).zip(scales).enumerate() {
                let row = chunk * CONVERTED_ROWS + r;
                let (words, padding) = words.split_at_mut(used);
                *scale = convert(words, &x[row * k..(row + 1) * k]);
                padding.fill(0);
            }
        });
        Activations { words, spare_rows: form.spare_rows, n, stride, scales }
    }

    /// Keeps the buffer for this thread's next product.
    pub(super) fn recycle(self) {
        self.words.recycle();
    }

    pub(super) fn words(&self) -> &[u32] {
        self.words.get()
    }
}

/// Two bf16 to a word.
#[inline(always)]
pub(super) fn bf16_pairs<S: Isa>(_: S, words: &mut [u32], x: &[f32]) -> f32 {
    from_f32(x, words);
    1.0
}

/// Rounded to bf16, but as f32: two words to a step.
#[inline(always)]
pub(super) fn widened_bf16<S: Isa>(_: S, words: &mut [u32], x: &[f32]) -> f32 {
    let (values, padding) = words.split_at_mut(x.len().min(words.len()));
    for (word, x) in values.iter_mut().zip(x) {
        *word = bf16(*x) << 16;
    }
    padding.fill(0);
    1.0
}
