//! A loaded checkpoint.

use super::files::CheckpointFiles;
use super::parts::{DepthInjection, Parts};
use super::wide_glimpse::WideGlimpse;
use crate::error::Result;
use crate::query::PromptWriter;
use crate::system;
use crate::vlm::chat::tokenizer::Tokenizer;
use crate::vlm::checkpoint::weights::Weights;
use crate::vlm::files::check_patches;
use crate::vlm::layers::linear::Linear;
use crate::vlm::layers::matrix::Matrix;
use crate::vlm::qwen2_5::QwenVl;
use crate::vlm::qwen2_5::preprocess::PreprocessorConfig;
use candle_core::Device;

/// A loaded checkpoint. Immutable: caches are arguments.
pub struct SdimModel {
    /// The vision-language model.
    pub vlm: QwenVl,
    /// What adds sparse depth to the image tokens; `None` for a checkpoint without it.
    pub injection: Option<DepthInjection>,
    /// Crops around pixels to token embeddings, zero-initialised; `None` for a checkpoint without it.
    pub glimpse: Option<Linear>,
    /// Wide crops around pixels to token embeddings; `None` for a checkpoint without it.
    pub wide_glimpse: Option<WideGlimpse>,
    /// How frames are resized and normalised.
    pub preprocessor: PreprocessorConfig,
    /// How it is asked.
    pub prompts: PromptWriter,
    /// Its vocabulary.
    pub tokenizer: Tokenizer,
    /// Ids that end a free answer.
    pub stop_ids: Vec<u32>,
    /// Rows of the output head that can continue a number, `[numbers, hidden]`.
    pub number_rows: Matrix,
    /// Where its tensors are.
    pub device: Device,
}

impl SdimModel {
    /// Builds the model; fails on missing or unread tensors.
    ///
    /// # Errors
    /// [`crate::Error::Config`] if the preprocessor's patches are not the model's; [`crate::Error::Argument`] on a device or a format
    /// of weights as for [`QwenVl::new`]; tensor and tokenizer errors.
    pub fn new(files: CheckpointFiles, weights: &Weights, device: &Device) -> Result<Self> {
        for device in [device, weights.device()] {
            system::check_order(device)?;
        }
        let CheckpointFiles { config, preprocessor, settings, tokenizer, stop_ids } = files;
        check_patches(&preprocessor, &config)?;
        let prompts = PromptWriter::new(&settings, &tokenizer)?;
        let Parts { vlm, injection, glimpse, wide_glimpse } = Parts::new(config, &settings, weights)?;
        weights.finish()?;
        let number_rows = vlm.decoder.head_of(&prompts.numbers().ids, weights.format())?;
        Ok(Self {
            vlm,
            injection,
            glimpse,
            wide_glimpse,
            preprocessor,
            prompts,
            tokenizer,
            stop_ids,
            number_rows,
            device: device.clone(),
        })
    }

    /// Folds what inference need not keep apart.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] if a tensor operation fails.
    pub fn fold(mut self) -> Result<Self> {
        if let Some(injection) = &mut self.injection {
            injection.fusion.fold()?;
            injection.patch_embed.fold()?;
        }
        Ok(self)
    }
}
