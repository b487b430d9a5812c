//! `sdim.json`: what is ours about a checkpoint, beside the published `config.json`.

use super::confidence::ConfidenceScale;
use super::marker::Marker;
use super::mode::{AnswerMode, Generation};
use super::number::{DepthUnit, NumberFormat, NumberTokens};
use super::template::PromptTemplate;
use crate::error::{Error, Result};
use crate::files::read_text;
use crate::fusion::FusionConfig;
use crate::vlm::checkpoint::lora::{LoraConfig, LoraMode, LoraSet};
use crate::vlm::qwen2_5::rope::RopeLayout;
use serde_json::Value;

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
    /// A mark drawn into the image, which is encoded anew for each query: slow, for checkpoints of DepthLM's kind.
    Marker(Marker),
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
    /// Width of the hidden layer through which each token at a pixel also sees a crop as many cells wide of the frame at a quarter of its
    /// size, with the logarithm of the interpolated depth by the number that the token states, and where measurements are; `null` for none.
    /// It needs a crop (`glimpse`), a pointer that states its hint, and numbers that are bins of equal ratio.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub wide_glimpse: Option<usize>,
    /// How numbers are written.
    pub number: NumberFormat,
    /// Where the tokens of numbers that are bins come from.
    #[serde(default, skip_serializing_if = "NumberTokens::in_vocabulary")]
    pub number_tokens: NumberTokens,
    /// What the number 1 means.
    pub unit: DepthUnit,
    /// How an answer is got.
    #[serde(default)]
    pub answer_mode: AnswerMode,
    /// What is made of the confidence of answers.
    #[serde(default, skip_serializing_if = "ConfidenceScale::is_identity")]
    pub confidence: ConfidenceScale,
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

/// The keys of a part of `sdim.json`.
fn json(part: &impl serde::Serialize) -> serde_json::Result<serde_json::Map<String, Value>> {
    match serde_json::to_value(part)? {
        Value::Object(keys) => Ok(keys),
        _ => Ok(serde_json::Map::new()),
    }
}

fn unknown(file: &str, key: &str, found: &str) -> Error {
    Error::config(file, key, found, format!("one of the presets {}", PromptTemplate::PRESETS.join(", ")))
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
            wide_glimpse: None,
            number: NumberFormat::Digits { decimals: 3, integers: 3 },
            number_tokens: NumberTokens::Vocabulary,
            unit: DepthUnit::Metres,
            answer_mode: AnswerMode::Digits,
            confidence: ConfidenceScale::default(),
            fusion: None,
            lora: None,
        }
    }

    /// DepthLM's way of asking, for a checkpoint that was trained as DepthLM trains Qwen2.5-VL: a mark in the image, its
    /// question, free answers. It neither sees nor is told measurements; they come in by the alignment of the map.
    ///
    /// DepthLM scales all images to one focal length (750 or 1000 pixels, by checkpoint) before it draws and asks, so that its
    /// answers are those of such a camera. A frame is taken as it is here: scale it beforehand.
    pub fn depthlm() -> Self {
        Self {
            template: PromptTemplate::depthlm(),
            pixel_reference: PixelReference::Marker(Marker::default()),
            measurements: MeasurementPrompt::None,
            number: NumberFormat::Digits { decimals: 2, integers: 3 },
            answer_mode: AnswerMode::Generate(Generation { max_new_tokens: 128, ..Generation::default() }),
            ..Self::paper()
        }
    }

    /// All settings of a preset by its name; `None` if there is none of it.
    pub fn preset(name: &str) -> Option<Self> {
        match name {
            "paper" => Some(Self::paper()),
            "paper_marked" => Some(Self {
                template: PromptTemplate::paper_marked(),
                pixel_reference: PixelReference::Marker(Marker::default()),
                ..Self::paper()
            }),
            "depthlm" => Some(Self::depthlm()),
            "tiny" => Some(Self::tiny()),
            _ => None,
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
            glimpse: Some(12),
            wide_glimpse: Some(256),
            number: NumberFormat::LogBins { bins: 1000, lowest: 0.0625, highest: 16.0 },
            number_tokens: NumberTokens::Vocabulary,
            unit: DepthUnit::FrameMedian,
            answer_mode: AnswerMode::Digits,
            confidence: ConfidenceScale::default(),
            fusion: Some(FusionConfig { branch: 16, high: 32, low: 16 }),
            lora: None,
        }
    }

    /// Parses `sdim.json`. It spells all keys out, or names a `preset` for those that it leaves out; `template` may be the
    /// name of a preset, too.
    ///
    /// # Errors
    /// [`Error::Format`] if it is no such file, [`Error::Config`] on an unknown format version or preset or a value out of
    /// range.
    pub fn from_bytes(file: &std::path::Path, bytes: &[u8]) -> Result<Self> {
        let wrong = |e: serde_json::Error| Error::format(file, e.to_string(), "the keys of sdim.json");
        let name = file.display().to_string();
        let mut keys: serde_json::Map<String, Value> = serde_json::from_slice(bytes).map_err(wrong)?;
        let mut short = false;
        if let Some(Value::String(preset)) = keys.get("template") {
            let template =
                PromptTemplate::preset(preset).ok_or_else(|| unknown(&name, "template", preset))?;
            keys.insert("template".into(), Value::Object(json(&template).map_err(wrong)?));
            short = true;
        }
        if let Some(preset) = keys.remove("preset") {
            let found = preset.as_str().and_then(Self::preset);
            let found = found.ok_or_else(|| unknown(&name, "preset", &preset.to_string()))?;
            let own = std::mem::replace(&mut keys, json(&found).map_err(wrong)?);
            keys.extend(own);
            short = true;
        }
        let settings: Self = match short {
            true => serde_json::from_value(Value::Object(keys)),
            // From the text itself, so that messages give the line.
            false => serde_json::from_slice(bytes),
        }
        .map_err(wrong)?;
        settings.validate(&name)?;
        Ok(settings)
    }

    /// The same without what was found for one set of weights and says nothing of others: the scale of the confidence.
    #[cfg(feature = "train")]
    pub(crate) fn of_the_shape(&self) -> Self {
        Self { confidence: ConfidenceScale::default(), ..self.clone() }
    }

    /// Reads `sdim.json`.
    ///
    /// # Errors
    /// [`Error::Io`], and as [`Settings::from_bytes`].
    pub fn from_file(path: &std::path::Path) -> Result<Self> {
        Self::from_bytes(path, &read_text(path)?)
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
        self.validate_wide_glimpse(file)?;
        if let Some(lora) = &self.lora {
            lora.validate(file)?;
        }
        self.confidence.validate(file)?;
        self.template.validate(file)?;
        self.number.validate(file)?;
        self.number_tokens.validate(file, self.number)?;
        self.validate_reference(file)?;
        self.validate_mode(file, &self.answer_mode)
    }

    /// Whether an answer mode is right by itself and goes with these settings; `file` is for messages.
    pub(crate) fn validate_mode(&self, file: &str, mode: &AnswerMode) -> Result<()> {
        mode.validate(file, self.number, self.unit, &self.template)
    }

    fn validate_wide_glimpse(&self, file: &str) -> Result<()> {
        let Some(hidden) = self.wide_glimpse else { return Ok(()) };
        let wrong = |expected: &str| Err(Error::config(file, "wide_glimpse", hidden.to_string(), expected));
        let pointed = matches!(self.pixel_reference, PixelReference::Pointer { .. });
        if !(1..=4096).contains(&hidden) {
            return wrong("1 to 4096 hidden values");
        }
        if self.glimpse.is_none() {
            return wrong("none without a `glimpse`");
        }
        if !(pointed && self.hint == Hint::Linear && matches!(self.number, NumberFormat::LogBins { .. })) {
            return wrong("none unless a pointer states its hint, in `log_bins`");
        }
        Ok(())
    }

    fn validate_reference(&self, file: &str) -> Result<()> {
        let query = &self.template.query;
        let (wanted, why) = match &self.pixel_reference {
            PixelReference::Marker(marker) => {
                marker.validate(file)?;
                (false, "no `{pixel}`, since the mark in the image says which pixel is meant")
            }
            _ => (true, "`{pixel}` once"),
        };
        if query.contains("{pixel}") != wanted {
            return Err(Error::config(file, "template.query", format!("{query:?}"), why));
        }
        Ok(())
    }
}

#[cfg(test)]
#[path = "settings_tests.rs"]
mod tests;
