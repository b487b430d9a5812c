//! Weights packed once for matrix products (stand-in: plain f32 of the rounded values until the kernels are there).
use crate::error::{Error, Result};
use candle_core::{DType, Device, Tensor};

/// In what form the matrices of a model are kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WeightFormat {
    /// As f32.
    F32,
    /// As bf16; activations are rounded to bf16, products are summed in f32.
    Bf16,
    /// As 8-bit integers with one scale per output.
    Int8,
}

/// A weight `[m, k]` (out, in).
pub struct PackedWeight(Tensor);

impl PackedWeight {
    /// From little-endian bf16 rows.
    ///
    /// # Errors
    /// [`Error::Tensors`] if the length is another.
    pub fn bf16_from_bytes(bytes: &[u8], m: usize, k: usize) -> Result<Self> {
        Ok(Self(Tensor::from_raw_buffer(bytes, DType::BF16, &[m, k], &Device::Cpu)?.to_dtype(DType::F32)?))
    }

    /// From f32 rows, rounded to nearest even.
    ///
    /// # Errors
    /// [`Error::Tensors`] if the length is another.
    pub fn bf16_from_f32(values: &[f32], m: usize, k: usize) -> Result<Self> {
        let exact = Tensor::from_slice(values, (m, k), &Device::Cpu)?;
        Ok(Self(exact.to_dtype(DType::BF16)?.to_dtype(DType::F32)?))
    }

    /// From rows that `row` writes.
    ///
    /// # Errors
    /// [`Error::Argument`]: not there yet.
    pub fn int8_from_rows(_m: usize, _k: usize, _row: impl Fn(usize, &mut [f32]) + Sync) -> Result<Self> {
        Err(Error::argument("weight format", "int8", "f32 or bf16"))
    }

    /// Outputs and inputs.
    pub fn dims(&self) -> (usize, usize) {
        (self.0.dims().first().copied().unwrap_or(0), self.0.dims().get(1).copied().unwrap_or(0))
    }

    /// `[n, k]` to `[n, m]`.
    ///
    /// # Errors
    /// [`Error::Argument`] on other shapes.
    pub fn linear(&self, x: &Tensor, bias: Option<&Tensor>) -> Result<Tensor> {
        super::linear(&x.to_dtype(DType::BF16)?.to_dtype(DType::F32)?, &self.0, bias)
    }

    /// Rows as f32, `[ids, k]`.
    ///
    /// # Errors
    /// [`Error::Tensors`] on a row that is not there.
    pub fn rows(&self, ids: &[u32]) -> Result<Tensor> {
        Ok(self.0.index_select(&Tensor::new(ids, &Device::Cpu)?, 0)?)
    }
}
