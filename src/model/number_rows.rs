//! Where the number tokens of an adapter start.

use super::adapter::Adapter;
use super::initial::normal;
use crate::error::{Error, Result};
use crate::query::{NumberTokens, PromptWriter, Settings};
use crate::vlm::checkpoint::weights::Weights;
use crate::vlm::files::Source;
use candle_core::{Device, Tensor};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use std::path::Path;

/// Standard deviation of a row's noise, in that of the digits around their mean: rows can be told apart, and none is nearer to a digit than
/// the digits are to each other.
const NOISE: f32 = 0.1;

impl Adapter {
    /// An adapter for a published checkpoint that changes none of its layers, as [`Adapter::fresh`]. With [`NumberTokens::Rows`] its number
    /// tokens start where the model knows numbers: each row is the mean of the rows of the ten digits, with a tenth of their spread as noise
    /// of its own (feature `train`). Until it was tuned, its answers are noise.
    ///
    /// # Errors
    /// As [`Adapter::layout`] and [`PromptWriter::new`]; of the checkpoint's files as [`SdimModel::load`](super::SdimModel::load), of which only the digits' rows are read.
    #[doc(hidden)]
    pub fn starting(base: &Path, settings: Settings, seed: u64) -> Result<Self> {
        let source = Source::dir(base);
        let (config, tokenizer) = (source.config()?, source.tokenizer()?);
        let mut adapter = Self::fresh(&config, settings, seed)?;
        // Every token that it is asked with has to be there.
        PromptWriter::new(&adapter.settings, &tokenizer)?;
        if adapter.settings.number_tokens != NumberTokens::Rows {
            return Ok(adapter);
        }
        let digits = ('0'..='9').map(|digit| tokenizer.id(&digit.to_string())).collect::<Result<Vec<_>>>()?;
        let weights = Weights::from_dir(base, &Device::Cpu)?;
        let shape = [config.text.vocab_size, config.text.hidden_size];
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        for (part, table) in [("embedding", "model.embed_tokens.weight"), ("head", "lm_head.weight")] {
            if let Some(rows) = adapter.tensors.get_mut(&format!("{}.{part}", NumberTokens::NAME)) {
                *rows = around(&weights.rows(table, shape, &digits)?, rows.dim(0)?, &mut rng)?;
            }
        }
        Ok(adapter)
    }
}

/// `count` rows around the mean of these, `[count, width]`.
fn around(known: &Tensor, count: usize, rng: &mut ChaCha8Rng) -> Result<Tensor> {
    let mean = known.mean_keepdim(0)?;
    let spread = known.broadcast_sub(&mean)?.sqr()?.mean_all()?.sqrt()?.to_scalar::<f32>()?;
    if !spread.is_finite() {
        return Err(Error::argument(
            "rows of the digits",
            "values that are not numbers",
            "a checkpoint with weights",
        ));
    }
    let width = known.dim(1)?;
    let noise: Vec<f32> = (0..count * width).map(|_| normal(rng) * spread * NOISE).collect();
    Ok(Tensor::from_vec(noise, (count, width), known.device())?.broadcast_add(&mean)?)
}
