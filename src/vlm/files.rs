//! The published files of a checkpoint that are not tensors, from a directory or from memory.

use super::checkpoint::json::parse_json;
use crate::error::{Error, Result};
use crate::files::read_text;
use crate::vlm::chat::tokenizer::Tokenizer;
use crate::vlm::qwen2_5::config::VlmConfig;
use crate::vlm::qwen2_5::preprocess::{IMAGE_PROCESSOR, PreprocessorConfig};
use std::borrow::Cow;
use std::path::{Path, PathBuf};

pub(crate) const CONFIG: &str = "config.json";
pub(crate) const PREPROCESSOR: &str = "preprocessor_config.json";
/// Where `transformers` 5 puts what stood in [`PREPROCESSOR`], under `image_processor`.
pub(crate) const PROCESSOR: &str = "processor_config.json";
pub(crate) const TOKENIZER: &str = "tokenizer.json";

/// Where the files are.
pub(crate) struct Source<'a> {
    dir: &'a Path,
    /// Names and bytes; without them, files of `dir` are read.
    memory: Option<&'a [(&'a str, &'a [u8])]>,
}

impl<'a> Source<'a> {
    pub(crate) fn dir(dir: &'a Path) -> Self {
        Self { dir, memory: None }
    }

    /// `dir` is for messages.
    pub(crate) fn memory(dir: &'a Path, files: &'a [(&'a str, &'a [u8])]) -> Self {
        Self { dir, memory: Some(files) }
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.dir.join(name)
    }

    pub(crate) fn has(&self, name: &str) -> bool {
        match self.memory {
            Some(files) => files.iter().any(|(n, _)| *n == name),
            None => self.path(name).exists(),
        }
    }

    pub(crate) fn read(&self, name: &str) -> Result<Cow<'a, [u8]>> {
        let path = self.path(name);
        let Some(files) = self.memory else {
            return read_text(&path).map(Cow::Owned);
        };
        match files.iter().find(|(n, _)| *n == name) {
            Some((_, bytes)) => Ok(Cow::Borrowed(bytes)),
            None => Err(Error::io(path)(std::io::ErrorKind::NotFound.into())),
        }
    }

    /// The file's place as text, for messages, and its JSON.
    pub(crate) fn json(&self, name: &str) -> Result<(String, serde_json::Value)> {
        let path = self.path(name);
        let value = parse_json(&path, &self.read(name)?)?;
        Ok((path.display().to_string(), value))
    }

    pub(crate) fn config(&self) -> Result<VlmConfig> {
        let (file, json) = self.json(CONFIG)?;
        VlmConfig::from_json(&file, &json)
    }

    /// As in the reference, an `image_processor` in the newer file goes before the older file.
    pub(crate) fn preprocessor(&self) -> Result<PreprocessorConfig> {
        if self.has(PROCESSOR) {
            let (file, json) = self.json(PROCESSOR)?;
            if json.get(IMAGE_PROCESSOR).is_some() {
                return PreprocessorConfig::from_json(&file, &json);
            }
        }
        let (file, json) = self.json(PREPROCESSOR)?;
        PreprocessorConfig::from_json(&file, &json)
    }

    pub(crate) fn tokenizer(&self) -> Result<Tokenizer> {
        Tokenizer::from_bytes(&self.path(TOKENIZER), &self.read(TOKENIZER)?)
    }
}

/// The patches that the preprocessor cuts must be those that the model reads.
pub(crate) fn check_patches(preprocessor: &PreprocessorConfig, config: &VlmConfig) -> Result<()> {
    let (p, v) = (preprocessor, &config.vision);
    let found = (p.patch_size, p.merge_size, p.temporal_patch_size);
    if found == (v.patch_size, v.merge_size, v.temporal_patch_size) {
        return Ok(());
    }
    let key = "patch_size, merge_size, temporal_patch_size";
    Err(Error::config(PREPROCESSOR, key, format!("{found:?}"), "the values of config.json"))
}
