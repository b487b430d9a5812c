//! Activations, converted once per product to what the kernel reads.

use super::gemm::TASK_ROWS;
use super::isa::Kernel;
use super::panel::{Words, padded_steps};
use super::words::{bf16, from_f32};
use rayon::prelude::*;

/// Rows converted in one task.
const ROWS: usize = 16;

/// Bytes converted at once: what stays in the cache, and what a thread keeps from one product to the next.
const AT_ONCE: usize = 8 << 20;

/// Rows to convert and multiply at once.
pub(in crate::kernels) fn rows_at_once(kernel: Kernel, k: usize) -> usize {
    let bytes = padded_steps(k, kernel.per_step).max(1) * kernel.words * size_of::<u32>();
    (AT_ONCE / bytes).next_multiple_of(TASK_ROWS).max(4 * TASK_ROWS)
}

/// Rows of words. A row starts at a cache line, and an odd number of lines after the one before, so that
/// the rows of a tile do not compete for the same sets of the cache.
pub(in crate::kernels) struct Left {
    words: Words,
    pub(in crate::kernels) n: usize,
    pub(in crate::kernels) stride: usize,
    /// What each row's integers are multiples of; 1 where the words are floats.
    pub(in crate::kernels) scales: Vec<f32>,
}

impl Left {
    /// Converts `x` `[n, k]`.
    pub(in crate::kernels) fn new(kernel: Kernel, x: &[f32], n: usize, k: usize) -> Self {
        let used = k.div_ceil(kernel.per_step) * kernel.words;
        let stride = ((padded_steps(k, kernel.per_step) * kernel.words).div_ceil(16) | 1) * 16;
        let mut words = Words::recycled((n + kernel.spare_rows) * stride);
        let mut scales = vec![1f32; n];
        let rows = words.get_mut()[..n * stride].par_chunks_mut(ROWS * stride).enumerate();
        rows.zip(scales.par_chunks_mut(ROWS)).for_each(|((chunk, words), scales)| {
            for (r, (words, scale)) in words.chunks_exact_mut(stride).zip(scales).enumerate() {
                let row = chunk * ROWS + r;
                let (words, padding) = words.split_at_mut(used);
                // SAFETY: a `Kernel` exists only where the CPU has its instructions.
                *scale = unsafe { (kernel.convert)(words, &x[row * k..(row + 1) * k]) };
                padding.fill(0);
            }
        });
        Left { words, n, stride, scales }
    }

    /// Keeps the buffer for this thread's next product.
    pub(in crate::kernels) fn recycle(self) {
        self.words.recycle();
    }

    pub(in crate::kernels) fn words(&self) -> &[u32] {
        self.words.get()
    }
}

/// Two bf16 to a word.
#[inline(always)]
pub(in crate::kernels) fn pairs(words: &mut [u32], x: &[f32]) -> f32 {
    from_f32(x, words);
    1.0
}

/// [`pairs`] by AVX512-BF16, to which subnormal values are zeros.
///
/// # Safety
/// The CPU must have AVX512-BF16.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
pub(in crate::kernels) unsafe fn pairs_at_once(words: &mut [u32], x: &[f32]) -> f32 {
    use std::arch::x86_64::{__m512, __m512bh, _mm512_cvtne2ps_pbh, _mm512_loadu_ps, _mm512_storeu_ps};
    let (whole, rest) = x.as_chunks::<32>();
    let (first, last) = words.split_at_mut(whole.len() * 16);
    for (words, x) in first.as_chunks_mut::<16>().0.iter_mut().zip(whole) {
        // SAFETY: the caller's promise for the CPU; 32 values become 16 words.
        unsafe {
            let (low, high) = (_mm512_loadu_ps(x.as_ptr()), _mm512_loadu_ps(x.as_ptr().add(16)));
            let pairs = std::mem::transmute::<__m512bh, __m512>(_mm512_cvtne2ps_pbh(high, low));
            _mm512_storeu_ps(words.as_mut_ptr().cast(), pairs);
        }
    }
    from_f32(rest, last);
    1.0
}

/// Rounded to bf16, but as f32: two words to a step.
#[inline(always)]
pub(in crate::kernels) fn widened(words: &mut [u32], x: &[f32]) -> f32 {
    let (values, padding) = words.split_at_mut(x.len().min(words.len()));
    for (word, x) in values.iter_mut().zip(x) {
        *word = bf16(*x) << 16;
    }
    padding.fill(0);
    1.0
}
