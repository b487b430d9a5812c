//! Ids of texts and conversations against the reference.
//!
//! `tests/fixtures/chat.json` is written by `tests/reference/make_chat.py`. The published tokenizer is not part of the
//! repository: what needs it looks for a directory beside it and says so when it is not there.

mod common;

use sdim::chat::{ChatPrompt, Part};
use sdim::internals::vlm::chat::template::{Message, Role, expand_image_placeholders};
use sdim::internals::vlm::chat::tokenizer::Tokenizer;
use sdim::internals::vlm::qwen2_5::config::{SpecialIds, VlmConfig};
use sdim::internals::vlm::qwen2_5::preprocess::PreprocessorConfig;
use serde_json::Value;
use std::path::{Path, PathBuf};

fn json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

fn published() -> Option<PathBuf> {
    common::beside("tokenizer", "tokenizer.json")
}

fn ids_of(value: &Value) -> Vec<u32> {
    serde_json::from_value(value.clone()).unwrap()
}

struct Conversation {
    name: String,
    prompt: ChatPrompt,
    /// Height and width of each image.
    sizes: Vec<(usize, usize)>,
    text: String,
    tokens: Vec<usize>,
    ids: Vec<u32>,
}

fn conversation(json: &Value) -> Conversation {
    let mut sizes = Vec::new();
    let mut part = |value: &Value| match value.as_str() {
        Some(text) => Part::from(text),
        None => {
            sizes.push(serde_json::from_value(value.clone()).unwrap());
            Part::Image
        }
    };
    let role = |name: &Value| match name.as_str() {
        Some("system") => Role::System,
        Some("user") => Role::User,
        Some("assistant") => Role::Assistant,
        _ => panic!("role {name}"),
    };
    let mut message = |m: &Value| Message {
        role: role(&m["role"]),
        content: m["content"].as_array().unwrap().iter().map(&mut part).collect(),
    };
    let messages = json["messages"].as_array().unwrap().iter().map(&mut message).collect();
    let prompt = ChatPrompt { messages, number_images: json["number_images"].as_bool().unwrap() };
    Conversation {
        name: json["name"].as_str().unwrap().to_string(),
        prompt,
        sizes,
        text: json["text"].as_str().unwrap().to_string(),
        tokens: serde_json::from_value(json["tokens"].clone()).unwrap(),
        ids: ids_of(&json["ids"]),
    }
}

fn conversations() -> Vec<Conversation> {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/chat.json");
    let all: Vec<_> = json(&file).as_array().unwrap().iter().map(conversation).collect();
    assert!(all.len() >= 12);
    all
}

/// The ids of the published configuration.
fn special() -> SpecialIds {
    SpecialIds { vision_start: 151652, vision_end: 151653, image: 151655 }
}

#[test]
fn conversations_read_as_the_published_template_writes_them() {
    for c in conversations() {
        assert_eq!(c.prompt.text(), c.text, "{}", c.name);
        assert_eq!(c.prompt.images(), c.sizes.len(), "{}", c.name);
    }
}

#[test]
fn images_of_conversations_get_as_many_tokens_as_in_the_reference() {
    let limits = serde_json::json!({"min_pixels": 3136, "max_pixels": 12845056});
    let config = PreprocessorConfig::from_json("limits", &limits).unwrap();
    for c in conversations() {
        let tokens = c.sizes.iter().map(|&(height, width)| {
            let (w, h) = config.smart_resize(width, height).unwrap();
            w * h / (28 * 28)
        });
        assert_eq!(tokens.collect::<Vec<_>>(), c.tokens, "{}", c.name);
    }
}

#[test]
fn placeholders_expand_to_the_ids_of_the_reference() {
    let image = special().image;
    for c in conversations() {
        let mut folded = Vec::new();
        for &id in &c.ids {
            if id != image || folded.last() != Some(&image) {
                folded.push(id);
            }
        }
        assert_eq!(expand_image_placeholders(&folded, image, &c.tokens).unwrap(), c.ids, "{}", c.name);
    }
}

#[test]
fn conversations_have_the_ids_of_the_reference() {
    let Some(dir) = published() else { return };
    let tokenizer = Tokenizer::from_file(&dir.join("tokenizer.json")).unwrap();
    let config = VlmConfig::from_json("config-3b.json", &json(&dir.join("config-3b.json"))).unwrap();
    assert_eq!(config.ids, special());
    for c in conversations() {
        let ids = c.prompt.ids(&tokenizer, &config.ids, &c.tokens).unwrap();
        assert_eq!(ids, c.ids, "{}", c.name);
    }
    let other = SpecialIds { image: 7, ..special() };
    let message = ChatPrompt::new().ids(&tokenizer, &other, &[]).unwrap_err().to_string();
    assert_eq!(message, "tokenizer: `<|image_pad|>` is 151655; expected 7, as config.json");
}

#[test]
fn the_published_template_is_the_one_written_out() {
    let Some(dir) = published() else { return };
    let template = json(&dir.join("chat_template.json"))["chat_template"].as_str().unwrap().to_string();
    assert_eq!(
        template.trim_end(),
        std::fs::read_to_string(dir.join("chat_template.jinja")).unwrap().trim_end()
    );
    assert!(template.contains(sdim::internals::vlm::chat::template::DEFAULT_SYSTEM));
}

#[test]
fn texts_have_the_ids_of_the_reference() {
    let Some(dir) = published() else { return };
    let tokenizer = Tokenizer::from_file(&dir.join("tokenizer.json")).unwrap();
    let golden = json(&dir.join("tokenizer_golden_400.json"));
    let golden = golden.as_array().unwrap();
    for case in golden {
        let text = case["text"].as_str().unwrap();
        assert_eq!(tokenizer.encode(text).unwrap(), ids_of(&case["ids"]), "{text:?}");
    }
    assert_eq!((golden.len(), tokenizer.vocab_size()), (400, 151665));
}
