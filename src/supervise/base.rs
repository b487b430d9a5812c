//! A checkpoint that training goes on from.

use super::init::FreshFiles;
use super::optimiser::Parameters;
use super::store;
use crate::error::Result;
use crate::vlm::checkpoint::weights::Weights;
use candle_core::{Device, Tensor};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A checkpoint that training goes on from: its files and its tensors.
pub struct Base {
    pub(super) files: FreshFiles,
    pub(super) dir: PathBuf,
    weights: Weights,
}

impl Base {
    /// A checkpoint directory, as [`DepthCompleter::load`](crate::DepthCompleter::load) reads it; nothing is converted yet.
    ///
    /// # Errors
    /// [`crate::Error::Io`] names a file that is not there; [`crate::Error::Format`] one that is damaged.
    pub fn load(dir: &Path) -> Result<Self> {
        let weights = Weights::from_dir(dir, &Device::Cpu)?;
        Ok(Self { files: FreshFiles::load(dir)?, dir: dir.to_path_buf(), weights })
    }

    /// The checkpoint inside the crate.
    ///
    /// # Errors
    /// [`crate::Error::Format`] if its tensors were damaged in building.
    #[cfg(feature = "tiny")]
    pub fn tiny() -> Result<Self> {
        let weights = crate::model::tiny_weights(&Device::Cpu)?;
        Ok(Self { files: FreshFiles::embedded(), dir: "sdim-tiny".into(), weights })
    }

    /// A checkpoint in memory: `tensors` are those that a model of these files has.
    pub fn of(files: FreshFiles, tensors: BTreeMap<String, Tensor>) -> Self {
        let weights = Weights::from_tensors("base", tensors.into_iter().collect());
        Self { files, dir: PathBuf::new(), weights }
    }

    /// Its weights as values and averages.
    pub(super) fn fill(&self, parameters: &mut Parameters) -> Result<()> {
        store::take_weights(&self.weights, parameters)
    }
}
