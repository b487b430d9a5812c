//! Which files of a checkpoint directory hold its tensors.

use super::config::read_json;
use super::weights::Weights;
use crate::error::{Error, Result};
use candle_core::Device;
use std::collections::BTreeSet;
use std::path::{Component, Path};

/// Index of a sharded checkpoint.
const INDEX: &str = "model.safetensors.index.json";
/// A checkpoint in one file.
const SINGLE: &str = "model.safetensors";

impl Weights {
    /// The tensors of a checkpoint directory: `model.safetensors`, or the shards that
    /// `model.safetensors.index.json` names.
    ///
    /// # Errors
    /// As [`Weights::from_file`]; [`Error::Format`] if the index is damaged, leaves the directory, or names a tensor that its
    /// shard lacks.
    pub fn from_dir(dir: &Path, device: &Device) -> Result<Self> {
        let index = dir.join(INDEX);
        if dir.join(SINGLE).exists() || !index.exists() {
            return Self::from_file(&dir.join(SINGLE), device);
        }
        let json = read_json(&index)?;
        let wrong =
            |found: &str| Error::format(&index, found, "`weight_map`: tensor names to files of this folder");
        let map =
            json.get("weight_map").and_then(|m| m.as_object()).ok_or_else(|| wrong("no `weight_map`"))?;
        let mut shards = BTreeSet::new();
        for (tensor, file) in map {
            let file = file.as_str().ok_or_else(|| wrong(tensor))?;
            let mut parts = Path::new(file).components();
            if !matches!((parts.next(), parts.next()), (Some(Component::Normal(_)), None)) {
                return Err(wrong(file));
            }
            shards.insert(file);
        }
        let mut weights = Self::empty(&index.display().to_string(), device);
        for shard in shards {
            weights.add_file(&dir.join(shard))?;
        }
        let absent = map.iter().find(|(name, _)| !weights.has(&super::weights::published_name(name)));
        match absent {
            Some((name, file)) => {
                Err(Error::format(&index, format!("`{name}`, which {file} lacks"), "tensors that exist"))
            }
            None => Ok(weights),
        }
    }
}
