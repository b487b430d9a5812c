//! Surface colours: patterns in metres, faded to their mean where a pixel is wider than the pattern.

use super::shapes::{Kind, Solid};
use super::space::{V3, mix, mul, times};
use crate::depth::sampling::noise::{floor, hash, hash01, noise};

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Pattern {
    Plain,
    Cloud,
    Checker,
    Brick,
    Tile,
    Stripe,
    Wood,
    Print,
    Text,
    Speckle,
    Window,
    Leaves,
    Road,
}

#[derive(Clone, Copy, Debug)]
pub(super) struct Material {
    pub pattern: Pattern,
    pub base: V3,
    pub second: V3,
    /// Period of the pattern, metres.
    pub period: f32,
    /// Relative brightness variation by noise.
    pub grain: f32,
    pub grain_period: f32,
    /// Strength of the highlight.
    pub gloss: f32,
    /// Own light, relative to the albedo.
    pub glow: f32,
    pub seed: u32,
}

/// Octaves of value noise around 0; those finer than two pixels are left out.
#[inline(always)]
fn octaves(u: f32, v: f32, period: f32, footprint: f32, seed: u32) -> f32 {
    let (mut sum, mut weight, mut p) = (0.0, 0.55, period);
    for k in 0..4 {
        let keep = (p / (2.0 * footprint) - 0.5).clamp(0.0, 1.0);
        if keep <= 0.0 {
            break;
        }
        sum += weight * keep * (noise(u / p, v / p, seed.wrapping_add(k)) - 0.5);
        weight *= 0.6;
        p *= 0.45;
    }
    sum
}

/// Surface coordinates in metres, and the same scaled to [-1, 1] over the face.
#[inline(always)]
pub(super) fn surface(solid: &Solid, p: V3) -> ([f32; 2], [f32; 2]) {
    let m = times(p, solid.half);
    match solid.kind {
        Kind::Cuboid | Kind::Cut { .. } => {
            let a = [p[0].abs(), p[1].abs(), p[2].abs()];
            if a[1] >= a[0] && a[1] >= a[2] {
                ([m[0], m[2]], [p[0], p[2]])
            } else if a[0] >= a[2] {
                ([m[2], m[1]], [p[2], p[1]])
            } else {
                ([m[0], m[1]], [p[0], p[1]])
            }
        }
        Kind::Frustum { .. } if p[1].abs() > 0.999 => ([m[0], m[2]], [p[0], p[2]]),
        _ => {
            let angle = p[2].atan2(p[0]);
            let s = angle * std::f32::consts::FRAC_1_PI;
            ([angle * solid.half[0].max(solid.half[2]), m[1]], [s, p[1]])
        }
    }
}

impl Material {
    /// Albedo at a point of `solid`'s surface (unit frame); `footprint` is the width of a pixel there, metres.
    pub fn albedo(&self, solid: &Solid, p: V3, footprint: f32) -> V3 {
        if self.pattern == Pattern::Plain && self.grain <= 0.0 {
            return self.base;
        }
        let (uv, st) = surface(solid, p);
        self.albedo_at(uv, st, solid.half[0] / solid.half[1].max(1e-6), footprint)
    }

    /// The same at surface coordinates `uv` in metres, and `st` in [-1, 1] over a face of which `ratio` is width by height.
    pub fn albedo_at(&self, uv: [f32; 2], st: [f32; 2], ratio: f32, footprint: f32) -> V3 {
        let c = self.colour(uv, st, footprint, ratio);
        if self.grain <= 0.0 {
            return c;
        }
        let g = octaves(uv[0], uv[1], self.grain_period, footprint, self.seed);
        mul(c, (1.0 + 2.0 * self.grain * g).max(0.05))
    }

    fn colour(&self, uv: [f32; 2], st: [f32; 2], footprint: f32, ratio: f32) -> V3 {
        let q = [uv[0] / self.period, uv[1] / self.period];
        let (i, j) = (floor(q[0]), floor(q[1]));
        let (a, b) = (q[0] - i as f32, q[1] - j as f32);
        // Sharpness of the pattern at this distance: 1 near, 0 when a period is below about two pixels.
        let px = footprint / self.period;
        let keep = (1.3 - 2.0 * px).clamp(0.0, 1.0);
        let two = |on: bool, mean: f32| {
            let t = if on { 1.0 } else { 0.0 };
            mix(self.base, self.second, mean + (t - mean) * keep)
        };
        match self.pattern {
            Pattern::Plain => self.base,
            Pattern::Cloud => {
                let t = 0.5 + 1.8 * octaves(uv[0], uv[1], self.period, footprint, self.seed ^ 7);
                mix(self.base, self.second, t.clamp(0.0, 1.0))
            }
            Pattern::Checker => two(i.wrapping_add(j) & 1 == 1, 0.5),
            Pattern::Stripe => {
                let t = hash01(i, 0, self.seed);
                let c = mix(self.base, self.second, t);
                mix(mix(self.base, self.second, 0.5), c, keep)
            }
            Pattern::Tile => {
                let line = (0.03f32).max(0.5 * px);
                let tone = 0.15 * (hash01(i, j, self.seed) - 0.5) * keep;
                mul(two(a < line || b < line, 2.0 * line.min(0.5)), 1.0 + tone)
            }
            Pattern::Brick => {
                let row = floor(2.0 * q[1]);
                let shift = q[0] + 0.5 * (row & 1) as f32;
                let block = floor(shift);
                let (along, across) = (shift - block as f32, 2.0 * q[1] - row as f32);
                let tone = 0.35 * (hash01(block, row, self.seed) - 0.5) * keep;
                mul(two(along < 0.05 || across < 0.1, 0.14), 1.0 + tone)
            }
            Pattern::Wood => {
                let board = floor(q[1] * 0.5);
                let bend = 0.6 * noise(q[0] * 0.15, q[1] * 0.6 + 17.0 * board as f32, self.seed);
                let ring = noise(q[0] * 0.25, (q[1] + bend) * 6.0, self.seed ^ 3);
                let tone = 0.25 * (hash01(board, 1, self.seed) - 0.5);
                mul(mix(self.base, self.second, 0.35 + (ring - 0.35) * keep), 1.0 + tone)
            }
            Pattern::Print => self.print(st, ratio),
            Pattern::Text => {
                let line = b > 0.25 && b < 0.75 && hash01(floor(q[0] * 2.2), j, self.seed) > 0.3;
                two(line && st[0].abs() < 0.85 && st[1].abs() < 0.9, 0.3)
            }
            Pattern::Speckle => {
                let n = noise(q[0], q[1], self.seed);
                two(n > 0.72, 0.2)
            }
            Pattern::Window => {
                let pane = a > 0.25 && a < 0.75 && b > 0.2 && b < 0.75;
                let frame = pane && ((a - 0.5).abs() < 0.02 || (b - 0.5).abs() < 0.02);
                let tone = 0.5 + hash01(i, j, self.seed);
                let c = two(pane && !frame, 0.27);
                if pane { mul(c, 1.0 + (tone - 1.0) * keep) } else { c }
            }
            Pattern::Leaves => {
                let n = octaves(uv[0], uv[1], self.period, footprint, self.seed ^ 5);
                mix(self.base, self.second, (0.5 + 2.6 * n).clamp(0.0, 1.0))
            }
            Pattern::Road => self.road(uv, footprint),
        }
    }

    /// Nested random rectangles with discs and lines of "text" in some: packaging, posters, screens, book covers.
    fn print(&self, st: [f32; 2], ratio: f32) -> V3 {
        let (mut s, mut t) = (0.5 * st[0] + 0.5, 0.5 * st[1] + 0.5);
        let (mut key, mut c) = (self.seed, self.base);
        let ratio = ratio.clamp(0.3, 3.0);
        for level in 0..4u32 {
            let pick = |n: u32| hash01(n as i32, level as i32, key);
            let cut = 0.2 + 0.6 * pick(0);
            let along_s = (pick(1) < 0.5) == (ratio > 0.6);
            let x = if along_s { &mut s } else { &mut t };
            let side = *x > cut;
            *x = if side { (*x - cut) / (1.0 - cut) } else { *x / cut };
            key = hash(side as i32, level as i32, key);
            if level > 0 && hash01(9, 9, key) < 0.35 {
                break;
            }
        }
        let pick = |n: i32| hash01(n, 31, key);
        let other = [pick(3), pick(4), pick(5)];
        c = mix(c, if pick(6) < 0.5 { self.second } else { times(other, other) }, pick(7).sqrt());
        let ink = if c[0] + c[1] + c[2] > 0.9 { [0.03; 3] } else { [0.85; 3] };
        let style = pick(8);
        if style < 0.3 {
            let (x, y) = ((s * (6.0 + 20.0 * pick(9))) as i32, t * (3.0 + 7.0 * pick(10)));
            if y.fract() > 0.5 && s > 0.1 && s < 0.9 && hash01(x, y as i32, key) > 0.25 {
                return ink;
            }
        } else if style < 0.55 {
            let (x, y) = (s - 0.5, t - 0.5);
            if x * x + y * y < 0.02 + 0.15 * pick(11) {
                return mix(ink, other, pick(12));
            }
        } else if style < 0.7 {
            return mix(c, other, t);
        }
        c
    }

    /// Asphalt with lane marks along the second coordinate.
    fn road(&self, uv: [f32; 2], footprint: f32) -> V3 {
        let lane = uv[0] / self.period;
        let mark = floor(lane + 0.5);
        let near = (lane - mark as f32).abs() * self.period;
        let solid_line = mark % 3 == 0;
        let dash = uv[1] / 6.0 - (floor(uv[1] / 6.0) as f32) < 0.45;
        let width = 0.08f32;
        let cover = ((width + 0.5 * footprint - near) / footprint.max(1e-4)).clamp(0.0, 1.0)
            * (2.0 * width / footprint.max(2.0 * width));
        if solid_line || dash { mix(self.base, self.second, cover) } else { self.base }
    }
}
