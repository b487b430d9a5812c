//! The checkpoint of the golden tests with a vocabulary, adapters for it, and what they make of it in one piece.

use crate::common::{device, root};
use candle_core::{Device, Tensor};
use sdim::internals::model::SdimModel;
use sdim::internals::query::number::bin_token;
use sdim::internals::supervise::FreshFiles;
use sdim::settings::{MeasurementPrompt, NumberFormat, NumberTokens, PromptTemplate, RopeLayout, Settings};
use sdim::{Adapter, Error, LoadOptions, WeightFormat};
use serde_json::{Value, json};
use std::collections::HashMap;
use std::path::Path;

pub const CPU: Device = Device::Cpu;
pub const BINS: usize = 40;
pub const EMBEDDING: &str = "sdim.number_tokens.embedding";
pub const HEAD: &str = "sdim.number_tokens.head";

pub type Tensors = HashMap<String, Tensor>;

/// Special tokens of the fixture's `config.json`, and two of our own that it has room for.
const SPECIAL: [(&str, u32); 9] = [
    ("<|point|>", 290),
    ("<|im_start|>", 296),
    ("<|vision_start|>", 297),
    ("<|vision_end|>", 298),
    ("<|vision_pad|>", 299),
    ("<|image_pad|>", 300),
    ("<|video_pad|>", 301),
    ("<|im_end|>", 302),
    ("<|endoftext|>", 303),
];

/// One token at the pixel asks, one answers; measurements and the hint are numbers, too.
pub fn pointer(tokens: NumberTokens) -> Settings {
    Settings {
        rope_layout: RopeLayout::Contiguous,
        position_scale: 1.0,
        glimpse: None,
        wide_glimpse: None,
        fusion: None,
        measurements: MeasurementPrompt::Prefix { max: 20 },
        number: NumberFormat::LogBins { bins: BINS, lowest: 0.1, highest: 10.0 },
        number_tokens: tokens,
        ..Settings::tiny()
    }
}

/// Words before and behind the number that asks, and before the answer.
pub fn in_words(tokens: NumberTokens) -> Settings {
    let template = PromptTemplate {
        before_image: "look:<|vision_start|>".into(),
        query: "how far is {pixel} here?".into(),
        answer: "it is {y} m away.".into(),
        ..PromptTemplate::tiny()
    };
    Settings { template, ..pointer(tokens) }
}

/// The golden tests' checkpoint, shaped and named as published, with a vocabulary of bytes; and what else is in its directory.
pub struct Base {
    dir: tempfile::TempDir,
    config: Value,
    pub tokenizer: Value,
    pub tensors: Tensors,
}

pub fn wave(rows: usize, columns: usize, turn: f32) -> Tensor {
    let values: Vec<f32> = (0..rows * columns).map(|i| (i as f32 * turn).sin() * 0.3).collect();
    Tensor::from_vec(values, (rows, columns), &CPU).unwrap()
}

impl Base {
    pub fn new(tied: bool) -> Self {
        let fixture = root().join("tests/fixtures/qwen_small");
        let read = |name: &str| std::fs::read(fixture.join(name)).unwrap();
        let mut config: Value = serde_json::from_slice(&read("config.json")).unwrap();
        config["tie_word_embeddings"] = tied.into();
        let mut tensors = candle_core::safetensors::load(fixture.join("model.safetensors"), &CPU).unwrap();
        let table = "model.embed_tokens.weight";
        let name = tensors.keys().find(|n| n.ends_with("embed_tokens.weight")).unwrap().clone();
        let embedding = tensors.remove(&name).unwrap();
        if !tied {
            tensors.insert("lm_head.weight".into(), wave(304, 48, 0.731));
        }
        tensors.insert(table.into(), embedding);
        let mut tokenizer: Value =
            serde_json::from_str(&FreshFiles::tiny(&Settings::paper()).unwrap().tokenizer).unwrap();
        // Ids have to follow each other, or the tokenizer counts its own.
        let special = |id: u32| {
            let name = SPECIAL.iter().find(|(_, own)| *own == id).map(|(name, _)| name.to_string());
            json!({"id": id, "content": name.unwrap_or(format!("<|unused{id}|>")), "single_word": false,
                   "lstrip": false, "rstrip": false, "normalized": false, "special": true})
        };
        tokenizer["added_tokens"] = (256..304).map(special).collect();
        let base = Self { dir: tempfile::tempdir().unwrap(), config, tokenizer, tensors };
        std::fs::write(base.path().join("preprocessor_config.json"), read("preprocessor_config.json"))
            .unwrap();
        base.write(&base.tensors);
        base
    }

    pub fn path(&self) -> &Path {
        self.dir.path()
    }

    pub fn write(&self, tensors: &Tensors) {
        for (name, json) in [("config.json", &self.config), ("tokenizer.json", &self.tokenizer)] {
            std::fs::write(self.path().join(name), json.to_string()).unwrap();
        }
        let bytes = safetensors::serialize(tensors, None).unwrap();
        std::fs::write(self.path().join("model.safetensors"), bytes).unwrap();
    }

    /// The tensors of an adapter with these settings, unlike each other and large enough that answers differ.
    pub fn adapter(&self, settings: &Settings) -> Adapter {
        let mut adapter = Adapter::starting(self.path(), settings.clone(), 3).unwrap();
        for (name, turn) in [(EMBEDDING, 0.377), (HEAD, 0.913)] {
            if let Some(rows) = adapter.tensors.get_mut(name) {
                *rows = wave(BINS, 48, turn);
            }
        }
        adapter
    }

    pub fn load(&self, adapter: Option<&Adapter>, format: WeightFormat) -> Result<SdimModel, Error> {
        let dir = tempfile::tempdir().unwrap();
        let mut options = LoadOptions::on(&device()).with_weights(format);
        if let Some(adapter) = adapter {
            adapter.save(dir.path())?;
            options = options.with_adapter(dir.path());
        }
        SdimModel::load(self.path(), &options)
    }

    pub fn adapted(&self, settings: &Settings, format: WeightFormat) -> SdimModel {
        self.load(Some(&self.adapter(settings)), format).unwrap()
    }

    /// The checkpoint whose vocabulary, embedding and head have the adapter's number tokens in one piece with its own.
    pub fn concatenated(&self, settings: &Settings) -> Self {
        let adapter = self.adapter(settings);
        let mut tensors = self.tensors.clone();
        for (table, part) in [("model.embed_tokens.weight", EMBEDDING), ("lm_head.weight", HEAD)] {
            if let Some(rows) = adapter.tensors.get(part) {
                tensors.insert(table.into(), Tensor::cat(&[&tensors[table], rows], 0).unwrap());
            }
        }
        let (mut config, mut tokenizer) = (self.config.clone(), self.tokenizer.clone());
        config["vocab_size"] = (304 + BINS).into();
        let added = tokenizer["added_tokens"].as_array_mut().unwrap();
        for k in 0..BINS {
            let mut token = added[0].clone();
            (token["content"], token["id"]) = (bin_token(k).into(), (304 + k).into());
            added.push(token);
        }
        let dir = tempfile::tempdir().unwrap();
        let name = "preprocessor_config.json";
        std::fs::copy(self.path().join(name), dir.path().join(name)).unwrap();
        let settings = Settings { number_tokens: NumberTokens::Vocabulary, ..settings.clone() };
        std::fs::write(dir.path().join("sdim.json"), settings.to_json().unwrap()).unwrap();
        let whole = Self { dir, config, tokenizer, tensors };
        whole.write(&whole.tensors);
        whole
    }
}
