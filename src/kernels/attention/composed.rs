//! Attention composed from candle operations, for devices and types without a kernel of ours.

use super::layout::{AttentionLayout, Block};
use crate::error::Result;

use candle_core::{D, DType, Device, Tensor};
use std::borrow::Borrow;

/// [`attention()`](super::attention) of tensors that fit the layout, `shared` being the extra pair.
pub(super) fn composed(
    q: &Tensor,
    k: &Tensor,
    v: &Tensor,
    shared: Option<(&Tensor, &Tensor)>,
    layout: &AttentionLayout,
) -> Result<Tensor> {
    let (sk, sv) = shared.unwrap_or((k, v));
    let mut blocks: Vec<&Block> = layout.blocks.iter().filter(|b| !b.queries.is_empty()).collect();
    blocks.sort_by_key(|b| b.queries.start);
    in_order(q, layout, blocks, |block| composed_block(q, [k, v], [sk, sv], layout, block))
}

/// What `attend` makes of each block, the blocks being in the order of their rows; rows of no block are zeros.
pub(super) fn in_order<B: Borrow<Block>>(
    q: &Tensor,
    layout: &AttentionLayout,
    blocks: impl IntoIterator<Item = B>,
    attend: impl Fn(&Block) -> Result<Tensor>,
) -> Result<Tensor> {
    let (rows, width) = (q.dim(0)?, layout.heads * layout.head_dim);
    let zeros = |rows: usize| Tensor::zeros((rows, width), q.dtype(), q.device());
    let (mut parts, mut at) = (Vec::new(), 0);
    for block in blocks {
        let block = block.borrow();
        if block.queries.start > at {
            parts.push(zeros(block.queries.start - at)?);
        }
        parts.push(attend(block)?);
        at = block.queries.end;
    }
    if at < rows || parts.is_empty() {
        parts.push(zeros(rows - at)?);
    }
    Ok(Tensor::cat(&parts, 0)?)
}

/// One block: scores against shared keys and own keys side by side, one softmax.
fn composed_block(
    q: &Tensor,
    own: [&Tensor; 2],
    shared: [&Tensor; 2],
    layout: &AttentionLayout,
    block: &Block,
) -> Result<Tensor> {
    let AttentionLayout { heads, kv_heads, head_dim: hd, .. } = *layout;
    let (items, group, qp, kp) = (block.items(), heads / kv_heads, block.q_period, block.k_period);
    let (rows, n_shared) = (block.queries.len(), block.shared.len());
    let scale = 1.0 / (hd as f64).sqrt();
    // [kv_heads, items, group * q_period, head_dim]
    let q = (q.narrow(0, block.queries.start, rows)? * scale)?
        .reshape((items, qp, kv_heads, group, hd))?
        .permute((2, 0, 3, 1, 4))?
        .reshape((kv_heads, items, group * qp, hd))?;
    let heads_first = |t: &Tensor, start: usize, len: usize, items: usize, period: usize| {
        t.narrow(0, start, len)?.reshape((items, period, kv_heads, hd))?.permute((2, 0, 1, 3))?.contiguous()
    };
    let (mut scores, mut values) = (Vec::new(), Vec::new());
    if n_shared > 0 {
        let [k, v] = shared.map(|t| heads_first(t, block.shared.start, n_shared, 1, n_shared));
        let flat = q.reshape((kv_heads, 1, items * group * qp, hd))?;
        let s = flat.matmul(&k?.t()?.contiguous()?)?;
        scores.push(s.reshape((kv_heads, items, group * qp, n_shared))?);
        values.push(v?);
    }
    if kp > 0 {
        let [k, v] = own.map(|t| heads_first(t, block.own_start, items * kp, items, kp));
        let mut s = q.matmul(&k?.t()?.contiguous()?)?;
        if block.causal {
            s = s.broadcast_add(&mask(block, group, q.dtype(), q.device())?)?;
        }
        scores.push(s);
        values.push(v?);
    }
    let scores = Tensor::cat(&scores, 3)?.to_dtype(DType::F32)?;
    let p = candle_nn::ops::softmax(&scores, D::Minus1)?.to_dtype(q.dtype())?;
    let mut out = Vec::new();
    if n_shared > 0 {
        let p =
            p.narrow(3, 0, n_shared)?.contiguous()?.reshape((kv_heads, 1, items * group * qp, n_shared))?;
        out.push(p.matmul(&values[0])?.reshape((kv_heads, items, group * qp, hd))?);
    }
    if kp > 0 {
        out.push(p.narrow(3, n_shared, kp)?.contiguous()?.matmul(&values[values.len() - 1])?);
    }
    let out = match &out[..] {
        [a, b] => (a + b)?,
        _ => out.swap_remove(0),
    };
    Ok(out
        .reshape((kv_heads, items, group, qp, hd))?
        .permute((1, 3, 0, 2, 4))?
        .reshape((rows, heads * hd))?)
}

/// 0 where a row sees a key of its item, minus infinity where not: `[group * q_period, k_period]`.
fn mask(block: &Block, group: usize, dtype: DType, device: &Device) -> Result<Tensor> {
    let (qp, kp) = (block.q_period, block.k_period);
    let values: Vec<f32> = (0..group * qp * kp)
        .map(|at| if at % kp < block.seen(at / kp % qp) { 0.0 } else { f32::NEG_INFINITY })
        .collect();
    Ok(Tensor::from_vec(values, (group * qp, kp), device)?.to_dtype(dtype)?)
}
