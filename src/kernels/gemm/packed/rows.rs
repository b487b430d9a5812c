//! Weights as they are at hand, and how their rows become the channels of packed ones.

use super::panel::Panels;
use super::{PackedWeight, WeightFormat, quantise, words};
use crate::error::{Error, Result};
use half::bf16;

/// Largest inner dimension of bytes: the sum of so many products of 255 and 127 is below 2^31.
pub(in crate::kernels) const LONGEST_INT8: usize = 1 << 16;

/// A weight `[m, k]` (outputs, inputs) that is to be packed, row-major.
#[derive(Clone, Copy, Debug)]
pub struct Rows<'a> {
    values: Values<'a>,
    m: usize,
    k: usize,
}

#[derive(Clone, Copy, Debug)]
enum Values<'a> {
    F32(&'a [f32]),
    /// Little-endian, of any alignment.
    Bf16(&'a [u8]),
}

impl<'a> Rows<'a> {
    /// `m * k` values.
    ///
    /// # Errors
    /// [`Error::BufferLength`] where there are more or fewer; [`Error::Argument`] where `k` is 0 and `m` above 2^32.
    pub fn f32(values: &'a [f32], m: usize, k: usize) -> Result<Self> {
        expect_rows(m, k)?;
        expect_length("weight", values.len(), m.checked_mul(k))?;
        Ok(Rows { values: Values::F32(values), m, k })
    }

    /// `m * k` little-endian bf16, as a safetensors file holds them; any alignment.
    ///
    /// # Errors
    /// [`Error::BufferLength`] where there are more or fewer than two bytes for each; [`Error::Argument`] where `k` is 0 and `m` above 2^32.
    pub fn bf16(bytes: &'a [u8], m: usize, k: usize) -> Result<Self> {
        expect_rows(m, k)?;
        expect_length("bf16 weight, in bytes", bytes.len(), m.checked_mul(k).and_then(|n| n.checked_mul(2)))?;
        Ok(Rows { values: Values::Bf16(bytes), m, k })
    }

    /// Outputs and inputs `(m, k)`.
    pub fn dims(&self) -> (usize, usize) {
        (self.m, self.k)
    }

    fn row(&self, row: usize) -> Values<'a> {
        match self.values {
            Values::F32(values) => Values::F32(&values[row * self.k..(row + 1) * self.k]),
            Values::Bf16(bytes) => Values::Bf16(&bytes[2 * row * self.k..2 * (row + 1) * self.k]),
        }
    }
}

/// Without inputs, no length tells whether the outputs can be.
fn expect_rows(m: usize, k: usize) -> Result<()> {
    if k == 0 && m > u32::MAX as usize {
        return Err(Error::argument(
            "outputs of a weight without inputs",
            m,
            format!("at most {}", u32::MAX),
        ));
    }
    Ok(())
}

fn expect_length(what: &'static str, found: usize, expected: Option<usize>) -> Result<()> {
    match expected {
        Some(expected) if expected == found => Ok(()),
        expected => Err(Error::BufferLength { what, expected: expected.unwrap_or(usize::MAX), found }),
    }
}

impl Values<'_> {
    /// Words of two bf16 each, rounded where the values are not.
    fn pairs(self, words: &mut [u32]) {
        match self {
            Values::F32(values) => words::from_f32(values, words),
            Values::Bf16(bytes) => words::from_bf16_bytes(bytes, words),
        }
    }

    /// Words of four bytes each; gives their scale and their sum.
    fn quantised(self, words: &mut [u32]) -> (f32, i32) {
        match self {
            Values::F32(values) => quantise::weight_row(values, words),
            Values::Bf16(bytes) => {
                let values = bytes.as_chunks::<2>().0.iter().map(|b| bf16::from_le_bytes(*b).to_f32());
                quantise::weight_row(&values.collect::<Vec<_>>(), words)
            }
        }
    }
}

/// Packs `channels` rows of weights that all have `k` inputs; `at(channel)` says of which part the channel is which row, or that there is none.
///
/// # Errors
/// [`Error::Argument`] as [`PackedWeight::new`].
pub(in crate::kernels) fn pack(
    format: WeightFormat,
    parts: &[Rows<'_>],
    (channels, k): (usize, usize),
    at: impl Fn(usize) -> Option<(usize, usize)> + Sync,
) -> Result<PackedWeight> {
    let row = |channel| at(channel).map(|(part, row): (usize, usize)| parts[part].row(row));
    match format {
        WeightFormat::F32 => Err(Error::argument("format of a packed weight", format, "bf16 or int8")),
        WeightFormat::Bf16 => {
            let (panels, _) = Panels::build(channels, k, 2, |channel, words| match row(channel) {
                Some(values) => values.pairs(words),
                None => words.fill(0),
            });
            Ok(PackedWeight { panels, format, scales: Vec::new(), offsets: Vec::new() })
        }
        WeightFormat::Int8 if k > LONGEST_INT8 => {
            Err(Error::argument("inputs of an int8 weight", k, format!("at most {LONGEST_INT8}")))
        }
        WeightFormat::Int8 => {
            let (panels, sums) = Panels::build(channels, k, 4, |channel, words| match row(channel) {
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
                sums.into_iter().map(|(scale, sum)| (scale, quantise::ZERO * sum)).unzip();
            Ok(PackedWeight { panels, format, scales, offsets })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{every_kernel, packed_as};
    use super::*;
    use crate::kernels::testing::{random, values};
    use WeightFormat::{Bf16, Int8};

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
            let parts: Vec<Rows> = all.iter().zip(sizes).map(|(w, m)| Rows::f32(w, m, k).unwrap()).collect();
            let joined = PackedWeight::new(format, &parts).unwrap();
            assert_eq!((joined.dims(), joined.format()), ((sizes.iter().sum(), k), format));
            for kernel in every_kernel(format) {
                let found = joined.linear_by(kernel, &x, None).unwrap();
                let mut first = 0;
                for (w, m) in all.iter().zip(sizes) {
                    let alone = packed_as(format, w, m, k).linear_by(kernel, &x, None).unwrap();
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
                let weight = PackedWeight::new(format, &[Rows::bf16(&moved[1..], m, k).unwrap()]).unwrap();
                let same = packed_as(format, &widened, m, k);
                assert_eq!(weight.panels.words(), same.panels.words(), "{format} {m}x{k}");
                assert_eq!((weight.scales, weight.offsets), (same.scales, same.offsets));
            }
        }
    }

    #[test]
    fn what_does_not_fit_is_an_error() {
        assert!(Rows::bf16(&[0; 11], 2, 3).is_err());
        assert!(Rows::bf16(&[0; 13], 2, 3).is_err());
        assert!(Rows::bf16(&[], usize::MAX / 3, 3).is_err());
        assert!(Rows::f32(&[0.0; 5], 2, 3).is_err());
        assert!(Rows::f32(&[0.0; 5], usize::MAX, 3).is_err());
        let (two, three) = ([0f32; 6], [0f32; 9]);
        let rows = |values, m, k| Rows::f32(values, m, k).unwrap();
        let (wide, narrow) = (rows(&two, 2, 3), rows(&two, 3, 2));
        assert!(PackedWeight::new(WeightFormat::F32, &[wide]).is_err());
        let error = PackedWeight::new(Bf16, &[wide, narrow]).unwrap_err().to_string();
        assert!(error.contains('2') && error.contains('3'), "{error}");
        assert_eq!(PackedWeight::new(Bf16, &[]).unwrap().dims(), (0, 0));
        let long = vec![0f32; LONGEST_INT8 + 1];
        assert!(PackedWeight::new(Int8, &[rows(&long, 1, LONGEST_INT8 + 1)]).is_err());
        let bad = [0.0, 1.0, 2.0, 3.0, f32::NAN, 5.0];
        let message = |parts: &[Rows]| PackedWeight::new(Int8, parts).unwrap_err().to_string();
        assert!(message(&[rows(&bad, 2, 3)]).contains("row 1 that"));
        assert!(message(&[rows(&three, 3, 3), rows(&bad, 2, 3)]).contains("row 1 of weight 1 that"));
    }
}
