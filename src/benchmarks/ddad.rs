//! DDAD (Guizilini et al., CVPR 2020): front camera, as VPP4DC prepared it for depth completion.

use std::path::{Path, PathBuf};

use super::dataset::{Sample, frame_seed};
use super::files::{all_taken, depth, first_with, list, list_some, picture, take, unpaired};
use super::listing::{Frame, Loader};
use super::outliers::{THRESHOLD, WINDOW, remove_outliers};
use crate::depth::{DepthScale, SparseDepth, sample_points};
use crate::error::Result;

#[derive(Clone, Debug)]
pub(super) struct Files {
    rgb: PathBuf,
    gt: PathBuf,
    hints: Option<PathBuf>,
}

/// The 3950 validation frames of the front camera, 1936 x 1216 pixels.
///
/// Read from the archive that Marigold-DC points to (`ddad_pregenerated.zip`, folder `pregenerated/val`): `rgb/NUMBER.png`,
/// `gt/NUMBER.png` and `hints/NUMBER.png`, depth in 16 bits, 256 units per metre, 0 = none. Neither resized nor cropped. The
/// hints are the published choice of about 20 % of the scanner's points. Without a folder `hints`, a fifth of the ground
/// truth's points (rounded up) is drawn, the same for the same seed; results are then near to, but not, the published
/// protocol's. Either way the points go through [`remove_outliers`] as on KITTI; the ground truth does not.
#[derive(Clone, Debug)]
pub struct DdadDataset {
    frames: Vec<Frame<Files>>,
    seed: u64,
}

impl DdadDataset {
    /// Lists `pregenerated/val`, or a folder that holds it. `seed` is used only without `hints`.
    ///
    /// # Errors
    /// [`crate::Error::Io`]; [`crate::Error::Format`] naming the file that lacks a partner.
    pub fn open(dir: impl AsRef<Path>, seed: u64) -> Result<Self> {
        let dir = first_with(dir.as_ref(), &["", "val", "pregenerated/val"], "rgb")?;
        let hints_dir = dir.join("hints");
        let mut truths = list(&dir.join("gt"), &["png"])?;
        let mut hints = if hints_dir.is_dir() { Some(list(&hints_dir, &["png"])?) } else { None };
        let mut frames = Vec::new();
        for (name, rgb) in list_some(&dir.join("rgb"), &["png"])? {
            let lacks = |kind: &str| unpaired(&rgb, kind, format!("{kind}/{name}.png"));
            let gt = take(&mut truths, &name).ok_or_else(|| lacks("gt"))?;
            let hints = match &mut hints {
                Some(files) => Some(take(files, &name).ok_or_else(|| lacks("hints"))?),
                None => None,
            };
            frames.push(Frame { name, files: Files { rgb, gt, hints } });
        }
        truths.extend(hints.unwrap_or_default());
        all_taken(truths, |name| format!("rgb/{name}.png"))?;
        Ok(Self { frames, seed })
    }
}

impl Loader for DdadDataset {
    type Files = Files;

    fn frames(&self) -> &[Frame<Files>] {
        &self.frames
    }

    fn brings_measurements(&self, _: &Files) -> bool {
        true
    }

    fn read(&self, frame: &Frame<Files>, index: usize) -> Result<Sample> {
        let Files { rgb, gt, hints } = &frame.files;
        let scale = Some(DepthScale::kitti());
        let rgb = picture(rgb)?;
        let gt = depth(gt, scale, &rgb)?;
        let chosen = match hints {
            Some(path) => depth(path, scale, &rgb)?,
            None => a_fifth(&gt, frame_seed(self.seed, index))?,
        };
        let sparse = remove_outliers(&chosen, WINDOW, THRESHOLD)?;
        Ok(Sample {
            name: frame.name.clone(),
            rgb,
            gt: gt.as_slice().to_vec(),
            sparse: Some(sparse),
            masks: Vec::new(),
        })
    }
}

fn a_fifth(gt: &SparseDepth, seed: u64) -> Result<SparseDepth> {
    if gt.measured() == 0 {
        return Ok(gt.clone());
    }
    sample_points(gt.as_slice(), gt.width(), gt.height(), gt.measured().div_ceil(5), seed)
}
