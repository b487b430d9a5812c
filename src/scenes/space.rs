//! Three-vectors and rotations, as plain arrays.
//!
//! World axes: x right, y up, z forward (metres). A rotation is stored as the rows of the world-to-local matrix, so
//! that row `k` is the local axis `k` in world coordinates.

pub(super) type V3 = [f32; 3];
pub(super) type Rot = [V3; 3];

pub(super) const UPRIGHT: Rot = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

#[inline(always)]
pub(super) fn add(a: V3, b: V3) -> V3 {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

#[inline(always)]
pub(super) fn sub(a: V3, b: V3) -> V3 {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

#[inline(always)]
pub(super) fn mul(a: V3, s: f32) -> V3 {
    [a[0] * s, a[1] * s, a[2] * s]
}

#[inline(always)]
pub(super) fn times(a: V3, b: V3) -> V3 {
    [a[0] * b[0], a[1] * b[1], a[2] * b[2]]
}

#[inline(always)]
pub(super) fn over(a: V3, b: V3) -> V3 {
    [a[0] / b[0], a[1] / b[1], a[2] / b[2]]
}

#[inline(always)]
pub(super) fn dot(a: V3, b: V3) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
pub(super) fn norm(a: V3) -> f32 {
    dot(a, a).sqrt()
}

#[inline(always)]
pub(super) fn unit(a: V3) -> V3 {
    mul(a, 1.0 / norm(a).max(1e-20))
}

#[inline(always)]
pub(super) fn mix(a: V3, b: V3, t: f32) -> V3 {
    [a[0] + (b[0] - a[0]) * t, a[1] + (b[1] - a[1]) * t, a[2] + (b[2] - a[2]) * t]
}

/// World vector to local axes.
#[inline(always)]
pub(super) fn to_local(r: &Rot, v: V3) -> V3 {
    [dot(r[0], v), dot(r[1], v), dot(r[2], v)]
}

/// Local vector to world axes.
#[inline(always)]
pub(super) fn to_world(r: &Rot, v: V3) -> V3 {
    add(add(mul(r[0], v[0]), mul(r[1], v[1])), mul(r[2], v[2]))
}

/// A rotation given inside another frame, expressed in the world.
pub(super) fn compose(child: &Rot, parent: &Rot) -> Rot {
    [to_world(parent, child[0]), to_world(parent, child[1]), to_world(parent, child[2])]
}

/// Right, up and forward axes for a heading (yaw about y), a pitch (positive looks up) and a roll, radians.
pub(super) fn turned(yaw: f32, pitch: f32, roll: f32) -> Rot {
    let ((sy, cy), (sp, cp), (sr, cr)) = (yaw.sin_cos(), pitch.sin_cos(), roll.sin_cos());
    let forward = [sy * cp, sp, cy * cp];
    let right = [cy, 0.0, -sy];
    let up = [-sy * sp, cp, -cy * sp];
    [add(mul(right, cr), mul(up, sr)), sub(mul(up, cr), mul(right, sr)), forward]
}
