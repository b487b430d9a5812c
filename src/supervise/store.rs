//! Checkpoints on disk: the published one, and the trainer's state to resume from.

use super::init::FreshFiles;
use super::optimiser::Parameters;
use crate::error::{Error, Result};
use crate::files::write_tensors;
use crate::vlm::checkpoint::weights::Weights;
use candle_core::{DType, Device, Tensor};
use std::collections::HashMap;
use std::path::Path;

/// File of the published weights.
const MODEL: &str = "model.safetensors";
/// File of the state to resume from.
const STATE: &str = "trainer.safetensors";

/// Counts in it.
const COUNTS: [&str; 2] = ["step", "skipped"];

/// How far a run is.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Progress {
    /// Steps done, those that were skipped included.
    pub step: usize,
    /// Steps that changed nothing, since their loss or their gradients were not finite.
    pub skipped: usize,
    /// The last of them, one right after the other.
    pub skipped_in_a_row: usize,
}

impl Progress {
    /// Steps that moved the weights.
    pub fn updates(&self) -> usize {
        self.step.saturating_sub(self.skipped)
    }
}

/// Writes a checkpoint directory that [`crate::model::SdimModel::load`] reads: the averages as bf16.
///
/// Whenever it is interrupted, the weights in the directory are those of the files beside them, or there are none.
///
/// # Errors
/// [`Error::Io`], [`Error::Tensors`].
pub fn publish(dir: &Path, files: &FreshFiles, parameters: &Parameters) -> Result<()> {
    std::fs::create_dir_all(dir).map_err(Error::io(dir))?;
    let mut tensors = HashMap::new();
    for (name, tensor) in parameters.averages()? {
        tensors.insert(name, tensor.to_dtype(DType::BF16)?);
    }
    let model = dir.join(MODEL);
    if !FreshFiles::load(dir).is_ok_and(|there| there == *files) {
        remove(&model)?;
        files.write(dir)?;
    }
    write_tensors(&model, &tensors)
}

/// Removes a state that [`save_state`] wrote, if there is one.
///
/// # Errors
/// [`Error::Io`].
pub fn remove_state(dir: &Path) -> Result<()> {
    remove(&dir.join(STATE))
}

fn remove(path: &Path) -> Result<()> {
    match std::fs::remove_file(path) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(Error::io(path)(e)),
        _ => Ok(()),
    }
}

/// Writes `trainer.safetensors`: values, moments and averages in f32, and how far the run is.
///
/// # Errors
/// [`Error::Io`], [`Error::Tensors`].
pub fn save_state(dir: &Path, parameters: &Parameters, progress: Progress) -> Result<()> {
    std::fs::create_dir_all(dir).map_err(Error::io(dir))?;
    let mut tensors = HashMap::new();
    for (name, p) in &parameters.all {
        for (part, data) in [("value", p.values()), ("m", &p.m), ("v", &p.v), ("average", &p.average)] {
            let tensor = Tensor::from_slice(data, p.var.shape(), &Device::Cpu)?;
            tensors.insert(format!("{part}/{name}"), tensor);
        }
    }
    let Progress { step, skipped, skipped_in_a_row } = progress;
    for (name, counts) in [(COUNTS[0], &[step][..]), (COUNTS[1], &[skipped, skipped_in_a_row])] {
        let counts: Vec<u32> = counts.iter().map(|&n| n as u32).collect();
        tensors.insert(name.into(), Tensor::new(counts, &Device::Cpu)?);
    }
    write_tensors(&dir.join(STATE), &tensors)
}

/// Takes the weights of a checkpoint as values and averages; moments stay as they are.
///
/// # Errors
/// [`Error::Format`] on a damaged file, [`Error::Tensor`] or [`Error::TensorSet`] if they belong to another model.
pub fn take_weights(weights: &Weights, parameters: &mut Parameters) -> Result<()> {
    let mut all = Vec::with_capacity(parameters.all.len());
    for (name, p) in &parameters.all {
        all.push(weights.get(name, p.var.dims())?.flatten_all()?.to_vec1::<f32>()?);
    }
    weights.finish()?;
    for (p, values) in parameters.all.values_mut().zip(all) {
        p.set(&values)?;
        p.average = values;
    }
    Ok(())
}

/// Reads what [`save_state`] wrote and returns how far the run is. On an error the parameters are as they were.
///
/// # Errors
/// [`Error::Io`], [`Error::Format`] on a damaged file, [`Error::Tensor`] or [`Error::TensorSet`] if it belongs to another
/// model.
pub fn load_state(dir: &Path, parameters: &mut Parameters) -> Result<Progress> {
    let path = dir.join(STATE);
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
    let mut unexpected: Vec<String> =
        state.keys().filter(|k| !COUNTS.contains(&k.as_str()) && !known(k)).cloned().collect();
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
    let counts = |name: &str, n: usize| match state.get(name).map(|t| t.to_vec1::<u32>()) {
        Some(Ok(counts)) if counts.len() == n => Ok(counts.iter().map(|&c| c as usize).collect()),
        _ => Err(missing(name, format!("{n} u32"))),
    };
    let step: Vec<usize> = counts(COUNTS[0], 1)?;
    // States of before steps could be skipped have none.
    let skipped = if state.contains_key(COUNTS[1]) { counts(COUNTS[1], 2)? } else { vec![0, 0] };
    for (p, (values, average, m, v)) in parameters.all.values_mut().zip(parts) {
        p.set(&values)?;
        (p.average, p.m, p.v) = (average, m, v);
    }
    Ok(Progress { step: step[0], skipped: skipped[0], skipped_in_a_row: skipped[1] })
}
