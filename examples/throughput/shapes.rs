//! Sizes of the published models, and random weights for them.

use rayon::prelude::*;
use serde_json::{Value, json};

/// `config.json` of a model by its short name.
pub fn config(name: &str) -> Option<Value> {
    let (hidden, inner, layers, heads, kv, vocab, tied) = match name {
        "3b" => (2048, 11008, 36, 16, 2, 151_936, true),
        "7b" => (3584, 18944, 28, 28, 4, 152_064, false),
        "tiny" => return Some(tiny()),
        _ => return None,
    };
    Some(json!({
        "model_type": "qwen2_5_vl", "hidden_act": "silu",
        "vision_start_token_id": 151_652, "vision_end_token_id": 151_653, "image_token_id": 151_655,
        "hidden_size": hidden, "intermediate_size": inner, "num_hidden_layers": layers,
        "num_attention_heads": heads, "num_key_value_heads": kv, "vocab_size": vocab,
        "rms_norm_eps": 1e-6, "rope_theta": 1e6, "tie_word_embeddings": tied,
        "rope_scaling": {"type": "mrope", "mrope_section": [16, 24, 24]},
        "vision_config": {
            "depth": 32, "hidden_act": "silu", "hidden_size": 1280, "intermediate_size": 3420, "num_heads": 16,
            "in_chans": 3, "out_hidden_size": hidden, "patch_size": 14, "spatial_merge_size": 2,
            "temporal_patch_size": 2, "window_size": 112, "fullatt_block_indexes": [7, 15, 23, 31],
        },
    }))
}

/// The checkpoint inside the crate.
fn tiny() -> Value {
    let text = include_str!("../../assets/sdim-tiny/config.json");
    serde_json::from_str(text).unwrap_or_default()
}

/// Values with the variance that keeps activations in range; norms are 1, biases 0.
pub fn random(name: &str, shape: &[usize]) -> Vec<f32> {
    let count = shape.iter().product();
    match shape {
        [_] if name.ends_with("bias") => vec![0.0; count],
        [_] => vec![1.0; count],
        _ => {
            let scale = (3.0 / (count / shape[0]) as f32).sqrt() / (1 << 23) as f32;
            let seed = name.bytes().fold(0x2545_F491u32, |s, b| s.wrapping_mul(31) ^ u32::from(b));
            let mut out = vec![0f32; count];
            out.par_chunks_mut((count / shape[0]).max(1)).enumerate().for_each(|(index, row)| {
                // A linear congruence is random enough for timing, and instant.
                let mut state = (seed ^ (index as u32).wrapping_mul(0x9E37_79B1)).wrapping_mul(0x85EB_CA6B);
                state ^= state >> 13;
                for value in row {
                    state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    *value = ((state >> 8) as f32 - (1 << 23) as f32) * scale;
                }
            });
            out
        }
    }
}
