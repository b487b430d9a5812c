//! Which files of a repository are needed, and which of them a folder holds.

use crate::error::{Error, Result};
use crate::model::{SETTINGS, TENSORS};
use crate::query::Settings;
use crate::vlm::chat::generate::GENERATION;
use crate::vlm::checkpoint::StoredFile;
use crate::vlm::checkpoint::shards::{INDEX, SINGLE, shard_names, tensor_names};
use crate::vlm::checkpoint::weights::published_name;
use crate::vlm::files::{CONFIG, PREPROCESSOR, PROCESSOR, Source, TOKENIZER};
use crate::vlm::qwen2_5::preprocess::IMAGE_PROCESSOR;
use std::path::Path;

/// What is wanted of a repository.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Files {
    Checkpoint,
    Adapter,
}

/// What a folder lacks.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Survey {
    /// Needed, and not there or damaged.
    pub(super) missing: Vec<String>,
    /// Not there, though the repository may have them: without them another model may be meant.
    pub(super) unknown: Vec<String>,
}

impl Files {
    /// The files that a repository must have, besides a checkpoint's weights.
    fn required(self) -> &'static [&'static str] {
        match self {
            Files::Checkpoint => &[CONFIG, PREPROCESSOR, TOKENIZER],
            Files::Adapter => &[SETTINGS, TENSORS],
        }
    }

    /// The files that a repository may have.
    pub(super) fn optional(self) -> &'static [&'static str] {
        match self {
            Files::Checkpoint => &[PROCESSOR, GENERATION, SETTINGS, TENSORS],
            Files::Adapter => &[],
        }
    }

    /// The files that are required of a repository which has these; newer ones have the preprocessor's keys in another file.
    pub(super) fn required_of(self, has: &dyn Fn(&str) -> bool) -> Vec<&'static str> {
        let newer = |name: &'static str| {
            if name == PREPROCESSOR && !has(name) && has(PROCESSOR) { PROCESSOR } else { name }
        };
        self.required().iter().copied().map(newer).collect()
    }

    /// What a folder lacks. A link whose target is gone counts as not there.
    pub(super) fn survey(self, dir: &Path, known_absent: &dyn Fn(&str) -> bool) -> Result<Survey> {
        let there = |name: &str| dir.join(name).exists();
        let mut missing: Vec<String> = Vec::new();
        for name in self.required() {
            let elsewhere = *name == PREPROCESSOR && holds_preprocessor(dir);
            if !elsewhere && !is_usable(dir, name)? {
                missing.push(name.to_string());
            }
        }
        if self == Files::Adapter {
            return Ok(Survey { missing, unknown: Vec::new() });
        }
        let tensors = weights(dir, &mut missing)?;
        if there(SETTINGS) {
            let lacking = tensors.is_some_and(|names| lacks(dir, &names));
            if (lacking && !there(TENSORS)) || (there(TENSORS) && !is_usable(dir, TENSORS)?) {
                missing.push(TENSORS.into());
            }
        } else if !known_absent(SETTINGS) && (there(TENSORS) || tensors.iter().flatten().any(|t| is_ours(t)))
        {
            missing.push(SETTINGS.into());
        }
        let mut unknown: Vec<String> = self.optional().iter().map(|name| name.to_string()).collect();
        unknown.retain(|name| !there(name) && !known_absent(name) && !missing.contains(name));
        Ok(Survey { missing, unknown })
    }
}

/// Names of a checkpoint's tensors, if that can be told; what is not there of its weights is added to `missing`.
fn weights(dir: &Path, missing: &mut Vec<String>) -> Result<Option<Vec<String>>> {
    let (single, index) = (dir.join(SINGLE), dir.join(INDEX));
    if single.exists() {
        if is_usable(dir, SINGLE)? {
            let tensors = StoredFile::open(&single)?.tensors();
            return Ok(tensors.ok().map(|all| all.into_iter().map(|(name, _)| name).collect()));
        }
        missing.push(SINGLE.into());
        return Ok(None);
    }
    if !index.exists() {
        missing.push(format!("{SINGLE} (or {INDEX} and its shards)"));
        return Ok(None);
    }
    for shard in shard_names(&index)? {
        if !is_usable(dir, &shard)? {
            missing.push(shard);
        }
    }
    Ok(Some(tensor_names(&index)?))
}

/// Whether a file is there, and if it holds tensors, all of it.
fn is_usable(dir: &Path, name: &str) -> Result<bool> {
    Ok(dir.join(name).exists() && is_whole(name, &dir.join(name))?)
}

/// Whether a file of this name has not been cut off; of files without tensors that is for their readers to tell.
pub(super) fn is_whole(name: &str, path: &Path) -> Result<bool> {
    if !name.ends_with(".safetensors") {
        return Ok(true);
    }
    if super::cache::size(path).is_none_or(|bytes| bytes < 8) {
        return Ok(false);
    }
    match StoredFile::open(path).and_then(|file| file.tensors()) {
        Err(Error::Format { .. }) => Ok(false),
        Err(error @ Error::Io { .. }) => Err(error),
        _ => Ok(true),
    }
}

fn holds_preprocessor(dir: &Path) -> bool {
    Source::dir(dir).json(PROCESSOR).is_ok_and(|(_, json)| json.get(IMAGE_PROCESSOR).is_some())
}

/// Whether plain Qwen2.5-VL has no tensor of this name.
fn is_ours(tensor: &str) -> bool {
    tensor.starts_with("sdim.") || tensor.contains(".lora_")
}

/// Whether the folder's settings ask for tensors that are not among these. Settings that cannot be read are for the
/// model's loader to report.
fn lacks(dir: &Path, tensors: &[String]) -> bool {
    let Ok(settings) = Settings::from_file(&dir.join(SETTINGS)) else { return false };
    let parts = [
        (settings.fusion.is_some(), "sdim.fusion."),
        (settings.fusion.is_some(), "sdim.patch_embed."),
        (settings.glimpse.is_some(), "sdim.glimpse."),
        (settings.wide_glimpse.is_some(), "sdim.wide_glimpse."),
        (settings.lora.is_some(), ".lora_"),
    ];
    parts.iter().any(|(asked, part)| *asked && !tensors.iter().any(|t| published_name(t).contains(part)))
}
