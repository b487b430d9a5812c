//! Linear layers read from a checkpoint.

use super::weights::Weights;
use crate::error::Result;
use crate::kernels;
use candle_core::Tensor;

/// `x W^T + b`, weight `[out, in]`.
pub struct Linear {
    weight: Tensor,
    bias: Option<Tensor>,
}

impl Linear {
    /// Reads `{name}.weight` and, if `bias`, `{name}.bias`.
    ///
    /// # Errors
    /// As [`Weights::get`].
    pub fn new(weights: &Weights, name: &str, inputs: usize, outputs: usize, bias: bool) -> Result<Self> {
        Ok(Self {
            weight: weights.get(&format!("{name}.weight"), &[outputs, inputs])?,
            bias: if bias { Some(weights.get(&format!("{name}.bias"), &[outputs])?) } else { None },
        })
    }

    /// `[n, in]` to `[n, out]`.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] on another width.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        kernels::linear(x, &self.weight, self.bias.as_ref())
    }
}

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

/// `down(silu(gate x) * up x)`, the MLP of both towers.
pub struct GatedMlp {
    gate: Linear,
    up: Linear,
    down: Linear,
}

impl GatedMlp {
    /// Reads `{name}.gate_proj`, `.up_proj` and `.down_proj`.
    ///
    /// # Errors
    /// As [`Weights::get`].
    pub fn new(weights: &Weights, name: &str, width: usize, inner: usize, bias: bool) -> Result<Self> {
        Ok(Self {
            gate: Linear::new(weights, &format!("{name}.gate_proj"), width, inner, bias)?,
            up: Linear::new(weights, &format!("{name}.up_proj"), width, inner, bias)?,
            down: Linear::new(weights, &format!("{name}.down_proj"), inner, width, bias)?,
        })
    }

    /// `[n, width]` to the same.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] on another width.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        self.down.forward(&kernels::swiglu(&self.gate.forward(x)?, &self.up.forward(x)?)?)
    }
}
