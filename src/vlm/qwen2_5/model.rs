//! Both towers put together.

use super::cache::KvCache;
use super::config::VlmConfig;
use super::decoder::{Context, Decoder, Keep};
use super::grid::Grid;
use super::interrupt::Interrupt;
use super::rope::{Position, RopeLayout};
use super::vision::VisionTower;
use crate::error::{Error, Result};
use crate::vlm::checkpoint::weights::Weights;
use crate::{kernels, system};
use candle_core::Tensor;

/// The published model: vision encoder and decoder.
pub struct QwenVl {
    /// Sizes and special tokens.
    pub config: VlmConfig,
    /// `visual.*`
    pub vision: VisionTower,
    /// `model.*` and the head.
    pub decoder: Decoder,
}

impl QwenVl {
    /// Builds both towers. The caller ends with [`Weights::finish`] when everything that reads them is built.
    ///
    /// # Errors
    /// As [`Weights::get`]; [`Error::Argument`] on a device without one order of work for all threads
    /// ([`crate::system::device`] opens those that have it), or a format of weights that it does not multiply.
    pub fn new(config: VlmConfig, weights: &Weights, layout: RopeLayout) -> Result<Self> {
        system::check_order(weights.device())?;
        weights.format().check(weights.device().location())?;
        let vision = VisionTower::new(&config.vision, weights)?;
        let decoder = Decoder::new(&config.text, weights, layout)?;
        Ok(Self { config, vision, decoder })
    }

    /// Image tokens `[tokens, hidden]` of preprocessed patches `[patches, patch_len]`.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] if the rows are not those of the grids.
    pub fn encode(&self, patches: &Tensor, grids: &[Grid]) -> Result<Tensor> {
        let vision = &self.vision;
        kernels::in_pool(patches.device(), || vision.encode(&vision.patch_embed.forward(patches)?, grids))
    }

    /// Embeds a prompt and puts the image tokens in the places of the placeholders, in order: `[ids, hidden]`.
    ///
    /// # Errors
    /// [`crate::Error::Argument`] on an id outside the vocabulary or if the counts differ.
    pub fn embed_prompt(&self, ids: &[u32], image_tokens: &Tensor) -> Result<Tensor> {
        let text = self.decoder.embed(ids)?;
        let (mut parts, mut i, mut used) = (Vec::new(), 0, 0);
        while i < ids.len() {
            let is_image = ids[i] == self.config.ids.image;
            let run = ids[i..].iter().take_while(|&&id| (id == self.config.ids.image) == is_image).count();
            if is_image {
                let left = image_tokens.dim(0)? - used;
                if run > left {
                    return Err(Error::argument("image placeholders", run, format!("{left} more")));
                }
                parts.push(image_tokens.narrow(0, used, run)?);
                used += run;
            } else {
                parts.push(text.narrow(0, i, run)?);
            }
            i += run;
        }
        if used != image_tokens.dim(0)? {
            let expected = format!("{} image tokens", image_tokens.dim(0)?);
            return Err(Error::argument("image placeholders", used, expected));
        }
        Ok(Tensor::cat(&parts, 0)?)
    }

    /// Reads tokens into a cache and returns the hidden states before the final norm of those that `keep` names,
    /// `[kept, hidden]`.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] on mismatched shapes.
    pub fn prefill(
        &self,
        embedded: &Tensor,
        positions: &[Position],
        cache: &mut KvCache,
        keep: Keep,
    ) -> Result<Tensor> {
        self.prefill_unless(embedded, positions, cache, keep, Interrupt::NEVER)
    }

    /// As [`QwenVl::prefill`], unless it is interrupted, which leaves the cache of no use.
    ///
    /// # Errors
    /// As [`QwenVl::prefill`]; [`Error::Cancelled`].
    pub fn prefill_unless(
        &self,
        embedded: &Tensor,
        positions: &[Position],
        cache: &mut KvCache,
        keep: Keep,
        interrupt: Interrupt,
    ) -> Result<Tensor> {
        let table = self.decoder.rope().table(positions, embedded.device())?;
        let context = Context::Cached { shared: None, own: cache };
        self.decoder.forward_keeping(embedded, &table, context, keep, interrupt)
    }
}
