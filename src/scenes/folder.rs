//! Folders of RGB-D frames: `rgb/NAME.png` or `.jpg`, `gt/NAME.png` or `.npy`, and perhaps `sparse/NAME.png` or `.npy`.

use std::fs;
use std::path::{Path, PathBuf};

use image::{ImageFormat, RgbImage};

use super::RgbdFrame;
use crate::depth::{DepthScale, SparseDepth, npy, png16};
use crate::error::{Error, Result};
use crate::frame::{image_error, read_rgb};

const PICTURES: [&str; 3] = ["png", "jpg", "jpeg"];
const DEPTHS: [&str; 2] = ["png", "npy"];

/// One frame of a folder.
#[derive(Clone, Debug)]
pub struct Sample {
    /// File name without its ending.
    pub name: String,
    /// The picture.
    pub rgb: RgbImage,
    /// Ground-truth Z-depth, metres, row-major, as many values as `rgb` has pixels; NaN where unknown.
    pub gt: Vec<f32>,
    /// Measurements of a real sensor, where the folder has them.
    pub sparse: Option<SparseDepth>,
}

#[derive(Clone, Debug)]
struct Entry {
    name: String,
    rgb: PathBuf,
    gt: PathBuf,
    sparse: Option<PathBuf>,
}

/// A folder of frames, in order of their names. Opening lists files, loading reads them.
#[derive(Clone, Debug)]
pub struct FolderDataset {
    entries: Vec<Entry>,
    scale: Option<DepthScale>,
}

impl FolderDataset {
    /// Lists `dir`. `scale` is the unit of its 16-bit PNGs and integer npy files; without one, loading such a file fails.
    ///
    /// Fails with [`Error::Io`] when `rgb` or `gt` cannot be listed, and with [`Error::Format`] naming the file when a
    /// picture has no ground truth, a ground truth or measurement no picture, or there is no frame at all.
    pub fn open(dir: impl AsRef<Path>, scale: impl Into<Option<DepthScale>>) -> Result<Self> {
        let dir = dir.as_ref();
        let pictures = list(&dir.join("rgb"), &PICTURES)?;
        let mut truths = list(&dir.join("gt"), &DEPTHS)?;
        let sparse_dir = dir.join("sparse");
        let mut measured = if sparse_dir.is_dir() { list(&sparse_dir, &DEPTHS)? } else { Vec::new() };
        let mut entries = Vec::with_capacity(pictures.len());
        for (name, rgb) in pictures {
            let Some(gt) = take(&mut truths, &name) else {
                return Err(Error::format(
                    rgb,
                    "no ground truth for it",
                    format!("gt/{name}.png or gt/{name}.npy"),
                ));
            };
            let sparse = take(&mut measured, &name);
            entries.push(Entry { name, rgb, gt, sparse });
        }
        if let Some((name, path)) = truths.into_iter().chain(measured).next() {
            return Err(Error::format(
                path,
                "no picture for it",
                format!("rgb/{name}.png or rgb/{name}.jpg"),
            ));
        }
        if entries.is_empty() {
            return Err(Error::format(dir.join("rgb"), "no picture", "at least one .png or .jpg"));
        }
        Ok(Self { entries, scale: scale.into() })
    }

    /// Number of frames, at least 1.
    pub fn len(&self) -> usize {
        self.entries.len()
    }

    /// Never true: an empty folder cannot be opened.
    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }

    /// Names of the frames, sorted.
    pub fn names(&self) -> impl Iterator<Item = &str> + '_ {
        self.entries.iter().map(|e| e.name.as_str())
    }

    /// Reads frame `index`.
    ///
    /// Fails with [`Error::Argument`] beyond the last frame, and with an error naming the file when one cannot be read or
    /// differs in size from its picture.
    pub fn load(&self, index: usize) -> Result<Sample> {
        let Some(entry) = self.entries.get(index) else {
            return Err(Error::argument("index", index, format!("below {}", self.entries.len())));
        };
        let rgb = read_rgb(&entry.rgb)?;
        let gt = self.depth(&entry.gt, &rgb)?.as_slice().to_vec();
        let sparse = entry.sparse.as_ref().map(|path| self.depth(path, &rgb)).transpose()?;
        Ok(Sample { name: entry.name.clone(), rgb, gt, sparse })
    }

    fn depth(&self, path: &Path, rgb: &RgbImage) -> Result<SparseDepth> {
        let map = SparseDepth::read(path, self.scale)?;
        let (w, h) = (rgb.width() as usize, rgb.height() as usize);
        if (map.width(), map.height()) != (w, h) {
            let found = format!("{}x{} pixels", map.width(), map.height());
            return Err(Error::format(path, found, format!("{w}x{h} as its picture")));
        }
        Ok(map)
    }
}

/// How [`write_frame`] stores depth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum DepthFile {
    /// f32 metres, exact.
    Npy,
    /// 16 bits in this unit, rounded; depths beyond its range become missing (0).
    Png(DepthScale),
}

/// Writes a frame into the layout of [`FolderDataset`], making the folders where needed.
///
/// Fails with [`Error::Io`] or [`Error::Format`] naming the file, and with [`Error::Argument`] for a name with a path
/// separator.
pub fn write_frame(dir: impl AsRef<Path>, name: &str, frame: &RgbdFrame, store: DepthFile) -> Result<()> {
    if name.is_empty() || name.contains(['/', '\\']) {
        return Err(Error::argument("name", format!("{name:?}"), "a file name without separators"));
    }
    let (rgb_dir, gt_dir) = (dir.as_ref().join("rgb"), dir.as_ref().join("gt"));
    for folder in [&rgb_dir, &gt_dir] {
        fs::create_dir_all(folder).map_err(Error::io(folder))?;
    }
    let path = rgb_dir.join(format!("{name}.png"));
    frame.rgb.save_with_format(&path, ImageFormat::Png).map_err(|e| image_error(&path, e))?;
    let (w, h) = (frame.width(), frame.height());
    match store {
        DepthFile::Npy => npy::write_npy(gt_dir.join(format!("{name}.npy")), w, h, &frame.depth),
        DepthFile::Png(scale) => {
            let stored: Vec<u16> = frame.depth.iter().map(|&d| in_units(d, scale)).collect();
            png16::write_png16(gt_dir.join(format!("{name}.png")), w, h, &stored)
        }
    }
}

fn in_units(metres: f32, scale: DepthScale) -> u16 {
    let (stored, saturated) = scale.stored(metres);
    if saturated { 0 } else { stored }
}

/// Files of a folder with one of the endings: (name without ending, path), sorted. Two files of one name are an error.
fn list(dir: &Path, endings: &[&str]) -> Result<Vec<(String, PathBuf)>> {
    let mut files = Vec::new();
    for entry in fs::read_dir(dir).map_err(Error::io(dir))? {
        let path = entry.map_err(Error::io(dir))?.path();
        let ending = path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
        let stem = path.file_stem().and_then(|s| s.to_str());
        if let (Some(ending), Some(stem)) = (ending, stem)
            && endings.contains(&ending.as_str())
            && !stem.starts_with('.')
        {
            files.push((stem.to_string(), path.clone()));
        }
    }
    files.sort();
    if let Some(two) = files.windows(2).find(|two| two[0].0 == two[1].0) {
        return Err(Error::format(&two[1].1, "a second file of this name", "one file per frame"));
    }
    Ok(files)
}

/// Removes the file of this name from a sorted list.
fn take(files: &mut Vec<(String, PathBuf)>, name: &str) -> Option<PathBuf> {
    let at = files.binary_search_by(|(n, _)| n.as_str().cmp(name)).ok()?;
    Some(files.remove(at).1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenes::procedural;

    #[test]
    fn what_is_written_is_loaded() {
        let dir = tempfile::tempdir().unwrap();
        let (a, b) = (procedural(3, 40, 30).unwrap(), procedural(4, 40, 30).unwrap());
        write_frame(dir.path(), "b", &a, DepthFile::Npy).unwrap();
        write_frame(dir.path(), "a", &b, DepthFile::Png(DepthScale::millimetres())).unwrap();
        let set = FolderDataset::open(dir.path(), DepthScale::millimetres()).unwrap();
        assert_eq!(set.names().collect::<Vec<_>>(), ["a", "b"]);
        let exact = set.load(1).unwrap();
        assert_eq!(exact.rgb, a.rgb);
        assert!(exact.gt.iter().zip(&a.depth).all(|(x, y)| x == y || (x.is_nan() && y.is_nan())));
        let rounded = set.load(0).unwrap();
        for (x, y) in rounded.gt.iter().zip(&b.depth) {
            assert!((x - y).abs() <= 0.00051 || (x.is_nan() && (*y >= 65.5 || y.is_nan())), "{x} {y}");
        }
        assert!(matches!(set.load(2), Err(Error::Argument { .. })));
    }

    #[test]
    fn errors_name_the_file() {
        let dir = tempfile::tempdir().unwrap();
        let scale = DepthScale::millimetres();
        let says = |needle: &str| {
            let set = FolderDataset::open(dir.path(), scale);
            let error =
                set.and_then(|s| (0..s.len()).try_for_each(|i| s.load(i).map(drop))).unwrap_err().to_string();
            assert!(error.contains(needle), "{error}");
        };
        says("rgb");
        let frame = procedural(5, 16, 12).unwrap();
        write_frame(dir.path(), "one", &frame, DepthFile::Npy).unwrap();
        write_frame(dir.path(), "two", &frame, DepthFile::Npy).unwrap();
        fs::remove_file(dir.path().join("gt/two.npy")).unwrap();
        says("two.png");
        npy::write_npy(dir.path().join("gt/two.npy"), 15, 12, &[1.0; 180]).unwrap();
        says("two.npy");
        fs::remove_file(dir.path().join("rgb/two.png")).unwrap();
        says("two.npy");
        fs::remove_file(dir.path().join("gt/two.npy")).unwrap();
        fs::write(dir.path().join("rgb/one.png"), b"not a picture").unwrap();
        says("one.png");
        assert!(matches!(
            write_frame(dir.path(), "../x", &frame, DepthFile::Npy),
            Err(Error::Argument { .. })
        ));
    }

    #[test]
    fn measurements_are_loaded_where_there_are_any() {
        let dir = tempfile::tempdir().unwrap();
        let frame = procedural(6, 16, 12).unwrap();
        write_frame(dir.path(), "one", &frame, DepthFile::Npy).unwrap();
        fs::create_dir(dir.path().join("sparse")).unwrap();
        let mut sparse = [f32::NAN; 192];
        sparse[17] = 2.5;
        npy::write_npy(dir.path().join("sparse/one.npy"), 16, 12, &sparse).unwrap();
        let sample = FolderDataset::open(dir.path(), DepthScale::kitti()).unwrap().load(0).unwrap();
        assert_eq!(sample.sparse.unwrap().points().collect::<Vec<_>>(), [(1, 1, 2.5)]);
    }
}
