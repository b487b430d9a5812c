//! Linear layers read from a checkpoint.

use super::lora::{Lora, LoraMode};
use super::matrix::Matrix;
use super::raw::{self, Raw};
use super::weights::Weights;
use crate::error::{Error, Result};
use crate::kernels::{self, PackedGate, PackedWeight};
use candle_core::Tensor;

/// A layer as it is found, before its weight is kept in some form.
struct Found<'w> {
    weights: &'w Weights,
    weight: Raw<'w>,
    bias: Option<Tensor>,
    lora: Option<Lora>,
}

impl<'w> Found<'w> {
    fn new(weights: &'w Weights, name: &str, inputs: usize, outputs: usize, bias: bool) -> Result<Self> {
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
    fn joins(&self) -> bool {
        self.lora.is_none() && self.weight.packs(self.weights.format(), self.weights.device())
    }

    fn keep(self) -> Result<Linear> {
        let weight = Matrix::new(&self.weight, self.weights.format(), self.weights.device())?;
        Ok(Linear { weight, bias: self.bias, lora: self.lora })
    }
}

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
    form: Joined,
    outputs: [usize; N],
}

enum Joined {
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
            Joined::Apart(layers) => layers[..count].iter().map(|l| l.forward(x)).collect::<Result<_>>()?,
            Joined::Packed { weight, bias } => {
                weight.linear_parts(x, bias.as_ref(), &self.outputs[..count])?
            }
        })
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
            (GateUp::Apart { gate, up }, _) => kernels::swiglu(&gate.forward(x)?, &up.forward(x)?)?,
        };
        self.down.forward_onto(&gated, residual)
    }
}

#[cfg(test)]
mod tests {
    use super::super::lora::{LoraConfig, LoraSet};
    use super::*;
    use crate::kernels::WeightFormat;
    use candle_core::{DType, Device};
    use std::collections::HashMap;

    const WIDTH: usize = 12;
    const LAYERS: [(&str, usize); 3] = [("a.q_proj", 40), ("a.k_proj", 7), ("a.v_proj", 16)];

    fn random(shape: &[usize], seed: usize) -> Tensor {
        let count = shape.iter().product::<usize>();
        let values: Vec<f32> = (0..count).map(|i| ((i * 31 + seed * 17) % 101) as f32 / 50.0 - 1.0).collect();
        Tensor::from_vec(values, shape, &Device::Cpu).unwrap()
    }

    fn values(tensor: &Tensor) -> Vec<f32> {
        tensor.flatten_all().unwrap().to_vec1().unwrap()
    }

    /// A file with joined layers, an MLP, and LoRA factors for one of each, as a checkpoint stores them.
    fn file(stored: DType) -> HashMap<String, Tensor> {
        let mut tensors = HashMap::new();
        let mut add = |name: String, shape: &[usize]| {
            let tensor = random(shape, tensors.len()).to_dtype(stored).unwrap();
            tensors.insert(name, tensor);
        };
        let mlp = [("m.gate_proj", 20), ("m.up_proj", 20)];
        for (name, outputs) in LAYERS.into_iter().chain(mlp) {
            add(format!("{name}.weight"), &[outputs, WIDTH]);
            add(format!("{name}.bias"), &[outputs]);
        }
        add("m.down_proj.weight".into(), &[WIDTH, 20]);
        add("m.down_proj.bias".into(), &[WIDTH]);
        for (name, outputs) in [("a.k_proj", 7), ("m.up_proj", 20)] {
            add(format!("{name}.lora_A.weight"), &[2, WIDTH]);
            add(format!("{name}.lora_B.weight"), &[outputs, 2]);
        }
        tensors
    }

    fn weights(tensors: &HashMap<String, Tensor>, format: WeightFormat, lora: Option<LoraMode>) -> Weights {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("w.safetensors");
        candle_core::safetensors::save(tensors, &path).unwrap();
        let targets = vec!["k_proj".into(), "up_proj".into()];
        let config = lora.map(|_| LoraConfig { rank: 2, alpha: 1.0, targets });
        let lora = LoraSet { config, mode: lora.unwrap_or_default() };
        let bytes = std::fs::read(&path).unwrap();
        Weights::from_bytes("w", bytes, &Device::Cpu).unwrap().with_format(format).with_lora(lora)
    }

    const FORMATS: [WeightFormat; 3] = [WeightFormat::F32, WeightFormat::Bf16, WeightFormat::Int8];
    const LORA: [Option<LoraMode>; 3] = [None, Some(LoraMode::Merge), Some(LoraMode::Apart)];

    #[test]
    fn joined_layers_are_the_layers() {
        let x = random(&[5, WIDTH], 1);
        for stored in [DType::F32, DType::F16, DType::BF16] {
            let tensors = file(stored);
            for (format, lora) in FORMATS.into_iter().flat_map(|f| LORA.map(|l| (f, l))) {
                let weights = weights(&tensors, format, lora);
                let joined = JoinedLinear::new(&weights, LAYERS, WIDTH, true).unwrap();
                let apart = format == WeightFormat::F32 || lora == Some(LoraMode::Apart);
                assert_eq!(matches!(joined.form, Joined::Apart(_)), apart, "{format} {lora:?}");
                for (part, (name, outputs)) in joined.forward(&x).unwrap().iter().zip(LAYERS) {
                    let layer = Linear::new(&weights, name, WIDTH, outputs, true).unwrap();
                    assert_eq!(part.dims(), [5, outputs]);
                    let expected = values(&layer.forward(&x).unwrap());
                    assert_eq!(values(part), expected, "{name} {stored:?} {format} {lora:?}");
                }
                let (all, [one, two]) = (joined.forward(&x).unwrap(), joined.first(&x).unwrap());
                assert_eq!([values(&one), values(&two)], [values(&all[0]), values(&all[1])]);
                assert!(joined.first::<4>(&x).is_err());
            }
        }
    }

    #[test]
    fn parts_and_sums_are_those_of_the_outputs() {
        let (x, residual) = (random(&[5, WIDTH], 1), random(&[5, 40], 2));
        let tensors = file(DType::BF16);
        for (format, lora) in FORMATS.into_iter().flat_map(|f| LORA.map(|l| (f, l))) {
            for (name, outputs) in LAYERS {
                let weights = weights(&tensors, format, lora);
                let layer = Linear::new(&weights, name, WIDTH, outputs, true).unwrap();
                let all = layer.forward(&x).unwrap();
                let parts = layer.forward_parts(&x, [3, outputs - 3]).unwrap();
                assert_eq!(
                    values(&Tensor::cat(&parts, 1).unwrap()),
                    values(&all),
                    "{name} {format} {lora:?}"
                );
                let residual = residual.narrow(1, 0, outputs).unwrap().contiguous().unwrap();
                let sum = layer.forward_onto(&x, &residual).unwrap();
                assert_eq!(values(&sum), values(&(&residual + all).unwrap()), "{name} {format} {lora:?}");
                assert!(layer.forward_onto(&x, &x).is_err());
                assert!(layer.forward_parts(&x, [3, outputs]).is_err());
            }
        }
    }

    #[test]
    fn the_gated_mlp_is_its_three_layers() {
        let x = random(&[5, WIDTH], 1);
        for stored in [DType::F32, DType::F16, DType::BF16] {
            let tensors = file(stored);
            for (format, lora) in FORMATS.into_iter().flat_map(|f| LORA.map(|l| (f, l))) {
                let weights = weights(&tensors, format, lora);
                let mlp = GatedMlp::new(&weights, "m", WIDTH, 20, true).unwrap();
                let apart = format == WeightFormat::F32 || lora == Some(LoraMode::Apart);
                assert_eq!(matches!(mlp.inputs, GateUp::Apart { .. }), apart, "{format} {lora:?}");
                let layer = |part, x, (inputs, outputs)| {
                    let name = format!("m.{part}");
                    Linear::new(&weights, &name, inputs, outputs, true).unwrap().forward(x).unwrap()
                };
                let (gate, up) = (layer("gate_proj", &x, (WIDTH, 20)), layer("up_proj", &x, (WIDTH, 20)));
                let expected = layer("down_proj", &kernels::swiglu(&gate, &up).unwrap(), (20, WIDTH));
                // The gate's own rounding may tip that of what `down_proj` reads.
                let tolerance = if format == WeightFormat::F32 { 0.0 } else { 0.05 };
                let expected = (&x + expected).unwrap();
                let found = values(&mlp.forward_onto(&x, &x).unwrap());
                for (found, expected) in found.iter().zip(values(&expected)) {
                    let close = (found - expected).abs() <= tolerance * (1.0 + expected.abs());
                    assert!(close, "{stored:?} {format} {lora:?}: {found}, expected {expected}");
                }
            }
        }
    }

    #[test]
    fn what_joined_layers_lack_is_listed_and_nothing_is_packed() {
        let mut tensors = file(DType::BF16);
        for name in ["a.k_proj.weight", "m.up_proj.weight"] {
            tensors.remove(name);
        }
        let weights = weights(&tensors, WeightFormat::Bf16, Some(LoraMode::Merge));
        let joined = JoinedLinear::new(&weights, LAYERS, WIDTH, true).unwrap();
        assert!(matches!(joined.form, Joined::Apart(_)));
        GatedMlp::new(&weights, "m", WIDTH, 20, true).unwrap();
        match weights.finish() {
            Err(Error::TensorSet { missing, unexpected, .. }) => {
                assert_eq!(missing, ["a.k_proj.weight", "m.up_proj.weight"]);
                assert!(unexpected.is_empty(), "{unexpected:?}");
            }
            other => panic!("{other:?}"),
        }
    }
}
