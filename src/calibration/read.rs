//! A calibration of any kind, by the ending of the file's name.

use std::path::Path;

use super::types::{Calibration, CalibrationOptions};
use super::{kitti, ros};
use crate::error::Result;
use crate::files::{extension, unknown_extension};

impl Calibration {
    /// Reads a file.
    ///
    /// | ending | what is read |
    /// |---|---|
    /// | `.yaml`, `.yml` | ROS: what `camera_calibration` writes (`camera_matrix`, `distortion_coefficients`, ..) or a printed `CameraInfo` (`k`, `d`, `r`, `p`) |
    /// | `.txt` | KITTI: odometry's `calib.txt` (`P0` to `P3`, `Tr`), the object benchmark's (`R0_rect`, `Tr_velo_to_cam`), and the raw data's `calib_cam_to_cam.txt` with the `calib_velo_to_cam.txt` beside it |
    ///
    /// For raw pictures ROS's camera matrix and distortion are taken, for rectified ones the projection matrix without
    /// distortion. KITTI's cameras are all rectified; the transform leads to the camera that was asked for, its offset from camera 0
    /// included.
    ///
    /// # Errors
    /// [`crate::Error::Io`]; [`crate::Error::Config`] for a key that is missing or has another form, which it names with what was expected, and
    /// for a size that is not the picture's; [`crate::Error::Format`] for text of another kind and an unknown ending;
    /// [`crate::Error::Argument`] for a KITTI file without the number of a camera, and for numbers that no camera or motion has.
    pub fn read(path: impl AsRef<Path>, options: &CalibrationOptions) -> Result<Self> {
        let path = path.as_ref();
        match extension(path).as_str() {
            "yaml" | "yml" => ros::read(path, options),
            "txt" => kitti::read(path, options),
            other => Err(unknown_extension(path, other, "yaml or yml (ROS), or txt (KITTI)")),
        }
    }
}
