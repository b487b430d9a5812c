//! The attention that layers call, and which of its forms computes it.

use super::batched::batched;
use super::bf16::{AttentionKernel, bf16_attention};
use super::composed::composed;
use super::f32::F32Attention;
use super::layout::{AttentionLayout, Precision};
use super::shared_keys::SharedKeys;
use crate::error::Result;
use crate::kernels::exec::{dims2, expect_dims, on_cpu};
use candle_core::{DType, Tensor};

/// `softmax(q k^T / sqrt(head_dim)) v` where each row sees what `layout` says.
///
/// `q` is `[nq, heads * head_dim]`, `k` and `v` `[nk, kv_heads * head_dim]`; gives `[nq, heads *
/// head_dim]`. With `shared` (like `k` and `v`, of any number of rows) the blocks' shared
/// keys are its rows, otherwise rows of `k` and `v`. One softmax runs over shared and own keys
/// together, so many short suffixes against one prefix cost one matrix product with the prefix, as
/// in Hydragen (arXiv 2402.05099), and the result is exact. Differentiable in every tensor; the
/// backward pass computes the probabilities again from the rows' log-sum-exp.
///
/// Rows out of range, overlapping query rows, a row that would see no key, and shapes that do not
/// fit are [`Error::Argument`](crate::error::Error::Argument).
pub fn attention(
    q: &Tensor,
    k: &Tensor,
    v: &Tensor,
    shared: Option<&SharedKeys>,
    layout: &AttentionLayout,
) -> Result<Tensor> {
    let (nq, _) = dims2("q", q)?;
    let (nk, _) = dims2("k", k)?;
    let width = layout.kv_heads * layout.head_dim;
    expect_dims("q", q, &[nq, layout.heads * layout.head_dim])?;
    expect_dims("k", k, &[nk, width])?;
    expect_dims("v", v, &[nk, width])?;
    let mut shared_rows = nk;
    let pair = shared.map(|shared| (shared.keys(), shared.values()));
    if let Some((sk, sv)) = pair {
        shared_rows = dims2("shared keys", sk)?.0;
        expect_dims("shared keys", sk, &[shared_rows, width])?;
        expect_dims("shared values", sv, &[shared_rows, width])?;
    }
    layout.check(nq, nk, shared_rows)?;
    if let Some((sk, sv)) = pair
        && (sk.track_op() || sv.track_op())
    {
        // Someone wants the extra pair's gradient: make it part of k and v.
        let (k, v) = (Tensor::cat(&[sk, k], 0)?, Tensor::cat(&[sv, v], 0)?);
        return attention(q, &k, &v, None, &layout.moved(shared_rows));
    }
    if !on_cpu(&[q, k, v]) || pair.is_some_and(|(sk, sv)| !on_cpu(&[sk, sv])) {
        let plain = |t: &&Tensor| !t.track_op() && t.dtype() == DType::F32;
        let all: Vec<&Tensor> =
            [q, k, v].into_iter().chain(pair.into_iter().flat_map(|(k, v)| [k, v])).collect();
        if all.iter().all(plain) {
            return batched(q, k, v, pair, layout);
        }
        return composed(q, k, v, pair, layout);
    }
    if layout.precision == Precision::Bf16
        && let Some(kernel) = AttentionKernel::current()
        && ![q, k, v].iter().any(|t| t.track_op())
    {
        return bf16_attention(&kernel, [q, k, v], shared, layout);
    }
    let shared = match pair {
        Some((sk, sv)) => Some((sk.contiguous()?, sv.contiguous()?)),
        None => None,
    };
    let op = F32Attention::new(layout.clone(), shared);
    Ok(q.contiguous()?.apply_op3(&k.contiguous()?, &v.contiguous()?, op)?)
}
