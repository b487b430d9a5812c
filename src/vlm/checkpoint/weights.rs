//! Named tensors of a checkpoint: strict shapes, published or in-memory names, and a record of what was read.

use super::lora::LoraSet;
use super::raw::Raw;
use super::stored::{Stored, StoredFile};
use crate::error::{Error, Result};
use crate::kernels::WeightFormat;
use candle_core::{DType, Device, Tensor};
use std::cell::{Cell, RefCell};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::Path;

/// Values of all missing tensors together for which zeros are allocated, at most. Beyond it a config is refused at once:
/// it may ask for more than there is memory. Missing matrices take no memory and do not count.
const STAND_INS: usize = 1 << 28;

/// Values of a tensor by its name and shape.
type Maker = Box<dyn Fn(&str, &[usize]) -> Vec<f32>>;

enum Source {
    /// In memory already: the trainer's variables, tests.
    Tensor(Tensor),
    /// In a file, converted when it is asked for.
    Stored(Stored),
}

impl Source {
    fn dims(&self) -> &[usize] {
        match self {
            Source::Tensor(t) => t.dims(),
            Source::Stored(s) => s.shape(),
        }
    }
}

/// A tensor that has another shape than the config asks for.
struct Misshaped {
    file: String,
    name: String,
    found: Vec<usize>,
    expected: Vec<usize>,
}

/// The tensors of a checkpoint under their published names.
///
/// Files are mapped, not read: each tensor is converted when the model asks for it, straight into the form in which it
/// is kept, so that no weight is ever held twice. Every read checks the shape and is recorded, so that
/// [`Weights::finish`] can tell missing, misshaped and unread tensors. From the first that is missing or misshaped on, nothing
/// is converted any more.
pub struct Weights {
    file: String,
    device: Device,
    format: WeightFormat,
    sources: HashMap<String, Source>,
    lora: LoraSet,
    made: Option<Maker>,
    read: RefCell<BTreeSet<String>>,
    missing: RefCell<BTreeSet<String>>,
    misshaped: RefCell<Vec<Misshaped>>,
    /// What stands in for tensors that are missing, misshaped, or not converted since others are.
    stand_ins: RefCell<BTreeMap<String, Vec<usize>>>,
    /// Values of those for which zeros were allocated.
    zeros: Cell<usize>,
}

/// Maps an in-memory name of `transformers` >= 4.52, or one below the prefix that PEFT writes, to the published one.
pub fn published_name(name: &str) -> String {
    let name = name.strip_prefix("base_model.model.").unwrap_or(name);
    if let Some(rest) = name.strip_prefix("model.visual.") {
        format!("visual.{rest}")
    } else if let Some(rest) = name.strip_prefix("model.language_model.") {
        format!("model.{rest}")
    } else {
        name.to_string()
    }
}

impl Weights {
    /// No tensor yet; see [`Weights::add_file`]. `file` is for messages.
    pub fn empty(file: &str, device: &Device) -> Self {
        Self {
            file: file.to_string(),
            device: device.clone(),
            format: WeightFormat::F32,
            sources: HashMap::new(),
            lora: LoraSet::default(),
            made: None,
            read: RefCell::default(),
            missing: RefCell::default(),
            misshaped: RefCell::default(),
            stand_ins: RefCell::default(),
            zeros: Cell::default(),
        }
    }

    /// Tensors that are already in memory, all on one device (the trainer's variables, tests). `file` is for messages.
    pub fn from_tensors(file: &str, tensors: HashMap<String, Tensor>) -> Self {
        let device = tensors.values().next().map_or(Device::Cpu, |tensor| tensor.device().clone());
        let mut weights = Self::empty(file, &device);
        weights.sources = tensors.into_iter().map(|(name, t)| (name, Source::Tensor(t))).collect();
        weights
    }

    /// Tensors whose values `make` gives by name and shape when they are asked for: random models of any size, which
    /// need no more memory than their weights. Nothing is ever missing.
    pub fn made(make: impl Fn(&str, &[usize]) -> Vec<f32> + 'static, device: &Device) -> Self {
        let mut weights = Self::empty("made", device);
        weights.made = Some(Box::new(make));
        weights
    }

    /// Safetensors bytes; tensors will lie on `device`.
    ///
    /// # Errors
    /// [`Error::Format`] if the bytes are truncated or no safetensors; [`Error::Tensor`] on an integer tensor.
    pub fn from_bytes(
        file: &str,
        bytes: impl Into<std::borrow::Cow<'static, [u8]>>,
        device: &Device,
    ) -> Result<Self> {
        let mut weights = Self::empty(file, device);
        weights.add(StoredFile::in_memory(file, bytes.into()))?;
        Ok(weights)
    }

    /// One safetensors file; tensors will lie on `device`.
    ///
    /// # Errors
    /// As [`Weights::from_bytes`], and [`Error::Io`].
    pub fn from_file(path: &Path, device: &Device) -> Result<Self> {
        let mut weights = Self::empty(&path.display().to_string(), device);
        weights.add_file(path)?;
        Ok(weights)
    }

    /// Adds the tensors of another file, which replace those of the same name.
    ///
    /// # Errors
    /// As [`Weights::from_file`].
    pub fn add_file(&mut self, path: &Path) -> Result<()> {
        self.add(StoredFile::open(path)?)
    }

    fn add(&mut self, file: StoredFile) -> Result<()> {
        for (name, stored) in file.tensors()? {
            self.sources.insert(published_name(&name), Source::Stored(stored));
        }
        Ok(())
    }

    /// In what form matrices are kept; [`WeightFormat::F32`] unless told. Vectors, convolutions and LoRA factors are
    /// always f32.
    pub fn with_format(mut self, format: WeightFormat) -> Self {
        self.format = format;
        self
    }

    /// In what form matrices are kept.
    pub fn format(&self) -> WeightFormat {
        self.format
    }

    /// Says which linear layers carry LoRA factors, and whether they are merged into the weight.
    pub fn with_lora(mut self, lora: LoraSet) -> Self {
        self.lora = lora;
        self
    }

    /// Which linear layers carry LoRA factors.
    pub fn lora(&self) -> &LoraSet {
        &self.lora
    }

    /// Whether a tensor of this name is there.
    pub fn has(&self, name: &str) -> bool {
        self.sources.contains_key(name)
    }

    /// The shape of the tensor of this name; `None` if it is not there.
    pub(crate) fn shape(&self, name: &str) -> Option<&[usize]> {
        self.sources.get(name).map(Source::dims)
    }

    /// Whether a tensor of this name and shape can be had. If not, that is recorded, and no memory is set aside.
    ///
    /// # Errors
    /// [`Error::TensorSet`] if the shape has more values than can be counted.
    pub(crate) fn require(&self, name: &str, shape: &[usize]) -> Result<bool> {
        if self.made.is_some() || self.find(name, shape).is_some() {
            return Ok(true);
        }
        self.stand_in(name, shape)?;
        Ok(false)
    }

    /// Records what is wrong with a tensor; `None` if that is something, or something was wrong before.
    fn find(&self, name: &str, shape: &[usize]) -> Option<&Source> {
        let Some(source) = self.sources.get(name) else {
            if self.made.is_none() {
                self.missing.borrow_mut().insert(name.to_string());
            }
            return None;
        };
        let seen = !self.read.borrow_mut().insert(name.to_string());
        if source.dims() != shape && !seen {
            let file = match source {
                Source::Stored(s) => s.file(),
                Source::Tensor(_) => &self.file,
            };
            self.misshaped.borrow_mut().push(Misshaped {
                file: file.to_string(),
                name: name.to_string(),
                found: source.dims().to_vec(),
                expected: shape.to_vec(),
            });
        }
        (self.missing.borrow().is_empty() && self.misshaped.borrow().is_empty()).then_some(source)
    }

    /// The tensor of this name, which must have this shape, as f32.
    ///
    /// A missing or misshaped tensor is recorded and zeros stand in for it, so that [`Weights::finish`] can list all of them
    /// at once.
    ///
    /// # Errors
    /// Those of [`Weights::finish`] at once if the stand-ins hold over 2^28 values.
    pub fn get(&self, name: &str, shape: &[usize]) -> Result<Tensor> {
        match self.find(name, shape) {
            Some(Source::Tensor(t)) => Ok(t.to_dtype(DType::F32)?),
            Some(Source::Stored(s)) => s.f32(&self.device),
            None => match self.make(name, shape)? {
                Some(made) => Ok(made),
                None => self.zeros(name, shape),
            },
        }
    }

    /// The matrix of this name as it is found.
    pub(crate) fn raw(&self, name: &str, shape: [usize; 2]) -> Result<Raw<'_>> {
        match self.find(name, &shape) {
            Some(Source::Tensor(t)) => Ok(Raw::Tensor(t.to_dtype(DType::F32)?)),
            Some(Source::Stored(s)) => Ok(Raw::Stored(s)),
            None => match self.make(name, &shape)? {
                Some(made) => Ok(Raw::Tensor(made)),
                None => {
                    self.stand_in(name, &shape)?;
                    Ok(Raw::Absent(shape))
                }
            },
        }
    }

    /// Some rows of the matrix of this name, `[ids, columns]`, without a look at the others.
    ///
    /// # Errors
    /// [`Error::TensorSet`] or [`Error::Tensor`] if there is no such matrix or it has another shape; [`Error::Argument`] on a row that is
    /// not there.
    #[cfg(feature = "train")]
    pub(crate) fn rows(&self, name: &str, shape: [usize; 2], ids: &[u32]) -> Result<Tensor> {
        if let Some(id) = ids.iter().find(|&&id| id as usize >= shape[0]) {
            return Err(Error::argument("token id", id, format!("below {}, the rows of `{name}`", shape[0])));
        }
        match self.raw(name, shape)? {
            Raw::Stored(stored) => stored.rows(ids, shape[1]),
            Raw::Tensor(tensor) => Ok(tensor.index_select(&Tensor::new(ids, tensor.device())?, 0)?),
            Raw::Absent(_) => Err(self.wrong(Vec::new())),
        }
    }

    /// Where tensors lie.
    pub(crate) fn device(&self) -> &Device {
        &self.device
    }

    fn make(&self, name: &str, shape: &[usize]) -> Result<Option<Tensor>> {
        let made = self.made.as_ref().map(|make| Tensor::from_vec(make(name, shape), shape, &self.device));
        Ok(made.transpose()?)
    }

    /// Records what is asked for and cannot be had; gives the number of its values.
    fn stand_in(&self, name: &str, shape: &[usize]) -> Result<usize> {
        self.stand_ins.borrow_mut().insert(name.to_string(), shape.to_vec());
        let values = shape.iter().try_fold(1usize, |n, &d| n.checked_mul(d));
        values.ok_or_else(|| self.wrong(Vec::new()))
    }

    /// Zeros in place of a tensor that cannot be had.
    fn zeros(&self, name: &str, shape: &[usize]) -> Result<Tensor> {
        let all = self.zeros.get().saturating_add(self.stand_in(name, shape)?);
        if all > STAND_INS {
            return Err(self.wrong(Vec::new()));
        }
        self.zeros.set(all);
        Ok(Tensor::zeros(shape, DType::F32, &Device::Cpu)?)
    }

    /// What was found to be wrong so far, and these tensors.
    fn wrong(&self, unexpected: Vec<String>) -> Error {
        let missing: Vec<String> = self.missing.borrow().iter().cloned().collect();
        let misshaped = self.misshaped.borrow();
        match &misshaped[..] {
            [one] if missing.is_empty() && unexpected.is_empty() => Error::Tensor {
                file: one.file.clone(),
                name: one.name.clone(),
                found: format!("shape {:?}", one.found),
                expected: format!("shape {:?}", one.expected),
            },
            all => {
                let told = |m: &Misshaped| format!("{} {:?}, expected {:?}", m.name, m.found, m.expected);
                let misshaped = all.iter().map(told).collect();
                Error::TensorSet { file: self.file.clone(), missing, unexpected, misshaped }
            }
        }
    }

    /// Declares that a tensor may be there without being read (a redundant tied head).
    pub fn ignore(&self, name: &str) {
        self.read.borrow_mut().insert(name.to_string());
    }

    /// Names and shapes that were asked for and are not there: of an empty set, the whole checkpoint's layout.
    pub fn wanted(&self) -> BTreeMap<String, Vec<usize>> {
        let (all, missing) = (self.stand_ins.borrow(), self.missing.borrow());
        all.iter().filter(|(name, _)| missing.contains(*name)).map(|(n, s)| (n.clone(), s.clone())).collect()
    }

    /// Must be called when the model is built: fails if a tensor was missing or had another shape, or one was never read.
    ///
    /// # Errors
    /// [`Error::TensorSet`] lists all of them; [`Error::Tensor`] if one of another shape is all that is wrong.
    pub fn finish(&self) -> Result<()> {
        let read = self.read.borrow();
        let mut unexpected: Vec<String> =
            self.sources.keys().filter(|k| !read.contains(*k)).cloned().collect();
        unexpected.sort();
        let complete = self.missing.borrow().is_empty() && self.misshaped.borrow().is_empty();
        if complete && unexpected.is_empty() { Ok(()) } else { Err(self.wrong(unexpected)) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_stands_in_for_missing_tensors_has_a_limit() {
        let weights = Weights::empty("nothing", &Device::Cpu);
        assert_eq!(weights.get("a", &[3, 4]).unwrap().dims(), [3, 4]);
        // Matrices take no memory, whatever they hold.
        assert!(
            matches!(weights.raw("b", [1 << 30, 1 << 30]), Ok(Raw::Absent([rows, _])) if rows == 1 << 30)
        );
        let missing = |error: Result<Tensor>| match error {
            Err(Error::TensorSet { missing, .. }) => missing,
            other => panic!("{other:?}"),
        };
        assert_eq!(missing(weights.get("c", &[STAND_INS])), ["a", "b", "c"]);
        assert!(weights.get("d", &[7]).is_ok());
        assert_eq!(missing(weights.get("e", &[usize::MAX, 2])).len(), 5);
        assert_eq!(weights.wanted().len(), 5);
    }
}
