//! What is expected of a frame before it is looked at.

/// Neighbouring pixels with a larger ratio of their depths lie on different surfaces.
pub(crate) const SAME_SURFACE: f32 = 1.06;

/// A map of a frame that is expected before anything is asked about it: the last frame's, moved along with the camera.
#[derive(Debug, Clone)]
pub(crate) struct Prior {
    /// Z-depth, metres, row-major; NaN where nothing is expected.
    pub(crate) depth: Vec<f32>,
    /// 0..=1, of pixels with a depth.
    pub(crate) confidence: Vec<f32>,
    /// Metres, of pixels with a depth.
    pub(crate) expected_error: Vec<f32>,
    /// How many frames came before: it decides which part of the lattice is asked as a check.
    pub(crate) turn: usize,
}

impl Prior {
    /// Nothing is expected.
    pub(crate) fn unknown(pixels: usize, turn: usize) -> Self {
        Self {
            depth: vec![f32::NAN; pixels],
            confidence: vec![0.0; pixels],
            expected_error: vec![f32::NAN; pixels],
            turn,
        }
    }
}
