//! Point clouds: from files (PCD, PLY, KITTI's `.bin`), from a completed map, and to files.

mod columns;
mod files;
mod from_map;
mod pcd;
mod ply;
mod points;
mod velodyne;

pub use from_map::CloudOptions;
pub use points::PointCloud;
