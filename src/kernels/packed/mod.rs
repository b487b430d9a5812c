//! Products with weights that are packed once, when they are loaded, in half or a quarter of the
//! memory of f32.
//!
//! One layout serves every instruction set and both formats: panels of 32 output channels,
//! `[panel][step][channel]` of 32-bit words, a word being the values of a channel for one step
//! through the inner dimension: two bf16 or four signed bytes. That is what the dot-product
//! instructions take (AVX512-BF16, VNNI, AMX), and what others widen in registers.

mod gemm;
mod isa;
mod lhs;
mod panel;
#[cfg(test)]
mod tests;
mod tile;
mod words;

use super::exec::{dims2, expect_dims, read, tensor};
use crate::error::{Error, Result};
use candle_core::{DType, Tensor};
use gemm::{Finish, Job};
use isa::Kernel;
use lhs::Left;
use panel::Panels;

/// How the weights of a model are held in memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WeightFormat {
    /// 32-bit floats, as plain tensors; the one format that can be trained.
    F32,
    /// 16-bit floats with the exponent range of f32 (8 bits of precision), as checkpoints are published.
    Bf16,
    /// Signed bytes with one scale per output channel.
    Int8,
}

/// A weight `[m, k]` (outputs, inputs, as checkpoints store it), packed for the CPU kernels.
///
/// Immutable, and for inference only: no gradient flows through its products.
///
/// Every output is one sum in a fixed order over the inner dimension, so that it depends neither on the number
/// of threads nor on how many rows are multiplied at once.
#[derive(Debug)]
pub struct PackedWeight {
    panels: Panels,
    format: WeightFormat,
}

impl PackedWeight {
    /// Packs `m * k` little-endian bf16 values, row-major, as a safetensors file holds them; any alignment.
    ///
    /// # Errors
    /// [`Error::BufferLength`] where `bytes` is not `2 * m * k` bytes long.
    pub fn bf16_from_bytes(bytes: &[u8], m: usize, k: usize) -> Result<Self> {
        let values = elements(bytes.len() / 2, m, k)?;
        if bytes.len() != 2 * values {
            let (expected, found) = (2 * values, bytes.len());
            return Err(Error::BufferLength { what: "bf16 weight, in bytes", expected, found });
        }
        let panels = Panels::build(m, k, 2, |row, words| {
            words::from_bf16_bytes(&bytes[row * 2 * k..(row + 1) * 2 * k], words);
        });
        Ok(PackedWeight { panels, format: WeightFormat::Bf16 })
    }

    /// Rounds `m * k` row-major values to bf16 (to nearest, ties to even) and packs them.
    ///
    /// # Errors
    /// [`Error::BufferLength`] where `values` does not hold `m * k` elements.
    pub fn bf16_from_f32(values: &[f32], m: usize, k: usize) -> Result<Self> {
        elements(values.len(), m, k)?;
        let panels = Panels::build(m, k, 2, |row, words| {
            words::from_f32(&values[row * k..(row + 1) * k], words);
        });
        Ok(PackedWeight { panels, format: WeightFormat::Bf16 })
    }

    /// From rows that `row` writes.
    ///
    /// # Errors
    /// [`Error::Argument`]: not there yet.
    pub fn int8_from_rows(_m: usize, _k: usize, _row: impl Fn(usize, &mut [f32]) + Sync) -> Result<Self> {
        Err(Error::argument("weight format", "int8", "f32 or bf16"))
    }

    /// Outputs and inputs `(m, k)`.
    pub fn dims(&self) -> (usize, usize) {
        (self.panels.m, self.panels.k)
    }

    /// Memory held, in bytes.
    pub fn bytes(&self) -> usize {
        self.panels.bytes()
    }

    /// The format of the values.
    pub fn format(&self) -> WeightFormat {
        self.format
    }

    /// `x W^T + b`: `x` is `[n, k]`, `bias` `[m]`, both f32 on the CPU; gives `[n, m]`.
    ///
    /// `x` is rounded to bf16 (to nearest even; NaN and infinities stay), products are summed in f32. Subnormal values of
    /// `x` or the weight may count as zero: the AVX512-BF16 and AMX instructions read them so.
    ///
    /// # Errors
    /// [`Error::Argument`] for another shape, type or device.
    pub fn linear(&self, x: &Tensor, bias: Option<&Tensor>) -> Result<Tensor> {
        self.linear_by(Kernel::current(self.format), x, bias)
    }

    fn linear_by(&self, kernel: Kernel, x: &Tensor, bias: Option<&Tensor>) -> Result<Tensor> {
        let (m, k) = self.dims();
        let (n, _) = dims2("x", x)?;
        expect_dims("x", x, &[n, k])?;
        expect_cpu_f32("x", x)?;
        if let Some(bias) = bias {
            expect_dims("bias", bias, &[m])?;
            expect_cpu_f32("bias", bias)?;
        }
        let product = |x: &[f32], bias: Option<&[f32]>| {
            let left = Left::new(kernel, x, n, k);
            let job = Job { kernel, left: &left, panels: &self.panels, finish: Finish { bias } };
            let mut out = vec![0f32; n * m];
            job.run(&mut out);
            Ok(out)
        };
        let out = read(x, |x| match bias {
            Some(bias) => read(bias, |bias| product(x, Some(bias))),
            None => product(x, None),
        })?;
        Ok(tensor(out, (n, m))?)
    }

    /// Rows of the weight as f32 `[ids, k]`: an embedding lookup, or some rows of an output head.
    ///
    /// # Errors
    /// [`Error::Argument`] for an id that is not below `m`.
    pub fn rows(&self, ids: &[u32]) -> Result<Tensor> {
        let (m, k) = self.dims();
        if let Some(id) = ids.iter().find(|&&id| id as usize >= m) {
            return Err(Error::argument("row id", id, format!("less than {m}, the rows of the weight")));
        }
        let mut out = vec![0f32; ids.len() * k];
        for (out, &id) in out.chunks_exact_mut(k.max(1)).zip(ids) {
            let words = self.panels.row(id as usize);
            for (pair, word) in out.chunks_mut(2).zip(words) {
                for (o, value) in pair.iter_mut().zip(words::halves(word)) {
                    *o = value;
                }
            }
        }
        Ok(tensor(out, (ids.len(), k))?)
    }
}

/// `m * k`, which must be `found`.
fn elements(found: usize, m: usize, k: usize) -> Result<usize> {
    match m.checked_mul(k) {
        Some(expected) if expected == found => Ok(expected),
        expected => {
            let expected = expected.unwrap_or(usize::MAX);
            Err(Error::BufferLength { what: "packed weight", expected, found })
        }
    }
}

fn expect_cpu_f32(name: &'static str, tensor: &Tensor) -> Result<()> {
    if tensor.device().is_cpu() && tensor.dtype() == DType::F32 {
        return Ok(());
    }
    let found = format!("{:?} on {:?}", tensor.dtype(), tensor.device().location());
    Err(Error::argument(name, found, "F32 on the CPU"))
}
