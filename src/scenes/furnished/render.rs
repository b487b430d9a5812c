//! From a scene to linear colours and depth: one ray per pixel and two more at edges; one to a light and one for what other
//! surfaces throw back per square of two by two pixels, which the surface around shares.

use super::light::{Lights, luma};
use super::look::{Look, linear_table};
use super::mesh::along;
use super::openings::sees_sky;
use super::plan::Plan;
use super::room::Hole;
use super::scene::{Hit, Scene};
use crate::depth::sampling::noise::hash;
use crate::scenes::camera::Camera;
use crate::scenes::space::{V3, add, dot, mix, mul, norm, sub, times, to_world, unit};

/// Where each of a square of sixteen takes its numbers from, so that together they cover the range.
const ORDER: [u32; 16] = [0, 8, 2, 10, 12, 4, 14, 6, 3, 11, 1, 9, 15, 7, 13, 5];

/// Rays that look past a pixel's middle, at edges.
const AROUND: [[f32; 2]; 2] = [[-0.31, -0.22], [0.27, 0.33]];

/// The part of the mean light that comes from everywhere.
pub(super) const AMBIENT: f32 = 0.22;

/// What the renderer needs.
pub(super) struct View<'a> {
    pub scene: &'a Scene,
    pub lights: &'a Lights,
    pub plan: &'a Plan,
    pub holes: &'a [Hole],
    pub camera: &'a Camera,
    pub width: usize,
    pub height: usize,
    pub seed: u32,
}

/// A picture before exposure, and what is measured.
pub(super) struct Rendered {
    pub colour: Vec<V3>,
    /// Z-depth, metres; NaN where nothing returns.
    pub depth: Vec<f32>,
}

/// A point that is seen.
#[derive(Clone, Copy)]
struct Point {
    hit: Hit,
    at: V3,
    /// As smooth as the surface seems, and that of its face; both towards the viewer.
    normal: V3,
    flat: V3,
    albedo: V3,
}

/// Light at a point: the share of the lamps' light that arrives, and what other surfaces send.
#[derive(Clone, Copy, Default)]
struct Share {
    lamps: f32,
    bounce: V3,
}

pub(super) fn render(view: &View) -> Rendered {
    let frame = Frame { view, linear: linear_table(), pixel: 1.0 / view.camera.k.fx };
    let (w, h) = (view.width, view.height);
    let points: Vec<Option<Point>> = (0..w * h).map(|i| frame.look((i % w) as f32, (i / w) as f32)).collect();
    let smooth = mean(&points, &frame.lit(&points), w);
    let middle: Vec<V3> = points
        .iter()
        .zip(&smooth)
        .enumerate()
        .map(|(i, (p, s))| frame.colour(p.as_ref(), s, view.camera.ray((i % w) as f32, (i / w) as f32)))
        .collect();
    let mut colour = frame.softened(middle, &points, &smooth);
    frame.glaze(&mut colour, &points);
    let depth = points.iter().map(|p| p.map_or(f32::NAN, |p| p.hit.touch.t)).collect();
    Rendered { colour, depth }
}

/// The mean light of what a camera sees, for the part that many reflections spread everywhere.
pub(super) fn mean_light(scene: &Scene, lights: &Lights, camera: &Camera, width: usize, height: usize) -> V3 {
    let (mut sum, mut count) = ([0.0; 3], 0.0f32);
    for k in 0..96 {
        let (x, y) = ((k % 12) as f32 / 12.0 * width as f32, (k / 12) as f32 / 8.0 * height as f32);
        let d = camera.ray(x, y);
        if let Some(hit) = scene.nearest(camera.at, d, 1e-3, f32::INFINITY) {
            let i = &scene.instances[hit.instance as usize];
            let n = unit(to_world(&i.axes, i.mesh.plane(hit.touch.face)));
            let n = if dot(n, d) > 0.0 { mul(n, -1.0) } else { n };
            sum = add(sum, lights.unshadowed(along(camera.at, d, hit.touch.t), n));
            count += 1.0;
        }
    }
    mul(sum, 1.0 / count.max(1.0))
}

struct Frame<'a> {
    view: &'a View<'a>,
    linear: [f32; 256],
    /// Width of a pixel at a depth of 1 m.
    pixel: f32,
}

impl Frame<'_> {
    /// What is seen through a place of the picture.
    fn look(&self, x: f32, y: f32) -> Option<Point> {
        let (scene, camera) = (self.view.scene, self.view.camera);
        let d = camera.ray(x, y);
        let hit = scene.nearest(camera.at, d, 1e-3, f32::INFINITY)?;
        let i = &scene.instances[hit.instance as usize];
        let (t, length) = (hit.touch.t, norm(d));
        let flat = unit(to_world(&i.axes, i.mesh.plane(hit.touch.face)));
        let flat = if dot(flat, d) > 0.0 { mul(flat, -1.0) } else { flat };
        let normal = unit(to_world(&i.axes, i.mesh.normal(&hit.touch)));
        let normal = if dot(normal, flat) < 0.0 { mul(normal, -1.0) } else { normal };
        let normal = if dot(normal, d) > -0.02 * length { flat } else { normal };
        let at = along(camera.at, d, t);
        let facing = (-dot(flat, d) / length).max(0.05);
        let footprint = t * self.pixel * (1.0 / facing).min(3.0);
        let albedo = scene.look(&hit).albedo(&i.mesh, &hit.touch, i.local(at), footprint, &self.linear);
        Some(Point { hit, at, normal, flat, albedo })
    }

    /// Light at every pixel: gathered at one pixel of each square of two by two, and of those of sixteen squares around a
    /// pixel the mean of those on its surface. What is too thin for that asks on its own.
    fn lit(&self, points: &[Option<Point>]) -> Vec<Share> {
        let (w, h) = (self.view.width, self.view.height);
        let (columns, rows) = (w.div_ceil(2), h.div_ceil(2));
        let square = |k: usize| {
            let (bx, by) = (k % columns, k / columns);
            let start = hash(bx as i32, by as i32, self.view.seed) as usize;
            (start..start.wrapping_add(4)).find_map(|n| {
                let (x, y) = ((2 * bx + (n & 1)).min(w - 1), (2 * by + (n >> 1 & 1)).min(h - 1));
                let p = points[y * w + x].as_ref()?;
                Some((p, self.gather(p, bx as u32, by as u32)))
            })
        };
        let gathered: Vec<Option<(&Point, Share)>> = (0..columns * rows).map(square).collect();
        let at = |i: usize| {
            let Some(p) = &points[i] else { return Share::default() };
            let (x, y) = (i % w, i / w);
            let mut sum = Sum::default();
            for by in y.div_ceil(2).saturating_sub(2)..(y.div_ceil(2) + 2).min(rows) {
                for bx in x.div_ceil(2).saturating_sub(2)..(x.div_ceil(2) + 2).min(columns) {
                    if let Some((q, share)) = &gathered[by * columns + bx]
                        && p.continues(q)
                    {
                        sum.add(share, 1.0);
                    }
                }
            }
            sum.mean().unwrap_or_else(|| self.gather(p, x as u32, y as u32))
        };
        (0..points.len()).map(at).collect()
    }

    /// One ray to a light and one to another surface; their numbers depend on the place in a square of sixteen.
    fn gather(&self, p: &Point, x: u32, y: u32) -> Share {
        let k = ORDER[(4 * (y & 3) + (x & 3)) as usize];
        let jitter = |n: u32| hash(x as i32, (y * 8 + n) as i32, self.view.seed) as f32 / 4_294_967_296.0;
        let cell = |k: u32, n: u32| ((k as f32) + jitter(n)) / 4.0;
        let lift = 1e-3 + 2e-4 * p.hit.touch.t;
        let from = add(p.at, mul(p.flat, lift));
        let lamps = self.lamp(p, from, (k as f32 + jitter(0)) / 16.0, [cell(k & 3, 1), cell(k >> 2, 2)]);
        let other = (k * 7 + 3) & 15;
        Share { lamps, bounce: self.bounce(p, from, [cell(other & 3, 3), cell(other >> 2, 4)]) }
    }

    /// 1 if a point of one of the lamps is in sight, each as likely as its light is strong.
    fn lamp(&self, p: &Point, from: V3, pick: f32, place: [f32; 2]) -> f32 {
        let lamps = &self.view.lights.lamps;
        let strong: f32 = lamps.iter().map(|l| luma(l.arriving(p.at, p.normal))).sum();
        let mut left = pick * strong;
        for lamp in lamps {
            left -= luma(lamp.arriving(p.at, p.normal));
            if left < 0.0 {
                let d = sub(lamp.point(place[0], place[1]), from);
                // Lamps stand in their shades: the last hand's breadth does not count.
                let end = 1.0 - (0.12 / norm(d)).min(0.5);
                return if dot(d, p.flat) <= 0.0 || self.view.scene.blocked(from, d, 1e-4, end) {
                    0.0
                } else {
                    1.0
                };
            }
        }
        0.0
    }

    /// Radiance from a direction, chosen by the cosine to the normal.
    fn bounce(&self, p: &Point, from: V3, u: [f32; 2]) -> V3 {
        let n = p.normal;
        let side = if n[1].abs() < 0.9 { [0.0, 1.0, 0.0] } else { [1.0, 0.0, 0.0] };
        let a = unit(super::geometry::cross(side, n));
        let b = super::geometry::cross(n, a);
        let (r, (s, c)) = (u[0].sqrt(), (std::f32::consts::TAU * u[1]).sin_cos());
        let up = (1.0 - u[0]).max(0.0).sqrt();
        let d = add(add(mul(a, r * c), mul(b, r * s)), mul(n, up));
        let lights = self.view.lights;
        let Some(hit) = self.view.scene.nearest(from, d, 1e-4, 30.0) else { return lights.ambient };
        // Near surfaces shade each other more than one reflection tells.
        let close = (0.35 + 1.6 * hit.touch.t).min(1.0);
        mul(self.thrown(&hit, from, d), close)
    }

    /// What a surface throws back, without shadows.
    fn thrown(&self, hit: &Hit, from: V3, d: V3) -> V3 {
        let scene = self.view.scene;
        let i = &scene.instances[hit.instance as usize];
        let n = unit(to_world(&i.axes, i.mesh.plane(hit.touch.face)));
        let n = if dot(n, d) > 0.0 { mul(n, -1.0) } else { n };
        let arriving = self.view.lights.unshadowed(along(from, d, hit.touch.t), n);
        let albedo = scene.look(hit).mean(&i.mesh, &hit.touch, &self.linear);
        // A lit spot beside a lamp would show as a speck of light on whatever happens to look at it.
        let most = 3.0 * luma(self.view.lights.ambient) / AMBIENT;
        let damp = (most / luma(arriving).max(1e-6)).min(1.0);
        times(albedo, add(mul(arriving, 0.6 * damp), self.view.lights.ambient))
    }

    fn colour(&self, point: Option<&Point>, share: &Share, d: V3) -> V3 {
        let lights = self.view.lights;
        let Some(p) = point else { return lights.sky_in(unit(d)) };
        let look = self.view.scene.look(&p.hit);
        let arriving = lights.unshadowed(p.at, p.normal);
        let mut light = add(mul(arriving, share.lamps), share.bounce);
        if let Some(sun) = lights.sun {
            let lambert = dot(p.normal, sun.to);
            let lift = add(p.at, mul(p.flat, 2e-3));
            if lambert > 0.0
                && dot(p.flat, sun.to) > 0.0
                && sees_sky(self.view.plan, self.view.holes, p.at, sun.to)
                && !self.view.scene.blocked(lift, sun.to, 1e-4, 100.0)
            {
                light = add(light, mul(sun.power, lambert));
            }
        }
        let mut c = add(times(p.albedo, light), mul(p.albedo, look.glow));
        if look.gloss > 0.0 {
            c = add(c, mul(self.highlight(p, look, unit(d)), share.lamps));
        }
        if look.mirror > 0.0 {
            c = mix(c, self.mirrored(p, unit(d)), look.mirror);
        }
        c
    }

    /// Reflections of the lamps themselves, after Blinn.
    fn highlight(&self, p: &Point, look: &Look, d: V3) -> V3 {
        self.view.lights.lamps.iter().fold([0.0; 3], |sum, lamp| {
            let to = unit(sub(lamp.at, p.at));
            let half = unit(sub(to, d));
            let shine = dot(p.normal, half).max(0.0).powf(look.exponent);
            let arriving = lamp.arriving(p.at, p.normal);
            add(sum, mul(arriving, look.gloss * shine * (0.15 * look.exponent).min(6.0)))
        })
    }

    fn mirrored(&self, p: &Point, d: V3) -> V3 {
        let r = sub(d, mul(p.normal, 2.0 * dot(d, p.normal)));
        let from = add(p.at, mul(p.flat, 2e-3));
        match self.view.scene.nearest(from, r, 1e-4, 60.0) {
            Some(hit) => self.thrown(&hit, from, r),
            None => self.view.lights.sky_in(r),
        }
    }

    /// Averages of three rays where a pixel's neighbours show something else.
    fn softened(&self, middle: Vec<V3>, points: &[Option<Point>], shares: &[Share]) -> Vec<V3> {
        let (w, h) = (self.view.width, self.view.height);
        let mut out = middle.clone();
        for y in 0..h {
            for x in 0..w {
                let i = y * w + x;
                let near = [(x > 0).then(|| i - 1), (x + 1 < w).then_some(i + 1)];
                let far = [(y > 0).then(|| i - w), (y + 1 < h).then_some(i + w)];
                let mut around = near.into_iter().chain(far).flatten();
                if !around.any(|k| differ(points[i].as_ref(), points[k].as_ref())) {
                    continue;
                }
                let mut sum = middle[i];
                for [dx, dy] in AROUND {
                    let (px, py) = (x as f32 + dx, y as f32 + dy);
                    let point = self.look(px, py);
                    let share = point.as_ref().map_or(Share::default(), |p| {
                        self.borrowed(p, x, y, points, shares)
                            .unwrap_or_else(|| self.gather(p, x as u32, y as u32))
                    });
                    sum = add(sum, self.colour(point.as_ref(), &share, self.view.camera.ray(px, py)));
                }
                out[i] = mul(sum, 1.0 / (1.0 + AROUND.len() as f32));
            }
        }
        out
    }

    /// The light of the most similar of nine pixels.
    fn borrowed(
        &self,
        p: &Point,
        x: usize,
        y: usize,
        points: &[Option<Point>],
        shares: &[Share],
    ) -> Option<Share> {
        let (w, h) = (self.view.width, self.view.height);
        let mut best: Option<(f32, Share)> = None;
        for j in y.saturating_sub(1)..(y + 2).min(h) {
            for i in x.saturating_sub(1)..(x + 2).min(w) {
                let Some(q) = &points[j * w + i] else { continue };
                let bend = 1.0 - dot(p.normal, q.normal);
                let gap = dot(sub(q.at, p.at), p.flat).abs() / p.hit.touch.t;
                let cost = bend + 20.0 * gap;
                if q.hit.instance == p.hit.instance && cost < 0.5 && best.is_none_or(|(c, _)| cost < c) {
                    best = Some((cost, shares[j * w + i]));
                }
            }
        }
        best.map(|(_, share)| share)
    }

    /// Lays glass over what is behind it.
    fn glaze(&self, colour: &mut [V3], points: &[Option<Point>]) {
        let (w, camera) = (self.view.width, self.view.camera);
        let around = add(self.view.lights.ambient, mul(self.view.lights.ambient, 1.5));
        for (i, (c, p)) in colour.iter_mut().zip(points).enumerate() {
            let d = camera.ray((i % w) as f32, (i / w) as f32);
            let end = p.map_or(f32::INFINITY, |p| p.hit.touch.t);
            if let Some((through, shine)) = self.view.scene.glass(camera.at, d, end) {
                *c = add(times(*c, mul(through, 1.0 - shine)), mul(around, shine));
            }
        }
    }
}

/// Whether two neighbouring pixels show different things.
fn differ(a: Option<&Point>, b: Option<&Point>) -> bool {
    match (a, b) {
        (None, None) => false,
        (Some(a), Some(b)) => {
            a.hit.instance != b.hit.instance
                || dot(a.flat, b.flat) < 0.7
                || dot(sub(b.at, a.at), a.flat).abs() > 0.02 * a.hit.touch.t
        }
        _ => true,
    }
}

impl Point {
    /// Whether another point is on the same surface near by.
    fn continues(&self, q: &Point) -> bool {
        let flat = 0.003 + 0.006 * self.hit.touch.t;
        dot(q.normal, self.normal) > 0.9 && dot(sub(q.at, self.at), self.normal).abs() < flat
    }
}

/// A weighted mean in the making.
#[derive(Default)]
struct Sum {
    share: Share,
    weight: f32,
}

impl Sum {
    fn add(&mut self, share: &Share, weight: f32) {
        self.share.lamps += weight * share.lamps;
        self.share.bounce = add(self.share.bounce, mul(share.bounce, weight));
        self.weight += weight;
    }

    fn mean(&self) -> Option<Share> {
        let scale = 1.0 / self.weight;
        let share = Share { lamps: self.share.lamps * scale, bounce: mul(self.share.bounce, scale) };
        (self.weight > 0.0).then_some(share)
    }
}

/// Distance between the pixels of [`mean`].
const STEP: usize = 4;

/// Means over nine pixels of the same surface, the outer ones with half the weight per direction.
fn mean(points: &[Option<Point>], shares: &[Share], w: usize) -> Vec<Share> {
    let h = points.len() / w;
    let at = |i: usize| {
        let Some(p) = &points[i] else { return Share::default() };
        let (x, y, mut sum) = (i % w, i / w, Sum::default());
        for (row, wy) in [(y.checked_sub(STEP), 0.5), (Some(y), 1.0), (Some(y + STEP), 0.5)] {
            let Some(row) = row.filter(|&j| j < h) else { continue };
            for (column, wx) in [(x.checked_sub(STEP), 0.5), (Some(x), 1.0), (Some(x + STEP), 0.5)] {
                let Some(k) = column.filter(|&k| k < w).map(|k| row * w + k) else { continue };
                if let Some(q) = &points[k]
                    && p.continues(q)
                {
                    sum.add(&shares[k], wx * wy);
                }
            }
        }
        sum.mean().unwrap_or(shares[i])
    };
    (0..points.len()).map(at).collect()
}
