//! From hits to an 8-bit picture: lights, one shadow map, and the faults of a real camera.

use image::RgbImage;
use rand::Rng;

use super::camera::Camera;
use super::cast::{Hits, NOTHING, cast};
use super::space::{V3, add, dot, mix, mul, norm, sub, times, unit};
use super::stage::Stage;
use crate::depth::Intrinsics;
use crate::depth::sampling::noise::hash;

const SHADOW_SIZE: usize = 192;

/// Distances seen from the first light.
struct Shadows {
    camera: Camera,
    hits: Hits,
    /// Share of the first light that a shadow keeps.
    keep: f32,
}

impl Shadows {
    fn new(stage: &mut Stage) -> Option<Self> {
        let light = stage.lights.first()?.at;
        if !stage.chance(0.75) {
            return None;
        }
        let (centre, radius) = stage.focus;
        let d = sub(centre, light);
        let distance = norm(d);
        let half = (radius / distance).atan().clamp(0.02, 1.15);
        let k = Intrinsics::from_fov(SHADOW_SIZE, SHADOW_SIZE, 2.0 * half);
        let camera = Camera::new(k, light, d[0].atan2(d[2]), (d[1] / distance).clamp(-1.0, 1.0).asin(), 0.0);
        let hits = cast(&stage.solids, &camera, SHADOW_SIZE, SHADOW_SIZE);
        let keep = if stage.chance(0.3) { 0.0 } else { stage.real(0.1, 0.7) };
        Some(Self { camera, hits, keep })
    }

    /// Share of the first light that arrives at a point of the given surface.
    fn at(&self, p: V3, normal: V3, solid: u32) -> f32 {
        let v = self.camera.view(p);
        if v[2] <= 0.0 {
            return 1.0;
        }
        let texel = v[2] / self.camera.k.fx;
        let (x, y) = (self.camera.k.cx + v[0] / texel, self.camera.k.cy + v[1] / texel);
        let last = SHADOW_SIZE as f32 - 1.0;
        if !(x > 0.0 && y > 0.0 && x < last && y < last) {
            return 1.0;
        }
        let slope = dot(normal, self.camera.axes[2]).abs().max(0.2);
        let limit = v[2] - 2.0 * texel / slope;
        let (i, j) = (x as usize, y as usize);
        let (a, b) = (x - i as f32, y - j as f32);
        let lit = |k: usize| {
            // Convex solids cannot shade themselves.
            f32::from(u8::from(self.hits.depth[k] >= limit || self.hits.solid[k] == solid))
        };
        let k = j * SHADOW_SIZE + i;
        let top = lit(k) * (1.0 - a) + lit(k + 1) * a;
        let low = lit(k + SHADOW_SIZE) * (1.0 - a) + lit(k + SHADOW_SIZE + 1) * a;
        self.keep + (1.0 - self.keep) * (top + (low - top) * b)
    }
}

/// Linear radiance of every pixel.
pub(super) fn shade(stage: &mut Stage, hits: &Hits, width: usize) -> Vec<V3> {
    let shadows = Shadows::new(stage);
    let camera = &stage.camera;
    let pixel = 1.0 / camera.k.fx;
    let mut out = Vec::with_capacity(hits.depth.len());
    for (i, (&t, &id)) in hits.depth.iter().zip(&hits.solid).enumerate() {
        let ray = camera.ray((i % width) as f32, (i / width) as f32);
        if id == NOTHING {
            let up = unit(ray)[1].max(0.0).sqrt();
            out.push(mix(stage.sky[0], stage.sky[1], up));
            continue;
        }
        let solid = &stage.solids[id as usize];
        let material = &stage.materials[solid.material as usize];
        let p = add(camera.at, mul(ray, t));
        let local = solid.to_unit(sub(p, solid.centre));
        let mut n = solid.normal(local);
        let facing = -dot(n, ray);
        if facing < 0.0 {
            n = mul(n, -1.0);
        }
        // Grazing views see the texture squeezed along one axis; a factor of two keeps some of it.
        let length = norm(ray);
        let footprint = t * pixel * (length / facing.abs().max(0.02)).min(3.0);
        let albedo = material.albedo(solid, local, footprint);
        let mut light = mul(stage.ambient, 0.75 + 0.25 * n[1]);
        let mut shine = [0.0; 3];
        for (k, l) in stage.lights.iter().enumerate() {
            let d = sub(l.at, p);
            let distance = norm(d);
            let to = mul(d, 1.0 / distance);
            let lambert = dot(n, to);
            if lambert <= 0.0 {
                continue;
            }
            let mut strength = 1.0 / (1.0 + (distance / l.reach).powi(2));
            if let (0, Some(s)) = (k, &shadows) {
                strength *= s.at(p, n, id);
            }
            light = add(light, mul(l.colour, lambert * strength));
            if material.gloss > 0.0 {
                let half = unit(sub(to, mul(ray, 1.0 / length)));
                let h = dot(n, half).max(0.0);
                let h4 = h * h * h * h;
                let h16 = h4 * h4 * h4 * h4;
                shine = add(shine, mul(l.colour, material.gloss * strength * h16 * h16));
            }
        }
        let glow = [material.glow; 3];
        let c = add(times(albedo, add(light, glow)), shine);
        let veil = if stage.haze < f32::INFINITY { 1.0 - (-t / stage.haze).exp() } else { 0.0 };
        out.push(mix(c, stage.sky[0], veil));
    }
    occlude(&mut out, hits, width);
    smooth_edges(&mut out, &hits.solid, width);
    out
}

/// Darkens pixels with nearer surroundings: the soft contact shadows of a room's diffuse light.
fn occlude(colour: &mut [V3], hits: &Hits, width: usize) {
    let height = colour.len() / width;
    let step = (width / 40).max(1);
    if width <= 2 * step || height <= 2 * step {
        return;
    }
    for y in step..height - step {
        for x in step..width - step {
            let i = y * width + x;
            let t = hits.depth[i];
            if t == f32::INFINITY {
                continue;
            }
            let mut dark = 0.0;
            for (a, b) in [
                (i - step, i + step),
                (i - step * width, i + step * width),
                (i - step * width / 2, i + step * width / 2),
            ] {
                let (a, b) = (hits.depth[a], hits.depth[b]);
                if a == f32::INFINITY || b == f32::INFINITY {
                    continue;
                }
                // Concave corners: both neighbours' mean inverse depth is nearer than this pixel.
                let bend = 0.5 * (t / a + t / b) - 1.0;
                if bend > 0.0 && bend < 0.12 {
                    dark += bend.min(0.12 - bend);
                }
            }
            if dark > 0.0 {
                colour[i] = mul(colour[i], 1.0 - (dark * 6.0).min(0.5));
            }
        }
    }
}

/// Blends pixels on the borders of solids with their neighbours, as a sensor's pixel area would.
fn smooth_edges(colour: &mut [V3], solid: &[u32], width: usize) {
    let height = solid.len() / width;
    let source = colour.to_vec();
    for y in 1..height.saturating_sub(1) {
        for x in 1..width.saturating_sub(1) {
            let i = y * width + x;
            let id = solid[i];
            let around = [i - 1, i + 1, i - width, i + width];
            if around.iter().any(|&k| solid[k] != id) {
                let sum = around.iter().fold([0.0; 3], |s, &k| add(s, source[k]));
                colour[i] = add(mul(source[i], 0.5), mul(sum, 0.125));
            }
        }
    }
}

fn luma(c: &V3) -> f32 {
    0.3 * c[0] + 0.6 * c[1] + 0.1 * c[2]
}

/// Exposure and the camera's own faults, at random.
pub(super) fn develop(stage: &mut Stage, colour: Vec<V3>, width: usize, height: usize) -> RgbImage {
    let step = (colour.len() / 2048).max(1);
    let mut sample: Vec<f32> = colour.iter().step_by(step).map(luma).collect();
    sample.sort_by(f32::total_cmp);
    let at = |q: f32| sample[((sample.len() - 1) as f32 * q) as usize];
    // Metered on a mix of the middle and the bright end, as cameras do, and missed by some.
    let level = (0.5 * at(0.5) + 0.25 * at(0.9)).max(1e-4);
    let gain = stage.log(0.12, 0.4) / level;
    let cast: V3 = if stage.chance(0.6) {
        [stage.real(0.85, 1.15), stage.real(0.94, 1.06), stage.real(0.8, 1.2)]
    } else {
        [1.0; 3]
    };
    let faults = Finish {
        cast: mul(cast, gain),
        vignette: if stage.chance(0.5) { stage.real(0.0, 0.5) } else { 0.0 },
        blur: if stage.chance(0.6) { stage.real(0.0, 0.22) } else { 0.0 },
        noise: if stage.chance(0.7) { stage.log(0.002, 0.035) } else { 0.0 },
        saturation: stage.real(0.6, 1.25),
        gamma: 1.0 / stage.real(1.8, 2.5),
        contrast: stage.real(0.0, 0.8),
        lift: if stage.chance(0.3) { stage.real(0.0, 0.06) } else { 0.0 },
        seed: stage.rng.random(),
    };
    finish(colour, width, height, &faults)
}

/// What a camera does to exposed light.
pub(super) struct Finish {
    /// Factors of the channels.
    pub cast: V3,
    /// Share of the light that is lost in the corners.
    pub vignette: f32,
    /// Weight of each neighbour in a blur.
    pub blur: f32,
    /// Deviation of the noise, as a part of white.
    pub noise: f32,
    pub saturation: f32,
    pub gamma: f32,
    /// Share of an S-shaped curve.
    pub contrast: f32,
    /// Brightness of black.
    pub lift: f32,
    pub seed: u32,
}

/// Colour cast, vignette, blur, noise, tone curve and 8 bits. `colour` is linear, white is 1.
pub(super) fn finish(mut colour: Vec<V3>, width: usize, height: usize, f: &Finish) -> RgbImage {
    let curve: Vec<f32> = (0..1025)
        .map(|i| {
            let v = (i as f32 / 1024.0).powf(f.gamma);
            let s = v * v * (3.0 - 2.0 * v);
            255.0 * (f.lift + (1.0 - f.lift) * (v + f.contrast * (s - v)))
        })
        .collect();
    if f.blur > 0.0 {
        soften(&mut colour, width, height, f.blur);
    }
    let (cx, cy) = (0.5 * width as f32, 0.5 * height as f32);
    let scale = 1.0 / (cx * cx + cy * cy);
    let mut bytes = Vec::with_capacity(width * height * 3);
    for (i, c) in colour.iter().enumerate() {
        let (x, y) = ((i % width) as f32 - cx, (i / width) as f32 - cy);
        let c = times(*c, mul(f.cast, 1.0 - f.vignette * (x * x + y * y) * scale));
        let grey = luma(&c);
        for (k, &v) in c.iter().enumerate() {
            let v = grey + (v - grey) * f.saturation;
            let mut out = curve[(v * 1024.0).clamp(0.0, 1024.0) as usize];
            if f.noise > 0.0 {
                let h = hash(i as i32, k as i32, f.seed);
                let sum = (h & 255) + (h >> 8 & 255) + (h >> 16 & 255) + (h >> 24);
                // Four bytes add up to nearly a Gaussian of deviation 148.
                out += (sum as f32 - 510.0) * (f.noise * 255.0 / 148.0);
            }
            bytes.push((out + 0.5) as u8);
        }
    }
    RgbImage::from_raw(width as u32, height as u32, bytes)
        .unwrap_or_else(|| RgbImage::new(width as u32, height as u32))
}

/// Separable 3-tap blur with weight `w` for each neighbour.
fn soften(colour: &mut [V3], width: usize, height: usize, w: f32) {
    let pass = |colour: &mut [V3], start: usize, stride: usize, n: usize| {
        let mut before = colour[start];
        for k in 0..n {
            let i = start + k * stride;
            let here = colour[i];
            let after = if k + 1 < n { colour[i + stride] } else { here };
            colour[i] = add(mul(here, 1.0 - 2.0 * w), mul(add(before, after), w));
            before = here;
        }
    };
    for y in 0..height {
        pass(colour, y * width, 1, width);
    }
    for x in 0..width {
        pass(colour, x, width, height);
    }
}
