//! The normalisation of both towers.

use crate::error::Result;
use crate::kernels;
use crate::vlm::checkpoint::weights::Weights;
use candle_core::Tensor;

/// RMSNorm with its weight; eps differs between the vision encoder (1e-6, fixed) and the decoder (config).
pub struct RmsNorm {
    weight: Tensor,
    eps: f64,
}

impl RmsNorm {
    /// Reads `{name}.weight`.
    ///
    /// # Errors
    /// As [`Weights::get`].
    pub fn new(weights: &Weights, name: &str, width: usize, eps: f64) -> Result<Self> {
        Ok(Self { weight: weights.get(&format!("{name}.weight"), &[width])?, eps })
    }

    /// `[n, width]` to the same.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] on another width.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        kernels::rms_norm(x, &self.weight, self.eps)
    }
}
