//! Named tensors of a checkpoint: strict shapes, published or in-memory names, and a record of what was read.

use crate::error::{Error, Result};
use candle_core::{DType, Device, Tensor};
use half::{bf16, f16};
use rayon::prelude::*;
use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::Path;

/// Values of all missing tensors together for which zeros stand in, at most. Beyond it a config is refused at once: it
/// may ask for more than there is memory.
const STAND_INS: usize = 1 << 28;

/// The tensors of a checkpoint under their published names.
///
/// Every read checks the shape and is recorded, so that [`Weights::finish`] can tell missing and unread tensors.
pub struct Weights {
    file: String,
    tensors: HashMap<String, Tensor>,
    /// File of each tensor that did not come from `file`.
    origin: HashMap<String, String>,
    read: RefCell<BTreeSet<String>>,
    missing: RefCell<BTreeMap<String, Vec<usize>>>,
}

/// Little-endian floats of a file as f32, in one pass.
fn widened(bytes: &[u8], stored: DType) -> Vec<f32> {
    let pairs = || bytes.par_chunks_exact(2).map(|b| [b[0], b[1]]);
    match stored {
        DType::BF16 => pairs().map(|b| bf16::from_le_bytes(b).to_f32()).collect(),
        DType::F16 => pairs().map(|b| f16::from_le_bytes(b).to_f32()).collect(),
        _ => bytes.par_chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect(),
    }
}

/// Maps an in-memory name of `transformers` >= 4.52 to the published one.
pub fn published_name(name: &str) -> String {
    if let Some(rest) = name.strip_prefix("model.visual.") {
        format!("visual.{rest}")
    } else if let Some(rest) = name.strip_prefix("model.language_model.") {
        format!("model.{rest}")
    } else {
        name.to_string()
    }
}

impl Weights {
    /// Tensors that are already in memory (the trainer's variables, tests). `file` is for messages.
    pub fn from_tensors(file: &str, tensors: HashMap<String, Tensor>) -> Self {
        Self {
            file: file.to_string(),
            tensors,
            origin: HashMap::new(),
            read: RefCell::default(),
            missing: RefCell::default(),
        }
    }

    /// Reads safetensors bytes and converts each tensor to `dtype` on `device`.
    ///
    /// # Errors
    /// [`Error::Format`] if the bytes are truncated or no safetensors; [`Error::Tensor`] on an integer tensor.
    pub fn from_bytes(file: &str, bytes: &[u8], dtype: DType, device: &Device) -> Result<Self> {
        let mut weights = Self::from_tensors(file, HashMap::new());
        weights.add_bytes(file, bytes, dtype, device)?;
        Ok(weights)
    }

    /// Reads one safetensors file.
    ///
    /// # Errors
    /// As [`Weights::from_bytes`], and [`Error::Io`].
    pub fn from_file(path: &Path, dtype: DType, device: &Device) -> Result<Self> {
        let mut weights = Self::from_tensors(&path.display().to_string(), HashMap::new());
        weights.add_file(path, dtype, device)?;
        Ok(weights)
    }

    /// Adds the tensors of another file, which replace those of the same name.
    ///
    /// # Errors
    /// As [`Weights::from_file`].
    pub fn add_file(&mut self, path: &Path, dtype: DType, device: &Device) -> Result<()> {
        let file = std::fs::File::open(path).map_err(Error::io(path))?;
        // SAFETY: the map is read-only and lives for this call. That nobody truncates the file meanwhile is the caller's
        // part, as with any program that maps its weights; a file that is short to begin with is refused below.
        let bytes = unsafe { memmap2::Mmap::map(&file) }.map_err(Error::io(path))?;
        self.add_bytes(&path.display().to_string(), &bytes, dtype, device)
    }

    fn add_bytes(&mut self, from: &str, bytes: &[u8], dtype: DType, device: &Device) -> Result<()> {
        let bad = |e: safetensors::SafeTensorError| {
            Error::format(from, e.to_string(), "a complete safetensors file")
        };
        let file = safetensors::SafeTensors::deserialize(bytes).map_err(bad)?;
        for (name, view) in file.tensors() {
            let stored = match view.dtype() {
                safetensors::Dtype::F32 => DType::F32,
                safetensors::Dtype::F16 => DType::F16,
                safetensors::Dtype::BF16 => DType::BF16,
                other => {
                    return Err(Error::Tensor {
                        file: from.to_string(),
                        name,
                        found: format!("{other:?}"),
                        expected: "F32, F16 or BF16".into(),
                    });
                }
            };
            let tensor = if dtype == DType::F32 {
                Tensor::from_vec(widened(view.data(), stored), view.shape(), device)?
            } else {
                Tensor::from_raw_buffer(view.data(), stored, view.shape(), device)?.to_dtype(dtype)?
            };
            let name = published_name(&name);
            if from != self.file {
                self.origin.insert(name.clone(), from.to_string());
            }
            self.tensors.insert(name, tensor);
        }
        Ok(())
    }

    /// Whether a tensor of this name is there.
    pub fn has(&self, name: &str) -> bool {
        self.tensors.contains_key(name)
    }

    /// The tensor of this name, which must have this shape.
    ///
    /// A missing tensor is recorded and stands in as zeros, so that [`Weights::finish`] can list all of them at once.
    ///
    /// # Errors
    /// [`Error::Tensor`] on another shape; [`Error::TensorSet`] at once if the missing tensors hold over 2^28 values.
    pub fn get(&self, name: &str, shape: &[usize]) -> Result<Tensor> {
        let Some(tensor) = self.tensors.get(name) else {
            self.miss(name, shape)?;
            return Ok(Tensor::zeros(shape, DType::F32, &Device::Cpu)?);
        };
        if tensor.dims() != shape {
            return Err(Error::Tensor {
                file: self.origin.get(name).unwrap_or(&self.file).clone(),
                name: name.to_string(),
                found: format!("shape {:?}", tensor.dims()),
                expected: format!("shape {shape:?}"),
            });
        }
        self.read.borrow_mut().insert(name.to_string());
        Ok(tensor.clone())
    }

    fn miss(&self, name: &str, shape: &[usize]) -> Result<()> {
        let mut missing = self.missing.borrow_mut();
        missing.insert(name.to_string(), shape.to_vec());
        let values = |s: &[usize]| s.iter().try_fold(1usize, |n, &d| n.checked_mul(d));
        let total = missing.values().try_fold(0usize, |n, s| n.checked_add(values(s)?));
        if total.is_some_and(|n| n <= STAND_INS) {
            return Ok(());
        }
        let missing = missing.keys().cloned().collect();
        Err(Error::TensorSet { file: self.file.clone(), missing, unexpected: Vec::new() })
    }

    /// Declares that a tensor may be there without being read (a redundant tied head).
    pub fn ignore(&self, name: &str) {
        self.read.borrow_mut().insert(name.to_string());
    }

    /// Names and shapes that were asked for and are not there: of an empty set, the whole checkpoint's layout.
    pub fn wanted(&self) -> BTreeMap<String, Vec<usize>> {
        self.missing.borrow().clone()
    }

    /// Must be called when the model is built: fails if a tensor was missing or one was never read.
    ///
    /// # Errors
    /// [`Error::TensorSet`] lists both.
    pub fn finish(&self) -> Result<()> {
        let read = self.read.borrow();
        let missing: Vec<String> = self.missing.borrow().keys().cloned().collect();
        let mut unexpected: Vec<String> =
            self.tensors.keys().filter(|k| !read.contains(*k)).cloned().collect();
        unexpected.sort();
        if missing.is_empty() && unexpected.is_empty() {
            return Ok(());
        }
        Err(Error::TensorSet { file: self.file.clone(), missing, unexpected })
    }
}
