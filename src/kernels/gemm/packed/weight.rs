//! A weight that is packed when it is loaded.

use super::format::WeightFormat;
use super::kernel::GemmKernel;
use super::panels::WordPanels;
use super::product::{Channels, Finish, Product};
use super::row_major::RowMajor;
use super::{quantise, select, words};
use crate::error::{Error, Result};
use crate::kernels::exec::{dims2, expect_dims, read, tensor};
use crate::kernels::written::written_parts;
use candle_core::{DType, Tensor};
use std::mem::MaybeUninit;

/// Largest inner dimension of bytes: the sum of so many products of 255 and 127 is below 2^31.
pub(super) const MAX_INT8_INPUTS: usize = 1 << 16;

/// A weight `[m, k]` (outputs, inputs, as checkpoints store it), packed for the CPU kernels.
///
/// Immutable, and for inference only: no gradient flows through its products.
///
/// Every output is one sum in a fixed order over the inner dimension, so that it depends neither on the number
/// of threads nor on how many rows are multiplied at once.
#[derive(Debug)]
pub struct PackedWeight {
    pub(super) panels: WordPanels,
    format: WeightFormat,
    /// Of each channel, where the format is [`WeightFormat::Int8`].
    pub(super) scales: Vec<f32>,
    /// 128 times the sum of each channel's bytes.
    pub(super) offsets: Vec<i32>,
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
    pub fn new(format: WeightFormat, parts: &[RowMajor<'_>]) -> Result<Self> {
        let k = parts.first().map_or(0, |part| part.dims().1);
        if let Some((_, other)) = parts.iter().map(RowMajor::dims).find(|dims| dims.1 != k) {
            return Err(Error::argument("inputs of joined weights", other, format!("{k} for all of them")));
        }
        let m = parts.iter().map(|part| part.dims().0).sum();
        pack_channels(format, parts, (m, k), |channel| {
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
        self.linear_by(&select::current(self.format), x, bias)
    }

    /// `r + (x W^T + b)`, rounded as the sum of the two is: `residual` `r` is `[n, m]`, the rest as for [`PackedWeight::linear`].
    /// No gradient flows, not through `residual` either.
    ///
    /// # Errors
    /// [`Error::Argument`] for another shape, type or device.
    pub fn linear_onto(&self, x: &Tensor, bias: Option<&Tensor>, residual: &Tensor) -> Result<Tensor> {
        let (m, _) = self.dims();
        let mut parts = self.multiply(&select::current(self.format), x, bias, Some(residual), &[m])?;
        parts.pop().ok_or_else(|| Error::argument("outputs", 0, "one part"))
    }

    /// The outputs of [`PackedWeight::linear`] in parts of these widths, `[n, width]` each; what the widths leave out at the end is not
    /// computed.
    ///
    /// # Errors
    /// [`Error::Argument`] for another shape, type or device, or widths of more than all outputs.
    pub fn linear_parts(&self, x: &Tensor, bias: Option<&Tensor>, widths: &[usize]) -> Result<Vec<Tensor>> {
        self.multiply(&select::current(self.format), x, bias, None, widths)
    }

    pub(super) fn linear_by(&self, kernel: &GemmKernel, x: &Tensor, bias: Option<&Tensor>) -> Result<Tensor> {
        let mut parts = self.multiply(kernel, x, bias, None, &[self.panels.m])?;
        parts.pop().ok_or_else(|| Error::argument("outputs", 0, "one part"))
    }

    pub(super) fn multiply(
        &self,
        kernel: &GemmKernel,
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
    pub(super) fn product(
        &self,
        kernel: &GemmKernel,
        x: &[f32],
        n: usize,
        widths: &[usize],
        finish: Finish<'_>,
    ) -> Vec<Vec<f32>> {
        let lens: Vec<usize> = widths.iter().map(|width| n * width).collect();
        // SAFETY: `product_into` writes every element.
        unsafe { written_parts(&lens, |parts| self.product_into(kernel, x, parts, widths, finish)) }
    }

    /// Writes every element of [`PackedWeight::product`]'s parts.
    pub(in crate::kernels) fn product_into(
        &self,
        kernel: &GemmKernel,
        x: &[f32],
        parts: &mut [&mut [MaybeUninit<f32>]],
        widths: &[usize],
        finish: Finish<'_>,
    ) {
        let (k, m) = (self.panels.k, widths.iter().sum());
        let finish = if kernel.signed { finish.without_offsets() } else { finish };
        let n = parts.iter().zip(widths).find(|(_, w)| **w > 0).map_or(0, |(part, w)| part.len() / w);
        let step = kernel.form.chunk_rows(k);
        for first in (0..n).step_by(step) {
            let rows = first..n.min(first + step);
            let room = parts.iter_mut().zip(widths);
            let mut room: Vec<_> = room.map(|(p, w)| &mut p[rows.start * w..rows.end * w]).collect();
            let residual = finish.residual.map(|r| &r[rows.start * m..rows.end * m]);
            let left = kernel.convert(&x[rows.start * k..rows.end * k], rows.len(), k);
            let finish = Finish { residual, ..finish };
            kernel.multiply(&Product { left: &left, panels: &self.panels, m, finish }, &mut room);
            left.recycle();
        }
    }

    /// What is done to the sums of this weight.
    pub(in crate::kernels) fn finish<'a>(&'a self, bias: Option<&'a [f32]>) -> Finish<'a> {
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

/// Packs `channels` rows of weights that all have `k` inputs; `at(channel)` says of which part the channel is which row, or that there is none.
///
/// # Errors
/// [`Error::Argument`] as [`PackedWeight::new`].
pub(super) fn pack_channels(
    format: WeightFormat,
    parts: &[RowMajor<'_>],
    (channels, k): (usize, usize),
    at: impl Fn(usize) -> Option<(usize, usize)> + Sync,
) -> Result<PackedWeight> {
    let row = |channel| at(channel).map(|(part, row): (usize, usize)| parts[part].row(row));
    match format {
        WeightFormat::F32 => Err(Error::argument("format of a packed weight", format, "bf16 or int8")),
        WeightFormat::Bf16 => {
            let (panels, _) = WordPanels::build(channels, k, 2, |channel, words| match row(channel) {
                Some(values) => values.pairs(words),
                None => words.fill(0),
            });
            Ok(PackedWeight { panels, format, scales: Vec::new(), offsets: Vec::new() })
        }
        WeightFormat::Int8 if k > MAX_INT8_INPUTS => {
            Err(Error::argument("inputs of an int8 weight", k, format!("at most {MAX_INT8_INPUTS}")))
        }
        WeightFormat::Int8 => {
            let (panels, sums) = WordPanels::build(channels, k, 4, |channel, words| match row(channel) {
                Some(values) => values.quantised(words),
                None => {
                    words.fill(0);
                    (0.0, 0)
                }
            });
            if let Some((part, row)) = sums.iter().position(|(scale, _)| scale.is_nan()).and_then(at) {
                let which = if parts.len() > 1 { format!(" of weight {part}") } else { String::new() };
                let found = format!("a value in row {row}{which} that is not finite");
                return Err(Error::argument("int8 weight", found, "finite values"));
            }
            let (scales, offsets) =
                sums.into_iter().map(|(scale, sum)| (scale, quantise::ZERO_POINT * sum)).unzip();
            Ok(PackedWeight { panels, format, scales, offsets })
        }
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
pub(in crate::kernels) fn read_some<R>(
    tensor: Option<&Tensor>,
    f: impl FnOnce(Option<&[f32]>) -> candle_core::Result<R>,
) -> candle_core::Result<R> {
    match tensor {
        Some(tensor) => read(tensor, |values| f(Some(values))),
        None => f(None),
    }
}

/// Checks that a tensor is what the packed kernels read.
pub(in crate::kernels) fn expect_cpu_f32(name: &'static str, tensor: &Tensor) -> Result<()> {
    if tensor.device().is_cpu() && tensor.dtype() == DType::F32 {
        return Ok(());
    }
    let found = format!("{:?} on {:?}", tensor.dtype(), tensor.device().location());
    Err(Error::argument(name, found, "F32 on the CPU"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::gemm::packed::tests::{every_kernel, packed_as};
    use crate::kernels::testing::{random, values};
    use WeightFormat::{Bf16, Int8};
    use half::bf16;

    fn bytes(values: &[f32]) -> Vec<u8> {
        values.iter().flat_map(|v| bf16::from_f32(*v).to_le_bytes()).collect()
    }

    #[test]
    fn joined_weights_give_the_outputs_of_each_in_turn() {
        let (n, k, sizes) = (7, 45, [33usize, 0, 16, 70]);
        let all: Vec<Vec<f32>> =
            sizes.iter().zip(1..).map(|(&m, seed)| values(&random(&[m, k], seed))).collect();
        let x = random(&[n, k], 9);
        for format in [Bf16, Int8] {
            let parts: Vec<RowMajor> =
                all.iter().zip(sizes).map(|(w, m)| RowMajor::f32(w, m, k).unwrap()).collect();
            let joined = PackedWeight::new(format, &parts).unwrap();
            assert_eq!((joined.dims(), joined.format()), ((sizes.iter().sum(), k), format));
            for kernel in every_kernel(format) {
                let found = joined.linear_by(&kernel, &x, None).unwrap();
                let mut first = 0;
                for (w, m) in all.iter().zip(sizes) {
                    let alone = packed_as(format, w, m, k).linear_by(&kernel, &x, None).unwrap();
                    let part = found.narrow(1, first, m).unwrap();
                    assert_eq!(values(&part), values(&alone), "{} {format} {m}", kernel.name);
                    first += m;
                }
            }
        }
    }

    #[test]
    fn bf16_is_packed_as_the_values_it_stands_for() {
        for (m, k) in [(1, 1), (33, 7), (40, 300)] {
            let stored = bytes(&values(&random(&[m, k], 4)));
            let widened: Vec<f32> =
                stored.as_chunks::<2>().0.iter().map(|b| bf16::from_le_bytes(*b).to_f32()).collect();
            // An odd address, as a memory map may give.
            let moved = [vec![0], stored].concat();
            for format in [Bf16, Int8] {
                let weight =
                    PackedWeight::new(format, &[RowMajor::bf16(&moved[1..], m, k).unwrap()]).unwrap();
                let same = packed_as(format, &widened, m, k);
                assert_eq!(weight.panels.words(), same.panels.words(), "{format} {m}x{k}");
                assert_eq!((weight.scales, weight.offsets), (same.scales, same.offsets));
            }
        }
    }

    #[test]
    fn what_does_not_fit_is_an_error() {
        assert!(RowMajor::bf16(&[0; 11], 2, 3).is_err());
        assert!(RowMajor::bf16(&[0; 13], 2, 3).is_err());
        assert!(RowMajor::bf16(&[], usize::MAX / 3, 3).is_err());
        assert!(RowMajor::f32(&[0.0; 5], 2, 3).is_err());
        assert!(RowMajor::f32(&[0.0; 5], usize::MAX, 3).is_err());
        let (two, three) = ([0f32; 6], [0f32; 9]);
        let rows = |values, m, k| RowMajor::f32(values, m, k).unwrap();
        let (wide, narrow) = (rows(&two, 2, 3), rows(&two, 3, 2));
        assert!(PackedWeight::new(WeightFormat::F32, &[wide]).is_err());
        let error = PackedWeight::new(Bf16, &[wide, narrow]).unwrap_err().to_string();
        assert!(error.contains('2') && error.contains('3'), "{error}");
        assert_eq!(PackedWeight::new(Bf16, &[]).unwrap().dims(), (0, 0));
        let long = vec![0f32; MAX_INT8_INPUTS + 1];
        assert!(PackedWeight::new(Int8, &[rows(&long, 1, MAX_INT8_INPUTS + 1)]).is_err());
        let bad = [0.0, 1.0, 2.0, 3.0, f32::NAN, 5.0];
        let message = |parts: &[RowMajor]| PackedWeight::new(Int8, parts).unwrap_err().to_string();
        assert!(message(&[rows(&bad, 2, 3)]).contains("row 1 that"));
        assert!(message(&[rows(&three, 3, 3), rows(&bad, 2, 3)]).contains("row 1 of weight 1 that"));
    }
}
