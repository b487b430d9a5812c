//! What moves and stands on roads: cars, vans, buses, bicycles.

use std::f32::consts::FRAC_PI_2;

use super::space::mul;
use super::stage::{Paint, Place, Stage};

/// Paint, glass, tyres and lights of a vehicle.
#[derive(Clone, Copy)]
struct Parts {
    body: Paint,
    glass: Paint,
    dark: Paint,
    white: Paint,
    red: Paint,
}

/// The plane that cuts a box from its front edge below to `z` of its upper side (unit frame), sloping to the front or back.
fn slope(z: f32, front: f32) -> ([f32; 3], f32) {
    let a = 2.0 / (1.0 - z);
    ([0.0, 1.0, front * a], a - 1.0)
}

impl Stage {
    fn vehicle_parts(&mut self) -> Parts {
        let colour = match self.int(0, 6) {
            0 | 1 => [self.real(0.5, 0.8); 3],
            2 | 3 => [self.real(0.02, 0.15); 3],
            4 => [self.real(0.2, 0.45); 3],
            _ => {
                let (s, v) = (self.real(0.5, 0.9), self.real(0.15, 0.5));
                self.hue(s, v)
            }
        };
        let body = self.plain(colour);
        self.materials[body as usize].gloss = 0.45;
        let shade = self.real(0.015, 0.06);
        let glass = self.plain(mul([0.9, 1.0, 1.05], shade));
        self.materials[glass as usize].gloss = 0.7;
        let dark = self.plain([0.03; 3]);
        Parts { body, glass, dark, white: self.plain([0.75; 3]), red: self.plain([0.45, 0.02, 0.02]) }
    }

    /// A vehicle with its front towards z of the place: mostly cars, some vans, a few buses.
    pub(super) fn motor(&mut self, place: &Place) {
        match self.int(0, 11) {
            0..=8 => self.saloon(place),
            9 | 10 => self.van(place),
            _ => self.bus(place),
        }
    }

    fn wheels(&mut self, place: &Place, p: &Parts, at: [f32; 2], radius: f32) {
        for (sx, sz) in [(1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)] {
            let wheel = place.tilted([sx * at[0], radius, sz * at[1]], 0.0, 0.0, FRAC_PI_2);
            self.tube(&wheel, [0.0; 3], radius, 0.11, 1.0, p.dark);
            self.tube(&wheel, [0.0; 3], 0.55 * radius, 0.115, 1.0, p.white);
        }
    }

    /// Lamps, plates and bumpers at both ends: half width, half length, height of the lamps.
    fn ends(&mut self, place: &Place, p: &Parts, w: f32, l: f32, y: f32) {
        for s in [-1.0, 1.0] {
            self.cuboid(place, [s * 0.78 * w, y, -l], [0.1, 0.08, 0.02], p.red);
            self.cuboid(place, [s * 0.74 * w, y - 0.05, l], [0.13, 0.06, 0.02], p.white);
            self.cuboid(place, [0.0, 0.38, s * (l + 0.02)], [0.96 * w, 0.1, 0.06], p.dark);
            self.cuboid(place, [0.0, 0.5, s * (l + 0.04)], [0.26, 0.055, 0.045], p.white);
        }
    }

    /// A hatchback, saloon, estate or off-roader.
    fn saloon(&mut self, place: &Place) {
        let p = self.vehicle_parts();
        let (l, w) = (self.real(1.8, 2.45), self.real(0.82, 0.95));
        let (waist, roof) = (self.real(0.86, 1.08), self.real(1.4, 1.78));
        let floor = self.real(0.18, 0.3);
        let bonnet = self.real(0.42, 0.6) * l;
        // Where the roof ends, and how steep the back is.
        let boot = if self.chance(0.4) { self.real(0.45, 0.65) * l } else { 0.95 * l };
        let middle = 0.5 * (bonnet - l);
        let (half, high) = (0.5 * (bonnet + l), 0.5 * (waist - floor));
        self.cuboid(place, [0.0, floor + high, middle], [w, high, half], p.body);
        let nose = [0.0, floor + high, 0.5 * (bonnet + l)];
        let (n, o) = slope(0.75, 1.0);
        self.cut(place, nose, [0.98 * w, 0.95 * high, 0.5 * (l - bonnet)], n, o, p.body);
        let (glass, top) = (0.5 * (roof - waist), 0.5 * (roof + waist));
        // The glass house: screen before, side windows, and the back.
        let (front, back) = (bonnet + 0.1 * l, -boot);
        let waist_z = 0.5 * (front + back);
        let (n, o) = slope(self.real(-0.1, 0.3), 1.0);
        self.cut(
            place,
            [0.0, top, 0.5 * (front + waist_z)],
            [0.88 * w, glass, 0.5 * (front - waist_z)],
            n,
            o,
            p.glass,
        );
        let (n, o) = slope(self.real(0.2, 0.85), -1.0);
        self.cut(
            place,
            [0.0, top, 0.5 * (back + waist_z)],
            [0.88 * w, glass, 0.5 * (waist_z - back)],
            n,
            o,
            p.glass,
        );
        let long = 0.3 * (front - back);
        self.cuboid(place, [0.0, roof, waist_z - 0.04 * l], [0.84 * w, 0.025, long], p.body);
        for s in [-1.0, 1.0] {
            for z in [0.0, 0.45] {
                self.bar(
                    place,
                    [s * 0.9 * w, waist, waist_z + z * long],
                    [s * 0.85 * w, roof, waist_z + z * long],
                    0.035,
                    p.body,
                );
            }
            self.ball(place, [s * (w + 0.08), waist + 0.05, bonnet - 0.1 * l], [0.09, 0.07, 0.05], p.body);
        }
        let radius = self.real(0.29, 0.36);
        self.wheels(place, &p, [w - 0.08, 0.62 * l], radius);
        self.ends(place, &p, w, l, 0.75 * waist);
    }

    /// A delivery van, a minibus or a lorry with a box.
    fn van(&mut self, place: &Place) {
        let p = self.vehicle_parts();
        let (l, w, h) = (self.real(2.3, 3.4), self.real(0.95, 1.15), self.real(1.9, 2.9));
        let cab = self.real(0.55, 0.75) * l;
        let white = self.real(0.4, 0.75);
        let load = if self.chance(0.3) { self.plain([white; 3]) } else { p.body };
        let middle = 0.5 * (cab - l);
        self.cuboid(place, [0.0, 0.5 * (h + 0.3), middle], [w, 0.5 * (h - 0.3), 0.5 * (cab + l)], load);
        let tall = h.min(2.3);
        let (n, o) = slope(self.real(-0.6, 0.2), 1.0);
        self.cut(
            place,
            [0.0, 0.5 * (tall + 0.3), 0.5 * (cab + l)],
            [0.97 * w, 0.5 * (tall - 0.3), 0.5 * (l - cab)],
            n,
            o,
            p.body,
        );
        self.cut(
            place,
            [0.0, 0.72 * tall, 0.5 * (cab + l) + 0.02],
            [0.9 * w, 0.2 * tall, 0.45 * (l - cab)],
            n,
            o,
            p.glass,
        );
        if self.chance(0.4) {
            self.cuboid(place, [0.0, 0.72 * h, middle], [1.005 * w, 0.16 * h, 0.42 * (cab + l)], p.glass);
        }
        self.wheels(place, &p, [w - 0.08, 0.62 * l], 0.36);
        self.ends(place, &p, w, l, 0.9);
    }

    fn bus(&mut self, place: &Place) {
        let p = self.vehicle_parts();
        let (l, w, h) = (self.real(4.5, 6.2), 1.27, self.real(2.8, 3.2));
        self.cuboid(place, [0.0, 0.5 * (h + 0.35), 0.0], [w, 0.5 * (h - 0.35), l], p.body);
        self.cuboid(place, [0.0, 0.66 * h, 0.0], [1.004 * w, 0.16 * h, 0.95 * l], p.glass);
        self.cuboid(place, [0.0, 0.6 * h, 0.0], [0.9 * w, 0.22 * h, 1.003 * l], p.glass);
        self.wheels(place, &p, [w - 0.1, 0.6 * l], 0.48);
        self.ends(place, &p, w, l, 0.8);
    }

    /// A bicycle, perhaps with its rider, driving towards z.
    pub(super) fn bicycle(&mut self, place: &Place, ridden: bool) {
        let colour = self.vivid();
        let (frame, dark) = (self.plain(colour), self.plain([0.03; 3]));
        for z in [-0.52, 0.52] {
            let wheel = place.tilted([0.0, 0.34, z], 0.0, 0.0, FRAC_PI_2);
            self.tube(&wheel, [0.0; 3], 0.34, 0.018, 1.0, dark);
        }
        for (a, b) in [
            ([0.0, 0.34, -0.52], [0.0, 0.32, -0.05]),
            ([0.0, 0.32, -0.05], [0.0, 0.9, -0.2]),
            ([0.0, 0.32, -0.05], [0.0, 0.85, 0.38]),
            ([0.0, 0.8, -0.18], [0.0, 0.85, 0.38]),
            ([0.0, 0.34, 0.52], [0.0, 1.0, 0.35]),
            ([-0.26, 1.02, 0.33], [0.26, 1.02, 0.33]),
        ] {
            self.bar(place, a, b, 0.018, frame);
        }
        self.ball(place, [0.0, 0.93, -0.2], [0.07, 0.04, 0.13], dark);
        if ridden {
            let (shirt, legs) = (self.thing(0.4), self.plain([0.06, 0.07, 0.1]));
            let skin = [self.real(0.25, 0.7), self.real(0.2, 0.5), self.real(0.15, 0.4)];
            let skin = self.plain(skin);
            for s in [-1.0, 1.0] {
                self.bar(place, [0.1 * s, 0.95, -0.2], [0.12 * s, 0.65, 0.12], 0.075, legs);
                self.bar(place, [0.12 * s, 0.65, 0.12], [0.1 * s, 0.25 - 0.1 * s, -0.05], 0.055, legs);
                self.bar(place, [0.2 * s, 1.4, 0.05], [0.24 * s, 1.05, 0.33], 0.045, shirt);
            }
            self.ball(place, [0.0, 1.22, -0.06], [0.2, 0.32, 0.16], shirt);
            self.ball(place, [0.0, 1.66, 0.06], [0.09, 0.13, 0.11], skin);
            self.ball(place, [0.0, 1.71, 0.05], [0.1, 0.1, 0.13], frame);
        }
    }
}
