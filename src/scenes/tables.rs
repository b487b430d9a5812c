//! Rooms seen from near: work places, and table tops with many small things.

use std::f32::consts::TAU;

use super::furniture::Top;
use super::stage::{Place, Stage};
use crate::depth::Intrinsics;

impl Stage {
    /// A work place seen from standing or sitting height.
    pub fn desk(&mut self, k: Intrinsics) {
        let size = [self.real(1.5, 4.0), self.real(2.3, 3.2), self.real(1.5, 4.0)];
        self.shell(size);
        let distance = self.log(0.5, 1.8);
        let (half, height) = ([self.real(0.6, 1.1), self.real(0.3, 0.5)], self.real(0.68, 0.78));
        let yaw = self.real(-0.7, 0.7);
        let place = Place::new([0.0, 0.0, 0.3], yaw);
        let top = self.table(&place, half, height);
        if self.chance(0.5) {
            let m = self.surface(1.0);
            let tall = self.real(0.55, 0.8);
            self.cuboid(&place, [0.0, tall, half[1] + 0.04], [1.1 * half[0], tall, 0.025], m);
        }
        for _ in 0..self.int(0, 3) {
            let (x, turn) = (self.real(-0.8, 0.8) * half[0], self.real(-0.5, 0.5));
            self.monitor(&top.place.inner([x, 0.0, 0.4 * half[1]], turn));
        }
        if self.chance(0.7) {
            let (x, turn) = (self.real(-0.5, 0.5) * half[0], self.real(-0.3, 0.3));
            self.keyboard(&top.place.inner([x, 0.0, -0.4 * half[1]], turn));
        }
        if self.chance(0.4) {
            let x = self.real(-0.8, 0.8) * half[0];
            self.desk_lamp(&top.place.inner([x, 0.0, 0.0], 0.7));
        }
        let (n, s) = (self.int(4, 26), self.log(0.09, 0.26));
        self.clutter(&top, n, s);
        for _ in 0..self.int(0, 2) {
            let (x, turn) = (self.real(-0.8, 0.8) * half[0], self.real(0.0, TAU));
            let gap = self.pick(&[0.2, 0.4]);
            self.chair(&place.inner([x, 0.0, -half[1] - gap], turn));
        }
        for _ in 0..self.int(1, 5) {
            let (a, r) = (self.real(-1.4, 1.4), self.real(1.3, 3.0));
            self.furnish(&place.inner([r * a.sin(), 0.0, r * a.cos()], a));
        }
        self.indoor_light(size);
        let around = yaw + self.real(-0.8, 0.8);
        let at = [
            -distance * around.sin(),
            height + self.real(0.15, 0.8),
            0.3 - (distance + half[1]) * around.cos(),
        ];
        let target = [self.real(-0.3, 0.3), height + self.real(-0.3, 0.25), 0.3];
        self.aim(k, at, target, 0.3);
        self.focus = ([0.0, 0.7, 0.3], 1.6);
    }

    /// A close look at many small things on a table or the floor.
    pub fn tabletop(&mut self, k: Intrinsics) {
        let size = [self.real(0.8, 3.0), self.real(1.8, 3.0), self.real(0.8, 3.0)];
        self.shell(size);
        let half = [self.log(0.25, 0.9), self.log(0.25, 0.7)];
        let (height, yaw) = (self.real(0.0, 0.9), self.real(0.0, TAU));
        let place = Place::new([0.0; 3], yaw);
        let top = if height < 0.35 { Top { place, half } } else { self.table(&place, half, height) };
        if self.chance(0.3) {
            // A cloth, a board or a tray.
            let m = self.floor();
            self.cuboid(&top.place, [0.0, 0.002, 0.0], [0.8 * half[0], 0.003, 0.8 * half[1]], m);
        }
        if self.chance(0.25) {
            self.bin(&top);
        }
        let r = self.log(0.35, 1.4);
        // Things are large in the picture, as in close-ups, and crowd where there are many.
        let (n, s) = (self.int(4, 40), r * self.log(0.08, 0.3));
        let inner = Top { place: top.place, half: [0.8 * half[0], 0.8 * half[1]] };
        self.clutter(&inner, n, s);
        for _ in 0..self.int(0, 4) {
            let (a, r) = (self.real(0.0, TAU), self.real(1.1, 2.0));
            let at = [r * a.sin(), 0.0, r * a.cos()];
            self.furnish(&Place::new(at, a));
        }
        self.indoor_light(size);
        let base = top.place.at[1];
        let (a, e) = (self.real(0.0, TAU), self.real(0.15, 1.45));
        let at = [r * e.cos() * a.sin(), base + (r * e.sin()).max(0.08), r * e.cos() * a.cos()];
        let target = [self.real(-0.3, 0.3) * half[0], base + 0.03, self.real(-0.3, 0.3) * half[1]];
        self.aim(k, at, target, 0.25);
        self.focus = ([0.0, base, 0.0], 0.9);
    }

    /// Four sides around part of a surface.
    fn bin(&mut self, top: &Top) {
        let m = self.surface(0.5);
        let (w, d, h) = (0.8 * top.half[0], 0.8 * top.half[1], self.real(0.03, 0.15));
        for s in [-1.0, 1.0] {
            self.cuboid(&top.place, [s * w, h, 0.0], [0.008, h, d], m);
            self.cuboid(&top.place, [0.0, h, s * d], [w, h, 0.008], m);
        }
    }
}
