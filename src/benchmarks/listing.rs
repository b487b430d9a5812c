//! Frames that were listed when a data set was opened and are read one by one: what the loaders of files have in common.

use super::dataset::{Dataset, Sample};
use crate::error::{Error, Result};

/// A frame that was found and not yet read.
#[derive(Clone, Debug)]
pub(super) struct Frame<F> {
    /// As [`Dataset::name`].
    pub(super) name: String,
    /// Where its parts lie.
    pub(super) files: F,
}

/// A data set whose frames are known by name once it is open. Every loader is a [`Dataset`].
pub(super) trait Loader: Send + Sync {
    /// What must be known of a frame to read it.
    type Files;

    /// All frames, in their order.
    fn frames(&self) -> &[Frame<Self::Files>];

    /// Whether a frame comes with measurements.
    fn brings_measurements(&self, _files: &Self::Files) -> bool {
        false
    }

    /// Reads the frame at an index of [`Loader::frames`].
    fn read(&self, frame: &Frame<Self::Files>, index: usize) -> Result<Sample>;
}

impl<L: Loader> Dataset for L {
    fn len(&self) -> usize {
        self.frames().len()
    }

    fn name(&self, index: usize) -> String {
        self.frames().get(index).map(|f| f.name.clone()).unwrap_or_default()
    }

    fn has_measurements(&self, index: usize) -> bool {
        self.frames().get(index).is_some_and(|f| self.brings_measurements(&f.files))
    }

    fn load(&self, index: usize) -> Result<Sample> {
        self.read(entry(self.frames(), index)?, index)
    }
}

/// The entry of a frame, or the error for an index beyond the last.
pub(super) fn entry<T>(entries: &[T], index: usize) -> Result<&T> {
    entries.get(index).ok_or_else(|| Error::argument("index", index, format!("below {}", entries.len())))
}
