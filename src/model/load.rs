//! From files to a loaded checkpoint.

use super::files::{CheckpointFiles, SETTINGS, TENSORS};
use super::peft::{self, PEFT_TENSORS};
use super::sdim_model::SdimModel;
use crate::error::Result;
use crate::query::Settings;
use crate::vlm::checkpoint::LoadOptions;
use crate::vlm::checkpoint::weights::Weights;
#[cfg(feature = "tiny")]
use candle_core::Device;
use std::path::Path;

impl SdimModel {
    /// Loads a checkpoint directory: `config.json`, `preprocessor_config.json`, `tokenizer.json`, `model.safetensors` or its
    /// shards with their index, and `sdim.json` and `sdim.safetensors` if it has them.
    ///
    /// # Errors
    /// Typed errors that name the file, key or tensor.
    pub fn load(dir: &Path, options: &LoadOptions) -> Result<Self> {
        let files = CheckpointFiles::from_dir(dir)?;
        let mut weights = Weights::from_dir(dir, &options.device)?;
        let beside = dir.join(TENSORS);
        if options.adapter.is_none() && beside.exists() {
            weights.add_file(&beside)?;
        }
        Self::assemble(files, weights, options)
    }

    fn assemble(mut files: CheckpointFiles, mut weights: Weights, options: &LoadOptions) -> Result<Self> {
        if let Some(adapter) = options.adapter.as_ref().filter(|adapter| peft::is_peft(adapter)) {
            files.settings.lora = Some(peft::lora(adapter)?);
            weights.add_file(&adapter.join(PEFT_TENSORS))?;
        } else if let Some(adapter) = &options.adapter {
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
    let [config, preprocessor, settings, tokenizer] = TINY.map(str::as_bytes);
    let files = CheckpointFiles::from_bytes("sdim-tiny", config, preprocessor, settings, tokenizer)?;
    SdimModel::assemble(files, tiny_weights(&options.device)?, options)
}

/// Its `config.json`, `preprocessor_config.json`, `sdim.json` and `tokenizer.json`.
#[cfg(feature = "tiny")]
pub(crate) const TINY: [&str; 4] = [
    include_str!("../../assets/sdim-tiny/config.json"),
    include_str!("../../assets/sdim-tiny/preprocessor_config.json"),
    include_str!("../../assets/sdim-tiny/sdim.json"),
    include_str!("../../assets/sdim-tiny/tokenizer.json"),
];

/// Its tensors.
#[cfg(feature = "tiny")]
pub(crate) fn tiny_weights(device: &Device) -> Result<Weights> {
    let bytes = include_bytes!("../../assets/sdim-tiny/model.safetensors");
    Weights::from_bytes("sdim-tiny/model.safetensors", &bytes[..], device)
}
