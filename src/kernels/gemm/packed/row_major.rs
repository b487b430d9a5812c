//! Weights that are to be packed, as they lie in memory.

use super::{quantise, words};
use crate::error::{Error, Result};
use half::bf16;

/// A weight `[m, k]` (outputs, inputs) that is to be packed, row-major.
#[derive(Clone, Copy, Debug)]
pub struct RowMajor<'a> {
    values: Values<'a>,
    m: usize,
    k: usize,
}

/// Some values in a row.
#[derive(Clone, Copy, Debug)]
pub(super) enum Values<'a> {
    F32(&'a [f32]),
    /// Little-endian, of any alignment.
    Bf16(&'a [u8]),
}

impl<'a> RowMajor<'a> {
    /// `m * k` values.
    ///
    /// # Errors
    /// [`Error::BufferLength`] where there are more or fewer; [`Error::Argument`] where `k` is 0 and `m` above 2^32.
    pub fn f32(values: &'a [f32], m: usize, k: usize) -> Result<Self> {
        expect_rows(m, k)?;
        expect_length("weight", values.len(), m.checked_mul(k))?;
        Ok(RowMajor { values: Values::F32(values), m, k })
    }

    /// `m * k` little-endian bf16, as a safetensors file holds them; any alignment.
    ///
    /// # Errors
    /// [`Error::BufferLength`] where there are more or fewer than two bytes for each; [`Error::Argument`] where `k` is 0 and `m` above 2^32.
    pub fn bf16(bytes: &'a [u8], m: usize, k: usize) -> Result<Self> {
        expect_rows(m, k)?;
        expect_length("bf16 weight, in bytes", bytes.len(), m.checked_mul(k).and_then(|n| n.checked_mul(2)))?;
        Ok(RowMajor { values: Values::Bf16(bytes), m, k })
    }

    /// Outputs and inputs `(m, k)`.
    pub fn dims(&self) -> (usize, usize) {
        (self.m, self.k)
    }

    pub(super) fn row(&self, row: usize) -> Values<'a> {
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
    pub(super) fn pairs(self, words: &mut [u32]) {
        match self {
            Values::F32(values) => words::from_f32(values, words),
            Values::Bf16(bytes) => words::from_bf16_bytes(bytes, words),
        }
    }

    /// Words of four bytes each; gives their scale and their sum.
    pub(super) fn quantised(self, words: &mut [u32]) -> (f32, i32) {
        match self {
            Values::F32(values) => quantise::weight_row(values, words),
            Values::Bf16(bytes) => {
                let values = bytes.as_chunks::<2>().0.iter().map(|b| bf16::from_le_bytes(*b).to_f32());
                quantise::weight_row(&values.collect::<Vec<_>>(), words)
            }
        }
    }
}
