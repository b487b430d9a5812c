//! Softmax attention of a few query rows over packed keys, in bf16 with sums in f32.

// Only x86-64 has a kernel.
#![cfg_attr(not(target_arch = "x86_64"), allow(dead_code))]

#[cfg(target_arch = "x86_64")]
use super::x86_64;
use crate::kernels::gemm::packed::panel::{Panels, WIDTH, Words};
use crate::kernels::gemm::packed::words::{pair_neighbours, pair_rows};
use crate::kernels::isa::level::Level;

/// Key sets that one row sees, at most: shared ones and its item's own.
pub(in crate::kernels) const PARTS: usize = 2;
/// Scores of own keys that are given with each row, at most.
pub(in crate::kernels) const GIVEN: usize = 16;
/// Words of a panel of keys in a row of probabilities.
#[cfg(target_arch = "x86_64")]
pub(super) const PANEL_WORDS: usize = WIDTH / 2;

/// Keys and values of one head, for queries that see all of them or the first so many.
#[derive(Debug)]
pub(in crate::kernels) struct PackedKeys {
    /// Keys as output channels: scores are a product with them.
    pub(super) keys: Panels,
    /// Values, `[panel of channels][pair of keys][channel]`, keys that do not exist being zeros.
    pub(super) values: Words,
    /// Pairs of keys of a panel.
    pub(super) steps: usize,
}

impl PackedKeys {
    /// Packs `n` rows of `head_dim` that start every `stride` elements.
    pub(in crate::kernels) fn new(
        level: Level,
        k: &[f32],
        v: &[f32],
        stride: usize,
        n: usize,
        head_dim: usize,
    ) -> Self {
        let (keys, _) = Panels::build(n, head_dim, 2, |row, words| {
            pair_neighbours(level, &k[row * stride..row * stride + head_dim], words);
        });
        let steps = n.div_ceil(WIDTH) * WIDTH / 2;
        let mut values = Words::zeros(head_dim.div_ceil(WIDTH) * WIDTH * steps);
        let zeros = [0f32; WIDTH];
        for (p, panel) in values.get_mut().chunks_exact_mut((steps * WIDTH).max(1)).enumerate() {
            let columns = p * WIDTH..head_dim.min((p + 1) * WIDTH);
            let row = |key: usize| match key < n {
                true => &v[key * stride + columns.start..key * stride + columns.end],
                false => &zeros[..columns.len()],
            };
            for (pair, words) in panel.chunks_exact_mut(WIDTH).take(n.div_ceil(2)).enumerate() {
                pair_rows(level, row(2 * pair), row(2 * pair + 1), words);
            }
        }
        PackedKeys { keys, values, steps }
    }
}

/// Keys that some rows see.
#[derive(Clone, Copy)]
pub(in crate::kernels) struct Part<'a> {
    pub(in crate::kernels) keys: &'a PackedKeys,
    /// How many of them each row sees.
    pub(in crate::kernels) seen: &'a [usize],
}

/// Query rows that are worked on together.
pub(in crate::kernels) struct Rows<'a> {
    pub(in crate::kernels) head_dim: usize,
    /// `[rows, head_dim]`, times log2(e) / sqrt(head_dim): the scores are exponents of 2.
    pub(in crate::kernels) q: &'a [f32],
    /// At most [`PARTS`].
    pub(in crate::kernels) parts: &'a [Part<'a>],
    /// Scores of further keys, `[rows, GIVEN]`, minus infinity where there is none, or empty. They become the weights of
    /// these keys' values, which the caller adds.
    pub(in crate::kernels) given: &'a mut [f32],
    /// `[rows, head_dim]`: receives the weighted sums of the parts' values.
    pub(in crate::kernels) sums: &'a mut [f32],
    /// Receives each row's sum of weights.
    pub(in crate::kernels) totals: &'a mut [f32],
}

/// Buffers, kept between calls.
#[derive(Default)]
pub(in crate::kernels) struct Space {
    pub(super) words: Vec<u32>,
}

/// A way to attend that this machine has: values come only from this module's checks.
#[derive(Clone, Copy)]
pub(in crate::kernels) struct Attend {
    /// Most rows of a call.
    pub(in crate::kernels) rows: usize,
    pub(super) run: unsafe fn(Rows<'_>, &mut Space),
}

impl Attend {
    /// The fastest at the level in use; `None` where bf16 is no faster than f32.
    pub(in crate::kernels) fn current() -> Option<Attend> {
        #[cfg(target_arch = "x86_64")]
        {
            let level = Level::current();
            if level.is_avx512() && is_x86_feature_detected!("avx512bf16") {
                return Some(if level.is_amx() { x86_64::AMX } else { x86_64::DOT });
            }
        }
        None
    }

    /// Every one that this machine can be tested with.
    #[cfg(test)]
    pub(in crate::kernels) fn every() -> Vec<Attend> {
        #[cfg(target_arch = "x86_64")]
        if let Some(current) = Attend::current() {
            return vec![current, x86_64::DOT, x86_64::EMULATED];
        }
        Vec::new()
    }

    /// Attends: each row's result depends on that row, its keys and their number only.
    pub(in crate::kernels) fn run(self, rows: Rows<'_>, space: &mut Space) {
        // SAFETY: an `Attend` exists only where the CPU has its instructions.
        unsafe { (self.run)(rows, space) }
    }
}
