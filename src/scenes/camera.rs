//! Where the camera of a scene stands.

use super::space::{Rot, V3, add, mul, sub, to_local, turned};
use crate::depth::Intrinsics;

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
