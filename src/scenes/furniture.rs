//! Things that stand in rooms, built from solids.

use std::f32::consts::TAU;

use super::space::{mix, mul};
use super::stage::{Place, Stage};
use super::texture::Pattern;

/// A horizontal rectangle on which things may stand: frame at its centre and half sizes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Top {
    pub place: Place,
    pub half: [f32; 2],
}

impl Stage {
    pub fn table(&mut self, place: &Place, half: [f32; 2], height: f32) -> Top {
        let top = if self.chance(0.6) { self.wood() } else { self.surface(1.0) };
        let dark = self.calm();
        let leg = self.plain(dark);
        let thick = self.real(0.012, 0.03);
        self.cuboid(place, [0.0, height - thick, 0.0], [half[0], thick, half[1]], top);
        let (x, z) = (half[0] * self.real(0.75, 0.95), half[1] * self.real(0.7, 0.95));
        let r = self.real(0.012, 0.045);
        let under = 0.5 * (height - 2.0 * thick);
        match self.int(0, 3) {
            0 => {
                for (sx, sz) in [(1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)] {
                    self.tube(place, [sx * x, under, sz * z], r, under, 1.0, leg);
                }
            }
            1 => {
                for sx in [-1.0, 1.0] {
                    self.cuboid(place, [sx * x, under, 0.0], [r, under, z], top);
                }
            }
            2 => {
                self.tube(place, [0.0, under, 0.0], 1.5 * r, under, 1.0, leg);
                self.tube(place, [0.0, 0.02, 0.0], 0.7 * half[1], 0.02, 0.5, leg);
            }
            _ => {
                for (sx, sz) in [(1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)] {
                    self.cuboid(place, [sx * x, under, sz * z], [r, under, r], leg);
                }
                if self.chance(0.5) {
                    self.drawers(
                        &place.inner([0.6 * half[0], 0.0, 0.0], 0.0),
                        [0.3 * half[0], 0.8 * half[1]],
                        1.6 * under,
                    );
                }
            }
        }
        Top { place: place.inner([0.0, height, 0.0], 0.0), half }
    }

    /// A closed cabinet with visible fronts and handles.
    pub fn drawers(&mut self, place: &Place, half: [f32; 2], height: f32) -> Top {
        let body = self.surface(1.0);
        let front = if self.chance(0.5) { body } else { self.surface(1.0) };
        let metal = [self.real(0.05, 0.7); 3];
        let handle = self.plain(metal);
        self.cuboid(place, [0.0, 0.5 * height, 0.0], [half[0], 0.5 * height, half[1]], body);
        let (columns, rows) = (self.int(1, 3), self.int(1, 5));
        let cell = [half[0] / columns as f32, 0.5 * height / rows as f32];
        for i in 0..columns {
            for j in 0..rows {
                let x = (2 * i + 1) as f32 * cell[0] - half[0];
                let y = (2 * j + 1) as f32 * cell[1];
                self.cuboid(place, [x, y, -half[1]], [0.96 * cell[0], 0.96 * cell[1], 0.008], front);
                self.cuboid(
                    place,
                    [x, y + 0.5 * cell[1], -half[1] - 0.02],
                    [0.3 * cell[0].min(0.3), 0.006, 0.012],
                    handle,
                );
            }
        }
        Top { place: place.inner([0.0, height, 0.0], 0.0), half }
    }

    pub fn shelf(&mut self, place: &Place, half: [f32; 2], height: f32) {
        let body = if self.chance(0.5) { self.wood() } else { self.surface(1.0) };
        let t = self.real(0.008, 0.02);
        for sx in [-1.0, 1.0] {
            self.cuboid(place, [sx * half[0], 0.5 * height, 0.0], [t, 0.5 * height, half[1]], body);
        }
        if self.chance(0.7) {
            self.cuboid(place, [0.0, 0.5 * height, half[1]], [half[0], 0.5 * height, t], body);
        }
        let boards = self.int(2, 6);
        for k in 0..=boards {
            let y = height * k as f32 / boards as f32;
            self.cuboid(place, [0.0, y, 0.0], [half[0], t, half[1]], body);
            if k < boards {
                let room = height / boards as f32 - 2.0 * t;
                self.row(&place.inner([0.0, y + t, 0.0], 0.0), half, room);
            }
        }
    }

    /// Books and boxes side by side.
    fn row(&mut self, place: &Place, half: [f32; 2], room: f32) {
        let mut x = -0.95 * half[0];
        let books = self.chance(0.6);
        for _ in 0..24 {
            let w = if books { self.real(0.008, 0.03) } else { self.real(0.03, 0.14) };
            if x + 2.0 * w > 0.95 * half[0] {
                break;
            }
            if self.chance(0.85) {
                let h = 0.5 * room * self.real(0.5, 0.92);
                let d = half[1] * self.real(0.5, 0.9);
                let m = self.thing(2.0 * h);
                if books || self.chance(0.6) {
                    self.cuboid(place, [x + w, h, d - 0.9 * half[1]], [0.95 * w, h, d], m);
                } else {
                    self.tube(place, [x + w, h, 0.0], w, h, 1.0, m);
                }
            }
            x += 2.0 * w + if self.chance(0.15) { self.real(0.02, 0.2) } else { 0.0 };
        }
    }

    pub fn chair(&mut self, place: &Place) {
        let (cloth, dark) = (self.vivid(), [self.real(0.02, 0.3); 3]);
        let seat = if self.chance(0.3) {
            self.wood()
        } else {
            self.paint(Pattern::Cloud, cloth, mul(cloth, 0.7), 0.02)
        };
        let frame = self.plain(dark);
        let (w, d, h) = (self.real(0.19, 0.27), self.real(0.19, 0.26), self.real(0.4, 0.5));
        let soft = self.chance(0.5);
        let t = if soft { self.real(0.04, 0.07) } else { 0.02 };
        let tall = self.real(0.18, 0.35);
        let lean = self.real(-0.3, 0.0);
        let back = place.tilted([0.0, h + tall, d], 0.0, lean, 0.0);
        if soft {
            self.ball(place, [0.0, h, 0.0], [1.15 * w, t, 1.15 * d], seat);
            self.ball(&back, [0.0, 0.05, 0.0], [1.1 * w, tall, t], seat);
        } else {
            self.cuboid(place, [0.0, h, 0.0], [w, t, d], seat);
            self.cuboid(&back, [0.0, 0.05, 0.0], [w, 0.7 * tall, t], seat);
        }
        self.bar(place, [0.0, h, d], [0.0, h + tall, d + 0.02], 0.02, frame);
        if self.chance(0.5) {
            self.tube(place, [0.0, 0.5 * h, 0.0], 0.025, 0.5 * h, 1.0, frame);
            for k in 0..5 {
                let (s, c) = (k as f32 * 1.2566).sin_cos();
                self.bar(place, [0.0, 0.1, 0.0], [0.3 * c, 0.05, 0.3 * s], 0.02, frame);
                self.ball(place, [0.3 * c, 0.03, 0.3 * s], [0.03; 3], frame);
            }
            if self.chance(0.5) {
                for s in [-1.0, 1.0] {
                    self.bar(place, [s * w, h, 0.0], [s * 1.15 * w, h + 0.2, 0.0], 0.015, frame);
                    self.cuboid(place, [s * 1.15 * w, h + 0.21, 0.0], [0.03, 0.015, 0.6 * d], frame);
                }
            }
        } else {
            for (sx, sz) in [(1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)] {
                self.bar(place, [sx * 0.9 * w, h, sz * 0.9 * d], [sx * w, 0.0, sz * d], 0.014, frame);
            }
        }
    }

    pub fn sofa(&mut self, place: &Place) {
        let (a, b) = (self.vivid(), self.calm());
        let cloth = self.paint(Pattern::Cloud, a, mix(a, b, 0.3), 0.05);
        let w = self.real(0.4, 1.1);
        self.cuboid(place, [0.0, 0.2, 0.0], [w, 0.2, 0.42], cloth);
        self.ball(place, [0.0, 0.42, -0.05], [w, 0.1, 0.42], cloth);
        let back = place.tilted([0.0, 0.5, 0.38], 0.0, -0.2, 0.0);
        self.cuboid(&back, [0.0, 0.1, 0.0], [w, 0.3, 0.1], cloth);
        for s in [-1.0, 1.0] {
            self.cuboid(place, [s * w, 0.3, 0.0], [0.1, 0.3, 0.42], cloth);
            if self.chance(0.5) {
                let tilt = self.real(-0.5, 0.5);
                let pillow = place.tilted([0.6 * s * w, 0.62, 0.15], 0.0, -0.4, tilt);
                let m = self.thing(0.4);
                self.ball(&pillow, [0.0; 3], [0.22, 0.2, 0.08], m);
            }
        }
    }

    pub fn monitor(&mut self, place: &Place) {
        let (w, h, y) = (self.real(0.18, 0.34), self.real(0.13, 0.2), self.real(0.22, 0.4));
        let case_colour = [self.real(0.02, 0.5); 3];
        let case = self.plain(case_colour);
        let (a, b) = (self.vivid(), self.vivid());
        let screen =
            if self.chance(0.5) { self.plain([0.02; 3]) } else { self.paint(Pattern::Print, a, b, 0.3) };
        self.materials[screen as usize].glow = self.real(0.0, 0.8);
        self.materials[screen as usize].gloss = 0.2;
        self.cuboid(place, [0.0, y, 0.0], [w, h, 0.02], case);
        self.cuboid(place, [0.0, y, -0.015], [0.94 * w, 0.92 * h, 0.008], screen);
        self.cuboid(place, [0.0, 0.5 * y, 0.03], [0.03, 0.5 * y, 0.012], case);
        self.cuboid(place, [0.0, 0.008, 0.02], [0.12, 0.008, 0.09], case);
    }

    pub fn keyboard(&mut self, place: &Place) {
        let (a, b) = ([self.real(0.02, 0.8); 3], [self.real(0.02, 0.8); 3]);
        let body = self.plain(a);
        let keys = self.paint(Pattern::Tile, b, mul(a, 0.5), 0.019);
        self.cuboid(place, [0.0, 0.008, 0.0], [0.22, 0.008, 0.07], body);
        self.cuboid(place, [0.0, 0.014, 0.0], [0.21, 0.005, 0.06], keys);
        self.ball(place, [0.3, 0.012, 0.0], [0.03, 0.018, 0.05], body);
    }

    pub fn desk_lamp(&mut self, place: &Place) {
        let c = self.vivid();
        let m = self.plain(c);
        let (h, r) = (self.real(0.2, 0.5), self.real(-0.25, 0.25));
        self.tube(place, [0.0, 0.01, 0.0], 0.08, 0.01, 0.9, m);
        self.bar(place, [0.0; 3], [r, h, 0.0], 0.007, m);
        self.bar(place, [r, h, 0.0], [-r, h + 0.15, 0.0], 0.007, m);
        let head = place.tilted([-r, h + 0.13, 0.0], 0.0, 0.3, r);
        self.tube(&head, [0.0; 3], 0.09, 0.06, 0.35, m);
    }

    pub fn plant(&mut self, place: &Place, size: f32) {
        let c = self.calm();
        let pot = self.plain(c);
        let green = [self.real(0.03, 0.25), self.real(0.2, 0.5), self.real(0.02, 0.15)];
        let leaf = self.paint(Pattern::Leaves, mul(green, 0.35), green, 0.12 * size);
        self.tube(place, [0.0, 0.15 * size, 0.0], 0.13 * size, 0.15 * size, 1.3, pot);
        let count = self.int(6, 16);
        for _ in 0..count {
            let (yaw, pitch) = (self.real(0.0, TAU), self.real(0.2, 1.4));
            let long = size * self.real(0.15, 0.4);
            let twig = place.tilted([0.0, 0.3 * size, 0.0], yaw, pitch, 0.0);
            self.ball(&twig, [0.0, 0.0, long], [0.25 * long, 0.04 * long, long], leaf);
        }
    }

    pub fn person(&mut self, place: &Place) {
        let (a, b) = (self.vivid(), self.vivid());
        let (shirt, legs) = (self.thing(0.4), self.plain(b));
        let skin = [self.real(0.25, 0.85), self.real(0.2, 0.6), self.real(0.15, 0.5)];
        let (skin, hair) = (self.plain(skin), self.plain(mul(a, 0.2)));
        let h = self.real(0.85, 1.1);
        let stride = self.real(-0.3, 0.3);
        for s in [-1.0, 1.0] {
            self.bar(place, [0.1 * s, 0.9 * h, 0.0], [0.12 * s, 0.05, s * stride], 0.075, legs);
            self.ball(place, [0.12 * s, 0.05, s * stride - 0.06], [0.05, 0.05, 0.13], hair);
            let swing = self.real(-0.3, 0.3);
            self.bar(place, [0.2 * s, 1.4 * h, 0.0], [0.3 * s, 0.95 * h, swing], 0.05, shirt);
            self.ball(place, [0.3 * s, 0.9 * h, swing], [0.05; 3], skin);
        }
        self.ball(place, [0.0, 1.2 * h, 0.0], [0.22, 0.36 * h, 0.14], shirt);
        self.ball(place, [0.0, 1.63 * h, 0.0], [0.09, 0.13, 0.11], skin);
        self.ball(place, [0.0, 1.66 * h, 0.02], [0.095, 0.12, 0.11], hair);
    }
}
