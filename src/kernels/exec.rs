//! How the operations reach their data and share work among threads.

use crate::error::{Error, Result};
use candle_core::{CpuStorage, DType, Device, Layout, Shape, Storage, Tensor};
use rayon::prelude::*;

/// True where our own kernels apply: every tensor on the CPU and f32.
pub(super) fn on_cpu(tensors: &[&Tensor]) -> bool {
    tensors.iter().all(|t| t.device().is_cpu() && t.dtype() == DType::F32)
}

/// True where an operation of candle's without a gradient may stand in: no gradient is wanted, one type, elements in each.
pub(super) fn one_kernel(tensors: &[&Tensor]) -> bool {
    let Some(first) = tensors.first() else { return false };
    tensors.iter().all(|t| !t.track_op() && t.dtype() == first.dtype() && t.elem_count() > 0)
}

/// The elements of a contiguous f32 CPU storage.
pub(super) fn slice<'a>(storage: &'a CpuStorage, layout: &Layout) -> candle_core::Result<&'a [f32]> {
    #[cfg(test)]
    super::threads::witness::called();
    let all = storage.as_slice::<f32>()?;
    match layout.contiguous_offsets() {
        Some((start, end)) => Ok(&all[start..end]),
        None => Err(candle_core::Error::RequiresContiguous { op: "sdim kernel" }.bt()),
    }
}

/// Runs `f` on the elements of a f32 CPU tensor, copied first only if not contiguous.
pub(crate) fn read<R>(
    tensor: &Tensor,
    f: impl FnOnce(&[f32]) -> candle_core::Result<R>,
) -> candle_core::Result<R> {
    let tensor = tensor.contiguous()?;
    let (storage, layout) = tensor.storage_and_layout();
    match &*storage {
        Storage::Cpu(cpu) => f(slice(cpu, layout)?),
        _ => Err(candle_core::Error::Msg("sdim kernel: tensor is not on the CPU".into()).bt()),
    }
}

/// [`read`] of two tensors.
pub(super) fn read2<R>(
    a: &Tensor,
    b: &Tensor,
    f: impl FnOnce(&[f32], &[f32]) -> candle_core::Result<R>,
) -> candle_core::Result<R> {
    read(a, |a| read(b, |b| f(a, b)))
}

/// [`read`] of three tensors.
pub(super) fn read3<R>(
    a: &Tensor,
    b: &Tensor,
    c: &Tensor,
    f: impl FnOnce(&[f32], &[f32], &[f32]) -> candle_core::Result<R>,
) -> candle_core::Result<R> {
    read(a, |a| read2(b, c, |b, c| f(a, b, c)))
}

/// A result of `cpu_fwd`.
pub(super) fn output(data: Vec<f32>, shape: impl Into<Shape>) -> (CpuStorage, Shape) {
    (CpuStorage::F32(data), shape.into())
}

/// A CPU tensor.
pub(super) fn tensor(data: Vec<f32>, shape: impl Into<Shape>) -> candle_core::Result<Tensor> {
    Tensor::from_vec(data, shape.into(), &Device::Cpu)
}

/// Rows in a chunk of work, so that a chunk holds about `elements` elements. Depends on the shape
/// only, never on the number of threads.
pub(super) fn chunk_rows(width: usize, elements: usize) -> usize {
    (elements / width.max(1)).max(1)
}

/// Sums partial results in order.
pub(super) fn sum_in_order(partials: Vec<Vec<f32>>, len: usize) -> Vec<f32> {
    let mut total = vec![0f32; len];
    for partial in partials {
        for (t, p) in total.iter_mut().zip(partial) {
            *t += p;
        }
    }
    total
}

/// Runs `f(chunk index)` for each chunk in parallel and collects the results in order.
pub(super) fn map_chunks<R: Send>(chunks: usize, f: impl Fn(usize) -> R + Sync + Send) -> Vec<R> {
    (0..chunks).into_par_iter().map(f).collect()
}

/// Checks that `tensor` has exactly these dimensions.
pub(super) fn expect_dims(name: &'static str, tensor: &Tensor, dims: &[usize]) -> Result<()> {
    if tensor.dims() == dims {
        return Ok(());
    }
    Err(Error::argument(name, format!("shape {:?}", tensor.dims()), format!("shape {dims:?}")))
}

/// The dimensions of a tensor that must have two.
pub(super) fn dims2(name: &'static str, tensor: &Tensor) -> Result<(usize, usize)> {
    match tensor.dims() {
        &[n, d] => Ok((n, d)),
        dims => Err(Error::argument(name, format!("shape {dims:?}"), "two dimensions")),
    }
}

/// The dimensions of a tensor that must have four.
pub(super) fn dims4(name: &'static str, tensor: &Tensor) -> Result<(usize, usize, usize, usize)> {
    match tensor.dims() {
        &[b, h, w, c] => Ok((b, h, w, c)),
        dims => Err(Error::argument(name, format!("shape {dims:?}"), "four dimensions")),
    }
}

/// The shapes, for error messages.
pub(super) fn same_shape(name: &'static str, a: &Tensor, b: &Tensor) -> Result<()> {
    expect_dims(name, b, a.dims())
}
