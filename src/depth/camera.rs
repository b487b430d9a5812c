//! A pinhole camera without distortion.

/// Pinhole intrinsics, pixels.
///
/// Pixel `(x, y)` looks along `((x - cx) / fx, (y - cy) / fy, 1)`, with x to the right, y down and integer coordinates
/// at pixel centres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsics {
    /// Focal length along x.
    pub fx: f32,
    /// Focal length along y.
    pub fy: f32,
    /// Column of the principal point.
    pub cx: f32,
    /// Row of the principal point.
    pub cy: f32,
}

impl Intrinsics {
    /// Square pixels and a centred principal point for a horizontal field of view in radians.
    pub fn from_fov(width: usize, height: usize, horizontal: f32) -> Self {
        let f = 0.5 * width as f32 / (0.5 * horizontal).tan();
        Self { fx: f, fy: f, cx: 0.5 * (width as f32 - 1.0), cy: 0.5 * (height as f32 - 1.0) }
    }
}
