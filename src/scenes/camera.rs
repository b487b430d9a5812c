//! A pinhole camera without distortion.

use super::space::{Rot, V3, add, mul, sub, to_local, turned};

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

/// Intrinsics and pose.
#[derive(Clone, Debug)]
pub(super) struct Camera {
    pub k: Intrinsics,
    pub at: V3,
    /// Rows: right, down, forward.
    pub axes: Rot,
}

impl Camera {
    /// Radians; a positive pitch looks up.
    pub fn new(k: Intrinsics, at: V3, yaw: f32, pitch: f32, roll: f32) -> Self {
        let [right, up, forward] = turned(yaw, pitch, roll);
        Self { k, at, axes: [right, mul(up, -1.0), forward] }
    }

    /// World direction of a pixel, scaled so that one unit along it is one metre of Z-depth: a hit at parameter `t` has
    /// Z-depth `t` exactly.
    #[inline(always)]
    pub fn ray(&self, x: f32, y: f32) -> V3 {
        let (u, v) = ((x - self.k.cx) / self.k.fx, (y - self.k.cy) / self.k.fy);
        add(add(mul(self.axes[0], u), mul(self.axes[1], v)), self.axes[2])
    }

    /// A world point in camera axes (x right, y down, z forward).
    #[inline(always)]
    pub fn view(&self, p: V3) -> V3 {
        to_local(&self.axes, sub(p, self.at))
    }
}
