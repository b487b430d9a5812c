//! Files that hold depth: 16-bit PNG, npy, npz, TIFF and OpenEXR. [`SparseDepth::read`](crate::SparseDepth::read) reads all
//! of them by their name.

#[cfg(feature = "exr")]
mod exr;
pub(crate) mod lzf;
pub(crate) mod npy;
mod npz;
pub(crate) mod png16;
mod raster;
mod scalar;
#[cfg(feature = "tiff")]
mod tiff;

use std::path::Path;

#[cfg(not(all(feature = "tiff", feature = "exr")))]
use crate::error::Error;
use crate::error::Result;
use crate::files::{extension, unknown_extension};

pub use npy::write_npy;
pub use png16::{read_png16, write_png16};
pub(crate) use raster::{Raster, Values};
pub(crate) use scalar::Scalar;

/// A depth file of any kind by its name; behind `.npz` may stand `:` and the name of an array.
///
/// # Errors
/// [`crate::Error::Io`]; [`crate::Error::Format`] for a damaged file, an unknown ending, and one whose feature this build lacks.
pub(super) fn read(path: &Path) -> Result<Raster> {
    if let Some((archive, name)) = named_array(path) {
        return npz::read_npz(archive, Some(name));
    }
    match extension(path).as_str() {
        "png" => {
            let (width, height, stored) = png16::read_png16(path)?;
            let values = Values::Integers(stored.into_iter().map(i64::from).collect());
            Ok(Raster { width, height, values })
        }
        "npy" => npy::read_npy(path),
        "npz" => npz::read_npz(path, None),
        #[cfg(feature = "tiff")]
        "tif" | "tiff" => tiff::read_tiff(path),
        #[cfg(not(feature = "tiff"))]
        "tif" | "tiff" => Err(Error::format(path, "a TIFF file", "a build with the feature `tiff`")),
        #[cfg(feature = "exr")]
        "exr" => exr::read_exr(path),
        #[cfg(not(feature = "exr"))]
        "exr" => Err(Error::format(path, "an OpenEXR file", "a build with the feature `exr`")),
        other => Err(unknown_extension(path, other, "png, npy, npz, tif, tiff or exr")),
    }
}

/// Archive and array of `FILE.npz:ARRAY`.
fn named_array(path: &Path) -> Option<(&Path, &str)> {
    let text = path.to_str()?;
    let (archive, name) = text.rsplit_once(':')?;
    let archive = Path::new(archive);
    archive.extension().is_some_and(|e| e.eq_ignore_ascii_case("npz")).then_some((archive, name))
}
