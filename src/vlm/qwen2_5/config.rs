//! Model configuration: `config.json` and `preprocessor_config.json` as published, in both layouts.
//!
//! The hub layout is flat (text fields at the top, `vision_config` nested); `transformers` >= 4.52 nests the text
//! fields in `text_config` and 5.x moves the rotary fields into `rope_parameters`. Both are read here into one form.

use crate::error::{Error, Result};
use crate::vlm::checkpoint::json::Node;
use serde_json::Value;

/// Sizes of the language decoder.
#[derive(Debug, Clone, PartialEq)]
pub struct TextConfig {
    /// Width of a token (`hidden_size`).
    pub hidden_size: usize,
    /// Decoder layers (`num_hidden_layers`).
    pub layers: usize,
    /// Query heads (`num_attention_heads`).
    pub heads: usize,
    /// Key/value heads (`num_key_value_heads`); divides `heads`.
    pub kv_heads: usize,
    /// Width of the gated MLP (`intermediate_size`).
    pub intermediate_size: usize,
    /// Rows of the embedding (`vocab_size`), which may exceed the tokenizer's vocabulary.
    pub vocab_size: usize,
    /// Epsilon of every RMSNorm of the decoder.
    pub rms_norm_eps: f64,
    /// Base of the rotary frequencies.
    pub rope_theta: f64,
    /// Frequencies given to the temporal, height and width axis; they sum to `head_dim / 2`.
    pub mrope_section: [usize; 3],
    /// Whether the output head is the transposed embedding (3B) or a tensor of its own (7B).
    pub tie_word_embeddings: bool,
}

/// Sizes of the vision encoder.
#[derive(Debug, Clone, PartialEq)]
pub struct VisionConfig {
    /// Blocks.
    pub depth: usize,
    /// Width of a patch token.
    pub hidden_size: usize,
    /// Width of the gated MLP.
    pub intermediate_size: usize,
    /// Attention heads.
    pub heads: usize,
    /// Colour channels (3).
    pub in_channels: usize,
    /// Side of a patch, pixels.
    pub patch_size: usize,
    /// Frames per patch (a still image is repeated).
    pub temporal_patch_size: usize,
    /// Patches per side that are merged into one token.
    pub merge_size: usize,
    /// Side of an attention window, pixels.
    pub window_size: usize,
    /// Blocks that attend over the entire image.
    pub fullatt_block_indexes: Vec<usize>,
    /// Width of the merged tokens: the decoder's width.
    pub out_hidden_size: usize,
}

/// Ids of the tokens that the model treats specially.
#[derive(Debug, Clone, PartialEq)]
pub struct SpecialIds {
    /// `<|vision_start|>`
    pub vision_start: u32,
    /// `<|vision_end|>`
    pub vision_end: u32,
    /// `<|image_pad|>`: replaced by image tokens.
    pub image: u32,
}

/// Everything of `config.json` that this crate reads.
#[derive(Debug, Clone, PartialEq)]
pub struct VlmConfig {
    /// Language decoder.
    pub text: TextConfig,
    /// Vision encoder.
    pub vision: VisionConfig,
    /// Special tokens.
    pub ids: SpecialIds,
}

impl TextConfig {
    /// Width of an attention head.
    pub fn head_dim(&self) -> usize {
        self.hidden_size / self.heads
    }
}

impl VisionConfig {
    /// Width of an attention head.
    pub fn head_dim(&self) -> usize {
        self.hidden_size / self.heads
    }

    /// Values of one flattened patch: channels x frames x side x side.
    pub fn patch_len(&self) -> usize {
        self.in_channels * self.temporal_patch_size * self.patch_size * self.patch_size
    }

    /// Side of an attention window in merged tokens.
    pub fn window_tokens(&self) -> usize {
        self.window_size / self.merge_size / self.patch_size
    }
}

impl VlmConfig {
    /// Reads `config.json`, flat or nested.
    ///
    /// # Errors
    /// [`Error::Config`] names the key that is missing or not supported.
    pub fn from_json(file: &str, json: &Value) -> Result<Self> {
        let top = Node::new(file, "", json);
        match json.get("model_type").and_then(Value::as_str) {
            Some("qwen2_5_vl") => {}
            _ => return top.wrong("model_type", "\"qwen2_5_vl\""),
        }
        let text_json = json.get("text_config").filter(|v| v.is_object());
        let text = match text_json {
            Some(t) => Node::new(file, "text_config", t),
            None => Node::new(file, "", json),
        };
        let vision_json = match json.get("vision_config") {
            Some(v) if v.is_object() => v,
            _ => return top.wrong("vision_config", "an object"),
        };
        let vision = Node::new(file, "vision_config", vision_json);
        let tie_at = |v: &Value| v.get("tie_word_embeddings").and_then(Value::as_bool);
        // The reference ties as soon as either place says so.
        let tie = [Some(json), text_json].into_iter().flatten().any(|v| tie_at(v) == Some(true));
        let config = Self {
            text: text_config(&text, tie)?,
            vision: vision_config(&vision)?,
            ids: SpecialIds {
                vision_start: top.id("vision_start_token_id")?,
                vision_end: top.id("vision_end_token_id")?,
                image: top.id("image_token_id")?,
            },
        };
        config.validate(file)?;
        Ok(config)
    }

    fn validate(&self, file: &str) -> Result<()> {
        let (t, v) = (&self.text, &self.vision);
        let check = |ok: bool, key: &str, found: String, expected: &str| {
            if ok { Ok(()) } else { Err(Error::config(file, key, found, expected)) }
        };
        check(
            t.hidden_size % t.heads == 0 && t.head_dim() % 2 == 0,
            "hidden_size",
            t.hidden_size.to_string(),
            "a multiple of 2 x num_attention_heads",
        )?;
        check(
            t.heads % t.kv_heads == 0,
            "num_key_value_heads",
            t.kv_heads.to_string(),
            "a divisor of num_attention_heads",
        )?;
        let sum = t.mrope_section.iter().try_fold(0usize, |a, &b| a.checked_add(b));
        check(
            sum == Some(t.head_dim() / 2),
            "mrope_section",
            format!("{:?}", t.mrope_section),
            "three sizes that sum to head_dim / 2",
        )?;
        check(
            v.hidden_size % v.heads == 0 && v.head_dim() % 4 == 0,
            "vision_config.hidden_size",
            v.hidden_size.to_string(),
            "a multiple of 4 x num_heads",
        )?;
        check(
            v.window_tokens() >= 1,
            "vision_config.window_size",
            v.window_size.to_string(),
            "at least patch_size x spatial_merge_size",
        )?;
        check(
            v.out_hidden_size == t.hidden_size,
            "vision_config.out_hidden_size",
            v.out_hidden_size.to_string(),
            "the decoder's hidden_size",
        )?;
        check(v.in_channels == 3, "vision_config.in_channels", v.in_channels.to_string(), "3")?;
        for (key, id) in [
            ("image_token_id", self.ids.image),
            ("vision_start_token_id", self.ids.vision_start),
            ("vision_end_token_id", self.ids.vision_end),
        ] {
            check((id as usize) < t.vocab_size, key, id.to_string(), "an id below vocab_size")?;
        }
        Ok(())
    }
}

fn text_config(n: &Node, tie_word_embeddings: bool) -> Result<TextConfig> {
    n.require("hidden_act", "silu")?;
    if n.value.get("use_sliding_window").and_then(Value::as_bool) == Some(true) {
        return n.wrong("use_sliding_window", "false (sliding windows are not implemented)");
    }
    // The reference takes the older key where both stand.
    let rope_key = ["rope_scaling", "rope_parameters"]
        .into_iter()
        .find(|k| n.value.get(k).is_some_and(Value::is_object));
    let Some(rope_key) = rope_key else {
        return n.wrong("rope_scaling", "an object with `mrope_section`");
    };
    let rope = Node::new(n.file, rope_key, &n.value[rope_key]);
    let kind = rope.value.get("rope_type").or_else(|| rope.value.get("type")).and_then(Value::as_str);
    if !matches!(kind, Some("mrope" | "default")) {
        return rope.wrong("type", "\"mrope\" or \"default\"");
    }
    let section = rope.sizes("mrope_section")?;
    let mrope_section = match <[usize; 3]>::try_from(section.as_slice()) {
        Ok(s) => s,
        Err(_) => return rope.wrong("mrope_section", "three sizes"),
    };
    let theta_node = if rope.absent("rope_theta") { n } else { &rope };
    Ok(TextConfig {
        hidden_size: n.size("hidden_size")?,
        layers: n.size_up_to("num_hidden_layers", 1024)?,
        heads: n.size("num_attention_heads")?,
        kv_heads: match n.value.get("num_key_value_heads") {
            Some(Value::Null) => n.size("num_attention_heads")?,
            _ => n.size("num_key_value_heads")?,
        },
        intermediate_size: n.size("intermediate_size")?,
        vocab_size: n.size("vocab_size")?,
        // Class defaults of the reference for absent keys: eps 1e-5, theta 1e6.
        rms_norm_eps: n.positive_or("rms_norm_eps", 1e-5)?,
        rope_theta: theta_node.positive_or("rope_theta", 1e6)?,
        mrope_section,
        tie_word_embeddings,
    })
}

fn vision_config(n: &Node) -> Result<VisionConfig> {
    n.require("hidden_act", "silu")?;
    // The reference reads `in_channels` and ignores the published `in_chans`; both are 3 everywhere.
    let channels = if n.absent("in_channels") { "in_chans" } else { "in_channels" };
    Ok(VisionConfig {
        depth: n.size_up_to_or("depth", 1024, 32)?,
        hidden_size: n.size_or("hidden_size", 3584)?,
        intermediate_size: n.size_or("intermediate_size", 3420)?,
        heads: n.size_or("num_heads", 16)?,
        in_channels: n.size_or(channels, 3)?,
        patch_size: n.size_up_to_or("patch_size", 1024, 14)?,
        temporal_patch_size: n.size_up_to_or("temporal_patch_size", 64, 2)?,
        merge_size: n.size_up_to_or("spatial_merge_size", 64, 2)?,
        window_size: n.size_or("window_size", 112)?,
        fullatt_block_indexes: if n.absent("fullatt_block_indexes") {
            vec![7, 15, 23, 31]
        } else {
            n.sizes("fullatt_block_indexes")?
        },
        out_hidden_size: n.size_or("out_hidden_size", 3584)?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::vlm::checkpoint::json::read_json;
    use serde_json::json;
    use std::path::Path;

    fn small() -> Value {
        let file = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures/qwen_small/config.json");
        read_json(Path::new(file)).unwrap()
    }

    fn read(change: impl FnOnce(&mut Value)) -> Result<VlmConfig> {
        let mut json = small();
        change(&mut json);
        VlmConfig::from_json("config.json", &json)
    }

    /// What `Qwen2_5_VLConfig` of the reference makes of the same files.
    #[test]
    fn keys_that_stand_twice_or_are_null_count_as_in_the_reference() {
        let rope = json!({"rope_type": "default", "rope_theta": 5.0, "mrope_section": [2, 1, 1]});
        let both = read(|c| c["rope_parameters"] = rope.clone()).unwrap().text;
        assert_eq!((both.rope_theta, both.mrope_section), (20000.0, [1, 2, 1]));
        let newer = read(|c| {
            c["rope_parameters"] = rope.clone();
            c["rope_scaling"] = Value::Null;
        });
        let newer = newer.unwrap().text;
        assert_eq!((newer.rope_theta, newer.mrope_section), (5.0, [2, 1, 1]));
        assert_eq!(read(|c| c["num_key_value_heads"] = Value::Null).unwrap().text.kv_heads, 6);
        let error = read(|c| c["rope_scaling"]["rope_type"] = json!("yarn")).unwrap_err().to_string();
        assert!(error.contains("rope_scaling.type"), "{error}");
    }

    #[test]
    fn the_head_is_tied_if_either_place_says_so() {
        for (outer, inner, tied) in [
            (json!(false), json!(true), true),
            (json!(true), json!(false), true),
            (Value::Null, json!(true), true),
            (Value::Null, Value::Null, false),
        ] {
            let read = read(|c| {
                c["text_config"] = c.clone();
                c["text_config"]["tie_word_embeddings"] = inner.clone();
                c["tie_word_embeddings"] = outer.clone();
            });
            assert_eq!(read.unwrap().text.tie_word_embeddings, tied, "{outer} {inner}");
        }
    }
}
