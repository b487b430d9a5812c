//! What lies between products of bf16 off the CPU, composed from candle operations: the forms that our kernels for CUDA are compared with,
//! and that stand in for them.

use crate::error::Result;
use candle_core::{D, DType, Device, Tensor};

/// How rows of attention lie: `[key_heads, items, group, period, head_dim]`, a query head being one of the `group` of a key head.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Heads {
    pub(super) items: usize,
    pub(super) key_heads: usize,
    pub(super) group: usize,
    /// Rows of an item.
    pub(super) period: usize,
    pub(super) head_dim: usize,
}

impl Heads {
    /// Rows of all heads.
    pub(super) fn rows(&self) -> usize {
        self.key_heads * self.items * self.group * self.period
    }

    /// Width of a row of all heads.
    pub(super) fn width(&self) -> usize {
        self.key_heads * self.group * self.head_dim
    }
}

/// Keys of its own item that a row sees beside those that all rows see.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct OwnKeys {
    /// Keys that all rows see.
    pub(super) shared: usize,
    /// Keys of an item, at most [`OwnKeys::MOST`].
    pub(super) own: usize,
    /// Whether a row sees only the own keys up to its own place.
    pub(super) causal: bool,
}

impl OwnKeys {
    /// As many as a warp has lanes.
    pub(super) const MOST: usize = 32;
}

/// `residual + (y + bias)` as f32; `y` is `[n, m]`, `bias` `[m]` and `residual` `[n, m]`, both f32.
pub(super) fn widen(y: &Tensor, bias: Option<&Tensor>, residual: Option<&Tensor>) -> Result<Tensor> {
    let mut y = y.contiguous()?.to_dtype(DType::F32)?;
    if let Some(bias) = bias {
        y = y.broadcast_add(bias)?;
    }
    Ok(match residual {
        Some(residual) => (residual + y)?,
        None => y,
    })
}

/// `silu(gate + gate_bias) * (up + up_bias)` in the type of `gate` and `up`, `[n, m]`; biases are f32, `[m]`.
pub(super) fn swiglu([gate, up]: [&Tensor; 2], biases: [Option<&Tensor>; 2]) -> Result<Tensor> {
    let with = |y: &Tensor, bias: Option<&Tensor>| match bias {
        Some(bias) => y.broadcast_add(&bias.to_dtype(y.dtype())?),
        None => Ok(y.clone()),
    };
    Ok((with(gate, biases[0])?.silu()? * with(up, biases[1])?)?)
}

/// `x` times `scale`, `[items * period, width]`, f32, as rows of attention in bf16, of which each item has `padded`; the further ones are 0.
pub(super) fn heads_first(x: &Tensor, heads: Heads, scale: f64, padded: usize) -> Result<Tensor> {
    let Heads { items, key_heads, group, period, head_dim } = heads;
    let x = (x * scale)?.to_dtype(DType::BF16)?.reshape((items, period, key_heads, group, head_dim))?;
    Ok(x.permute((2, 0, 3, 1, 4))?.contiguous()?.pad_with_zeros(3, 0, padded - period)?.contiguous()?)
}

/// Rows of attention, `[rows, head_dim]`, f32, as `[items * period, width]`. With own keys, what their values `v`, `[items * own, key_heads *
/// head_dim]`, add by the probabilities that `p` has for them.
pub(super) fn heads_last(
    x: &Tensor,
    own: Option<(&Tensor, &Tensor, OwnKeys)>,
    heads: Heads,
) -> Result<Tensor> {
    let Heads { items, key_heads, group, period, head_dim } = heads;
    let mut x = x.reshape((key_heads, items, group * period, head_dim))?;
    if let Some((p, v, keys)) = own {
        let p = p.reshape((key_heads, items, group * period, ()))?.narrow(3, keys.shared, keys.own)?;
        let v = v.reshape((items, keys.own, key_heads, head_dim))?.permute((2, 0, 1, 3))?.contiguous()?;
        x = (x + p.to_dtype(DType::F32)?.contiguous()?.matmul(&v)?)?;
    }
    let x = x.reshape((key_heads, items, group, period, head_dim))?.permute((1, 3, 0, 2, 4))?.contiguous()?;
    Ok(x.reshape((items * period, heads.width()))?)
}

/// Softmax of the first `columns` scores of each row of `[rows, stride]`, f32, as bf16; 0 in the others. If `causal`, row `i` of a period sees
/// `period - 1 - i` fewer.
pub(super) fn probabilities(scores: &Tensor, columns: usize, period: usize, causal: bool) -> Result<Tensor> {
    let (rows, stride) = scores.dims2()?;
    let mut scores = scores.narrow(1, 0, columns)?.contiguous()?;
    if causal {
        let mask = seen(period, columns, scores.device())?;
        scores = scores.reshape((rows / period, period, columns))?.broadcast_add(&mask)?;
    }
    let p = candle_nn::ops::softmax_last_dim(&scores)?.reshape((rows, columns))?;
    Ok(p.to_dtype(DType::BF16)?.pad_with_zeros(1, 0, stride - columns)?.contiguous()?)
}

/// [`probabilities`] of the first `keys.shared` scores and of the own keys together, which follow them in the result: those of queries `q`,
/// rows of attention in bf16, and keys `k`, `[items * own, key_heads * head_dim]`, f32.
pub(super) fn shared_probabilities(
    scores: &Tensor,
    [q, k]: [&Tensor; 2],
    keys: OwnKeys,
    heads: Heads,
) -> Result<Tensor> {
    let (Heads { items, key_heads, group, period, head_dim }, OwnKeys { shared, own, causal }) =
        (heads, keys);
    let k = k.reshape((items, own, key_heads, head_dim))?.permute((2, 0, 1, 3))?.contiguous()?;
    let q = q.to_dtype(DType::F32)?.reshape((key_heads, items, group * period, head_dim))?;
    let own_scores = q.matmul(&k.transpose(2, 3)?.contiguous()?)?;
    let mut own_scores = own_scores.reshape((key_heads * items * group, period, own))?;
    if causal {
        own_scores = own_scores.broadcast_add(&seen(period, own, q.device())?)?;
    }
    let (rows, stride) = scores.dims2()?;
    let scores = Tensor::cat(&[&scores.narrow(1, 0, shared)?, &own_scores.reshape((rows, own))?], 1)?;
    let p = candle_nn::ops::softmax_last_dim(&scores)?.to_dtype(DType::BF16)?;
    Ok(p.pad_with_zeros(1, 0, stride - shared - own)?.contiguous()?)
}

/// `a b`, or `a b^T` if `transposed`, in f32: `[n, m, k]` with `[n, k, o]` or `[n, o, k]`, both of one type.
pub(super) fn product(a: &Tensor, b: &Tensor, transposed: bool) -> Result<Tensor> {
    let [a, b] = [a.to_dtype(DType::F32)?, b.to_dtype(DType::F32)?];
    let b = if transposed { b.transpose(D::Minus1, D::Minus2)? } else { b };
    Ok(a.contiguous()?.matmul(&b.contiguous()?)?)
}

/// 0 where a row of a period sees one of `columns` keys, of which the last row sees all; minus infinity where not.
fn seen(period: usize, columns: usize, device: &Device) -> Result<Tensor> {
    let unseen = |at: usize| at % columns + period > columns + at / columns;
    let mask: Vec<f32> =
        (0..period * columns).map(|at| if unseen(at) { f32::NEG_INFINITY } else { 0.0 }).collect();
    Ok(Tensor::from_vec(mask, (period, columns), device)?)
}
