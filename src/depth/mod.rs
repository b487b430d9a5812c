//! Depth maps in memory and on disk: sparse measurements, dense results, file formats, colours, interpolation, errors.
//!
//! Everywhere in this module depth is Z-depth (along the optical axis) in metres, `f32`, row-major, `width * height`
//! values; x grows to the right, y grows downwards; a missing value is NaN in memory and 0 in integer files.

pub mod baselines;
pub mod colour;
pub mod figure;
pub mod interpolate;
mod label;
mod map;
pub(crate) mod mesh;
pub mod metrics;
pub mod npy;
pub mod outliers;
pub mod png16;
pub mod preview;
mod scale;
mod sparse;

pub use map::{DepthMap, Saturation};
pub use scale::DepthScale;
pub use sparse::SparseDepth;

use crate::error::{Error, Result};
use ndarray::ArrayView2;

/// `width * height`, refusing empty images and products that overflow.
pub(crate) fn pixel_count(width: usize, height: usize) -> Result<usize> {
    let reason = match width.checked_mul(height) {
        Some(0) => "expected a width and height of at least 1 pixel",
        Some(n) if n <= MAX_PIXELS => return Ok(n),
        _ => "expected at most 2^28 pixels",
    };
    Err(Error::ImageSize { width, height, reason: reason.to_string() })
}

/// Largest image accepted: 1 GiB of f32, far above any camera, far below what an attacker's header may claim.
pub(crate) const MAX_PIXELS: usize = 1 << 28;

/// Whether a pixel or one of the eight around it has no depth.
pub(crate) fn faces_a_hole(depth: &[f32], width: usize, height: usize, x: usize, y: usize) -> bool {
    let columns = x.saturating_sub(1)..(x + 2).min(width);
    let mut rows = y.saturating_sub(1)..(y + 2).min(height);
    rows.any(|row| depth[row * width..][columns.clone()].iter().any(|d| d.is_nan()))
}

/// Fails unless a buffer holds exactly one value per pixel.
pub(crate) fn check_length(what: &'static str, found: usize, expected: usize) -> Result<()> {
    if found == expected { Ok(()) } else { Err(Error::BufferLength { what, expected, found }) }
}

/// Whether a number is a usable depth: finite and above zero.
pub(crate) fn is_valid(depth: f32) -> bool {
    depth.is_finite() && depth > 0.0
}

/// A row-major buffer as (rows, columns); the callers' constructors guarantee the length.
fn view2<T>(data: &[T], width: usize, height: usize) -> ArrayView2<'_, T> {
    ArrayView2::from_shape((height, width), data).unwrap_or_else(|_| ndarray::aview2::<T, 0>(&[]))
}
