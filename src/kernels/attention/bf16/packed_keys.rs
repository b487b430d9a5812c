//! Keys and values of one head, packed for products in bf16.

use crate::kernels::gemm::packed::{AlignedWords, PANEL_WIDTH, WordPanels, pair_neighbours, pair_rows};
use crate::kernels::isa::Level;

/// Keys and values of one head, for queries that see all of them or the first so many.
#[derive(Debug)]
pub(in crate::kernels::attention) struct PackedKeys {
    /// Keys as output channels: scores are a product with them.
    pub(super) keys: WordPanels,
    /// Values, `[panel of channels][pair of keys][channel]`, keys that do not exist being zeros.
    pub(super) values: AlignedWords,
    /// Pairs of keys of a panel.
    pub(super) steps: usize,
}

impl PackedKeys {
    /// Packs `n` rows of `head_dim` that start every `stride` elements.
    pub(super) fn new(level: Level, k: &[f32], v: &[f32], stride: usize, n: usize, head_dim: usize) -> Self {
        let (keys, _) = WordPanels::build(n, head_dim, 2, |row, words| {
            pair_neighbours(level, &k[row * stride..row * stride + head_dim], words);
        });
        let steps = n.div_ceil(PANEL_WIDTH) * PANEL_WIDTH / 2;
        let mut values = AlignedWords::zeros(head_dim.div_ceil(PANEL_WIDTH) * PANEL_WIDTH * steps);
        let zeros = [0f32; PANEL_WIDTH];
        for (p, panel) in values.get_mut().chunks_exact_mut((steps * PANEL_WIDTH).max(1)).enumerate() {
            let columns = p * PANEL_WIDTH..head_dim.min((p + 1) * PANEL_WIDTH);
            let row = |key: usize| match key < n {
                true => &v[key * stride + columns.start..key * stride + columns.end],
                false => &zeros[..columns.len()],
            };
            for (pair, words) in panel.chunks_exact_mut(PANEL_WIDTH).take(n.div_ceil(2)).enumerate() {
                pair_rows(level, row(2 * pair), row(2 * pair + 1), words);
            }
        }
        PackedKeys { keys, values, steps }
    }
}
