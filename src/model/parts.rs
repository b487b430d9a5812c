//! Everything of a model that has weights.

use super::files::SETTINGS;
use super::wide_glimpse::WideGlimpse;
use crate::error::{Error, Result};
use crate::fusion::Fusion;
use crate::query::{NumberTokens, Settings};
use crate::vlm::checkpoint::weights::Weights;
use crate::vlm::layers::linear::Linear;
use crate::vlm::qwen2_5::QwenVl;
use crate::vlm::qwen2_5::config::VlmConfig;
use crate::vlm::qwen2_5::patch_embed::PatchEmbed;

/// The fusion block with the second patch embedding (F_e2 of Eq. 3a).
pub struct DepthInjection {
    /// I and S to O.
    pub fusion: Fusion,
    /// O to tokens.
    pub patch_embed: PatchEmbed,
}

/// Everything of a model that has weights.
pub(crate) struct Parts {
    pub(crate) vlm: QwenVl,
    pub(crate) injection: Option<DepthInjection>,
    pub(crate) glimpse: Option<Linear>,
    pub(crate) wide_glimpse: Option<WideGlimpse>,
}

impl Parts {
    /// Asks for each tensor; what is missing is for [`Weights::finish`] to tell.
    pub(crate) fn new(config: VlmConfig, settings: &Settings, weights: &Weights) -> Result<Self> {
        let injection = match &settings.fusion {
            Some(fusion) => Some(DepthInjection {
                fusion: Fusion::new(fusion, weights)?,
                patch_embed: PatchEmbed::new(&config.vision, weights, "sdim.patch_embed.proj")?,
            }),
            None => None,
        };
        let glimpse = match settings.glimpse {
            Some(side) => {
                Some(Linear::new(weights, "sdim.glimpse", 3 * side * side, config.text.hidden_size, false)?)
            }
            None => None,
        };
        let hidden = config.text.hidden_size;
        let wide_glimpse = match (settings.glimpse, settings.wide_glimpse) {
            (Some(side), Some(inner)) => Some(WideGlimpse::new(weights, side, inner, &config)?),
            _ => None,
        };
        let mut vlm = QwenVl::new(config, weights, settings.rope_layout)?;
        if let Some(bins) = settings.number.bins().filter(|_| settings.number_tokens == NumberTokens::Rows) {
            check_number_rows(weights, bins.count, hidden)?;
            vlm.decoder.add_tokens(weights, NumberTokens::NAME, bins.count)?;
        }
        Ok(Self { vlm, injection, glimpse, wide_glimpse })
    }
}

/// Number tokens that are as wide as the model, but not as many as `sdim.json` says: one of the two files is another checkpoint's, which says
/// more than a shape.
fn check_number_rows(weights: &Weights, bins: usize, hidden: usize) -> Result<()> {
    for part in ["embedding", "head"] {
        let name = format!("{}.{part}", NumberTokens::NAME);
        if let Some(&[rows, width]) = weights.shape(&name)
            && width == hidden
            && rows != bins
        {
            return Err(Error::config(
                SETTINGS,
                "number.bins",
                bins.to_string(),
                format!("{rows}, the rows of `{name}`"),
            ));
        }
    }
    Ok(())
}
