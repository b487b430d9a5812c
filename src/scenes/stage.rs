//! The scene under construction: solids, materials and lights, and the random choices that make them.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::camera::Camera;
use super::shapes::{Kind, Solid};
use super::space::{Rot, UPRIGHT, V3, add, compose, dot, mix, mul, norm, sub, to_world, turned, unit};
use super::texture::{Material, Pattern};
use crate::depth::sampling::choice::Below;

/// A light at a point; a sun is a light very far away without fall-off.
#[derive(Clone, Debug)]
pub(super) struct Light {
    pub at: V3,
    pub colour: V3,
    /// Distance at which half of it is left; infinity for a sun.
    pub reach: f32,
}

/// What the renderer needs.
#[derive(Clone, Debug)]
pub(super) struct Stage {
    pub rng: ChaCha8Rng,
    pub solids: Vec<Solid>,
    pub materials: Vec<Material>,
    pub lights: Vec<Light>,
    pub ambient: V3,
    /// Colours at the horizon and overhead where no solid is hit.
    pub sky: [V3; 2],
    /// Distance over which haze covers a surface, metres.
    pub haze: f32,
    pub camera: Camera,
    /// What the first light's shadows are cast upon: centre and radius.
    pub focus: (V3, f32),
}

/// A local frame in which furniture is put together: y up, z to the front.
#[derive(Clone, Copy, Debug)]
pub(super) struct Place {
    pub at: V3,
    pub axes: Rot,
}

impl Place {
    pub fn new(at: V3, yaw: f32) -> Self {
        Self { at, axes: turned(yaw, 0.0, 0.0) }
    }

    pub fn point(&self, local: V3) -> V3 {
        add(self.at, to_world(&self.axes, local))
    }

    /// A frame at a local point, turned about the vertical.
    pub fn inner(&self, local: V3, yaw: f32) -> Self {
        Self { at: self.point(local), axes: compose(&turned(yaw, 0.0, 0.0), &self.axes) }
    }

    /// The same with any rotation.
    pub fn tilted(&self, local: V3, yaw: f32, pitch: f32, roll: f32) -> Self {
        Self { at: self.point(local), axes: compose(&turned(yaw, pitch, roll), &self.axes) }
    }
}

/// Index of a material.
pub(super) type Paint = u16;

impl Stage {
    pub fn new(rng: ChaCha8Rng, camera: Camera) -> Self {
        Self {
            rng,
            solids: Vec::with_capacity(256),
            materials: Vec::with_capacity(128),
            lights: Vec::new(),
            ambient: [0.3; 3],
            sky: [[0.8, 0.85, 0.9], [0.4, 0.6, 0.9]],
            haze: f32::INFINITY,
            camera,
            focus: ([0.0; 3], 5.0),
        }
    }

    pub fn real(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.rng.random::<f32>()
    }

    /// Log-uniform.
    pub fn log(&mut self, low: f32, high: f32) -> f32 {
        self.real(low.ln(), high.ln()).exp()
    }

    /// Uniform in `low..=high`.
    pub fn int(&mut self, low: usize, high: usize) -> usize {
        low + (self.rng.next_u32_below(high - low + 1))
    }

    pub fn chance(&mut self, p: f32) -> bool {
        self.rng.random::<f32>() < p
    }

    pub fn pick<T: Copy>(&mut self, of: &[T]) -> T {
        of[self.int(0, of.len() - 1)]
    }

    /// Any hue with the given saturation and brightness.
    pub fn hue(&mut self, saturation: f32, value: f32) -> V3 {
        let h = self.real(0.0, 6.0);
        let wheel = |shift: f32| {
            let k = (h + shift).rem_euclid(6.0);
            1.0 - (2.0 - (k - 3.0).abs()).clamp(0.0, 1.0)
        };
        mul(mix([1.0; 3], [wheel(0.0), wheel(4.0), wheel(2.0)], saturation), value)
    }

    /// Colours of walls and furniture: mostly white, grey, beige and wood.
    pub fn calm(&mut self) -> V3 {
        match self.int(0, 9) {
            0..=3 => {
                let v = self.real(0.45, 0.9);
                let warm = self.real(-0.04, 0.1);
                [v, v * (1.0 - 0.5 * warm), v * (1.0 - warm)]
            }
            4 => [self.real(0.02, 0.2); 3],
            5 | 6 => {
                let v = self.real(0.2, 0.7);
                mul([1.0, self.real(0.62, 0.8), self.real(0.3, 0.6)], v)
            }
            7 => [self.real(0.1, 0.6); 3],
            _ => {
                let (s, v) = (self.real(0.1, 0.5), self.real(0.2, 0.8));
                self.hue(s, v)
            }
        }
    }

    /// Colours of things: saturated ones, black and white too.
    pub fn vivid(&mut self) -> V3 {
        match self.int(0, 5) {
            0 => [self.real(0.02, 0.12); 3],
            1 => [self.real(0.6, 0.95); 3],
            2 => self.calm(),
            _ => {
                let (s, v) = (self.real(0.4, 1.0), self.real(0.15, 0.95));
                self.hue(s, v)
            }
        }
    }

    pub fn paint(&mut self, pattern: Pattern, base: V3, second: V3, period: f32) -> Paint {
        let grain = if self.chance(0.4) { self.log(0.02, 0.25) } else { 0.0 };
        let m = Material {
            pattern,
            base,
            second,
            period: period.max(1e-4),
            grain,
            grain_period: period.max(1e-3) * self.log(0.2, 2.0),
            gloss: if self.chance(0.35) { self.real(0.05, 0.6) } else { 0.0 },
            glow: 0.0,
            seed: self.rng.random(),
        };
        self.materials.push(m);
        (self.materials.len() - 1) as Paint
    }

    pub fn plain(&mut self, base: V3) -> Paint {
        self.paint(Pattern::Plain, base, base, 0.3)
    }

    /// Walls, ceilings, large furniture; `size` in metres sets the period.
    pub fn surface(&mut self, size: f32) -> Paint {
        let (a, b) = (self.calm(), self.calm());
        let near = mix(a, b, self.real(0.1, 0.5));
        let period = size * self.log(0.1, 0.6);
        match self.int(0, 13) {
            0..=5 => self.plain(a),
            6 => self.paint(Pattern::Cloud, a, near, period),
            7 => self.paint(Pattern::Stripe, a, near, 0.3 * period),
            8 => self.paint(Pattern::Tile, a, near, period),
            9 => self.paint(Pattern::Brick, a, b, period),
            10 | 11 => self.wood(),
            12 => self.paint(Pattern::Speckle, a, near, 0.1 * period),
            _ => self.paint(Pattern::Checker, a, b, period),
        }
    }

    pub fn wood(&mut self) -> Paint {
        let v = self.real(0.25, 0.8);
        let a = mul([1.0, self.real(0.66, 0.82), self.real(0.38, 0.62)], v);
        let b = mul(a, self.real(0.55, 0.9));
        let period = self.log(0.04, 0.16);
        self.paint(Pattern::Wood, a, b, period)
    }

    pub fn floor(&mut self) -> Paint {
        let (a, b) = (self.calm(), self.calm());
        let near = mix(a, b, self.real(0.15, 0.6));
        let period = self.log(0.1, 0.7);
        match self.int(0, 9) {
            0 | 1 => self.wood(),
            2 => self.paint(Pattern::Tile, a, b, period),
            3 => self.paint(Pattern::Checker, a, b, period),
            4 => self.paint(Pattern::Cloud, a, near, period),
            5 => self.paint(Pattern::Speckle, a, near, 0.05 * period),
            6 => self.paint(Pattern::Stripe, a, near, 0.2 * period),
            _ => self.plain(a),
        }
    }

    /// Small things of about `size` metres.
    pub fn thing(&mut self, size: f32) -> Paint {
        let (a, b) = (self.vivid(), self.vivid());
        match self.int(0, 11) {
            0..=3 => self.plain(a),
            4..=6 => self.paint(Pattern::Print, a, b, size),
            7 => self.paint(Pattern::Stripe, a, b, 0.15 * size),
            8 => self.paint(Pattern::Checker, a, b, 0.3 * size),
            9 => self.paint(Pattern::Cloud, a, b, 0.5 * size),
            10 => self.paint(Pattern::Text, a, b, 0.1 * size),
            _ => self.paint(Pattern::Speckle, a, b, 0.08 * size),
        }
    }

    fn put(&mut self, kind: Kind, place: &Place, centre: V3, half: V3, material: Paint) {
        let half = half.map(|h| h.max(1e-5));
        self.solids.push(Solid { kind, centre: place.point(centre), half, axes: place.axes, material });
    }

    pub fn cuboid(&mut self, place: &Place, centre: V3, half: V3, material: Paint) {
        self.put(Kind::Cuboid, place, centre, half, material);
    }

    pub fn ball(&mut self, place: &Place, centre: V3, half: V3, material: Paint) {
        self.put(Kind::Ellipsoid, place, centre, half, material);
    }

    /// Upright; `top` is the upper radius relative to the lower one.
    pub fn tube(
        &mut self,
        place: &Place,
        centre: V3,
        radius: f32,
        half_height: f32,
        top: f32,
        material: Paint,
    ) {
        self.put(Kind::Frustum { top }, place, centre, [radius, half_height, radius], material);
    }

    /// A cuboid without the part beyond a plane (unit frame).
    pub fn cut(&mut self, place: &Place, centre: V3, half: V3, normal: V3, offset: f32, material: Paint) {
        self.put(Kind::Cut { normal, offset }, place, centre, half, material);
    }

    /// A round bar between two local points.
    pub fn bar(&mut self, place: &Place, from: V3, to: V3, radius: f32, material: Paint) {
        let d = sub(to, from);
        let length = norm(d).max(1e-6);
        let y = mul(d, 1.0 / length);
        let x = if y[1].abs() < 0.9 { unit([y[2], 0.0, -y[0]]) } else { [1.0, 0.0, 0.0] };
        let x = unit(sub(x, mul(y, dot(x, y))));
        let z = [y[1] * x[2] - y[2] * x[1], y[2] * x[0] - y[0] * x[2], y[0] * x[1] - y[1] * x[0]];
        let inner = Place { at: place.point(mix(from, to, 0.5)), axes: compose(&[x, y, z], &place.axes) };
        self.tube(&inner, [0.0; 3], radius, 0.5 * length, 1.0, material);
    }

    pub fn world(&self) -> Place {
        Place { at: [0.0; 3], axes: UPRIGHT }
    }

    pub fn lamp(&mut self, at: V3, strength: f32, reach: f32) {
        let warm = self.real(-0.1, 0.35);
        let colour = mul([1.0, 1.0 - 0.4 * warm, 1.0 - warm], strength);
        self.lights.push(Light { at, colour, reach });
    }
}
