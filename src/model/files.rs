//! What a checkpoint directory holds beside tensors.

use crate::error::Result;
use crate::query::Settings;
use crate::vlm::chat::generate::GenerationConfig;
use crate::vlm::chat::tokenizer::Tokenizer;
use crate::vlm::files::{CONFIG, PREPROCESSOR, Source, TOKENIZER};
use crate::vlm::qwen2_5::config::VlmConfig;
use crate::vlm::qwen2_5::preprocess::PreprocessorConfig;
use std::path::Path;

/// File of the settings of a checkpoint or an adapter.
pub const SETTINGS: &str = "sdim.json";
/// File of an adapter's tensors.
pub const TENSORS: &str = "sdim.safetensors";

/// The files of a checkpoint that are not tensors.
pub struct CheckpointFiles {
    /// `config.json`
    pub config: VlmConfig,
    /// `preprocessor_config.json`
    pub preprocessor: PreprocessorConfig,
    /// `sdim.json`
    pub settings: Settings,
    /// `tokenizer.json`
    pub tokenizer: Tokenizer,
    /// Ids that end an answer, of `generation_config.json` or `config.json`.
    pub stop_ids: Vec<u32>,
}

impl CheckpointFiles {
    /// From the bytes of the four files.
    ///
    /// # Errors
    /// Typed errors that name the file and key.
    pub fn from_bytes(
        dir: &str,
        config: &[u8],
        preprocessor: &[u8],
        settings: &[u8],
        tokenizer: &[u8],
    ) -> Result<Self> {
        let files =
            [(CONFIG, config), (PREPROCESSOR, preprocessor), (SETTINGS, settings), (TOKENIZER, tokenizer)];
        Self::read(&Source::memory(Path::new(dir), &files))
    }

    /// From a directory. Without `sdim.json` the checkpoint is plain Qwen2.5-VL, asked in the paper's words.
    ///
    /// # Errors
    /// Typed errors that name the file and key.
    pub fn from_dir(dir: &Path) -> Result<Self> {
        Self::read(&Source::dir(dir))
    }

    fn read(source: &Source) -> Result<Self> {
        Ok(Self {
            config: source.config()?,
            preprocessor: source.preprocessor()?,
            settings: if source.has(SETTINGS) {
                Settings::from_bytes(&source.path(SETTINGS), &source.read(SETTINGS)?)?
            } else {
                Settings::paper()
            },
            tokenizer: source.tokenizer()?,
            stop_ids: GenerationConfig::read(source)?.stop_ids,
        })
    }
}
