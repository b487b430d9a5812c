//! Linear layers read from a checkpoint.

use super::lora::Lora;
use super::matrix::Matrix;
use crate::error::{Error, Result};
use crate::kernels::{self, PackedWeight};
use crate::vlm::checkpoint::lora::LoraMode;
use crate::vlm::checkpoint::raw::{self, Raw};
use crate::vlm::checkpoint::weights::Weights;
use candle_core::{DType, Tensor};

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

    /// The type that its input is rounded to, where that is another one than f32 and nothing else reads the input.
    pub(crate) fn input_type(&self) -> Option<DType> {
        self.weight.rounded_type().filter(|_| self.lora.is_none())
    }

    /// The product alone, in the type in which the matrix is multiplied; `None` where [`Linear::input_type`] is none.
    pub(super) fn rounded_product(&self, x: &Tensor) -> Result<Option<Tensor>> {
        match (&self.weight, self.input_type()) {
            (Matrix::Plain(weight), Some(dtype)) => {
                Ok(Some(kernels::linear(&x.to_dtype(dtype)?, weight, None)?))
            }
            _ => Ok(None),
        }
    }

    /// [`Linear::forward`] added to `residual`, `[n, out]`.
    ///
    /// # Errors
    /// [`crate::Error::Argument`] or [`crate::Error::Tensors`] on another width.
    pub fn forward_onto(&self, x: &Tensor, residual: &Tensor) -> Result<Tensor> {
        match (&self.weight, &self.lora) {
            (Matrix::Packed(packed), None) => packed.linear_onto(x, self.bias.as_ref(), residual),
            _ => match self.rounded_product(x)? {
                Some(y) => kernels::widen(&y, self.bias.as_ref(), Some(residual)),
                None => kernels::add(residual, &self.forward(x)?),
            },
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
                let (all, finished) = match self.rounded_product(x)? {
                    Some(y) => (y, false),
                    None => (self.forward(x)?, true),
                };
                let mut first = 0;
                let part = |width| {
                    let columns = all.narrow(1, first, width)?;
                    let bias = self.bias.as_ref().map(|bias| bias.narrow(0, first, width)).transpose()?;
                    first += width;
                    if finished {
                        Ok(columns.contiguous()?)
                    } else {
                        kernels::widen(&columns, bias.as_ref(), None)
                    }
                };
                widths.into_iter().map(part).collect::<Result<_>>()?
            }
        })
    }
}

/// [`Linear::input_type`] of layers that have one.
pub(super) fn common_type<'a>(layers: impl IntoIterator<Item = &'a Linear>) -> Option<DType> {
    let mut types = layers.into_iter().map(Linear::input_type);
    let first = types.next()?;
    first.filter(|_| types.all(|other| other == first))
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

    /// [`Linear::input_type`], where it is that of all layers.
    pub(crate) fn input_type(&self) -> Option<DType> {
        match &self.form {
            Joined::Apart(layers) => common_type(layers),
            Joined::Packed { .. } => None,
        }
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
                let x = match self.input_type() {
                    Some(dtype) => &x.to_dtype(dtype)?,
                    None => x,
                };
                layers[..count].iter().map(|l| l.forward(x)).collect::<Result<_>>()?
            }
            Joined::Packed { weight, bias } => {
                weight.linear_parts(x, bias.as_ref(), &self.outputs[..count])?
            }
        })
    }
}
