//! Products with weights that are packed once, when they are loaded, in half or a quarter of the
//! memory of f32.
//!
//! One layout serves every instruction set and both formats: panels of 32 output channels,
//! `[panel][step][channel]` of 32-bit words, a word being the values of a channel for one step
//! through the inner dimension: two bf16 or four signed bytes. That is what the dot-product
//! instructions take (AVX512-BF16, VNNI, AMX, the dot products of NEON), and what others widen in registers.

#[cfg(any(test, target_arch = "x86_64"))]
pub(in crate::kernels) mod amx;
#[cfg(target_arch = "x86_64")]
pub(in crate::kernels) mod amx_unit;
pub(in crate::kernels) mod dot_bf16;
mod dot_int8;
mod format;
mod gate;
mod gemm;
mod isa;
mod lhs;
mod mlp;
#[cfg(target_arch = "aarch64")]
pub(in crate::kernels) mod neon;
pub(in crate::kernels) mod panel;
mod quantise;
mod rows;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod tests_int8;
pub(in crate::kernels) mod tile;
pub(in crate::kernels) mod words;

use crate::error::{Error, Result};
use crate::kernels::exec::{dims2, expect_dims, read, tensor};
#[cfg(target_arch = "x86_64")]
pub(in crate::kernels) use amx_unit::busy as amx_busy;
use candle_core::{DType, Tensor};
pub use format::WeightFormat;
pub use gate::PackedGate;
use gemm::{Channels, Finish, Job};
use isa::Kernel;
use lhs::Left;
use panel::Panels;
pub use rows::Rows;
use std::mem::MaybeUninit;

#[cfg(target_arch = "x86_64")]
pub(in crate::kernels) use amx_unit::usable as amx_usable;

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
    /// Of each channel, where the format is [`WeightFormat::Int8`].
    scales: Vec<f32>,
    /// 128 times the sum of each channel's bytes.
    offsets: Vec<i32>,
}

impl PackedWeight {
    /// Packs weights that have the same inputs as one, whose outputs are theirs in turn.
    ///
    /// bf16: values are rounded to nearest, ties to even. int8: each output channel becomes bytes in -127 ..= 127 times its own scale,
    /// its largest magnitude over 127.
    ///
    /// # Errors
    /// [`Error::Argument`] where the inputs differ, the format is [`WeightFormat::F32`], or it is [`WeightFormat::Int8`] and a
    /// value is not finite or the inputs are more than 65,536.
    pub fn new(format: WeightFormat, parts: &[Rows<'_>]) -> Result<Self> {
        let k = parts.first().map_or(0, |part| part.dims().1);
        if let Some((_, other)) = parts.iter().map(Rows::dims).find(|dims| dims.1 != k) {
            return Err(Error::argument("inputs of joined weights", other, format!("{k} for all of them")));
        }
        let m = parts.iter().map(|part| part.dims().0).sum();
        rows::pack(format, parts, (m, k), |channel| {
            let mut row = channel;
            parts.iter().enumerate().find_map(|(i, part)| {
                let (m, _) = part.dims();
                if row < m {
                    return Some((i, row));
                }
                row -= m;
                None
            })
        })
    }

    /// Outputs and inputs `(m, k)`.
    pub fn dims(&self) -> (usize, usize) {
        (self.panels.m, self.panels.k)
    }

    /// Memory held, in bytes.
    pub fn bytes(&self) -> usize {
        self.panels.bytes() + 4 * (self.scales.len() + self.offsets.len())
    }

    /// The format of the values.
    pub fn format(&self) -> WeightFormat {
        self.format
    }

    /// `x W^T + b`: `x` is `[n, k]`, `bias` `[m]`, both f32 on the CPU; gives `[n, m]`.
    ///
    /// bf16: `x` is rounded to bf16 (to nearest even; NaN and infinities stay), products are summed in f32. Subnormal values of
    /// `x` or the weight may count as zero: the instructions of AVX512-BF16, AMX and FEAT_BF16 (Arm) read them so. The last also rounds
    /// sums to odd rather than to nearest: by up to one unit in the last place of each.
    ///
    /// int8: each row of `x` is quantised as a channel of the weight is, by its own scale; sums are exact, so that every
    /// instruction set gives the same bits. A row with a value that is not finite gives NaN.
    ///
    /// # Errors
    /// [`Error::Argument`] for another shape, type or device.
    pub fn linear(&self, x: &Tensor, bias: Option<&Tensor>) -> Result<Tensor> {
        self.linear_by(Kernel::current(self.format), x, bias)
    }

    /// `r + (x W^T + b)`, rounded as the sum of the two is: `residual` `r` is `[n, m]`, the rest as for [`PackedWeight::linear`].
    /// No gradient flows, not through `residual` either.
    ///
    /// # Errors
    /// [`Error::Argument`] for another shape, type or device.
    pub fn linear_onto(&self, x: &Tensor, bias: Option<&Tensor>, residual: &Tensor) -> Result<Tensor> {
        let (m, _) = self.dims();
        let mut parts = self.multiply(Kernel::current(self.format), x, bias, Some(residual), &[m])?;
        parts.pop().ok_or_else(|| Error::argument("outputs", 0, "one part"))
    }

    /// The outputs of [`PackedWeight::linear`] in parts of these widths, `[n, width]` each; what the widths leave out at the end is not
    /// computed.
    ///
    /// # Errors
    /// [`Error::Argument`] for another shape, type or device, or widths of more than all outputs.
    pub fn linear_parts(&self, x: &Tensor, bias: Option<&Tensor>, widths: &[usize]) -> Result<Vec<Tensor>> {
        self.multiply(Kernel::current(self.format), x, bias, None, widths)
    }

    fn linear_by(&self, kernel: Kernel, x: &Tensor, bias: Option<&Tensor>) -> Result<Tensor> {
        let mut parts = self.multiply(kernel, x, bias, None, &[self.panels.m])?;
        parts.pop().ok_or_else(|| Error::argument("outputs", 0, "one part"))
    }

    fn multiply(
        &self,
        kernel: Kernel,
        x: &Tensor,
        bias: Option<&Tensor>,
        residual: Option<&Tensor>,
        widths: &[usize],
    ) -> Result<Vec<Tensor>> {
        let (m, k) = self.dims();
        let (n, _) = dims2("x", x)?;
        let known = [("x", Some(x), &[n, k][..]), ("bias", bias, &[m]), ("residual", residual, &[n, m])];
        for (name, tensor, dims) in known {
            if let Some(tensor) = tensor {
                expect_dims(name, tensor, dims)?;
                expect_cpu_f32(name, tensor)?;
            }
        }
        let wanted = widths.iter().try_fold(0usize, |sum, &width| sum.checked_add(width));
        if wanted.is_none_or(|wanted| wanted > m || residual.is_some() && wanted < m) {
            return Err(Error::argument("widths", format!("{widths:?}"), format!("{m} outputs at most")));
        }
        let parts = read(x, |x| {
            read_some(bias, |bias| {
                read_some(residual, |residual| {
                    Ok(self.product(kernel, x, n, widths, Finish { residual, ..self.finish(bias) }))
                })
            })
        })?;
        let parts = parts.into_iter().zip(widths).map(|(part, &width)| Ok(tensor(part, (n, width))?));
        parts.collect()
    }

    /// The outputs that `finish` leaves in parts of these widths, `[n, width]` each.
    fn product(
        &self,
        kernel: Kernel,
        x: &[f32],
        n: usize,
        widths: &[usize],
        finish: Finish<'_>,
    ) -> Vec<Vec<f32>> {
        let mut parts: Vec<Vec<f32>> = widths.iter().map(|width| Vec::with_capacity(n * width)).collect();
        let room = parts.iter_mut().zip(widths);
        let mut room: Vec<_> = room.map(|(p, width)| &mut p.spare_capacity_mut()[..n * width]).collect();
        self.product_into(kernel, x, &mut room, widths, finish);
        for (part, width) in parts.iter_mut().zip(widths) {
            // SAFETY: every element was written.
            unsafe { part.set_len(n * width) };
        }
        parts
    }

    /// Writes every element of [`PackedWeight::product`]'s parts.
    fn product_into(
        &self,
        kernel: Kernel,
        x: &[f32],
        parts: &mut [&mut [MaybeUninit<f32>]],
        widths: &[usize],
        finish: Finish<'_>,
    ) {
        let (k, m) = (self.panels.k, widths.iter().sum());
        let finish = if kernel.signed { finish.without_offsets() } else { finish };
        let n = parts.iter().zip(widths).find(|(_, w)| **w > 0).map_or(0, |(part, w)| part.len() / w);
        let step = lhs::rows_at_once(kernel, k);
        for first in (0..n).step_by(step) {
            let rows = first..n.min(first + step);
            let room = parts.iter_mut().zip(widths);
            let mut room: Vec<_> = room.map(|(p, w)| &mut p[rows.start * w..rows.end * w]).collect();
            let residual = finish.residual.map(|r| &r[rows.start * m..rows.end * m]);
            let left = Left::new(kernel, &x[rows.start * k..rows.end * k], rows.len(), k);
            let finish = Finish { residual, ..finish };
            Job { kernel, left: &left, panels: &self.panels, m, finish }.run(&mut room);
            left.recycle();
        }
    }

    fn finish<'a>(&'a self, bias: Option<&'a [f32]>) -> Finish<'a> {
        let channels = Channels { scales: &self.scales, offsets: &self.offsets };
        Finish {
            bias,
            gated: false,
            residual: None,
            channels: (self.format == WeightFormat::Int8).then_some(channels),
        }
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
            match self.scales.get(id as usize) {
                None => spread(out, words.map(words::halves)),
                Some(scale) => spread(out, words.map(|w| quantise::bytes(w).map(|byte| byte * scale))),
            }
        }
        Ok(tensor(out, (ids.len(), k))?)
    }
}

/// Writes the values of words; the last word may hold more than there is room for.
fn spread<const N: usize>(out: &mut [f32], words: impl Iterator<Item = [f32; N]>) {
    for (out, word) in out.chunks_mut(N).zip(words) {
        for (o, value) in out.iter_mut().zip(word) {
            *o = value;
        }
    }
}

/// [`read`] of what may not be there.
fn read_some<R>(
    tensor: Option<&Tensor>,
    f: impl FnOnce(Option<&[f32]>) -> candle_core::Result<R>,
) -> candle_core::Result<R> {
    match tensor {
        Some(tensor) => read(tensor, |values| f(Some(values))),
        None => f(None),
    }
}

fn expect_cpu_f32(name: &'static str, tensor: &Tensor) -> Result<()> {
    if tensor.device().is_cpu() && tensor.dtype() == DType::F32 {
        return Ok(());
    }
    let found = format!("{:?} on {:?}", tensor.dtype(), tensor.device().location());
    Err(Error::argument(name, found, "F32 on the CPU"))
}
