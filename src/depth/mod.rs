//! Depth in memory and on disk: sparse measurements, dense maps, cameras, files, interpolation, normals.
//!
//! Everywhere in this module depth is Z-depth (along the optical axis) in metres, `f32`, row-major, `width * height`
//! values; x grows to the right, y grows downwards; a missing value is NaN in memory and 0 in integer files.

mod camera;
mod cloud;
mod hidden;
pub mod interpolate;
pub mod io;
mod map;
mod normals;
pub mod outliers;
pub(crate) mod pixels;
pub(crate) mod sampling;
mod scale;
mod sparse;

pub use camera::{Camera, Distortion, Intrinsics, Transform};
pub use cloud::ProjectionReport;
pub use hidden::Visibility;
pub use map::{DepthMap, DepthParts, Saturation};
pub use normals::normals;
pub use sampling::{SparsePattern, sample_points};
pub use scale::DepthScale;
pub use sparse::SparseDepth;
