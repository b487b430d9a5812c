//! Safetensors files of records: tensors by name, and what the file says of itself.

use crate::error::{Error, Result};
use crate::files::write_whole;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::collections::HashMap;
use std::path::Path;

/// Name, type, shape and bytes of a tensor.
pub(super) type Part<'a> = (&'a str, Dtype, &'a [usize], Vec<u8>);

/// Little-endian bytes of numbers.
pub(super) fn bytes<T: Copy, const N: usize>(values: &[T], to: fn(T) -> [u8; N]) -> Vec<u8> {
    values.iter().flat_map(|&v| to(v)).collect()
}

/// Writes a file whole or not at all, with `about` as JSON under `key` of its metadata.
///
/// # Errors
/// [`Error::Io`].
pub(super) fn write(path: &Path, key: &str, about: &impl Serialize, parts: &[Part]) -> Result<()> {
    let wrong = |e: String| Error::format(path, e, "records that safetensors can hold");
    let views = parts.iter().map(|(name, dtype, shape, data)| {
        Ok((*name, TensorView::new(*dtype, shape.to_vec(), data).map_err(|e| wrong(e.to_string()))?))
    });
    let views = views.collect::<Result<Vec<_>>>()?;
    let about = serde_json::to_string(about).map_err(|e| wrong(e.to_string()))?;
    let metadata = HashMap::from([(key.to_string(), about)]);
    let file = safetensors::serialize(views, Some(metadata)).map_err(|e| wrong(e.to_string()))?;
    write_whole(path, &file)
}

/// Tensors of a file that is not trusted.
pub(super) struct Reader<'a> {
    path: &'a Path,
    tensors: SafeTensors<'a>,
}

impl<'a> Reader<'a> {
    /// What the file says of itself under `key`, and its tensors. `what` is for messages.
    ///
    /// # Errors
    /// [`Error::Format`] if it is no such file of this version.
    pub(super) fn open<T: DeserializeOwned>(
        path: &'a Path,
        file: &'a [u8],
        key: &str,
        what: &str,
        version: u32,
    ) -> Result<(T, Self)> {
        let wrong = |found: String| Error::format(path, found, format!("{what} of version {version}"));
        let (_, header) = SafeTensors::read_metadata(file).map_err(|e| wrong(e.to_string()))?;
        let about = header.metadata().as_ref().and_then(|m| m.get(key));
        let about = about.ok_or_else(|| wrong(format!("no {key} in the metadata")))?;
        #[derive(serde::Deserialize)]
        struct Versioned {
            version: u32,
        }
        let found: Versioned = serde_json::from_str(about).map_err(|e| wrong(e.to_string()))?;
        if found.version != version {
            return Err(wrong(format!("version {}", found.version)));
        }
        let about = serde_json::from_str(about).map_err(|e| wrong(e.to_string()))?;
        let tensors = SafeTensors::deserialize(file).map_err(|e| wrong(e.to_string()))?;
        Ok((about, Self { path, tensors }))
    }

    /// The error for a tensor that is not what it should be.
    pub(super) fn wrong(&self, name: &str, found: impl ToString, expected: impl ToString) -> Error {
        let (found, expected) = (found.to_string(), expected.to_string());
        Error::Tensor { file: self.path.display().to_string(), name: name.into(), found, expected }
    }

    fn tensor(&self, name: &str) -> Result<TensorView<'_>> {
        self.tensors.tensor(name).map_err(|_| self.wrong(name, "missing", "a tensor of records"))
    }

    /// Lengths of a tensor of `N` axes.
    pub(super) fn shape<const N: usize>(&self, name: &str) -> Result<[usize; N]> {
        let tensor = self.tensor(name)?;
        let found = tensor.shape();
        found.try_into().map_err(|_| self.wrong(name, format!("{found:?}"), format!("{N} dimensions")))
    }

    /// The values of a tensor of this type and shape.
    pub(super) fn take<T, const N: usize>(
        &self,
        name: &str,
        dtype: Dtype,
        shape: &[usize],
        from: fn([u8; N]) -> T,
    ) -> Result<Vec<T>> {
        let tensor = self.tensor(name)?;
        if tensor.dtype() != dtype || tensor.shape() != shape {
            let found = format!("{:?} {:?}", tensor.dtype(), tensor.shape());
            return Err(self.wrong(name, found, format!("{dtype:?} {shape:?}")));
        }
        let chunks = tensor.data().chunks_exact(N);
        Ok(chunks.filter_map(|c| c.try_into().ok()).map(from).collect())
    }

    /// Checks that starts of runs rise from 0 to `end`.
    pub(super) fn check_starts(&self, name: &str, starts: &[u32], end: usize) -> Result<()> {
        let ends = (starts.first(), starts.last().map(|&s| s as usize));
        if starts.is_sorted() && ends == (Some(&0), Some(end)) {
            return Ok(());
        }
        Err(self.wrong(name, "an entry out of range", format!("rising from 0 to {end}")))
    }
}
