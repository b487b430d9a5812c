//! A matrix of a checkpoint in the form in which it is kept.

use super::stored::Stored;
use crate::error::{Error, Result};
use crate::kernels::{self, PackedWeight, WeightFormat};
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
    /// Keeps a f32 tensor, plus `added` of the same shape if given, in a format.
    ///
    /// # Errors
    /// [`Error::Tensors`] if the device refuses it.
    pub fn from_tensor(tensor: &Tensor, added: Option<&Tensor>, format: WeightFormat) -> Result<Self> {
        let sum = match added {
            Some(added) => (tensor + added)?,
            None => tensor.clone(),
        };
        let (rows, columns) = sum.dims2()?;
        match (format, sum.device()) {
            (WeightFormat::F32, _) => Ok(Self::Plain(sum)),
            (_, Device::Cpu) => {
                let values = sum.flatten_all()?.to_vec1::<f32>()?;
                Self::packed(&values, rows, columns, format)
            }
            _ => Ok(Self::Plain(sum.to_dtype(DType::BF16)?)),
        }
    }

    fn packed(values: &[f32], rows: usize, columns: usize, format: WeightFormat) -> Result<Self> {
        let packed = match format {
            WeightFormat::Int8 => PackedWeight::int8_from_rows(rows, columns, |i, out| {
                out.copy_from_slice(&values[i * columns..(i + 1) * columns]);
            })?,
            _ => PackedWeight::bf16_from_f32(values, rows, columns)?,
        };
        Ok(Self::Packed(Arc::new(packed)))
    }

    /// Converts a tensor of a file. bf16 is packed as it lies, without a copy in f32.
    pub(super) fn from_stored(stored: &Stored, format: WeightFormat, device: &Device) -> Result<Self> {
        let &[rows, columns] = stored.shape() else {
            let found = format!("shape {:?}", stored.shape());
            return Err(Error::argument("matrix", found, "two dimensions"));
        };
        match (format, device, stored.dtype()) {
            (WeightFormat::F32, _, _) => Ok(Self::Plain(stored.f32(device)?)),
            (WeightFormat::Bf16, Device::Cpu, DType::BF16) => {
                let packed = stored.with_bytes(|b| PackedWeight::bf16_from_bytes(b, rows, columns))??;
                Ok(Self::Packed(Arc::new(packed)))
            }
            (_, Device::Cpu, _) => Self::packed(&stored.values()?, rows, columns, format),
            _ => Ok(Self::Plain(stored.f32(&Device::Cpu)?.to_dtype(DType::BF16)?.to_device(device)?)),
        }
    }

    /// Output and input width.
    pub fn dims(&self) -> (usize, usize) {
        match self {
            Self::Plain(t) => (t.dims().first().copied().unwrap_or(0), t.dims().get(1).copied().unwrap_or(0)),
            Self::Packed(p) => p.dims(),
        }
    }

    /// `x W^T + b`: `[n, in]` to `[n, out]`, both f32; `bias` is `[out]`.
    ///
    /// # Errors
    /// [`Error::Argument`] or [`Error::Tensors`] on another width.
    pub fn linear(&self, x: &Tensor, bias: Option<&Tensor>) -> Result<Tensor> {
        match self {
            Self::Plain(t) if t.dtype() == DType::F32 => kernels::linear(x, t, bias),
            Self::Plain(t) => {
                let y = kernels::linear(&x.to_dtype(t.dtype())?, t, None)?.to_dtype(DType::F32)?;
                Ok(match bias {
                    Some(bias) => y.broadcast_add(bias)?,
                    None => y,
                })
            }
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
