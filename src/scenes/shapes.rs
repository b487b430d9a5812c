//! Solid primitives and exact ray intersections.
//!
//! Every solid lives in a unit frame (its bounding box is [-1, 1]^3) reached by a rotation and a scale per axis. The ray
//! parameter survives that affine change, so intersections are solved in the unit frame and need no conversion back.

use super::space::{Rot, V3, dot, over, sub, to_local, to_world, unit};

/// Hits nearer than this are ignored, so that a ray may start on a surface.
pub(super) const NEAR: f32 = 1e-3;

#[derive(Clone, Copy, Debug)]
pub(super) enum Kind {
    Cuboid,
    Ellipsoid,
    /// Axis y, radius 1 at y = -1 and `top` at y = +1, closed by discs.
    Frustum {
        top: f32,
    },
    /// The cuboid's part where `dot(normal, p) <= offset`.
    Cut {
        normal: V3,
        offset: f32,
    },
}

#[derive(Clone, Debug)]
pub(super) struct Solid {
    pub kind: Kind,
    pub centre: V3,
    pub half: V3,
    pub axes: Rot,
    pub material: u16,
}

impl Solid {
    /// World direction or offset from the centre, in the unit frame.
    #[inline(always)]
    pub fn to_unit(&self, v: V3) -> V3 {
        over(to_local(&self.axes, v), self.half)
    }

    /// Outward unit normal in world axes at a point of the surface, given in the unit frame.
    pub fn normal(&self, p: V3) -> V3 {
        let n = match self.kind {
            Kind::Cuboid => face(p).0,
            Kind::Ellipsoid => p,
            Kind::Frustum { top } => frustum_normal(p, top),
            Kind::Cut { normal, offset } => {
                let (n, gap) = face(p);
                let to_cut = (dot(normal, p) - offset).abs() / dot(normal, normal).sqrt();
                if to_cut < gap { normal } else { n }
            }
        };
        unit(to_world(&self.axes, over(n, self.half)))
    }
}

/// The cuboid face nearest to a surface point, and the distance to its plane.
#[inline(always)]
fn face(p: V3) -> (V3, f32) {
    let a = [p[0].abs(), p[1].abs(), p[2].abs()];
    let k = if a[0] >= a[1] && a[0] >= a[2] {
        0
    } else if a[1] >= a[2] {
        1
    } else {
        2
    };
    let mut n = [0.0; 3];
    n[k] = p[k].signum();
    (n, (1.0 - a[k]).abs())
}

fn frustum_normal(p: V3, top: f32) -> V3 {
    let (a, b) = (0.5 * (1.0 + top), 0.5 * (top - 1.0));
    let side = (p[0] * p[0] + p[2] * p[2]).sqrt();
    let radius = a + b * p[1];
    if (1.0 - p[1].abs()).abs() < (side - radius).abs() {
        [0.0, p[1].signum(), 0.0]
    } else {
        [p[0], -b * radius, p[2]]
    }
}

/// `f32::min` and `max` spend instructions on NaN; these map to one each.
#[inline(always)]
fn smaller(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

#[inline(always)]
fn larger(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// Entry and exit of a ray through [-1, 1]^3; axis-parallel rays come as infinities.
#[inline(always)]
fn slabs(o: V3, d: V3) -> (f32, f32) {
    let (mut t0, mut t1) = (f32::NEG_INFINITY, f32::INFINITY);
    for k in 0..3 {
        let inv = 1.0 / d[k];
        let (a, b) = ((-1.0 - o[k]) * inv, (1.0 - o[k]) * inv);
        t0 = larger(t0, smaller(a, b));
        t1 = smaller(t1, larger(a, b));
    }
    (t0, t1)
}

/// Nearest hit in front of the ray's origin; a ray that starts inside the solid does not see it (infinity = no hit).
#[inline(always)]
pub(super) fn hit_cuboid(o: V3, d: V3) -> f32 {
    let (t0, t1) = slabs(o, d);
    if (t0 <= t1) & (t0 > NEAR) { t0 } else { f32::INFINITY }
}

#[inline(always)]
pub(super) fn hit_cut(o: V3, d: V3, normal: V3, offset: f32) -> f32 {
    let (mut t0, mut t1) = slabs(o, d);
    let (gap, speed) = (offset - dot(normal, o), dot(normal, d));
    let t = gap / speed;
    if speed < 0.0 {
        t0 = t0.max(t);
    } else if speed > 0.0 {
        t1 = t1.min(t);
    } else if gap < 0.0 {
        return f32::INFINITY;
    }
    if t0 <= t1 && t0 > NEAR { t0 } else { f32::INFINITY }
}

#[inline(always)]
pub(super) fn hit_ellipsoid(o: V3, d: V3) -> f32 {
    // Solved about the point of the ray nearest to the centre: far small balls keep their digits.
    let dd = dot(d, d);
    let tm = -dot(o, d) / dd;
    let m = sub(o, [-tm * d[0], -tm * d[1], -tm * d[2]]);
    // Beside the ball the root is NaN, which is not > NEAR.
    let t = tm - ((1.0 - dot(m, m)) / dd).sqrt();
    if t > NEAR { t } else { f32::INFINITY }
}

#[inline(always)]
pub(super) fn hit_frustum(o: V3, d: V3, top: f32) -> f32 {
    let mut best = f32::INFINITY;
    let (a, b) = (0.5 * (1.0 + top), 0.5 * (top - 1.0));
    // (ox + t dx)^2 + (oz + t dz)^2 = (r0 + t rd)^2 with the radius linear in y.
    let (r0, rd) = (a + b * o[1], b * d[1]);
    let qa = d[0] * d[0] + d[2] * d[2] - rd * rd;
    let qb = o[0] * d[0] + o[2] * d[2] - r0 * rd;
    let qc = o[0] * o[0] + o[2] * o[2] - r0 * r0;
    let disc = qb * qb - qa * qc;
    if disc >= 0.0 && qa.abs() > 1e-12 {
        let root = disc.sqrt();
        // The stable pair of roots: the one that adds, and the other from their product.
        let q = -(qb + root.copysign(qb));
        for t in [q / qa, qc / q] {
            let y = o[1] + t * d[1];
            if t > NEAR && t < best && (-1.0..=1.0).contains(&y) {
                best = t;
            }
        }
    }
    for (y, r) in [(1.0, top), (-1.0, 1.0)] {
        let t = (y - o[1]) / d[1];
        if t > NEAR && t < best {
            let (x, z) = (o[0] + t * d[0], o[2] + t * d[2]);
            if x * x + z * z <= r * r {
                best = t;
            }
        }
    }
    best
}
