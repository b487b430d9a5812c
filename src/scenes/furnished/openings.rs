//! Doors, windows, what is behind them, and lamps.

use super::light::{Light, Sun};
use super::look::Look;
use super::plan::{Plan, Spot};
use super::role::Role;
use super::room::{Hold, Hole, Piece, Room};
use super::shell::{Covering, Opening};
use super::style::{self, Kind, Style};
use crate::scenes::space::{V3, mul, turned, unit};
use crate::scenes::texture::Pattern;

impl Room<'_> {
    /// Chooses doors and windows and keeps the room before them free. Walls are built later.
    pub fn open(&mut self) {
        let doors = if self.dice.chance(0.75) { 1 } else { 2 };
        for _ in 0..doors {
            self.door();
        }
        let windows = match self.kind {
            Kind::Bathroom => self.dice.int(0, 1),
            Kind::Workshop => self.dice.int(0, 2),
            _ => self.dice.pick(&[0, 1, 2, 2, 3]),
        };
        let wall = self.dice.int(0, 3);
        for i in 0..windows {
            let k = if i == 2 { self.dice.int(0, 3) } else { wall };
            self.window(k);
        }
    }

    /// The space that must stay free before an opening, `deep` into the room.
    fn keep(&mut self, hole: &Hole, deep: f32) {
        let (o, wall) = (hole.opening, self.plan.wall(hole.wall));
        let at = wall.point(o.along, o.low, 0.5 * deep);
        let spot = Spot { at, yaw: wall.yaw, half: [o.half + 0.05, 0.5 * deep], height: o.high - o.low };
        self.plan.kept.push(spot);
        self.holes.push(*hole);
    }

    /// A place for an opening of half a width on a wall, away from the others.
    fn gap(&mut self, wall: usize, half: f32) -> Option<f32> {
        let reach = self.plan.wall(wall).half - half - 0.12;
        (0..8).filter(|_| reach > 0.0).find_map(|_| {
            let along = self.dice.real(-reach.max(0.0), reach.max(0.0));
            let apart = |h: &&Hole| (h.opening.along - along).abs() < h.opening.half + half + 0.15;
            (!self.holes.iter().filter(|h| h.wall == wall).any(|h| apart(&h))).then_some(along)
        })
    }

    fn door(&mut self) {
        let wall = self.dice.int(0, 3);
        let height = self.plan.size[1];
        let leaf = if self.dice.chance(0.7) {
            self.choose_where(Role::Door, |m| m.size()[1] < height - 0.1)
        } else {
            None
        };
        let half = leaf.as_ref().map_or(self.dice.real(0.4, 0.75), |m| m.half()[0] - 0.005);
        let high =
            leaf.as_ref().map_or(self.dice.real(1.98, 2.2), |m| m.size()[1] - 0.005).min(height - 0.08);
        let Some(along) = self.gap(wall, half) else { return };
        let hole = Hole { wall, opening: Opening { along, half, low: 0.0, high }, window: false };
        self.keep(&hole, 0.8);
        if let Some(model) = leaf {
            self.insert(model, &hole, 0.0);
        }
    }

    fn window(&mut self, wall: usize) {
        let height = self.plan.size[1];
        let fits = |m: &super::model::Model| m.entry.elevation + m.size()[1] < height - 0.05;
        let Some(model) = self.choose_where(Role::Window, fits) else { return };
        let half = model.half()[0] - 0.005;
        let (low, tall) = (model.entry.elevation + 0.005, model.size()[1] - 0.01);
        let Some(along) = self.gap(wall, half) else { return };
        let hole = Hole { wall, opening: Opening { along, half, low, high: low + tall }, window: true };
        self.keep(&hole, 0.12);
        let up = model.entry.elevation;
        self.insert(model, &hole, up);
    }

    /// Puts a door or window into its opening, as deep in the wall as its catalogue says.
    fn insert(&mut self, model: std::sync::Arc<super::model::Model>, hole: &Hole, up: f32) {
        let wall = self.plan.wall(hole.wall);
        let out = 0.5 * model.size()[2] - model.entry.behind;
        let at = wall.point(hole.opening.along, up, out);
        self.pieces.push(Piece { model, at, yaw: wall.yaw, hold: Hold::Opening });
    }

    /// Walls, floor, ceiling, and what is seen through openings.
    pub fn build(&mut self, style: &Style) {
        let [w, h, l] = self.plan.size;
        let floor = self.shell.look(Look::patterned(style.floor));
        let ceiling = self.shell.look(Look::patterned(style.ceiling));
        let walls = style.walls.map(|m| self.shell.look(Look::patterned(m)));
        let trim = self.shell.look(Look::patterned(style.trim));
        self.shell.quad([[-w, 0.0, -l], [w, 0.0, -l], [w, 0.0, l], [-w, 0.0, l]], floor);
        self.shell.quad([[-w, h, -l], [w, h, -l], [w, h, l], [-w, h, l]], ceiling);
        let skirting = self.dice.chance(0.8).then(|| (trim, self.dice.real(0.05, 0.12)));
        let thick = self.dice.real(0.12, 0.32);
        for (k, wall) in walls.into_iter().enumerate() {
            let openings: Vec<Opening> =
                self.holes.iter().filter(|o| o.wall == k).map(|o| o.opening).collect();
            let skirting = skirting.filter(|_| self.kind != Kind::Bathroom);
            let on = Covering { wall, floor, skirting };
            self.shell.wall(&self.plan.wall(k), h, &openings, thick, &on);
        }
        for hole in self.holes.clone() {
            if !hole.window {
                self.beyond_door(&hole, thick, [floor, walls[hole.wall], ceiling]);
            }
        }
        if self.holes.iter().any(|h| h.window) {
            self.outdoors();
        }
    }

    /// Another room behind a door, with a light of its own.
    fn beyond_door(&mut self, hole: &Hole, thick: f32, looks: [u16; 3]) {
        let wall = self.plan.wall(hole.wall);
        let o = hole.opening;
        let (left, right) = (self.dice.real(0.3, 2.0), self.dice.real(0.3, 2.0));
        let deep = self.dice.log(1.0, 5.0);
        let along = [o.along - o.half - left, o.along + o.half + right];
        let height = self.plan.size[1];
        self.shell.corridor(&wall, along, height, [thick, thick + deep], looks);
        let power = mul([1.0, 0.93, 0.82], self.dice.real(0.3, 2.0));
        let at = wall.point(o.along, height - 0.3, -thick - 0.5 * deep);
        self.lights.push(Light::lamp(at, 0.15, power));
    }

    /// Ground and perhaps houses outside, lit by the day; the sky is open.
    fn outdoors(&mut self) {
        let far = self.dice.log(8.0, 45.0);
        let down = if self.dice.chance(0.5) { 0.3 } else { self.dice.real(2.5, 14.0) };
        let day = self.day;
        let glow = move |mut m: crate::scenes::texture::Material| {
            m.glow = 0.7 * day;
            Look::patterned(m)
        };
        let green = self.dice.real(0.0, 1.0);
        let mut ground = style::plain(&mut self.dice, [0.22 - 0.1 * green, 0.22, 0.2 - 0.13 * green]);
        (ground.pattern, ground.second, ground.period) = (Pattern::Cloud, mul(ground.base, 0.6), 1.5);
        let ground = self.shell.look(glow(ground));
        let r = 2.0 * far;
        let [w, _, l] = self.plan.size;
        // Outside only: light must not find it below the room.
        for k in 0..4 {
            let edge = if k % 2 == 0 { l } else { w } + 0.4;
            let wall = super::plan::Wall { middle: [0.0; 3], yaw: self.plan.wall(k).yaw, half: r };
            let p = |along: f32, out: f32| {
                let q = wall.point(along, 0.0, -out);
                [q[0], -down, q[2]]
            };
            self.shell.quad([p(-r, edge), p(r, edge), p(r, r), p(-r, r)], ground);
        }
        let houses = self.dice.real(0.0, 1.0);
        for _ in 0..14 {
            let a = self.dice.real(0.0, std::f32::consts::TAU);
            let distance = far * self.dice.real(0.7, 1.5) + w.max(l);
            let (half, tall) =
                ([self.dice.real(2.0, 9.0), self.dice.real(2.0, 5.0)], self.dice.log(2.0, 9.0));
            let (pattern, period) =
                if self.dice.chance(0.6) { (Pattern::Window, 2.8) } else { (Pattern::Plain, 1.0) };
            let v = self.dice.real(0.2, 0.65);
            let warm = self.dice.real(0.8, 1.0);
            let mut m = style::plain(&mut self.dice, [v, v * (0.5 + 0.5 * warm), v * warm]);
            (m.pattern, m.second, m.period) = (pattern, mul(m.base, 0.3), period);
            if self.dice.chance(houses) {
                let look = self.shell.look(glow(m));
                let at = [distance * a.sin(), -down, distance * a.cos()];
                self.shell.cuboid(at, a, [half[0], tall, half[1]], look);
            }
        }
    }

    /// Lamps on the ceiling, and the light of those that stand or hang elsewhere.
    pub fn lamps(&mut self) {
        let [w, h, l] = self.plan.size;
        let mut shine: Vec<(V3, f32)> = Vec::new();
        for piece in &self.pieces {
            let [_, tall, _] = piece.model.size();
            match piece.model.role {
                Role::TableLamp | Role::FloorLamp => shine.push((piece.point([0.0, 0.88 * tall, 0.0]), 0.35)),
                Role::WallLamp => shine.push((piece.point([0.0, 0.5 * tall, 0.1]), 0.3)),
                _ => {}
            }
        }
        let warm = self.dice.real(0.0, 1.0);
        let tint = [1.0, 0.92 - 0.12 * warm, 0.84 - 0.32 * warm];
        for (at, power) in shine {
            if self.dice.chance(if self.lit { 0.8 } else { 0.2 }) {
                self.lights.push(Light::lamp(at, 0.1, mul([1.0, 0.8, 0.55], power)));
            }
        }
        let tubes = matches!(self.kind, Kind::Office | Kind::Workshop) || self.dice.chance(0.15);
        let [nx, nz] = [w, l].map(|half| ((2.0 * half / 3.2).ceil() as usize).max(1));
        let power = self.dice.real(3.0, 5.6) * (w * l).sqrt() / (nx * nz) as f32;
        let fans = self.dice.chance(0.1);
        let fits = |m: &super::model::Model| m.size()[1] < h - 2.0 && (fans || m.entry.category == "Lights");
        let model = if tubes { None } else { self.choose_where(Role::CeilingLamp, fits) };
        for i in 0..nx {
            for j in 0..nz {
                let x = (2 * i + 1) as f32 / nx as f32 * w - w;
                let z = (2 * j + 1) as f32 / nz as f32 * l - l;
                self.ceiling_lamp(model.clone(), [x, h, z], mul(tint, power));
            }
        }
    }

    fn ceiling_lamp(&mut self, model: Option<std::sync::Arc<super::model::Model>>, at: V3, power: V3) {
        if let Some(model) = model {
            let tall = model.size()[1];
            let low = [at[0], at[1] - tall, at[2]];
            let piece = Piece { model, at: low, yaw: 0.0, hold: Hold::Ceiling };
            if self.put(piece).is_some() && self.lit {
                // Below the shade, which would keep its light for itself.
                self.lights.push(Light::lamp([at[0], (low[1] - 0.06).max(1.7), at[2]], 0.12, power));
            }
            return;
        }
        let half = if self.dice.chance(0.5) { [0.6, 0.08] } else { [0.3, 0.3] };
        let mut look = style::plain(&mut self.dice, [0.8; 3]);
        look.glow = if self.lit { 2.5 } else { 0.0 };
        look.grain = 0.0;
        let look = self.shell.look(Look::patterned(look));
        self.shell.cuboid([at[0], at[1] - 0.05, at[2]], 0.0, [half[0], 0.024, half[1]], look);
        if self.lit {
            self.lights.push(Light {
                at: [at[0], at[1] - 0.06, at[2]],
                half: [[half[0], 0.0, 0.0], [0.0, 0.0, half[1]]],
                normal: [0.0, -1.0, 0.0],
                power,
            });
        }
    }

    /// Windows shine by the sky's light; by day the sun may come in through one.
    pub fn windows(&mut self) -> Option<Sun> {
        let day = self.day;
        let holes: Vec<Hole> = self.holes.iter().filter(|h| h.window).copied().collect();
        for hole in &holes {
            let (o, wall) = (hole.opening, self.plan.wall(hole.wall));
            let [right, _, forward] = turned(wall.yaw, 0.0, 0.0);
            let tall = 0.5 * (o.high - o.low);
            let power = mul([0.9, 0.97, 1.08], day * 4.0 * o.half * tall * 0.32);
            self.lights.push(Light {
                at: wall.point(o.along, o.low + tall, 0.02),
                half: [mul(right, o.half), [0.0, tall, 0.0]],
                normal: forward,
                power,
            });
        }
        let hole = *holes.first()?;
        if day < 1.0 || !self.dice.chance(0.45) {
            return None;
        }
        // Down through the window, from one side or the other.
        let [right, _, forward] = turned(self.plan.wall(hole.wall).yaw, 0.0, 0.0);
        let (aside, high) = (self.dice.real(-0.8, 0.8), self.dice.real(0.25, 1.1));
        let to = unit([0, 1, 2].map(|k| right[k] * aside - forward[k] + [0.0, high, 0.0][k]));
        Some(Sun { to, power: mul([1.0, 0.9, 0.75], day * self.dice.real(0.8, 2.2)) })
    }
}

/// Whether light along `to` reaches a point of the room through a window.
pub(super) fn sees_sky(plan: &Plan, holes: &[Hole], p: V3, to: V3) -> bool {
    holes.iter().filter(|h| h.window).any(|hole| {
        let wall = plan.wall(hole.wall);
        let [right, _, forward] = turned(wall.yaw, 0.0, 0.0);
        let speed = crate::scenes::space::dot(to, forward);
        let gap = crate::scenes::space::dot(crate::scenes::space::sub(p, wall.middle), forward);
        if speed >= -1e-4 {
            return false;
        }
        let q = crate::scenes::space::add(p, mul(to, gap / -speed));
        let along = crate::scenes::space::dot(crate::scenes::space::sub(q, wall.middle), right);
        (along - hole.opening.along).abs() < hole.opening.half
            && (hole.opening.low..hole.opening.high).contains(&q[1])
    })
}
