//! Hypersim (Roberts et al., ICCV 2021): rendered rooms.

use std::path::{Path, PathBuf};

use super::dataset::Sample;
use super::files::{entries, frame_name, list, list_some, picture, recordings, same_size, take, unpaired};
use super::hdf5::Numbers;
use super::listing::{Frame, Loader};
use crate::depth::pixels::is_valid;
use crate::error::{Error, Result};

/// Focal length in pixels of a picture of [`WIDTH`] columns: a field of view of 60 degrees, square pixels, the principal point at the centre.
const FOCAL: f64 = 886.81;
const WIDTH: f64 = 1024.0;

#[derive(Clone, Debug)]
pub(super) struct Files {
    rgb: PathBuf,
    distance: PathBuf,
}

/// One scene, or a folder of scenes (`ai_001_001`, ..), each with its folder `images` as published.
///
/// Frames are the files `frame.NUMBER.depth_meters.hdf5` of the folders `scene_cam_NN_geometry_hdf5`; the picture is the authors' tone-mapped
/// preview, `frame.NUMBER.tonemap.jpg` (else `frame.NUMBER.color.jpg`) in `scene_cam_NN_final_preview`. The HDF5 files hold in `dataset` the
/// distance to the optical centre in metres, 1024 x 768, NaN where the ray leaves the scene. It becomes Z as the authors say for their
/// cameras (github.com/apple/ml-hypersim, issue 9): `Z = d f / |(x, y, f)|` with f = 886.81 pixels and x, y from the centre
/// of the picture. Copies in another size have the same field of view. Neither cropped nor resized; no measurements of its own.
#[derive(Clone, Debug)]
pub struct HypersimDataset {
    frames: Vec<Frame<Files>>,
}

impl HypersimDataset {
    /// Lists the frames of all cameras.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Format`] naming the distances that lack a picture, or the folder without a frame.
    pub fn open(dir: impl AsRef<Path>) -> Result<Self> {
        let mut frames = Vec::new();
        for (scene, dir) in recordings(dir.as_ref(), ["images", "images"])? {
            let images = dir.join("images");
            let before = frames.len();
            for camera in cameras(&images)? {
                let name = frame_name(&scene, camera.strip_prefix("scene_").unwrap_or(&camera));
                let mut previews = list(&images.join(format!("{camera}_final_preview")), &["jpg"])?;
                for (file, distance) in list_some(&images.join(format!("{camera}_geometry_hdf5")), &["hdf5"])?
                {
                    let Some(frame) = file.strip_suffix(".depth_meters") else { continue };
                    let kinds = ["tonemap", "color"];
                    let rgb = kinds.iter().find_map(|kind| take(&mut previews, &format!("{frame}.{kind}")));
                    let rgb = rgb.ok_or_else(|| {
                        unpaired(&distance, "picture", format!("{camera}_final_preview/{frame}.tonemap.jpg"))
                    })?;
                    let number = frame.strip_prefix("frame.").unwrap_or(frame);
                    frames.push(Frame { name: frame_name(&name, number), files: Files { rgb, distance } });
                }
            }
            if frames.len() == before {
                let expected = "scene_cam_NN_geometry_hdf5/frame.NUMBER.depth_meters.hdf5";
                return Err(Error::format(images, "no frame", expected));
            }
        }
        Ok(Self { frames })
    }
}

/// Names of the cameras of a scene, `scene_cam_00` and so on, those with distances.
fn cameras(images: &Path) -> Result<Vec<String>> {
    let camera = |(name, _): (String, PathBuf)| name.strip_suffix("_geometry_hdf5").map(str::to_string);
    Ok(entries(images)?.into_iter().filter_map(camera).collect())
}

impl Loader for HypersimDataset {
    type Files = Files;

    fn frames(&self) -> &[Frame<Files>] {
        &self.frames
    }

    fn read(&self, frame: &Frame<Files>, _: usize) -> Result<Sample> {
        let Files { rgb, distance } = &frame.files;
        let rgb = picture(rgb)?;
        let file = Numbers::open(distance)?;
        let &[height, width] = &file.shape("dataset")?[..] else {
            return Err(file.wrong("dataset", "other than rows and columns".into()));
        };
        same_size(distance, (width, height), &rgb)?;
        let gt = planar(&file.floats("dataset", None)?, width, height);
        Ok(Sample { name: frame.name.clone(), rgb, gt, sparse: None, masks: Vec::new() })
    }
}

/// Distances along the rays to Z.
fn planar(distances: &[f32], width: usize, height: usize) -> Vec<f32> {
    let focal = FOCAL * width as f64 / WIDTH;
    let from_centre = |at: usize, size: usize| at as f64 + 0.5 - 0.5 * size as f64;
    let z = |(i, &d): (usize, &f32)| {
        let (x, y) = (from_centre(i % width, width), from_centre(i / width, height));
        let z = f64::from(d) * focal / (x * x + y * y + focal * focal).sqrt();
        if is_valid(d) { z as f32 } else { f32::NAN }
    };
    distances.iter().enumerate().map(z).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wall_is_as_far_at_its_edges_as_in_its_middle() {
        // Distances to a wall at 3 m, by the field of view of 60 degrees.
        for (width, height) in [(1024, 768), (64, 48)] {
            let half = (30f64).to_radians().tan();
            let ray = |i: usize| {
                let x = ((i % width) as f64 + 0.5) / width as f64 * 2.0 - 1.0;
                let y =
                    (((i / width) as f64 + 0.5) / height as f64 * 2.0 - 1.0) * height as f64 / width as f64;
                3.0 * (1.0 + (x * half).powi(2) + (y * half).powi(2)).sqrt()
            };
            let distances: Vec<f32> = (0..width * height).map(|i| ray(i) as f32).collect();
            assert!(distances[0] > 3.6);
            assert!(planar(&distances, width, height).iter().all(|z| (z - 3.0).abs() < 1e-4));
        }
        assert!(planar(&[f32::NAN, 0.0, f32::INFINITY, -1.0], 2, 2).iter().all(|z| z.is_nan()));
    }
}
