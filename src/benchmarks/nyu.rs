//! NYU Depth V2 (Silberman et al., ECCV 2012): the 654 official test frames.

use std::path::{Path, PathBuf};

use image::RgbImage;

use super::dataset::{Dataset, Sample};
use super::files::{Listed, list_some, naming};
use super::hdf5::Numbers;
use super::listing::entry;
use crate::depth::SparseDepth;
use crate::error::{Error, Result};

/// Size of a stored frame.
const STORED_SIZE: (usize, usize) = (640, 480);
/// Size of a frame of the protocol.
const CROP_SIZE: (usize, usize) = (304, 228);
/// What is cut off on the left and at the top of the 320 x 240 frame.
const CROP_MARGIN: (usize, usize) = ((320 - CROP_SIZE.0) / 2, (240 - CROP_SIZE.1) / 2);

/// The 654 official test frames at 304 x 228 pixels, in either of the forms in which they are passed around.
///
/// **One HDF5 file per frame** (`val/official/NUMBER.h5` of sparse-to-dense, Ma and Karaman, ICRA 2018; `rgb` 3 x 480 x 640
/// 8-bit, `depth` 480 x 640 floating-point metres). Picture and depth are halved to 320 x 240 and cropped at the centre, as
/// NLSPN (ECCV 2020) and its successors do with torchvision on Pillow images: bilinear with antialiasing, which for a half is
/// the weights 1, 3, 3, 1 in each direction, exact to the bit of Pillow 12 here. A pixel whose 4 x 4 source pixels are not all
/// valid has no depth (the official depth is filled, so none is lost). The protocol draws 500 points.
///
/// **One HDF5 file for all** (`nyu_img_gt.h5` and, optional, `nyu_pred_with_500.h5` of Conti et al., WACV 2023, which
/// Marigold-DC takes: `img` N x 228 x 304 x 3 8-bit, `gt` and `hints` N x 228 x 304 x 1 floating-point metres), already halved
/// and cropped. Where there are hints they are the measurements: 500 published points per frame.
pub struct NyuDataset {
    source: Source,
}

enum Source {
    Frames(Listed),
    Bundle { path: PathBuf, images: Numbers, hints: Option<(PathBuf, Numbers)>, frames: usize },
}

impl NyuDataset {
    /// Looks for `nyu_img_gt.h5`, then for frames in `val/official`, `official` and the folder itself.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Format`] naming the folder without a frame, or the file with other arrays than these.
    pub fn open(dir: impl AsRef<Path>) -> Result<Self> {
        let dir = dir.as_ref();
        let bundle = dir.join("nyu_img_gt.h5");
        if bundle.is_file() {
            return Ok(Self { source: open_bundle(bundle, dir.join("nyu_pred_with_500.h5"))? });
        }
        for place in ["val/official", "official"] {
            if dir.join(place).is_dir() {
                return Ok(Self { source: Source::Frames(list_some(&dir.join(place), &["h5"])?) });
            }
        }
        Ok(Self { source: Source::Frames(list_some(dir, &["h5"])?) })
    }
}

fn open_bundle(path: PathBuf, hints: PathBuf) -> Result<Source> {
    let images = Numbers::open(&path)?;
    let frames = frames_of(&images, "img", 3)?;
    let depths = frames_of(&images, "gt", 1)?;
    if frames != depths || frames == 0 {
        let found = format!("{frames} pictures and {depths} depth maps");
        return Err(Error::format(path, found, "one depth map for each of at least one picture"));
    }
    let hints = if hints.is_file() { Some((hints.clone(), Numbers::open(&hints)?)) } else { None };
    if let Some((hints_path, file)) = &hints {
        let found = frames_of(file, "hints", 1)?;
        if found != frames {
            let expected = format!("{frames} as in {}", path.display());
            return Err(Error::format(hints_path, format!("measurements of {found} frames"), expected));
        }
    }
    Ok(Source::Bundle { path, images, hints, frames })
}

/// Number of frames in an array of frames of the protocol's size.
fn frames_of(file: &Numbers, name: &str, channels: usize) -> Result<usize> {
    let shape = file.shape(name)?;
    match shape[..] {
        // A frame takes more than a byte, however well it is compressed: a file cannot claim endless frames.
        [frames, h, w, c] if (w, h) == CROP_SIZE && c == channels && frames as u64 <= file.size() => {
            Ok(frames)
        }
        _ => Err(file.wrong(
            name,
            format!("shape {shape:?} instead of [N, {}, {}, {}]", CROP_SIZE.1, CROP_SIZE.0, channels),
        )),
    }
}

impl Dataset for NyuDataset {
    fn len(&self) -> usize {
        match &self.source {
            Source::Frames(files) => files.len(),
            Source::Bundle { frames, .. } => *frames,
        }
    }

    fn name(&self, index: usize) -> String {
        match &self.source {
            Source::Frames(files) => files.get(index).map(|f| f.0.clone()).unwrap_or_default(),
            Source::Bundle { frames, .. } if index < *frames => format!("{index:04}"),
            Source::Bundle { .. } => String::new(),
        }
    }

    fn has_measurements(&self, index: usize) -> bool {
        matches!(&self.source, Source::Bundle { hints: Some(_), frames, .. } if index < *frames)
    }

    fn load(&self, index: usize) -> Result<Sample> {
        let (rgb, gt, sparse) = match &self.source {
            Source::Frames(files) => {
                let path = &entry(files, index)?.1;
                let (rgb, gt) = halved(path)?;
                (rgb, cropped(gt, path)?, None)
            }
            Source::Bundle { path, images, hints, frames } => {
                if index >= *frames {
                    return Err(Error::argument("index", index, format!("below {frames}")));
                }
                let rgb = images.bytes("img", Some(index))?;
                let gt = cropped(images.floats("gt", Some(index))?, path)?;
                let read =
                    |(path, file): &(PathBuf, Numbers)| cropped(file.floats("hints", Some(index))?, path);
                (rgb, gt, hints.as_ref().map(read).transpose()?)
            }
        };
        let rgb = RgbImage::from_raw(CROP_SIZE.0 as u32, CROP_SIZE.1 as u32, rgb);
        let expected = CROP_SIZE.0 * CROP_SIZE.1 * 3;
        let rgb = rgb.ok_or(Error::BufferLength { what: "picture", expected, found: 0 })?;
        Ok(Sample { name: self.name(index), rgb, gt: gt.as_slice().to_vec(), sparse, masks: Vec::new() })
    }
}

fn cropped(depth: Vec<f32>, path: &Path) -> Result<SparseDepth> {
    SparseDepth::new(CROP_SIZE.0, CROP_SIZE.1, depth).map_err(|e| naming(path, e))
}

/// A frame's own file, halved and cropped: interleaved colours and depth.
fn halved(path: &Path) -> Result<(Vec<u8>, Vec<f32>)> {
    let file = Numbers::open(path)?;
    let (w, h) = STORED_SIZE;
    for (name, expected) in [("rgb", &[3, h, w][..]), ("depth", &[h, w])] {
        let shape = file.shape(name)?;
        if shape != expected {
            return Err(file.wrong(name, format!("shape {shape:?} instead of {expected:?}")));
        }
    }
    let planes = file.bytes("rgb", None)?;
    let mut rgb = vec![0; CROP_SIZE.0 * CROP_SIZE.1 * 3];
    for (c, plane) in planes.chunks_exact(w * h).enumerate() {
        let half = half(plane, |[a, b, c, d]: [u8; 4]| {
            let [a, b, c, d] = [a, b, c, d].map(u16::from);
            ((a + 3 * b + 3 * c + d + 4) / 8) as u8
        });
        rgb.iter_mut().skip(c).step_by(3).zip(half).for_each(|(to, from)| *to = from);
    }
    let mut depth = file.floats("depth", None)?;
    depth.iter_mut().filter(|d| !crate::depth::pixels::is_valid(**d)).for_each(|d| *d = f32::NAN);
    let depth = half(&depth, |four: [f32; 4]| {
        let [a, b, c, d] = four.map(f64::from);
        (a * 0.125 + b * 0.375 + c * 0.375 + d * 0.125) as f32
    });
    Ok((rgb, depth))
}

/// The centre of half a plane: columns first, rounded to the plane's own type, then rows.
fn half<T: Copy>(plane: &[T], weigh: impl Fn([T; 4]) -> T) -> Vec<T> {
    let (top, left) = (2 * CROP_MARGIN.1 - 1, 2 * CROP_MARGIN.0 - 1);
    let narrow: Vec<T> = (0..2 * CROP_SIZE.1 + 2)
        .flat_map(|row| {
            let row = &plane[(top + row) * STORED_SIZE.0 + left..];
            (0..CROP_SIZE.0).map(move |x| [row[2 * x], row[2 * x + 1], row[2 * x + 2], row[2 * x + 3]])
        })
        .map(&weigh)
        .collect();
    let at = |x: usize, y: usize| narrow[y * CROP_SIZE.0 + x];
    let rows = (0..CROP_SIZE.1).flat_map(|y| (0..CROP_SIZE.0).map(move |x| (x, 2 * y)));
    rows.map(|(x, y)| weigh([at(x, y), at(x, y + 1), at(x, y + 2), at(x, y + 3)])).collect()
}
