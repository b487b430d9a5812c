//! Streets as the ego vehicle of a LiDAR data set sees them: 2 to 120 m, true to scale.

use std::f32::consts::{FRAC_PI_2, PI, TAU};

use super::camera::Camera;
use super::space::mul;
use super::stage::{Place, Stage};
use super::texture::Pattern;
use crate::depth::Intrinsics;

/// How far along the road things are put, metres.
const END: f32 = 125.0;

/// Half the road's width and the widths of what lies beside it, metres.
struct Road {
    lane: f32,
    lanes: usize,
    /// Parking strip, 0 without one.
    strip: f32,
    walk: f32,
    /// Garden before the houses.
    front: f32,
    /// Distance of a crossing, beyond [`END`] without one.
    crossing: f32,
}

impl Road {
    fn curb(&self) -> f32 {
        self.lane * self.lanes as f32 + self.strip
    }

    /// Whether a stretch lies on the crossing.
    fn crossed(&self, from: f32, to: f32) -> bool {
        to > self.crossing - 6.0 && from < self.crossing + 6.0
    }
}

impl Stage {
    /// A road along z with all that stands and moves there; the camera is on a car in the right lane.
    pub fn drive(&mut self, k: Intrinsics) {
        self.daylight();
        let road = Road {
            lane: self.real(2.9, 3.7),
            lanes: self.pick(&[1, 1, 1, 2, 2]),
            strip: if self.chance(0.6) { 2.2 } else { 0.0 },
            walk: self.log(1.5, 5.0),
            front: if self.chance(0.5) { 0.0 } else { self.log(0.5, 9.0) },
            crossing: if self.chance(0.5) { self.real(18.0, 90.0) } else { 2.0 * END },
        };
        self.surfaces(&road);
        let built = self.pick(&[0.25, 0.7, 0.95, 1.0]);
        for side in [-1.0f32, 1.0] {
            self.houses(&road, side, built);
            self.verge(&road, side);
            self.parked(&road, side);
            self.walkers(&road, side);
        }
        self.traffic(&road);
        if self.chance(0.5) {
            let half = [self.real(10.0, 40.0), self.log(3.0, 14.0), 6.0];
            let at = [self.real(-15.0, 15.0), 0.0, self.real(105.0, 150.0)];
            self.building(&Place::new(at, 0.0), half);
        }
        if self.chance(0.35) {
            self.hills();
        }
        let own = (self.int(0, road.lanes - 1) as f32 + 0.5) * road.lane + self.real(-0.35, 0.35);
        let at = [own, self.real(1.6, 2.0), 0.0];
        let yaw = if self.chance(0.8) { self.real(-0.06, 0.06) } else { self.real(-0.5, 0.5) };
        let (pitch, roll) = (self.real(-0.05, 0.04), self.real(-0.02, 0.02));
        self.camera = Camera::new(k, at, yaw, pitch, roll);
        self.focus = ([at[0], 0.0, 18.0], 22.0);
    }

    fn surfaces(&mut self, road: &Road) {
        let world = self.world();
        let v = self.real(0.07, 0.28);
        let asphalt = self.paint(Pattern::Road, [v, v, 1.02 * v], [0.7; 3], road.lane);
        self.materials[asphalt as usize].grain = self.real(0.05, 0.2);
        self.materials[asphalt as usize].grain_period = self.log(0.1, 3.0);
        self.cuboid(&world, [0.0, -1.0, 60.0], [300.0, 1.0, 300.0], asphalt);
        let v = self.real(0.2, 0.42);
        let (stone, kerb) = ([v, v, 0.96 * v], self.plain([1.1 * v; 3]));
        let paving = self.paint(Pattern::Tile, stone, mul(stone, 0.75), 0.5);
        let green = [self.real(0.08, 0.2), self.real(0.16, 0.28), 0.06];
        let lawn = self.paint(Pattern::Cloud, green, mul(green, 0.6), 1.2);
        let (curb, high) = (road.curb(), self.real(0.05, 0.08));
        // Pavements stop where another road crosses.
        let from = road.crossing.min(END) - 6.0;
        for s in [-1.0f32, 1.0] {
            for (a, b) in [(-30.0, from), (road.crossing + 6.0, 2.0 * END)] {
                if b > a {
                    let (z, half) = (0.5 * (a + b), 0.5 * (b - a));
                    let wide = 0.5 * road.walk;
                    self.cuboid(&world, [s * (curb + 0.08), high, z], [0.08, high, half], kerb);
                    self.cuboid(&world, [s * (curb + 0.16 + wide), high, z], [wide, high, half], paving);
                    self.cuboid(
                        &world,
                        [s * (curb + 0.16 + road.walk + 40.0), high, z],
                        [40.0, 0.9 * high, half],
                        lawn,
                    );
                }
            }
        }
    }

    fn houses(&mut self, road: &Road, side: f32, built: f32) {
        let line = road.curb() + 0.2 + road.walk + road.front;
        let mut z = self.real(-14.0, 4.0);
        let row = self.chance(0.5);
        while z < END {
            let long = self.log(3.5, 12.0);
            let to = z + 2.0 * long;
            if road.crossed(z, to) {
                z = road.crossing + 7.0;
                if z >= END || to >= END {
                    break;
                }
                continue;
            }
            let deep = self.real(4.0, 8.0);
            let back = if row { 0.0 } else { self.log(0.01, 4.0) };
            if self.chance(built) {
                let high = self.log(2.4, 11.0);
                let place = Place::new([side * (line + back + deep), 0.1, z + long], 0.0);
                self.building(&place, [deep, high, long]);
                if z < 60.0 {
                    self.facade(&place, side, [deep, high, long]);
                }
            } else {
                self.garden(side * (line + back), z, to);
            }
            z = to + if row { 0.0 } else { self.real(0.5, 9.0) };
        }
    }

    /// Windows, doors, pipes and awnings that stand out from a house's wall towards the road.
    fn facade(&mut self, place: &Place, side: f32, [deep, high, long]: [f32; 3]) {
        let v = self.real(0.3, 0.8);
        let (trim, glass) = (self.plain([v, v, 0.95 * v]), self.plain([0.05, 0.06, 0.07]));
        self.materials[glass as usize].gloss = 0.5;
        let c = self.vivid();
        let leaf = self.plain(mul(c, 0.5));
        let x = -side * deep;
        let floors = ((2.0 * high / 3.1) as usize).clamp(1, 5);
        let columns = ((2.0 * long / self.real(2.2, 3.4)) as usize).clamp(1, 8);
        let (wide, tall) = (self.real(0.4, 0.7), self.real(0.6, 0.95));
        let out = self.log(0.03, 0.16);
        for j in 0..floors {
            for i in 0..columns {
                let z = ((2 * i + 1) as f32 / columns as f32 - 1.0) * long;
                let y = 3.1 * j as f32 + 1.75;
                if j == 0 && i == columns / 2 {
                    self.cuboid(place, [x, 1.05, z], [out + 0.05, 1.05, 0.5], leaf);
                    self.cuboid(place, [x - side * 0.4, 0.1, z], [0.5, 0.1, 0.7], trim);
                    continue;
                }
                self.cuboid(place, [x, y, z], [0.5 * out + 0.01, tall, wide], glass);
                self.cuboid(place, [x, y - tall, z], [out + 0.04, 0.05, wide + 0.1], trim);
                self.cuboid(place, [x, y + tall, z], [out, 0.06, wide + 0.08], trim);
                self.cuboid(place, [x, y, z], [out, tall, 0.03], trim);
            }
        }
        if self.chance(0.3) {
            let c = self.vivid();
            let cloth = self.plain(c);
            let shade = place.tilted([x - side * 0.6, 2.75, 0.0], 0.0, 0.0, side * 0.25);
            self.cuboid(&shade, [0.0; 3], [0.75, 0.03, 0.8 * long], cloth);
        }
        for z in [-0.97, 0.97] {
            if self.chance(0.5) {
                self.tube(place, [x - side * 0.06, high, z * long], 0.05, high, 1.0, trim);
            }
        }
    }

    /// A hedge, a fence, a wall or trees where there is no house.
    fn garden(&mut self, x: f32, from: f32, to: f32) {
        let world = self.world();
        let (z, half) = (0.5 * (from + to), 0.5 * (to - from));
        match self.int(0, 4) {
            0 => {
                let green = [self.real(0.05, 0.15), self.real(0.14, 0.28), 0.05];
                let m = self.paint(Pattern::Leaves, mul(green, 0.4), green, 0.4);
                let (deep, tall) = (self.real(0.2, 0.6), self.real(0.4, 1.2));
                self.cuboid(&world, [x, tall, z], [deep, tall, half], m);
            }
            1 => {
                let m = self.surface(1.0);
                let tall = self.real(0.3, 1.1);
                self.cuboid(&world, [x, tall, z], [0.12, tall, half], m);
            }
            2 => {
                let grey = self.real(0.05, 0.7);
                let m = self.plain([grey; 3]);
                let tall = self.real(0.9, 1.7);
                let posts = ((to - from) / 1.2) as usize;
                for i in 0..=posts {
                    self.tube(&world, [x, 0.5 * tall, from + 1.2 * i as f32], 0.03, 0.5 * tall, 1.0, m);
                }
                for y in [0.35, 0.9] {
                    self.cuboid(&world, [x, y * tall, z], [0.015, 0.04, half], m);
                }
            }
            _ => {
                for _ in 0..self.int(1, 4) {
                    let at = [x + self.real(-2.0, 2.0), 0.1, self.real(from, to)];
                    let tall = self.real(2.0, 12.0);
                    self.tree(&Place::new(at, 0.0), tall);
                }
            }
        }
    }

    /// Trees, lamps, signs, bollards, bins along the kerb.
    fn verge(&mut self, road: &Road, side: f32) {
        let x = side * (road.curb() + self.real(0.45, 0.9));
        let (trees, lamps) = (self.pick(&[0.0, 0.0, 0.5, 0.9]), self.real(20.0, 35.0));
        let mut z = self.real(3.0, lamps);
        while z < END {
            if !road.crossed(z, z) {
                self.lamp_post(&Place::new([x, 0.1, z], 0.0), side);
            }
            z += lamps;
        }
        let mut z = self.real(3.0, 12.0);
        while z < 100.0 {
            let place = Place::new([x, 0.1, z], FRAC_PI_2 - FRAC_PI_2 * side);
            if !road.crossed(z - 1.0, z + 1.0) {
                if self.chance(trees) {
                    let tall = self.real(3.5, 11.0);
                    self.tree(&place, tall);
                } else {
                    self.street_thing(&place, side);
                }
            }
            z += self.real(4.0, 13.0);
        }
        if self.chance(0.2) {
            let (grey, gap) = (self.plain([0.1; 3]), self.real(1.3, 2.5));
            let from = self.real(4.0, 25.0);
            for i in 0..12 {
                let at = [side * (road.curb() + 0.3), 0.55, from + gap * i as f32];
                let world = self.world();
                self.tube(&world, at, 0.06, 0.45, 0.9, grey);
            }
        }
        if road.crossing < END {
            let place = Place::new([side * (road.curb() + 0.5), 0.1, road.crossing - 7.5], 0.0);
            self.signal(&place, side);
        }
    }

    fn lamp_post(&mut self, place: &Place, side: f32) {
        let v = self.real(0.05, 0.4);
        let m = self.plain([v; 3]);
        let (h, r) = (self.real(4.0, 9.0), self.real(0.05, 0.1));
        self.tube(place, [0.0, 0.5 * h, 0.0], r, 0.5 * h, 0.6, m);
        let reach = -side * self.real(0.3, 2.2);
        self.bar(place, [0.0, h, 0.0], [reach, h + 0.25, 0.0], 0.5 * r, m);
        self.cuboid(place, [reach, h + 0.22, 0.0], [0.3, 0.05, 0.12], m);
    }

    fn signal(&mut self, place: &Place, side: f32) {
        let (grey, black) = (self.plain([0.2; 3]), self.plain([0.03; 3]));
        let h = self.real(2.8, 3.6);
        self.tube(place, [0.0, 0.5 * h, 0.0], 0.07, 0.5 * h, 1.0, grey);
        self.cuboid(place, [0.0, h, 0.0], [0.15, 0.42, 0.12], black);
        if self.chance(0.4) {
            self.bar(place, [0.0, 5.4, 0.0], [-4.5 * side, 5.6, 0.0], 0.06, grey);
            self.tube(place, [0.0, 2.7, 0.0], 0.07, 2.7, 1.0, grey);
            self.cuboid(place, [-4.3 * side, 5.3, 0.0], [0.15, 0.42, 0.12], black);
        }
    }

    fn street_thing(&mut self, place: &Place, side: f32) {
        match self.int(0, 9) {
            0..=2 => self.pole(place),
            3 => {
                let c = self.pick(&[[0.05, 0.2, 0.07], [0.06, 0.06, 0.07], [0.3, 0.22, 0.03]]);
                let m = self.plain(c);
                for k in 0..self.int(1, 3) {
                    let z = 0.65 * k as f32;
                    self.tube(place, [0.0, 0.5, z], 0.26, 0.5, 1.15, m);
                }
            }
            4 => {
                let m = self.wood();
                self.cuboid(place, [0.0, 0.44, 0.0], [0.22, 0.03, 0.8], m);
                self.cuboid(place, [side * 0.2, 0.7, 0.0], [0.02, 0.18, 0.8], m);
                for z in [-0.7, 0.7] {
                    self.cuboid(place, [0.0, 0.21, z], [0.2, 0.21, 0.03], m);
                }
            }
            5 => {
                let (steel, glass) = (self.plain([0.15; 3]), self.plain([0.3, 0.36, 0.38]));
                for (x, z) in [(0.7, -1.6), (0.7, 1.6), (-0.5, -1.6), (-0.5, 1.6)] {
                    self.tube(place, [x, 1.2, z], 0.04, 1.2, 1.0, steel);
                }
                self.cuboid(place, [0.1, 2.42, 0.0], [0.8, 0.05, 1.8], steel);
                self.cuboid(place, [0.7, 1.3, 0.0], [0.015, 0.9, 1.55], glass);
            }
            6 => {
                let yaw = self.real(0.0, TAU);
                self.bicycle(&place.inner([0.0; 3], yaw), false);
            }
            7 => {
                let v = self.real(0.2, 0.5);
                let m = self.plain([v, v, 0.9 * v]);
                let (w, h) = (self.real(0.3, 0.7), self.real(0.5, 0.8));
                self.cuboid(place, [0.3, h, 0.0], [0.2, h, w], m);
            }
            8 => self.person(place),
            _ => {}
        }
    }

    fn parked(&mut self, road: &Road, side: f32) {
        let density = if road.strip > 0.0 { self.real(0.2, 0.95) } else { self.pick(&[0.0, 0.0, 0.15]) };
        let mut z = self.real(2.5, 9.0);
        while z < 90.0 {
            if self.chance(density) && !road.crossed(z - 4.0, z + 4.0) {
                let turn = if side > 0.0 { 0.0 } else { PI } + self.real(-0.04, 0.04);
                self.motor(&Place::new([side * (road.curb() - 1.15), 0.0, z], turn));
            }
            z += self.real(5.4, 8.0);
        }
    }

    fn walkers(&mut self, road: &Road, side: f32) {
        for _ in 0..self.int(0, 6) {
            let at = [side * (road.curb() + self.real(0.6, 0.3 + road.walk)), 0.13, self.log(4.0, 70.0)];
            let yaw = self.pick(&[0.0, PI]) + self.real(-0.4, 0.4);
            self.person(&Place::new(at, yaw));
        }
        if self.chance(0.3) {
            let at = [side * (road.curb() - road.strip - 0.6), 0.0, self.log(6.0, 60.0)];
            let yaw = if side > 0.0 { 0.0 } else { PI };
            self.bicycle(&Place::new(at, yaw), true);
        }
    }

    /// Vehicles in every lane, the own lane's first one not too near, and those that cross.
    fn traffic(&mut self, road: &Road) {
        for lane in 0..2 * road.lanes {
            let x = (lane as f32 + 0.5 - road.lanes as f32) * road.lane;
            let mut z = self.log(7.5, 45.0);
            let busy = self.real(0.0, 1.0);
            while z < 115.0 {
                if self.chance(busy) && !road.crossed(z - 4.0, z + 4.0) {
                    let turn = if x > 0.0 { 0.0 } else { PI } + self.real(-0.03, 0.03);
                    let x = x + self.real(-0.3, 0.3);
                    self.motor(&Place::new([x, 0.0, z], turn));
                }
                z += self.log(9.0, 45.0);
            }
        }
        if road.crossing < END {
            for _ in 0..self.int(0, 3) {
                let at = [self.real(-25.0, 25.0), 0.0, road.crossing + self.pick(&[-2.2, 2.2])];
                let turn = if at[2] < road.crossing { FRAC_PI_2 } else { -FRAC_PI_2 };
                self.motor(&Place::new(at, turn));
            }
            for _ in 0..self.int(0, 4) {
                let at = [self.real(-1.0, 1.0) * road.curb(), 0.0, road.crossing - self.real(6.5, 8.0)];
                let yaw = self.pick(&[-FRAC_PI_2, FRAC_PI_2]);
                self.person(&Place::new(at, yaw));
            }
        }
    }
}
