//! Calibrations of cameras, and where a LiDAR stands: from the files of ROS and KITTI.

mod extrinsic;
mod kitti;
mod numbers;
mod read;
mod ros;
mod types;
mod yaml;

pub use extrinsic::read_extrinsic;
pub use types::{Calibration, CalibrationOptions};
