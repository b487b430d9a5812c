//! What is read of one answer.

use crate::error::{Error, Result};
use std::str::FromStr;

/// An answer in units of the frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reading {
    /// Median of the distribution; NaN if nothing could be read.
    pub value: f32,
    /// Probability that the truth lies within 5 % of `value`, as the model sees it; in 0..=1, higher is surer.
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

/// Half-width of the interval whose probability is the confidence, relative to the answer.
pub(crate) const CONFIDENT_WITHIN: f32 = 0.05;
