//! Free generation, token by token.

use crate::error::{Error, Result};
use crate::vlm::checkpoint::json::Node;
use crate::vlm::files::{CONFIG, Source};
use crate::vlm::qwen2_5::QwenVl;
use crate::vlm::qwen2_5::decoder::Keep;
use crate::vlm::qwen2_5::rope::Position;
use crate::vlm::qwen2_5::sequences::Sequences;
use candle_core::{DType, Tensor};
use candle_transformers::generation::{LogitsProcessor, Sampling};
use serde_json::Value;
use std::path::Path;

pub(crate) const GENERATION: &str = "generation_config.json";
/// Ids that end an answer, in both files that may tell them.
const STOP_IDS: &str = "eos_token_id";

/// What a checkpoint says about generation, `generation_config.json`.
///
/// The published files ask for sampling at a temperature of 1e-6, which is greedy in all but name; this crate generates
/// greedily and reads no sampling keys.
#[derive(Debug, Clone, PartialEq)]
pub struct GenerationConfig {
    /// `repetition_penalty`; 1, which is off, where the file or the key is absent. Published: 1.05.
    pub repetition_penalty: f32,
    /// `eos_token_id`, a number or a list; that of `config.json` where the file or the key is absent; may be empty.
    pub stop_ids: Vec<u32>,
}

impl GenerationConfig {
    /// Reads a checkpoint directory, where `generation_config.json` may be absent.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Format`] if a file is no JSON; [`Error::Config`] names the key.
    pub fn from_dir(dir: impl AsRef<Path>) -> Result<Self> {
        Self::read(&Source::dir(dir.as_ref()))
    }

    pub(crate) fn read(source: &Source) -> Result<Self> {
        let mut generation = Self { repetition_penalty: 1.0, stop_ids: Vec::new() };
        if source.has(GENERATION) {
            let (file, json) = source.json(GENERATION)?;
            let penalty = Node::new(&file, "", &json).positive_or("repetition_penalty", 1.0)?;
            generation.repetition_penalty = penalty as f32;
            generation.stop_ids = stop_ids(&file, &json)?;
        }
        if generation.stop_ids.is_empty() {
            let (file, json) = source.json(CONFIG)?;
            generation.stop_ids = stop_ids(&file, &json)?;
            if let (true, Some(text)) = (generation.stop_ids.is_empty(), json.get("text_config")) {
                generation.stop_ids = stop_ids(&file, text)?;
            }
        }
        Ok(generation)
    }
}

fn stop_ids(file: &str, json: &Value) -> Result<Vec<u32>> {
    let id = |value: &Value| value.as_u64().and_then(|id| u32::try_from(id).ok());
    let value = json.get(STOP_IDS).unwrap_or(&Value::Null);
    let ids = match value {
        Value::Null => Some(Vec::new()),
        Value::Array(list) => list.iter().map(id).collect(),
        one => id(one).map(|id| vec![id]),
    };
    ids.ok_or_else(|| Error::config(file, STOP_IDS, value.to_string(), "a token id or a list of them"))
}

/// How to continue a prompt.
#[derive(Debug, Clone)]
pub struct GenerateOptions {
    /// Tokens at most.
    pub max_new_tokens: usize,
    /// Divides (or multiplies, if negative) the logit of every id seen so far; 1 is off. Published: 1.05.
    pub repetition_penalty: f32,
    /// Ids that end the answer (not returned).
    pub stop_ids: Vec<u32>,
    /// Ids from this one on have no token and are never chosen.
    pub usable_vocab: usize,
}

impl GenerateOptions {
    /// Checks the values that a user may set.
    ///
    /// # Errors
    /// [`Error::Argument`] if no token is asked for, or on a penalty that is not a positive, finite number.
    pub fn check(&self) -> Result<()> {
        if self.max_new_tokens == 0 {
            return Err(Error::argument("max_new_tokens", 0, "at least 1"));
        }
        if !(self.repetition_penalty.is_finite() && self.repetition_penalty > 0.0) {
            let expected = "a positive, finite number; 1 is off";
            return Err(Error::argument("repetition_penalty", self.repetition_penalty, expected));
        }
        Ok(())
    }
}

impl QwenVl {
    /// Continues a prompt greedily.
    ///
    /// `embedded` is `[tokens, hidden]` with one position per token, `next` the position that follows, `ids` the prompt.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] on mismatched shapes.
    pub fn generate(
        &self,
        ids: &[u32],
        embedded: &Tensor,
        positions: &[Position],
        next: f32,
        options: &GenerateOptions,
    ) -> Result<Vec<u32>> {
        self.generate_watched(ids, embedded, positions, next, options, &mut |_| Ok(()))
    }

    /// Like [`QwenVl::generate`]; `watch` receives the logits of each step, `[usable_vocab]` in f32, before the repetition
    /// penalty. An error that it returns ends the generation.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] on mismatched shapes; what `watch` returns.
    pub fn generate_watched(
        &self,
        ids: &[u32],
        embedded: &Tensor,
        positions: &[Position],
        next: f32,
        options: &GenerateOptions,
        watch: &mut dyn FnMut(&Tensor) -> Result<()>,
    ) -> Result<Vec<u32>> {
        let mut sampler = LogitsProcessor::from_sampling(0, Sampling::ArgMax);
        let mut prompt = self.decoder.cache(1);
        let hidden = self.prefill(embedded, positions, &mut prompt, Keep::Last)?;
        // The answer has a cache of its own, since a cache is copied when it grows.
        let mut sequence = Sequences::after(&self.decoder, &prompt, self.decoder.final_norm(&hidden)?, next);
        let mut answer: Vec<u32> = Vec::new();
        while answer.len() < options.max_new_tokens {
            if let Some(&id) = answer.last() {
                sequence.go_on(&[id])?;
            }
            let logits = self.decoder.logits(sequence.last())?.squeeze(0)?;
            let usable = options.usable_vocab.min(logits.dim(0)?);
            let logits = logits.narrow(0, 0, usable)?.to_dtype(DType::F32)?;
            watch(&logits)?;
            let logits = if options.repetition_penalty == 1.0 {
                logits
            } else {
                let mut values = logits.to_vec1::<f32>()?;
                penalise(&mut values, ids.iter().chain(&answer).copied(), options.repetition_penalty);
                Tensor::from_vec(values, usable, logits.device())?
            };
            let id = sampler.sample(&logits)?;
            if options.stop_ids.contains(&id) {
                break;
            }
            answer.push(id);
        }
        Ok(answer)
    }
}

/// Makes the tokens that were seen less likely, once each, as the reference's generation does.
pub(crate) fn penalise(logits: &mut [f32], seen: impl Iterator<Item = u32>, penalty: f32) {
    let mut seen: Vec<u32> = seen.collect();
    seen.sort_unstable();
    seen.dedup();
    for id in seen {
        if let Some(l) = logits.get_mut(id as usize) {
            *l = if *l < 0.0 { *l * penalty } else { *l / penalty };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn read(generation: Option<Value>, config: Value) -> Result<GenerationConfig> {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join(CONFIG), config.to_string()).unwrap();
        if let Some(json) = generation {
            std::fs::write(dir.path().join(GENERATION), json.to_string()).unwrap();
        }
        GenerationConfig::from_dir(dir.path())
    }

    #[test]
    fn the_file_goes_before_the_config_and_absent_keys_have_their_defaults() {
        let config = json!({"eos_token_id": 7});
        let wanted = |penalty: f32, ids: &[u32]| GenerationConfig {
            repetition_penalty: penalty,
            stop_ids: ids.to_vec(),
        };
        let both = json!({"repetition_penalty": 1.05, "eos_token_id": [3, 4]});
        assert_eq!(read(Some(both), config.clone()).unwrap(), wanted(1.05, &[3, 4]));
        assert_eq!(read(Some(json!({"eos_token_id": 5})), config.clone()).unwrap(), wanted(1.0, &[5]));
        let none = json!({"repetition_penalty": 1.2, "eos_token_id": null});
        assert_eq!(read(Some(none), config.clone()).unwrap(), wanted(1.2, &[7]));
        assert_eq!(read(None, config).unwrap(), wanted(1.0, &[7]));
        let nested = json!({"text_config": {"eos_token_id": [8]}});
        assert_eq!(read(None, nested).unwrap(), wanted(1.0, &[8]));
        assert_eq!(read(None, json!({})).unwrap(), wanted(1.0, &[]));
    }

    #[test]
    fn a_wrong_value_names_its_file_and_key() {
        for (json, wanted) in [
            (json!({"repetition_penalty": 0}), "repetition_penalty"),
            (json!({"repetition_penalty": "high"}), "repetition_penalty"),
            (json!({"eos_token_id": -1}), "eos_token_id"),
            (json!({"eos_token_id": [1, "x"]}), "eos_token_id"),
            (json!({"eos_token_id": 1u64 << 32}), "eos_token_id"),
        ] {
            match read(Some(json), json!({})) {
                Err(Error::Config { file, key, .. }) => {
                    assert!(file.ends_with(GENERATION), "{file}");
                    assert_eq!(key, wanted);
                }
                other => panic!("{wanted}: {other:?}"),
            }
        }
    }

    #[test]
    fn options_that_ask_for_nothing_or_divide_by_nothing_are_refused() {
        let with = |max_new_tokens, repetition_penalty| GenerateOptions {
            max_new_tokens,
            repetition_penalty,
            stop_ids: vec![],
            usable_vocab: 1,
        };
        assert!(with(1, 1.05).check().is_ok());
        for (tokens, penalty) in [(0, 1.0), (1, 0.0), (1, -1.0), (1, f32::NAN), (1, f32::INFINITY)] {
            let error = with(tokens, penalty).check();
            assert!(matches!(error, Err(Error::Argument { .. })), "{tokens} {penalty}: {error:?}");
        }
    }

    #[test]
    fn penalties_count_once_and_push_down() {
        let mut logits = [2.0, -2.0, 1.0];
        penalise(&mut logits, [0, 1, 0, 77].into_iter(), 2.0);
        assert_eq!(logits, [1.0, -4.0, 1.0]);
    }
}
