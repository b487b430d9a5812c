//! Small things: on tables, counters and shelves, and pictures on walls.

use super::look::Look;
use super::plan::Spot;
use super::role::Role;
use super::room::Room;
use super::style::{self, Kind};
use crate::scenes::space::{V3, mix, mul};
use crate::scenes::texture::{Material, Pattern};

/// Colours of book covers and parcels, linear.
const COVERS: [V3; 12] = [
    [0.30, 0.06, 0.05],
    [0.06, 0.10, 0.22],
    [0.07, 0.16, 0.10],
    [0.62, 0.58, 0.48],
    [0.70, 0.69, 0.66],
    [0.05, 0.05, 0.05],
    [0.42, 0.30, 0.10],
    [0.22, 0.10, 0.05],
    [0.16, 0.26, 0.34],
    [0.45, 0.18, 0.08],
    [0.30, 0.30, 0.30],
    [0.20, 0.08, 0.18],
];

/// Colours of pictures: ground and figures.
const PRINTS: [[V3; 2]; 8] = [
    [[0.62, 0.58, 0.50], [0.12, 0.16, 0.20]],
    [[0.20, 0.28, 0.34], [0.60, 0.56, 0.48]],
    [[0.45, 0.42, 0.36], [0.30, 0.14, 0.08]],
    [[0.10, 0.10, 0.10], [0.60, 0.60, 0.60]],
    [[0.34, 0.38, 0.28], [0.62, 0.60, 0.46]],
    [[0.66, 0.64, 0.60], [0.34, 0.20, 0.16]],
    [[0.40, 0.48, 0.52], [0.14, 0.20, 0.16]],
    [[0.56, 0.44, 0.30], [0.20, 0.12, 0.10]],
];

impl Room<'_> {
    /// Sets up to `count` things of some roles on a piece.
    pub fn dress(&mut self, host: usize, roles: &[Role], count: usize) {
        for _ in 0..count {
            let role = self.dice.pick(roles);
            let [x, z] = self.pieces[host].model.half();
            let limit = x.min(z);
            let small = |m: &super::model::Model| m.half()[0].min(m.half()[1]) < limit;
            if let Some(model) = self.choose_where(role, small) {
                let face = matches!(role, Role::Computer | Role::Tv);
                self.set_on(&model, host, face, 8);
            }
        }
    }

    /// Fills the shelves of a piece with books, parcels and ornaments.
    pub fn stock(&mut self, host: usize, roles: &[Role]) {
        let parcels = self.kind == Kind::Workshop && self.dice.chance(0.7);
        let shelves = self.pieces[host].model.profile().shelves();
        let full = self.dice.real(0.3, 1.0);
        for board in shelves.iter().filter(|b| b.room > 0.14 && b.height < 2.0) {
            if self.dice.chance(full) {
                self.row(host, board.height, board.room.min(0.45), parcels);
            }
        }
        let more = self.dice.int(2, 9);
        self.dress(host, roles, more);
    }

    /// Books or parcels side by side on a shelf, as far as it carries them.
    fn row(&mut self, host: usize, height: f32, room: f32, parcels: bool) {
        let carrier = self.pieces[host].clone();
        let half = carrier.model.half();
        let (mut x, end) = if self.dice.chance(0.5) { (-0.97, 0.97) } else { (-0.97, 0.3) };
        (x, _) = (x * half[0], end);
        let paints = if parcels { self.parcel_paints() } else { self.book_paints() };
        for _ in 0..70 {
            let thick = if parcels { self.dice.real(0.08, 0.22) } else { self.dice.real(0.006, 0.024) };
            if x + 2.0 * thick > end * half[0] {
                return;
            }
            let tall = room * self.dice.real(0.5, 0.92);
            let tall = if parcels { tall } else { tall.min(self.dice.real(0.19, 0.32)) };
            let deep = half[1] * self.dice.real(0.5, 0.8);
            let back = self.dice.real(0.85, 0.95) * half[1] - deep;
            let local = [x + thick, -back];
            let on = carrier.model.carries(local, [thick, deep], 0.0, height, tall);
            let at = carrier.point([local[0], height, local[1]]);
            let spot = Spot { at, yaw: carrier.yaw, half: [thick, deep], height: tall };
            let gap = self.dice.chance(0.04);
            if on && !gap && self.is_free_on(host, &spot) {
                let paint = self.dice.pick(&paints);
                self.shell.cuboid(at, carrier.yaw, [thick - 0.0005, 0.5 * tall, deep], paint);
                self.small.push((host, spot));
            }
            x += 2.0 * thick + if gap { self.dice.real(0.05, 0.25) } else { 0.001 };
        }
    }

    fn book_paints(&mut self) -> Vec<u16> {
        (0..7)
            .map(|_| {
                let base = self.dice.pick(&COVERS);
                let s = self.dice.real(0.7, 1.2);
                let base = mul(base, s);
                let letters = if base[1] > 0.3 { [0.05; 3] } else { [0.6, 0.55, 0.4] };
                let mut m = style::plain(&mut self.dice, base);
                if self.dice.chance(0.4) {
                    (m.pattern, m.second, m.period) = (Pattern::Text, mix(base, letters, 0.6), 0.05);
                }
                self.shell.look(Look::patterned(m))
            })
            .collect()
    }

    fn parcel_paints(&mut self) -> Vec<u16> {
        (0..4)
            .map(|_| {
                let v = self.dice.real(0.7, 1.15);
                let card = mul([0.36, 0.24, 0.14], v);
                let base = if self.dice.chance(0.75) { card } else { self.dice.pick(&COVERS) };
                let mut m = style::plain(&mut self.dice, base);
                if self.dice.chance(0.3) {
                    (m.pattern, m.second, m.period) = (Pattern::Print, mul(base, 0.6), 0.3);
                }
                self.shell.look(Look::patterned(m))
            })
            .collect()
    }

    /// Parcels on the floor, some on others.
    pub fn parcels(&mut self, count: usize) {
        let paints = self.parcel_paints();
        let [w, _, l] = self.plan.size;
        for _ in 0..count {
            let half = [self.dice.log(0.1, 0.3), self.dice.log(0.08, 0.25), self.dice.log(0.1, 0.3)];
            let at = [self.dice.real(-0.95, 0.95) * w, 0.0, self.dice.real(-0.95, 0.95) * l];
            let yaw = self.dice.real(0.0, std::f32::consts::TAU);
            let spot = Spot { at, yaw, half: [half[0], half[2]], height: 2.0 * half[1] };
            if !self.plan.fits(&spot, 0.01) {
                continue;
            }
            let paint = self.dice.pick(&paints);
            self.shell.cuboid(at, yaw, half, paint);
            self.plan.taken.push(spot);
            if self.dice.chance(0.4) {
                let s = self.dice.real(0.5, 0.95);
                let upper = [at[0], 2.0 * half[1], at[2]];
                let turn = yaw + self.dice.real(-0.1, 0.1);
                let small = [0.9 * s * half[0], s * half[1], 0.9 * s * half[2]];
                let spot = Spot { at: upper, yaw: turn, half: [small[0], small[2]], height: 2.0 * small[1] };
                if self.plan.fits(&spot, 0.0) {
                    let paint = self.dice.pick(&paints);
                    self.shell.cuboid(upper, turn, small, paint);
                    self.plan.taken.push(spot);
                }
            }
        }
    }

    /// Framed pictures, where walls are free.
    pub fn pictures(&mut self, count: usize) {
        let v = self.dice.pick(&[0.03, 0.05, 0.3, 0.7]);
        let frame = style::plain(&mut self.dice, [v, 0.95 * v, 0.85 * v]);
        let frame = self.shell.look(Look::patterned(frame));
        for _ in 0..count {
            let half = [self.dice.log(0.12, 0.55), self.dice.log(0.12, 0.4)];
            let wall = self.plan.wall(self.dice.int(0, 3));
            let along = self.dice.real(-0.85, 0.85) * (wall.half - half[0]).max(0.0);
            let up = self.dice.real(1.35, 1.65) - half[1];
            let at = wall.point(along, up, 0.014);
            let spot = Spot { at, yaw: wall.yaw, half: [half[0], 0.012], height: 2.0 * half[1] };
            if !self.plan.fits(&spot, 0.02) {
                continue;
            }
            let [base, second] = self.dice.pick(&PRINTS);
            let mut print: Material = style::plain(&mut self.dice, base);
            let (pattern, period) = self.dice.pick(&[
                (Pattern::Cloud, 0.25),
                (Pattern::Cloud, 0.08),
                (Pattern::Cloud, 0.5),
                (Pattern::Stripe, 0.03),
                (Pattern::Text, 0.04),
                (Pattern::Print, 0.3),
            ]);
            (print.pattern, print.period, print.second, print.grain) = (pattern, period, second, 0.0);
            let print = self.shell.look(Look::patterned(print));
            self.shell.cuboid(at, wall.yaw, [half[0], half[1], 0.012], frame);
            let rim = self.dice.real(0.015, 0.04);
            let inner = wall.point(along, up + rim, 0.015);
            self.shell.cuboid(inner, wall.yaw, [half[0] - rim, half[1] - rim, 0.013], print);
            self.plan.taken.push(spot);
        }
    }
}
