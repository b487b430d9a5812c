//! Free generation, token by token.

use crate::error::{Error, Result};
use crate::vlm::checkpoint::json::Node;
use crate::vlm::files::{CONFIG, Source};
use crate::vlm::qwen2_5::QwenVl;
use crate::vlm::qwen2_5::decoder::Keep;
use crate::vlm::qwen2_5::rope::Position;
use crate::vlm::qwen2_5::sequences::Sequences;
use candle_core::{DType, Tensor};
use candle_transformers::generation::{self, LogitsProcessor};
use candle_transformers::utils::apply_repeat_penalty;
use serde_json::Value;
use std::path::Path;

pub(crate) const GENERATION: &str = "generation_config.json";
/// Ids that end an answer, in both files that may tell them.
const STOP_IDS: &str = "eos_token_id";

/// What a checkpoint says about generation, `generation_config.json`.
///
/// The published files ask for sampling at a temperature of 1e-6, which is greedy in all but name; this crate answers greedily
/// unless [`Sampling`] is asked for, and reads no sampling keys.
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

/// Tokens drawn at random instead of the likeliest ones.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sampling {
    /// Divides the logits before the softmax: below 1 for safer, above 1 for wilder answers; positive.
    pub temperature: f64,
    /// The least set of likeliest tokens whose probabilities sum up to this, above 0 and at most 1; `None` for all tokens.
    pub top_p: Option<f64>,
    /// The same seed gives the same answer.
    pub seed: u64,
}

impl Sampling {
    fn check(&self) -> Result<()> {
        if !(self.temperature.is_finite() && self.temperature > 0.0) {
            let expected = "a positive, finite number; no sampling at all is greedy";
            return Err(Error::argument("temperature", self.temperature, expected));
        }
        match self.top_p {
            Some(p) if !(p > 0.0 && p <= 1.0) => Err(Error::argument("top_p", p, "above 0 and at most 1")),
            _ => Ok(()),
        }
    }

    /// What chooses the next token.
    fn processor(sampling: Option<&Self>) -> LogitsProcessor {
        let greedy = LogitsProcessor::from_sampling(0, generation::Sampling::ArgMax);
        sampling.map_or(greedy, |s| {
            let (p, temperature) = (s.top_p, s.temperature);
            let kind = match p {
                Some(p) => generation::Sampling::TopP { p, temperature },
                None => generation::Sampling::All { temperature },
            };
            LogitsProcessor::from_sampling(s.seed, kind)
        })
    }
}

/// How to continue a prompt.
#[derive(Debug, Clone)]
pub struct GenerateOptions {
    /// Tokens at most.
    pub max_new_tokens: usize,
    /// Divides (or multiplies, if negative) the logit of every id seen so far; 1 is off. Published: 1.05.
    pub repetition_penalty: f32,
    /// How tokens are drawn; `None` for the likeliest one each time.
    pub sampling: Option<Sampling>,
    /// Ids that end the answer (not returned).
    pub stop_ids: Vec<u32>,
    /// Ids from this one on have no token and are never chosen.
    pub usable_vocab: usize,
}

impl GenerateOptions {
    /// Checks the values that a user may set.
    ///
    /// # Errors
    /// [`Error::Argument`] if no token is asked for, on a penalty or temperature that is not a positive, finite number, or a
    /// `top_p` outside 0 to 1.
    pub fn check(&self) -> Result<()> {
        if self.max_new_tokens == 0 {
            return Err(Error::argument("max_new_tokens", 0, "at least 1"));
        }
        if !(self.repetition_penalty.is_finite() && self.repetition_penalty > 0.0) {
            let expected = "a positive, finite number; 1 is off";
            return Err(Error::argument("repetition_penalty", self.repetition_penalty, expected));
        }
        self.sampling.as_ref().map_or(Ok(()), Sampling::check)
    }
}

impl QwenVl {
    /// Continues a prompt.
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
        let mut sampler = Sampling::processor(options.sampling.as_ref());
        let mut prompt = self.decoder.cache(1);
        let hidden = self.prefill(embedded, positions, &mut prompt, Keep::Last)?;
        // The answer has a cache of its own, since a cache is copied when it grows.
        let mut sequence = Sequences::after(&self.decoder, &prompt, self.decoder.final_norm(&hidden)?, next);
        let mut answer: Vec<u32> = Vec::new();
        while answer.len() < options.max_new_tokens {
            if let Some(&id) = answer.last() {
                sequence.decode_step(&[id])?;
            }
            let logits = self.decoder.logits(sequence.last())?.squeeze(0)?;
            let usable = options.usable_vocab.min(logits.dim(0)?);
            let logits = logits.narrow(0, 0, usable)?.to_dtype(DType::F32)?;
            watch(&logits)?;
            let logits = if options.repetition_penalty == 1.0 {
                logits
            } else {
                let seen: Vec<u32> = ids.iter().chain(&answer).copied().collect();
                apply_repeat_penalty(&logits, options.repetition_penalty, &seen)?
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
            sampling: None,
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
    fn sampling_out_of_range_is_refused() {
        let check = |temperature, top_p| Sampling { temperature, top_p, seed: 0 }.check();
        assert!(check(0.7, None).is_ok() && check(1.0, Some(1.0)).is_ok() && check(2.0, Some(0.1)).is_ok());
        let bad = [
            (0.0, None),
            (-1.0, None),
            (f64::NAN, None),
            (f64::INFINITY, None),
            (1.0, Some(0.0)),
            (1.0, Some(1.1)),
        ];
        for (temperature, top_p) in bad {
            assert!(
                matches!(check(temperature, top_p), Err(Error::Argument { .. })),
                "{temperature} {top_p:?}"
            );
        }
    }

    #[test]
    fn draws_follow_temperature_top_p_and_seed() {
        let logits = Tensor::new(&[2.0f32, 1.0, 0.0, -8.0], &candle_core::Device::Cpu).unwrap();
        let draws = |sampling: Option<Sampling>| -> Vec<u32> {
            let mut processor = Sampling::processor(sampling.as_ref());
            (0..200).map(|_| processor.sample(&logits).unwrap()).collect()
        };
        let sampled = |temperature, top_p, seed| draws(Some(Sampling { temperature, top_p, seed }));
        let seen = |draws: &[u32], id: u32| draws.iter().filter(|d| **d == id).count();
        assert_eq!(seen(&draws(None), 0), 200);
        let warm = sampled(1.0, None, 1);
        assert!((100..170).contains(&seen(&warm, 0)) && seen(&warm, 1) > 20 && seen(&warm, 2) > 2);
        assert_eq!(warm, sampled(1.0, None, 1));
        assert_ne!(warm, sampled(1.0, None, 2));
        assert!(seen(&sampled(0.1, None, 1), 0) >= 199);
        // The likeliest token alone has 0.665.
        assert_eq!(seen(&sampled(1.0, Some(0.5), 1), 0), 200);
        assert_eq!(seen(&sampled(1.0, Some(0.8), 1), 2), 0);
    }
}
