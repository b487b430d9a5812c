//! Checkpoints on disk: the published one, and the trainer's state to resume from.

use super::init::FreshFiles;
use super::optimiser::Parameters;
use crate::error::{Error, Result};
use crate::files::write_tensors;
use candle_core::{DType, Device, Tensor};
use std::collections::HashMap;
use std::path::Path;

/// Writes a checkpoint directory that [`crate::model::SdimModel::load`] reads: the averaged weights as bf16.
///
/// # Errors
/// [`Error::Io`], [`Error::Tensors`].
pub fn publish(dir: &Path, files: &FreshFiles, parameters: &Parameters) -> Result<()> {
    std::fs::create_dir_all(dir).map_err(Error::io(dir))?;
    let mut tensors = HashMap::new();
    for (name, tensor) in parameters.averages()? {
        tensors.insert(name, tensor.to_dtype(DType::BF16)?);
    }
    write_tensors(&dir.join("model.safetensors"), &tensors)?;
    files.write(dir)
}

/// Writes `trainer.safetensors`: values, moments and averages in f32, and the number of finished steps.
///
/// # Errors
/// [`Error::Io`], [`Error::Tensors`].
pub fn save_state(dir: &Path, parameters: &Parameters, step: usize) -> Result<()> {
    std::fs::create_dir_all(dir).map_err(Error::io(dir))?;
    let mut tensors = HashMap::new();
    for (name, p) in &parameters.all {
        for (part, data) in [("value", p.values()), ("m", &p.m), ("v", &p.v), ("average", &p.average)] {
            let tensor = Tensor::from_slice(data, p.var.shape(), &Device::Cpu)?;
            tensors.insert(format!("{part}/{name}"), tensor);
        }
    }
    tensors.insert("step".into(), Tensor::new(&[step as u32], &Device::Cpu)?);
    write_tensors(&dir.join("trainer.safetensors"), &tensors)
}

/// Reads what [`save_state`] wrote and returns the number of finished steps.
///
/// # Errors
/// [`Error::Io`], [`Error::Format`] on a damaged file, [`Error::Tensor`] or [`Error::TensorSet`] if it belongs to another
/// model.
pub fn load_state(dir: &Path, parameters: &mut Parameters) -> Result<usize> {
    let path = dir.join("trainer.safetensors");
    let file = path.display().to_string();
    let bytes = std::fs::read(&path).map_err(Error::io(&path))?;
    let state = candle_core::safetensors::load_buffer(&bytes, &Device::Cpu)
        .map_err(|e| Error::format(&path, e.to_string(), "a trainer state"))?;
    let missing = |name: &str, expected: String| Error::Tensor {
        file: file.clone(),
        name: name.to_string(),
        found: "missing or of another shape".into(),
        expected,
    };
    let known = |key: &str| key.split_once('/').is_some_and(|(_, name)| parameters.all.contains_key(name));
    let mut unexpected: Vec<String> = state.keys().filter(|k| *k != "step" && !known(k)).cloned().collect();
    if !unexpected.is_empty() {
        unexpected.sort();
        return Err(Error::TensorSet { file, missing: Vec::new(), unexpected, misshaped: Vec::new() });
    }
    let mut parts = Vec::with_capacity(parameters.all.len());
    for (name, p) in &parameters.all {
        let read = |part: &str| -> Result<Vec<f32>> {
            match state.get(&format!("{part}/{name}")) {
                Some(t) if t.shape() == p.var.shape() => Ok(t.flatten_all()?.to_vec1()?),
                _ => Err(missing(&format!("{part}/{name}"), format!("{:?}", p.var.shape()))),
            }
        };
        parts.push((read("value")?, read("average")?, read("m")?, read("v")?));
    }
    let step = match state.get("step").map(|t| t.to_vec1::<u32>()) {
        Some(Ok(step)) if step.len() == 1 => step[0] as usize,
        _ => return Err(missing("step", "one u32".into())),
    };
    for (p, (values, average, m, v)) in parameters.all.values_mut().zip(parts) {
        p.set(&values, &average)?;
        (p.m, p.v) = (m, v);
    }
    Ok(step)
}
