//! The small vocabulary: bytes, special tokens, numbers.

use crate::query::number::bin_token;
use serde_json::{Value, json};

/// Special tokens of the small vocabulary, after the 256 bytes.
const SPECIAL: [&str; 9] = [
    "<|endoftext|>",
    "<|im_start|>",
    "<|im_end|>",
    "<|vision_start|>",
    "<|vision_end|>",
    "<|vision_pad|>",
    "<|image_pad|>",
    "<|video_pad|>",
    "<|point|>",
];

/// Tokens of the vocabulary before the number tokens.
pub(super) const WORDS: usize = 256 + SPECIAL.len();

/// Id of a special token.
pub(super) fn special_id(token: &str) -> usize {
    256 + SPECIAL.iter().position(|s| *s == token).unwrap_or_default()
}

/// A byte-level BPE without merges: any text can be written, one token per byte; then the special and number tokens.
pub(super) fn byte_tokenizer(numbers: usize) -> Value {
    // The printable stand-ins of the byte-level alphabet: bytes that print stand for themselves, the others are moved
    // up from 256 in order.
    let prints = |b: u8| matches!(b, 33..=126 | 161..=172 | 174..=255);
    let mut moved = 0u32;
    let mut vocab = serde_json::Map::new();
    for b in 0..=255u8 {
        let code = if prints(b) { u32::from(b) } else { 256 + moved };
        moved += u32::from(!prints(b));
        if let Some(c) = char::from_u32(code) {
            vocab.insert(c.to_string(), json!(b));
        }
    }
    let names = SPECIAL.iter().map(|s| s.to_string()).chain((0..numbers).map(bin_token));
    let added: Vec<Value> = names
        .enumerate()
        .map(|(i, content)| {
            json!({"id": 256 + i, "content": content, "single_word": false, "lstrip": false,
                   "rstrip": false, "normalized": false, "special": true})
        })
        .collect();
    let byte_level =
        json!({"type": "ByteLevel", "add_prefix_space": false, "trim_offsets": false, "use_regex": false});
    json!({
        "version": "1.0", "truncation": null, "padding": null, "added_tokens": added,
        "normalizer": null, "pre_tokenizer": byte_level, "post_processor": null, "decoder": byte_level,
        "model": {"type": "BPE", "dropout": null, "unk_token": null, "continuing_subword_prefix": null,
                  "end_of_word_suffix": null, "fuse_unk": false, "byte_fallback": false, "ignore_merges": false,
                  "vocab": vocab, "merges": []},
    })
}
