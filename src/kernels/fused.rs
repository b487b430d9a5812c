//! What lies between products of bf16 off the CPU: by kernels of ours on CUDA, where a tensor is read once and written once, else composed.

use super::ops::rms_norm;
use super::rounded::{self, Heads, OwnKeys};
use crate::error::{Error, Result};
use crate::kernels::exec::{dims2, expect_dims, same_shape};
use candle_core::{DType, Device, Tensor};

/// Ends the function with what our kernel makes of tensors, `$tensors` with the types that it takes, where it is there and takes them.
macro_rules! ours {
    ($tensors:expr, |$kernels:ident| $launch:expr) => {
        #[cfg(feature = "cuda")]
        if let Some($kernels) = super::cuda::kernels(place($tensors)) {
            if super::cuda::fits(&$kernels, $tensors) {
                return Ok($launch?);
            }
        }
    };
}

/// Where the first of some tensors lies.
#[cfg(feature = "cuda")]
fn place<'a>(tensors: &[(&'a Tensor, DType)]) -> &'a Device {
    tensors.first().map_or(&Device::Cpu, |(t, _)| t.device())
}

/// With those that are there, as f32.
fn with<'a>(first: &[(&'a Tensor, DType)], others: &[Option<&'a Tensor>]) -> Vec<(&'a Tensor, DType)> {
    first.iter().copied().chain(others.iter().flatten().map(|&t| (t, DType::F32))).collect()
}

/// Whether attention's products may be of bf16 on a device: where those of ours give f32.
pub(super) fn rounds_attention(device: &Device) -> bool {
    match device {
        #[cfg(feature = "cuda")]
        Device::Cuda(_) => super::cuda::kernels(device).is_some(),
        _ => false,
    }
}

/// What follows a product of a rounded type: `residual + (y + bias)` as f32.
///
/// `y` is `[n, m]`, contiguous or columns of a wider tensor that is; `bias` `[m]` and `residual` `[n, m]` are f32.
///
/// # Errors
/// [`Error::Tensors`](crate::Error::Tensors) on other shapes.
pub fn widen(y: &Tensor, bias: Option<&Tensor>, residual: Option<&Tensor>) -> Result<Tensor> {
    let known = with(&[], &[bias, residual]);
    let (n, m) = y.dims2()?;
    let fit = bias.is_none_or(|b| b.dims() == [m]) && residual.is_none_or(|r| r.dims() == [n, m]);
    #[cfg(feature = "cuda")]
    if let Some(kernels) = super::cuda::kernels(y.device()) {
        let row = y.narrow(0, 0, n.min(1))?;
        let rows = y.stride()[1] == 1 && super::cuda::fits(&kernels, &[(&row, DType::BF16)]);
        if fit && rows && super::cuda::fits(&kernels, &known) {
            return Ok(super::cuda::widen(&kernels, y, bias, residual)?);
        }
    }
    if !fit {
        let found = format!("{:?}", known.iter().map(|(t, _)| t.dims()).collect::<Vec<_>>());
        return Err(Error::argument("bias and residual", found, format!("those of {n} rows of {m}")));
    }
    rounded::widen(y, bias, residual)
}

/// `silu(gate + gate_bias) * (up + up_bias)`, `[n, m]`, in the rounded type of `gate` and `up`; biases are f32, `[m]`.
///
/// # Errors
/// [`Error::Tensors`](crate::Error::Tensors) on other shapes.
pub fn swiglu_rounded([gate, up]: [&Tensor; 2], biases: [Option<&Tensor>; 2]) -> Result<Tensor> {
    same_shape("up", gate, up)?;
    for bias in biases.into_iter().flatten() {
        expect_dims("bias", bias, &gate.dims()[1..])?;
    }
    let all = with(&[(gate, DType::BF16), (up, DType::BF16)], &biases);
    ours!(&all, |kernels| super::cuda::swiglu(&kernels, [gate, up], biases));
    drop(all);
    rounded::swiglu([gate, up], biases)
}

/// [`rms_norm`] in a rounded type, for a product of that type.
///
/// # Errors
/// As [`rms_norm`].
pub fn rms_norm_rounded(x: &Tensor, weight: &Tensor, eps: f64, dtype: DType) -> Result<Tensor> {
    let (_, d) = dims2("x", x)?;
    expect_dims("weight", weight, &[d])?;
    if dtype == DType::BF16 {
        ours!(&[(x, DType::F32), (weight, DType::F32)], |kernels| super::cuda::rms_norm(
            &kernels, x, weight, eps
        ));
    }
    Ok(rms_norm(x, weight, eps)?.to_dtype(dtype)?)
}

/// [`rounded::heads_first`].
pub(super) fn heads_first(x: &Tensor, heads: Heads, scale: f64, padded: usize) -> Result<Tensor> {
    expect_dims("rows", x, &[heads.items * heads.period, heads.width()])?;
    ours!(&[(x, DType::F32)], |kernels| super::cuda::heads_first(&kernels, x, heads, scale, padded));
    rounded::heads_first(x, heads, scale, padded)
}

/// [`rounded::heads_last`].
pub(super) fn heads_last(
    x: &Tensor,
    own: Option<(&Tensor, &Tensor, OwnKeys)>,
    heads: Heads,
) -> Result<Tensor> {
    let mut all = vec![(x, DType::F32)];
    if let Some((p, v, keys)) = own {
        expect_dims("own values", v, &[heads.items * keys.own, heads.key_heads * heads.head_dim])?;
        all.extend([(p, DType::BF16), (v, DType::F32)]);
    }
    ours!(&all, |kernels| super::cuda::heads_last(&kernels, x, own, heads));
    drop(all);
    rounded::heads_last(x, own, heads)
}

/// [`rounded::probabilities`].
pub(super) fn probabilities(scores: &Tensor, columns: usize, period: usize, causal: bool) -> Result<Tensor> {
    ours!(&[(scores, DType::F32)], |kernels| super::cuda::probabilities(
        &kernels, scores, columns, period, causal
    ));
    rounded::probabilities(scores, columns, period, causal)
}

/// [`rounded::shared_probabilities`].
pub(super) fn shared_probabilities(
    scores: &Tensor,
    [q, k]: [&Tensor; 2],
    keys: OwnKeys,
    heads: Heads,
) -> Result<Tensor> {
    expect_dims("own keys", k, &[heads.items * keys.own, heads.key_heads * heads.head_dim])?;
    ours!(&[(scores, DType::F32), (q, DType::BF16), (k, DType::F32)], |kernels| {
        super::cuda::shared_probabilities(&kernels, scores, [q, k], keys, heads)
    });
    rounded::shared_probabilities(scores, [q, k], keys, heads)
}

/// [`rounded::product`].
pub(super) fn product(a: &Tensor, b: &Tensor, transposed: bool) -> Result<Tensor> {
    ours!(&[(a, DType::BF16), (b, DType::BF16)], |kernels| super::cuda::product(&kernels, a, b, transposed));
    rounded::product(a, b, transposed)
}
