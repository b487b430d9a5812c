//! Walls, floors, boxes: the triangles of a room that come from no file.

use super::geometry::{Face, Geometry};
use super::look::Look;
use super::plan::Wall;
use crate::scenes::space::{V3, add, to_world, turned};

/// A hole in a wall: its middle along the wall, half its width, and the heights of its sides.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Opening {
    pub along: f32,
    pub half: f32,
    pub low: f32,
    pub high: f32,
}

/// What a wall is covered with.
#[derive(Clone, Copy)]
pub(super) struct Covering {
    pub wall: u16,
    /// On the thresholds of doors.
    pub floor: u16,
    /// A skirting board's look and height.
    pub skirting: Option<(u16, f32)>,
}

/// Triangles and their looks under construction.
#[derive(Default)]
pub(super) struct Shell {
    pub geometry: Geometry,
    pub looks: Vec<Look>,
}

impl Shell {
    /// Adds a look and returns its number.
    pub fn look(&mut self, look: Look) -> u16 {
        self.looks.push(look);
        (self.looks.len() - 1) as u16
    }

    /// A plane quadrilateral; texture coordinates run from 0 to 1 from the first corner to the second and to the fourth.
    pub fn quad(&mut self, corners: [V3; 4], material: u16) {
        let base = self.geometry.points.len() as u32;
        self.geometry.points.extend(corners);
        let uv = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
        for (a, b) in [(1, 2), (2, 3)] {
            let points = [base, base + a as u32, base + b as u32];
            self.geometry.faces.push(Face { points, uv: [uv[0], uv[a], uv[b]], material });
        }
    }

    /// A box that stands on `at`, its front (and its back) upright for a picture.
    pub fn cuboid(&mut self, at: V3, yaw: f32, half: V3, material: u16) {
        let axes = turned(yaw, 0.0, 0.0);
        let [w, h, d] = half;
        let p = |x: f32, y: f32, z: f32| add(at, to_world(&axes, [x * w, h + y * h, z * d]));
        // Who looks at the front has -x to the right.
        let sides = [
            [p(1.0, -1.0, 1.0), p(-1.0, -1.0, 1.0), p(-1.0, 1.0, 1.0), p(1.0, 1.0, 1.0)],
            [p(-1.0, -1.0, -1.0), p(1.0, -1.0, -1.0), p(1.0, 1.0, -1.0), p(-1.0, 1.0, -1.0)],
            [p(-1.0, -1.0, 1.0), p(-1.0, -1.0, -1.0), p(-1.0, 1.0, -1.0), p(-1.0, 1.0, 1.0)],
            [p(1.0, -1.0, -1.0), p(1.0, -1.0, 1.0), p(1.0, 1.0, 1.0), p(1.0, 1.0, -1.0)],
            [p(1.0, 1.0, 1.0), p(-1.0, 1.0, 1.0), p(-1.0, 1.0, -1.0), p(1.0, 1.0, -1.0)],
            [p(-1.0, -1.0, 1.0), p(1.0, -1.0, 1.0), p(1.0, -1.0, -1.0), p(-1.0, -1.0, -1.0)],
        ];
        sides.into_iter().for_each(|side| self.quad(side, material));
    }

    /// A wall of a height with openings, which do not overlap: its inner face, the sides of the openings, `thick` deep, and
    /// perhaps a skirting board.
    pub fn wall(&mut self, wall: &Wall, height: f32, openings: &[Opening], thick: f32, on: &Covering) {
        let mut openings = openings.to_vec();
        openings.sort_by(|a, b| a.along.total_cmp(&b.along));
        let mut from = -wall.half;
        for o in &openings {
            let (left, right) = (o.along - o.half, o.along + o.half);
            self.panel(wall, [from, left], [0.0, height], on.wall);
            self.panel(wall, [left, right], [0.0, o.low], on.wall);
            self.panel(wall, [left, right], [o.high, height], on.wall);
            self.reveal(wall, o, thick, on);
            self.skirt(wall, [from, left], on.skirting);
            if o.low > 0.15 {
                self.skirt(wall, [left, right], on.skirting);
            }
            from = right;
        }
        self.panel(wall, [from, wall.half], [0.0, height], on.wall);
        self.skirt(wall, [from, wall.half], on.skirting);
    }

    fn panel(&mut self, wall: &Wall, along: [f32; 2], up: [f32; 2], material: u16) {
        if along[1] - along[0] > 1e-4 && up[1] - up[0] > 1e-4 {
            let p = |a: usize, u: usize| wall.point(along[a], up[u], 0.0);
            self.quad([p(1, 0), p(0, 0), p(0, 1), p(1, 1)], material);
        }
    }

    /// The four sides of an opening.
    fn reveal(&mut self, wall: &Wall, o: &Opening, thick: f32, on: &Covering) {
        let (left, right) = (o.along - o.half, o.along + o.half);
        let rim = [[left, o.low], [right, o.low], [right, o.high], [left, o.high]];
        for k in 0..4 {
            let ([a, b], [c, d]) = (rim[k], rim[(k + 1) % 4]);
            let p = |along, up, out: f32| wall.point(along, up, out);
            let material = if k == 0 && o.low == 0.0 { on.floor } else { on.wall };
            self.quad([p(a, b, 0.0), p(c, d, 0.0), p(c, d, -thick), p(a, b, -thick)], material);
        }
    }

    fn skirt(&mut self, wall: &Wall, along: [f32; 2], skirting: Option<(u16, f32)>) {
        if let Some((material, height)) = skirting.filter(|_| along[1] - along[0] > 0.02) {
            let middle = wall.point(0.5 * (along[0] + along[1]), 0.0, 0.0);
            self.cuboid(middle, wall.yaw, [0.5 * (along[1] - along[0]), 0.5 * height, 0.008], material);
        }
    }

    /// A closed space behind a wall, seen through an opening: from `near` to `far` behind the wall's face.
    pub fn corridor(&mut self, wall: &Wall, along: [f32; 2], height: f32, depth: [f32; 2], looks: [u16; 3]) {
        let [near, far] = depth.map(|d| -d);
        let p = |along: f32, up: f32, out: f32| wall.point(along, up, out);
        let ([a, b], [floor, side, top]) = (along, looks);
        self.quad([p(a, 0.0, near), p(b, 0.0, near), p(b, 0.0, far), p(a, 0.0, far)], floor);
        self.quad([p(a, height, near), p(b, height, near), p(b, height, far), p(a, height, far)], top);
        self.quad([p(b, 0.0, far), p(a, 0.0, far), p(a, height, far), p(b, height, far)], side);
        for x in [a, b] {
            self.quad([p(x, 0.0, near), p(x, 0.0, far), p(x, height, far), p(x, height, near)], side);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::mesh::{Mesh, ray};
    use super::super::plan::Plan;
    use super::*;
    use crate::scenes::texture::{Material, Pattern};

    fn plain() -> Look {
        Look::patterned(Material {
            pattern: Pattern::Plain,
            base: [0.5; 3],
            second: [0.5; 3],
            period: 1.0,
            grain: 0.0,
            grain_period: 1.0,
            gloss: 0.0,
            glow: 0.0,
            seed: 0,
        })
    }

    #[test]
    fn a_wall_is_closed_but_for_its_openings() {
        let plan = Plan::new([2.0, 2.5, 3.0]);
        let holes = [
            Opening { along: 0.9, half: 0.45, low: 0.0, high: 2.1 },
            Opening { along: -0.8, half: 0.5, low: 0.9, high: 2.0 },
        ];
        for k in 0..4 {
            let mut shell = Shell::default();
            let look = shell.look(plain());
            let wall = plan.wall(k);
            shell.wall(&wall, 2.5, &holes, 0.2, &Covering { wall: look, floor: look, skirting: None });
            let mesh = Mesh::new(&shell.geometry);
            let from = [0.1, 1.3, 0.05];
            for i in -18..=18 {
                for j in 1..24 {
                    let (along, up) = (0.1 * i as f32 + 0.013, 0.1 * j as f32 + 0.017);
                    let target = wall.point(along, up, 0.0);
                    let d = crate::scenes::space::sub(target, from);
                    let hit = mesh.nearest(ray(from, d, 0.0, 1.0001), |_| true);
                    let hole = holes
                        .iter()
                        .any(|o| (along - o.along).abs() < o.half && (o.low..o.high).contains(&up));
                    match hit {
                        Some(touch) => {
                            assert!(!hole && (touch.t - 1.0).abs() < 1e-4, "{k} {along} {up}: {touch:?}")
                        }
                        None => assert!(hole, "{k} {along} {up}"),
                    }
                }
            }
        }
    }
}
