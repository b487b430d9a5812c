//! What is read of one answer.

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

impl Reading {
    /// No readable number.
    pub const INVALID: Self = Self { value: f32::NAN, confidence: 0.0, expected_error: f32::NAN };
}

/// Half-width of the interval whose probability is the confidence, relative to the answer.
pub(crate) const CONFIDENT_WITHIN: f32 = 0.05;
