//! iBims-1 (Koch et al., ECCV Workshops 2018): 100 indoor frames of a laser scanner.

use std::path::{Path, PathBuf};

use image::{Rgb, RgbImage};

use super::dataset::{Mask, Sample};
use super::files::{lines, list_some, naming};
use super::listing::{Frame, Loader};
use super::mat::Record;
use crate::depth::SparseDepth;
use crate::depth::pixels::pixel_count;
use crate::error::{Error, Result};

/// Masks of the file that are passed on: the field, the name of the mask, and whether the pixels meant are those with 0.
const MASKS: [(&str, &str, bool); 6] = [
    ("mask_invalid", "invalid", true),
    ("mask_transp", "transparent", true),
    ("edges", "edges", false),
    ("mask_wall", "wall", false),
    ("mask_table", "table", false),
    ("mask_floor", "floor", false),
];

/// The core data set (`ibims1_core_mat`): 100 frames of 640 x 480 pixels, one MATLAB file each.
///
/// Each file holds a struct `data` with `rgb`, `depth` (metres), `mask_invalid` and `mask_transp` (1 where a pixel is usable),
/// `edges`, and masks of walls, tables and floors. Frames are those of `imagelist.txt` in its order, or all files by name where
/// there is no list. The ground truth counts where depth is not 0 and both masks are 1, the intersection that the official
/// evaluation script takes; the protocol draws 1000 points from it. Neither resized nor cropped.
///
/// The masks of a sample: `invalid`, `transparent`, `missing` (depth 0), and, where the file has them, `edges`, `wall`, `table`,
/// `floor`; true where the pixel is what the name says.
#[derive(Clone, Debug)]
pub struct IbimsDataset {
    frames: Vec<Frame<PathBuf>>,
}

impl IbimsDataset {
    /// Lists the files in the folder, or in `ibims1_core_mat` below it.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Format`] naming the folder without a MATLAB file, or the list that names an absent one.
    pub fn open(dir: impl AsRef<Path>) -> Result<Self> {
        let dir = dir.as_ref();
        let below = ["ibims1_core_mat/ibims1_core_mat", "ibims1_core_mat"].map(|place| dir.join(place));
        let place = below.iter().find(|d| d.is_dir());
        let files = list_some(place.map_or(dir, PathBuf::as_path), &["mat"])?;
        let list = dir.join("imagelist.txt");
        if !list.is_file() {
            let frames = files.into_iter().map(|(name, files)| Frame { name, files });
            return Ok(Self { frames: frames.collect() });
        }
        let mut frames = Vec::new();
        for line in lines(&list)? {
            let name = line.strip_suffix(".mat").unwrap_or(&line);
            let Some((_, file)) = files.iter().find(|(n, _)| n == name) else {
                let expected = format!("{name}.mat beside the other files");
                return Err(Error::format(&list, format!("frame {name:?}, which has no file"), expected));
            };
            frames.push(Frame { name: name.to_string(), files: file.clone() });
        }
        if frames.is_empty() {
            return Err(Error::format(&list, "no name", "one frame per line"));
        }
        Ok(Self { frames })
    }
}

impl Loader for IbimsDataset {
    type Files = PathBuf;

    fn frames(&self) -> &[Frame<PathBuf>] {
        &self.frames
    }

    fn read(&self, frame: &Frame<PathBuf>, _: usize) -> Result<Sample> {
        let path = &frame.files;
        let data = Record::read(path, "data")?;
        let shape = data.field("depth").map(|d| d.shape.clone()).unwrap_or_default();
        let [h, w] = shape[..] else {
            return Err(Error::format(
                path,
                format!("`depth` of shape {shape:?}"),
                "a field `depth` of rows and columns",
            ));
        };
        pixel_count(w, h).map_err(|e| naming(path, e))?;
        let rgb = picture(&data, w, h, path)?;
        let depth = by_rows(&data.values("depth", &shape)?, w, h);
        let mut masks = Vec::new();
        for (field, name, of_zeros) in MASKS {
            // Planes are marked in few frames only; validity is needed in all.
            let absent = data.field(field).is_none_or(|f| f.shape.contains(&0));
            if absent && !of_zeros {
                continue;
            }
            let values = by_rows(&data.values(field, &shape)?, w, h);
            masks.push(Mask { name, pixels: values.into_iter().map(|v| (v == 0.0) == of_zeros).collect() });
        }
        masks.push(Mask { name: "missing", pixels: depth.iter().map(|&d| d == 0.0).collect() });
        let excluded = |i: usize| {
            let named = |m: &&Mask| matches!(m.name, "invalid" | "transparent" | "missing");
            masks.iter().filter(named).any(|m| m.pixels[i])
        };
        let gt = depth.iter().enumerate().map(|(i, &d)| if excluded(i) { f32::NAN } else { d as f32 });
        let gt = SparseDepth::new(w, h, gt.collect()).map_err(|e| naming(path, e))?.as_slice().to_vec();
        Ok(Sample { name: frame.name.clone(), rgb, gt, sparse: None, masks })
    }
}

/// Values that lie column by column, row by row.
fn by_rows(values: &[f64], w: usize, h: usize) -> Vec<f64> {
    (0..w * h).map(|i| values[i % w * h + i / w]).collect()
}

fn picture(data: &Record, w: usize, h: usize, path: &Path) -> Result<RgbImage> {
    let values = data.values("rgb", &[h, w, 3])?;
    if let Some(v) = values.iter().find(|v| !(0.0..=255.0).contains(*v)) {
        return Err(Error::format(path, format!("a colour of {v}"), "`rgb` of 0 to 255"));
    }
    Ok(RgbImage::from_fn(w as u32, h as u32, |x, y| {
        let at = x as usize * h + y as usize;
        Rgb([0, 1, 2].map(|c| values[c * w * h + at] as u8))
    }))
}
