//! Matrices of a checkpoint before they are kept in some form.

use super::stored::{Bytes, Stored};
use crate::error::Result;
use crate::kernels::{PackedWeight, RowMajor, WeightFormat};
use candle_core::{DType, Device, Tensor};

/// A matrix `[out, in]` as it is found.
pub(crate) enum Raw<'a> {
    /// In a file, not converted yet.
    Stored(&'a Stored),
    /// f32: in memory already, or computed.
    Tensor(Tensor),
    /// It is not there; only its shape is known.
    Absent([usize; 2]),
}

/// The values of a matrix on their way into packed form.
pub(crate) enum Held<'a> {
    /// bf16 as it lies, without a copy.
    Bytes(Bytes<'a>, [usize; 2]),
    /// Converted.
    Values(Vec<f32>, [usize; 2]),
}

impl Raw<'_> {
    /// Whether it is to be packed for our kernels; `device` is for what lies in a file.
    pub(crate) fn packs(&self, format: WeightFormat, device: &Device) -> bool {
        let on_cpu = match self {
            Raw::Stored(_) => device.is_cpu(),
            Raw::Tensor(tensor) => tensor.device().is_cpu(),
            Raw::Absent(_) => false,
        };
        on_cpu && format != WeightFormat::F32
    }

    /// As a f32 tensor; what lies in a file goes to `device`. Zeros that take no memory if it is absent.
    pub(crate) fn f32(&self, device: &Device) -> Result<Tensor> {
        match self {
            Raw::Stored(stored) => stored.f32(device),
            Raw::Tensor(tensor) => Ok(tensor.clone()),
            Raw::Absent(shape) => Ok(Tensor::zeros((1, 1), DType::F32, &Device::Cpu)?.broadcast_as(shape)?),
        }
    }

    /// Reads the values.
    pub(crate) fn hold(&self) -> Result<Held<'_>> {
        match self {
            Raw::Stored(s) if s.dtype() == DType::BF16 => Ok(Held::Bytes(s.bytes()?, s.matrix()?)),
            Raw::Stored(s) => Ok(Held::Values(s.values()?, s.matrix()?)),
            Raw::Tensor(t) => Ok(Held::Values(t.flatten_all()?.to_vec1()?, t.dims2()?.into())),
            Raw::Absent(shape) => Ok(Held::Values(Vec::new(), *shape)),
        }
    }
}

impl Held<'_> {
    /// What can be packed.
    pub(crate) fn rows(&self) -> Result<RowMajor<'_>> {
        match self {
            Held::Bytes(bytes, [rows, columns]) => RowMajor::bf16(bytes, *rows, *columns),
            Held::Values(values, [rows, columns]) => RowMajor::f32(values, *rows, *columns),
        }
    }
}

/// Packs matrices that have the same inputs as one, whose outputs are theirs in turn.
pub(crate) fn pack(raws: &[&Raw<'_>], format: WeightFormat) -> Result<PackedWeight> {
    let held = raws.iter().map(|raw| raw.hold()).collect::<Result<Vec<_>>>()?;
    let rows = held.iter().map(Held::rows).collect::<Result<Vec<_>>>()?;
    PackedWeight::new(format, &rows)
}
