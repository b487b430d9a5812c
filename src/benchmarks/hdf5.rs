//! HDF5 files through the crate `hdf5-reader`: arrays of numbers, with limits on what a file may ask for.

use std::path::{Path, PathBuf};

use half::f16;
use hdf5_reader::error::Error as Hdf5Error;
use hdf5_reader::{
    ByteOrder, Datatype, FilterRegistry, H5Type, Hdf5File, OpenOptions, SliceInfo, SliceInfoElem,
};

use crate::depth::io::lzf;
use crate::error::{Error, Result};

/// The registered number of the filter LZF.
const LZF: u16 = 32000;
/// Largest array read at once, bytes: a picture of 16 megapixels in f64.
const LARGEST_READ: usize = 1 << 27;

/// An open file.
pub(super) struct Numbers {
    path: PathBuf,
    file: Hdf5File,
    size: u64,
}

impl Numbers {
    /// Opens a file; only its structure is read.
    pub(super) fn open(path: &Path) -> Result<Self> {
        // Opening by the crate reports an absent file without its name.
        let size = std::fs::metadata(path).map_err(Error::io(path))?.len();
        let options = OpenOptions {
            max_read_bytes: LARGEST_READ,
            max_chunk_bytes: LARGEST_READ,
            filter_registry: Some(filters()),
            ..Default::default()
        };
        let file = Hdf5File::open_with_options(path, options);
        let file = file.map_err(|e| Error::format(path, e.to_string(), "an HDF5 file"))?;
        Ok(Self { path: path.to_path_buf(), file, size })
    }

    /// Bytes of the file.
    pub(super) fn size(&self) -> u64 {
        self.size
    }

    /// Lengths of a data set.
    pub(super) fn shape(&self, name: &str) -> Result<Vec<usize>> {
        let data = self.file.dataset(name).map_err(|e| self.wrong(name, e.to_string()))?;
        // A length beyond the machine's can only be a lie; the largest number fails every later check.
        Ok(data.shape().iter().map(|&n| usize::try_from(n).unwrap_or(usize::MAX)).collect())
    }

    /// 8-bit values, of the whole data set or of one index of its first axis.
    pub(super) fn bytes(&self, name: &str, index: Option<usize>) -> Result<Vec<u8>> {
        let data = self.file.dataset(name).map_err(|e| self.wrong(name, e.to_string()))?;
        let values = data.read_slice::<u8>(&selection(data.ndim(), index));
        Ok(values.map_err(|e| self.wrong(name, e.to_string()))?.iter().copied().collect())
    }

    /// Floating-point values (f16, f32 or f64), of the whole data set or of one index of its first axis.
    pub(super) fn floats(&self, name: &str, index: Option<usize>) -> Result<Vec<f32>> {
        let data = self.file.dataset(name).map_err(|e| self.wrong(name, e.to_string()))?;
        let selection = selection(data.ndim(), index);
        let values = match data.dtype() {
            Datatype::FloatingPoint { size: 2, .. } => {
                data.read_slice::<Half>(&selection).map(|a| a.iter().map(|v| v.0).collect())
            }
            Datatype::FloatingPoint { size: 4, .. } => {
                data.read_slice::<f32>(&selection).map(|a| a.iter().copied().collect())
            }
            Datatype::FloatingPoint { size: 8, .. } => {
                data.read_slice::<f64>(&selection).map(|a| a.iter().map(|&v| v as f32).collect())
            }
            other => return Err(self.wrong(name, format!("elements {other:?}"))),
        };
        values.map_err(|e| self.wrong(name, e.to_string()))
    }

    /// The error for a data set that is not what it should be.
    pub(super) fn wrong(&self, name: &str, found: String) -> Error {
        Error::format(
            &self.path,
            format!("data set `{name}`: {found}"),
            "8-bit pictures, floating-point depth",
        )
    }
}

/// A number that is stored in 16 bits, for which the reader has no type.
#[derive(Clone, Copy)]
struct Half(f32);

impl H5Type for Half {
    fn hdf5_type() -> Datatype {
        Datatype::FloatingPoint { size: 2, byte_order: ByteOrder::LittleEndian }
    }

    fn from_bytes(bytes: &[u8], dtype: &Datatype) -> hdf5_reader::error::Result<Self> {
        match (dtype, bytes) {
            (Datatype::FloatingPoint { size: 2, byte_order }, &[a, b]) => {
                let big = *byte_order == ByteOrder::BigEndian;
                let value = if big { f16::from_be_bytes([a, b]) } else { f16::from_le_bytes([a, b]) };
                Ok(Self(value.to_f32()))
            }
            _ => {
                let actual = format!("{dtype:?}");
                Err(Hdf5Error::TypeMismatch { expected: "a number of 16 bits".into(), actual })
            }
        }
    }

    fn element_size(_: &Datatype) -> usize {
        2
    }
}

fn filters() -> FilterRegistry {
    let mut filters = FilterRegistry::new();
    let unpack = |data: &[u8]| lzf::unpack(data, LARGEST_READ);
    let damaged = || Hdf5Error::DecompressionError("damaged LZF data".to_string());
    filters.register(LZF, Box::new(move |_, data, _| unpack(data).ok_or_else(damaged)));
    filters
}

fn selection(axes: usize, index: Option<usize>) -> SliceInfo {
    let mut all = SliceInfo::all(axes);
    if let (Some(index), Some(first)) = (index, all.selections.first_mut()) {
        *first = SliceInfoElem::Index(index as u64);
    }
    all
}
