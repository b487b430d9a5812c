//! What is read of one answer.

use crate::error::{Error, Result};
use std::str::FromStr;

/// What one answer says.
///
/// What [`Bins`](super::bins::Bins) and [`DigitReader`](super::number::DigitReader) read is in number units, of which the frame's
/// [`FrameSpace::unit`](super::FrameSpace) says the metres. What `model::ask` returns, and all that follows it, is in metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reading {
    /// Of bins the median or the mean of the distribution, as [`Readout`] says; of digits and words the number that was said.
    /// NaN if nothing could be read.
    pub value: f32,
    /// Probability that the truth lies within 5 % of `value` (of bins: and at least one bin), as the model sees it; in 0..=1, higher is
    /// surer.
    pub confidence: f32,
    /// Expected absolute error, same unit as `value`.
    pub expected_error: f32,
}

/// Which number of a distribution is the answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Readout {
    /// The median: the least mean absolute error, and edges that stay sharp.
    #[default]
    Median,
    /// The mean: the least mean squared error. Where the model doubts between two surfaces it lies between them.
    Mean,
}

impl FromStr for Readout {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        match text {
            "median" => Ok(Self::Median),
            "mean" => Ok(Self::Mean),
            _ => Err(Error::argument("readout", text, "median or mean")),
        }
    }
}

impl std::fmt::Display for Readout {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Median => "median",
            Self::Mean => "mean",
        })
    }
}

impl Reading {
    /// No readable number.
    pub const INVALID: Self = Self { value: f32::NAN, confidence: 0.0, expected_error: f32::NAN };
}
