//! How a checkpoint is loaded.

use super::lora::LoraMode;
use crate::kernels::WeightFormat;
use candle_core::Device;
use std::path::PathBuf;

/// How to load a checkpoint.
///
/// ```
/// use sdim::{LoadOptions, WeightFormat};
/// let options = LoadOptions::default().with_weights(WeightFormat::F32).with_adapter("my-adapter");
/// assert!(options.device.is_cpu());
/// ```
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct LoadOptions {
    /// Where its tensors shall lie. [`crate::system::device`] opens devices that may be used by several threads; one made with
    /// candle's `Device::new_cuda` may not, and is refused.
    pub device: Device,
    /// In what form its matrices are kept. On the CPU, [`WeightFormat::Bf16`] takes half the memory of
    /// [`WeightFormat::F32`] and is faster; a published checkpoint loses nothing by it, since it is stored in bf16.
    pub weights: WeightFormat,
    /// A directory with `sdim.json` and `sdim.safetensors`, which replace or complete those of the checkpoint; or one that PEFT (or
    /// ms-swift) has saved, with `adapter_config.json` and `adapter_model.safetensors`: plain LoRA, which leaves the settings as they are.
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

    /// With matrices kept in this form.
    pub fn with_weights(mut self, weights: WeightFormat) -> Self {
        self.weights = weights;
        self
    }

    /// With the adapter in this directory.
    pub fn with_adapter(mut self, dir: impl Into<PathBuf>) -> Self {
        self.adapter = Some(dir.into());
        self
    }

    /// With the adapter's LoRA factors merged or apart.
    pub fn with_lora(mut self, lora: LoraMode) -> Self {
        self.lora = lora;
        self
    }
}

impl Default for LoadOptions {
    /// As [`LoadOptions::on`] the CPU.
    fn default() -> Self {
        Self::on(&Device::Cpu)
    }
}
