//! What each row of an attention sees.

use crate::error::{Error, Result};
use crate::kernels::gemm::packed::WeightFormat;
use std::ops::Range;

/// Query rows that all see the same shared keys, each beside keys of its own item.
///
/// Row `r` (counted from `queries.start`) belongs to item `j = r / q_period` and is its row
/// `i = r % q_period`. It sees all key rows of `shared`, and of the item's own key rows
/// `own_start + j * k_period + c`, `c < k_period`, all, or if `causal` those with
/// `c <= k_period - q_period + i`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Block {
    /// Query rows of the block; their number is a multiple of `q_period`. Blocks do not overlap.
    pub queries: Range<usize>,
    /// Key rows that every query of the block sees; may be empty. Rows of the extra pair if the call
    /// has one.
    pub shared: Range<usize>,
    /// First own key row of the block's first item.
    pub own_start: usize,
    /// Query rows of an item, at least 1.
    pub q_period: usize,
    /// Own key rows of an item; at least `q_period` if `causal`; may be 0 if not.
    pub k_period: usize,
    /// Whether a row sees only the own keys up to its own place.
    pub causal: bool,
}

impl Block {
    /// Items of the block.
    pub(super) fn items(&self) -> usize {
        self.queries.len() / self.q_period
    }

    /// Own keys that row `i` of an item sees.
    pub(super) fn seen(&self, i: usize) -> usize {
        if self.causal { self.k_period - self.q_period + i + 1 } else { self.k_period }
    }
}

/// The heads, and which rows see which.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AttentionLayout {
    /// Query heads.
    pub heads: usize,
    /// Key and value heads, a divisor of `heads`: query head `i` reads head `i / (heads / kv_heads)`.
    pub kv_heads: usize,
    /// Width of a head.
    pub head_dim: usize,
    /// The blocks. Query rows of no block give zeros.
    pub blocks: Vec<Block>,
    /// What queries, keys, values and weights may be rounded to.
    pub precision: Precision,
}

/// What the operands of attention's products may be rounded to. Sums and the softmax are f32 always.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Default)]
pub enum Precision {
    /// Nothing is rounded.
    #[default]
    F32,
    /// To bf16, where the machine multiplies these faster and no gradient is wanted; few own keys
    /// (up to 16) are not rounded. As [`crate::kernels::PackedWeight::linear`] does with activations.
    Bf16,
}

impl From<WeightFormat> for Precision {
    /// What goes with weights of a format.
    fn from(format: WeightFormat) -> Self {
        match format {
            WeightFormat::F32 => Precision::F32,
            WeightFormat::Bf16 | WeightFormat::Int8 => Precision::Bf16,
        }
    }
}

impl AttentionLayout {
    /// The layout after `rows` rows were put before the own keys.
    pub(super) fn moved(&self, rows: usize) -> AttentionLayout {
        let mut layout = self.clone();
        for block in &mut layout.blocks {
            block.own_start += rows;
        }
        layout
    }

    /// Checks that the layout fits so many rows of queries, own keys and shared keys.
    pub(super) fn check(&self, nq: usize, nk: usize, shared_rows: usize) -> Result<()> {
        let wrong = |found: String, expected: &str| Err(Error::argument("layout", found, expected));
        let AttentionLayout { heads, kv_heads, head_dim, blocks, .. } = self;
        if *kv_heads == 0 || *head_dim == 0 || *heads == 0 || heads % kv_heads != 0 {
            let found = format!("{heads} heads of {head_dim}, {kv_heads} key heads");
            return wrong(found, "heads a multiple of key heads, all at least 1");
        }
        for block in blocks {
            let found = || format!("{block:?}");
            let rows = block.queries.end.saturating_sub(block.queries.start);
            if block.q_period == 0 || rows % block.q_period != 0 {
                return wrong(found(), "query rows a multiple of q_period, which is at least 1");
            }
            if block.causal && block.k_period < block.q_period {
                return wrong(found(), "k_period of at least q_period in a causal block");
            }
            if block.k_period == 0 && block.shared.is_empty() && rows > 0 {
                return wrong(found(), "at least one key for every row");
            }
            let own_end = (rows / block.q_period)
                .checked_mul(block.k_period)
                .and_then(|own| own.checked_add(block.own_start));
            if block.queries.end > nq
                || (!block.shared.is_empty() && block.shared.end > shared_rows)
                || own_end.is_none_or(|end| end > nk)
            {
                let expected = format!("rows within {nq} queries, {nk} keys and {shared_rows} shared keys");
                return wrong(found(), &expected);
            }
        }
        let mut ranges: Vec<_> =
            blocks.iter().filter(|b| !b.queries.is_empty()).map(|b| b.queries.clone()).collect();
        ranges.sort_by_key(|r| r.start);
        if let Some(pair) = ranges.windows(2).find(|p| p[1].start < p[0].end) {
            return wrong(format!("query rows {:?} and {:?}", pair[0], pair[1]), "no overlap");
        }
        Ok(())
    }
}
