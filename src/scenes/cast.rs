//! Ray casting in object order: each solid is intersected only with the rays of the pixels that its projection can reach,
//! and a depth buffer keeps the nearest hit. Rays of one camera share their origin, so a solid's unit-frame direction is
//! linear in the pixel and costs three additions.

use super::camera::Camera;
use super::shapes::{Kind, NEAR, Solid, hit_cuboid, hit_cut, hit_ellipsoid, hit_frustum};
use super::space::{V3, add, dot, mul, sub, times, to_local, to_world};

/// Pixels that are skipped together behind nearer solids.
const RUN: usize = 16;

/// No solid was hit.
pub(super) const NOTHING: u32 = u32::MAX;

#[derive(Clone)]
pub(super) struct Hits {
    /// Z-depth, metres; infinity where nothing was hit.
    pub depth: Vec<f32>,
    /// Index of the solid, or [`NOTHING`].
    pub solid: Vec<u32>,
}

/// Pixels (inclusive ranges) that a solid may cover and the smallest Z-depth it may have.
struct Reach {
    x: (usize, usize),
    y: (usize, usize),
    nearest: f32,
    solid: u32,
}

pub(super) fn cast(solids: &[Solid], camera: &Camera, width: usize, height: usize) -> Hits {
    cast_where(solids, camera, width, height, |_| |_, _, t| t)
}

/// As [`cast`], but only hits with `dot(normal, p) > offset` count, as if each ray started at that plane. A solid that the plane cuts is
/// not seen by rays that would start inside it.
pub(super) fn cast_beyond(
    solids: &[Solid],
    camera: &Camera,
    width: usize,
    height: usize,
    (normal, offset): (V3, f32),
) -> Hits {
    cast_where(solids, camera, width, height, |solid| {
        // The plane in the solid's unit frame.
        let (n, c) = (times(to_local(&solid.axes, normal), solid.half), offset - dot(normal, solid.centre));
        move |o, d, t| if dot(n, o) + t * dot(n, d) > c { t } else { f32::INFINITY }
    })
}

/// Casts; `keep` makes of a solid what judges its hits, by the ray's origin and direction in its unit frame and the parameter.
fn cast_where<K: Fn(V3, V3, f32) -> f32>(
    solids: &[Solid],
    camera: &Camera,
    width: usize,
    height: usize,
    keep: impl Fn(&Solid) -> K,
) -> Hits {
    let mut hits = Hits { depth: vec![f32::INFINITY; width * height], solid: vec![NOTHING; width * height] };
    let mut reaches: Vec<Reach> =
        solids.iter().enumerate().filter_map(|(i, s)| reach(s, i as u32, camera, width, height)).collect();
    // Near solids first: most of what lies behind them is then skipped by the depth comparison alone.
    reaches.sort_by(|a, b| a.nearest.total_cmp(&b.nearest));
    for r in &reaches {
        let solid = &solids[r.solid as usize];
        let k = keep(solid);
        match solid.kind {
            Kind::Cuboid => scan(solid, r, camera, width, &mut hits, |o, d| k(o, d, hit_cuboid(o, d))),
            Kind::Ellipsoid => scan(solid, r, camera, width, &mut hits, |o, d| k(o, d, hit_ellipsoid(o, d))),
            Kind::Frustum { top } => {
                scan(solid, r, camera, width, &mut hits, |o, d| k(o, d, hit_frustum(o, d, top)))
            }
            Kind::Cut { normal, offset } => {
                scan(solid, r, camera, width, &mut hits, |o, d| k(o, d, hit_cut(o, d, normal, offset)))
            }
        }
    }
    hits
}

#[inline(always)]
fn scan(
    solid: &Solid,
    r: &Reach,
    camera: &Camera,
    width: usize,
    hits: &mut Hits,
    hit: impl Fn(V3, V3) -> f32,
) {
    let origin = solid.to_unit(sub(camera.at, solid.centre));
    let right = mul(solid.to_unit(camera.axes[0]), 1.0 / camera.k.fx);
    let down = mul(solid.to_unit(camera.axes[1]), 1.0 / camera.k.fy);
    let forward = solid.to_unit(camera.axes[2]);
    for y in r.y.0..=r.y.1 {
        let row = add(forward, mul(down, y as f32 - camera.k.cy));
        let line = y * width;
        let depths = &mut hits.depth[line + r.x.0..=line + r.x.1];
        let owners = &mut hits.solid[line + r.x.0..=line + r.x.1];
        for (n, (depths, owners)) in depths.chunks_mut(RUN).zip(owners.chunks_mut(RUN)).enumerate() {
            let deepest = depths.iter().fold(0.0, |m: f32, &d| if d > m { d } else { m });
            if deepest <= r.nearest {
                continue;
            }
            let first = (r.x.0 + n * RUN) as f32 - camera.k.cx;
            // Without branches, so that the compiler can take several pixels at once.
            for (k, (depth, owner)) in depths.iter_mut().zip(owners).enumerate() {
                let t = hit(origin, add(row, mul(right, first + k as f32)));
                let closer = t < *depth;
                *depth = if closer { t } else { *depth };
                *owner = if closer { r.solid } else { *owner };
            }
        }
    }
}

/// Projects the bounding box, with the edges that cross the near plane cut there.
fn reach(solid: &Solid, index: u32, camera: &Camera, width: usize, height: usize) -> Option<Reach> {
    let mut corners = [[0.0f32; 3]; 8];
    for (i, c) in corners.iter_mut().enumerate() {
        let sign = |bit: usize| if i >> bit & 1 == 1 { 1.0 } else { -1.0 };
        let offset = to_world(&solid.axes, times(solid.half, [sign(0), sign(1), sign(2)]));
        *c = camera.view(add(solid.centre, offset));
    }
    let nearest = corners.iter().fold(f32::INFINITY, |m, c| m.min(c[2]));
    if corners.iter().all(|c| c[2] <= NEAR) {
        return None;
    }
    let (mut x0, mut x1) = (f32::INFINITY, f32::NEG_INFINITY);
    let (mut y0, mut y1) = (f32::INFINITY, f32::NEG_INFINITY);
    let mut project = |p: V3| {
        let (x, y) = (camera.k.cx + camera.k.fx * p[0] / p[2], camera.k.cy + camera.k.fy * p[1] / p[2]);
        (x0, x1, y0, y1) = (x0.min(x), x1.max(x), y0.min(y), y1.max(y));
    };
    for i in 0..8 {
        if corners[i][2] > NEAR {
            project(corners[i]);
        }
        for bit in 0..3 {
            let j = i | 1 << bit;
            let (a, b) = (corners[i], corners[j]);
            if j != i && (a[2] > NEAR) != (b[2] > NEAR) {
                let s = (NEAR - a[2]) / (b[2] - a[2]);
                project([a[0] + s * (b[0] - a[0]), a[1] + s * (b[1] - a[1]), NEAR]);
            }
        }
    }
    let (w, h) = (width as f32 - 1.0, height as f32 - 1.0);
    // Half a pixel of slack against rounding in the projection.
    let (x0, x1, y0, y1) = (x0 - 0.5, x1 + 0.5, y0 - 0.5, y1 + 0.5);
    if !(x1 >= 0.0 && y1 >= 0.0 && x0 <= w && y0 <= h) {
        return None;
    }
    let range = |a: f32, b: f32, max: f32| (a.max(0.0).ceil() as usize, b.min(max).floor() as usize);
    let (x, y) = (range(x0, x1, w), range(y0, y1, h));
    (x.0 <= x.1 && y.0 <= y.1).then_some(Reach { x, y, nearest: nearest.max(NEAR) * 0.9999, solid: index })
}
