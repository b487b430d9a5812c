//! Options for point clouds and calibrations.

use anyhow::{Context, ensure};
use sdim::calibration::{Calibration, CalibrationOptions, read_extrinsic};
use sdim::cloud::{CloudOptions, PointCloud};
use sdim::depth::{Camera, Distortion, Intrinsics, Transform, Visibility, normals};
use sdim::draw::colour::normals_to_rgb;
use sdim::{DepthMap, RgbImage, SparseDepth};
use std::path::{Path, PathBuf};
use std::str::FromStr;

#[derive(clap::Args)]
pub struct SensorArgs {
    /// Point cloud as measurements, instead of --sparse: .pcd, .ply or KITTI's .bin. Needs a camera and, unless --calib has it, --extrinsic.
    #[arg(long, group = "measurements", requires = "rgb")]
    cloud: Option<PathBuf>,
    /// The camera's calibration: ROS's camera_info (.yaml) or KITTI's calib (.txt).
    #[arg(long, conflicts_with = "intrinsics")]
    calib: Option<PathBuf>,
    /// Number of the camera in a KITTI calibration.
    #[arg(long, value_name = "N", requires = "calib")]
    camera: Option<usize>,
    /// The picture was rectified by the calibration (ROS's image_rect).
    #[arg(long, requires = "calib")]
    rectified: bool,
    /// A camera without distortion, pixels; instead of --calib.
    #[arg(long, value_name = "FX,FY,CX,CY")]
    intrinsics: Option<Pinhole>,
    /// From the cloud's axes to the camera's (x right, y down, z forward), metres: a text file or .npy with a 4x4 matrix, KITTI's
    /// calib_velo_to_cam.txt, or `identity` for a cloud in the camera's axes. Without it, the LiDAR's place in --calib.
    #[arg(long, value_name = "FILE", requires = "cloud")]
    extrinsic: Option<PathBuf>,
    /// Writes the completed map as points with colours, normals and confidence: .ply or .pcd. Needs a camera.
    #[arg(long, value_name = "FILE")]
    cloud_out: Option<PathBuf>,
    /// Leaves pixels with a lower confidence (0 to 1) out of --cloud-out.
    #[arg(long, value_name = "SHARE", requires = "cloud_out", default_value_t = 0.0)]
    min_confidence: f32,
    /// Leaves pixels with a larger expected error out of --cloud-out, metres.
    #[arg(long, value_name = "M", requires = "cloud_out")]
    max_error: Option<f32>,
}

/// Half of the side of the windows of normals, pixels.
const RADIUS: usize = 4;

impl SensorArgs {
    /// The camera that the options tell, for a picture; `None` without any. Options that could only fail at the end fail here.
    pub fn calibration(&self, rgb: &RgbImage) -> anyhow::Result<Option<Calibration>> {
        let size = (rgb.width() as usize, rgb.height() as usize);
        let calibration = match (&self.calib, self.intrinsics) {
            (Some(path), _) => {
                let mut options = CalibrationOptions::new(size.0, size.1).with_rectified(self.rectified);
                if let Some(number) = self.camera {
                    options = options.with_camera(number);
                }
                Some(Calibration::read(path, &options)?)
            }
            (None, Some(Pinhole(intrinsics))) => {
                let camera = Camera::new(size.0, size.1, intrinsics, Distortion::None)?;
                Some(Calibration { camera, lidar_to_camera: None })
            }
            (None, None) => None,
        };
        if let Some(out) = &self.cloud_out {
            ensure!(calibration.is_some(), "--cloud-out needs a camera: --calib or --intrinsics");
            let ending = out.extension().and_then(|e| e.to_str()).unwrap_or("").to_ascii_lowercase();
            ensure!(matches!(ending.as_str(), "ply" | "pcd"), "{}: expected .ply or .pcd", out.display());
            ensure!((0.0..=1.0).contains(&self.min_confidence), "--min-confidence: expected 0 to 1");
            ensure!(self.max_error.is_none_or(|e| e >= 0.0), "--max-error: expected at least 0 m");
        }
        Ok(calibration)
    }

    /// The measurements of the cloud, as the camera sees them.
    pub fn sparse(&self, calibration: Option<&Calibration>) -> anyhow::Result<SparseDepth> {
        let path = self.cloud.as_deref().context("expected --sparse or --cloud")?;
        let calibration = calibration.context("--cloud needs a camera: --calib or --intrinsics")?;
        let to_camera = match (&self.extrinsic, calibration.lidar_to_camera) {
            (Some(word), _) if word.as_os_str() == "identity" => Transform::identity(),
            (Some(file), _) => read_extrinsic(file)?,
            (None, Some(known)) => known,
            (None, None) => anyhow::bail!(
                "where the cloud was taken is not known: expected --extrinsic FILE, or --extrinsic identity for a cloud in the camera's axes"
            ),
        };
        let cloud = PointCloud::read(path)?;
        let seen =
            SparseDepth::from_cloud(cloud.points, &calibration.camera, &to_camera, &Visibility::default());
        let (sparse, report) = seen.with_context(|| path.display().to_string())?;
        ensure!(
            sparse.measured() > 0,
            "{}: {report}; expected a cloud in view, and the transform from its axes to \
             the camera's (x right, y down, z forward)",
            path.display()
        );
        Ok(sparse)
    }

    /// Writes the points of the map, and a picture of its normals beside the other results.
    pub fn write(&self, map: &DepthMap, rgb: &RgbImage, camera: &Camera, dir: &Path) -> anyhow::Result<()> {
        let picture = normals_to_rgb(&normals(map, camera, RADIUS)?, map.width(), map.height())?;
        let path = dir.join("normals.png");
        picture.save(&path).with_context(|| path.display().to_string())?;
        let Some(out) = &self.cloud_out else { return Ok(()) };
        let mut options =
            CloudOptions::default().with_min_confidence(self.min_confidence).with_normals(RADIUS);
        if let Some(metres) = self.max_error {
            options = options.with_max_expected_error(metres);
        }
        PointCloud::from_map(map, Some(rgb), camera, &options)?.write(out)?;
        Ok(())
    }
}

/// Four numbers between commas.
#[derive(Clone, Copy)]
struct Pinhole(Intrinsics);

impl FromStr for Pinhole {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let numbers: Vec<f32> = text.split(',').filter_map(|n| n.trim().parse().ok()).collect();
        match (&numbers[..], text.split(',').count()) {
            (&[fx, fy, cx, cy], 4) => Ok(Self(Intrinsics { fx, fy, cx, cy })),
            _ => Err("expected four numbers: fx,fy,cx,cy in pixels".to_string()),
        }
    }
}
