//! A checkpoint that answers questions about images: plain Qwen2.5-VL, as published.

use super::generate::{GenerateOptions, GenerationConfig, Sampling};
use super::template::{ChatPrompt, IMAGE_PLACEHOLDER, Part};
use super::tokenizer::Tokenizer;
use crate::error::{Error, Result};
use crate::vlm::checkpoint::LoadOptions;
use crate::vlm::checkpoint::weights::Weights;
use crate::vlm::files::{Source, TOKENIZER, check_patches};
use crate::vlm::qwen2_5::QwenVl;
use crate::vlm::qwen2_5::config::VlmConfig;
use crate::vlm::qwen2_5::grid::Grid;
use crate::vlm::qwen2_5::positions::positions;
use crate::vlm::qwen2_5::preprocess::{Pixels, PreprocessorConfig};
use crate::vlm::qwen2_5::rope::RopeLayout;
use candle_core::{Device, Tensor};
use image::RgbImage;
use std::path::Path;

/// Logits that an [`Answer`] keeps of its first token.
const TOP_LOGITS: usize = 20;

/// A published Qwen2.5-VL checkpoint, or a fine-tune of one, to talk to. Immutable: share it by `Arc`.
///
/// ```no_run
/// use sdim::LoadOptions;
/// use sdim::chat::{AnswerOptions, ChatModel};
/// let model = ChatModel::load("Qwen2.5-VL-3B-Instruct", &LoadOptions::default())?;
/// let image = sdim::read_rgb("kitchen.jpg")?;
/// let answer = model.answer(&image, "How far is the kettle?", &AnswerOptions::default())?;
/// println!("{}", answer.text);
/// # Ok::<(), sdim::Error>(())
/// ```
pub struct ChatModel {
    /// Vision encoder and decoder.
    vlm: QwenVl,
    /// How images are resized and normalised.
    preprocessor: PreprocessorConfig,
    /// Text to ids.
    tokenizer: Tokenizer,
    /// What `generation_config.json` says.
    generation: GenerationConfig,
    usable_vocab: usize,
    device: Device,
}

/// How to answer; what is `None` is as the checkpoint's `generation_config.json` says.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct AnswerOptions {
    /// Tokens at most, at least 1.
    pub max_new_tokens: usize,
    /// Divides (multiplies, if negative) the logit of every id of the prompt and the answer so far; positive, 1 is off.
    pub repetition_penalty: Option<f32>,
    /// How tokens are drawn; `None` for the likeliest one each time.
    pub sampling: Option<Sampling>,
    /// Ids that end the answer.
    pub stop_ids: Option<Vec<u32>>,
}

impl Default for AnswerOptions {
    fn default() -> Self {
        Self { max_new_tokens: 128, repetition_penalty: None, sampling: None, stop_ids: None }
    }
}

impl AnswerOptions {
    /// With this many tokens at most.
    pub fn with_max_new_tokens(mut self, tokens: usize) -> Self {
        self.max_new_tokens = tokens;
        self
    }

    /// With this repetition penalty.
    pub fn with_repetition_penalty(mut self, penalty: f32) -> Self {
        self.repetition_penalty = Some(penalty);
        self
    }

    /// With tokens drawn at random.
    pub fn with_sampling(mut self, sampling: Sampling) -> Self {
        self.sampling = Some(sampling);
        self
    }

    /// With these ids that end the answer.
    pub fn with_stop_ids(mut self, ids: Vec<u32>) -> Self {
        self.stop_ids = Some(ids);
        self
    }
}

/// A question and its answer in numbers and in words.
#[derive(Debug, Clone, PartialEq)]
pub struct Answer {
    /// The prompt, image placeholders expanded.
    pub prompt_ids: Vec<u32>,
    /// The answer, without the id that ended it.
    pub generated_ids: Vec<u32>,
    /// The answer in words, without special tokens.
    pub text: String,
    /// Ids and logits of the first answered token, the 20 highest in falling order, before the repetition penalty. Columns
    /// of the output head that have no token are not among them.
    pub first_logits_top: Vec<(u32, f32)>,
}

impl ChatModel {
    /// Loads a checkpoint directory as published or as `transformers` saves it: `config.json`, `preprocessor_config.json`,
    /// `tokenizer.json`, `generation_config.json` if it is there, and `model.safetensors` or its shards with their index.
    ///
    /// # Errors
    /// Typed errors that name the file and the key or tensor. [`Error::TensorSet`] on a checkpoint with tensors that plain
    /// Qwen2.5-VL does not have (load one made for depth as [`crate::DepthCompleter`]); [`Error::Argument`] if the options name an
    /// adapter, which is for depth.
    pub fn load(dir: impl AsRef<Path>, options: &LoadOptions) -> Result<Self> {
        if let Some(adapter) = &options.adapter {
            return Err(Error::argument("adapter", adapter.display(), "none: adapters are made for depth"));
        }
        let device = &options.device;
        let dir = dir.as_ref();
        let source = Source::dir(dir);
        let (config, preprocessor) = (source.config()?, source.preprocessor()?);
        check_patches(&preprocessor, &config)?;
        let tokenizer = source.tokenizer()?;
        check_placeholder(&source, &tokenizer, &config)?;
        let generation = GenerationConfig::from_dir(dir)?;
        let weights = Weights::from_dir(dir, device)?.with_format(options.weights);
        let vlm = QwenVl::new(config, &weights, RopeLayout::Contiguous)?;
        weights.finish()?;
        let usable_vocab = tokenizer.vocab_size();
        Ok(Self { vlm, preprocessor, tokenizer, generation, usable_vocab, device: device.clone() })
    }

    /// With images of at most this many pixels: less time and memory per image, and coarser sight. Published: 12,845,056.
    ///
    /// # Errors
    /// [`Error::Argument`] if it is below what the checkpoint's `min_pixels` asks for.
    pub fn with_max_pixels(mut self, pixels: usize) -> Result<Self> {
        let least = self.preprocessor.min_pixels;
        if pixels < least {
            return Err(Error::argument("max_pixels", pixels, format!("at least min_pixels, {least}")));
        }
        self.preprocessor.max_pixels = pixels;
        Ok(self)
    }

    /// Answers a question about an image, in one turn after the default system turn.
    ///
    /// # Errors
    /// [`Error::Argument`] if the question is empty; as [`ChatModel::reply`].
    pub fn answer(&self, image: &RgbImage, question: &str, options: &AnswerOptions) -> Result<Answer> {
        if question.trim().is_empty() {
            return Err(Error::argument("question", format!("{question:?}"), "some text"));
        }
        let prompt = ChatPrompt::new().user([Part::Image, question.into()]);
        self.reply(&prompt, &[image], options)
    }

    /// Continues a conversation; `images` are those of the conversation, in order.
    ///
    /// # Errors
    /// [`Error::Argument`] on an option out of range or if the images are not as many as the conversation shows;
    /// [`Error::ImageSize`]; [`Error::Tokenizer`].
    pub fn reply(
        &self,
        prompt: &ChatPrompt,
        images: &[&RgbImage],
        options: &AnswerOptions,
    ) -> Result<Answer> {
        let defaults = &self.generation;
        let options = GenerateOptions {
            max_new_tokens: options.max_new_tokens,
            repetition_penalty: options.repetition_penalty.unwrap_or(defaults.repetition_penalty),
            sampling: options.sampling,
            stop_ids: options.stop_ids.as_ref().unwrap_or(&defaults.stop_ids).clone(),
            usable_vocab: self.usable_vocab,
        };
        options.check()?;
        let pixels: Vec<Pixels> =
            images.iter().map(|image| self.preprocessor.resize(image)).collect::<Result<_>>()?;
        let grids: Vec<Grid> = pixels.iter().map(|p| p.grid).collect();
        let config = &self.vlm.config;
        let unit = config.vision.merge_size.pow(2);
        let tokens: Vec<usize> = grids.iter().map(|g| g.patches() / unit).collect();
        let ids = prompt.ids(&self.tokenizer, &config.ids, &tokens)?;
        let walked = positions(&ids, &grids, config, 1.0)?;
        let embedded = self.embed(&ids, &pixels, &grids)?;
        let mut first: Option<Vec<f32>> = None;
        let generated_ids = self.vlm.generate_watched(
            &ids,
            &embedded,
            &walked.positions,
            walked.next,
            &options,
            &mut |logits| {
                if first.is_none() {
                    first = Some(logits.to_vec1()?);
                }
                Ok(())
            },
        )?;
        Ok(Answer {
            text: self.tokenizer.decode(&generated_ids)?,
            first_logits_top: top(&first.unwrap_or_default()),
            prompt_ids: ids,
            generated_ids,
        })
    }

    /// The prompt with its images in their places, `[ids, hidden]`.
    fn embed(&self, ids: &[u32], pixels: &[Pixels], grids: &[Grid]) -> Result<Tensor> {
        if pixels.is_empty() {
            return self.vlm.decoder.embed(ids);
        }
        let patches = pixels.iter().map(|p| self.preprocessor.patches(p, &self.device));
        let patches = Tensor::cat(&patches.collect::<Result<Vec<_>>>()?, 0)?;
        self.vlm.embed_prompt(ids, &self.vlm.encode(&patches, grids)?)
    }
}

/// A tokenizer of another model is refused before the weights are read.
fn check_placeholder(source: &Source, tokenizer: &Tokenizer, config: &VlmConfig) -> Result<()> {
    let found = match tokenizer.id(IMAGE_PLACEHOLDER) {
        Ok(id) if id == config.ids.image => return Ok(()),
        Ok(id) => format!("token `{IMAGE_PLACEHOLDER}` with id {id}"),
        Err(_) => format!("no token `{IMAGE_PLACEHOLDER}`"),
    };
    let expected =
        format!("`{IMAGE_PLACEHOLDER}` with id {}, the image_token_id of config.json", config.ids.image);
    Err(Error::format(source.path(TOKENIZER), found, expected))
}

/// The highest logits with their ids, in falling order; of equal ones the lower id first.
fn top(logits: &[f32]) -> Vec<(u32, f32)> {
    let mut all: Vec<(u32, f32)> = (0..).zip(logits.iter().copied()).collect();
    all.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    all.truncate(TOP_LOGITS);
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_highest_logits_come_first() {
        assert_eq!(top(&[1.0, 3.0, -2.0, 3.0]), [(1, 3.0), (3, 3.0), (0, 1.0), (2, -2.0)]);
        let many: Vec<f32> = (0..100).map(|i| i as f32).collect();
        assert_eq!(top(&many).len(), TOP_LOGITS);
        assert_eq!(top(&many)[0], (99, 99.0));
    }
}
