//! Tensors as they lie in safetensors files: found at once, mapped and converted one at a time.

use crate::error::{Error, Result};
use candle_core::{DType, Device, Tensor};
use half::{bf16, f16};
use rayon::prelude::*;
use std::borrow::Cow;
use std::fs::File;
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

enum Content {
    Bytes(Cow<'static, [u8]>),
    Mapped(File),
}

struct Inner {
    name: String,
    content: Content,
}

/// A safetensors file, in memory or on disk.
pub(crate) struct StoredFile(Arc<Inner>);

/// One floating-point tensor of a file.
pub(crate) struct Stored {
    file: Arc<Inner>,
    dtype: DType,
    shape: Vec<usize>,
    range: Range<usize>,
}

/// Bytes of a file. Those on disk are mapped as long as this lives: only what is mapped counts as the program's memory, so
/// that a checkpoint is never resident beside the weights that are made from it.
pub(crate) enum Bytes<'a> {
    Held(&'a [u8]),
    Mapped(memmap2::Mmap),
}

impl std::ops::Deref for Bytes<'_> {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        match self {
            Bytes::Held(bytes) => bytes,
            Bytes::Mapped(map) => map,
        }
    }
}

impl Inner {
    /// All bytes of the file, or a range of them. The only unsafe call outside of the kernels.
    #[allow(unsafe_code)]
    fn bytes(&self, range: Option<Range<usize>>) -> Result<Bytes<'_>> {
        let file = match &self.content {
            Content::Bytes(bytes) => return Ok(Bytes::Held(range.map_or(&bytes[..], |r| &bytes[r]))),
            Content::Mapped(file) => file,
        };
        let mut options = memmap2::MmapOptions::new();
        if let Some(range) = range {
            if range.is_empty() {
                return Ok(Bytes::Held(&[]));
            }
            options.offset(range.start as u64).len(range.len());
        }
        // SAFETY: the map is read-only and lives no longer than the tensor's conversion. That nobody truncates the file meanwhile is
        // the caller's part, as with any program that maps its weights; a file that is short to begin with is refused when
        // it is opened.
        let map = unsafe { options.map(file) }.map_err(Error::io(Path::new(&self.name)))?;
        Ok(Bytes::Mapped(map))
    }
}

impl StoredFile {
    pub(crate) fn in_memory(name: &str, bytes: Cow<'static, [u8]>) -> Self {
        Self(Arc::new(Inner { name: name.to_string(), content: Content::Bytes(bytes) }))
    }

    pub(crate) fn open(path: &Path) -> Result<Self> {
        let file = File::open(path).map_err(Error::io(path))?;
        Ok(Self(Arc::new(Inner { name: path.display().to_string(), content: Content::Mapped(file) })))
    }

    /// Names and places of all tensors.
    pub(crate) fn tensors(&self) -> Result<Vec<(String, Stored)>> {
        self.parse(&self.0.bytes(None)?)
    }

    fn parse(&self, bytes: &[u8]) -> Result<Vec<(String, Stored)>> {
        let name = &self.0.name;
        let file = safetensors::SafeTensors::deserialize(bytes)
            .map_err(|e| Error::format(name, e.to_string(), "a complete safetensors file"))?;
        let mut tensors = Vec::new();
        for (tensor, view) in file.tensors() {
            let dtype = match view.dtype() {
                safetensors::Dtype::F32 => DType::F32,
                safetensors::Dtype::F16 => DType::F16,
                safetensors::Dtype::BF16 => DType::BF16,
                other => {
                    return Err(Error::Tensor {
                        file: name.clone(),
                        name: tensor,
                        found: format!("{other:?}"),
                        expected: "F32, F16 or BF16".into(),
                    });
                }
            };
            let start = view.data().as_ptr() as usize - bytes.as_ptr() as usize;
            let range = start..start + view.data().len();
            let shape = view.shape().to_vec();
            tensors.push((tensor, Stored { file: self.0.clone(), dtype, shape, range }));
        }
        Ok(tensors)
    }
}

impl Stored {
    pub(crate) fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// Name of the file, for messages.
    pub(crate) fn file(&self) -> &str {
        &self.file.name
    }

    pub(crate) fn dtype(&self) -> DType {
        self.dtype
    }

    /// Rows and columns.
    pub(crate) fn matrix(&self) -> Result<[usize; 2]> {
        <[usize; 2]>::try_from(&self.shape[..])
            .map_err(|_| Error::argument("matrix", format!("shape {:?}", self.shape), "two dimensions"))
    }

    /// Little-endian values of its type.
    pub(crate) fn bytes(&self) -> Result<Bytes<'_>> {
        self.file.bytes(Some(self.range.clone()))
    }

    /// The values as f32, in one pass.
    pub(crate) fn values(&self) -> Result<Vec<f32>> {
        Ok(widened(&self.bytes()?, self.dtype))
    }

    /// Some rows of a matrix as f32 on the CPU; `ids` are below the number of its rows, which have `columns` values.
    #[cfg(feature = "train")]
    pub(crate) fn rows(&self, ids: &[u32], columns: usize) -> Result<Tensor> {
        let (bytes, row) = (self.bytes()?, columns * self.dtype.size_in_bytes());
        let values = ids.iter().flat_map(|&id| widened(&bytes[id as usize * row..][..row], self.dtype));
        Ok(Tensor::from_vec(values.collect::<Vec<f32>>(), (ids.len(), columns), &Device::Cpu)?)
    }

    /// The tensor on the CPU in the type in which it is stored.
    pub(crate) fn tensor(&self) -> Result<Tensor> {
        Ok(Tensor::from_raw_buffer(&self.bytes()?, self.dtype, self.shape(), &Device::Cpu)?)
    }

    /// The tensor as f32 on a device.
    pub(crate) fn f32(&self, device: &Device) -> Result<Tensor> {
        Ok(Tensor::from_vec(self.values()?, self.shape(), device)?)
    }
}

/// Little-endian floats as f32.
fn widened(bytes: &[u8], stored: DType) -> Vec<f32> {
    let pairs = || bytes.par_chunks_exact(2).map(|b| [b[0], b[1]]);
    match stored {
        DType::BF16 => pairs().map(|b| bf16::from_le_bytes(b).to_f32()).collect(),
        DType::F16 => pairs().map(|b| f16::from_le_bytes(b).to_f32()).collect(),
        _ => bytes.par_chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect(),
    }
}

#[cfg(test)]
mod tests {
    use crate::kernels::WeightFormat;
    use crate::vlm::checkpoint::weights::Weights;
    use crate::vlm::layers::matrix::Matrix;
    use candle_core::{DType, Device, Tensor};
    use std::collections::HashMap;

    #[test]
    fn files_of_every_float_type_give_their_values() {
        // Exact in all three types.
        let values = [1.5f32, -0.375, 96.0, 0.0078125, -2.0, 0.0];
        let tensor = Tensor::new(&values[..], &Device::Cpu).unwrap().reshape((2, 3)).unwrap();
        let of = |t: Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        for stored in [DType::F32, DType::F16, DType::BF16] {
            let dir = tempfile::tempdir().unwrap();
            let path = dir.path().join("w.safetensors");
            let tensors = HashMap::from([("w", tensor.to_dtype(stored).unwrap())]);
            candle_core::safetensors::save(&tensors, &path).unwrap();
            for format in [WeightFormat::F32, WeightFormat::Bf16] {
                let weights = Weights::from_file(&path, &Device::Cpu).unwrap().with_format(format);
                assert_eq!(of(weights.get("w", &[2, 3]).unwrap()), values, "{stored:?}");
                let matrix = Matrix::read(&weights, "w", [2, 3]).unwrap();
                assert_eq!(of(matrix.rows(&[0, 1]).unwrap()), values, "{stored:?} as {format:?}");
            }
        }
    }
}
