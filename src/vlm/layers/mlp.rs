//! The gated MLP of both towers.

use super::linear::{Found, Linear, common_type};
use super::matrix::Matrix;
use crate::error::Result;
use crate::kernels::{self, PackedGate};
use crate::vlm::checkpoint::weights::Weights;
use candle_core::{DType, Tensor};

/// The two projections of a gated MLP that read the same input.
pub(super) enum GateUp {
    Apart { gate: Linear, up: Linear },
    Joined(PackedGate),
}

/// `down(silu(gate x) * up x)`, the MLP of both towers.
pub struct GatedMlp {
    pub(super) inputs: GateUp,
    pub(super) down: Linear,
}

impl GatedMlp {
    /// Reads `{name}.gate_proj`, `.up_proj` and `.down_proj`.
    ///
    /// # Errors
    /// As [`Weights::get`].
    pub fn new(weights: &Weights, name: &str, width: usize, inner: usize, bias: bool) -> Result<Self> {
        let found = |part| Found::new(weights, &format!("{name}.{part}"), width, inner, bias);
        let (gate, up) = (found("gate_proj")?, found("up_proj")?);
        let inputs = if gate.joins() && up.joins() {
            let (g, u) = (gate.weight.hold()?, up.weight.hold()?);
            let (g, u) = ((g.rows()?, gate.bias.as_ref()), (u.rows()?, up.bias.as_ref()));
            GateUp::Joined(PackedGate::new(weights.format(), g, u)?)
        } else {
            GateUp::Apart { gate: gate.keep()?, up: up.keep()? }
        };
        Ok(Self { inputs, down: Linear::new(weights, &format!("{name}.down_proj"), inner, width, bias)? })
    }

    /// Its output for `x` added to `residual`: `[n, width]` each, as the result.
    ///
    /// # Errors
    /// [`crate::Error::Argument`] or [`crate::Error::Tensors`] on another width.
    pub fn forward_onto(&self, x: &Tensor, residual: &Tensor) -> Result<Tensor> {
        let gated = match (&self.inputs, &self.down) {
            (GateUp::Joined(both), Linear { weight: Matrix::Packed(down), bias, lora: None }) => {
                return kernels::packed_mlp(both, x, down, bias.as_ref(), residual);
            }
            (GateUp::Joined(both), _) => both.apply(x)?,
            (GateUp::Apart { gate, up }, _) => match self.rounded_products(gate, up, x)? {
                // Off the CPU: what lies between two products of one type need not leave it.
                Some([g, u]) => kernels::swiglu_rounded([&g, &u], [gate.bias.as_ref(), up.bias.as_ref()])?,
                None => kernels::swiglu(&gate.forward(x)?, &up.forward(x)?)?,
            },
        };
        self.down.forward_onto(&gated, residual)
    }
    /// [`Linear::input_type`], where it is that of all three layers.
    pub(crate) fn input_type(&self) -> Option<DType> {
        match &self.inputs {
            GateUp::Apart { gate, up } => common_type([gate, up, &self.down]),
            GateUp::Joined(_) => None,
        }
    }

    /// The products of both projections, where all three layers multiply in one rounded type.
    fn rounded_products(&self, gate: &Linear, up: &Linear, x: &Tensor) -> Result<Option<[Tensor; 2]>> {
        let Some(dtype) = self.input_type() else { return Ok(None) };
        let x = x.to_dtype(dtype)?;
        let [g, u] = [gate.rounded_product(&x)?, up.rounded_product(&x)?];
        Ok(g.zip(u).map(|(g, u)| [g, u]))
    }
}
