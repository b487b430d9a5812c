use super::linear::{Joined, JoinedLinear, Linear};
use super::matrix::Matrix;
use super::mlp::{GateUp, GatedMlp};
use crate::error::Error;
use crate::kernels::{self, WeightFormat};
use crate::vlm::checkpoint::lora::{LoraConfig, LoraMode, LoraSet};
use crate::vlm::checkpoint::weights::Weights;
use candle_core::{DType, Device, Tensor};
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
            assert_eq!(values(&Tensor::cat(&parts, 1).unwrap()), values(&all), "{name} {format} {lora:?}");
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

/// As matrices lie on another device than the CPU: plain tensors, which candle multiplies here in f16 but not in bf16.
#[test]
fn plain_matrices_of_a_rounded_type_give_what_those_of_f32_give() {
    let linear = |outputs, inputs, seed, dtype| {
        let weight = Matrix::Plain(random(&[outputs, inputs], seed).to_dtype(dtype).unwrap());
        Linear { weight, bias: Some(random(&[outputs], seed + 1)), lora: None }
    };
    let (x, residual) = (random(&[5, WIDTH], 1), random(&[5, WIDTH], 2));
    let run = |dtype| {
        let inputs = GateUp::Apart { gate: linear(20, WIDTH, 1, dtype), up: linear(20, WIDTH, 3, dtype) };
        let mlp = GatedMlp { inputs, down: linear(WIDTH, 20, 5, dtype) };
        let layers = vec![linear(4, WIDTH, 7, dtype), linear(6, WIDTH, 9, dtype)];
        let joined = JoinedLinear { form: Joined::Apart(layers), outputs: [4, 6] };
        let [a, b] = joined.forward(&x).unwrap();
        [mlp.forward_onto(&x, &residual).unwrap(), a, b].map(|t| values(&t))
    };
    let (exact, rounded) = (run(DType::F32), run(DType::F16));
    for (exact, rounded) in exact.iter().zip(&rounded) {
        let largest = exact.iter().fold(0f32, |m, v| m.max(v.abs()));
        let off = exact.iter().zip(rounded).fold(0f32, |m, (a, b)| m.max((a - b).abs()));
        assert!(off > 0.0 && off < 5e-3 * largest, "{off} of {largest}");
    }
}
