//! What a calibration says, and for which picture it is read.

use crate::depth::{Camera, Transform};

/// What a file says of the camera that took a picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Calibration {
    /// The camera, for pictures of the size that was asked for.
    pub camera: Camera,
    /// From the axes of the LiDAR to those of this camera (x right, y down, z forward), where the file says so.
    pub lidar_to_camera: Option<Transform>,
}

/// Which picture a calibration is read for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CalibrationOptions {
    pub(super) size: (usize, usize),
    pub(super) camera: Option<usize>,
    pub(super) rectified: bool,
}

impl CalibrationOptions {
    /// For pictures of this width and height, as the camera gives them.
    pub fn new(width: usize, height: usize) -> Self {
        Self { size: (width, height), camera: None, rectified: false }
    }

    /// The number of the camera in a file of several: 0 to 3 in KITTI's.
    pub fn with_camera(mut self, number: usize) -> Self {
        self.camera = Some(number);
        self
    }

    /// For pictures that were rectified by that calibration (ROS's `image_rect`) instead of raw ones. KITTI's are, always.
    pub fn with_rectified(mut self, rectified: bool) -> Self {
        self.rectified = rectified;
        self
    }
}
