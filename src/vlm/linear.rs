//! Linear layers read from a checkpoint.

use super::lora::{Lora, LoraMode};
use super::matrix::Matrix;
use super::weights::Weights;
use crate::error::Result;
use crate::kernels::{self, PackedGate};
use candle_core::Tensor;

/// `x W^T + b`, weight `[out, in]`, and a low-rank addition where an adapter has one.
pub struct Linear {
    weight: Matrix,
    bias: Option<Tensor>,
    lora: Option<Lora>,
}

impl Linear {
    /// Reads `{name}.weight`, if `bias`, `{name}.bias`, and the factors of an adapter (see [`Lora::new`]).
    ///
    /// # Errors
    /// As [`Weights::get`].
    pub fn new(weights: &Weights, name: &str, inputs: usize, outputs: usize, bias: bool) -> Result<Self> {
        let lora = Lora::new(weights, name, inputs, outputs)?;
        let (added, lora) = match (lora, weights.lora().mode) {
            (Some(lora), LoraMode::Merge) => (Some(lora.delta()?), None),
            (lora, _) => (None, lora),
        };
        Ok(Self {
            weight: weights.matrix(&format!("{name}.weight"), [outputs, inputs], added.as_ref())?,
            bias: if bias { Some(weights.get(&format!("{name}.bias"), &[outputs])?) } else { None },
            lora,
        })
    }

    /// `[n, in]` to `[n, out]`.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] on another width.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let y = self.weight.linear(x, self.bias.as_ref())?;
        match &self.lora {
            Some(lora) => kernels::add(&y, &lora.forward(x)?),
            None => Ok(y),
        }
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

/// The two projections of a gated MLP that read the same input.
enum GateUp {
    Apart { gate: Linear, up: Linear },
    Joined(PackedGate),
}

/// `down(silu(gate x) * up x)`, the MLP of both towers.
pub struct GatedMlp {
    inputs: GateUp,
    down: Linear,
}

impl GatedMlp {
    /// Reads `{name}.gate_proj`, `.up_proj` and `.down_proj`.
    ///
    /// # Errors
    /// As [`Weights::get`].
    pub fn new(weights: &Weights, name: &str, width: usize, inner: usize, bias: bool) -> Result<Self> {
        let gate = Linear::new(weights, &format!("{name}.gate_proj"), width, inner, bias)?;
        let up = Linear::new(weights, &format!("{name}.up_proj"), width, inner, bias)?;
        let inputs = match ((&gate.weight, &gate.lora), (&up.weight, &up.lora)) {
            ((Matrix::Packed(g), None), (Matrix::Packed(u), None)) => {
                GateUp::Joined(PackedGate::new((g, gate.bias.as_ref()), (u, up.bias.as_ref()))?)
            }
            _ => GateUp::Apart { gate, up },
        };
        Ok(Self { inputs, down: Linear::new(weights, &format!("{name}.down_proj"), inner, width, bias)? })
    }

    /// `[n, width]` to the same.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] on another width.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let gated = match &self.inputs {
            GateUp::Apart { gate, up } => kernels::swiglu(&gate.forward(x)?, &up.forward(x)?)?,
            GateUp::Joined(both) => both.apply(x)?,
        };
        self.down.forward(&gated)
    }
}
