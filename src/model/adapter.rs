//! Adapters: what is ours on top of a published checkpoint, in two files beside it.
//!
//! `sdim.json` says how the model is asked (template, pixel reference, numbers, depth normalisation, format version),
//! which fusion block it has and which layers carry LoRA; `sdim.safetensors` holds the fusion block (`sdim.fusion.*`), the
//! second patch embedding (`sdim.patch_embed.*`), number tokens (`sdim.number_tokens.*`), and the factors `{layer}.lora_A.weight` and
//! `{layer}.lora_B.weight`. A tensor under the name of one of the base's own replaces that one: so a small checkpoint that was adapted as a
//! whole is an adapter, too.

use super::files::{SETTINGS, TENSORS};
use super::parts::Parts;
use crate::error::{Error, Result};
use crate::files::{write_tensors, write_whole};
use crate::query::Settings;
use crate::vlm::checkpoint::StoredFile;
use crate::vlm::checkpoint::weights::Weights;
use crate::vlm::qwen2_5::config::VlmConfig;
use candle_core::{Device, Tensor};
use std::collections::BTreeMap;
use std::path::Path;

/// An adapter in memory.
///
/// ```no_run
/// use sdim::{Adapter, DepthCompleter, LoadOptions};
/// use std::path::Path;
/// // A look into one, and a checkpoint that is loaded with it.
/// let adapter = Adapter::load(Path::new("my-adapter"))?;
/// println!("{} tensors, numbers {:?}", adapter.tensors.len(), adapter.settings.number);
/// let options = LoadOptions::default().with_adapter("my-adapter");
/// let completer = DepthCompleter::load("Qwen2.5-VL-3B-Instruct", &options)?;
/// # Ok::<(), sdim::Error>(())
/// ```
#[derive(Debug, Clone)]
pub struct Adapter {
    /// `sdim.json`
    pub settings: Settings,
    /// Tensors by name, in the type in which they are stored.
    pub tensors: BTreeMap<String, Tensor>,
}

impl Adapter {
    /// Reads an adapter directory.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Format`], [`Error::Config`], [`Error::Tensor`], naming the file and key.
    pub fn load(dir: &Path) -> Result<Self> {
        let settings = Settings::from_file(&dir.join(SETTINGS))?;
        let mut tensors = BTreeMap::new();
        for (name, stored) in StoredFile::open(&dir.join(TENSORS))?.tensors()? {
            tensors.insert(name, stored.tensor()?);
        }
        Ok(Self { settings, tensors })
    }

    /// Writes an adapter directory, each file whole or not at all. What [`Adapter::load`] then reads is equal bit for bit.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Config`] if the settings could not be read back.
    pub fn save(&self, dir: &Path) -> Result<()> {
        let json = self.settings.to_json()?;
        std::fs::create_dir_all(dir).map_err(Error::io(dir))?;
        write_tensors(&dir.join(TENSORS), &self.tensors)?;
        write_whole(&dir.join(SETTINGS), json.as_bytes())
    }

    /// Names and shapes of the tensors that an adapter with these settings has, on a base model of this configuration.
    ///
    /// # Errors
    /// [`Error::Config`] if settings are out of range; [`Error::Argument`] if a LoRA target names no layer of the model.
    #[doc(hidden)]
    pub fn layout(config: &VlmConfig, settings: &Settings) -> Result<BTreeMap<String, Vec<usize>>> {
        settings.validate(SETTINGS)?;
        let weights =
            Weights::empty("adapter", &Device::Cpu).with_lora(settings.lora_set(Default::default()));
        Parts::new(config.clone(), settings, &weights)?;
        let ours = |name: &String| name.starts_with("sdim.") || name.contains(".lora_");
        let layout: BTreeMap<_, _> = weights.wanted().into_iter().filter(|(name, _)| ours(name)).collect();
        for target in settings.lora.iter().flat_map(|l| &l.targets) {
            let part = format!(".{target}.lora_A.weight");
            if !layout.keys().any(|name| name.ends_with(&part)) {
                return Err(Error::argument("lora target", target, "the last part of a linear layer's name"));
            }
        }
        Ok(layout)
    }

    /// A new adapter that changes nothing: the zero convolutions of the fusion block and every LoRA `B` are 0 (feature
    /// `train`).
    ///
    /// # Errors
    /// As [`Adapter::layout`].
    #[cfg(feature = "train")]
    #[doc(hidden)]
    pub fn fresh(config: &VlmConfig, settings: Settings, seed: u64) -> Result<Self> {
        let layout = Self::layout(config, &settings)?;
        let tensors = super::initial::initial(&layout, &[], config.text.layers, seed)?;
        Ok(Self { settings, tensors })
    }
}
