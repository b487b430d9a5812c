//! What of the room a model takes up, and where things can stand on it, on a grid over its footprint.

use super::mesh::{Mesh, ray};
use crate::scenes::space::{V3, add, mul, sub};

/// Side of a cell, metres, where the model is not too large for it.
const CELL: f32 = 0.04;

/// Cells along a side, at most.
const MOST: usize = 72;

/// Least height above a board for it to count, metres.
const LEAST: f32 = 0.07;

/// A level surface: its height, and how much room there is above it, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Board {
    pub height: f32,
    pub room: f32,
}

/// Spans of height and boards of every cell.
pub(super) struct Profile {
    low: V3,
    cell: [f32; 2],
    count: [usize; 2],
    /// Lowest and highest point in each cell; the lowest is above the highest where there is nothing.
    spans: Vec<(f32, f32)>,
    boards: Vec<Vec<Board>>,
}

impl Profile {
    /// `clear` tells which materials are glass: nothing stands on glass.
    pub fn new(mesh: &Mesh, clear: impl Fn(u16) -> bool) -> Self {
        let extent = sub(mesh.high, mesh.low);
        let count = [extent[0], extent[2]].map(|e| ((e / CELL).ceil() as usize).clamp(1, MOST));
        let cell = [extent[0] / count[0] as f32, extent[2] / count[1] as f32].map(|c| c.max(1e-4));
        let empty = (f32::INFINITY, f32::NEG_INFINITY);
        let mut profile = Self {
            low: mesh.low,
            cell,
            count,
            spans: vec![empty; count[0] * count[1]],
            boards: vec![Vec::new(); count[0] * count[1]],
        };
        profile.measure(mesh);
        for k in 0..profile.boards.len() {
            profile.boards[k] = profile.boards_in(mesh, k, &clear);
        }
        profile
    }

    /// Marks points on every face, close enough to leave out no cell.
    fn measure(&mut self, mesh: &Mesh) {
        let step = 0.5 * self.cell[0].min(self.cell[1]);
        for face in 0..mesh.faces() as u32 {
            let [a, b, c] = mesh.corners(face);
            let (e1, e2) = (sub(b, a), sub(c, a));
            let flat = |e: V3| (e[0] * e[0] + e[2] * e[2]).sqrt();
            let longest = flat(e1).max(flat(e2)).max(flat(sub(c, b)));
            let n = ((longest / step).ceil() as usize).clamp(1, 2 * MOST);
            for i in 0..=n {
                for j in 0..=n - i {
                    let p = add(a, add(mul(e1, i as f32 / n as f32), mul(e2, j as f32 / n as f32)));
                    if let Some(k) = self.index(p[0], p[2]) {
                        let span = &mut self.spans[k];
                        *span = (span.0.min(p[1]), span.1.max(p[1]));
                    }
                }
            }
        }
    }

    fn index(&self, x: f32, z: f32) -> Option<usize> {
        let cell = |v: f32, low: f32, side: f32, n: usize| {
            let at = (v - low) / side;
            // What lies on the far border belongs to the last cell.
            (at > -1e-3 && at < n as f32 + 1e-3).then(|| (at.max(0.0) as usize).min(n - 1))
        };
        let i = cell(x, self.low[0], self.cell[0], self.count[0])?;
        Some(cell(z, self.low[2], self.cell[1], self.count[1])? * self.count[0] + i)
    }

    /// The middle of a cell.
    fn middle(&self, k: usize) -> [f32; 2] {
        let (i, j) = (k % self.count[0], k / self.count[0]);
        [self.low[0] + (i as f32 + 0.5) * self.cell[0], self.low[2] + (j as f32 + 0.5) * self.cell[1]]
    }

    fn boards_in(&self, mesh: &Mesh, k: usize, clear: &impl Fn(u16) -> bool) -> Vec<Board> {
        let [x, z] = self.middle(k);
        let opaque = |t: &super::mesh::Touch| !clear(mesh.material(t.face));
        let (mut from, mut above) = (mesh.high[1] + 0.01, f32::INFINITY);
        let mut boards = Vec::new();
        for _ in 0..40 {
            let down = ray([x, from, z], [0.0, -1.0, 0.0], 1e-5, f32::INFINITY);
            let Some(touch) = mesh.nearest(down, opaque) else { break };
            let height = from - touch.t;
            let normal = mesh.plane(touch.face);
            let level = normal[1].abs() > 0.98 * crate::scenes::space::norm(normal);
            let room = above - height;
            if level && room > LEAST {
                // Inside a closed cabinet nothing is seen.
                let out = ray([x, height + 0.5 * LEAST, z], [0.0, 0.0, 1.0], 1e-5, f32::INFINITY);
                if room == f32::INFINITY || !mesh.any(out, opaque) {
                    boards.push(Board { height, room });
                }
            }
            (from, above) = (height - 1e-4, height);
        }
        boards
    }

    /// A cell with a board, by a number from 0 to 1: the cell's middle and its boards.
    pub fn board_cell(&self, pick: f32) -> Option<([f32; 2], &[Board])> {
        let with: usize = self.boards.iter().filter(|b| !b.is_empty()).count();
        let n = ((pick * with as f32) as usize).min(with.checked_sub(1)?);
        let (k, boards) = self.boards.iter().enumerate().filter(|(_, b)| !b.is_empty()).nth(n)?;
        Some((self.middle(k), boards))
    }

    /// Whether a rectangle (half sides, turned by `yaw`) around `at` lies on boards of this height with `room` above, all of it.
    pub fn carries(&self, at: [f32; 2], half: [f32; 2], yaw: f32, height: f32, room: f32) -> bool {
        let on = |b: &Board| (b.height - height).abs() < 0.004 && b.room > room;
        let (s, c) = yaw.sin_cos();
        let steps = half.map(|h| ((2.0 * h / (0.7 * CELL)).ceil() as i32).clamp(2, 64));
        (0..=steps[0]).all(|i| {
            (0..=steps[1]).all(|j| {
                let x = half[0] * (2.0 * i as f32 / steps[0] as f32 - 1.0);
                let z = half[1] * (2.0 * j as f32 / steps[1] as f32 - 1.0);
                let k = self.index(at[0] + c * x + s * z, at[1] - s * x + c * z);
                k.is_some_and(|k| self.boards[k].iter().any(on))
            })
        })
    }

    /// Boards that reach over most of the model's width at mid depth: where rows of books may stand. Heights and rooms.
    pub fn shelves(&self) -> Vec<Board> {
        let row = |j: usize| j * self.count[0]..(j + 1) * self.count[0];
        let mid = &self.boards[row(self.count[1] / 2)];
        let mut found: Vec<(Board, usize)> = Vec::new();
        for board in mid.iter().flatten() {
            match found.iter_mut().find(|(b, _)| (b.height - board.height).abs() < 0.01) {
                Some((b, n)) => {
                    b.room = b.room.min(board.room);
                    *n += 1;
                }
                None => found.push((*board, 1)),
            }
        }
        found.retain(|(_, n)| *n * 2 > self.count[0]);
        found.into_iter().map(|(b, _)| b).collect()
    }

    /// Whether some cell of this model, standing at a place of the other's frame and turned by `yaw`, is at the height of what the
    /// other has there.
    pub fn clashes(&self, at: [f32; 2], yaw: f32, other: &Profile) -> bool {
        let (s, c) = yaw.sin_cos();
        (0..self.spans.len()).any(|k| {
            let (low, high) = self.spans[k];
            if low > high {
                return false;
            }
            let [x, z] = self.middle(k);
            let there = other.index(at[0] + c * x + s * z, at[1] - s * x + c * z);
            there.is_some_and(|k| {
                let (a, b) = other.spans[k];
                low < b - 0.005 && a + 0.005 < high
            })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::geometry::Geometry;
    use super::super::geometry::tests::cuboid;
    use super::*;

    fn joined(parts: &[Geometry]) -> Mesh {
        let mut all = Geometry::default();
        for part in parts {
            let base = all.points.len() as u32;
            all.points.extend(&part.points);
            all.faces.extend(part.faces.iter().map(|f| {
                let points = f.points.map(|i| i + base);
                super::super::geometry::Face { points, ..*f }
            }));
        }
        Mesh::new(&all)
    }

    /// A top of 1.2 x 0.8 m at 0.7 m on four legs.
    fn table() -> Mesh {
        let mut parts = vec![cuboid([-0.6, 0.67, -0.4], [0.6, 0.7, 0.4], 0)];
        for (x, z) in [(-0.58, -0.38), (0.54, -0.38), (-0.58, 0.34), (0.54, 0.34)] {
            parts.push(cuboid([x, 0.0, z], [x + 0.04, 0.67, z + 0.04], 0));
        }
        joined(&parts)
    }

    #[test]
    fn things_rest_on_a_table_and_not_beyond_its_border() {
        let p = Profile::new(&table(), |_| false);
        assert!(p.carries([0.0, 0.0], [0.2, 0.1], 0.7, 0.7, 0.3));
        assert!(p.carries([0.39, 0.0], [0.2, 0.1], 0.0, 0.7, 0.3));
        assert!(!p.carries([0.45, 0.0], [0.2, 0.1], 0.0, 0.7, 0.3), "over the border");
        assert!(!p.carries([0.0, 0.0], [0.2, 0.1], 0.0, 0.6, 0.3), "in the air");
        let (at, boards) = p.board_cell(0.4).unwrap();
        assert!(at[0].abs() < 0.6 && (boards[0].height - 0.7).abs() < 1e-4);
        let glass = Profile::new(&table(), |_| true);
        assert!(glass.board_cell(0.5).is_none(), "nothing stands on glass");
    }

    #[test]
    fn a_seat_slides_under_the_table_and_a_back_does_not() {
        let t = Profile::new(&table(), |_| false);
        let stool = Profile::new(&joined(&[cuboid([-0.2, 0.0, -0.2], [0.2, 0.5, 0.2], 0)]), |_| false);
        let tall = Profile::new(&joined(&[cuboid([-0.2, 0.0, -0.2], [0.2, 0.9, 0.2], 0)]), |_| false);
        assert!(!stool.clashes([0.0, 0.3], 0.0, &t));
        assert!(tall.clashes([0.0, 0.3], 0.0, &t));
        assert!(!tall.clashes([0.0, 0.61], 0.0, &t), "beside it");
        assert!(stool.clashes([0.56, 0.36], 0.0, &t), "a leg in the way");
    }

    #[test]
    fn shelves_are_open_to_the_front_and_a_cupboard_is_not() {
        let (w, d) = (0.5, 0.15);
        let board = |y: f32| cuboid([-w, y, -d], [w, y + 0.02, d], 0);
        let back = cuboid([-w, 0.0, -d], [w, 1.22, 0.02 - d], 0);
        let open = [board(0.0), board(0.6), board(1.2), back.clone()];
        let p = Profile::new(&joined(&open), |_| false);
        let heights: Vec<f32> = p.shelves().iter().map(|b| (b.height * 100.0).round()).collect();
        assert_eq!(heights, [122.0, 62.0, 2.0]);
        assert!(p.carries([0.0, 0.02], [0.1, 0.05], 0.0, 0.62, 0.5));
        assert!(!p.carries([0.0, 0.02], [0.1, 0.05], 0.0, 0.62, 0.6), "too tall for the shelf");
        let front = cuboid([-w, 0.0, d - 0.01], [w, 1.22, d], 0);
        let closed = [board(0.0), board(0.6), board(1.2), back, front];
        assert_eq!(Profile::new(&joined(&closed), |_| false).shelves().len(), 1, "only its top");
    }
}
