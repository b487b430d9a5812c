//! `sdim.json`: what is ours about a checkpoint, beside the published `config.json`.

use super::number::{DepthUnit, NumberFormat};
use super::template::PromptTemplate;
use crate::error::{Error, Result};
use crate::fusion::FusionConfig;
use crate::vlm::lora::{LoraConfig, LoraMode, LoraSet};
use crate::vlm::rope::RopeLayout;

/// The format version that this crate writes and reads.
pub const FORMAT: u32 = 1;

/// How a query says which pixel it means.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum PixelReference {
    /// One token whose M-RoPE position is the pixel's own: no words at all.
    Pointer {
        /// The token that points where no hint is given.
        token: String,
    },
    /// The pixel's column and row in words, in pixels of the resized image.
    Coordinates,
}

/// Where the measurements are told.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum MeasurementPrompt {
    /// Not in words; the fusion block alone sees them.
    None,
    /// In the shared prefix: each as a number at its pixel's M-RoPE position (T of Eq. 4a, once per frame).
    Prefix {
        /// At most this many, spread evenly over the frame.
        max: usize,
    },
    /// In each query: the paper's mask sentence.
    PerQuery,
}

/// A first guess that a query states, for the model to correct.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Hint {
    /// None: the pointer token asks.
    #[default]
    None,
    /// The Delaunay-linear interpolation of the measurements: the pointer is that number's token.
    Linear,
}

/// Everything in `sdim.json`.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Settings {
    /// Version of this file's format.
    pub format: u32,
    /// Which rotary frequency turns with which axis.
    #[serde(default)]
    pub rope_layout: RopeLayout,
    /// M-RoPE units per merged patch on the height and width axis of image tokens; 1 as published.
    #[serde(default = "one")]
    pub position_scale: f32,
    /// Prompt and answer text.
    pub template: PromptTemplate,
    /// How a pixel is named.
    pub pixel_reference: PixelReference,
    /// Where measurements are told.
    pub measurements: MeasurementPrompt,
    /// The guess that a pointer states.
    #[serde(default)]
    pub hint: Hint,
    /// Side, in pixels of the resized image, of the crop around the pixel that is added to each token that stands at a
    /// pixel; `null` for none.
    #[serde(default)]
    pub glimpse: Option<usize>,
    /// How numbers are written.
    pub number: NumberFormat,
    /// What the number 1 means.
    pub unit: DepthUnit,
    /// Channels of the fusion block; `null` for a checkpoint without one.
    #[serde(default)]
    pub fusion: Option<FusionConfig>,
    /// Which linear layers of the base model carry low-rank additions; `null` for none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lora: Option<LoraConfig>,
}

fn one() -> f32 {
    1.0
}

impl Settings {
    /// The paper's way of asking, for a checkpoint that has no `sdim.json` (plain Qwen2.5-VL).
    pub fn paper() -> Self {
        Self {
            format: FORMAT,
            rope_layout: RopeLayout::Contiguous,
            position_scale: 1.0,
            template: PromptTemplate::paper(),
            pixel_reference: PixelReference::Coordinates,
            measurements: MeasurementPrompt::PerQuery,
            hint: Hint::None,
            glimpse: None,
            number: NumberFormat::Digits { decimals: 3, integers: 3 },
            unit: DepthUnit::Metres,
            fusion: None,
            lora: None,
        }
    }

    /// The tiny model's way of asking.
    pub fn tiny() -> Self {
        Self {
            format: FORMAT,
            rope_layout: RopeLayout::Interleaved,
            position_scale: 8.0,
            template: PromptTemplate::tiny(),
            pixel_reference: PixelReference::Pointer { token: "<|point|>".into() },
            measurements: MeasurementPrompt::Prefix { max: 1024 },
            hint: Hint::Linear,
            glimpse: Some(8),
            number: NumberFormat::Bins { bins: 1000, range: 1.25 },
            unit: DepthUnit::FrameMax,
            fusion: Some(FusionConfig { branch: 16, high: 32, low: 16 }),
            lora: None,
        }
    }

    /// Parses `sdim.json`.
    ///
    /// # Errors
    /// [`Error::Format`] if it is no such file, [`Error::Config`] on an unknown format version or a value out of range.
    pub fn from_bytes(file: &std::path::Path, bytes: &[u8]) -> Result<Self> {
        let settings: Self = serde_json::from_slice(bytes)
            .map_err(|e| Error::format(file, e.to_string(), "the keys of sdim.json"))?;
        settings.validate(&file.display().to_string())?;
        Ok(settings)
    }

    /// Reads `sdim.json`.
    ///
    /// # Errors
    /// [`Error::Io`], and as [`Settings::from_bytes`].
    pub fn from_file(path: &std::path::Path) -> Result<Self> {
        Self::from_bytes(path, &std::fs::read(path).map_err(Error::io(path))?)
    }

    /// The text of `sdim.json`.
    ///
    /// # Errors
    /// [`Error::Config`] on a value out of range, which could not be read back.
    pub fn to_json(&self) -> Result<String> {
        self.validate("sdim.json")?;
        serde_json::to_string_pretty(self).map_err(|e| Error::format("sdim.json", e.to_string(), "JSON"))
    }

    /// The low-rank additions with what becomes of them.
    pub(crate) fn lora_set(&self, mode: LoraMode) -> LoraSet {
        LoraSet { config: self.lora.clone(), mode }
    }

    pub(crate) fn validate(&self, file: &str) -> Result<()> {
        if self.format != FORMAT {
            return Err(Error::config(file, "format", self.format.to_string(), FORMAT.to_string()));
        }
        if !(self.position_scale.is_finite() && self.position_scale > 0.0) {
            let found = self.position_scale.to_string();
            return Err(Error::config(file, "position_scale", found, "a positive number"));
        }
        if let Some(f) = self.fusion
            && ![f.branch, f.high, f.low].iter().all(|c| (1..=1024).contains(c))
        {
            return Err(Error::config(file, "fusion", format!("{f:?}"), "1 to 1024 channels each"));
        }
        if self.measurements == (MeasurementPrompt::Prefix { max: 0 }) {
            return Err(Error::config(file, "measurements.max", "0", "at least 1, or the kind `none`"));
        }
        if self.glimpse.is_some_and(|side| !(1..=64).contains(&side)) {
            return Err(Error::config(
                file,
                "glimpse",
                format!("{:?}", self.glimpse),
                "a side of 1 to 64 pixels",
            ));
        }
        if let Some(lora) = &self.lora {
            lora.validate(file)?;
        }
        self.template.validate(file)?;
        self.number.validate(file)
    }
}
