//! KITTI depth completion (Uhrig et al., 3DV 2017): the official selection of 1000 validation frames.

use std::path::{Path, PathBuf};

use super::dataset::Sample;
use super::files::{all_taken, depth, first_with, list, list_some, picture, take, unpaired};
use super::listing::{Frame, Loader};
use super::outliers::{THRESHOLD, WINDOW, remove_outliers};
use crate::depth::DepthScale;
use crate::error::Result;

#[derive(Clone, Debug)]
pub(super) struct Files {
    rgb: PathBuf,
    gt: PathBuf,
    sparse: PathBuf,
}

/// The official `val_selection_cropped`: 1000 frames of 1216 x 352 pixels.
///
/// Read from `image/DRIVE_image_FRAME_CAMERA.png`, `velodyne_raw/DRIVE_velodyne_raw_FRAME_CAMERA.png` and
/// `groundtruth_depth/DRIVE_groundtruth_depth_FRAME_CAMERA.png`; depth in 16 bits, 256 units per metre, 0 = none (the
/// benchmark's development kit). Neither resized nor cropped. The scanner's points go through [`remove_outliers`]; the ground
/// truth, cleaned by its makers, does not. Its nearest and farthest values all count, as in Marigold-DC.
#[derive(Clone, Debug)]
pub struct KittiDataset {
    frames: Vec<Frame<Files>>,
}

impl KittiDataset {
    /// Lists `val_selection_cropped`, or a folder that holds it as the official archive does.
    ///
    /// # Errors
    /// [`crate::Error::Io`]; [`crate::Error::Format`] naming the file that lacks a partner.
    pub fn open(dir: impl AsRef<Path>) -> Result<Self> {
        let places = ["", "val_selection_cropped", "depth_selection/val_selection_cropped"];
        let dir = first_with(dir.as_ref(), &places, "image")?;
        let mut truths = list(&dir.join("groundtruth_depth"), &["png"])?;
        let mut measured = list(&dir.join("velodyne_raw"), &["png"])?;
        let mut frames = Vec::new();
        for (name, rgb) in list_some(&dir.join("image"), &["png"])? {
            let partner = |files: &mut _, kind: &str| {
                let partner = name.replacen("_image_", &format!("_{kind}_"), 1);
                take(files, &partner).ok_or_else(|| unpaired(&rgb, kind, format!("{kind}/{partner}.png")))
            };
            let gt = partner(&mut truths, "groundtruth_depth")?;
            let sparse = partner(&mut measured, "velodyne_raw")?;
            frames.push(Frame { name, files: Files { rgb, gt, sparse } });
        }
        all_taken(truths, |n| format!("image/{}.png", n.replacen("_groundtruth_depth_", "_image_", 1)))?;
        all_taken(measured, |n| format!("image/{}.png", n.replacen("_velodyne_raw_", "_image_", 1)))?;
        Ok(Self { frames })
    }
}

impl Loader for KittiDataset {
    type Files = Files;

    fn frames(&self) -> &[Frame<Files>] {
        &self.frames
    }

    fn brings_measurements(&self, _: &Files) -> bool {
        true
    }

    fn read(&self, frame: &Frame<Files>, _: usize) -> Result<Sample> {
        let Files { rgb, gt, sparse } = &frame.files;
        let scale = Some(DepthScale::kitti());
        let rgb = picture(rgb)?;
        let gt = depth(gt, scale, &rgb)?.as_slice().to_vec();
        let measured = remove_outliers(&depth(sparse, scale, &rgb)?, WINDOW, THRESHOLD)?;
        Ok(Sample { name: frame.name.clone(), rgb, gt, sparse: Some(measured), masks: Vec::new() })
    }
}
