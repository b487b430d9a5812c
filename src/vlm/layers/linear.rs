//! Linear layers read from a checkpoint.

use super::lora::Lora;
use super::matrix::Matrix;
use crate::error::{Error, Result};
use crate::kernels::{self, PackedWeight};
use crate::vlm::checkpoint::lora::LoraMode;
use crate::vlm::checkpoint::raw::{self, Raw};
use crate::vlm::checkpoint::weights::Weights;
use candle_core::Tensor;

/// A layer as it is found, before its weight is kept in some form.
pub(crate) struct Found<'w> {
    weights: &'w Weights,
    pub(crate) weight: Raw<'w>,
    pub(crate) bias: Option<Tensor>,
    lora: Option<Lora>,
}

impl<'w> Found<'w> {
    pub(crate) fn new(
        weights: &'w Weights,
        name: &str,
        inputs: usize,
        outputs: usize,
        bias: bool,
    ) -> Result<Self> {
        let lora = Lora::new(weights, name, inputs, outputs)?;
        let weight = weights.raw(&format!("{name}.weight"), [outputs, inputs])?;
        let (weight, lora) = match (lora, weights.lora().mode) {
            // What is absent stays so: the load fails at its end.
            (Some(lora), LoraMode::Merge) if !matches!(weight, Raw::Absent(_)) => {
                (Raw::Tensor((weight.f32(weights.device())? + lora.delta()?)?), None)
            }
            (_, LoraMode::Merge) => (weight, None),
            (lora, _) => (weight, lora),
        };
        let bias = if bias { Some(weights.get(&format!("{name}.bias"), &[outputs])?) } else { None };
        Ok(Self { weights, weight, bias, lora })
    }

    /// Whether it can be part of a packed weight with others.
    pub(crate) fn joins(&self) -> bool {
        self.lora.is_none() && self.weight.packs(self.weights.format(), self.weights.device())
    }

    pub(crate) fn keep(self) -> Result<Linear> {
        let weight = Matrix::new(&self.weight, self.weights.format(), self.weights.device())?;
        Ok(Linear { weight, bias: self.bias, lora: self.lora })
    }
}

/// `x W^T + b`, weight `[out, in]`, and a low-rank addition where an adapter has one.
pub struct Linear {
    pub(crate) weight: Matrix,
    pub(crate) bias: Option<Tensor>,
    pub(crate) lora: Option<Lora>,
}

impl Linear {
    /// Reads `{name}.weight`, if `bias`, `{name}.bias`, and the factors of an adapter (see [`Lora::new`]).
    ///
    /// # Errors
    /// As [`Weights::get`].
    pub fn new(weights: &Weights, name: &str, inputs: usize, outputs: usize, bias: bool) -> Result<Self> {
        Found::new(weights, name, inputs, outputs, bias)?.keep()
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

    /// Whether [`Linear::forward_rounded`] gives another type than f32.
    pub(super) fn rounds(&self) -> bool {
        self.lora.is_none() && self.weight.rounded_type().is_some()
    }

    /// [`Linear::forward`] in the type in which the matrix is multiplied, for what goes into another product of that type.
    pub(super) fn forward_rounded(&self, x: &Tensor) -> Result<Tensor> {
        match (&self.weight, self.rounds()) {
            (Matrix::Plain(weight), true) => {
                let y = kernels::linear(&x.to_dtype(weight.dtype())?, weight, None)?;
                Ok(match &self.bias {
                    Some(bias) => y.broadcast_add(&bias.to_dtype(weight.dtype())?)?,
                    None => y,
                })
            }
            _ => self.forward(x),
        }
    }

    /// [`Linear::forward`] added to `residual`, `[n, out]`.
    ///
    /// # Errors
    /// [`crate::Error::Argument`] or [`crate::Error::Tensors`] on another width.
    pub fn forward_onto(&self, x: &Tensor, residual: &Tensor) -> Result<Tensor> {
        match (&self.weight, &self.lora) {
            (Matrix::Packed(packed), None) => packed.linear_onto(x, self.bias.as_ref(), residual),
            _ => kernels::add(residual, &self.forward(x)?),
        }
    }

    /// [`Linear::forward`] in parts of these widths, `[n, width]` each.
    ///
    /// # Errors
    /// [`crate::Error::Argument`] or [`crate::Error::Tensors`] on another width.
    pub fn forward_parts<const N: usize>(&self, x: &Tensor, widths: [usize; N]) -> Result<[Tensor; N]> {
        array(match (&self.weight, &self.lora) {
            (Matrix::Packed(packed), None) => packed.linear_parts(x, self.bias.as_ref(), &widths)?,
            _ => {
                let all = self.forward(x)?;
                let mut first = 0;
                let part = |width| {
                    first += width;
                    Ok(all.narrow(1, first - width, width)?.contiguous()?)
                };
                widths.into_iter().map(part).collect::<Result<_>>()?
            }
        })
    }
}

fn array<const N: usize>(parts: Vec<Tensor>) -> Result<[Tensor; N]> {
    parts.try_into().map_err(|parts: Vec<_>| Error::argument("parts", parts.len(), N.to_string()))
}

/// Linear layers that read the same input: one product where their weights are packed and none has an addition of its own.
pub struct JoinedLinear<const N: usize> {
    pub(super) form: Joined,
    pub(super) outputs: [usize; N],
}

pub(super) enum Joined {
    Apart(Vec<Linear>),
    /// Outputs of each layer in turn.
    Packed {
        weight: PackedWeight,
        bias: Option<Tensor>,
    },
}

impl<const N: usize> JoinedLinear<N> {
    /// Reads the layers of these names and outputs, each as [`Linear::new`] does.
    ///
    /// # Errors
    /// As [`Weights::get`].
    pub fn new(weights: &Weights, layers: [(&str, usize); N], inputs: usize, bias: bool) -> Result<Self> {
        let found = layers.iter().map(|(name, outputs)| Found::new(weights, name, inputs, *outputs, bias));
        let found = found.collect::<Result<Vec<_>>>()?;
        let form = if found.iter().all(Found::joins) {
            let parts: Vec<&Raw> = found.iter().map(|f| &f.weight).collect();
            let biases: Vec<&Tensor> = found.iter().filter_map(|f| f.bias.as_ref()).collect();
            let bias = if bias { Some(Tensor::cat(&biases, 0)?) } else { None };
            Joined::Packed { weight: raw::pack(&parts, weights.format())?, bias }
        } else {
            Joined::Apart(found.into_iter().map(Found::keep).collect::<Result<_>>()?)
        };
        Ok(Self { form, outputs: layers.map(|(_, outputs)| outputs) })
    }

    /// `[n, in]` to `[n, out]` of each layer.
    ///
    /// # Errors
    /// [`crate::Error::Argument`] or [`crate::Error::Tensors`] on another width.
    pub fn forward(&self, x: &Tensor) -> Result<[Tensor; N]> {
        self.first(x)
    }

    /// [`JoinedLinear::forward`] of the first `M` layers alone.
    ///
    /// # Errors
    /// As [`JoinedLinear::forward`]; [`Error::Argument`] if there are fewer layers.
    pub fn first<const M: usize>(&self, x: &Tensor) -> Result<[Tensor; M]> {
        let count = M.min(N);
        array(match &self.form {
            Joined::Apart(layers) => {
                // Rounded once for all of them, if it is.
                let x = match layers[0].weight.rounded_type() {
                    Some(dtype) if layers.iter().all(Linear::rounds) => &x.to_dtype(dtype)?,
                    _ => x,
                };
                layers[..count].iter().map(|l| l.forward(x)).collect::<Result<_>>()?
            }
            Joined::Packed { weight, bias } => {
                weight.linear_parts(x, bias.as_ref(), &self.outputs[..count])?
            }
        })
    }
}
