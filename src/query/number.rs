//! Numbers as tokens: how a depth is written into a prompt, and how an answer is read from logits.

use super::bins::{Bins, Spacing};
use super::reading::Reading;
use crate::depth::SparseDepth;
use crate::depth::pixels::CONFIDENT_WITHIN;
use crate::error::{Error, Result};
use crate::vlm::chat::tokenizer::Tokenizer;
use crate::vlm::qwen2_5::token_table::FIRST_ADDED;

/// What the number 1 means in prompts and answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DepthUnit {
    /// One metre.
    Metres,
    /// A hundredth of a metre.
    Centimetres,
    /// A thousandth of a metre.
    Millimetres,
    /// The frame's largest measurement.
    FrameMax,
    /// The median of the frame's measurements, which a few wrong ones do not move.
    FrameMedian,
}

impl DepthUnit {
    /// Metres of the number 1 where it is the same in every frame.
    pub fn metres(self) -> Option<f32> {
        match self {
            Self::Metres => Some(1.0),
            Self::Centimetres => Some(0.01),
            Self::Millimetres => Some(0.001),
            Self::FrameMax | Self::FrameMedian => None,
        }
    }

    /// Metres of the number 1 in a frame with these measurements; 1 where the frame decides but has none.
    pub fn metres_in(self, sparse: &SparseDepth) -> f32 {
        let metres = match self {
            Self::Metres | Self::Centimetres | Self::Millimetres => self.metres(),
            Self::FrameMax => sparse.max(),
            Self::FrameMedian => sparse.median(),
        };
        metres.unwrap_or(1.0)
    }
}

/// How a number is written, a property of the checkpoint.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum NumberFormat {
    /// One token per depth bin, `<|d0|>` to `<|d{bins-1}|>`, over 0 .. `range` units.
    Bins {
        /// Number of bins.
        bins: usize,
        /// Upper end of the last bin, in [`DepthUnit`]s.
        range: f64,
    },
    /// One token per depth bin, `<|d0|>` to `<|d{bins-1}|>`, from `lowest` to `highest` units, each wider than the one before it
    /// by the same factor: as fine near as far, and a frame of 2 m and a street of 100 m have room.
    LogBins {
        /// Number of bins.
        bins: usize,
        /// Lower end of the first bin, in [`DepthUnit`]s, above 0.
        lowest: f64,
        /// Upper end of the last bin, in [`DepthUnit`]s.
        highest: f64,
    },
    /// Decimal digits, one token each, with a fixed number of decimals ("4.230").
    Digits {
        /// Digits after the point.
        decimals: usize,
        /// Digits before the point, at most.
        integers: usize,
    },
}

/// Where the tokens of numbers that are bins come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NumberTokens {
    /// `tokenizer.json` has them by their names.
    #[default]
    Vocabulary,
    /// They have no text: each is a row of `sdim.number_tokens.embedding` and, unless the base ties its head to the embedding, of
    /// `sdim.number_tokens.head`, both `[bins, hidden]`. So a published checkpoint gets them from an adapter.
    Rows,
}

impl NumberTokens {
    /// The tensors that hold [`NumberTokens::Rows`], without their last part.
    pub(crate) const NAME: &str = "sdim.number_tokens";

    pub(crate) fn in_vocabulary(&self) -> bool {
        *self == Self::Vocabulary
    }

    /// Checks that only bins have rows.
    ///
    /// # Errors
    /// [`Error::Config`] names the field of `sdim.json`.
    pub(super) fn validate(self, file: &str, format: NumberFormat) -> Result<()> {
        if self.in_vocabulary() || format.bins().is_some() {
            return Ok(());
        }
        let expected = "\"vocabulary\", since numbers are digits; or bins as `number`";
        Err(Error::config(file, "number_tokens", "rows", expected))
    }
}

/// A number format with the ids of its tokens.
#[derive(Debug, Clone)]
pub struct Numbers {
    /// How numbers are written.
    pub format: NumberFormat,
    /// Token ids: one per bin, from [`FIRST_ADDED`] on where they are rows of their own; or `0` to `9` and the point.
    pub ids: Vec<u32>,
}

/// Index of the decimal point among the rows of a [`NumberFormat::Digits`] head.
pub const POINT: usize = 10;

impl NumberFormat {
    /// Checks the sizes of a configuration.
    ///
    /// # Errors
    /// [`Error::Config`] names the field of `sdim.json`.
    #[doc(hidden)]
    pub fn validate(&self, file: &str) -> Result<()> {
        let (key, found, ok, expected) = match *self {
            NumberFormat::Bins { bins, range } => (
                "number.bins",
                format!("{bins} bins over {range}"),
                (2..=100_000).contains(&bins) && range.is_finite() && range > 0.0,
                "2 to 100000 bins over a positive range",
            ),
            NumberFormat::LogBins { bins, lowest, highest } => (
                "number.bins",
                format!("{bins} bins from {lowest} to {highest}"),
                (2..=100_000).contains(&bins) && lowest >= 1e-6 && lowest < highest && highest <= 1e6,
                "2 to 100000 bins from a number to a larger one, both within 0.000001 to 1000000",
            ),
            NumberFormat::Digits { decimals, integers } => (
                "number.decimals",
                format!("{integers}.{decimals}"),
                (1..=6).contains(&decimals) && (1..=6).contains(&integers),
                "1 to 6 digits before and after the point",
            ),
        };
        if ok { Ok(()) } else { Err(Error::config(file, key, found, expected)) }
    }

    /// The bins, where numbers are bins.
    #[doc(hidden)]
    pub fn bins(&self) -> Option<Bins> {
        match *self {
            Self::Bins { bins, range } => Some(Bins { count: bins, spacing: Spacing::Equal { range } }),
            Self::LogBins { bins, lowest, highest } => {
                Some(Bins { count: bins, spacing: Spacing::Ratio { lowest, highest } })
            }
            Self::Digits { .. } => None,
        }
    }
}

impl Numbers {
    /// Looks the tokens up.
    ///
    /// # Errors
    /// [`Error::Tokenizer`] names a token that the vocabulary lacks.
    pub fn new(format: NumberFormat, tokens: NumberTokens, tokenizer: &Tokenizer) -> Result<Self> {
        let ids = match format.bins() {
            Some(bins) if tokens == NumberTokens::Rows => (FIRST_ADDED..).take(bins.count).collect(),
            Some(bins) => (0..bins.count).map(|k| tokenizer.id(&bin_token(k))).collect::<Result<_>>()?,
            None => "0123456789.".chars().map(|c| tokenizer.id(&c.to_string())).collect::<Result<_>>()?,
        };
        Ok(Self { format, ids })
    }

    /// The tokens of a value in units, as indices into `ids`. Values out of range are clamped, NaN is 0.
    pub fn write(&self, value: f32) -> Vec<usize> {
        let value = if value.is_nan() { 0.0 } else { value };
        match self.format {
            NumberFormat::Bins { .. } | NumberFormat::LogBins { .. } => {
                self.format.bins().map(|b| b.bin(value)).into_iter().collect()
            }
            NumberFormat::Digits { decimals, integers } => {
                let limit = 10f64.powi(integers as i32) - 10f64.powi(-(decimals as i32));
                format!("{:.decimals$}", f64::from(value).clamp(0.0, limit))
                    .bytes()
                    .map(|b| if b == b'.' { POINT } else { usize::from(b - b'0') })
                    .collect()
            }
        }
    }

    /// What the fusion block sees of a measured number, above 0: the number itself; its place among bins of equal ratio, as a
    /// share of them, so that no measurement is far from the others.
    pub fn seen(&self, value: f32) -> f32 {
        match self.format {
            NumberFormat::LogBins { .. } => self.format.bins().map_or(value, |bins| {
                let count = bins.count as f64;
                (bins.position(value).max(1.0) / count) as f32
            }),
            _ => value,
        }
    }

    /// The number that one token states: the middle of its bin. NaN for a digit, which states none, and for any other token.
    pub fn stated(&self, id: u32) -> f32 {
        let Some(bins) = self.format.bins() else { return f32::NAN };
        // They follow each other in all vocabularies but odd ones.
        let guess = self.ids.first().and_then(|first| id.checked_sub(*first)).map(|k| k as usize);
        let guess = guess.filter(|&k| self.ids.get(k) == Some(&id));
        let bin = guess.or_else(|| self.ids.iter().position(|&own| own == id));
        bin.map_or(f32::NAN, |k| bins.number(k as f32 + 0.5))
    }

    /// Like [`Numbers::write`], as token ids.
    pub fn write_ids(&self, value: f32) -> Vec<u32> {
        self.write(value).into_iter().map(|i| self.ids[i]).collect()
    }
}

/// Name of a bin's token.
pub fn bin_token(bin: usize) -> String {
    format!("<|d{bin}|>")
}

/// Reads a number from its digits' distributions as they were chosen one after the other.
///
/// Digits at places worth at most 5 % of the value do not count against the confidence.
#[derive(Debug, Clone)]
pub struct DigitReader {
    format: (usize, usize),
    chosen: Vec<usize>,
    steps: Vec<[f32; 11]>,
}

impl DigitReader {
    /// Starts a number with this many decimals and at most this many digits before the point.
    pub fn new(decimals: usize, integers: usize) -> Self {
        Self { format: (decimals, integers), chosen: Vec::new(), steps: Vec::new() }
    }

    fn point_at(&self) -> Option<usize> {
        self.chosen.iter().position(|&c| c == POINT)
    }

    /// Whether all decimals are there.
    pub fn done(&self) -> bool {
        self.point_at().is_some_and(|p| self.chosen.len() == p + 1 + self.format.0)
    }

    /// Which of the 11 rows may come next.
    fn allowed(&self) -> [bool; 11] {
        let mut allowed = [true; 11];
        match self.point_at() {
            Some(_) => allowed[POINT] = false,
            None if self.chosen.is_empty() => allowed[POINT] = false,
            None if self.chosen.len() >= self.format.1 || self.chosen == [0] => {
                allowed = [false; 11];
                allowed[POINT] = true;
            }
            None => {}
        }
        allowed
    }

    /// Takes the logits of the 11 rows, chooses the likeliest allowed one and returns its index; `None` if the logits
    /// are not numbers.
    pub fn push(&mut self, logits: &[f32]) -> Option<usize> {
        let allowed = self.allowed();
        let max = (0..11).filter(|&i| allowed[i]).map(|i| logits[i]).fold(f32::NEG_INFINITY, f32::max);
        if !max.is_finite() || logits.iter().any(|l| l.is_nan()) {
            return None;
        }
        let mut p = [0f32; 11];
        for i in 0..11 {
            p[i] = if allowed[i] { (logits[i] - max).exp() } else { 0.0 };
        }
        let total: f32 = p.iter().sum();
        p.iter_mut().for_each(|v| *v /= total);
        let best = (0..11).fold(0, |b, i| if p[i] > p[b] { i } else { b });
        self.chosen.push(best);
        self.steps.push(p);
        Some(best)
    }

    /// The number, once [`DigitReader::done`].
    pub fn reading(&self) -> Reading {
        let Some(point) = self.point_at().filter(|_| self.done()) else {
            return Reading::INVALID;
        };
        let place = |i: usize| {
            let exponent = if i < point { point as i32 - 1 - i as i32 } else { point as i32 - i as i32 };
            10f32.powi(exponent)
        };
        let digits = || (0..self.chosen.len()).filter(|&i| i != point);
        let value: f32 = digits().map(|i| self.chosen[i] as f32 * place(i)).sum();
        let (mut confidence, mut error) = (1f32, 0f32);
        for i in 0..self.chosen.len() {
            let p = &self.steps[i];
            let weight = if i == point { 1.0 } else { place(i) };
            if i == point || weight > value * CONFIDENT_WITHIN {
                confidence *= p[self.chosen[i]];
            }
            if i != point {
                error += (0..10).map(|d| p[d] * d.abs_diff(self.chosen[i]) as f32).sum::<f32>() * weight;
            }
        }
        Reading { value, confidence, expected_error: error }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digits_follow_the_grammar() {
        let mut reader = DigitReader::new(3, 2);
        // The point is likeliest from the start on, but a number cannot begin with it, nor have two of them.
        let mut logits = [0f32; 11];
        logits[POINT] = 9.0;
        logits[4] = 5.0;
        assert_eq!(reader.push(&logits), Some(4));
        assert_eq!(reader.push(&logits), Some(POINT));
        for _ in 0..3 {
            assert!(!reader.done());
            assert_eq!(reader.push(&logits), Some(4));
        }
        assert!(reader.done());
        let r = reader.reading();
        assert!((r.value - 4.444).abs() < 1e-5);
        assert!(r.confidence > 0.5 && r.confidence < 1.0 && r.expected_error > 0.0);
        assert_eq!(reader.push(&[f32::NAN; 11]), None);
    }

    #[test]
    fn a_long_integer_part_is_closed_by_the_point() {
        let mut reader = DigitReader::new(1, 2);
        let nines: [f32; 11] = std::array::from_fn(|i| if i == 9 { 9.0 } else { 0.0 });
        let chosen: Vec<_> = (0..4).map(|_| reader.push(&nines).unwrap()).collect();
        assert_eq!(chosen, [9, 9, POINT, 9]);
        assert!((reader.reading().value - 99.9).abs() < 1e-4);
    }
}
