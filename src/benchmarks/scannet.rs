//! ScanNet (Dai et al., CVPR 2017) as its `SensReader` exports it, and recordings like it.

use std::path::{Path, PathBuf};

use super::dataset::Sample;
use super::files::{
    PICTURES, all_taken, frame_name, list, list_some, naming, picture, recordings, take, unpaired,
};
use super::listing::{Frame, Loader};
use crate::depth::{DepthScale, SparseDepth};
use crate::error::{Error, Result};
use crate::image::resize::lanczos;

#[derive(Clone, Debug)]
pub(super) struct Files {
    rgb: PathBuf,
    gt: PathBuf,
}

/// One scene, or a folder of scenes, each with `color/NUMBER.jpg` and `depth/NUMBER.png`.
///
/// Depth is stored in 16 bits, in millimetres, 0 = none. Colour is larger than depth (1296 x 968 and 640 x 480): the picture is
/// resized to the depth map's size by Lanczos' filter, as Marigold-DC prepares ScanNet with Pillow, here exact to the bit of Pillow
/// 12; depth is never resampled, so that no value is invented. A picture whose sides are in another ratio (more than 2 %) is an
/// error. Frames are in order of their numbers and have no measurements of their own.
///
/// Evaluations take a choice of the frames: Marigold-DC the 745 of `scannet_decotr_split.txt` in its repository, a list as
/// [`super::LayoutOptions::frames`] takes it.
#[derive(Clone, Debug)]
pub struct ScanNetDataset {
    frames: Vec<Frame<Files>>,
}

impl ScanNetDataset {
    /// Lists the frames.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Format`] naming the file that lacks a partner.
    pub fn open(dir: impl AsRef<Path>) -> Result<Self> {
        let mut frames = Vec::new();
        for (scene, dir) in recordings(dir.as_ref(), ["color", "depth"])? {
            let mut truths = list(&dir.join("depth"), &["png"])?;
            let mut pictures = list_some(&dir.join("color"), &PICTURES)?;
            pictures.sort_by(|a, b| number(&a.0).cmp(&number(&b.0)));
            for (frame, rgb) in pictures {
                let gt = take(&mut truths, &frame);
                let gt = gt.ok_or_else(|| unpaired(&rgb, "depth", format!("depth/{frame}.png")))?;
                frames.push(Frame { name: frame_name(&scene, &frame), files: Files { rgb, gt } });
            }
            all_taken(truths, |name| format!("color/{name}.jpg"))?;
        }
        Ok(Self { frames })
    }
}

/// Orders 2 before 10; names that are no numbers come first, by their letters.
fn number(name: &str) -> (Option<u64>, &str) {
    (name.parse().ok(), name)
}

impl Loader for ScanNetDataset {
    type Files = Files;

    fn frames(&self) -> &[Frame<Files>] {
        &self.frames
    }

    fn read(&self, frame: &Frame<Files>, _: usize) -> Result<Sample> {
        let Files { rgb: rgb_path, gt } = &frame.files;
        let depth = SparseDepth::read(gt, Some(DepthScale::millimetres())).map_err(|e| naming(gt, e))?;
        let mut rgb = picture(rgb_path)?;
        let (w, h) = (depth.width(), depth.height());
        let (rgb_w, rgb_h) = (rgb.width() as usize, rgb.height() as usize);
        if (rgb_w * h).abs_diff(rgb_h * w) * 50 > rgb_h * w {
            let expected = format!("sides in the ratio of its depth map's {w}x{h}");
            return Err(Error::format(rgb_path, format!("{rgb_w}x{rgb_h} pixels"), expected));
        }
        if (rgb_w, rgb_h) != (w, h) {
            rgb = lanczos(&rgb, w, h);
        }
        Ok(Sample {
            name: frame.name.clone(),
            rgb,
            gt: depth.as_slice().to_vec(),
            sparse: None,
            masks: Vec::new(),
        })
    }
}
