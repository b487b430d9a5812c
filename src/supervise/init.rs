//! A fresh small checkpoint: its configuration, its vocabulary and its initial weights.

use super::shape::Shape;
use crate::adapter::SETTINGS;
use crate::error::{Error, Result};
use crate::files::{write_tensors, write_whole};
use crate::model::{CheckpointFiles, SdimModel};
use crate::query::Settings;
use crate::query::number::{NumberFormat, Numbers, bin_token};
use crate::vlm::checkpoint::{CONFIG, PREPROCESSOR, TOKENIZER};
use crate::vlm::weights::Weights;
use candle_core::{Device, Tensor};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::Path;

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

/// The JSON files of a checkpoint, as text.
#[derive(Debug, Clone, PartialEq)]
pub struct FreshFiles {
    /// `config.json`
    pub config: String,
    /// `preprocessor_config.json`
    pub preprocessor: String,
    /// `sdim.json`
    pub settings: String,
    /// `tokenizer.json`
    pub tokenizer: String,
}

impl FreshFiles {
    /// The tiny model.
    ///
    /// # Errors
    /// As [`FreshFiles::of`].
    pub fn tiny(settings: &Settings) -> Result<Self> {
        Self::of(&Shape::tiny(), settings)
    }

    /// A model of any shape.
    ///
    /// # Errors
    /// [`Error::Config`] names the key whose size does not fit; [`Error::Format`] if a part cannot be written as JSON.
    pub fn of(shape: &Shape, settings: &Settings) -> Result<Self> {
        let numbers = match settings.number {
            NumberFormat::Bins { bins, .. } => bins,
            NumberFormat::Digits { .. } => 0,
        };
        let text = |what: &str, value: &Value| {
            serde_json::to_string_pretty(value).map_err(|e| Error::format(what, e.to_string(), "JSON"))
        };
        let files = Self {
            config: text(CONFIG, &shape.config(numbers))?,
            preprocessor: text(PREPROCESSOR, &shape.preprocessor())?,
            settings: settings.to_json()?,
            tokenizer: byte_tokenizer(numbers).to_string(),
        };
        files.parse()?;
        Ok(files)
    }

    /// Writes the four files into a checkpoint directory.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write(&self, dir: &Path) -> Result<()> {
        std::fs::create_dir_all(dir).map_err(Error::io(dir))?;
        for (name, text) in [
            (CONFIG, &self.config),
            (PREPROCESSOR, &self.preprocessor),
            (SETTINGS, &self.settings),
            (TOKENIZER, &self.tokenizer),
        ] {
            write_whole(&dir.join(name), text.as_bytes())?;
        }
        Ok(())
    }

    /// Initial values of all tensors of a model of these files, by [`initial`].
    ///
    /// # Errors
    /// As [`FreshFiles::parse`] and [`initial`]; [`Error::Config`] if the patches of the two files differ.
    pub fn initial(&self, seed: u64) -> Result<BTreeMap<String, Tensor>> {
        let parsed = self.parse()?;
        let layers = parsed.config.text.layers;
        let number_ids = Numbers::new(parsed.settings.number, &parsed.tokenizer)?.ids;
        let empty = Weights::from_tensors("fresh", Default::default());
        // Building on nothing fails, but not before each tensor was asked for.
        match SdimModel::new(parsed, &empty, &Device::Cpu) {
            Err(Error::TensorSet { .. }) => initial(&empty.wanted(), &number_ids, layers, seed),
            Err(other) => Err(other),
            Ok(_) => Err(Error::argument("layout", "no tensors", "a model with weights")),
        }
    }

    /// Writes a checkpoint directory with the initial values, in f32: where training starts.
    ///
    /// # Errors
    /// As [`FreshFiles::initial`]; [`Error::Io`].
    pub fn write_initial(&self, dir: &Path, seed: u64) -> Result<()> {
        self.write(dir)?;
        write_tensors(&dir.join("model.safetensors"), &self.initial(seed)?)
    }

    /// Parses them as a loader would.
    ///
    /// # Errors
    /// As [`CheckpointFiles::from_bytes`].
    pub fn parse(&self) -> Result<CheckpointFiles> {
        let [c, p, s, t] = [&self.config, &self.preprocessor, &self.settings, &self.tokenizer];
        CheckpointFiles::from_bytes("fresh", c.as_bytes(), p.as_bytes(), s.as_bytes(), t.as_bytes())
    }
}

/// A byte-level BPE without merges: any text can be written, one token per byte; then the special and number tokens.
fn byte_tokenizer(numbers: usize) -> Value {
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

fn normal(rng: &mut ChaCha8Rng) -> f32 {
    let (u, v): (f32, f32) = (rng.random::<f32>().max(1e-9), rng.random());
    (-2.0 * u.ln()).sqrt() * (std::f32::consts::TAU * v).cos()
}

/// Initial values of all tensors of a layout (see [`crate::vlm::weights::Weights::wanted`]).
///
/// Norms are 1, biases 0, projections normal with variance 1 / inputs (those into the residual stream smaller), fusion
/// convolutions He; the depth branch's and the last fusion convolution are 0 as the paper asks (Eq. 1b, 2b), and so is the
/// second factor of each LoRA. Number tokens
/// start as sinusoids of their value.
///
/// # Errors
/// [`Error::Tensors`] if a tensor cannot be made.
pub fn initial(
    layout: &BTreeMap<String, Vec<usize>>,
    number_ids: &[u32],
    layers: usize,
    seed: u64,
) -> Result<BTreeMap<String, Tensor>> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut out = BTreeMap::new();
    for (name, shape) in layout {
        let count: usize = shape.iter().product();
        let fan_in = (count / shape[0]) as f32;
        let residual = 0.5 / (2.0 * layers as f32).sqrt();
        let std = if name.ends_with("bias")
            || name.ends_with("running_mean")
            || name.starts_with("sdim.fusion.depth.conv")
            || name.starts_with("sdim.fusion.out")
            || name.starts_with("sdim.glimpse")
            || name.contains(".lora_B.")
        {
            0.0
        } else if name.starts_with("sdim.fusion") && shape.len() == 4 {
            (2.0 / fan_in).sqrt()
        } else if name.ends_with("embed_tokens.weight") {
            0.1
        } else if name.contains("o_proj") || name.contains("down_proj") || name.contains("attn.proj") {
            residual / fan_in.sqrt()
        } else {
            1.0 / fan_in.sqrt()
        };
        let mut values: Vec<f32> = if shape.len() == 1 && std != 0.0 {
            vec![1.0; count]
        } else if std == 0.0 {
            vec![0.0; count]
        } else {
            (0..count).map(|_| normal(&mut rng) * std).collect()
        };
        if name.ends_with("embed_tokens.weight") && number_ids.len() > 11 {
            write_sinusoids(&mut values, shape[1], number_ids);
        }
        out.insert(name.clone(), Tensor::from_vec(values, shape.as_slice(), &Device::Cpu)?);
    }
    Ok(out)
}

/// Rows of the number tokens: pairs of cosine and sine of the value at frequencies from half a turn over the whole
/// range up to one turn over five bins.
fn write_sinusoids(table: &mut [f32], width: usize, ids: &[u32]) {
    const AMPLITUDE: f32 = 0.28;
    let pairs = width / 2;
    let top = ids.len() as f32 * 0.4;
    for (k, &id) in ids.iter().enumerate() {
        let value = (k as f32 + 0.5) / ids.len() as f32;
        let row = &mut table[id as usize * width..][..width];
        for j in 0..pairs {
            let turn = std::f32::consts::PI * top.powf(j as f32 / (pairs - 1).max(1) as f32) * value;
            row[2 * j] = turn.cos() * AMPLITUDE;
            row[2 * j + 1] = turn.sin() * AMPLITUDE;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fresh_files_parse_and_any_text_survives_the_tokenizer() {
        let files = FreshFiles::tiny(&Settings::tiny()).unwrap().parse().unwrap();
        let text = "The distance is 4.230 m — größer\n\u{0}";
        let ids = files.tokenizer.encode(text).unwrap();
        assert_eq!(ids.len(), text.len(), "one token per byte");
        assert_eq!(files.tokenizer.decode(&ids).unwrap(), text);
        let marked = files.tokenizer.encode("<|vision_start|><|image_pad|>").unwrap();
        assert_eq!(marked, [files.config.ids.vision_start, files.config.ids.image]);
        assert!(files.tokenizer.vocab_size() <= files.config.text.vocab_size);
    }
}
