//! The normalisation of both towers.

use crate::error::Result;
use crate::kernels;
use crate::vlm::checkpoint::weights::Weights;
use candle_core::{DType, Tensor};

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

    /// [`RmsNorm::forward`] in the type that what reads it rounds its input to, if it does.
    ///
    /// # Errors
    /// As [`RmsNorm::forward`].
    pub fn forward_as(&self, x: &Tensor, dtype: Option<DType>) -> Result<Tensor> {
        match dtype {
            Some(dtype) => kernels::rms_norm_rounded(x, &self.weight, self.eps, dtype),
            None => self.forward(x),
        }
    }
}
