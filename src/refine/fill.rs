//! What a way of filling is given and gives.

use crate::depth::SparseDepth;
use crate::error::Result;
use image::RgbImage;

/// What the model said about one pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Answered {
    /// Column.
    pub x: usize,
    /// Row.
    pub y: usize,
    /// Z-depth, metres. NaN, infinite, 0 or negative: no readable answer, the pixel is filled like one not asked.
    pub depth: f32,
    /// 0..=1, higher is surer.
    pub confidence: f32,
    /// Expected absolute error, metres.
    pub expected_error: f32,
}

/// All that a [`Fill`] may look at.
#[derive(Debug, Clone, Copy)]
pub struct FillInput<'a> {
    /// Width of the frame, pixels.
    pub width: usize,
    /// Height of the frame, pixels.
    pub height: usize,
    /// The frame.
    pub rgb: &'a RgbImage,
    /// The answers, in any order. Of several for one pixel the last counts.
    pub asked: &'a [Answered],
    /// The measurements; they count as answers with confidence 1 and outrank the model's.
    pub sparse: &'a SparseDepth,
}

/// A value per pixel, row-major.
///
/// Every pixel is filled if there is at least one answer or measurement; otherwise depth and expected error are NaN and
/// confidence is 0 everywhere.
#[derive(Debug, Clone)]
pub struct Filled {
    /// Z-depth, metres.
    pub depth: Vec<f32>,
    /// 0..=1, higher is surer.
    pub confidence: Vec<f32>,
    /// Expected absolute error, metres.
    pub expected_error: Vec<f32>,
}

/// A way to fill the pixels that were not asked.
pub trait Fill: Send + Sync {
    /// Fills a frame. Answered and measured pixels keep their values bit for bit.
    ///
    /// # Errors
    /// [`crate::Error::SizeMismatch`], [`crate::Error::ImageSize`] for an empty frame, [`crate::Error::Argument`] for an answer outside the frame or
    /// with a confidence or expected error out of range.
    fn fill(&self, input: &FillInput) -> Result<Filled>;
}
