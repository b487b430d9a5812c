//! How a model says a number: digit by digit, or as one token of its own.

use rayon::prelude::*;
use sdim::WeightFormat;
use sdim::internals::kernels::{self, Middle};
use sdim::internals::query::bins::{Bins, Spacing};
use sdim::internals::vlm::layers::matrix::Matrix;
use sdim::internals::vlm::qwen2_5::QwenVl;
use sdim::internals::vlm::qwen2_5::sequences::Sequences;
use sdim::internals::vlm::qwen2_5::token_table::FIRST_ADDED;
use std::str::FromStr;

/// How numbers are said.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Numbers {
    Digits,
    Bins,
}

impl FromStr for Numbers {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "digits" => Ok(Self::Digits),
            "bins" => Ok(Self::Bins),
            _ => Err("digits or bins".into()),
        }
    }
}

impl std::fmt::Display for Numbers {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(if *self == Self::Digits { "digits" } else { "bins" })
    }
}

/// The rows of the head that numbers are read from, and how.
pub struct Answers {
    ids: Vec<u32>,
    rows: Matrix,
    /// Of digits, how many an answer has.
    digits: Option<usize>,
}

impl Answers {
    pub fn digits(model: &QwenVl, digits: usize, format: WeightFormat) -> anyhow::Result<Self> {
        let ids: Vec<u32> = (13..24).collect();
        Ok(Self { rows: model.decoder.head_of(&ids, format)?, ids, digits: Some(digits) })
    }

    /// As one of so many tokens behind the model's vocabulary, which has them.
    pub fn bins(model: &QwenVl, bins: usize, format: WeightFormat) -> anyhow::Result<Self> {
        let ids: Vec<u32> = (FIRST_ADDED..).take(bins).collect();
        Ok(Self { rows: model.decoder.head_of(&ids, format)?, ids, digits: None })
    }

    /// Passes of the decoder for one answer, that of the question included.
    pub fn passes(&self) -> usize {
        self.digits.unwrap_or(1)
    }

    /// Rows of the head that each of them multiplies.
    pub fn rows(&self) -> usize {
        self.ids.len()
    }

    /// The `i`-th token of questions: as a checkpoint with a hint asks, with a number.
    pub fn asking(&self, i: usize) -> u32 {
        self.ids[i % self.ids.len()]
    }

    /// Reads the answers of a batch, all of their tokens: greedily digit by digit, step after step; or the median of the bins, with its
    /// confidence and expected error, found where the logits are.
    pub fn read(&self, sequences: &mut Sequences, into: &mut Vec<u32>) -> anyhow::Result<()> {
        let Some(digits) = self.digits else { return self.read_bins(sequences, into) };
        for digit in 0..digits {
            if digit > 0 {
                let ids = into[into.len() - sequences.count()..].to_vec();
                sequences.decode_step(&ids)?;
            }
            let best = self.rows.linear(sequences.last(), None)?.argmax(1)?.to_vec1::<u32>()?;
            into.extend(best.into_iter().map(|i| self.ids[i as usize]));
        }
        Ok(())
    }

    fn read_bins(&self, sequences: &Sequences, into: &mut Vec<u32>) -> anyhow::Result<()> {
        let bins = Bins { count: self.ids.len(), spacing: Spacing::Ratio { lowest: 0.0625, highest: 16.0 } };
        let logits = self.rows.linear(sequences.last(), None)?;
        if !logits.device().is_cpu() {
            let stats = kernels::bin_stats_of_rows(&logits, Middle::Median, |at| bins.tolerance(at))?;
            into.extend(stats.into_iter().map(|s| s.map_or(f32::NAN, |s| bins.reading(s).value).to_bits()));
            return Ok(());
        }
        let logits: Vec<f32> = logits.flatten_all()?.to_vec1()?;
        let rows = logits.par_chunks(self.ids.len());
        into.par_extend(rows.map_init(Vec::new, |scratch, row| bins.read(row, scratch).value.to_bits()));
        Ok(())
    }
}
