//! Small things of every shape, for the surfaces that furniture offers and for the air.

use std::f32::consts::{FRAC_PI_2, TAU};

use super::furniture::Top;
use super::space::{UPRIGHT, V3};
use super::stage::{Paint, Place, Stage};
use super::texture::Pattern;

impl Stage {
    /// Spreads things of about `size` metres over a surface, some on top of each other.
    pub fn clutter(&mut self, top: &Top, count: usize, size: f32) {
        for _ in 0..count {
            let (x, z) = (self.real(-0.95, 0.95) * top.half[0], self.real(-0.95, 0.95) * top.half[1]);
            let yaw = self.real(0.0, TAU);
            let s = size * self.log(0.35, 1.6);
            let place = top.place.inner([x, 0.0, z], yaw);
            self.object(&place, s);
        }
    }

    /// One thing of about `s` metres standing at the frame's origin.
    pub fn object(&mut self, place: &Place, s: f32) {
        let m = self.thing(s);
        match self.int(0, 15) {
            0..=2 => self.parcel(place, s, m),
            3 => {
                let r = 0.5 * s * self.real(0.5, 1.0);
                self.ball(place, [0.0, r, 0.0], [r; 3], m);
            }
            4 => {
                let (r, h) = (0.35 * s, 0.5 * s * self.real(0.6, 1.4));
                self.tube(place, [0.0, h, 0.0], r, h, 1.0, m);
                let lid = self.real(0.3, 0.8);
                let lid = self.plain([lid; 3]);
                self.tube(place, [0.0, 2.0 * h, 0.0], 0.96 * r, 0.01 * s, 1.0, lid);
            }
            5 | 6 => self.bottle(place, s, m),
            7 => self.mug(place, 0.6 * s, m),
            8 => {
                let text = self.paint(Pattern::Text, [0.8; 3], [0.1; 3], 0.05 * s + 0.004);
                let m = if self.chance(0.5) { text } else { m };
                self.cuboid(place, [0.0, 0.002, 0.0], [0.7 * s, 0.002, s], m);
            }
            9 => self.books(place, s),
            10 => {
                let lying = place.tilted([0.0, 0.25 * s, 0.0], 0.0, 0.0, FRAC_PI_2);
                let taper = self.real(0.5, 1.0);
                let long = s * self.pick(&[0.4, 0.8]);
                self.tube(&lying, [0.0; 3], 0.25 * s, long, taper, m);
            }
            11 => {
                let top = self.real(0.0, 0.5);
                self.tube(place, [0.0, 0.5 * s, 0.0], 0.4 * s, 0.5 * s, top, m);
            }
            12 => {
                let normal = [self.real(-1.0, 1.0), self.real(0.2, 1.0), self.real(-0.3, 0.3)];
                let half = [0.5 * s, 0.4 * s, 0.4 * s];
                self.cut(place, [0.0, 0.4 * s, 0.0], half, normal, corner_offset(normal), m);
            }
            13 => {
                // A curved thing: fruit, tool handle.
                for k in 0..4 {
                    let a = 0.4 * k as f32 - 0.6;
                    let p = [0.6 * s * a.sin(), 0.15 * s, 0.6 * s * (1.0 - a.cos())];
                    let bent = place.tilted(p, -a, 0.0, 0.0);
                    self.ball(&bent, [0.0; 3], [0.2 * s, 0.13 * s, 0.13 * s], m);
                }
            }
            14 => {
                // A slack bag.
                for _ in 0..3 {
                    let p = [self.real(-0.2, 0.2) * s, 0.3 * s, self.real(-0.2, 0.2) * s];
                    let half = [s * self.real(0.3, 0.5), s * self.real(0.25, 0.4), s * self.real(0.2, 0.4)];
                    let lean = self.real(-0.5, 0.5);
                    self.ball(&place.tilted(p, lean, lean, 0.5 * lean), [0.0; 3], half, m);
                }
            }
            _ => {
                let (lean, around) = (self.real(-0.6, 0.6), self.real(-0.6, 0.6));
                let radius = s * self.log(0.02, 0.08);
                self.bar(place, [0.0; 3], [s * lean, 1.5 * s, s * around], radius, m);
            }
        }
    }

    fn parcel(&mut self, place: &Place, s: f32, m: Paint) {
        let half = [0.5 * s * self.log(0.4, 1.3), 0.5 * s * self.log(0.3, 1.5), 0.5 * s * self.log(0.3, 1.0)];
        let place = if self.chance(0.15) {
            let roll = self.real(-0.4, 0.4);
            place.tilted([0.0, 0.2 * s, 0.0], 0.0, 0.2, roll)
        } else {
            *place
        };
        self.cuboid(&place, [0.0, half[1], 0.0], half, m);
        if self.chance(0.4) {
            let label = self.thing(s);
            let inner = [half[0] * self.real(0.3, 0.8), half[1] * self.real(0.3, 0.8), half[2] + 0.0006];
            self.cuboid(&place, [0.0, half[1], 0.0], inner, label);
        }
        if self.chance(0.3) {
            let yaw = self.real(-0.5, 0.5);
            let size = s * self.real(0.3, 0.7);
            self.object_small(&place.inner([0.0, 2.0 * half[1], 0.0], yaw), size);
        }
    }

    /// Something on top of something, without going on for ever.
    fn object_small(&mut self, place: &Place, s: f32) {
        let m = self.thing(s);
        match self.int(0, 2) {
            0 => self.cuboid(place, [0.0, 0.3 * s, 0.0], [0.5 * s, 0.3 * s, 0.4 * s], m),
            1 => self.ball(place, [0.0, 0.4 * s, 0.0], [0.4 * s; 3], m),
            _ => self.tube(place, [0.0, 0.5 * s, 0.0], 0.3 * s, 0.5 * s, 1.0, m),
        }
    }

    fn bottle(&mut self, place: &Place, s: f32, m: Paint) {
        let (r, h) = (0.22 * s, 0.45 * s);
        let cap = self.vivid();
        let cap = self.plain(cap);
        self.tube(place, [0.0, h, 0.0], r, h, 1.0, m);
        let neck = self.real(0.25, 0.5);
        self.tube(place, [0.0, 2.0 * h + 0.15 * s, 0.0], r, 0.15 * s, neck, m);
        self.tube(place, [0.0, 2.0 * h + 0.36 * s, 0.0], neck * r, 0.06 * s, 1.0, cap);
        if self.chance(0.5) {
            let label = self.thing(s);
            self.tube(place, [0.0, h, 0.0], 1.01 * r, 0.5 * h, 1.0, label);
        }
    }

    fn mug(&mut self, place: &Place, s: f32, m: Paint) {
        let taper = self.real(0.9, 1.35);
        self.tube(place, [0.0, 0.5 * s, 0.0], 0.4 * s, 0.5 * s, taper, m);
        let inside = self.plain([0.06, 0.04, 0.03]);
        self.tube(place, [0.0, s, 0.0], 0.36 * s * taper, 0.003 * s, 1.0, inside);
        for (y, r) in [(0.3, 0.5), (0.5, 0.62), (0.7, 0.55)] {
            self.ball(place, [r * s, y * s, 0.0], [0.1 * s, 0.13 * s, 0.06 * s], m);
        }
    }

    fn books(&mut self, place: &Place, s: f32) {
        let mut y = 0.0;
        for _ in 0..self.int(1, 5) {
            let t = s * self.real(0.03, 0.12);
            let m = self.thing(s);
            let yaw = self.real(-0.3, 0.3);
            let half = [s * self.real(0.45, 0.7), t, s * self.real(0.35, 0.5)];
            self.cuboid(&place.inner([0.0, y, 0.0], yaw), [0.0, t, 0.0], half, m);
            y += 2.0 * t;
        }
    }

    /// Solids of any kind, size and attitude, in the air.
    pub fn anything(&mut self, at: V3, size: f32) {
        let (yaw, pitch, roll) = (self.real(0.0, TAU), self.real(-1.5, 1.5), self.real(-3.1, 3.1));
        let place = Place { at, axes: UPRIGHT }.tilted([0.0; 3], yaw, pitch, roll);
        let m = if self.chance(0.5) { self.surface(size) } else { self.thing(size) };
        let half = [size * self.log(0.05, 1.0), size * self.log(0.1, 1.0), size * self.log(0.1, 1.0)];
        match self.int(0, 4) {
            0 | 1 => self.cuboid(&place, [0.0; 3], half, m),
            2 => self.ball(&place, [0.0; 3], half, m),
            3 => {
                let top = self.real(0.0, 1.5);
                self.tube(&place, [0.0; 3], half[0], half[1], top, m);
            }
            _ => {
                let n = [self.real(-1.0, 1.0), self.real(-1.0, 1.0), self.real(-1.0, 1.0)];
                self.cut(&place, [0.0; 3], half, n, 0.4 * corner_offset(n), m);
            }
        }
    }
}

/// An offset at which a plane of this normal cuts a corner off the unit cube.
fn corner_offset(n: V3) -> f32 {
    0.35 * (n[0].abs() + n[1].abs() + n[2].abs())
}
