//! Attention of one block by products of bf16, off the CPU. Scores, their softmax and all sums are f32.

use super::layout::{AttentionLayout, Block};
use crate::error::Result;
use crate::kernels::fused;
use crate::kernels::rounded::{Heads, OwnKeys};
use candle_core::Tensor;

/// Rows of keys and columns of scores are multiples of so many, as products of bf16 are fastest with.
const STEP: usize = 8;

/// Whether [`rounded_piece`] takes a block: long own keys beside shared ones it does not.
pub(super) fn takes(block: &Block) -> bool {
    block.shared.is_empty() || block.k_period <= OwnKeys::MOST
}

/// What the rows of a block that [`takes`] is true of see: `[rows, heads * head_dim]`, f32. Own keys beside shared ones are not rounded.
pub(super) fn rounded_piece(
    q: &Tensor,
    own: [&Tensor; 2],
    shared: [&Tensor; 2],
    layout: &AttentionLayout,
    block: &Block,
) -> Result<Tensor> {
    let AttentionLayout { heads, kv_heads: key_heads, head_dim, .. } = *layout;
    let (items, group, period, count) = (block.items(), heads / key_heads, block.q_period, block.k_period);
    let heads = Heads { items, key_heads, group, period, head_dim };
    let scale = 1.0 / (head_dim as f64).sqrt();
    let q =
        fused::heads_first(&q.narrow(0, block.queries.start, heads.items * period)?, heads, scale, period)?;
    let keys = |t: &Tensor, first: usize, items: usize, period: usize, padded: usize| -> Result<Tensor> {
        let rows = t.narrow(0, first, items * period)?;
        let keys = Heads { items, group: 1, period, ..heads };
        Ok(fused::heads_first(&rows, keys, 1.0, padded)?.reshape((key_heads * items, padded, head_dim))?)
    };
    if block.shared.is_empty() {
        let padded = count.next_multiple_of(STEP);
        let [k, v] = own.map(|t| keys(t, block.own_start, items, count, padded));
        let (batch, rows) = (key_heads * items, group * period);
        let scores = fused::product(&q.reshape((batch, rows, head_dim))?, &k?, true)?;
        let p = fused::probabilities(&scores.reshape((batch * rows, padded))?, count, period, block.causal)?;
        let out = fused::product(&p.reshape((batch, rows, padded))?, &v?, false)?;
        return fused::heads_last(&out, None, heads);
    }
    let known = block.shared.len();
    let padded = (known + count).next_multiple_of(STEP);
    let [k, v] = shared.map(|t| keys(t, block.shared.start, 1, known, padded));
    let (all, rows) = (items * group * period, heads.rows());
    let scores =
        fused::product(&q.reshape((key_heads, all, head_dim))?, &k?, true)?.reshape((rows, padded))?;
    let [own_k, own_v] = own.map(|t| t.narrow(0, block.own_start, items * count));
    let own_keys = OwnKeys { shared: known, own: count, causal: block.causal };
    let p = match count {
        0 => fused::probabilities(&scores, known, 1, false)?,
        _ => fused::shared_probabilities(&scores, [&q, &own_k?], own_keys, heads)?,
    };
    let out = fused::product(&p.reshape((key_heads, all, padded))?, &v?, false)?;
    let own_v = own_v?;
    fused::heads_last(&out, (count > 0).then_some((&p, &own_v, own_keys)), heads)
}
