//! Structs shaped like ROS's `sensor_msgs`: pictures, calibrations and clouds, in and out, without ROS.
//!
//! Fields have the names, types and meanings of the message definitions (`sensor_msgs/msg/*.msg`, the same in ROS 1 and 2), but for the header,
//! which has nothing that completion needs. So a program copies the fields of the messages of its own ROS client, and moves the data.
//!
//! ```
//! use sdim::depth::{Transform, Visibility};
//! use sdim::messages::{CameraInfo, Image, PointCloud2, PointField};
//! use sdim::SparseDepth;
//!
//! let picture = Image {
//!     height: 2, width: 4, encoding: "bgr8".into(), is_bigendian: 0, step: 12, data: vec![90; 24],
//! };
//! let info = CameraInfo {
//!     height: 2, width: 4, distortion_model: "plumb_bob".into(), d: vec![0.0; 5],
//!     k: [3.0, 0.0, 1.5, 0.0, 3.0, 0.5, 0.0, 0.0, 1.0],
//!     ..CameraInfo::default()
//! };
//! let cloud = PointCloud2 {
//!     height: 1, width: 1, is_bigendian: false, point_step: 12, row_step: 12, is_dense: true,
//!     fields: ["x", "y", "z"].iter().zip([0, 4, 8]).map(|(n, o)| PointField::float32(n, o)).collect(),
//!     data: [0.5f32, 0.0, 3.0].iter().flat_map(|c| c.to_le_bytes()).collect(),
//! };
//! let rgb = picture.to_rgb()?;
//! let lidar_to_camera = Transform::identity(); // from tf: target the camera's optical frame, source the cloud's
//! let (sparse, report) =
//!     SparseDepth::from_cloud(cloud.points()?, &info.to_camera()?, &lidar_to_camera, &Visibility::default())?;
//! assert_eq!((rgb.dimensions(), sparse.get(2, 1), report.measured), ((4, 2), Some(3.0), 1));
//! # Ok::<(), sdim::Error>(())
//! ```

mod camera_info;
mod cloud;
mod picture;

pub use camera_info::{CameraInfo, RegionOfInterest};
pub use cloud::{PointCloud2, PointField};
pub use picture::Image;
