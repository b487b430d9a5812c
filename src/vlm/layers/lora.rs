//! Low-rank additions to linear layers.
//!
//! Source: Hu et al., "LoRA: Low-Rank Adaptation of Large Language Models" (2021), Sec. 4.1: `W + alpha / r * B A`.

use crate::error::Result;
use crate::kernels;
use crate::vlm::checkpoint::weights::Weights;
use candle_core::Tensor;

/// The factors of one layer.
pub struct Lora {
    /// `[rank, in]`
    a: Tensor,
    /// `[out, rank]`, scaled.
    b: Tensor,
}

impl Lora {
    /// Reads `{layer}.lora_A.weight` and `{layer}.lora_B.weight` if the layer is a target. `None`, too, if one of them or the
    /// layer's own weight is missing, which is recorded: a product of stand-ins would take time and memory for nothing.
    ///
    /// # Errors
    /// As [`Weights::get`].
    pub fn new(weights: &Weights, layer: &str, inputs: usize, outputs: usize) -> Result<Option<Self>> {
        let Some(config) = weights.lora().config.as_ref().filter(|c| c.covers(layer)) else {
            return Ok(None);
        };
        let [a, b] = ["A", "B"].map(|factor| format!("{layer}.lora_{factor}.weight"));
        let shapes = [[config.rank, inputs], [outputs, config.rank]];
        let mut complete = weights.require(&format!("{layer}.weight"), &[outputs, inputs])?;
        complete &= weights.require(&a, &shapes[0])?;
        complete &= weights.require(&b, &shapes[1])?;
        if !complete {
            return Ok(None);
        }
        let (a, b) = (weights.get(&a, &shapes[0])?, weights.get(&b, &shapes[1])?);
        let scale = f64::from(config.alpha) / config.rank as f64;
        Ok(Some(Self { a, b: (b * scale)? }))
    }

    /// The addition to the weight, `[out, in]`.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] if the device refuses it.
    pub fn delta(&self) -> Result<Tensor> {
        kernels::linear(&self.b, &self.a.t()?.contiguous()?, None)
    }

    /// The addition to the output: `[n, in]` to `[n, out]`.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] on another width.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        kernels::linear(&kernels::linear(x, &self.a, None)?, &self.b, None)
    }
}
