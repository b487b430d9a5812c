//! Activations, converted once per product to what the kernel reads.

use super::isa::Kernel;
use super::panel::Words;
use super::words::{bf16, from_f32};
use rayon::prelude::*;

/// Rows converted in one task.
const ROWS: usize = 16;

/// Rows of words. A row starts at a cache line, and an odd number of lines after the one before, so that
/// the rows of a tile do not compete for the same sets of the cache.
pub(super) struct Left {
    words: Words,
    pub(super) n: usize,
    pub(super) stride: usize,
    /// What each row's integers are multiples of; 1 where the words are floats.
    pub(super) scales: Vec<f32>,
}

impl Left {
    /// Converts `x` `[n, k]`.
    pub(super) fn new(kernel: Kernel, x: &[f32], n: usize, k: usize) -> Self {
        let stride = ((k.div_ceil(kernel.per_step) * kernel.words).div_ceil(16) | 1) * 16;
        let mut words = Words::zeros(n * stride);
        let mut scales = vec![1f32; n];
        if k > 0 {
            let rows = words.get_mut().par_chunks_mut(ROWS * stride).zip(x.par_chunks(ROWS * k));
            rows.zip(scales.par_chunks_mut(ROWS)).for_each(|((words, x), scales)| {
                let rows = words.chunks_exact_mut(stride).zip(x.chunks_exact(k));
                for ((words, x), scale) in rows.zip(scales) {
                    // SAFETY: a `Kernel` exists only where the CPU has its instructions.
                    *scale = unsafe { (kernel.convert)(words, x) };
                }
            });
        }
        Left { words, n, stride, scales }
    }

    pub(super) fn words(&self) -> &[u32] {
        self.words.get()
    }
}

/// Two bf16 to a word.
#[inline(always)]
pub(super) fn pairs(words: &mut [u32], x: &[f32]) -> f32 {
    from_f32(x, words);
    1.0
}

/// Rounded to bf16, but as f32: two words to a step.
#[inline(always)]
pub(super) fn widened(words: &mut [u32], x: &[f32]) -> f32 {
    for (word, x) in words.iter_mut().zip(x) {
        *word = bf16(*x) << 16;
    }
    1.0
}
