//! Free generation, token by token.

use super::QwenVl;
use super::decoder::Keep;
use super::rope::Position;
use crate::error::Result;
use candle_core::{DType, Tensor};
use candle_transformers::generation::{LogitsProcessor, Sampling};
use candle_transformers::utils::apply_repeat_penalty;

/// How to continue a prompt.
#[derive(Debug, Clone)]
pub struct GenerateOptions {
    /// Tokens at most.
    pub max_new_tokens: usize,
    /// Divides (or multiplies, if negative) the logit of every id seen so far; 1 is off. Published: 1.05.
    pub repetition_penalty: f32,
    /// Ids that end the answer (not returned).
    pub stop_ids: Vec<u32>,
    /// Ids from this one on have no token and are never chosen.
    pub usable_vocab: usize,
}

impl QwenVl {
    /// Continues a prompt greedily.
    ///
    /// `embedded` is `[tokens, hidden]` with one position per token, `next` the position that follows, `ids` the prompt.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] on mismatched shapes.
    pub fn generate(
        &self,
        ids: &[u32],
        embedded: &Tensor,
        positions: &[Position],
        next: f32,
        options: &GenerateOptions,
    ) -> Result<Vec<u32>> {
        let mut cache = self.decoder.cache(1);
        let mut sampler = LogitsProcessor::from_sampling(0, Sampling::ArgMax);
        let mut seen = ids.to_vec();
        let mut hidden = self.prefill(embedded, positions, &mut cache, Keep::Last)?;
        let mut answer = Vec::new();
        while answer.len() < options.max_new_tokens {
            let logits = self.decoder.logits(&self.decoder.final_norm(&hidden)?)?.squeeze(0)?;
            let usable = options.usable_vocab.min(logits.dim(0)?);
            let logits = logits.narrow(0, 0, usable)?.to_dtype(DType::F32)?;
            let logits = if options.repetition_penalty == 1.0 {
                logits
            } else {
                apply_repeat_penalty(&logits, options.repetition_penalty, &seen)?
            };
            let id = sampler.sample(&logits)?;
            if options.stop_ids.contains(&id) {
                break;
            }
            let position = Position::text(next + answer.len() as f32);
            answer.push(id);
            if answer.len() == options.max_new_tokens {
                break;
            }
            seen.push(id);
            hidden = self.prefill(&self.decoder.embed(&[id])?, &[position], &mut cache, Keep::Last)?;
        }
        Ok(answer)
    }
}
