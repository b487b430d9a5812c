//! From files to a loaded checkpoint.

use super::files::{CheckpointFiles, SETTINGS, TENSORS};
use super::sdim_model::SdimModel;
use crate::error::Result;
use crate::kernels::WeightFormat;
use crate::query::Settings;
use crate::vlm::checkpoint::lora::LoraMode;
use crate::vlm::checkpoint::weights::Weights;
use candle_core::Device;
use std::path::{Path, PathBuf};

/// How to load a checkpoint.
#[derive(Debug, Clone)]
pub struct LoadOptions {
    /// Where its tensors shall lie.
    pub device: Device,
    /// In what form its matrices are kept. On the CPU, [`WeightFormat::Bf16`] takes half the memory of
    /// [`WeightFormat::F32`] and is faster; a published checkpoint loses nothing by it, since it is stored in bf16.
    pub weights: WeightFormat,
    /// A directory with `sdim.json` and `sdim.safetensors`, which replace or complete those of the checkpoint.
    pub adapter: Option<PathBuf>,
    /// What becomes of the adapter's LoRA factors.
    pub lora: LoraMode,
}

impl LoadOptions {
    /// A device, the form of weights that suits it ([`WeightFormat::native`]), no adapter.
    pub fn on(device: &Device) -> Self {
        Self {
            device: device.clone(),
            weights: WeightFormat::native(device),
            adapter: None,
            lora: LoraMode::default(),
        }
    }
}

impl Default for LoadOptions {
    /// As [`LoadOptions::on`] the CPU.
    fn default() -> Self {
        Self::on(&Device::Cpu)
    }
}

impl SdimModel {
    /// Loads a checkpoint directory in the form that suits the device ([`LoadOptions::on`]): `config.json`, `preprocessor_config.json`, `tokenizer.json`,
    /// `model.safetensors` or its shards with their index, and `sdim.json` and `sdim.safetensors` if it has them.
    ///
    /// # Errors
    /// Typed errors that name the file, key or tensor.
    pub fn load(dir: &Path, device: &Device) -> Result<Self> {
        Self::load_with(dir, &LoadOptions::on(device))
    }

    /// As [`SdimModel::load`], with a form of weights and an adapter.
    ///
    /// # Errors
    /// Typed errors that name the file, key or tensor.
    pub fn load_with(dir: &Path, options: &LoadOptions) -> Result<Self> {
        let files = CheckpointFiles::from_dir(dir)?;
        let mut weights = Weights::from_dir(dir, &options.device)?;
        let beside = dir.join(TENSORS);
        if options.adapter.is_none() && beside.exists() {
            weights.add_file(&beside)?;
        }
        Self::assemble(files, weights, options)
    }

    fn assemble(mut files: CheckpointFiles, mut weights: Weights, options: &LoadOptions) -> Result<Self> {
        if let Some(adapter) = &options.adapter {
            files.settings = Settings::from_file(&adapter.join(SETTINGS))?;
            weights.add_file(&adapter.join(TENSORS))?;
        }
        let weights = weights.with_format(options.weights).with_lora(files.settings.lora_set(options.lora));
        Self::new(files, &weights, &options.device)?.fold()
    }
}

/// The checkpoint that ships inside the crate.
///
/// # Errors
/// [`crate::Error::Tensors`] if the device refuses the tensors; what an adapter can have wrong.
#[cfg(feature = "tiny")]
pub fn tiny(options: &LoadOptions) -> Result<SdimModel> {
    let files = CheckpointFiles::from_bytes(
        "sdim-tiny",
        include_bytes!("../../assets/sdim-tiny/config.json"),
        include_bytes!("../../assets/sdim-tiny/preprocessor_config.json"),
        include_bytes!("../../assets/sdim-tiny/sdim.json"),
        include_bytes!("../../assets/sdim-tiny/tokenizer.json"),
    )?;
    let bytes = include_bytes!("../../assets/sdim-tiny/model.safetensors");
    let weights = Weights::from_bytes("sdim-tiny/model.safetensors", &bytes[..], &options.device)?;
    SdimModel::assemble(files, weights, options)
}
