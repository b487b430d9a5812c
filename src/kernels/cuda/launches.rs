//! Launches of our kernels and of products: each makes a new tensor of tensors on the device of the kernels, of which [`fits`] is true.
//!
//! All work of a device is done in order on one stream, and memory is taken and given back in the same order, so that an address is
//! good for every launch that is asked for while its tensor is there.

use super::compiled::{Compiled, Kernel};
use crate::kernels::rounded::{Heads, OwnKeys};
use candle_core::cuda_backend::CudaDType;
use candle_core::cuda_backend::cudarc::cublas::{result, sys};
use candle_core::cuda_backend::cudarc::driver::{
    CudaSlice, DevicePtr, DevicePtrMut, LaunchConfig, PushKernelArg,
};
use candle_core::op::BackpropOp;
use candle_core::{CudaStorage, DType, Device, Error, Result, Shape, Storage, Tensor};
use half::bf16;

/// Threads of a block, at most.
const THREADS: usize = 256;
/// Warps of a block whose warps have a row each.
const WARPS: usize = 4;
/// Address of a tensor that is left out.
const NONE: u64 = 0;

/// Whether our launches take tensors: on this device, of these types, none empty, their rows without gaps, no gradient wanted.
pub(in super::super) fn fits(kernels: &Compiled, tensors: &[(&Tensor, DType)]) -> bool {
    let here = |t: &Tensor| matches!(t.device(), Device::Cuda(d) if d.id() == kernels.device().id());
    tensors.iter().all(|(t, dtype)| {
        here(t) && t.dtype() == *dtype && !t.track_op() && t.elem_count() > 0 && t.is_contiguous()
    })
}

/// Address of a tensor's first element.
fn address<T: CudaDType>(kernels: &Compiled, tensor: &Tensor) -> Result<u64> {
    let (storage, layout) = tensor.storage_and_layout();
    let Storage::Cuda(storage) = &*storage else {
        return Err(Error::Msg("a kernel's tensor is not on a CUDA device".into()).bt());
    };
    let rest = storage.as_cuda_slice::<T>()?.try_slice(layout.start_offset()..);
    let rest = rest.ok_or_else(|| Error::Msg("a kernel's tensor lies beyond its data".into()).bt())?;
    Ok(rest.device_ptr(&kernels.device().cuda_stream()).0)
}

fn address_or_none(kernels: &Compiled, tensor: Option<&Tensor>) -> Result<u64> {
    tensor.map_or(Ok(NONE), |t| address::<f32>(kernels, t))
}

/// A result while it is made.
struct Room<T> {
    data: CudaSlice<T>,
    address: u64,
}

impl<T: CudaDType + candle_core::cuda_backend::cudarc::driver::DeviceRepr> Room<T> {
    /// # Safety
    /// A launch that is asked for before any other one must write each of the elements.
    unsafe fn new(kernels: &Compiled, len: usize) -> Result<Self> {
        // SAFETY: the caller's.
        let mut data = unsafe { kernels.device().alloc::<T>(len)? };
        let address = data.device_ptr_mut(&kernels.device().cuda_stream()).0;
        Ok(Self { data, address })
    }

    fn tensor(self, kernels: &Compiled, shape: impl Into<Shape>) -> Tensor {
        let storage = CudaStorage::wrap_cuda_slice(self.data, kernels.device().clone());
        Tensor::from_storage(Storage::Cuda(storage), shape, BackpropOp::none(), false)
    }
}

/// Launches a kernel of so many blocks and threads with arguments in the order of its parameters.
macro_rules! launch {
    ($kernels:expr, $kernel:expr, $blocks:expr, $threads:expr, $($argument:expr),+ $(,)?) => {{
        let stream = $kernels.device().cuda_stream();
        let config = LaunchConfig {
            grid_dim: (number($blocks)?, 1, 1),
            block_dim: (number($threads)?, 1, 1),
            shared_mem_bytes: 0,
        };
        let mut arguments = stream.launch_builder($kernels.function($kernel));
        $(let argument = $argument; arguments.arg(&argument);)+
        // SAFETY: of the addresses that stand here, the first is that of a room which the kernel fills, the others those of tensors that
        // `fits` is true of, with the shapes that are told; types and order are those of the parameters in `kernels.cu`.
        unsafe { arguments.launch(config) }.map_err(Error::wrap)?;
    }};
}

/// A size as kernels take it.
fn number(n: usize) -> Result<u32> {
    let most = i32::MAX as usize;
    if n > most {
        Err(Error::Msg(format!("{n} rows or columns for a kernel, which takes {most}")).bt())
    } else {
        Ok(n as u32)
    }
}

/// Whole warps for the elements of a row.
fn threads(width: usize) -> usize {
    width.next_multiple_of(32).min(THREADS)
}

/// As [`rounded::widen`](crate::kernels::rounded::widen). Rows of `y` may have gaps between them.
pub(in super::super) fn widen(
    kernels: &Compiled,
    y: &Tensor,
    bias: Option<&Tensor>,
    residual: Option<&Tensor>,
) -> Result<Tensor> {
    let (n, m) = y.dims2()?;
    let [bias, residual] = [address_or_none(kernels, bias)?, address_or_none(kernels, residual)?];
    let (from, stride) = (address::<bf16>(kernels, y)?, number(y.stride()[0])?);
    // SAFETY: the kernel writes `m` elements of each of `n` rows.
    let out = unsafe { Room::<f32>::new(kernels, n * m)? };
    launch!(kernels, Kernel::Widen, n, threads(m), out.address, from, stride, bias, residual, number(m)?);
    Ok(out.tensor(kernels, (n, m)))
}

/// RMS norm of `x`, `[n, d]`, f32, in bf16.
pub(in super::super) fn rms_norm(
    kernels: &Compiled,
    x: &Tensor,
    weight: &Tensor,
    eps: f64,
) -> Result<Tensor> {
    let (n, d) = x.dims2()?;
    let [from, weight] = [address::<f32>(kernels, x)?, address::<f32>(kernels, weight)?];
    // SAFETY: the kernel writes `d` elements of each of `n` rows.
    let out = unsafe { Room::<bf16>::new(kernels, n * d)? };
    launch!(kernels, Kernel::RmsNorm, n, threads(d), out.address, from, weight, number(d)?, eps as f32);
    Ok(out.tensor(kernels, (n, d)))
}

/// As [`rounded::swiglu`](crate::kernels::rounded::swiglu).
pub(in super::super) fn swiglu(
    kernels: &Compiled,
    [gate, up]: [&Tensor; 2],
    biases: [Option<&Tensor>; 2],
) -> Result<Tensor> {
    let (n, m) = gate.dims2()?;
    let [g, u] = [address::<bf16>(kernels, gate)?, address::<bf16>(kernels, up)?];
    let [gb, ub] = [address_or_none(kernels, biases[0])?, address_or_none(kernels, biases[1])?];
    // SAFETY: the kernel writes `m` elements of each of `n` rows.
    let out = unsafe { Room::<bf16>::new(kernels, n * m)? };
    launch!(kernels, Kernel::Swiglu, n, threads(m), out.address, g, u, gb, ub, number(m)?);
    Ok(out.tensor(kernels, (n, m)))
}

/// As [`rounded::heads_first`](crate::kernels::rounded::heads_first).
pub(in super::super) fn heads_first(
    kernels: &Compiled,
    x: &Tensor,
    heads: Heads,
    scale: f64,
    padded: usize,
) -> Result<Tensor> {
    let Heads { items, key_heads, group, period, head_dim } = heads;
    let rows = key_heads * items * group * padded;
    let from = address::<f32>(kernels, x)?;
    // SAFETY: the kernel writes `head_dim` elements of each of `rows` rows.
    let out = unsafe { Room::<bf16>::new(kernels, rows * head_dim)? };
    launch!(
        kernels,
        Kernel::HeadsFirst,
        rows,
        threads(head_dim),
        out.address,
        from,
        scale as f32,
        number(items)?,
        number(key_heads)?,
        number(group)?,
        number(period)?,
        number(padded)?,
        number(head_dim)?,
    );
    Ok(out.tensor(kernels, (key_heads, items, group, padded, head_dim)))
}

/// As [`rounded::probabilities`](crate::kernels::rounded::probabilities).
pub(in super::super) fn probabilities(
    kernels: &Compiled,
    scores: &Tensor,
    columns: usize,
    period: usize,
    causal: bool,
) -> Result<Tensor> {
    let (rows, stride) = scores.dims2()?;
    let from = address::<f32>(kernels, scores)?;
    // SAFETY: the kernel writes `stride` elements of each of `rows` rows.
    let out = unsafe { Room::<bf16>::new(kernels, rows * stride)? };
    launch!(
        kernels,
        Kernel::Probabilities,
        rows.div_ceil(WARPS),
        WARPS * 32,
        out.address,
        from,
        number(rows)?,
        number(stride)?,
        number(columns)?,
        number(period)?,
        u32::from(causal),
    );
    Ok(out.tensor(kernels, (rows, stride)))
}

/// As [`rounded::shared_probabilities`](crate::kernels::rounded::shared_probabilities).
pub(in super::super) fn shared_probabilities(
    kernels: &Compiled,
    scores: &Tensor,
    [q, k]: [&Tensor; 2],
    keys: OwnKeys,
    heads: Heads,
) -> Result<Tensor> {
    let Heads { items, key_heads, group, period, head_dim } = heads;
    let (rows, stride) = scores.dims2()?;
    let [from, k] = [address::<f32>(kernels, scores)?, address::<f32>(kernels, k)?];
    let q = address::<bf16>(kernels, q)?;
    // SAFETY: the kernel writes `stride` elements of each of `rows` rows.
    let out = unsafe { Room::<bf16>::new(kernels, rows * stride)? };
    launch!(
        kernels,
        Kernel::SharedProbabilities,
        rows.div_ceil(WARPS),
        WARPS * 32,
        out.address,
        from,
        q,
        k,
        number(rows)?,
        number(stride)?,
        number(keys.shared)?,
        number(keys.own)?,
        number(period)?,
        u32::from(keys.causal),
        number(items)?,
        number(key_heads)?,
        number(group)?,
        number(head_dim)?,
    );
    Ok(out.tensor(kernels, (rows, stride)))
}

/// As [`rounded::heads_last`](crate::kernels::rounded::heads_last).
pub(in super::super) fn heads_last(
    kernels: &Compiled,
    x: &Tensor,
    own: Option<(&Tensor, &Tensor, OwnKeys)>,
    heads: Heads,
) -> Result<Tensor> {
    let Heads { items, key_heads, group, period, head_dim } = heads;
    let from = address::<f32>(kernels, x)?;
    let (p, v, stride, shared, count) = match own {
        Some((p, v, keys)) => {
            let stride = p.dims2()?.1;
            (address::<bf16>(kernels, p)?, address::<f32>(kernels, v)?, stride, keys.shared, keys.own)
        }
        None => (NONE, NONE, 0, 0, 0),
    };
    // SAFETY: rows of attention and those of the result are as many elements, each of which the kernel writes.
    let out = unsafe { Room::<f32>::new(kernels, heads.rows() * head_dim)? };
    launch!(
        kernels,
        Kernel::HeadsLast,
        heads.rows(),
        threads(head_dim),
        out.address,
        from,
        p,
        v,
        number(stride)?,
        number(shared)?,
        number(count)?,
        number(items)?,
        number(key_heads)?,
        number(group)?,
        number(period)?,
        number(head_dim)?,
    );
    Ok(out.tensor(kernels, (items * period, heads.width())))
}

/// As [`rounded::product`](crate::kernels::rounded::product), of bf16: what candle's own product would round to bf16 stays f32.
pub(in super::super) fn product(
    kernels: &Compiled,
    a: &Tensor,
    b: &Tensor,
    transposed: bool,
) -> Result<Tensor> {
    let ((n, m, k), (_, rows, columns)) = (a.dims3()?, b.dims3()?);
    let o = if transposed { rows } else { columns };
    let size = |n: usize| number(n).map(|n| n as i32);
    // cuBLAS counts by columns, so that it is given the transposed tensors, and `b` comes first.
    let (operation, width) = if transposed {
        (sys::cublasOperation_t::CUBLAS_OP_T, size(k)?)
    } else {
        (sys::cublasOperation_t::CUBLAS_OP_N, size(o)?)
    };
    let [first, second] = [address::<bf16>(kernels, b)?, address::<bf16>(kernels, a)?];
    // SAFETY: the product writes `m` rows of `o` elements for each of `n`.
    let out = unsafe { Room::<f32>::new(kernels, n * m * o)? };
    let (one, zero) = (1f32, 0f32);
    let (rounded, exact) = (sys::cudaDataType_t::CUDA_R_16BF, sys::cudaDataType_t::CUDA_R_32F);
    let blas = kernels.device().cublas_handle();
    // SAFETY: contiguous tensors of these sizes; the numbers are read during the call.
    unsafe {
        result::gemm_strided_batched_ex(
            *blas.handle(),
            operation,
            sys::cublasOperation_t::CUBLAS_OP_N,
            size(o)?,
            size(m)?,
            size(k)?,
            (&raw const one).cast(),
            first as *const _,
            rounded,
            width,
            (o * k) as i64,
            second as *const _,
            rounded,
            size(k)?,
            (m * k) as i64,
            (&raw const zero).cast(),
            out.address as *mut _,
            exact,
            size(o)?,
            (m * o) as i64,
            size(n)?,
            sys::cublasComputeType_t::CUBLAS_COMPUTE_32F,
            sys::cublasGemmAlgo_t::CUBLAS_GEMM_DEFAULT_TENSOR_OP,
        )
    }
    .map_err(Error::wrap)?;
    Ok(out.tensor(kernels, (n, m, o)))
}
