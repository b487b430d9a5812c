//! Outdoor scenes: streets and open places, under a sky without return.

use std::f32::consts::{FRAC_PI_2, PI, TAU};

use super::space::{V3, mix, mul, unit};
use super::stage::{Paint, Place, Stage};
use super::texture::Pattern;
use crate::depth::Intrinsics;

impl Stage {
    pub(super) fn daylight(&mut self) {
        let (a, e) = (self.real(0.0, TAU), self.real(0.25, 1.3));
        let to: V3 = [e.cos() * a.sin(), e.sin(), e.cos() * a.cos()];
        let overcast = self.chance(0.35);
        let sun = if overcast { self.real(0.0, 0.3) } else { self.real(0.7, 1.6) };
        self.lamp(mul(unit(to), 900.0), sun, f32::INFINITY);
        let blue = self.real(0.9, 1.3);
        self.ambient = mul([0.95, 1.0, blue], self.real(0.3, 0.7));
        let grey = self.real(0.5, 1.0);
        self.sky = if overcast {
            [[grey, grey, grey]; 2]
        } else {
            [mix([grey; 3], [0.6, 0.8, 1.0], 0.4), [0.25, 0.45, self.real(0.7, 1.1)]]
        };
        if self.chance(0.5) {
            self.haze = self.log(80.0, 800.0);
        }
    }

    pub(super) fn building(&mut self, place: &Place, half: V3) {
        let (a, b) = (self.calm(), [self.real(0.03, 0.3); 3]);
        let pattern =
            self.pick(&[Pattern::Window, Pattern::Window, Pattern::Brick, Pattern::Plain, Pattern::Stripe]);
        let period = if pattern == Pattern::Window { self.real(2.0, 4.0) } else { self.real(0.3, 1.5) };
        let m = self.paint(pattern, a, b, period);
        self.cuboid(place, [0.0, half[1], 0.0], half, m);
        match self.int(0, 5) {
            0 | 1 => {
                // A gable: a box without its upper corners.
                let c = self.calm();
                let roof = self.plain(c);
                let tall = 0.35 * half[0];
                let at = [0.0, 2.0 * half[1] + tall, 0.0];
                for s in [-1.0, 1.0] {
                    let side = [s * 0.5 * half[0], at[1], 0.0];
                    self.cut(place, side, [0.5 * half[0], tall, half[2]], [s, 1.0, 0.0], 0.0, roof);
                }
            }
            2 => {
                // Balconies.
                let c = self.calm();
                let m = self.plain(c);
                for k in 1..((half[1] / 1.5) as usize).min(8) {
                    self.cuboid(place, [0.0, 3.0 * k as f32, 0.0], [half[0] + 0.8, 0.1, 0.8 * half[2]], m);
                    self.cuboid(
                        place,
                        [0.0, 3.0 * k as f32 + 0.5, 0.0],
                        [half[0] + 0.8, 0.5, 0.78 * half[2]],
                        m,
                    );
                }
            }
            3 => {
                let c = self.vivid();
                let m = self.plain(c);
                let tilt = place.tilted([0.0, 2.8, 0.0], 0.0, 0.0, 0.0);
                self.cuboid(&tilt, [0.0; 3], [half[0] + 1.0, 0.06, 0.5 * half[2]], m);
            }
            _ => {}
        }
    }

    fn car(&mut self, place: &Place) {
        let c = self.vivid();
        let body = self.plain(c);
        self.materials[body as usize].gloss = 0.5;
        let (glass, tyre) = (self.plain([0.04, 0.05, 0.06]), self.plain([0.03; 3]));
        self.materials[glass as usize].gloss = 0.6;
        let (l, w, h) = (self.real(1.8, 2.5), self.real(0.8, 0.95), self.real(0.6, 0.8));
        self.cuboid(place, [0.0, 0.55 * h + 0.2, 0.0], [w, 0.45 * h, l], body);
        let tall = self.real(0.25, 0.5);
        let cabin = [0.0, h + 0.2 + tall, -0.1 * l];
        self.cut(place, cabin, [0.9 * w, tall, 0.6 * l], [0.0, 0.8, 1.0], 1.2, glass);
        self.cuboid(place, [0.0, cabin[1] + tall, -0.2 * l], [0.85 * w, 0.03, 0.35 * l], body);
        for (sx, sz) in [(1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)] {
            let wheel = place.tilted([sx * w, 0.32, sz * 0.62 * l], 0.0, 0.0, FRAC_PI_2);
            self.tube(&wheel, [0.0; 3], 0.32, 0.11, 1.0, tyre);
        }
        let (red, plate) = (self.plain([0.7, 0.03, 0.03]), self.plain([0.8; 3]));
        for s in [-1.0, 1.0] {
            self.cuboid(place, [s * 0.8 * w, 0.75 * h + 0.1, -l], [0.12, 0.07, 0.02], red);
        }
        self.cuboid(place, [0.0, 0.5 * h, -l], [0.25, 0.06, 0.02], plate);
    }

    fn truck(&mut self, place: &Place) {
        let (c, d) = (self.vivid(), self.vivid());
        let (cab, tyre) = (self.plain(c), self.plain([0.03; 3]));
        let load = self.paint(Pattern::Print, d, c, 2.0);
        let (l, h) = (self.real(2.0, 5.0), self.real(1.0, 1.7));
        self.cuboid(place, [0.0, 0.9 + h, 0.0], [1.2, h, l], load);
        self.cuboid(place, [0.0, 1.8, l + 1.2], [1.15, 1.1, 0.9], cab);
        for s in [-1.0, 1.0] {
            for z in [-0.8 * l, -0.5 * l, l + 1.0] {
                let wheel = place.tilted([s * 1.05, 0.5, z], 0.0, 0.0, FRAC_PI_2);
                self.tube(&wheel, [0.0; 3], 0.5, 0.15, 1.0, tyre);
            }
        }
    }

    pub(super) fn tree(&mut self, place: &Place, height: f32) {
        let bark = mul([0.5, 0.38, 0.28], self.real(0.2, 0.8));
        let trunk = self.paint(Pattern::Cloud, bark, mul(bark, 0.5), 0.3);
        let season = self.real(0.0, 1.0);
        let green = mix([0.08, 0.25, 0.05], [0.4, 0.35, 0.08], season * season);
        let leaves = self.paint(Pattern::Leaves, mul(green, 0.25), mul(green, 1.5), 0.09 * height);
        self.tube(place, [0.0, 0.25 * height, 0.0], 0.03 * height, 0.25 * height, 0.6, trunk);
        if self.chance(0.25) {
            for k in 0..3 {
                let y = (0.45 + 0.2 * k as f32) * height;
                self.tube(
                    place,
                    [0.0, y, 0.0],
                    (0.28 - 0.06 * k as f32) * height,
                    0.17 * height,
                    0.0,
                    leaves,
                );
            }
            return;
        }
        let bare = self.chance(0.15);
        for _ in 0..self.int(7, 22) {
            let (a, r) = (self.real(0.0, TAU), self.real(0.0, 0.25) * height);
            let p = [r * a.sin(), self.real(0.5, 0.9) * height, r * a.cos()];
            self.bar(place, [0.0, 0.42 * height, 0.0], p, 0.008 * height, trunk);
            if !bare {
                let s = height * self.real(0.06, 0.17);
                let flat = self.pick(&[0.7, 0.9]);
                self.ball(place, p, [s, s * flat, s], leaves);
            }
        }
    }

    pub(super) fn pole(&mut self, place: &Place) {
        let grey = [self.real(0.05, 0.6); 3];
        let m = self.plain(grey);
        let h = self.real(2.2, 9.0);
        let r = self.real(0.03, 0.12);
        self.tube(place, [0.0, 0.5 * h, 0.0], r, 0.5 * h, 0.7, m);
        match self.int(0, 3) {
            0 => self.bar(place, [0.0, h, 0.0], [2.0, h + 0.3, 0.0], 0.6 * r, m),
            1 => {
                let (a, b) = (self.vivid(), self.vivid());
                let sign = self.paint(Pattern::Print, a, b, 0.5);
                let s = self.real(0.3, 0.9);
                let tall = s * self.pick(&[0.6, 1.0]);
                self.cuboid(place, [0.0, h, -r], [s, tall, 0.02], sign);
            }
            2 => self.cuboid(place, [0.0, h, 0.0], [0.16, 0.45, 0.16], m),
            _ => self.ball(place, [0.0, h, 0.0], [0.25; 3], m),
        }
    }

    fn ground(&mut self, lane: f32) -> Paint {
        let v = self.real(0.08, 0.4);
        let a = [v, v, v * self.real(0.85, 1.1)];
        match self.int(0, 5) {
            0..=2 => self.paint(Pattern::Road, a, [0.8; 3], lane),
            3 => self.paint(Pattern::Tile, a, mul(a, 0.7), 0.8),
            4 => {
                let g = [self.real(0.1, 0.4), self.real(0.25, 0.4), 0.08];
                self.paint(Pattern::Cloud, g, mul(g, 0.5), 1.5)
            }
            _ => self.paint(Pattern::Cloud, a, mul(a, 0.7), 2.0),
        }
    }

    /// A street along z with facades, trees, parked and driving cars, and something at its end.
    pub fn street(&mut self, k: Intrinsics) {
        self.daylight();
        let world = self.world();
        let lane = self.real(2.8, 3.8);
        let road = self.ground(lane);
        self.materials[road as usize].grain = self.real(0.05, 0.2);
        self.materials[road as usize].grain_period = self.log(0.1, 3.0);
        self.cuboid(&world, [0.0, -1.0, 60.0], [300.0, 1.0, 300.0], road);
        let curb = lane * self.pick(&[1.0, 1.5, 2.0, 3.0]);
        let walk = self.log(1.5, 6.0);
        let pavement = self.ground(50.0);
        let built = self.real(0.2, 1.0);
        for s in [-1.0f32, 1.0] {
            self.cuboid(&world, [s * (curb + 30.0), 0.0, 60.0], [30.0, 0.12, 200.0], pavement);
            self.frontage(s, curb + walk, built);
            self.kerbside(s, curb);
        }
        self.vehicles(curb, lane);
        if self.chance(0.6) {
            let half = [self.real(10.0, 50.0), self.log(3.0, 20.0), 5.0];
            let at = [self.real(-20.0, 20.0), 0.0, self.real(90.0, 130.0)];
            self.building(&Place::new(at, 0.0), half);
        }
        if self.chance(0.3) {
            self.hills();
        }
        let height = if self.chance(0.8) { self.real(1.2, 2.2) } else { self.real(2.5, 8.0) };
        let at = [self.real(-0.7, 0.7) * curb, height, 0.0];
        let target = [at[0] + self.real(-3.0, 3.0), height + self.real(-4.0, 1.5), 30.0];
        self.aim(k, at, target, if at[1] > 2.4 { 0.4 } else { 0.15 });
        self.focus = ([at[0], 0.0, 18.0], 22.0);
    }

    /// Houses and hedges along one side, `s` -1 or 1, from `edge` metres off the middle on.
    fn frontage(&mut self, s: f32, edge: f32, built: f32) {
        let world = self.world();
        let mut z = self.real(-15.0, 5.0);
        while z < 110.0 {
            let long = self.log(3.0, 14.0);
            let high = self.log(2.0, 12.0);
            if self.chance(built) {
                let deep = self.real(4.0, 8.0);
                let x = s * (edge + deep + self.log(0.01, 3.0));
                self.building(&Place::new([x, 0.1, z + long], 0.0), [deep, high, long]);
            } else if self.chance(0.5) {
                let hedge = [self.real(0.05, 0.2), self.real(0.2, 0.4), 0.06];
                let m = self.paint(Pattern::Leaves, mul(hedge, 0.4), hedge, 0.4);
                let tall = self.real(0.4, 1.5);
                self.cuboid(&world, [s * edge, tall, z + long], [0.5, tall, long], m);
            }
            z += 2.0 * long + if self.chance(0.3) { self.real(1.0, 12.0) } else { 0.0 };
        }
    }

    /// Trees, poles and people beside the road, and parked cars.
    fn kerbside(&mut self, s: f32, curb: f32) {
        let mut z = self.real(2.0, 12.0);
        let trees = self.real(0.0, 0.8);
        let row = self.real(5.0, 14.0);
        while z < 90.0 {
            let x = s * (curb + self.real(0.4, 1.2));
            let place = Place::new([x, 0.1, z], FRAC_PI_2 - FRAC_PI_2 * s);
            if self.chance(trees) {
                let tall = self.real(3.0, 11.0);
                self.tree(&place, tall);
            } else if self.chance(0.6) {
                self.pole(&place);
            } else if self.chance(0.4) {
                self.person(&place);
            }
            z += row * self.real(0.7, 1.4);
        }
        let parked = self.real(0.0, 0.8);
        let mut z = self.real(3.0, 9.0);
        while z < 70.0 {
            if self.chance(parked) {
                let turn = self.real(-0.05, 0.05);
                self.car(&Place::new([s * (curb - 1.1), 0.0, z], turn));
            }
            z += self.real(5.2, 9.0);
        }
    }

    /// What drives on the road.
    fn vehicles(&mut self, curb: f32, lane: f32) {
        for _ in 0..self.int(0, 5) {
            let lanes = (curb / lane) as i32;
            let x = lane
                * (self.int(0, (2 * lanes).max(1) as usize) as f32 - lanes as f32 + 0.5)
                    .clamp(-curb / lane + 0.6, curb / lane - 0.6);
            let turn = if x < 0.0 { PI } else { 0.0 };
            let z = self.log(7.0, 80.0);
            if self.chance(0.75) {
                self.car(&Place::new([x, 0.0, z], turn));
            } else {
                self.truck(&Place::new([x, 0.0, z], turn));
            }
        }
    }

    pub(super) fn hills(&mut self) {
        let world = self.world();
        for _ in 0..self.int(1, 5) {
            let g = [self.real(0.1, 0.4), self.real(0.2, 0.4), self.real(0.05, 0.25)];
            let m = self.paint(Pattern::Cloud, g, mul(g, 0.5), 6.0);
            let r = self.log(20.0, 80.0);
            let at = [self.real(-120.0, 120.0), -2.0, self.real(60.0, 140.0)];
            self.ball(&world, at, [r, 0.3 * r, r], m);
        }
    }

    /// A yard, garden or square: walls, steps, benches, trees, boulders; mostly nearer than 40 m.
    pub fn yard(&mut self, k: Intrinsics) {
        self.daylight();
        let world = self.world();
        let m = self.ground(40.0);
        self.materials[m as usize].grain = self.real(0.05, 0.3);
        self.cuboid(&world, [0.0, -1.0, 0.0], [300.0, 1.0, 300.0], m);
        for _ in 0..self.int(1, 5) {
            let (a, r) = (self.real(-1.3, 1.3), self.log(8.0, 45.0));
            let half = [self.real(2.0, 10.0), self.log(1.2, 8.0), self.real(2.0, 10.0)];
            let yaw = self.real(0.0, TAU);
            let r = r + half[0].max(half[2]) * 1.4;
            self.building(&Place::new([r * a.sin(), 0.0, r * a.cos()], yaw), half);
        }
        for _ in 0..self.int(0, 4) {
            let (a, r) = (self.real(-1.2, 1.2), self.log(3.0, 20.0));
            let wall = self.surface(1.5);
            let (yaw, long, tall) = (self.real(0.0, TAU), self.log(0.5, 6.0), self.log(0.2, 1.5));
            self.cuboid(
                &Place::new([r * a.sin(), 0.0, r * a.cos()], yaw),
                [0.0, tall, 0.0],
                [long, tall, 0.15],
                wall,
            );
        }
        for _ in 0..self.int(3, 18) {
            let (a, r) = (self.real(-1.1, 1.1), self.log(2.2, 40.0));
            let yaw = self.real(0.0, TAU);
            let place = Place::new([r * a.sin(), 0.0, r * a.cos()], yaw);
            match self.int(0, 9) {
                0..=2 => {
                    let tall = self.log(1.0, 9.0);
                    self.tree(&place, tall);
                }
                3 => {
                    let top = self.table(&place, [0.8, 0.3], 0.45);
                    self.clutter(&top, 3, 0.2);
                }
                4 => self.pole(&place),
                5 => self.person(&place),
                6 => self.car(&place),
                7 => {
                    let stone = self.paint(Pattern::Cloud, [0.4; 3], [0.2; 3], 0.3);
                    let s = self.log(0.2, 1.5);
                    self.ball(&place, [0.0, 0.2 * s, 0.0], [s, 0.6 * s, 0.8 * s], stone);
                }
                8 => {
                    let s = self.log(0.3, 1.0);
                    self.object(&place, s);
                }
                _ => {
                    let green = [0.12, self.real(0.2, 0.4), 0.06];
                    let leaf = self.paint(Pattern::Leaves, mul(green, 0.3), green, 0.2);
                    for _ in 0..4 {
                        let p = [self.real(-0.7, 0.7), 0.4, self.real(-0.7, 0.7)];
                        let s = self.real(0.4, 0.8);
                        self.ball(&place, p, [s, s, s], leaf);
                    }
                }
            }
        }
        if self.chance(0.5) {
            self.hills();
        }
        let height = self.real(0.8, 2.0);
        let target = [self.real(-3.0, 3.0), self.real(-0.5, 2.5), 12.0];
        self.aim(k, [0.0, height, 0.0], target, 0.3);
        self.focus = ([0.0, 0.0, 10.0], 13.0);
    }
}
