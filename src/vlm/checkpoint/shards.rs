//! Which files of a checkpoint directory hold its tensors.

use super::json::read_json;
use super::weights::Weights;
use crate::error::{Error, Result};
use candle_core::Device;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path};

/// Index of a sharded checkpoint.
pub(crate) const INDEX: &str = "model.safetensors.index.json";
/// A checkpoint in one file.
pub(crate) const SINGLE: &str = "model.safetensors";

/// Files of the tensors that an index names; all of them files of its folder.
fn weight_map(index: &Path) -> Result<BTreeMap<String, String>> {
    let json = read_json(index)?;
    let wrong =
        |found: &str| Error::format(index, found, "`weight_map`: tensor names to files of this folder");
    let map = json.get("weight_map").and_then(|m| m.as_object()).ok_or_else(|| wrong("no `weight_map`"))?;
    let file_of = |(tensor, file): (&String, &serde_json::Value)| {
        let file = file.as_str().ok_or_else(|| wrong(tensor))?;
        let mut parts = Path::new(file).components();
        match (parts.next(), parts.next()) {
            (Some(Component::Normal(_)), None) => Ok((tensor.clone(), file.to_string())),
            _ => Err(wrong(file)),
        }
    };
    map.iter().map(file_of).collect()
}

/// The shards that an index names.
#[cfg(feature = "hub")]
pub(crate) fn shard_names(index: &Path) -> Result<BTreeSet<String>> {
    Ok(weight_map(index)?.into_values().collect())
}

/// Names of the tensors that an index has.
#[cfg(feature = "hub")]
pub(crate) fn tensor_names(index: &Path) -> Result<Vec<String>> {
    Ok(weight_map(index)?.into_keys().collect())
}

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
        let map = weight_map(&index)?;
        let shards: BTreeSet<&String> = map.values().collect();
        let mut weights = Self::empty(&index.display().to_string(), device);
        for shard in shards {
            weights.add_file(&dir.join(shard))?;
        }
        let absent =
            map.iter().find(|(name, _)| !weights.has(&crate::vlm::checkpoint::weights::published_name(name)));
        match absent {
            Some((name, file)) => {
                Err(Error::format(&index, format!("`{name}`, which {file} lacks"), "tensors that exist"))
            }
            None => Ok(weights),
        }
    }
}
