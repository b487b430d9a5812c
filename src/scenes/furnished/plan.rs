//! The floor plan: which boxes are taken, and where walls are.

use std::f32::consts::{FRAC_PI_2, PI};

use crate::scenes::space::{V3, add, mul, turned};

/// An upright box: middle of its lower side, heading, half its sides and its height.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Spot {
    pub at: V3,
    pub yaw: f32,
    pub half: [f32; 2],
    pub height: f32,
}

impl Spot {
    /// Directions of its width and depth on the floor.
    fn axes(&self) -> [[f32; 2]; 2] {
        let (s, c) = self.yaw.sin_cos();
        [[c, -s], [s, c]]
    }

    /// The four corners on the floor.
    pub fn corners(&self) -> [[f32; 2]; 4] {
        let [a, b] = self.axes();
        [(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)].map(|(i, j)| {
            let (x, z) = (i * self.half[0], j * self.half[1]);
            [self.at[0] + x * a[0] + z * b[0], self.at[2] + x * a[1] + z * b[1]]
        })
    }

    /// Whether two boxes come closer than `gap`, by the axes of both (exact for gap 0).
    pub fn meets(&self, other: &Self, gap: f32) -> bool {
        let (low, high) =
            (self.at[1].max(other.at[1]), (self.at[1] + self.height).min(other.at[1] + other.height));
        if low >= high {
            return false;
        }
        let between = [other.at[0] - self.at[0], other.at[2] - self.at[2]];
        let reach = |s: &Self, axis: [f32; 2]| {
            let [a, b] = s.axes();
            let along = |v: [f32; 2]| (v[0] * axis[0] + v[1] * axis[1]).abs();
            s.half[0] * along(a) + s.half[1] * along(b)
        };
        self.axes().into_iter().chain(other.axes()).all(|axis| {
            let distance = (between[0] * axis[0] + between[1] * axis[1]).abs();
            distance < reach(self, axis) + reach(other, axis) + gap
        })
    }

    /// Whether a point is inside, with `gap` around the box.
    pub fn holds(&self, p: V3, gap: f32) -> bool {
        let [a, b] = self.axes();
        let d = [p[0] - self.at[0], p[2] - self.at[2]];
        (d[0] * a[0] + d[1] * a[1]).abs() < self.half[0] + gap
            && (d[0] * b[0] + d[1] * b[1]).abs() < self.half[1] + gap
            && (self.at[1] - gap..self.at[1] + self.height + gap).contains(&p[1])
    }
}

/// One side of a room: its heading points into the room.
#[derive(Clone, Copy, Debug)]
pub(super) struct Wall {
    pub middle: V3,
    pub yaw: f32,
    pub half: f32,
}

impl Wall {
    /// A point `along` the wall from its middle, `up` from the floor, `out` into the room.
    pub fn point(&self, along: f32, up: f32, out: f32) -> V3 {
        let [right, _, forward] = turned(self.yaw, 0.0, 0.0);
        let floor = add(self.middle, add(mul(right, along), mul(forward, out)));
        [floor[0], floor[1] + up, floor[2]]
    }
}

/// A rectangular room around the origin and what stands in it.
#[derive(Clone, Debug)]
pub(super) struct Plan {
    /// Half its width, its height, half its length.
    pub size: V3,
    pub taken: Vec<Spot>,
    /// Room that must stay free, before doors.
    pub kept: Vec<Spot>,
}

impl Plan {
    pub fn new(size: V3) -> Self {
        Self { size, taken: Vec::new(), kept: Vec::new() }
    }

    pub fn wall(&self, k: usize) -> Wall {
        let [w, _, l] = self.size;
        match k % 4 {
            0 => Wall { middle: [0.0, 0.0, l], yaw: PI, half: w },
            1 => Wall { middle: [w, 0.0, 0.0], yaw: -FRAC_PI_2, half: l },
            2 => Wall { middle: [0.0, 0.0, -l], yaw: 0.0, half: w },
            _ => Wall { middle: [-w, 0.0, 0.0], yaw: FRAC_PI_2, half: l },
        }
    }

    /// Whether a box lies in the room.
    pub fn inside(&self, spot: &Spot) -> bool {
        let [w, h, l] = self.size;
        spot.at[1] >= 0.0
            && spot.at[1] + spot.height <= h
            && spot.corners().iter().all(|c| c[0].abs() <= w + 1e-4 && c[1].abs() <= l + 1e-4)
    }

    /// Whether a box lies in the room, `gap` from all others, and leaves doors free.
    pub fn fits(&self, spot: &Spot, gap: f32) -> bool {
        self.inside(spot)
            && !self.taken.iter().any(|t| t.meets(spot, gap))
            && !self.kept.iter().any(|k| k.meets(spot, 0.0))
    }

    /// Whether a point is in the room and `gap` from everything.
    pub fn free(&self, p: V3, gap: f32) -> bool {
        let [w, h, l] = self.size;
        p[0].abs() < w - gap
            && p[2].abs() < l - gap
            && p[1] > 0.05
            && p[1] < h - gap
            && !self.taken.iter().any(|t| t.holds(p, gap))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spot(x: f32, z: f32, yaw: f32) -> Spot {
        Spot { at: [x, 0.0, z], yaw, half: [0.5, 0.2], height: 1.0 }
    }

    #[test]
    fn turned_boxes_meet_only_where_they_overlap() {
        let a = spot(0.0, 0.0, 0.0);
        assert!(a.meets(&spot(0.9, 0.0, 0.0), 0.0));
        assert!(!a.meets(&spot(1.01, 0.0, 0.0), 0.0));
        assert!(a.meets(&spot(1.01, 0.0, 0.0), 0.05));
        // The circles around them overlap, the boxes do not.
        assert!(!a.meets(&spot(0.0, 0.45, 0.0), 0.0));
        assert!(a.meets(&spot(0.0, 0.45, FRAC_PI_2), 0.0));
        assert!(!a.meets(&spot(0.75, 0.45, 0.785), 0.0));
        let above = Spot { at: [0.0, 1.0, 0.0], ..a };
        assert!(!a.meets(&above, 0.1), "things may hang above others");
        assert!(
            a.holds([0.4, 0.5, 0.1], 0.0)
                && !a.holds([0.4, 0.5, 0.3], 0.05)
                && !a.holds([0.0, 1.2, 0.0], 0.1)
        );
    }

    #[test]
    fn walls_look_into_the_room() {
        let plan = Plan::new([2.0, 2.5, 3.0]);
        for k in 0..4 {
            let wall = plan.wall(k);
            let p = wall.point(0.0, 1.0, 0.5);
            assert!(plan.free(p, 0.4) && !plan.free(p, 0.6), "{k}: {p:?}");
            for along in [-wall.half, wall.half] {
                let corner = wall.point(along, 0.0, 0.0);
                assert!(
                    (corner[0].abs() - 2.0).abs() < 1e-5 && (corner[2].abs() - 3.0).abs() < 1e-5,
                    "{corner:?}"
                );
            }
            let back = Spot { at: wall.point(0.3, 0.0, 0.2), yaw: wall.yaw, half: [0.5, 0.2], height: 1.0 };
            assert!(plan.inside(&back));
        }
        assert!(!plan.inside(&spot(1.6, 0.0, 0.0)) && plan.inside(&spot(1.6, 0.0, FRAC_PI_2)));
    }
}
