//! A matrix of a checkpoint in the form in which it is kept.

use crate::error::{Error, Result};
use crate::kernels::{self, PackedWeight, WeightFormat};
use crate::vlm::checkpoint::raw::{self, Raw};
use crate::vlm::checkpoint::weights::Weights;
use candle_core::{DType, Device, Tensor};
use std::sync::Arc;

/// `[out, in]`, as checkpoints store it. Cheap to clone: a tied head shares its embedding.
#[derive(Clone)]
pub enum Matrix {
    /// A candle tensor: f32 on the CPU; f32 or bf16 on other devices.
    Plain(Tensor),
    /// Packed for our kernels on the CPU.
    Packed(Arc<PackedWeight>),
}

impl Matrix {
    /// The matrix `[rows, columns]` of this name in the form of [`Weights::with_format`].
    ///
    /// # Errors
    /// As [`Weights::get`]; what stands in for a missing matrix takes no memory.
    pub fn read(weights: &Weights, name: &str, shape: [usize; 2]) -> Result<Self> {
        Self::new(&weights.raw(name, shape)?, weights.format(), weights.device())
    }

    /// Keeps a f32 tensor in a format.
    ///
    /// # Errors
    /// [`Error::Tensors`] if it has not two dimensions or the device refuses it; [`Error::Argument`] for what int8 cannot hold,
    /// and for int8 on another device than the CPU.
    pub fn from_tensor(tensor: &Tensor, format: WeightFormat) -> Result<Self> {
        tensor.dims2()?;
        Self::new(&Raw::Tensor(tensor.clone()), format, tensor.device())
    }

    /// Keeps a matrix in a format; what lies in a file goes to `device`. What is absent takes no memory.
    pub(crate) fn new(raw: &Raw<'_>, format: WeightFormat, device: &Device) -> Result<Self> {
        if raw.packs(format, device) {
            return Ok(Self::Packed(Arc::new(raw::pack(&[raw], format)?)));
        }
        let place = if let Raw::Tensor(tensor) = raw { tensor.device() } else { device };
        format.check(place.location())?;
        Ok(Self::Plain(match (format, raw) {
            (WeightFormat::F32, _) | (_, Raw::Absent(_)) => raw.f32(device)?,
            // Half as much goes to the device.
            (_, Raw::Stored(stored)) => stored.f32(&Device::Cpu)?.to_dtype(DType::BF16)?.to_device(device)?,
            (_, Raw::Tensor(tensor)) => tensor.to_dtype(DType::BF16)?,
        }))
    }

    /// Output and input width.
    pub fn dims(&self) -> (usize, usize) {
        match self {
            Self::Plain(t) => (t.dims().first().copied().unwrap_or(0), t.dims().get(1).copied().unwrap_or(0)),
            Self::Packed(p) => p.dims(),
        }
    }

    /// The type that activations are rounded to for its product, where that is a plain tensor of another type than f32.
    pub(super) fn rounded_type(&self) -> Option<DType> {
        match self {
            Self::Plain(t) if t.dtype() != DType::F32 => Some(t.dtype()),
            Self::Plain(_) | Self::Packed(_) => None,
        }
    }

    /// `x W^T + b`: `[n, in]`, f32 or the matrix's type, to `[n, out]`, f32; `bias` is `[out]`.
    ///
    /// # Errors
    /// [`Error::Argument`] or [`Error::Tensors`] on another width.
    pub fn linear(&self, x: &Tensor, bias: Option<&Tensor>) -> Result<Tensor> {
        match self {
            Self::Plain(t) if t.dtype() == DType::F32 => kernels::linear(x, t, bias),
            Self::Plain(t) => kernels::widen(&kernels::linear(&x.to_dtype(t.dtype())?, t, None)?, bias, None),
            Self::Packed(p) => p.linear(x, bias),
        }
    }

    /// Some rows of the matrix as f32, `[ids, in]`: embeddings of tokens, or their rows of the output head.
    ///
    /// # Errors
    /// [`Error::Argument`] on a row that is not there.
    pub fn rows(&self, ids: &[u32]) -> Result<Tensor> {
        let (rows, _) = self.dims();
        if let Some(id) = ids.iter().find(|&&id| id as usize >= rows) {
            return Err(Error::argument("token id", id, format!("below the model's vocabulary of {rows}")));
        }
        match self {
            Self::Plain(t) => {
                let index = Tensor::from_vec(ids.to_vec(), ids.len(), t.device())?;
                Ok(t.index_select(&index, 0)?.to_dtype(DType::F32)?)
            }
            Self::Packed(p) => p.rows(ids),
        }
    }
}
