//! Sizes of small checkpoints, by name or from a file.

use super::vocabulary::{WORDS, special_id};
use crate::query::Settings;
use serde_json::{Value, json};

/// Side of a patch, pixels.
const PATCH: usize = 8;
/// Patches per side of a merged token.
const MERGE: usize = 2;
/// Frames per patch: as published, with a still image repeated.
const FRAMES: usize = 2;

/// Sizes of a small checkpoint. Patches have 8 pixels and are merged 2x2; the embedding is the output head, too.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Shape {
    /// Width of the decoder.
    pub hidden_size: usize,
    /// Width of its gated MLP.
    pub intermediate_size: usize,
    /// Decoder layers.
    pub layers: usize,
    /// Query heads.
    pub heads: usize,
    /// Key and value heads.
    pub kv_heads: usize,
    /// The vision encoder.
    pub vision: VisionShape,
    /// Side of the crop at tokens that stand at a pixel, pixels; `null` for none. [`Shape::settings`] takes it over.
    pub glimpse: Option<usize>,
    /// Width of the layer behind the wide crop; `null` for none. [`Shape::settings`] takes it over.
    #[serde(default)]
    pub wide_glimpse: Option<usize>,
    /// Frames are resized to at least and at most so many pixels.
    pub pixels: (usize, usize),
}

/// Sizes of a small vision encoder.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VisionShape {
    /// Width of a patch token.
    pub hidden_size: usize,
    /// Width of the gated MLP.
    pub intermediate_size: usize,
    /// Blocks.
    pub depth: usize,
    /// Attention heads.
    pub heads: usize,
    /// Side of a window, pixels.
    pub window: usize,
    /// Blocks that attend over the entire image.
    pub full_attention: Vec<usize>,
}

impl Shape {
    /// Names of the shapes that have one.
    pub const NAMES: [&str; 2] = ["tiny", "small"];

    /// About 4 million parameters, images of at most 110,592 pixels (384x288).
    pub fn tiny() -> Self {
        Self {
            hidden_size: 192,
            intermediate_size: 512,
            layers: 4,
            heads: 4,
            kv_heads: 2,
            vision: VisionShape {
                hidden_size: 128,
                intermediate_size: 344,
                depth: 6,
                heads: 4,
                window: 64,
                full_attention: vec![1, 3, 5],
            },
            glimpse: Some(12),
            wide_glimpse: Some(256),
            pixels: (16_384, 110_592),
        }
    }

    /// About 10 million parameters, images of at most 110,592 pixels (384x288).
    pub fn small() -> Self {
        Self {
            hidden_size: 288,
            intermediate_size: 768,
            layers: 6,
            heads: 6,
            kv_heads: 3,
            vision: VisionShape {
                hidden_size: 192,
                intermediate_size: 512,
                depth: 6,
                heads: 6,
                window: 64,
                full_attention: (0..6).collect(),
            },
            glimpse: Some(12),
            wide_glimpse: Some(256),
            pixels: (16_384, 110_592),
        }
    }

    /// A shape by its name; `None` if there is none of it.
    pub fn named(name: &str) -> Option<Self> {
        match name {
            "tiny" => Some(Self::tiny()),
            "small" => Some(Self::small()),
            _ => None,
        }
    }

    /// The way of asking of `sdim-tiny`, with this shape's crops.
    pub fn settings(&self) -> Settings {
        Settings { glimpse: self.glimpse, wide_glimpse: self.wide_glimpse, ..Settings::tiny() }
    }

    /// `config.json` for a vocabulary with so many number tokens.
    pub(super) fn config(&self, numbers: usize) -> Value {
        let head_dim = self.hidden_size.checked_div(self.heads).unwrap_or_default();
        let third = head_dim / 6;
        json!({
            "architectures": ["Qwen2_5_VLForConditionalGeneration"],
            "model_type": "qwen2_5_vl",
            "bos_token_id": special_id("<|endoftext|>"),
            "eos_token_id": special_id("<|im_end|>"),
            "vision_start_token_id": special_id("<|vision_start|>"),
            "vision_end_token_id": special_id("<|vision_end|>"),
            "vision_token_id": special_id("<|vision_pad|>"),
            "image_token_id": special_id("<|image_pad|>"),
            "video_token_id": special_id("<|video_pad|>"),
            "hidden_act": "silu",
            "hidden_size": self.hidden_size,
            "intermediate_size": self.intermediate_size,
            "num_attention_heads": self.heads,
            "num_key_value_heads": self.kv_heads,
            "num_hidden_layers": self.layers,
            "rms_norm_eps": 1e-6,
            "rope_theta": 512.0,
            "rope_scaling": {"type": "mrope", "mrope_section": [head_dim / 2 - 2 * third, third, third]},
            "max_position_embeddings": 32768,
            "use_sliding_window": false,
            "tie_word_embeddings": true,
            "torch_dtype": "bfloat16",
            "vocab_size": (WORDS + numbers).next_multiple_of(16),
            "vision_config": {
                "hidden_act": "silu",
                "depth": self.vision.depth,
                "hidden_size": self.vision.hidden_size,
                "intermediate_size": self.vision.intermediate_size,
                "num_heads": self.vision.heads,
                "in_chans": 3,
                "patch_size": PATCH,
                "spatial_patch_size": PATCH,
                "spatial_merge_size": MERGE,
                "temporal_patch_size": FRAMES,
                "window_size": self.vision.window,
                "fullatt_block_indexes": self.vision.full_attention,
                "out_hidden_size": self.hidden_size,
            },
        })
    }

    /// `preprocessor_config.json`.
    pub(super) fn preprocessor(&self) -> Value {
        json!({
            "image_processor_type": "Qwen2VLImageProcessor",
            "min_pixels": self.pixels.0,
            "max_pixels": self.pixels.1,
            "patch_size": PATCH,
            "temporal_patch_size": FRAMES,
            "merge_size": MERGE,
            "image_mean": [0.48145466, 0.4578275, 0.40821073],
            "image_std": [0.26862954, 0.26130258, 0.27577711],
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::supervise::init::FreshFiles;

    #[test]
    fn shapes_with_a_name_are_what_their_description_says() {
        for (name, millions, resized) in [("tiny", 3.97, (384, 288)), ("small", 9.99, (384, 288))] {
            let shape = Shape::named(name).unwrap();
            let files = FreshFiles::of(&shape, &shape.settings()).unwrap();
            let count: usize = files.initial(1).unwrap().values().map(|t| t.elem_count()).sum();
            assert!((count as f64 / 1e6 - millions).abs() < 0.005, "{name}: {count}");
            let parsed = files.parse().unwrap();
            assert_eq!(parsed.settings.glimpse, shape.glimpse);
            assert_eq!(parsed.preprocessor.smart_resize(640, 480).unwrap(), resized, "{name}");
            let again: Shape = serde_json::from_str(&serde_json::to_string(&shape).unwrap()).unwrap();
            assert_eq!(again, shape);
        }
        assert_eq!(Shape::named("huge"), None);
    }

    #[test]
    fn sizes_that_do_not_fit_are_named() {
        let refused = |change: fn(&mut Shape), key: &str| {
            let mut shape = Shape::tiny();
            change(&mut shape);
            match FreshFiles::of(&shape, &shape.settings()) {
                Err(crate::Error::Config { key: found, .. }) => assert_eq!(found, key),
                other => panic!("{key}: {other:?}"),
            }
        };
        refused(|s| s.heads = 0, "num_attention_heads");
        refused(|s| s.heads = 5, "hidden_size");
        refused(|s| s.kv_heads = 3, "num_key_value_heads");
        refused(|s| s.vision.heads = 3, "vision_config.hidden_size");
        refused(|s| s.pixels = (10, 5), "min_pixels");
    }
}
