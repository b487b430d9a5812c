//! Everything of a model that has weights.

use crate::error::Result;
use crate::fusion::Fusion;
use crate::query::Settings;
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
        Ok(Self { vlm: QwenVl::new(config, weights, settings.rope_layout)?, injection, glimpse })
    }
}
