//! Folders of RGB-D frames: `rgb/NAME.png` or `.jpg`, `gt/NAME.png` or `.npy`, and perhaps `sparse/NAME.png` or `.npy`; or the
//! same side by side as `NAME_rgb`, `NAME_gt` and `NAME_sparse`. A folder with `rgb` and `sparse` and without `gt` is what a robot records:
//! its frames have measurements and no ground truth.

use std::fs;
use std::path::{Path, PathBuf};

use image::ImageFormat;

use super::dataset::Sample;
use super::files::{Listed, PICTURES, all_taken, depth, list, list_some, picture, take, unpaired};
use super::flat::Flat;
use super::listing::{Frame, Loader};
use crate::depth::DepthScale;
use crate::depth::io::{npy, png16};
use crate::error::{Error, Result};
use crate::image::image_error;
use crate::scenes::RgbdFrame;

const DEPTHS: [&str; 2] = ["png", "npy"];

#[derive(Clone, Debug)]
pub(super) struct Files {
    rgb: PathBuf,
    gt: Option<PathBuf>,
    sparse: Option<PathBuf>,
    scale: Option<DepthScale>,
}

/// A folder of frames, in order of their names. Opening lists files, loading reads them.
#[derive(Clone, Debug)]
pub struct FolderDataset {
    frames: Vec<Frame<Files>>,
}

impl FolderDataset {
    /// Lists `dir`. `scale` is the unit of its 16-bit PNGs and integer npy files; without one, that of `manifest.json` counts
    /// where frames lie side by side, and else loading such a file fails.
    ///
    /// Where `gt` is absent and `sparse` is not, the ground truth of all frames is NaN.
    ///
    /// Fails with [`Error::Io`] when `rgb` or `gt` cannot be listed, and with [`Error::Format`] naming the file when a
    /// picture has no ground truth, a ground truth or measurement no picture, or there is no frame at all. Other folders
    /// (`intrinsics/`) are left alone.
    pub fn open(dir: impl AsRef<Path>, scale: impl Into<Option<DepthScale>>) -> Result<Self> {
        let (dir, scale) = (dir.as_ref(), scale.into());
        let flat = if dir.join("rgb").exists() { None } else { Flat::list(dir, &DEPTHS)? };
        if let Some(Flat { pictures, truths, measured, scales }) = flat {
            let at = |name: &str, part: &str| format!("{name}_{part}.png");
            return Self::pair(pictures, truths, measured, at, |name| scale.or(scales.get(name).copied()));
        }
        let pictures = list_some(&dir.join("rgb"), &PICTURES)?;
        let (gt_dir, sparse_dir) = (dir.join("gt"), dir.join("sparse"));
        let mut measured = if sparse_dir.is_dir() { list(&sparse_dir, &DEPTHS)? } else { Vec::new() };
        if !gt_dir.exists() && !measured.is_empty() {
            return Self::measured_alone(pictures, &mut measured, scale);
        }
        let truths = list(&gt_dir, &DEPTHS)?;
        let at = |name: &str, part: &str| format!("{part}/{name}.png");
        Self::pair(pictures, truths, measured, at, |_| scale)
    }

    /// Frames without ground truth, each with its measurements.
    fn measured_alone(pictures: Listed, measured: &mut Listed, scale: Option<DepthScale>) -> Result<Self> {
        let mut frames = Vec::with_capacity(pictures.len());
        for (name, rgb) in pictures {
            let sparse = take(measured, &name);
            let lacks = || unpaired(&rgb, "measurements", format!("sparse/{name}.png or .npy"));
            let files = Files { sparse: Some(sparse.ok_or_else(lacks)?), rgb, gt: None, scale };
            frames.push(Frame { name, files });
        }
        all_taken(std::mem::take(measured), |name| format!("rgb/{name}.png or .jpg"))?;
        Ok(Self { frames })
    }

    fn pair(
        pictures: Listed,
        mut truths: Listed,
        mut measured: Listed,
        at: impl Fn(&str, &str) -> String,
        scale: impl Fn(&str) -> Option<DepthScale>,
    ) -> Result<Self> {
        let mut frames = Vec::with_capacity(pictures.len());
        for (name, rgb) in pictures {
            let Some(gt) = take(&mut truths, &name) else {
                return Err(unpaired(&rgb, "ground truth", format!("{} or .npy", at(&name, "gt"))));
            };
            let (sparse, scale) = (take(&mut measured, &name), scale(&name));
            frames.push(Frame { name, files: Files { rgb, gt: Some(gt), sparse, scale } });
        }
        truths.append(&mut measured);
        all_taken(truths, |name| format!("{} or .jpg", at(name, "rgb")))?;
        Ok(Self { frames })
    }
}

impl Loader for FolderDataset {
    type Files = Files;

    fn frames(&self) -> &[Frame<Files>] {
        &self.frames
    }

    fn brings_measurements(&self, files: &Files) -> bool {
        files.sparse.is_some()
    }

    fn read(&self, frame: &Frame<Files>, _: usize) -> Result<Sample> {
        let Files { rgb, gt, sparse, scale } = &frame.files;
        let rgb = picture(rgb)?;
        let gt = match gt {
            Some(path) => depth(path, *scale, &rgb)?.as_slice().to_vec(),
            None => vec![f32::NAN; rgb.width() as usize * rgb.height() as usize],
        };
        let sparse = sparse.as_ref().map(|path| depth(path, *scale, &rgb)).transpose()?;
        Ok(Sample { name: frame.name.clone(), rgb, gt, sparse, masks: Vec::new() })
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

/// Writes a frame into the layout of [`Layout::Folder`](super::Layout::Folder), making the folders where needed.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::benchmarks::dataset::Dataset;
    use crate::scenes::procedural;

    #[test]
    fn what_is_written_is_loaded() {
        let dir = tempfile::tempdir().unwrap();
        let (a, b) = (procedural(3, 40, 30).unwrap(), procedural(4, 40, 30).unwrap());
        write_frame(dir.path(), "b", &a, DepthFile::Npy).unwrap();
        write_frame(dir.path(), "a", &b, DepthFile::Png(DepthScale::millimetres())).unwrap();
        let set = FolderDataset::open(dir.path(), DepthScale::millimetres()).unwrap();
        assert_eq!([0, 1, 2].map(|i| set.name(i)), ["a", "b", ""]);
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
    fn a_robots_own_frames_have_no_ground_truth() {
        let dir = tempfile::tempdir().unwrap();
        let frame = procedural(6, 16, 12).unwrap();
        write_frame(dir.path(), "one", &frame, DepthFile::Npy).unwrap();
        fs::rename(dir.path().join("gt"), dir.path().join("sparse")).unwrap();
        let set = FolderDataset::open(dir.path(), None).unwrap();
        let sample = set.load(0).unwrap();
        assert!(set.has_measurements(0) && sample.gt.iter().all(|d| d.is_nan()) && sample.gt.len() == 192);
        let known = frame.depth.iter().filter(|d| d.is_finite()).count();
        assert_eq!(sample.sparse.unwrap().measured(), known);
        frame.rgb.save(dir.path().join("rgb/two.png")).unwrap();
        let error = FolderDataset::open(dir.path(), None).unwrap_err().to_string();
        assert!(error.contains("two.png") && error.contains("sparse/two"), "{error}");
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
