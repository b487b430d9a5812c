//! Indoor scenes: furnished rooms, halls, and solids in free arrangement.

use std::f32::consts::{FRAC_PI_2, TAU};

use super::camera::Camera;
use super::furniture::Top;
use super::space::{V3, mul};
use super::stage::{Place, Stage};
use super::texture::Pattern;
use crate::depth::Intrinsics;

/// Inner size of a room: half width, height, half length. Its floor's centre is the origin.
type Size = [f32; 3];

impl Stage {
    /// Puts the camera at `at`, towards `target`, with some disorder in its attitude.
    pub fn aim(&mut self, k: Intrinsics, at: V3, target: V3, disorder: f32) {
        let d = super::space::sub(target, at);
        let yaw = d[0].atan2(d[2]) + disorder * self.real(-0.5, 0.5);
        let pitch = d[1].atan2((d[0] * d[0] + d[2] * d[2]).sqrt()) + disorder * self.real(-0.3, 0.3);
        let roll =
            if self.chance(0.7) { self.real(-0.06, 0.06) } else { self.real(-0.5, 0.5) * disorder.min(1.0) };
        self.camera = Camera::new(k, at, yaw, pitch, roll);
    }

    pub fn indoor_light(&mut self, size: Size) {
        // Some rooms are dark but for what stands near a lamp.
        let level = if self.chance(0.15) { self.real(0.02, 0.1) } else { self.real(0.15, 0.6) };
        self.ambient = mul([1.0, self.real(0.9, 1.05), self.real(0.75, 1.15)], level);
        for _ in 0..self.int(1, 3) {
            let at = [
                self.real(-0.9, 0.9) * size[0],
                self.real(0.75, 0.97) * size[1],
                self.real(-0.9, 0.9) * size[2],
            ];
            let (strength, reach) = (self.real(0.3, 1.2), size[1] * self.real(0.5, 2.5));
            self.lamp(at, strength, reach);
        }
    }

    /// A wall from (x0, z0) to (x1, z1) of the given height, perhaps with an opening; its inner face is on the line.
    fn wall(&mut self, from: [f32; 2], to: [f32; 2], height: f32, m: super::stage::Paint, open: bool) {
        let (dx, dz) = (to[0] - from[0], to[1] - from[1]);
        let length = (dx * dx + dz * dz).sqrt();
        let place = Place::new([0.5 * (from[0] + to[0]), 0.0, 0.5 * (from[1] + to[1])], (-dz).atan2(dx));
        let t = 0.06;
        let half = 0.5 * length;
        if open {
            let (w, c) = (self.real(0.4, 0.9).min(0.4 * half), self.real(-0.5, 0.5) * half);
            let (y0, y1) =
                if self.chance(0.6) { (0.0, 0.8 * height) } else { (0.35 * height, 0.85 * height) };
            for (a, b, low, high) in [
                (-half, c - w, 0.0, height),
                (c + w, half, 0.0, height),
                (c - w, c + w, 0.0, y0),
                (c - w, c + w, y1, height),
            ] {
                if b - a > 0.01 && high - low > 0.01 {
                    self.cuboid(
                        &place,
                        [0.5 * (a + b), 0.5 * (low + high), t],
                        [0.5 * (b - a), 0.5 * (high - low), t],
                        m,
                    );
                }
            }
            let frame = self.wood();
            for s in [-1.0, 1.0] {
                self.cuboid(&place, [c + s * w, 0.5 * (y0 + y1), 0.0], [0.04, 0.5 * (y1 - y0), 0.08], frame);
            }
            self.cuboid(&place, [c, y1, 0.0], [w, 0.04, 0.08], frame);
            if y0 == 0.0 && self.chance(0.5) {
                // The door leaf, ajar.
                let swing = self.real(0.2, 2.2);
                let leaf = self.surface(1.0);
                let hinge = place.inner([c - w, 0.0, -0.05], swing);
                self.cuboid(&hinge, [w, 0.5 * y1, 0.0], [w, 0.5 * y1, 0.02], leaf);
            }
        } else {
            self.cuboid(&place, [0.0, 0.5 * height, t], [half, 0.5 * height, t], m);
        }
        self.decorate(&place, half, height);
    }

    /// Flat and nearly flat things on a wall.
    fn decorate(&mut self, place: &Place, half: f32, height: f32) {
        if self.chance(0.5) {
            let c = self.calm();
            let skirting = self.plain(c);
            self.cuboid(place, [0.0, 0.04, 0.0], [half, 0.05, 0.012], skirting);
        }
        for _ in 0..self.int(0, 4) {
            let (w, h) = (self.log(0.1, 0.6), self.log(0.1, 0.5));
            let at = [self.real(-0.9, 0.9) * half, self.real(0.35, 0.85) * height, 0.0];
            let thick = self.pick(&[0.002, 0.002, 0.02, 0.05]);
            let (a, b) = (self.vivid(), self.vivid());
            let m = if self.chance(0.7) { self.paint(Pattern::Print, a, b, w) } else { self.thing(w) };
            self.cuboid(place, at, [w, h, thick], m);
        }
        if self.chance(0.15) {
            // A radiator or a curtain.
            let c = self.calm();
            let m = self.plain(c);
            let (n, r) = (self.int(6, 16), self.real(0.025, 0.06));
            let (x, tall) = (self.real(-0.6, 0.6) * half, self.pick(&[0.15, 0.45]) * height);
            for i in 0..n {
                self.tube(place, [x + 1.9 * r * i as f32, tall + 0.1, -r], r, tall, 1.0, m);
            }
        }
    }

    /// Walls, floor and ceiling, and a farther room behind, so that openings show something.
    pub fn shell(&mut self, size: Size) {
        let [w, h, l] = size;
        let world = self.world();
        let (floor, ceiling, wall) = (self.floor(), self.calm(), self.surface(2.0));
        let ceiling = if self.chance(0.3) {
            self.paint(Pattern::Tile, ceiling, mul(ceiling, 0.7), 0.6)
        } else {
            self.plain(ceiling)
        };
        let far = 3.0 * w.max(l);
        self.cuboid(&world, [0.0, -0.1, 0.0], [far, 0.1, far], floor);
        self.cuboid(&world, [0.0, h + 0.1, 0.0], [far, 0.1, far], ceiling);
        let corners = [[-w, l], [w, l], [w, -l], [-w, -l]];
        for k in 0..4 {
            let m = if self.chance(0.25) { self.surface(2.0) } else { wall };
            let open = self.chance(0.4);
            self.wall(corners[k], corners[(k + 1) % 4], h, m, open);
        }
        let back = self.surface(3.0);
        for (x, z) in [(far, 0.0), (-far, 0.0), (0.0, far), (0.0, -far)] {
            let reach = self.real(0.45, 1.0);
            let half = [if x == 0.0 { far } else { 0.1 }, h, if z == 0.0 { far } else { 0.1 }];
            self.cuboid(&world, [reach * x, 0.0, reach * z], half, back);
        }
        for _ in 0..self.int(0, 5) {
            let (a, r) = (self.real(0.0, TAU), self.real(0.5, 0.9) * far);
            let place = Place::new([r * a.sin(), 0.0, r * a.cos()], a);
            if place.at[0].abs() > w + 0.6 || place.at[2].abs() > l + 0.6 {
                self.furnish(&place);
            }
        }
        if self.chance(0.3) {
            // Ceiling lamps.
            let lamp = self.plain([0.9; 3]);
            self.materials[lamp as usize].glow = self.real(0.5, 3.0);
            let z = self.real(-0.5, 0.8) * l;
            let wide = self.log(0.1, 0.7);
            self.cuboid(&world, [0.0, h - 0.03, z], [wide, 0.03, 0.1], lamp);
        }
    }

    /// One piece of furniture with its front towards -z of the frame.
    pub fn furnish(&mut self, place: &Place) {
        match self.int(0, 11) {
            0..=2 => {
                let (half, height) = ([self.real(0.4, 0.9), self.real(0.25, 0.45)], self.real(0.4, 1.05));
                let top = self.table(place, half, height);
                let (n, s) = (self.int(2, 14), self.log(0.07, 0.25));
                self.clutter(&top, n, s);
                if self.chance(0.4) {
                    self.monitor(&top.place.inner([0.0, 0.0, 0.1], 0.0));
                }
                if self.chance(0.6) {
                    let yaw = self.real(2.4, 3.9);
                    self.chair(&place.inner([0.0, 0.0, -half[1] - 0.35], yaw));
                }
            }
            3 | 4 => {
                let (half, height) = ([self.real(0.25, 0.7), self.real(0.12, 0.25)], self.real(0.8, 2.2));
                self.shelf(place, half, height);
            }
            5 | 6 => {
                let (half, height) = ([self.real(0.25, 0.8), self.real(0.2, 0.35)], self.real(0.5, 2.1));
                let top = self.drawers(place, half, height);
                if height < 1.4 {
                    let n = self.int(0, 6);
                    self.clutter(&top, n, 0.2);
                }
            }
            7 => {
                let yaw = self.real(-1.0, 1.0);
                self.chair(&place.inner([0.0; 3], yaw));
            }
            8 => self.sofa(place),
            9 => {
                let size = self.log(0.4, 1.6);
                self.plant(place, size);
            }
            10 => {
                let (n, s) = (self.int(1, 5), self.log(0.25, 0.7));
                self.clutter(&Top { place: *place, half: [0.5, 0.4] }, n, s);
            }
            _ => {
                if self.chance(0.5) {
                    self.person(place);
                } else {
                    let c = self.vivid();
                    let m = self.plain(c);
                    let h = self.real(1.0, 1.7);
                    self.tube(place, [0.0, 0.01, 0.0], 0.15, 0.01, 1.0, m);
                    self.bar(place, [0.0; 3], [0.0, h, 0.0], 0.012, m);
                    self.tube(place, [0.0, h, 0.0], 0.2, 0.13, 0.6, m);
                }
            }
        }
    }

    pub fn room(&mut self, k: Intrinsics) {
        let size = [self.real(1.4, 3.5), self.real(2.2, 3.2), self.real(1.6, 4.5)];
        let [w, h, l] = size;
        self.shell(size);
        // Along the walls, fronts to the middle.
        let n = self.int(4, 9);
        for i in 0..n {
            let along = self.real(-0.85, 0.85);
            let depth = self.real(0.25, 0.5);
            let place = match i % 4 {
                0 | 2 => Place::new([along * w, 0.0, l - depth], 0.0),
                1 => Place::new([w - depth, 0.0, along * l], FRAC_PI_2),
                _ => Place::new([depth - w, 0.0, along * l], -FRAC_PI_2),
            };
            self.furnish(&place);
        }
        for _ in 0..self.int(1, 4) {
            let yaw = self.real(0.0, TAU);
            let at = [self.real(-0.6, 0.6) * w, 0.0, self.real(-0.3, 0.7) * l];
            self.furnish(&Place::new(at, yaw));
        }
        self.indoor_light(size);
        let at = [self.real(-0.7, 0.7) * w, self.real(0.4, 0.8) * h.min(2.3), self.real(-0.95, -0.4) * l];
        let target = [self.real(-0.7, 0.7) * w, self.real(0.0, 0.55) * h, self.real(0.2, 1.0) * l];
        self.aim(k, at, target, 0.5);
        self.focus = ([0.0, 0.0, 0.3 * l], 1.2 * w.max(l));
    }

    /// A long corridor or a large hall with columns, doors and steps.
    pub fn hall(&mut self, k: Intrinsics) {
        let size = [self.log(0.9, 8.0), self.log(2.3, 6.0), self.log(5.0, 25.0)];
        let [w, h, l] = size;
        self.shell(size);
        let (column, c) = (self.surface(1.0), self.calm());
        let (r, gap) = (self.real(0.08, 0.35), self.real(2.0, 5.0));
        let round = self.chance(0.5);
        let inset = self.real(0.0, 0.5) * w;
        let door = self.plain(c);
        let doors = self.chance(0.6);
        let mut z = -l;
        while z < l {
            for s in [-1.0, 1.0] {
                if w > 2.0 {
                    let p = [s * (w - inset - r), 0.5 * h, z];
                    if round {
                        let world = self.world();
                        self.tube(&world, p, r, 0.5 * h, 1.0, column);
                    } else {
                        let world = self.world();
                        self.cuboid(&world, p, [r, 0.5 * h, r], column);
                    }
                }
                if doors && self.chance(0.7) {
                    let world = self.world();
                    let deep = self.real(0.01, 0.1);
                    self.cuboid(&world, [s * w, 1.0, z + 0.5 * gap], [deep, 1.0, 0.45], door);
                }
            }
            z += gap;
        }
        if self.chance(0.35) {
            let steps = self.int(3, 14);
            let m = self.surface(1.0);
            let z = self.real(0.0, 0.6) * l;
            for i in 0..steps {
                let y = 0.085 * (i + 1) as f32;
                let world = self.world();
                self.cuboid(&world, [0.0, y, z + 0.3 * i as f32], [0.7 * w, y, 0.15], m);
            }
        }
        for _ in 0..self.int(2, 10) {
            let side = self.pick(&[-1.0f32, 1.0]);
            let at = [side * (w - 0.4) * self.real(0.6, 1.0), 0.0, self.real(-0.5, 0.9) * l];
            self.furnish(&Place::new(at, side * FRAC_PI_2));
        }
        self.indoor_light(size);
        let at = [self.real(-0.6, 0.6) * w, self.real(0.8, 1.9).min(0.8 * h), self.real(-0.9, -0.2) * l];
        let target = [self.real(-0.9, 0.9) * w, self.real(0.1, 0.6) * h, self.real(0.3, 1.0) * l];
        self.aim(k, at, target, 0.4);
        self.focus = ([0.0, 0.0, at[2] + 5.0], 6.0);
    }

    /// Solids in free arrangement before a background.
    pub fn heap(&mut self, k: Intrinsics) {
        let far = self.log(1.5, 12.0);
        let size = [far, 1.2 * far, far];
        self.shell(size);
        let eye = [0.0, 0.5 * far, -0.9 * far];
        for _ in 0..self.int(8, 70) {
            let z = far * self.real(-0.6, 0.95);
            let spread = 0.8 * (z + far);
            let at = [self.real(-0.5, 0.5) * spread, 0.5 * far + self.real(-0.45, 0.45) * spread, z];
            let s = spread * self.log(0.03, 0.25);
            self.anything(at, s);
        }
        for _ in 0..self.int(0, 8) {
            let c = self.vivid();
            let m = self.plain(c);
            let world = self.world();
            let from = [self.real(-1.0, 1.0) * far, self.real(0.0, 1.2) * far, self.real(-0.5, 0.9) * far];
            let to = [self.real(-1.0, 1.0) * far, self.real(0.0, 1.2) * far, self.real(-0.5, 0.9) * far];
            let radius = far * self.log(0.002, 0.02);
            self.bar(&world, from, to, radius, m);
        }
        self.indoor_light(size);
        self.aim(k, eye, [0.0, 0.5 * far, far], 0.5);
        self.focus = ([0.0, 0.4 * far, 0.2 * far], far);
    }
}
