//! Virtual KITTI 2 (Cabon, Murray, Humenberger, 2020): rendered streets.

use std::path::{Path, PathBuf};

use super::dataset::Sample;
use super::files::{
    PICTURES, all_taken, entries, frame_name, list, list_some, naming, picture, same_size, take, unpaired,
};
use super::listing::{Frame, Loader};
use crate::depth::io::png16;
use crate::error::{Error, Result};

/// Metres of the number 1 in a depth file.
const CENTIMETRE: f32 = 0.01;
/// The far plane, 655.35 m: the sky, and whatever else is as far or farther.
const FAR: u16 = u16::MAX;

#[derive(Clone, Debug)]
pub(super) struct Files {
    rgb: PathBuf,
    gt: PathBuf,
}

/// The scenes (`Scene01`, ..) with their variations (`clone`, `fog`, `15-deg-left`, ..) as published: pictures of 1242 x 375 pixels in
/// `SCENE/VARIATION/frames/rgb/CAMERA/rgb_NUMBER.jpg`, depth in `SCENE/VARIATION/frames/depth/CAMERA/depth_NUMBER.png`.
///
/// Both archives unpack into one folder of scenes; folders `vkitti_2.0.3_rgb` and `vkitti_2.0.3_depth` beside each other are read, too. Depth is
/// Z in 16 bits, in centimetres, up to 655.34 m; 65535 is the far plane, at which nothing is measured, and 0 is none. Neither cropped nor
/// resized; no measurements of its own.
#[derive(Clone, Debug)]
pub struct VirtualKittiDataset {
    frames: Vec<Frame<Files>>,
}

impl VirtualKittiDataset {
    /// Lists the frames of all scenes, variations and cameras.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Format`] naming the file that lacks a partner, or the folder without a scene.
    pub fn open(dir: impl AsRef<Path>) -> Result<Self> {
        let dir = dir.as_ref();
        let apart = [dir.join("vkitti_2.0.3_rgb"), dir.join("vkitti_2.0.3_depth")];
        let [pictures, depths] =
            if apart.iter().all(|d| d.is_dir()) { apart } else { [dir; 2].map(PathBuf::from) };
        let mut frames = Vec::new();
        for scene in folders(&pictures)? {
            for variation in folders(&pictures.join(&scene))? {
                let place = Path::new(&scene).join(&variation).join("frames");
                let shown = pictures.join(&place).join("rgb");
                if shown.is_dir() {
                    for camera in folders(&shown)? {
                        let name = [&scene, &variation, &camera].map(String::as_str).join("-");
                        let gt = depths.join(&place).join("depth").join(&camera);
                        frames.extend(camera_frames(&name, &shown.join(&camera), &gt)?);
                    }
                }
            }
        }
        if frames.is_empty() {
            return Err(Error::format(dir, "no frame", "SCENE/VARIATION/frames/rgb/CAMERA/rgb_NUMBER.jpg"));
        }
        Ok(Self { frames })
    }
}

/// Frames of one camera in order of their numbers.
fn camera_frames(name: &str, shown: &Path, gt: &Path) -> Result<Vec<Frame<Files>>> {
    let mut truths = list(gt, &["png"])?;
    let mut frames = Vec::new();
    for (file, rgb) in list_some(shown, &PICTURES)? {
        let number = file.strip_prefix("rgb_").unwrap_or(&file);
        let gt = take(&mut truths, &format!("depth_{number}"));
        let gt = gt.ok_or_else(|| unpaired(&rgb, "depth", format!("depth_{number}.png")))?;
        frames.push(Frame { name: frame_name(name, number), files: Files { rgb, gt } });
    }
    all_taken(truths, |name| format!("{}.jpg", name.replacen("depth", "rgb", 1)))?;
    Ok(frames)
}

/// Names of the folders in a folder, sorted.
fn folders(dir: &Path) -> Result<Vec<String>> {
    let inside = entries(dir)?.into_iter().filter(|(_, path)| path.is_dir());
    Ok(inside.map(|(name, _)| name).collect())
}

impl Loader for VirtualKittiDataset {
    type Files = Files;

    fn frames(&self) -> &[Frame<Files>] {
        &self.frames
    }

    fn read(&self, frame: &Frame<Files>, _: usize) -> Result<Sample> {
        let Files { rgb, gt } = &frame.files;
        let rgb = picture(rgb)?;
        let (width, height, stored) = png16::read_png16(gt).map_err(|e| naming(gt, e))?;
        same_size(gt, (width, height), &rgb)?;
        let metres = |&v: &u16| if v == 0 || v == FAR { f32::NAN } else { f32::from(v) * CENTIMETRE };
        let gt = stored.iter().map(metres).collect();
        Ok(Sample { name: frame.name.clone(), rgb, gt, sparse: None, masks: Vec::new() })
    }
}
